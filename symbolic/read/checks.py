"""Checks across the sections of a workcell: names, references, reach, consistency.

Each function records what it finds in `problems` and looks only at parts that are themselves
in order.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from symbolic.array import Array
from symbolic.contact.force_closure import has_force_closure
from symbolic.errors import RobotModelError
from symbolic.read.arms import (
    arm_model,
    body_names,
    link_frame,
    machine_problem,
    robot_urdf,
    turning_joints,
)
from symbolic.read.payload import SHAPE_KEYS
from symbolic.records import PAYLOAD, Robot, Workcell
from symbolic.records.poses import box_placement, inverse
from symbolic.records.problems import Problems, matching, suggestion

PATCH_OVERLAP = 0.9  # [1], how far patches that carry moments together may stand beside one another
REACH_SLACK = 1e-6  # [m], rounding of a flange exactly at full stretch


def check_names(workcell: Workcell, problems: Problems) -> None:
    """Names are unique where they are used to address something."""
    robots = [(f"robots[{i}].name", robot.name) for i, robot in enumerate(workcell.robots)]
    bodies = [(f"environment[{i}].name", b.name) for i, b in enumerate(workcell.environment)]
    _check_unique([("'payload' (reserved)", PAYLOAD), *robots, *bodies], problems)
    for index, robot in enumerate(workcell.robots):
        path = f"robots[{index}]"
        links: list[tuple[str, str]] = []
        if problems.clean(f"{path}.urdf"):
            content = robot_urdf(robot)
            links = [(f"a link of {robot.urdf.name}", link) for link in content.collision_links]
        tools = [(f"{path}.tool[{i}].name", body.name) for i, body in enumerate(robot.tool)]
        _check_unique([*links, *tools], problems)
    for index, body in enumerate(workcell.environment):
        if "/" in body.name:
            problems.add(
                f"environment[{index}].name",
                f"found {body.name!r}; allowed is a name without '/', which marks a robot's bodies",
            )


def _check_unique(entries: list[tuple[str, str]], problems: Problems) -> None:
    first: dict[str, str] = {}
    for path, name in entries:
        if name and name in first:
            problems.add(path, f"found {name!r} again; it is already {first[name]}")
        first.setdefault(name, path)


def check_contacts(workcell: Workcell, problems: Problems) -> None:
    """The pads can hold the payload whatever the motion asks, as the allocation takes them."""
    if not problems.clean("contacts", "task.allocation", *SHAPE_KEYS):
        return
    allocation, first = workcell.task.allocation, workcell.contacts[0].T_box_pad
    if allocation == "soft-finger" and workcell.has_opposite_pads:
        # They carry any moment by pressing harder where the line between them lies well within
        # their friction cones.
        apart = first[:3, 3] - workcell.contacts[1].T_box_pad[:3, 3]
        friction = min(contact.friction for contact in workcell.contacts)
        room = friction * abs(float(apart @ first[:3, 2]))
        _check_beside(workcell, room, "friction times the pads' distance", problems)
    elif allocation == "joint" and workcell.has_facing_pads:
        # Likewise where the patches overlap, seen along the normal.
        room = sum(contact.patch_radius for contact in workcell.contacts)
        _check_beside(workcell, room, "both patch radii together", problems)
    elif allocation == "paper":
        if not workcell.has_facing_pads:
            second = workcell.contacts[1].T_box_pad
            turned = np.degrees(np.arccos(np.clip(-first[:3, 2] @ second[:3, 2], -1.0, 1.0)))
            problems.add(
                "contacts[1].xyz",
                f"belongs to {len(workcell.pads)} pads, with a normal {turned:.4g} degrees off the "
                "opposite of contacts[0]; the paper's allocation allows two round pads with "
                "opposite normals: task.allocation = 'soft-finger' and 'joint' take any",
            )
    elif not has_force_closure(workcell):
        problems.add(
            "contacts",
            "the pads do not close their grasp: no squeeze within their friction cones holds the "
            "payload against whatever the motion asks; allowed is enough friction (with 5 % to "
            "spare) along the lines between them: turn them towards one another, raise friction "
            "or add a pad (further)",
        )


def _check_beside(workcell: Workcell, room: float, meaning: str, problems: Problems) -> None:
    """Pads lie beside one another by less than most of some room [m]."""
    beside, room = pads_beside(workcell), PATCH_OVERLAP * room
    if beside >= room:
        problems.add(
            "contacts[1].xyz",
            f"faces a point {beside:g} m beside contacts[0]; task.allocation = "
            f"{workcell.task.allocation!r} allows less than {room:g} m here, {PATCH_OVERLAP:g} of "
            f"{meaning}",
        )


def pads_beside(workcell: Workcell) -> float:
    """How far the contacts lie beside one another, seen along their normals [m]."""
    apart = workcell.contacts[0].T_box_pad[:3, 3] - workcell.contacts[1].T_box_pad[:3, 3]
    normal = workcell.contacts[0].T_box_pad[:3, 2]
    return float(np.linalg.norm(apart - (apart @ normal) * normal))


def check_uncertainty(workcell: Workcell, problems: Problems) -> None:
    """Displaced pads keep some of their patches, and these face one another."""
    displaced = workcell.uncertainty.pad_position
    if not (displaced and workcell.uncertainty.stated) or not problems.clean(
        "uncertainty", "contacts", *SHAPE_KEYS
    ):
        return
    if not workcell.has_facing_pads:
        problems.add(
            "uncertainty.pad_position",
            "needs two round pads that face one another; leave it out for others",
        )
        return
    radii = [contact.patch_radius for contact in workcell.contacts]
    room = min(min(radii), (sum(radii) - pads_beside(workcell) / PATCH_OVERLAP) / 2.0)
    if displaced >= room:
        problems.add(
            "uncertainty.pad_position",
            f"found {displaced:g} m; allowed is less than {max(room, 0.0):g} m, beyond which "
            "displaced patches need not face one another",
        )


def check_shapes(workcell: Workcell, problems: Problems) -> None:
    """There are not more collision shapes than convex pieces allowed; a mesh has at least one."""
    most = workcell.collision.most_pieces
    if not problems.clean("collision.most_pieces", *_of_robots("urdf")):
        return
    counts = {"environment": len(workcell.environment)}
    for index, robot in enumerate(workcell.robots):
        counts[f"robots[{index}].tool"] = len(robot.tool)
        collisions = robot_urdf(robot).collisions.values()
        counts[f"robots[{index}].urdf"] = sum(map(len, collisions))
    total = sum(counts.values()) + 1
    if total > most:
        largest = max(counts, key=lambda path: counts[path])
        problems.add(
            largest,
            f"found {counts[largest]} collision shapes, {total} in the whole cell; allowed are "
            f"{most}: simplify or merge them, leave out what nothing can touch, or raise "
            "collision.most_pieces and wait",
        )


def check_references(workcell: Workcell, problems: Problems) -> None:
    """Names in allowed contacts and ignored pairs exist."""
    if not problems.clean("environment"):
        return

    def check(path: str, name: str, known: list[str], meaning: str) -> None:
        if problems.clean(path) and not matching(name, known):
            hint = suggestion(name, known) or f"; they are {', '.join(known)}"
            problems.add(path, f"found {name!r}; allowed is {meaning}{hint}")

    environment = [body.name for body in workcell.environment]
    for index, contact in enumerate(workcell.task.allowed_contacts):
        path = f"task.allowed_contacts[{index}].body"
        check(path, contact.body, environment, "an environment body")
    if not problems.clean(*_of_robots("name", *ARM_KEYS, "flange", "tool")):
        return
    known = [name for group in body_names(workcell).values() for name in group]
    for index, pair in enumerate(workcell.collision.ignored):
        for side in ("first", "second"):
            path = f"collision.ignored[{index}].{side}"
            check(path, getattr(pair, side), known, "a body of the cell")


ARM_KEYS = ("urdf", "chain", "locked_joints", "drop_links")


def _of_robots(*parts: str) -> list[str]:
    """Keys of both robots."""
    return [f"robots[{index}].{part}" for index in (0, 1) for part in parts]


def check_machine(workcell: Workcell, problems: Problems) -> None:
    """Two arms of one machine move apart from one another, and agree on what stands still."""
    if problems.clean(*_of_robots(*ARM_KEYS)) and (problem := machine_problem(workcell.robots)):
        problems.add("robots[1].chain", problem)


def check_speeds(workcell: Workcell, problems: Problems) -> None:
    """The reference speeds are within the payload's own limits."""
    for key, limit_key in (
        ("reference_speed", "velocity_max"),
        ("reference_angular_speed", "angular_velocity_max"),
    ):
        value, limit = getattr(workcell.task, key), getattr(workcell.payload, limit_key)
        if problems.clean(f"task.{key}", f"payload.{limit_key}") and value > limit:
            problems.add(
                f"task.{key}",
                f"found {value:g}; allowed is at most payload.{limit_key} = {limit:g}",
            )


