"""All that a study of a cell compiles, built at once on all cores, before any of it is needed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from importlib.metadata import version

from codegen.build import compiler_of
from codegen.cache import Cache
from codegen.compiler import interruptible
from codegen.errors import CodegenError
from hybrid_opt.cell import Cell
from hybrid_opt.progress import Progress
from symbolic.errors import DualArmError

Maker = Callable[[], object]
"""Loads or builds functions."""

_TICK = 1.0
"""Interval at which the elapsed time is shown [s]."""


def build_study(cell: Cell, progress: Progress, polish: bool = True, drivable: bool = True) -> None:
    """Load or build the functions of a study, all compilers side by side.

    What a polish compiles when its solves first ask for it, rows of arms' clearances, is not among
    them. Where all was built before nothing is done; what cannot be built is left to who asks for
    it.

    Args:
        cell: read from a file.
        progress: where to show it.
        polish: whether fronts are polished.
        drivable: whether carries are also searched for as robots drive them.
    """
    cache = cell.compiled.cache or Cache()
    what = (str(cell.force_kind), str(polish), str(drivable), compiler_of(cache).identity)
    sources = cache.code_digest("codegen", "hybrid_opt")
    key = cell.compiled.key("study", *what, version("casadi"), sources)
    if key is None or cache.read_record(key) is not None:
        return
    # Drivable cells have the longest functions.
    cells = [cell.drivable(), cell] if drivable and not _driven(cell) else [cell]
    makers = [make for each in cells for make in _makers(each, polish)]
    failures = build_all(makers, progress)
    if not any(isinstance(failure, CodegenError) for failure in failures):
        cache.write_record(key, {"built": True})


def build_all(makers: Sequence[Maker], progress: Progress) -> list[DualArmError]:
    """Load or build functions side by side; what cannot be built is left to who asks for it.

    Ctrl-C ends all compilers and loses nothing that is compiled; the threads that make expressions
    are not waited for.

    Returns:
        Why some were not built.
    """
    # Each waits for its compilers most of the time; expressions are made by one after the other.
    pool = ThreadPoolExecutor(len(makers))
    try:
        with interruptible(), progress.stage("compiling", len(makers), "sets", delay=_TICK) as told:
            futures = [pool.submit(make) for make in makers]
            left = set(futures)
            while left:
                done, left = wait(left, _TICK, FIRST_COMPLETED)
                told(len(done))
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    failures = [failure for future in futures if (failure := future.exception()) is not None]
    for failure in failures:
        # Callers that need a function report why a cell cannot have it.
        if not isinstance(failure, DualArmError):
            raise failure
    return [failure for failure in failures if isinstance(failure, DualArmError)]


def _driven(cell: Cell) -> bool:
    return cell.workcell.task.time_law == "optimal"


def _makers(cell: Cell, polish: bool) -> Iterator[Maker]:
    # Not imported at the top: who builds a few functions needs none of it.
    from hybrid_opt.job.plan import JobCollisions
    from hybrid_opt.polishing.drive import is_polishable
    from hybrid_opt.polishing.rows import row_library
    from hybrid_opt.polishing.solvers.dense import dense_method
    from hybrid_opt.polishing.solvers.quadratic import quadratic_method
    from hybrid_opt.robust.force import at_rest, pressing_model, robust_model
    from hybrid_opt.timing.model import TimingModel
    from hybrid_opt.timing.path_timer import PATH_INTERVALS

    compiled, workcell, cache = cell.compiled, cell.workcell, cell.compiled.cache
    known = workcell.has_facing_pads
    if _driven(cell):
        known = is_polishable(workcell, cell.force_kind.robust)
    polished = polish and known
    yield lambda: cell.evaluator
    if polished:
        yield lambda: cell.polish_functions
    if _driven(cell):
        yield lambda: cell.path_timer
        yield lambda: TimingModel(compiled, PATH_INTERVALS)
    yield lambda: cell.timing_model
    yield lambda: JobCollisions(compiled)
    yield lambda: robust_model(workcell)
    if _driven(cell):
        yield lambda: pressing_model(workcell).nominal(at_rest())  # built when first asked
    if polished:
        yield lambda: (quadratic_method(cache), dense_method(cache))
        yield lambda: row_library(cache)
