"""What is wrong with a path before any timing: no motion, an arm that cannot follow it."""

from __future__ import annotations

import numpy as np

from hybrid_opt.timing.model import PathMotion, TimingModel
from hybrid_opt.timing.records import Place, Timing, TimingStatus

LEAST_LENGTH = 1e-9
"""A path along which box and joints move less than this does not move [m, rad]."""


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
    checks = (
        (TimingStatus.OFF_PATH, motion.lost > 0.5, "reach", "loses the path"),
        (
            TimingStatus.JOINT_LIMITS,
            motion.limit_margin < 0.0,
            "joint position",
            "leaves its joint range",
        ),
        (
            TimingStatus.NEAR_SINGULAR,
            motion.manipulability < [robot.min_manipulability for robot in model.workcell.robots],
            "manipulability",
            "comes too near a singular posture",
        ),
    )
    for status, failed, name, text in checks:
        if failed.any():
            sample = int(np.argmax(failed.any(axis=1)))
            robot = model.workcell.robots[int(np.argmax(failed[sample]))].name
            parameter = float(motion.parameter[sample])
            return Timing(
                status,
                f"robot {robot!r} {text} at u = {parameter:.4f}",
                Place(name, robot, "", sample, parameter),
                None,
            )
    return None
