"""Reasons why a path has no timing at all: no motion, an arm that cannot follow it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.path_motion import PathMotion
from hybrid_opt.timing.records import Place, Timing, TimingStatus
from symbolic.array import Array
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
