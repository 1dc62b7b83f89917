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


ARM_CHECKS = (
    (TimingStatus.OFF_PATH, "reach", "loses the path"),
    (TimingStatus.JOINT_LIMITS, "joint position", "leaves its joint range"),
    (TimingStatus.NEAR_SINGULAR, "manipulability", "comes too near a singular posture"),
)
"""How an arm can fail a path, in the order of reporting: the timing's status, its name in a
`Place`, and what the robot does, for people."""


@dataclass(frozen=True)
class PathFailure:
    """Why a path cannot be timed at all; attributes as of `Timing`."""

    status: TimingStatus
    place: Place
    reason: str


def path_failure(
    workcell: Workcell, pose: Array, lost: Array, limit_margin: Array, manipulability: Array
) -> PathFailure | None:
    """Why a path cannot be timed, with arm and place, or None.

    Args:
        pose: (n, 6) box poses at uniform samples.
        lost, limit_margin, manipulability: (n, 2) by sample and arm, as of
            `symbolic.robot.arm.TRACK_OUTPUTS`.
    """
    if float(np.abs(pose - pose[0]).max()) < LEAST_LENGTH:
        reason = "all poses of the path are the same: there is nothing to time"
        return PathFailure(TimingStatus.NO_MOTION, Place("path length", "", "", 0, 0.0), reason)
    least = [robot.min_manipulability for robot in workcell.robots]
    found = (lost > 0.5, limit_margin < 0.0, manipulability < least)
    for failed, (status, constraint, text) in zip(found, ARM_CHECKS, strict=True):
        if failed.any():
            sample = int(np.argmax(failed.any(axis=1)))
            robot = workcell.robots[int(np.argmax(failed[sample]))].name
            place = Place(constraint, robot, "", sample, sample / (len(pose) - 1))
            reason = f"robot {robot!r} {text} at u = {place.parameter:.4f}"
            return PathFailure(status, place, reason)
    return None


def untimed(model: TimingModel, motion: PathMotion) -> Timing | None:
    """The answer for a path that cannot be timed, None for others."""
    arms = motion.lost, motion.limit_margin, motion.manipulability
    found = path_failure(model.workcell, motion.pose, *arms)
    return None if found is None else Timing(found.status, found.reason, found.place, None)


@dataclass(frozen=True)
class DrivenSpeeds:
    """Path speeds with constant u'' on intervals, at `REFINEMENT` samples per interval, both ends
    of every interval included; to be driven along any path.

    Attributes:
        index: (n,) of the samples among those of a path's motion.
        time: (n,) [s].
        share: (n,) how far the samples lie within their intervals.
        a, w: (n,) u'' and u'^2.
    """

    index: NDArray[np.intp]
    time: Array
    share: Array
    a: Array
    w: Array

    @classmethod
    def of(cls, grid_speed: Array) -> DrivenSpeeds:
        """grid_speed: (intervals + 1,) path speed u' at the grid points [1/s]."""
        squared, intervals = grid_speed**2, len(grid_speed) - 1
        share = np.linspace(0.0, 1.0, REFINEMENT + 1)
        w = squared[:-1, None] + np.outer(np.diff(squared), share)
        speed = np.sqrt(np.maximum(w, 0.0))
        # Average speed over a piece of constant acceleration is that of its ends.
        total = speed[:, :1] + speed
        elapsed = 2.0 * share / intervals / np.where(total > 0.0, total, 1.0)
        starts = np.concatenate([[0.0], np.cumsum(elapsed[:, -1])])[:-1]
        index = REFINEMENT * np.arange(intervals)[:, None] + np.arange(REFINEMENT + 1)
        return cls(
            index.reshape(-1),
            (starts[:, None] + elapsed).reshape(-1),
            np.tile(share, intervals),
            np.repeat(np.diff(squared) * intervals / 2.0, REFINEMENT + 1),
            w.reshape(-1),
        )

    def carry(
        self, model: TimingModel, motion: PathMotion, a: float = 0.0, w: float = 0.0
    ) -> Carry:
        """A path driven so, with `a` added to u'' and `w` to u'^2 everywhere."""
        speed = np.sqrt(np.maximum(self.w + w, 0.0))
        return model.carry(motion.at(self.index), self.time, speed, self.a + a)


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
    failure = untimed(model, motion)
    if failure is not None:
        return failure
    carry = DrivenSpeeds.of(grid_speed).carry(model, motion)
    use = limit_use(carry, model.workcell, limits, model.joint_names)
    excess = worst(use)
    status, reason = TimingStatus.OK, f"{carry.duration:.3f} s; most used: {excess.place}"
    if excess.ratio > 1.0 + RECOMPUTED_TOLERANCE:
        status = TimingStatus.EXCEEDED
        reason = f"uses {100.0 * excess.ratio:.1f} % of the limit: {excess.place}"
    return Timing(status, reason, excess.place, carry, use, grid_speed, limits=limits)
