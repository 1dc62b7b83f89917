"""Operations on a cell: search, polish, time, store, and rank its homotopy classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.carry import Carry, decision_of
from hybrid_opt.cell import Cell
from hybrid_opt.front import Front
from hybrid_opt.metaheuristics.run import SearchSettings, make, search_carries
from hybrid_opt.polishing.settings import PolishSettings, default_settings
from hybrid_opt.progress import ShowProgress, as_callback, progress_bar
from hybrid_opt.store.trajectory_file import write_trajectory
from hybrid_opt.timing.analysis import TimedTrajectory, time_trajectory
from hybrid_opt.timing.jerk import time_with_jerk as solve_with_jerk
from hybrid_opt.timing.records import JerkLimits, JerkTiming, Timing, TimingLimits
from hybrid_opt.timing.solve import time_path as solve_timing
from symbolic.array import Array
from symbolic.errors import SettingsError


def search(
    cell: Cell,
    algorithm: str = "nsga2",
    *,
    evaluations: int = 1000,
    rng: np.random.Generator,
    settings: SearchSettings | None = None,
    progress: ShowProgress = False,
) -> Front:
    """Search for the carries of least objectives.

    Args:
        algorithm: one of `algorithms()`.
        evaluations: candidates that may be evaluated.
        rng: the search's only randomness; the same state gives the same front to the bit.
        settings: see there; None for the defaults. Where it names no initial candidates, the
            hand-made trajectory is in the first generation of all but the random search.
        progress: True for a bar, or a function of candidates done and in all.

    Raises:
        SettingsError: an unknown algorithm or a value that is not allowed.
        WorkcellError: the payload cannot be held still, so that there is nothing to search for.
    """
    settings = settings or SearchSettings()
    make(algorithm, settings.algorithm)  # refuses mistakes before anything is compiled
    evaluator = cell.holding_evaluator
    if settings.initial is None and algorithm != "random":
        settings = replace(settings, initial=cell.initial[None])
    with progress_bar(progress, algorithm, evaluations) as advance:
        found, _ = search_carries(
            evaluator, algorithm, evaluations, rng, settings, advance, cell.workcell.task
        )
    return Front.of_search(cell, algorithm, found)


def polish(
    front: Front,
    *,
    rng: np.random.Generator,
    settings: PolishSettings | None = None,
    paths: Sequence[Carry | Array] = (),
    progress: ShowProgress = False,
) -> Front:
    """Improve a front: both peak forces with an interior-point method, or, in drivable cells,
    path and speed profile together.

    Args:
        rng: spreads the starts of some attempts.
        settings: see `hybrid_opt.polishing.settings`; None for the usual ones of the time law.
        paths: carries of the cell whose paths are known to be good, or their decision vectors,
            with or without a force limit; in drivable cells only. The front is nowhere
            behind them. The hand-made path always takes part.
        progress: True for a bar, or a function of attempts done and those expected in all: what is
            left to do shows on the way, and both are equal in the end.

    Raises:
        SettingsError: the cell's objectives are not those of the polish, or a path does not fit.
    """
    cell, task = front.cell, front.cell.workcell.task
    settings = settings or default_settings(task.law.is_drivable)
    polisher = cell.polisher(settings)
    known = [np.asarray(decision_of(path), dtype=float) for path in paths]
    if known and not task.law.is_drivable:
        raise SettingsError(
            f"known paths take part in polishes of drivable carries only; this one has "
            f"{task.law.title}: polish the front of Cell.drivable()"
        )
    for path in known:
        if path.shape not in ((task.n_path,), (task.n_var,)) or not np.isfinite(path).all():
            raise SettingsError(
                f"a known path of shape {path.shape}; needs {task.n_path} finite numbers, or "
                f"{task.n_var} with a force limit"
            )
    beside = np.array([path[: task.n_path] for path in known]).reshape(-1, task.n_path)
    with progress_bar(progress, "polish", settings.attempts) as advance:
        done = polisher.polish(front.x, rng, paths=beside, on_progress=as_callback(advance))
    return front.after(done)


def time_path(cell: Cell, carry: Carry | Array, limits: TimingLimits | None = None) -> Timing:
    """Compute the fastest timing from rest to rest that robots can drive.

    Args:
        carry: the carry whose path is timed, or its decision vector (n_var,).
        limits: beyond the cell's own speeds and accelerations, which always hold; None for the
            joint torques and the contact patches.

    Raises:
        SettingsError: the carry does not fit the cell.
    """
    return solve_timing(cell.timing_model, decision_of(carry), limits)


def time_with_jerk(
    cell: Cell,
    carry: Carry | Array,
    limits: TimingLimits | None = None,
    jerk: JerkLimits | None = None,
) -> JerkTiming:
    """Compute a fast timing within limits on jerk as well, at rest without acceleration at both
    ends.

    Args:
        carry, limits: as for `time_path`.
        jerk: largest jerks; None for those that the workcell states.

    Raises:
        SettingsError: the carry does not fit the cell, or no jerk is limited.
    """
    jerk = jerk or JerkLimits.from_workcell(cell.workcell)
    if jerk is None:
        raise SettingsError(
            "the workcell limits no jerk: give ho.JerkLimits, or state jerk_max of its robots"
        )
    return solve_with_jerk(cell.timing_model, decision_of(carry), limits or TimingLimits(), jerk)


def compare_timings(
    cell: Cell,
    carry: Carry | Array,
    *,
    force_limit: float | None = None,
    curve_points: int | None = None,
    progress: ShowProgress = False,
) -> TimedTrajectory:
    """Compare the search's timing and the drivable ones of a carry, with margins.

    Args:
        force_limit: normal force [N] of a force-limited timing, None for no such timing.
        curve_points: points of the curve of duration against force limit, None for no curve.
        progress: True for a bar, or a function of timings done and in all, the margins as one.
    """
    return time_trajectory(
        cell.timing_model, decision_of(carry), force_limit, curve_points, progress=progress
    )


def save(carry: Carry, path: str | Path, provenance: Mapping[str, Any] | None = None) -> None:
    """Store a carry of `Cell.carry` with its whole cell in one file; see docs/reference/bundles.md.

    Args:
        path: the file, replaced if it exists.
        provenance: origin of the carry as JSON values.

    Raises:
        ResultsError: the workcell was changed after reading, or the file cannot be written.
    """
    write_trajectory(path, carry.workcell, carry.x, carry.figures, provenance or {})
