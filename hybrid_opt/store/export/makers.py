"""Whose arms a workcell has, as far as their descriptions tell; languages that fit no other's."""

from __future__ import annotations

import re

from symbolic.errors import SettingsError
from symbolic.robot.urdf import arm_model, robot_urdf, turning_joints
from symbolic.workcell.records import Robot, Workcell

ABB = "ABB"
UR = "UR e-series"

AXES = 6
"""Robot axes of a target."""

_SIGNS = {
    ABB: re.compile(r"(?<![a-z])(abb|irb|crb|gofa|yumi|swifti)(?![a-z])"),
    UR: re.compile(r"(?<![a-z0-9])(ur(3|5|10|16)e|ur(7e|8|12e|15|18|20|30))(?![a-z0-9])"),
}


def require_maker(workcell: Workcell, maker: str, language: str, any_arm: bool) -> None:
    """Refuse a language for arms that do not look like its maker's.

    Args:
        maker: `ABB` or `UR`.
        language: for the message.
        any_arm: whether the user wants it all the same.

    Raises:
        SettingsError: an arm's file, its xacro arguments and its links name another make.
    """
    if any_arm:
        return
    for robot in workcell.robots:
        if not _SIGNS[maker].search(_named(robot)):
            raise SettingsError(
                f"robot {robot.name!r} is described by {robot.urdf.name}, which does not look like "
                f"an arm of {maker}; {language} is theirs: choose another form, or force it "
                "(--any-arm) where zero and signs of its joints are the controller's"
            )


def require_axes(workcell: Workcell, language: str) -> None:
    """Refuse a language whose targets hold six robot axes for arms with other joints.

    Raises:
        SettingsError: an arm has more joints, or one that slides.
    """
    for robot in workcell.robots:
        turning = turning_joints(arm_model(robot))
        if len(turning) != AXES or not all(turning):
            raise SettingsError(
                f"robot {robot.name!r} has {len(turning)} joints; targets of {language} hold "
                f"{AXES} turning axes, choose another form"
            )


def _named(robot: Robot) -> str:
    """What a description says of its make, in small letters, words apart."""
    words = [robot.urdf.name, *robot_urdf(robot).links]
    words += [value for _, value in robot.xacro_arguments]
    return " ".join(words).lower().replace("_", " ")
