"""Wrong entries for the sample workcell file, and how to put them in."""

from __future__ import annotations

import re
from typing import Any

from tests.symbolic.read.samples import RACK

DELETE = object()
ZERO_POSE = [0.0] * 6
LOWER = [0, 0, 2, 0, 0, 0]
UNREASONED = {"first": "payload", "second": "ground"}


NO_MESH = {"name": "m", "kind": "mesh", "path": "no.stl"}


def allowed(departure: float, body: str = "top board") -> dict[str, Any]:
    """A contact that is allowed, of a body of the sample."""
    return {"body": body, "departure": departure}


def ignored(second: str) -> dict[str, Any]:
    """A pair that is ignored: the payload and another body."""
    return {"first": "payload", "second": second, "reason": "r"}


def put(data: Any, path: str, value: Any) -> None:
    """Set, append to ('[+]') or delete the entry at a key path."""
    keys: list[Any] = [
        int(part[1:-1]) if re.fullmatch(r"\[\d+\]", part) else part
        for part in re.findall(r"[^.\[\]]+|\[\d+\]|\[\+\]", path)
    ]
    for key in keys[:-1]:
        data = data[key] if isinstance(data, list) else data.setdefault(key, {})
    if value is DELETE:
        del data[keys[-1]]
    elif keys[-1] == "[+]":
        data.append(value)
    else:
        data[keys[-1]] = value


