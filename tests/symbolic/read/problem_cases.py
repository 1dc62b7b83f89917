"""Wrong entries for the sample workcell file, and how to put them in."""

from __future__ import annotations

import re
from typing import Any

from tests.symbolic.read.samples import RACK

DELETE = object()
ZERO_POSE = [0.0] * 6


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


# (where to put, what, key path told, words of the message)
CASES: list[tuple[str, Any, str, str]] = [
    # unknown and missing keys
    ("payload.mas", 3.0, "payload.mas", "unknown key"),
    ("task.refrence_speed", 0.1, "task.refrence_speed", "unknown key"),
    ("pyload", {}, "pyload", "allowed keys are collision, contacts"),
    ("environment[0].radius", 1.0, "environment[0].radius", "allowed keys are kind, name"),
    ("robots[1].base.yaw", 1.0, "robots[1].base.yaw", "unknown key; allowed keys are rpy, xyz"),
    ("robots[0].acceleraton_max", 3.0, "robots[0].acceleraton_max", "unknown key"),
    ("name", DELETE, "name", "is missing"),
    ("payload", DELETE, "payload", "is missing"),
    ("payload.mass", DELETE, "payload.mass", "is missing"),
    ("task.goal", DELETE, "task.goal", "is missing"),
    ("task.reference_speed", DELETE, "task.reference_speed", "is missing"),
    ("robots[0].urdf", DELETE, "robots[0].urdf", "is missing"),
    ("robots[1].pad", DELETE, "robots[1].pad", "is missing"),
    ("contacts[1].friction", DELETE, "contacts[1].friction", "is missing"),
    ("environment[2].size", DELETE, "environment[2].size", "is missing"),
    # wrong types and counts
    ("payload.mass", "10 kg", "payload.mass", "found '10 kg'; allowed is a number"),
    ("payload.mass", True, "payload.mass", "found True; allowed is a number"),
    ("payload", 3, "payload", "found 3; allowed is a table"),
    ("payload.size", [0.3, 0.4], "payload.size", "allowed is an array of 3 numbers"),
    ("payload.size", 0.3, "payload.size", "allowed is an array of 3 numbers"),
    ("task.start", [0.0, 0.0, 0.7], "task.start", "allowed is an array of 6 numbers"),
    ("robots", [], "robots", "found 0 tables; allowed are exactly 2"),
    ("robots[0].package_dirs", ["."] * 101, "robots[0].package_dirs", "found 101 folders"),
    ("robots[0].urdf", "package://" + "a" * 9000, "robots[0].urdf", "in no package that is found"),
    ("contacts[+]", {}, "contacts", "found 3 tables; allowed are exactly 2"),
    ("environment", 3, "environment", "allowed is an array of tables, [[environment]]"),
    ("robots[0].tool", 3, "robots[0].tool", "array of tables, [[robots.tool]]"),
    ("robots[0].locked_joints", 3, "robots[0].locked_joints", "allowed is a table"),
    ("robots[0].package_dirs", "x", "robots[0].package_dirs", "allowed is an array of folders"),
    ("environment[0].kind", "cube", "environment[0].kind", "'box', 'cylinder', 'sphere', 'mesh'"),
    ("environment[0].kind", "boxx", "environment[0].kind", "did you mean 'box'?"),
    ("handling", {"stand_off": 50}, "handling.stand_off", "this looks like mm"),
    ("handling", {"lift_height": -0.1}, "handling.lift_height", "allowed is 0 to 0.5 m"),
    ("handling", {"lift_hight": 0.1}, "handling.lift_hight", "did you mean 'lift_height'"),
    ("uncertainty", {"friction": 10}, "uncertainty.friction", "allowed"),
    ("uncertainty", {"frction": 0.1}, "uncertainty.frction", "did you mean 'friction'"),
    ("uncertainty", {"disturbance": 0.3}, "uncertainty.disturbance", "array of 3 numbers"),
    ("uncertainty", {"pad_position": 0.04}, "uncertainty.pad_position", "less than 0.0315 m"),
    ("uncertainty", {"tilt": 2}, "uncertainty.tilt", "this looks like deg"),
    ("uncertainty", {"internal": 2.0}, "uncertainty.internal", "did you mean 'internal_force'"),
    ("task.allocation", "conic", "task.allocation", "allowed is one of 'paper', 'joint'"),
    ("task.force_limit", [60.0, 50.0], "task.force_limit", "found 60 above 50"),
    ("task.force_limit", 50.0, "task.force_limit", "allowed is an array of 2 numbers"),
    ("task.time_law", "toppra", "task.time_law", "allowed is one of 'constant', 'ramped'"),
    ("task.samples", 4, "task.samples", "found 4; allowed is a whole number 5 to"),
    ("task.samples", 50.0, "task.samples", "allowed is a whole number"),
    ("robots[0].start_branch", -2, "robots[0].start_branch", "allowed is a whole number -1 to"),
    # not finite
    ("payload.mass", float("nan"), "payload.mass", "found nan"),
    ("payload.mass", 10**400, "payload.mass", "found inf"),
    ("task.goal[2]", float("inf"), "task.goal[2]", "found inf"),
    ("robots[0].base.xyz[1]", float("-inf"), "robots[0].base.xyz[1]", "found -inf"),
    # not positive
    ("payload.size[1]", 0.0, "payload.size[1]", "allowed is 0.001 to 5 m"),
    ("payload.mass", -1.0, "payload.mass", "allowed is 0.001 to 500 kg"),
    ("contacts[0].friction", 0, "contacts[0].friction", "allowed is 0.001 to 5"),
    ("contacts[0].patch_radius", 0, "contacts[0].patch_radius", "allowed is 0.0001 to 0.5 m"),
    ("environment[0].size[2]", 0, "environment[0].size[2]", "allowed is 1e-06 to 10 m"),
    ("robots[0].tool[0].length", -0.1, "robots[0].tool[0].length", "allowed is 1e-06 to 10 m"),
    (
        "robots[0].acceleration_max",
        0,
        "robots[0].acceleration_max",
        "allowed is 0.001 to 200 rad/s^2",
    ),
    ("robots[0].jerk_max", 0, "robots[0].jerk_max", "allowed is 0.1 to 20000 rad/s^3"),
    ("robots[0].jerk_max", [50.0] * 5, "robots[0].jerk_max", "an array of 6 numbers"),
    ("payload.jerk_max", -1.0, "payload.jerk_max", "allowed is 0.1 to 10000 m/s^3"),
    ("payload.jerk_max", "none", "payload.jerk_max", "allowed is a number"),
    ("task.reference_speed", 0, "task.reference_speed", "allowed is 0.001 to 10 m/s"),
    ("collision.tolerance", -0.001, "collision.tolerance", "allowed is 0 to 0.1 m"),
    ("task.reference_speed", 1e-320, "task.reference_speed", "allowed is 0.001 to 10 m/s"),
    ("task.samples", int("1" * 4000), "task.samples", "a number of 13285 bits"),
    # another unit
    ("payload.size[0]", 300, "payload.size[0]", "looks like mm: 300 mm are 0.3 m"),
    ("payload.mass", 10_000, "payload.mass", "looks like g: 10000 g are 10 kg"),
    ("robots[0].base.xyz[1]", 1050.0, "robots[0].base.xyz[1]", "looks like mm"),
    ("robots[0].base.rpy[2]", -90.0, "robots[0].base.rpy[2]", "-90 deg are -1.5708 rad"),
    ("robots[0].pad.xyz[2]", 100, "robots[0].pad.xyz[2]", "looks like mm"),
    ("contacts[0].patch_radius", 31.5, "contacts[0].patch_radius", "31.5 mm are 0.0315 m"),
    ("contacts[0].spin", 45, "contacts[0].spin", "looks like deg"),
    ("contacts[0].friction", 60, "contacts[0].friction", "looks like %"),
    ("task.start[2]", 745, "task.start[2]", "looks like mm"),
    ("task.waypoints[0].upper[5]", 10, "task.waypoints[0].upper[5]", "looks like deg"),
    ("task.reference_force", 12, "task.reference_force", "12 kgf are 117.68 N"),
    ("task.reference_force", [117.7, 12], "task.reference_force[1]", "looks like kgf"),
    ("task.reference_speed", 250, "task.reference_speed", "250 mm/s are 0.25 m/s"),
    ("task.reference_angular_speed", 30, "task.reference_angular_speed", "looks like deg/s"),
    ("robots[0].velocity_max", [120] * 6, "robots[0].velocity_max[0]", "looks like deg/s"),
    ("robots[0].acceleration_max", 500, "robots[0].acceleration_max", "looks like deg/s^2"),
    ("payload.jerk_max", 30_000, "payload.jerk_max", "30000 mm/s^3 are 30 m/s^3"),
    ("robots[0].jerk_max", 30_000, "robots[0].jerk_max", "looks like deg/s^3"),
    ("robots[0].position_upper", [270] * 6, "robots[0].position_upper[0]", "looks like deg"),
    # inertia
    ("payload.inertia", "hollow", "payload.inertia", "'solid box' or a 3 x 3 matrix"),
    ("payload.inertia", [[1, 0, 0]], "payload.inertia", "'solid box' or a 3 x 3 matrix"),
    ("payload.inertia", [[0.1, 0, 0], [0, 0.1], [0, 0, 0.1]], "payload.inertia[1]", "3 numbers"),
    (
        "payload.inertia",
        [[0.1, 0.01, 0], [0, 0.1, 0], [0, 0, 0.1]],
        "payload.inertia",
        "not symmetric",
    ),
    ("payload.inertia", [[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0]], "payload.inertia", "singular"),
    ("payload.inertia", [[0, 0, 0], [0, 0, 0], [0, 0, 0]], "payload.inertia", "singular"),
    ("payload.inertia", [[-0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], "payload.inertia", "singular"),
    (
        "payload.inertia",
        [[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.3]],
        "payload.inertia",
        "at most the sum of the other two",
    ),
    (
        "payload.inertia",
        [[185, 0, 0], [0, 127, 0], [0, 0, 208]],
        "payload.inertia",
        "mass inside the box gives at most",
    ),
    ("payload.centre_of_mass", [0, 0.21, 0], "payload.centre_of_mass[1]", "outside the box"),
    # contacts
    ("contacts[0].xyz", [0, 0.19, 0], "contacts[0].xyz", "0.01 m inside the box"),
    ("contacts[0].xyz", [0, 0.25, 0], "contacts[0].xyz", "0.05 m outside the box"),
    ("contacts[0].xyz", [0.15, 0.20, 0], "contacts[0].xyz", "on an edge of the box"),
    ("contacts[0].xyz", [0.14, 0.20, 0], "contacts[0].xyz", "only 0.01 m from the edge"),
    ("contacts[1].xyz", [0, 0.20, 0], "contacts[1].xyz", "allowed are opposite faces"),
    ("contacts[1].xyz", [0.15, 0, 0], "contacts[1].xyz", "on the +x face, contacts[0] on the +y"),
    # task
    (
        "task.waypoints[1].lower[0]",
        -0.40,
        "task.waypoints[1].lower[0]",
        "found -0.4 for x, above its upper bound -0.42",
    ),
    ("task.waypoints", [], "task.waypoints", "at least one free waypoint"),
    ("task.waypoints", [{"fixed": ZERO_POSE}], "task.waypoints", "at least one free waypoint"),
    ("task.waypoints[0].fixed", ZERO_POSE, "task.waypoints[0].fixed", "found beside 'lower' and"),
    ("task.waypoints[0].count", 0, "task.waypoints[0].count", "whole number 1 to"),
    ("task.waypoints[0].count", 97, "task.waypoints", "found 101 poses"),
    (
        "task.waypoints[0]",
        {"lower": ZERO_POSE, "upper": ZERO_POSE},
        "task.waypoints[0]",
        "a fixed pose is written fixed",
    ),
    ("task.initial", [ZERO_POSE], "task.initial", "found 1 rows; allowed is one per free"),
    ("task.initial", 3, "task.initial", "rows of 6 numbers"),
    ("task.initial[1]", [0.0], "task.initial[1]", "an array of 6 numbers"),
    ("task.initial[1][2]", 1.2, "task.initial[1][2]", "found 1.2 for z, outside its bounds"),
    ("task.reference_speed", 1.5, "task.reference_speed", "at most payload.velocity_max = 1"),
    (
        "task.allowed_contacts",
        [{"body": "tpo board", "departure": 0.02}],
        "task.allowed_contacts[0].body",
        "did you mean 'top board'?",
    ),
    (
        "task.allowed_contacts",
        [{"body": "top board", "departure": 20}],
        "task.allowed_contacts[0].departure",
        "looks like mm",
    ),
    ("task.start[2]", 2.5, "task.start", "out of reach: the flange of robot 'left'"),
    ("robots[1].base.xyz[1]", -3.0, "task.goal", "the flange of robot 'right'"),
    # names
    ("environment[1].name", "ground", "environment[5].name", "already environment[1].name"),
    ("robots[1].name", "left", "robots[1].name", "found 'left' again"),
    ("environment[0].name", "payload", "environment[0].name", "reserved"),
    ("environment[0].name", "left", "environment[0].name", "already robots[0].name"),
    ("environment[0].name", "a\nb", "environment[0].name", "control character"),
    ("environment[0].name", "a\u202eb", "environment[0].name", "control character"),
    ("environment[0].name", "", "environment[0].name", "not empty"),
    ("environment[0].name", " a", "environment[0].name", "spaces at its ends"),
    ("environment[0].name", "a" * 81, "environment[0].name", "81 characters"),
    ("environment[0].name", 5, "environment[0].name", "allowed is a text"),
    ("environment[0].name", "left/link_1", "environment[0].name", "without '/'"),
    ("robots[0].name", "a/b", "robots[0].name", "without '/'"),
    ("robots[0].tool[0].name", "link_3", "robots[0].tool[0].name", "already a link of gofa12.urdf"),
    ("name", "\x1b[31mred", "name", "control character"),
    # robots
    ("robots[0].urdf", "nowhere.urdf", "robots[0].urdf", "cannot be read (No such file"),
    ("robots[0].urdf", ".", "robots[0].urdf", "cannot be read"),
    ("robots[0].urdf", "a\0b", "robots[0].urdf", "allowed is the path of a file"),
    ("robots[0].urdf", str(RACK), "robots[0].urdf", "not readable XML"),
    ("robots[0].flange", "tool", "robots[0].flange", "did you mean 'tool0'?"),
    ("robots[0].flange", "xyz", "robots[0].flange", "allowed are 'link_6', 'tool0'"),
    ("robots[0].flange", "link_4", "robots[0].flange", "the last joint does not move"),
    ("robots[0].locked_joints.joint_9", 0.0, "robots[0].locked_joints", "no moving joint"),
    ("robots[0].locked_joints.joint_6", 0.0, "robots[0].urdf", "found 5 joints"),
    ("robots[0].package_dirs", ["nowhere"], "robots[0].package_dirs[0]", "allowed is a folder"),
    (
        "robots[0].position_lower",
        [0, 0, 2, 0, 0, 0],
        "robots[0].position_lower[2]",
        "found 2 rad for joint 'joint_3', not below its upper limit",
    ),
    ("robots[0].position_lower", -1.0, "robots[0].position_lower", "an array of 6 numbers"),
    ("robots[0].min_manipulability", 0, "robots[0].min_manipulability", "1e-09 to 10 m^3"),
    # other files, collision pairs
    (
        "environment[0]",
        {"name": "m", "kind": "mesh", "path": "no.stl"},
        "environment[0].path",
        "cannot be read",
    ),
    (
        "collision.ignored",
        [{"first": "payload", "second": "left/link_7", "reason": "r"}],
        "collision.ignored[0].second",
        "did you mean 'left/",
    ),
    (
        "collision.ignored",
        [{"first": "payload", "second": "payload", "reason": "r"}],
        "collision.ignored[0]",
        "with itself",
    ),
    (
        "collision.ignored",
        [{"first": "payload", "second": "ground"}],
        "collision.ignored[0].reason",
        "is missing",
    ),
]