def check_reach(workcell: Workcell, problems: Problems) -> None:
    """No fixed pose asks for more than the stretched length of an arm.

    This is necessary, not sufficient: it costs no inverse kinematics.
    """
    poses = [(path, pose) for path, pose in _fixed_poses(workcell) if problems.clean(path)]
    for index, (robot, contact) in enumerate(zip(workcell.robots, workcell.contacts, strict=True)):
        needed = [f"robots[{index}].{part}" for part in (*ARM_KEYS, "flange", "base", "pad")]
        if not problems.clean(*SHAPE_KEYS, f"contacts[{index}]", *needed):
            continue
        shoulder, length = stretched_length(robot)
        T_box_flange = contact.T_box_pad @ inverse(robot.T_flange_pad)
        for path, pose in poses:
            flange = (box_placement(workcell.task.orientation, pose) @ T_box_flange)[:3, 3]
            distance = float(np.linalg.norm(flange - shoulder))
            if distance > length + REACH_SLACK:
                where = ", ".join(f"{entry:.3f}" for entry in flange)
                box = ", ".join(f"{entry:g}" for entry in pose[:3])
                problems.add(
                    path,
                    f"the box at ({box}) m is out of reach: the flange of robot {robot.name!r} "
                    f"has to stand at ({where}) m, {distance:.3f} m from its first joint; allowed "
                    f"is {length:.3f} m, its links stretched out (look at robots[{index}].base, "
                    f"robots[{index}].pad and contacts[{index}] as well)",
                )


