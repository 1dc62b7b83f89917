"""The library. `import hybrid_opt as ho` and work with a cell; docs/library.md shows how.

`Cell` is the only resource. `search` and `polish` make a `Front`, a front gives a `Carry`,
`time_path` makes a `Timing` of it, `recommend` says which to run, `plan_job` plans the whole job
around that, and `export` writes it for robots. `propose` makes the file of a cell that has no carry
yet. Rooms, in the order of the data: evaluate, collision, proposing, metaheuristics, indicators,
polishing, timing, robust, recommending, job, bundles, store; work and campaign carry out whole
studies; display is how objects look in a notebook.

Names are imported when they are first used, so that `import hybrid_opt` takes no time.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hybrid_opt.shown import shown_by

if TYPE_CHECKING:
    __version__: str
    from hybrid_opt.branches import search_branches
    from hybrid_opt.bundles.bundle import Origin, export
    from hybrid_opt.bundles.job_file import BundleOptions
    from hybrid_opt.carry import Carry
    from hybrid_opt.catalogue import algorithms, example, load, objectives, targets
    from hybrid_opt.cell import Cell
    from hybrid_opt.door import polish, save, search, time_every_way, time_path, time_with_jerk
    from hybrid_opt.evaluate.objectives import Objective
    from hybrid_opt.front import Front
    from hybrid_opt.gripping import Grip, propose_grip
    from hybrid_opt.job.plan import plan_job
    from hybrid_opt.job.records import Job
    from hybrid_opt.metaheuristics.run import SearchSettings
    from hybrid_opt.metaheuristics.settings import GeneticSettings, MopsoSettings
    from hybrid_opt.polishing.settings import PolishSettings
    from hybrid_opt.proposing.proposal import Proposal, ProposeSettings, propose
    from hybrid_opt.recommending.choice import Wish
    from hybrid_opt.recommending.recommendation import Recommendation, recommend
    from hybrid_opt.robust.squeeze import SqueezeSettings
    from hybrid_opt.sensitivity import Sensitivities, sensitivities
    from hybrid_opt.sweeping import Sweep, sweep
    from hybrid_opt.timing.records import JerkLimits, JerkTiming, Timing, TimingLimits
    from hybrid_opt.workbench.browser import live
    from symbolic.errors import DualArmError
    from symbolic.records import Workcell

__all__ = [
    "BundleOptions",
    "Carry",
    "Cell",
    "DualArmError",
    "Front",
    "GeneticSettings",
    "Grip",
    "JerkLimits",
    "JerkTiming",
    "Job",
    "MopsoSettings",
    "Objective",
    "Origin",
    "PolishSettings",
    "Proposal",
    "ProposeSettings",
    "Recommendation",
    "SearchSettings",
    "Sensitivities",
    "SqueezeSettings",
    "Sweep",
    "Timing",
    "TimingLimits",
    "Wish",
    "Workcell",
    "algorithms",
    "example",
    "export",
    "live",
    "load",
    "objectives",
    "plan_job",
    "polish",
    "propose",
    "propose_grip",
    "recommend",
    "save",
    "search",
    "search_branches",
    "sensitivities",
    "sweep",
    "targets",
    "time_every_way",
    "time_path",
    "time_with_jerk",
]

_HOMES = {
    "BundleOptions": "hybrid_opt.bundles.job_file",
    "Carry": "hybrid_opt.carry",
    "Cell": "hybrid_opt.cell",
    "DualArmError": "symbolic.errors",
    "Front": "hybrid_opt.front",
    "GeneticSettings": "hybrid_opt.metaheuristics.settings",
    "Grip": "hybrid_opt.gripping",
    "JerkLimits": "hybrid_opt.timing.records",
    "JerkTiming": "hybrid_opt.timing.records",
    "Job": "hybrid_opt.job.records",
    "MopsoSettings": "hybrid_opt.metaheuristics.settings",
    "Objective": "hybrid_opt.evaluate.objectives",
    "Origin": "hybrid_opt.bundles.bundle",
    "PolishSettings": "hybrid_opt.polishing.settings",
    "Proposal": "hybrid_opt.proposing.proposal",
    "ProposeSettings": "hybrid_opt.proposing.proposal",
    "Recommendation": "hybrid_opt.recommending.recommendation",
    "SearchSettings": "hybrid_opt.metaheuristics.run",
    "Sensitivities": "hybrid_opt.sensitivity",
    "SqueezeSettings": "hybrid_opt.robust.squeeze",
    "Sweep": "hybrid_opt.sweeping",
    "Timing": "hybrid_opt.timing.records",
    "TimingLimits": "hybrid_opt.timing.records",
    "Wish": "hybrid_opt.recommending.choice",
    "Workcell": "symbolic.records",
    "algorithms": "hybrid_opt.catalogue",
    "example": "hybrid_opt.catalogue",
    "export": "hybrid_opt.bundles.bundle",
    "live": "hybrid_opt.workbench.browser",
    "load": "hybrid_opt.catalogue",
    "objectives": "hybrid_opt.catalogue",
    "plan_job": "hybrid_opt.job.plan",
    "polish": "hybrid_opt.door",
    "propose": "hybrid_opt.proposing.proposal",
    "propose_grip": "hybrid_opt.gripping",
    "recommend": "hybrid_opt.recommending.recommendation",
    "save": "hybrid_opt.door",
    "search": "hybrid_opt.door",
    "search_branches": "hybrid_opt.branches",
    "sensitivities": "hybrid_opt.sensitivity",
    "sweep": "hybrid_opt.sweeping",
    "targets": "hybrid_opt.catalogue",
    "time_every_way": "hybrid_opt.door",
    "time_path": "hybrid_opt.door",
    "time_with_jerk": "hybrid_opt.door",
}


shown_by(lambda room: import_module(f"hybrid_opt.display.{room}"))


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("hybrid_opt.version").own_version()
    if name not in _HOMES:
        raise AttributeError(f"module 'hybrid_opt' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
