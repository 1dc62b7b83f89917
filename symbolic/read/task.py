"""The task section of a workcell file, and the redundant joints.

Redundant joints are an arm's joints beyond six; their paths are decision variables. A path of all
joints along the hand-made trajectory decides which joints are redundant, and gives their initial
positions. It is made by Newton steps of least norm that also drift to the middle of the joint
ranges as far as the pose of the box allows (Liegeois, IEEE T-SMC 7(12), 1977).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import cast, get_args

import numpy as np
import pinocchio as pin

from symbolic.array import Array
from symbolic.contact.registry import CONTACT_MODELS, contact_model
from symbolic.read.arms import FOLLOWING, arm_model, common_joints, link_frame, turning_joints
from symbolic.read.payload import SHAPE_KEYS
from symbolic.read.tables import TableReader, checked_vector
from symbolic.records import (
    POSE_SIZE,
    Contact,
    RedundantJoint,
    Robot,
    Task,
    Waypoint,
    Workcell,
)
from symbolic.records import quantities as quantity
from symbolic.records.cell import box_flange
from symbolic.records.poses import (
    Orientation,
    Rotation,
    box_placement,
    inverse,
    read_only,
    rotation_from_rpy,
)
from symbolic.records.problems import Problems, shown
from symbolic.records.time_law import CONSTANT, TIME_LAWS, TimeLaw

MAX_WAYPOINTS = 100
MAX_PIECES = 10

MOST_TURN = 5.0
"""Longest rotation vector of a waypoint [rad]: a full turn minus the overshoot of the spline."""

FORCE_LIMIT_MARGIN = 1.001


def read_task(table: TableReader, holding: Array) -> tuple[Task, tuple[RedundancyEntry, ...]]:
    """Read the task (fixed poses, waypoints, sampling, limits), and the tables of redundant joints.

    Args:
        table: the task's section of the workcell file.
        holding: holding force of each arm's hand, 0 for a pad [N].
    """
    orientation = _orientation(table)
    names = ("x", "y", "z", *orientation.components)
    start = _fixed(table, "start")
    between = [w for entry in table.tables("waypoints") for w in _waypoints(entry, names)]
    waypoints = (start, *between, _fixed(table, "goal"))
    if table.clean("waypoints"):
        if all(waypoint.is_fixed for waypoint in waypoints):
            table.add("waypoints", "no waypoint is free; allowed is at least one free waypoint")
        if len(waypoints) > MAX_WAYPOINTS:
            table.add(
                "waypoints",
                f"found {len(waypoints)} poses with start and goal; allowed are {MAX_WAYPOINTS}",
            )
    time_law = table.choice("time_law", tuple(TIME_LAWS), CONSTANT)
    law = TIME_LAWS[time_law or CONSTANT]
    pieces = table.integer("drivable_pieces", 1, MAX_PIECES, 1)
    redundant = read_redundant(table, len(waypoints))
    holds, given = bool(holding.any()), {}
    if holds:
        given["reference_force"] = read_only(np.full(2, holding[holding > 0.0].min()))
        if table.has("reference_force"):
            table.add("reference_force", "found beside holding_force of the contacts, its value")
    task = table.record(
        Task,
        **given,
        waypoints=waypoints,
        time_law=law.name,
        initial=_read_initial(table, [w for w in waypoints if not w.is_fixed], names),
        allocation=_allocation(table, law, holds),
        force_limit=_force_limit(table),
        redundant=(),
        orientation=orientation,
        pieces=pieces if law.is_drivable else 1,
    )
    if orientation.is_vector:
        _check_vectors(task, table.problems)
    return task, redundant


def _allocation(table: TableReader, law: TimeLaw, holds: bool) -> str:
    """Read the name of the contact model; if none is stated, choose it: 'holding-hands' if hands
    hold (`holds`), else 'soft-finger' under a drivable time law, else 'paper'."""
    pads = "soft-finger" if law.is_drivable else "paper"
    usual = _known_allocation(table, "allocation", "holding-hands" if holds else pads)
    own = _known_allocation(table, "drivable_allocation", usual)
    for key, name in (("allocation", usual), ("drivable_allocation", own)):
        if holds and name != "holding-hands":
            table.add(key, f"found {name!r}; hands that hold by themselves have 'holding-hands'")
    return own if law.is_drivable else usual


def _known_allocation(table: TableReader, key: str, usual: str) -> str:
    if table.raw(key, usual) == "joint":
        table.add(
            key,
            "found 'joint', which no longer exists, because real pads need up to 31 % more force; "
            "write 'soft-finger' and search, polish and time anew",
        )
        return usual
    return table.choice(key, tuple(CONTACT_MODELS), usual)


def _check_vectors(task: Task, problems: Problems) -> None:
    """Record a problem unless every allowed rotation vector is shorter than `MOST_TURN` [rad]."""
    for k, waypoint in enumerate(task.waypoints):
        farthest = np.maximum(np.abs(waypoint.lower[3:]), np.abs(waypoint.upper[3:]))
        if np.linalg.norm(farthest) > MOST_TURN:
            problems.add(
                "task.rotation",
                f"found a rotation of up to {np.linalg.norm(farthest):.2f} rad at pose {k} of the "
                f"path, start and goal included; allowed are {MOST_TURN:g} rad from "
                "task.rotation_reference",
            )


def with_force_limit(workcell: Workcell) -> Workcell:
    """Return the workcell with the range of the force limit, a decision variable of drivable
    carries.

    The workcell file may state the range. Otherwise it begins at 1.001 times the force that holds
    the payload level and at rest, and ends at the smaller of both robots' reference forces; if this
    is less than its beginning, the range is one value.
    """
    task = workcell.task
    if np.isfinite(task.force_limit[1]):
        return workcell
    least = FORCE_LIMIT_MARGIN * contact_model(workcell).level_force
    highest = max(float(task.reference_force.min()), least)
    return replace(workcell, task=replace(task, force_limit=(least, highest)))


def _orientation(table: TableReader) -> Orientation:
    """Read the convention of the last three numbers of every pose."""
    known = get_args(Rotation)
    rotation = cast("Rotation", table.choice("rotation", known, known[0]))
    rpy = table.vector("rotation_reference", (quantity.ANGLE,) * 3, default=(0.0, 0.0, 0.0))
    if rotation == "roll-pitch-yaw":
        if "rotation_reference" in table:
            table.add("rotation_reference", 'allowed with rotation = "quaternion" only')
        return Orientation(rotation)
    return Orientation(rotation, read_only(rotation_from_rpy(rpy)))


def _force_limit(table: TableReader) -> tuple[float, float]:
    """Read the lower and upper bound of the force limit [N]; the upper is infinite if not
    stated."""
    if not table.has("force_limit"):
        return (0.0, np.inf)
    low, high = table.vector("force_limit", (quantity.FORCE,) * 2)
    if low > high:
        table.add(
            "force_limit",
            f"found {low:g} above {high:g}; allowed is the least limit, then the largest",
        )
    return (float(low), float(high))


def _fixed(table: TableReader, key: str) -> Waypoint:
    pose = table.vector(key, quantity.POSE)
    return Waypoint(pose, pose)


def _waypoints(table: TableReader, names: Sequence[str]) -> list[Waypoint]:
    """Read one table of `task.waypoints`: a fixed waypoint, or `count` free waypoints with equal
    bounds.

    Args:
        table: the table.
        names: names of a pose's six numbers, for messages.
    """
    if table.has("fixed"):
        pose = table.vector("fixed", quantity.POSE)
        table.refuse("fixed", ("lower", "upper", "count"))
        table.close()
        return [Waypoint(pose, pose)]
    lower, upper = (table.vector(key, quantity.POSE) for key in ("lower", "upper"))
    count = table.integer("count", 1, MAX_WAYPOINTS, 1)
    table.close()
    if table.problems.clean(table.path):
        for index, (component, low, high) in enumerate(zip(names, lower, upper, strict=True)):
            if low > high:
                table.add(
                    f"lower[{index}]",
                    f"found {low:g} for {component}, above its upper bound {high:g}; allowed is "
                    "lower <= upper",
                )
        if np.array_equal(lower, upper):
            table.problems.add(
                table.path, "lower equals upper everywhere; a fixed pose is written fixed = [...]"
            )
    return [Waypoint(lower, upper)] * count


def _read_initial(table: TableReader, free: list[Waypoint], names: Sequence[str]) -> Array:
    """Read the initial poses (n_free, 6) of the free waypoints [m, rad], from the key `initial`.
    The default is the middle of their bounds.

    Args:
        table: the task's section of the workcell file.
        free: the free waypoints.
        names: names of a pose's six numbers, for messages.
    """
    value = table.raw("initial", None)
    path, problems = table.at("initial"), table.problems
    if value is None:
        return read_only(np.reshape([(w.lower + w.upper) / 2 for w in free], (-1, 6)))
    if not isinstance(value, list):
        problems.add(path, f"found {shown(value)}; allowed is an array of rows of 6 numbers")
        return read_only(np.zeros((len(free), 6)))
    rows = [
        checked_vector(row, quantity.POSE, f"{path}[{index}]", problems)
        for index, row in enumerate(value)
    ]
    found = read_only(np.reshape(rows, (-1, 6)))
    if not table.clean("waypoints"):
        return found
    if len(rows) != len(free):
        problems.add(
            path, f"found {len(rows)} rows; allowed is one per free waypoint, {len(free)} here"
        )
    for row, (values, waypoint) in enumerate(zip(rows, free, strict=False)):
        low, high = waypoint.lower, waypoint.upper
        sound = problems.clean(f"{path}[{row}]")
        for column in np.flatnonzero((values < low) | (values > high)) if sound else ():
            problems.add(
                f"{path}[{row}][{column}]",
                f"found {values[column]:g} for {names[int(column)]}, outside its bounds; allowed "
                f"is {low[column]:g} to {high[column]:g}",
            )
    return found


# --- redundant joints ---


FULL_TURN = 2.0 * np.pi
"""Largest width of a joint's default bounds, about its initial value [rad]. Beyond it positions
repeat."""

MOST_BEYOND = 6
"""Largest number of redundant joints of one arm, without those that move both arms. All choices are
tried."""


@dataclass(frozen=True)
class RedundancyEntry:
    """Entry of a redundant joint in a workcell file.

    Attributes:
        path: key path of the entry.
        joint: 'robot/joint', or the name of a joint of either robot.
        lower, upper, initial: (n_waypoints,) bounds and initial positions at the waypoints [rad or
            m]; None if the file does not state them.
    """

    path: str
    joint: str
    lower: Array | None = None
    upper: Array | None = None
    initial: Array | None = None


def read_redundant(table: TableReader, n_waypoints: int) -> tuple[RedundancyEntry, ...]:
    """Read the entries of `task.redundant`.

    Args:
        table: the task's section of the workcell file.
        n_waypoints: number of waypoints, fixed and free.
    """
    found = []
    for entry in table.tables("redundant"):
        values = {
            key: entry.vector(key, (quantity.LOCKED_POSITION,) * n_waypoints, filling=True)
            for key in ("lower", "upper", "initial")
            if entry.has(key)
        }
        found.append(RedundancyEntry(entry.path, entry.text("joint"), **values))
        entry.close()
    return tuple(found)


def with_redundancy(
    workcell: Workcell, entries: Sequence[RedundancyEntry], problems: Problems
) -> Workcell:
    """Return the workcell with its redundant joints.

    Joints and positions that the file does not state are chosen automatically.

    Args:
        workcell: the workcell without redundant joints.
        entries: entries of `task.redundant` in the file.
        problems: collector of problems.
    """
    if not problems.clean("robots", "task", "contacts", *SHAPE_KEYS):
        return workcell
    models = [arm_model(robot) for robot in workcell.robots]
    names = [tuple(model.names)[1:] for model in models]
    if not entries and all(len(joints) == FOLLOWING for joints in names):
        return workcell
    common = common_joints(workcell.robots)
    arms, found = [], []
    for i, robot in enumerate(workcell.robots):
        most = FOLLOWING + MOST_BEYOND + len(common)
        if len(names[i]) > most:
            told = f"found {len(names[i])} joints that move; allowed are {most}"
            problems.add(f"robots[{i}].chain", f"{told}: hold others by locked_joints")
            return workcell
        path, redundant = _choice(workcell, i, entries, common)
        if not set(common) <= set(redundant):
            problems.add(
                f"robots[{i}].redundant_joints",
                f"joint {common[0]!r} moves both arms; allowed are arms with at least six joints "
                "of their own, and redundant joints that name the common ones",
            )
            return workcell
        arms.append(replace(robot, redundant_joints=redundant))
        for name in redundant:
            if i == 0 or name not in common:
                drives = tuple(
                    names[k].index(name) if k == i or name in common else -1 for k in (0, 1)
                )
                said = _entry(entries, robot, name)
                found.append(_joint(workcell, i, (drives[0], drives[1]), said, path, problems))
    known = {joint.name for joint in found} | {joint.name.split("/")[1] for joint in found}
    known |= {f"{workcell.robots[1].name}/{name}" for name in common}
    for entry in entries:
        if entry.joint not in known:
            listed = ", ".join(joint.name for joint in found) or "none in this cell"
            problems.add(
                f"{entry.path}.joint", f"found {entry.joint!r}; redundant joints are: {listed}"
            )
    task = replace(workcell.task, redundant=tuple(found))
    return replace(workcell, robots=(arms[0], arms[1]), task=task)


def _choice(
    workcell: Workcell, i: int, entries: Sequence[RedundancyEntry], common: tuple[str, ...]
) -> tuple[PosturePath | None, tuple[str, ...]]:
    """Choose the redundant joints of one arm: those beyond six, whose positions are decision
    variables.

    Args:
        workcell: the workcell.
        i: index of the arm.
        entries: tables of `task.redundant` in the file.
        common: names of joints that move both arms.

    Returns:
        The arm's joint path along the trajectory of `task.initial`, and the names of the redundant
        joints. The path is None if it is not needed, because the file states all joints and
        positions, or if none is found.
    """
    robot = workcell.robots[i]
    model = arm_model(robot)
    names, beyond = list(model.names)[1:], model.nq - FOLLOWING
    chosen = tuple(sorted(robot.redundant_joints, key=names.index))
    told = [_entry(entries, robot, name) for name in chosen]
    if not beyond or (chosen and all(entry.initial is not None for entry in told)):
        return None, chosen
    held = {}
    for name in common:
        joint, entry = names.index(name), _entry(entries, robot, name)
        middle = (robot.position_lower[joint] + robot.position_upper[joint]) / 2.0
        held[joint] = float(middle if entry.initial is None else entry.initial[0])
    path = posture_path(robot, workcell.contacts[i], workcell.task, held)
    if not chosen:
        sliding = [k for k, turns in enumerate(turning_joints(model)) if not turns]
        forced = list(dict.fromkeys([*held, *sliding]))[:beyond]
        chosen = tuple(names[k] for k in best_conditioned(path, model.nq, forced))
    return path, chosen


def _entry(entries: Sequence[RedundancyEntry], robot: Robot, name: str) -> RedundancyEntry:
    """Return the entry of `task.redundant` for a robot's joint; an entry without values if the file
    has none.

    An entry for 'robot/joint' takes precedence over one for the name of the joint alone.
    """
    by_name = {entry.joint: entry for entry in reversed(entries)}
    nothing = RedundancyEntry("", name)
    return by_name.get(f"{robot.name}/{name}", by_name.get(name, nothing))


def _joint(
    workcell: Workcell,
    i: int,
    drives: tuple[int, int],
    said: RedundancyEntry,
    path: PosturePath | None,
    problems: Problems,
) -> RedundantJoint:
    robot, n = workcell.robots[i], len(workcell.task.waypoints)
    joint, name = drives[i], said.joint.removeprefix(f"{robot.name}/")
    least, most = float(robot.position_lower[joint]), float(robot.position_upper[joint])
    initial = said.initial
    if initial is None:
        middle = np.full(n, (least + most) / 2.0)
        initial = middle if path is None else path.at_waypoints(joint)
        initial = np.maximum(initial, least if said.lower is None else said.lower)
        initial = np.minimum(initial, most if said.upper is None else said.upper)
    reach = np.inf if most - least <= FULL_TURN else FULL_TURN / 2.0
    lower = np.maximum(least, initial - reach) if said.lower is None else said.lower
    upper = np.minimum(most, initial + reach) if said.upper is None else said.upper
    where = said.path or f"robots[{i}].redundant_joints"
    if np.any(lower < least) or np.any(upper > most):
        problems.add(where, f"found bounds beyond the joint's limits {least:g} to {most:g}")
    elif np.any(lower > initial) or np.any(initial > upper):
        problems.add(where, "allowed is lower <= initial <= upper at every waypoint")
    first = f"{robot.name}/{name}"
    return RedundantJoint(first, drives, read_only(lower), read_only(upper), read_only(initial))


# --- a posture path along the hand-made trajectory ---


SEEDS = 24
"""Number of random postures from which the start posture is searched."""

MAX_NEWTON_STEPS = 80
"""Largest number of Newton steps to the start posture, and to each pose after it."""

POSES_PER_PIECE = 4
"""Number of poses per piece of the path."""

CLOSE = 1e-4
"""A posture with a smaller pose error counts as reached [m, rad]. The values are only a
proposal."""

CENTRING_SHARE = 0.05
"""Share of the way to the middle of their ranges by which free joints move in a step."""


@dataclass(frozen=True)
class PosturePath:
    """Path of an arm's joints along the hand-made trajectory.

    Attributes:
        q: (n, joints) joint positions at n poses, which are evenly spaced along the path parameter
            and include both ends [rad or m].
        jacobian: (n, 6, joints) Jacobian of the flange at these poses, along the axes of the root.
    """

    q: Array
    jacobian: Array

    def at_waypoints(self, joint: int) -> Array:
        """Return the positions (n_waypoints,) of one joint at the waypoints, rounded to 0.001 [rad
        or m].

        Args:
            joint: index of the joint.
        """
        return np.asarray(np.round(self.q[::POSES_PER_PIECE, joint], 3))


class _Chain:
    """Numeric kinematics of an arm with some joints held."""

    def __init__(
        self, robot: Robot, contact: Contact, task: Task, held: Mapping[int, float]
    ) -> None:
        self.robot, self.orientation, self.held = robot, task.orientation, dict(held)
        self.model = arm_model(robot)
        self.data = self.model.createData()
        self.flange = link_frame(self.model, robot.flange)
        self.to_root = inverse(robot.T_world_base)
        self.T_box_flange = box_flange(robot, contact)
        self.free = [k for k in range(self.model.nq) if k not in self.held]
        reach = np.clip([robot.position_lower, robot.position_upper], -np.pi, np.pi)
        self.low, self.high = np.minimum(reach[0], reach[1]), np.maximum(reach[0], reach[1])
        self.middle = (self.low + self.high) / 2.0

    def jacobian(self, q: Array) -> Array:
        """Compute the Jacobian (6, joints) of the flange at joint positions q (joints,): three
        linear rows, then three angular rows, along the axes of the robot's root."""
        J: Array = pin.computeFrameJacobian(
            self.model, self.data, q, self.flange, pin.LOCAL_WORLD_ALIGNED
        )
        return J

    def error(self, q: Array, pose: Array) -> Array:
        """Compute the wanted minus the actual pose of the flange at joints q: position [m] and
        rotation vector [rad], (6,), root axes. At the wanted pose the arm holds the box at `pose`
        (6,)."""
        T = self.to_root @ box_placement(self.orientation, pose) @ self.T_box_flange
        pin.framesForwardKinematics(self.model, self.data, q)
        here = self.data.oMf[self.flange]
        turn = pin.log3(T[:3, :3] @ here.rotation.T)
        return np.concatenate([T[:3, 3] - here.translation, turn])

    def reach(self, q: Array, pose: Array) -> Array | None:
        """Find joint positions (n,) near q that are within the limits and hold the box at `pose`
        (6,); None if Newton's method finds none."""
        for _ in range(MAX_NEWTON_STEPS):
            error = self.error(q, pose)
            if np.linalg.norm(error) < CLOSE and self.within(q):
                return q
            J = self.jacobian(q)[:, self.free]
            inverted = J.T @ np.linalg.inv(J @ J.T + 1e-8 * np.eye(6))
            centring = CENTRING_SHARE * (self.middle - q)[self.free]
            step = inverted @ error + centring - inverted @ (J @ centring)
            q = q.copy()
            q[self.free] += step * min(1.0, 0.4 / max(float(np.abs(step).max()), 1e-12))
        return None

    def within(self, q: Array) -> bool:
        """Return True if every joint position in q (joints,) is within its limits."""
        return bool(np.all((q >= self.robot.position_lower) & (q <= self.robot.position_upper)))

    def starts(self) -> Array:
        """Return start postures (k, joints): the middle of the limits, then random ones
        [rad or m]."""
        rng = np.random.default_rng(0)
        q = np.vstack([self.middle, rng.uniform(self.low, self.high, (SEEDS, len(self.low)))])
        for joint, value in self.held.items():
            q[:, joint] = value
        return q


