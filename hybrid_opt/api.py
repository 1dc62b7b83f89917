"""Operations on one carry of a cell: time its path, compare timings, store it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hybrid_opt.carry import Carry, decision_of
from hybrid_opt.cell import Cell
from hybrid_opt.progress import ShowProgress
from hybrid_opt.store.trajectory_file import write_trajectory
from hybrid_opt.timing.analysis import TimedTrajectory, time_trajectory
from hybrid_opt.timing.jerk import time_with_jerk as solve_with_jerk
from hybrid_opt.timing.records import JerkLimits, JerkTiming, Timing, TimingLimits
from hybrid_opt.timing.solve import time_path as solve_timing
from symbolic.array import Array
from symbolic.errors import SettingsError


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
    """Compute several timings of one path, to compare them.

    They are the timing of the search, the fastest one within the task's reference speeds, the
    fastest one, and those that the arguments ask for
    (`hybrid_opt.timing.analysis.time_trajectory`). For the timing within the reference speeds the
    result also has margins: the largest errors of the workcell's description that it tolerates.

    Args:
        cell: the cell of the carry.
        carry: a carry with the path to time, or its decision vector (n_var,).
        force_limit: largest normal force [N] of an additional force-limited timing, None for no
            such timing.
        curve_points: number of points on the curve of duration against force limit, None for no
            curve.
        progress: True for a progress bar, or a function that is called with the number of timings
            done and their total. The computation of the margins counts as one more timing.
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
