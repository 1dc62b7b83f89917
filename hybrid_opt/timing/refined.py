"""A timing of a path, recomputed between its grid points from the exact model."""

from __future__ import annotations

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.timing.model import REFINEMENT, TimingModel
from hybrid_opt.timing.path_check import path_failure
from hybrid_opt.timing.path_motion import PathMotion
from hybrid_opt.timing.records import Timing, TimingLimits, TimingStatus
from hybrid_opt.timing.use import RECOMPUTED_TOLERANCE, limit_use, worst
from symbolic.array import Array
from symbolic.errors import SettingsError


def refined_carry(model: TimingModel, motion: PathMotion, grid_speed: Array) -> Carry:
    """The carry at `REFINEMENT` samples per interval, both ends of every interval included.

    Args:
        motion: the path's geometry.
        grid_speed: (intervals + 1,) path speed u' at the grid points, u'' constant between [1/s].
    """
    squared = grid_speed**2
    share = np.linspace(0.0, 1.0, REFINEMENT + 1)
    w = squared[:-1, None] + np.outer(np.diff(squared), share)
    speed = np.sqrt(np.maximum(w, 0.0))
    # Average speed over a piece of constant acceleration is that of its ends.
    total = speed[:, :1] + speed
    elapsed = 2.0 * share / model.intervals / np.where(total > 0.0, total, 1.0)
    starts = np.concatenate([[0.0], np.cumsum(elapsed[:, -1])])[:-1]
    a = np.repeat(np.diff(squared) * model.intervals / 2.0, REFINEMENT + 1)
    index = REFINEMENT * np.arange(model.intervals)[:, None] + np.arange(REFINEMENT + 1)
    return model.carry(
        motion.at(index.reshape(-1)), (starts[:, None] + elapsed).reshape(-1), speed.reshape(-1), a
    )


def drive_path(
    model: TimingModel,
    x: Array,
    grid_speed: Array,
    limits: TimingLimits,
    motion: PathMotion | None = None,
) -> Timing:
    """A given timing of a path with its carry, held against every limit.

    Args:
        model: its intervals are those of the timing.
        x: (n_var,) decision vector.
        grid_speed: (intervals + 1,) path speed u' at the grid points [1/s].
        motion: the path's geometry, where it is known already.

    Returns:
        Status `OK`, or `EXCEEDED` with the limit and the place; or why the path itself fails.

    Raises:
        SettingsError: x or the speeds do not fit.
    """
    grid_speed = np.asarray(grid_speed, dtype=float)
    moves = np.all(grid_speed[:-1] + grid_speed[1:] > 0.0) if grid_speed.ndim == 1 else False
    if grid_speed.shape != (model.intervals + 1,) or not moves:
        raise SettingsError(
            f"path speeds of shape {grid_speed.shape}; needs {model.intervals + 1} that never "
            "stand still over an interval"
        )
    motion = model.path_motion(x) if motion is None else motion
    failure = path_failure(model, motion)
    if failure is not None:
        return failure
    carry = refined_carry(model, motion, grid_speed)
    use = limit_use(carry, model.workcell, limits, model.joint_names)
    excess = worst(use)
    status, reason = TimingStatus.OK, f"{carry.duration:.3f} s; most used: {excess.place}"
    if excess.ratio > 1.0 + RECOMPUTED_TOLERANCE:
        status = TimingStatus.EXCEEDED
        reason = f"uses {100.0 * excess.ratio:.1f} % of the limit: {excess.place}"
    return Timing(status, reason, excess.place, carry, use, grid_speed, limits=limits)
