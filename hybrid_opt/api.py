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
    """Search for non-dominated carries and return them as a front.

    Args:
        cell: the cell to search.
        algorithm: name of the search algorithm, one of `algorithms()`.
        evaluations: largest number of candidates to evaluate.
        rng: random generator; the same state gives exactly the same front.
        settings: settings of the search, None for the defaults. Without initial candidates in
            the settings, the first generation contains the cell's hand-made trajectory, except
            in the random search.
        progress: True for a progress bar, or a function that is called with the number of
            candidates evaluated and their total.

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
    """Improve the carries of a front by nonlinear programming and return the polished front.

    The polish lowers both peak normal forces. In drivable cells it lowers duration and force
    instead, by optimising path and speed profile together.

    Args:
        front: the front to improve.
        rng: random generator that perturbs the starts of some attempts.
        settings: settings of the polish, None for the defaults of the cell's time law.
        paths: further good carries of the same cell from which attempts start, or their decision
            vectors (n_var,), or (n_path,) without the force limit; only for drivable cells. No
            given path dominates a point of the result. The hand-made path is always a start.
        progress: True for a progress bar, or a function that is called with the number of attempts
            done and the number expected in all; the second number may change.

    Raises:
        SettingsError: the polish does not support the cell's objectives, or a path does not fit.
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
    """Compute the fastest timing of a path from rest to rest within the limits of the robots.

    Args:
        cell: the cell of the carry.
        carry: a carry with the path to time, or its decision vector (n_var,).
        limits: additional limits; None limits the joint torques and the pressure shifts on the
            contact patches. The cell's limits on speed and acceleration always apply.

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
    """Compute a fast timing of a path within limits on jerk.

    Speed and acceleration are zero at both ends.

    Args:
        cell: the cell of the carry.
        carry: a carry with the path to time, or its decision vector (n_var,).
        limits: limits besides jerk, as for `time_path`; None for the defaults.
        jerk: limits on jerk, None for the limits in the workcell file.

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
    """Compare the timing of the search with drivable timings of the same path, with margins.

    Args:
        cell: the cell of the carry.
        carry: a carry with the path to time, or its decision vector (n_var,).
        force_limit: largest normal force [N] of an additional force-limited timing, None for no
            such timing.
        curve_points: number of points on the curve of duration against force limit, None for no
            curve.
        progress: True for a progress bar, or a function that is called with the number of
            timings done and their total; all margins together count as one timing.
    """
    return time_trajectory(
        cell.timing_model, decision_of(carry), force_limit, curve_points, progress=progress
    )


def save(carry: Carry, path: str | Path, provenance: Mapping[str, Any] | None = None) -> None:
    """Store a carry and its whole cell in one trajectory file (docs/reference/bundles.md).

    Args:
        carry: the carry to store, from `Cell.carry`.
        path: path of the file; an existing file is replaced.
        provenance: origin of the carry as JSON values by name (algorithm, seed, ...); None for
            none.

    Raises:
        ResultsError: the workcell was changed after reading, or the file cannot be written.
    """
    write_trajectory(path, carry.workcell, carry.x, carry.figures, provenance or {})