def posture_path(
    robot: Robot, contact: Contact, task: Task, held: Mapping[int, float]
) -> PosturePath | None:
    """Compute the positions of all joints of an arm along the trajectory of `task.initial`, away
    from joint limits and singular postures.

    Args:
        robot: the arm.
        contact: the arm's contact with the box.
        task: the task, with or without redundant joints.
        held: positions of joints that do not move, by index [rad or m].

    Returns:
        The path; None if none is found.
    """
    # Not imported at the top: it needs CasADi, which cells of six-joint arms do not to be read.
    from symbolic.path.spline import path_basis

    chain = _Chain(robot, contact, task, held)
    points = np.array([waypoint.lower for waypoint in task.waypoints])
    points[list(task.free_indices)] = task.initial
    points[:, 3:] = task.orientation.unwrapped(points[:, 3:])
    u = np.linspace(0.0, 1.0, POSES_PER_PIECE * (len(points) - 1) + 1)
    poses = path_basis(len(points), u).position @ points[:, :POSE_SIZE]
    best, most = None, -np.inf
    for start in chain.starts():
        q = chain.reach(start, poses[0])
        path = []
        for pose in poses:
            q = None if q is None else chain.reach(q, pose)
            if q is None:
                break
            path.append(q)
        if q is None:
            continue
        jacobian = np.array([chain.jacobian(each) for each in path])
        room = np.minimum(np.array(path) - robot.position_lower, robot.position_upper - path)
        least = np.linalg.svd(jacobian[:, :, chain.free], compute_uv=False)[:, -1].min()
        score = float(least * room[:, chain.free].min())
        if score > most:
            best, most = PosturePath(np.array(path), jacobian), score
    return best


def best_conditioned(
    path: PosturePath | None, n_joints: int, forced: Sequence[int]
) -> tuple[int, ...]:
    """Choose the redundant joints of an arm such that the other six joints stay farthest from
    singular postures.

    The measure is the least singular value of their Jacobian along the path.

    Args:
        path: joint path of the arm along the trajectory of `task.initial`; None chooses the joints
            next to the root.
        n_joints: number of joints of the arm.
        forced: indices of joints that are redundant in any case.

    Returns:
        n_joints - 6 indices in ascending order.
    """
    others = [joint for joint in range(n_joints) if joint not in forced]
    chosen = [
        tuple(sorted((*forced, *more)))
        for more in combinations(others, n_joints - FOLLOWING - len(forced))
    ]
    if path is None:
        return chosen[0]

    def condition(joints: tuple[int, ...]) -> float:
        rest = [joint for joint in range(n_joints) if joint not in joints]
        singular = np.linalg.svd(path.jacobian[:, :, rest], compute_uv=False)
        return float(singular[:, -1].min())

    return max(chosen, key=condition)
