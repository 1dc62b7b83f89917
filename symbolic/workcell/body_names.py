"""The names by which a workcell's bodies are addressed."""

from __future__ import annotations

from symbolic.robot.machine import arm_links
from symbolic.robot.urdf import robot_urdf
from symbolic.workcell.records import Workcell

PAYLOAD_BODY = "payload"


def body_names(workcell: Workcell) -> dict[str, tuple[str, ...]]:
    """The names by which collision pairs are addressed, per owner.

    The payload is `payload`, an environment body has its own name, a link or tool body of a
    robot is `ROBOT/NAME`; what stands still of a machine with both arms bears the name of the
    first. The keys are `payload`, `environment` and the robots' names.
    """
    names = {
        PAYLOAD_BODY: (PAYLOAD_BODY,),
        "environment": tuple(body.name for body in workcell.environment),
    }
    for i, robot in enumerate(workcell.robots):
        owned = arm_links(workcell.robots, i)
        links = tuple(
            x for x in robot_urdf(robot).collision_links if x in owned.moved + owned.still
        )
        tools = tuple(body.name for body in robot.tool)
        names[robot.name] = tuple(f"{robot.name}/{name}" for name in (*links, *tools))
    return names
