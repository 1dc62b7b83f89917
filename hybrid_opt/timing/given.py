"""A given path and a given timing of it: what forbids any timing, and the timing recomputed between
its grid points from the exact model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.carry import Carry
from hybrid_opt.timing.limits import RECOMPUTED_TOLERANCE, limit_use, worst
from hybrid_opt.timing.model import REFINEMENT, PathMotion, TimingModel
from hybrid_opt.timing.records import Place, Timing, TimingLimits, TimingStatus
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell

LEAST_LENGTH = 1e-9
"""A path along which box and joints move less than this does not move [m, rad]."""


@dataclass(frozen=True)
class ArmCheck:
    """One way in which an arm can fail a path.

    Attributes:
        status: what it makes of the timing.
        failed: (n, 2) by sample and arm.
        constraint: its name in a `Place`.
        text: what the robot does, for people.
    """

    status: TimingStatus
    failed: NDArray[np.bool_]
    constraint: str
    text: str


def arm_checks(
    workcell: Workcell, lost: Array, limit_margin: Array, manipulability: Array
) -> tuple[ArmCheck, ...]:
    """The checks in the order in which they are told; inputs (n, 2) by sample and arm."""
    least = [robot.min_manipulability for robot in workcell.robots]
    return (
        ArmCheck(TimingStatus.OFF_PATH, lost > 0.5, "reach", "loses the path"),
        ArmCheck(
            TimingStatus.JOINT_LIMITS,
            limit_margin < 0.0,
            "joint position",
            "leaves its joint range",
        ),
        ArmCheck(
            TimingStatus.NEAR_SINGULAR,
            manipulability < least,
            "manipulability",
            "comes too near a singular posture",
        ),
    )


def path_failure(model: TimingModel, motion: PathMotion) -> Timing | None:
    """Why a path cannot be timed, with arm and place, or None."""
    if float(np.abs(motion.pose - motion.pose[0]).max()) < LEAST_LENGTH:
        place = Place("path length", "", "", 0, 0.0)
        return Timing(
            TimingStatus.NO_MOTION,
            "all poses of the path are the same: there is nothing to time",
            place,
            None,
        )
    workcell = model.workcell
    checks = arm_checks(workcell, motion.lost, motion.limit_margin, motion.manipulability)
    for check in checks:
        if check.failed.any():
            sample = int(np.argmax(check.failed.any(axis=1)))
            robot = workcell.robots[int(np.argmax(check.failed[sample]))].name
            parameter = float(motion.parameter[sample])
            return Timing(
                check.status,
                f"robot {robot!r} {check.text} at u = {parameter:.4f}",
                Place(check.constraint, robot, "", sample, parameter),
                None,
            )
    return None


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
