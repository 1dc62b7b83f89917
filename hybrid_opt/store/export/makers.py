"""Makers of a workcell's arms, as far as descriptions tell; languages that fit no other maker's."""

from __future__ import annotations

import re
from collections.abc import Sequence

from symbolic.errors import SettingsError
from symbolic.read.arms import arm_model, robot_urdf, turning_joints
from symbolic.records import Robot, Workcell

ABB = "ABB"
UR = "UR e-series"

SIX, SEVEN = 6, 7
"""Axes of an arm that a language's targets can hold."""

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


def require_axes(workcell: Workcell, language: str, allowed: Sequence[int] = (SIX,)) -> None:
    """Refuse a language for arms whose joints its targets cannot hold.

    Args:
        allowed: numbers of turning joints that they can.

    Raises:
        SettingsError: an arm has another number of joints, or one that slides.
    """
    for robot in workcell.robots:
        turning = turning_joints(arm_model(robot))
        if len(turning) not in allowed or not all(turning):
            slide = "" if all(turning) else f", {turning.count(False)} of them sliding"
            raise SettingsError(
                f"robot {robot.name!r} has {len(turning)} joints{slide}; targets of {language} "
                f"hold {' or '.join(map(str, allowed))} turning axes, choose another form"
            )


def _named(robot: Robot) -> str:
    """Words about the make in a description, in small letters."""
    words = [robot.urdf.name, *robot_urdf(robot).links]
    words += [value for _, value in robot.xacro_arguments]
    return " ".join(words).lower().replace("_", " ")
