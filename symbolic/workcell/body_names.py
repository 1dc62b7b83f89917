"""The names by which a workcell's bodies are addressed, and patterns that stand for several."""

from __future__ import annotations

import re
from collections.abc import Iterable

from symbolic.robot.urdf import robot_urdf
from symbolic.workcell.records import Workcell

PAYLOAD_BODY = "payload"


def body_names(workcell: Workcell) -> dict[str, tuple[str, ...]]:
    """The names by which collision pairs are addressed, per owner.

    The payload is `payload`, an environment body has its own name, a link or tool body of a
    robot is `ROBOT/NAME`. The keys are `payload`, `environment` and the robots' names.
    """
    names = {
        PAYLOAD_BODY: (PAYLOAD_BODY,),
        "environment": tuple(body.name for body in workcell.environment),
    }
    for robot in workcell.robots:
        links = robot_urdf(robot).collision_links
        tools = tuple(body.name for body in robot.tool)
        names[robot.name] = tuple(f"{robot.name}/{name}" for name in (*links, *tools))
    return names


def matching(pattern: str, names: Iterable[str]) -> tuple[str, ...]:
    """The names that a pattern stands for: `*` is any text, `?` any character.

    A name that is written out stands for itself, also where it holds such a character.
    """
    names = tuple(names)
    if pattern in names:
        return (pattern,)
    words = {"*": ".*", "?": "."}
    form = re.compile("".join(words.get(letter, re.escape(letter)) for letter in pattern))
    return tuple(name for name in names if form.fullmatch(name))
