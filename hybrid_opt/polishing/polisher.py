"""Choice of the polisher of a cell, by its time law: of both peak forces, or of path and timing
together."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_PAIRS, FORCE_PAIRS, ROBUST_OBJECTIVES
from hybrid_opt.polishing.drive_front import DrivePolisher
from hybrid_opt.polishing.force_front import ForcePolisher
from hybrid_opt.polishing.front import Polisher
from hybrid_opt.polishing.functions import PolishFunctions, polish_functions
from hybrid_opt.polishing.settings import PolishSettings
from symbolic.contact.registry import command_model
from symbolic.errors import SettingsError
from symbolic.records.cell import Workcell


def has_polishable_forces(workcell: Workcell, objectives: Sequence[str]) -> bool:
    """Return True if the polish supports the forces among the objectives.

    It supports planned normal forces of all pads. Robust normal forces, which hold the box in every
    case of the uncertainty, need two pads with opposite normals.

    Args:
        workcell: the cell.
        objectives: names of the objectives.
    """
    return command_model(workcell).has_scalar_squeeze or tuple(objectives) != ROBUST_OBJECTIVES


CACHED_POLISHERS = 4
"""Number of polishers that are kept for further fronts, because they load functions."""


@lru_cache(maxsize=CACHED_POLISHERS)
def make_polisher(
    evaluator: CandidateEvaluator,
    settings: PolishSettings,
    functions: PolishFunctions | None = None,
) -> Polisher:
    """Load or build the functions for the polish of an evaluator's cell, and return its polisher.
    The same arguments return the same object.

    The objectives have to be both peak normal forces. In drivable cells, whose carries are timed
    from rest to rest within all limits, they have to be the duration and the largest force. The
    forces may be planned or robust (holding the box in every case of the uncertainty). Robust
    forces of pads whose normals are not opposite are not supported; planned forces are, with any
    pads.

    Args:
        evaluator: evaluator of candidates by the full model.
        settings: settings of the polish.
        functions: compiled functions of the cell; None loads or builds them.

    Raises:
        SettingsError: the polish does not support the evaluator's objectives, or their forces with
            the cell's pads.
        DualArmError: the functions cannot be built.
    """
    driven = evaluator.workcell.task.law.is_drivable
    _require_objectives(evaluator, DRIVABLE_PAIRS if driven else FORCE_PAIRS, driven)
    functions = functions or polish_functions(evaluator.compiled)
    return (DrivePolisher if driven else ForcePolisher)(evaluator, settings, functions)


def _require_objectives(
    evaluator: CandidateEvaluator, pairs: tuple[tuple[str, str], ...], driven: bool
) -> None:
    names = evaluator.objective_names
    known = [tuple(pair) for pair in pairs]
    if names not in known and not (driven and names[::-1] in known):
        named = " or ".join(" and ".join(pair) for pair in pairs)
        raise SettingsError(
            f"{'under the time law optimal ' if driven else ''}the polish minimises {named}; the "
            f"objectives are {', '.join(names)}: switch the polish off for them",
            code="objectives",
        )
    if not has_polishable_forces(evaluator.workcell, names):
        raise SettingsError(
            "the polish of robust forces knows two round pads that face one another, and no "
            "others: switch it off",
            code="not-polishable",
        )