def stretched_length(robot: Robot) -> tuple[Array, float]:
    """Where the first joint stands (3,) [m] in the world, and an upper bound of the reach [m].

    The bound is the sum of the distances between successive joints and the flange, and of how far
    joints may slide.

    Raises:
        RobotModelError: the robot's model is not a serial arm.
    """
    model = arm_model(robot)
    shoulder = robot.T_world_base @ np.append(model.jointPlacements[1].translation, 1.0)
    flange = model.frames[link_frame(model, robot.flange)].placement.translation
    offsets = [model.jointPlacements[joint].translation for joint in range(2, model.njoints)]
    slides = sum(
        max(abs(low), abs(high))
        for turns, low, high in zip(
            turning_joints(model), robot.position_lower, robot.position_upper, strict=True
        )
        if not turns
    )
    stretched = sum(np.linalg.norm(offset) for offset in [*offsets, flange])
    return shoulder[:3], float(stretched + slides)


def _fixed_poses(workcell: Workcell) -> Iterator[tuple[str, Array]]:
    waypoints = workcell.task.waypoints
    yield "task.start", waypoints[0].lower
    for waypoint in waypoints[1:-1]:
        if waypoint.is_fixed:
            yield "task.waypoints", waypoint.lower
    yield "task.goal", waypoints[-1].lower


def check_all(workcell: Workcell, problems: Problems) -> None:
    """Every check across sections that needs no inverse kinematics."""
    for check in (
        check_machine,
        check_shapes,
        check_names,
        check_contacts,
        check_uncertainty,
        check_references,
        check_speeds,
        check_reach,
    ):
        try:
            check(workcell, problems)
        except RobotModelError as error:  # pragma: no cover - the robots section reports it first
            if problems.clean("robots"):
                problems.add("robots", str(error))
