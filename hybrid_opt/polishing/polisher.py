"""Polish of fronts, by the cell's time law: of both peak forces, or of path and timing together."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from codegen.native import one_thread
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_PAIRS, FORCE_PAIRS, ROBUST_OBJECTIVES
from hybrid_opt.polishing.cell import SmoothCell
from hybrid_opt.polishing.drive import DriveStepMethod
from hybrid_opt.polishing.drive_front import DriveRun
from hybrid_opt.polishing.force import ForceSolver
from hybrid_opt.polishing.force_front import ForceRun
from hybrid_opt.polishing.front import ParetoArchive, PolishedFront, PolishRun
from hybrid_opt.polishing.functions import PolishFunctions, polish_functions
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.timing.model import TimingModel
from symbolic.array import Array
from symbolic.contact.registry import command_model
from symbolic.errors import SettingsError
from symbolic.records.cell import Workcell
from symbolic.records.task import initial_decision

TIMED_EVALUATIONS = 32
"""Number of candidates whose evaluation is timed; the cost of a polish is stated in evaluations."""


def has_polishable_forces(workcell: Workcell, objectives: Sequence[str]) -> bool:
    """Return True if the polish supports the forces among the objectives.

    It supports planned normal forces of all pads. Robust normal forces, which hold the box in every
    case of the uncertainty, need two pads with opposite normals.

    Args:
        workcell: the cell.
        objectives: names of the objectives.
    """
    return command_model(workcell).has_scalar_squeeze or tuple(objectives) != ROBUST_OBJECTIVES


class Polisher:
    """Polishes fronts of one cell. Reuse one object for several fronts, because it loads functions.

    Attributes:
        evaluator: evaluator of candidates by the full model.
        settings: settings of the polish.
        solver: minimises scalarisations of both peak forces; None in drivable cells.
        drive_method: step method of drivable carries; None with other time laws.
    """

    solver: ForceSolver | None = None
    drive_method: DriveStepMethod | None = None

    def __init__(
        self,
        evaluator: CandidateEvaluator,
        settings: PolishSettings,
        functions: PolishFunctions | None = None,
    ) -> None:
        """Load or build the functions for the polish of the evaluator's cell.

        Args:
            evaluator: evaluator of candidates by the full model.
            settings: settings of the polish.
            functions: compiled functions of the cell; None loads or builds them.

        Raises:
            SettingsError: the polish does not support the evaluator's objectives, or the cell's
                pads. It needs both peak normal forces as objectives, in drivable cells the duration
                and one of them. The forces may be planned or robust (holding the box in every case
                of the uncertainty).
            DualArmError: the functions cannot be built.
        """
        self.evaluator, self.settings = evaluator, settings
        driven = evaluator.workcell.task.law.is_drivable
        _require_objectives(evaluator, DRIVABLE_PAIRS if driven else FORCE_PAIRS, driven)
        functions = functions or polish_functions(evaluator.compiled)
        cell = SmoothCell(evaluator, functions, settings.clearance)
        if not driven:
            self.solver = ForceSolver(cell, settings)
            return
        self.drive_method = DriveStepMethod(cell)
        self._timings = TimingModel(evaluator.compiled, self.drive_method.driver.timer.intervals)

    def polish(
        self,
        front_x: Array,
        rng: np.random.Generator,
        paths: Array | None = None,
        on_progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> PolishedFront:
        """Polish a front.

        Args:
            front_x: (k, n_var) decision vectors of the front; k may be 0.
            rng: generator of random starts.
            paths: (m, n_path) free waypoints of known good paths, not necessarily on the front;
                only the polish of drivable carries uses them. None for none.
            on_progress: function called with the number of finished attempts and the expected
                total.
        """
        begin = time.perf_counter()
        x = np.asarray(front_x, dtype=float).reshape(-1, self.evaluator.n_var)
        unit = self._evaluation_seconds(x)
        found = self.evaluator.certified(self.evaluator.evaluate(x))
        feasible = np.flatnonzero(found.feasible)
        archive = ParetoArchive(x[feasible], found.objectives[feasible], feasible.tolist())
        known = np.empty((0, self.evaluator.workcell.task.n_path)) if paths is None else paths
        given = archive, on_progress
        run: PolishRun[Any]
        if self.solver is not None:
            run = ForceRun(self.solver, self.settings, *given)
        else:
            assert self.drive_method is not None
            run = DriveRun(self.drive_method, self.settings, self._timings, *given, known)
        if len(feasible) and self.settings.attempts:
            with one_thread():
                run.run(rng)
        on_progress(len(run.outcomes), len(run.outcomes))
        rows = archive.front_indices() if len(feasible) else []
        return PolishedFront(
            x=np.array([archive.x[k] for k in rows]).reshape(-1, self.evaluator.n_var),
            objectives=np.array([archive.objectives[k] for k in rows]).reshape(-1, 2),
            parent=np.array([archive.parent[k] for k in rows], dtype=np.int64),
            polished=np.array([archive.polished[k] for k in rows], dtype=bool),
            outcomes=tuple(run.outcomes),
            seconds=time.perf_counter() - begin,
            evaluation_seconds=unit,
            solver="quadratic" if self.solver is None else self.settings.solver,
        )

    def _evaluation_seconds(self, x: Array) -> float:
        """Measure the time of one candidate's evaluation [s].

        Args:
            x: (k, n_var) candidates to evaluate; the hand-made trajectory if k is 0.
        """
        sample = x if len(x) else initial_decision(self.evaluator.workcell.task)[None]
        batch = np.resize(sample, (TIMED_EVALUATIONS, self.evaluator.n_var))
        begin = time.perf_counter()
        self.evaluator.evaluate(batch)
        return (time.perf_counter() - begin) / len(batch)


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