# (where to put, what, words of the message; the key path that is told, if it is another)
CASES: list[tuple[Any, ...]] = [
    ("payload.mas", 3.0, "unknown key"),
    ("task.refrence_speed", 0.1, "unknown key"),
    ("environment[0].radius", 1.0, "allowed keys are kind, name"),
    ("robots[1].base.yaw", 1.0, "unknown key; allowed keys are rpy, xyz"),
    ("name", DELETE, "is missing"),
    ("payload", DELETE, "is missing"),
    ("task.reference_speed", DELETE, "is missing"),
    ("contacts[1].friction", DELETE, "is missing"),
    # wrong types and counts
    ("payload.mass", "10 kg", "found '10 kg'; allowed is a number"),
    ("payload.mass", True, "found True; allowed is a number"),
    ("payload", 3, "found 3; allowed is a table"),
    ("payload.size", [0.3, 0.4], "allowed is an array of 3 numbers"),
    ("task.start", [0.0, 0.0, 0.7], "allowed is an array of 6 numbers"),
    ("robots", [], "found 0 tables; allowed are exactly 2"),
    ("robots[0].package_dirs", ["."] * 101, "found 101 folders"),
    ("robots[0].urdf", "package://" + "a" * 9000, "in no package that is found"),
    ("contacts[+]", {}, "found 3 tables; allowed are exactly 2", "contacts"),
    ("environment", 3, "allowed is an array of tables, [[environment]]"),
    ("robots[0].locked_joints", 3, "allowed is a table"),
    ("robots[0].package_dirs", "x", "allowed is an array of folders"),
    ("environment[0].kind", "cube", "'box', 'cylinder', 'sphere', 'mesh'"),
    ("environment[0].kind", "boxx", "did you mean 'box'?"),
    ("handling", {"stand_off": 50}, "this looks like mm", "handling.stand_off"),
    ("handling", {"lift_height": -0.1}, "allowed is 0 to 0.5 m", "handling.lift_height"),
    ("uncertainty", {"friction": 10}, "allowed", "uncertainty.friction"),
    ("uncertainty", {"pad_position": 0.04}, "less than 0.0315 m", "uncertainty.pad_position"),
    ("uncertainty", {"tilt": 2}, "this looks like deg", "uncertainty.tilt"),
    ("uncertainty", {"internal": 2.0}, "did you mean 'internal_force'", "uncertainty.internal"),
    ("task.allocation", "conic", "allowed is one of 'paper', 'joint'"),
    ("task.force_limit", [60.0, 50.0], "found 60 above 50"),
    ("task.time_law", "toppra", "allowed is one of 'constant', 'ramped'"),
    ("task.samples", 4, "found 4; allowed is a whole number 5 to"),
    ("task.samples", 50.0, "allowed is a whole number"),
    ("robots[0].start_branch", -2, "allowed is a whole number -1 to"),
    # not finite
    ("payload.mass", float("nan"), "found nan"),
    ("payload.mass", 10**400, "found inf"),
    ("robots[0].base.xyz[1]", float("-inf"), "found -inf"),
    # not positive
    ("payload.size[1]", 0.0, "allowed is 0.001 to 5 m"),
    ("payload.mass", -1.0, "allowed is 0.001 to 500 kg"),
    ("contacts[0].friction", 0, "allowed is 0.001 to 5"),
    ("robots[0].jerk_max", 0, "allowed is 0.1 to 20000 rad/s^3"),
    ("robots[0].driver", 3, "allowed is a table"),
    ("robots[0].driver", {"adress": "a"}, "unknown key", "robots[0].driver.adress"),
    ("robots[0].driver", {"address": 'x";EXIT'}, "an IP address", "robots[0].driver.address"),
    ("robots[0].driver", {"prefix": "1 a"}, "with a letter first", "robots[0].driver.prefix"),
    ("robots[0].driver", {"rate": 1.0}, "allowed is 10 to 8000 Hz", "robots[0].driver.rate"),
    ("robots[0].driver", {"lag": 30}, "looks like ms", "robots[0].driver.lag"),
    ("robots[0].driver", {"force_control": 1}, "true or false", "robots[0].driver.force_control"),
    ("collision.tolerance", -0.001, "allowed is 0 to 0.1 m"),
    ("task.reference_speed", 1e-320, "allowed is 0.001 to 10 m/s"),
    ("task.samples", int("1" * 4000), "a number of 13285 bits"),
    # another unit
    ("payload.size[0]", 300, "looks like mm: 300 mm are 0.3 m"),
    ("payload.mass", 10_000, "looks like g: 10000 g are 10 kg"),
    ("robots[0].base.rpy[2]", -90.0, "-90 deg are -1.5708 rad"),
    ("contacts[0].patch_radius", 31.5, "31.5 mm are 0.0315 m"),
    ("contacts[0].friction", 60, "looks like %"),
    ("task.reference_force", 12, "12 kgf are 117.68 N"),
    ("task.reference_force", [117.7, 12], "looks like kgf", "task.reference_force[1]"),
    ("task.reference_speed", 250, "250 mm/s are 0.25 m/s"),
    ("task.reference_angular_speed", 30, "looks like deg/s"),
    ("payload.jerk_max", 30_000, "30000 mm/s^3 are 30 m/s^3"),
    # inertia
    ("payload.inertia", "hollow", "'solid box' or a 3 x 3 matrix"),
    ("payload.inertia", [[1, 0, 0]], "'solid box' or a 3 x 3 matrix"),
    ("payload.inertia", [[0.1, 0, 0], [0, 0.1], [0, 0, 0.1]], "3 numbers", "payload.inertia[1]"),
    ("payload.inertia", [[0.1, 0.01, 0], [0, 0.1, 0], [0, 0, 0.1]], "not symmetric"),
    ("payload.inertia", [[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0]], "singular"),
    ("payload.inertia", [[0, 0, 0], [0, 0, 0], [0, 0, 0]], "singular"),
    ("payload.inertia", [[-0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], "singular"),
    ("payload.inertia", [[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.3]], "the sum of the other two"),
    ("payload.inertia", [[185, 0, 0], [0, 127, 0], [0, 0, 208]], "inside the box gives"),
    ("payload.centre_of_mass", [0, 0.21, 0], "outside the box", "payload.centre_of_mass[1]"),
    # contacts
    ("contacts[0].xyz", [0, 0.19, 0], "0.01 m inside the box"),
    ("contacts[0].xyz", [0, 0.25, 0], "0.05 m outside the box"),
    ("contacts[0].xyz", [0.15, 0.20, 0], "on an edge of the box"),
    ("contacts[0].xyz", [0.14, 0.20, 0], "only 0.01 m from the edge"),
    ("contacts[1].xyz", [0, 0.20, 0], "a normal 180 degrees off the opposite"),
    ("contacts[1].xyz", [0.15, 0, 0], "a normal 90 degrees off the opposite"),
    # task
    ("task.waypoints[1].lower[0]", -0.40, "found -0.4 for x, above its upper bound -0.42"),
    ("task.waypoints", [], "at least one free waypoint"),
    ("task.waypoints", [{"fixed": ZERO_POSE}], "at least one free waypoint"),
    ("task.waypoints[0].fixed", ZERO_POSE, "found beside 'lower' and"),
    ("task.waypoints[0].count", 0, "whole number 1 to"),
    ("task.waypoints[0].count", 97, "found 101 poses", "task.waypoints"),
    ("task.waypoints[0]", {"lower": ZERO_POSE, "upper": ZERO_POSE}, "is written fixed"),
    ("task.initial", [ZERO_POSE], "found 1 rows; allowed is one per free"),
    ("task.initial[1]", [0.0], "an array of 6 numbers"),
    ("task.initial[1][2]", 1.2, "found 1.2 for z, outside its bounds"),
    ("task.reference_speed", 1.5, "at most payload.velocity_max = 1"),
    (
        "task.allowed_contacts",
        [allowed(0.02, "tpo board")],
        "did you mean 'top board'?",
        "task.allowed_contacts[0].body",
    ),
    ("task.allowed_contacts", [allowed(20)], "looks like mm", "task.allowed_contacts[0].departure"),
    ("task.start[2]", 2.5, "out of reach: the flange of robot 'left'", "task.start"),
    ("robots[1].base.xyz[1]", -3.0, "the flange of robot 'right'", "task.goal"),
    # names
    ("environment[1].name", "ground", "already environment[1].name", "environment[5].name"),
    ("robots[1].name", "left", "found 'left' again"),
    ("environment[0].name", "payload", "reserved"),
    ("environment[0].name", "left", "already robots[0].name"),
    ("environment[0].name", "a\nb", "control character"),
    ("environment[0].name", "a\u202eb", "control character"),
    ("environment[0].name", "", "not empty"),
    ("environment[0].name", " a", "spaces at its ends"),
    ("environment[0].name", "a" * 81, "81 characters"),
    ("environment[0].name", 5, "allowed is a text"),
    ("environment[0].name", "left/link_1", "without '/'"),
    ("robots[0].tool[0].name", "link_3", "already a link of gofa12.urdf"),
    # robots
    ("robots[0].urdf", "nowhere.urdf", "cannot be read (No such file"),
    ("robots[0].urdf", "a\0b", "allowed is the path of a file"),
    ("robots[0].urdf", str(RACK), "not readable XML"),
    ("robots[0].flange", "tool", "did you mean 'tool0'?"),
    ("robots[0].flange", "xyz", "allowed are 'link_6', 'tool0'"),
    ("robots[0].flange", "link_4", "the last joint does not move"),
    ("robots[0].locked_joints.joint_9", 0.0, "no moving joint", "robots[0].locked_joints"),
    ("robots[0].locked_joints.joint_6", 0.0, "found 5 joints", "robots[0].urdf"),
    ("robots[0].package_dirs", ["nowhere"], "allowed is a folder", "robots[0].package_dirs[0]"),
    (
        "robots[0].position_lower",
        LOWER,
        "found 2 rad for joint 'joint_3'",
        "robots[0].position_lower[2]",
    ),
    # other files, collision pairs
    ("environment[0]", NO_MESH, "cannot be read", "environment[0].path"),
    (
        "collision.ignored",
        [ignored("left/link_7")],
        "did you mean 'left/",
        "collision.ignored[0].second",
    ),
    ("collision.ignored", [ignored("payload")], "with itself", "collision.ignored[0]"),
    ("collision.ignored", [UNREASONED], "is missing", "collision.ignored[0].reason"),
]
