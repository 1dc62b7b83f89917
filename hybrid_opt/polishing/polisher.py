"""Which polish a cell gets: by its time law."""

from __future__ import annotations

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.drivable.front import DrivablePolisher
from hybrid_opt.polishing.front import FrontPolisher
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.run import Polisher
from hybrid_opt.polishing.settings import PolishSettings


def polisher_for(
    evaluator: CandidateEvaluator,
    settings: PolishSettings,
    functions: PolishFunctions | None = None,
) -> Polisher:
    """The polish of path and timing under the time law 'optimal', otherwise that of forces.

    Raises:
        SettingsError: the objectives are not those of the polish.
        DualArmError: its functions cannot be built.
    """
    driven = evaluator.workcell.task.time_law == "optimal"
    return (DrivablePolisher if driven else FrontPolisher)(evaluator, settings, functions)
