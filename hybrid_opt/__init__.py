"""Library for the planning of dual-arm carries. `import hybrid_opt as ho` and work with a `Cell`;
docs/reference/library.md shows how.

`search` and `polish` return a `Front` of a cell, and an entry of a front is a `Carry`. `time_path`
computes a `Timing` of a carry's path. `recommend` says which carry to run, `plan_job` plans the
whole job around it, and `export` writes the job for robots. `propose` writes the workcell file of a
cell that has no carry yet.

Subpackages, in the order in which data pass them: evaluate, collision, proposing, metaheuristics,
indicators, polishing, timing, robust, recommending, job, bundles, store. work and campaign carry
out whole studies; display formats objects for terminals and notebooks.

Names are imported when they are first used, so that `import hybrid_opt` takes no time.
"""

from __future__ import annotations

import ast
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from hybrid_opt.api import compare_timings as compare_timings
    from hybrid_opt.api import save as save
    from hybrid_opt.api import time_path as time_path
    from hybrid_opt.api import time_with_jerk as time_with_jerk
    from hybrid_opt.branches import search_branches as search_branches
    from hybrid_opt.campaign.results import load as load
    from hybrid_opt.carry import Carry as Carry
    from hybrid_opt.cell import Cell as Cell
    from hybrid_opt.cell import example as example
    from hybrid_opt.errors import JobError as JobError
    from hybrid_opt.errors import ProposalError as ProposalError
    from hybrid_opt.errors import ResultsError as ResultsError
    from hybrid_opt.evaluate.objectives import Objective as Objective
    from hybrid_opt.evaluate.objectives import objectives as objectives
    from hybrid_opt.extras.bundles.bundle import Origin as Origin
    from hybrid_opt.extras.bundles.bundle import export as export
    from hybrid_opt.extras.bundles.job_file import BundleOptions as BundleOptions
    from hybrid_opt.extras.bundles.targets import targets as targets
    from hybrid_opt.extras.gripping import Grip as Grip
    from hybrid_opt.extras.gripping import propose_grip as propose_grip
    from hybrid_opt.extras.proposing.proposal import Proposal as Proposal
    from hybrid_opt.extras.proposing.proposal import ProposeSettings as ProposeSettings
    from hybrid_opt.extras.proposing.proposal import propose as propose
    from hybrid_opt.extras.proposing.proposal import propose_classes as propose_classes
    from hybrid_opt.extras.proposing.reach import plan_reach as plan_reach
    from hybrid_opt.extras.sweeping import Sweep as Sweep
    from hybrid_opt.extras.sweeping import sweep as sweep
    from hybrid_opt.extras.workbench import live as live
    from hybrid_opt.front import Front as Front
    from hybrid_opt.front import polish as polish
    from hybrid_opt.front import search as search
    from hybrid_opt.job.plan import plan_job as plan_job
    from hybrid_opt.job.records import Job as Job
    from hybrid_opt.metaheuristics.algorithms import GeneticSettings as GeneticSettings
    from hybrid_opt.metaheuristics.mopso import MopsoSettings as MopsoSettings
    from hybrid_opt.metaheuristics.run import SearchSettings as SearchSettings
    from hybrid_opt.metaheuristics.run import algorithms as algorithms
    from hybrid_opt.polishing.settings import PolishSettings as PolishSettings
    from hybrid_opt.recommending.choice import Wish as Wish
    from hybrid_opt.recommending.recommendation import Recommendation as Recommendation
    from hybrid_opt.recommending.recommendation import recommend as recommend
    from hybrid_opt.robust.budget import GripBudget as GripBudget
    from hybrid_opt.robust.budget import grip_budget as grip_budget
    from hybrid_opt.robust.squeeze import SqueezeSettings as SqueezeSettings
    from hybrid_opt.sensitivity import Sensitivities as Sensitivities
    from hybrid_opt.sensitivity import sensitivities as sensitivities
    from hybrid_opt.timing.records import JerkLimits as JerkLimits
    from hybrid_opt.timing.records import JerkTiming as JerkTiming
    from hybrid_opt.timing.records import Timing as Timing
    from hybrid_opt.timing.records import TimingLimits as TimingLimits
    from symbolic.errors import DualArmError as DualArmError
    from symbolic.errors import SettingsError as SettingsError
    from symbolic.errors import WorkcellError as WorkcellError
    from symbolic.records import Uncertainty as Uncertainty
    from symbolic.records import Workcell as Workcell


def _require_own(package: str, member: str) -> None:
    """Check that an imported package is part of this project, and not of another one with the same
    name.

    Args:
        package: name of the package.
        member: name of a module that the package of this project contains.

    Raises:
        ImportError: the package has no such member, so it belongs to another project.
    """
    try:
        found = find_spec(f"{package}.{member}")
    except ModuleNotFoundError:
        found = None
    if found is None:
        spec = find_spec(package)
        where = "missing" if spec is None else f"another project's, in {spec.origin}"
        raise ImportError(
            f"dual-arm-carry needs its own package '{package}', but the one that is found is "
            f"{where}; install dual-arm-carry into a virtual environment of its own"
        )


_require_own("symbolic", "safe_io")
_require_own("codegen", "native")

_HOMES = {
    each.name: node.module
    for node in ast.walk(ast.parse(Path(__file__).read_bytes()))
    if isinstance(node, ast.ImportFrom) and node.module
    for each in node.names
    if each.asname
}
"""Name of the module that defines each public name, read from the imports above, which only type
checkers execute."""

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("hybrid_opt.store.files").own_version()
    if name not in _HOMES:
        raise AttributeError(f"module 'hybrid_opt' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
