"""All inverse-kinematics branches of an arm at a pose, and the ranking of start branches.

Six joints reach a pose in up to sixteen ways. At the start an arm's redundant joints have their
values in the hand-made trajectory. No closed form covers every arm (the GoFa's wrist is offset). So
Newton's method starts from many postures that fill the joint ranges evenly, all at once, and the
distinct solutions are collected. The residual of each solution is checked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.expression import named_function
from symbolic.path.spline import extended_waypoints, sample_basis
from symbolic.records import POSE_SIZE, Contact, Robot, Workcell
from symbolic.records.cell import box_flange
from symbolic.records.poses import box_placement, inverse
from symbolic.records.task import initial_decision
from symbolic.robot.arm import TRACK_OUTPUTS, follow_function, following_columns, pose_error
from symbolic.robot.model import RobotModel

N_STARTS = 1024
"""Number of starts of the search."""

SPREAD_ROOT = 1.1127756842787055
"""The root of x^7 = x + 1. Multiples of its powers fill six dimensions evenly (Roberts)."""

MOST_STEPS, STEPS = 80, 4
"""Largest number of Newton steps from each start, and number of steps made at once."""

SOLUTION_TOLERANCE = 1e-10
"""Largest pose residual of a solution [m, rad]."""

BRANCH_TOLERANCE = 1e-4
"""Solutions that differ less than this in every joint count as one [rad]."""

IK_STEP_LIMIT = 0.4
"""Largest change of a joint in one step of the search [rad]."""

ROBUST_CLEARANCE = 0.02
"""Clearance beyond this does not make a branch better [m]."""


@dataclass(frozen=True, eq=False)
class StartBranch:
    """A start posture of one arm, and figures of the arm's motion along the hand-made trajectory.

    Attributes:
        q: (n,) joint positions at the first waypoint [rad].
        kept: number of samples of the hand-made trajectory before the first one that is not
            reached, beyond a joint limit or near a singularity.
        clearance: least clearance bound of this arm along the trajectory [m]; infinite if no bound
            is computed.
        limit_margin: least distance to a joint limit along the trajectory [rad].
        manipulability: least abs(det(J)) of the flange along the trajectory [m^3].
        path: (samples, n) joints along the trajectory [rad].
    """

    q: Array
    kept: int
    clearance: float
    limit_margin: float
    manipulability: float
    path: Array

    @property
    def rank(self) -> tuple[float, ...]:
        """Sort key; the branch with the smallest key is best. Branches are ordered by the number of
        samples of the hand-made trajectory that the arm can follow, then by clearance, then by the
        product of the distance to the nearest joint limit and manipulability.

        Clearances above `ROBUST_CLEARANCE` count as equal.
        """
        robust = min(self.clearance, ROBUST_CLEARANCE)
        return (-float(self.kept), -round(robust, 4), -self.limit_margin * self.manipulability)


Approach = Callable[[Array, Array, Array], Mapping[str, Array]]
"""Function from joints (n, joints), the transposed rotation (3, 3) and the position (3,) of the
wanted flange placement to the outputs (n, ...) of `approach_function`."""

Follow = Callable[[Array, Array], Mapping[str, Array]]
"""Function from joints (m, joints) at the first of n extended poses (n, 6 + k) to the
`TRACK_OUTPUTS` (m, n, ...) of an arm without load."""

Poses = Callable[[Array], Array]
"""Function from extended waypoints (w, 6 + k) to the extended poses (n, 6 + k) at all samples of
the path through them."""

Clearance = Callable[[Array, Array], float]
"""Function from box poses (n, 6) and joints (n, joints) of an arm to the arm's least clearance
bound [m]."""


@dataclass(frozen=True)
class ArmSearch:
    """Functions that the search for an arm's start branches uses.

    Attributes:
        approach: function of Newton steps towards a flange placement (type `Approach`).
        follow: function of the arm's motion along extended poses (type `Follow`).
        poses: function from waypoints to all samples of the path (type `Poses`).
        clearance: function of the arm's least clearance bound [m]; None for no bound.
        found: cache of start postures (m, n), keyed by flange placement, joint limits and positions
            of redundant joints.
    """

    approach: Approach
    follow: Follow
    poses: Poses
    clearance: Clearance | None = None
    found: dict[bytes, Array] = field(default_factory=dict)


def interpreted_search(
    workcell: Workcell, arm: int, model: RobotModel, clearance: Clearance | None = None
) -> ArmSearch:
    """Build the functions of the search for an arm's start branches, evaluated by CasADi's
    interpreter instead of compiled code.

    Args:
        workcell: the workcell.
        arm: index of the arm, 0 or 1.
        model: model of the arm.
        clearance: function of the arm's least clearance bound [m]; None if clearance does not
            count.
    """
    track = follow_function(
        workcell.robots[arm], model, workcell.contacts[arm], workcell.task.samples, "follow"
    )

    def follow(starts: Array, extended: Array) -> Mapping[str, Array]:
        still = np.zeros((POSE_SIZE, len(extended)))
        found = [[np.array(x).T for x in track(q, extended.T, still)] for q in starts]
        outputs = [np.array(values) for values in zip(*found, strict=True)]
        return {
            name: values[:, :, 0] if values.shape[2] == 1 else values
            for name, values in zip(TRACK_OUTPUTS, outputs, strict=True)
        }

    def poses(waypoints: Array) -> Array:
        return sample_basis(workcell.task).position @ waypoints

    return ArmSearch(interpreted_approach(model), follow, poses, clearance)


def interpreted_approach(model: RobotModel) -> Approach:
    """Build an arm's function of Newton steps, called as the type `Approach` describes and
    evaluated by CasADi's interpreter instead of compiled code."""
    function = approach_function(model, "approach")

    def approach(q: Array, rotation: Array, position: Array) -> Mapping[str, Array]:
        wanted = (np.tile(each, len(q)) for each in (rotation.T, position[:, None]))
        reached, residual, following = function.map(len(q))(q.T, *wanted)
        joints = {"reached": np.array(reached).T, "next": np.array(following).T}
        return joints | {"residual": np.array(residual)[0]}

    return approach


def approach_function(model: RobotModel, name: str) -> ca.Function:
    """Build the function of damped Newton steps towards a placement of the flange.

    Inputs: q (n,) [rad, or m for a sliding joint]; wanted rotation (3, 3) and position (3,) [m] of
    the flange in the root. Outputs: reached (n,), joints before the last step; residual, the pose
    residual of these joints [m, rad]; next (n,), joints after the last step.

    Args:
        model: model of the arm.
        name: name of the new function.
    """
    q, R, p = ca.SX.sym("q", model.n_joints), ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3)
    rotation, position, jacobian = model.kinematics(q)
    error, residual = pose_error(R, p, rotation, position)
    J = following_columns(model, jacobian)
    # Slight damping keeps singular postures finite and vanishes near a solution.
    damping = 1e-3 * ca.fmin(residual, 1.0) ** 2 + 1e-14
    normal = ca.mtimes(J.T, J) + damping * ca.SX.eye(6)
    D, LT, order = ca.ldl(normal, False)
    solved = ca.ldl_solve(ca.mtimes(J.T, error), D, LT, order)
    scale = IK_STEP_LIMIT / ca.fmax(ca.norm_inf(solved), IK_STEP_LIMIT)
    moved = list(ca.vertsplit(q))
    for k, joint in enumerate(model.following):
        moved[joint] = q[joint] + scale * solved[k]
    outputs = ca.cse([residual, ca.vertcat(*moved)])
    step = ca.Function(f"{name}_step", [q, R, p], outputs)
    start, R, p = ca.MX.sym("q", model.n_joints), ca.MX.sym("R", 3, 3), ca.MX.sym("p", 3)
    reached = after = start
    for _ in range(STEPS):
        reached, (residual, after) = after, step(after, R, p)
    return named_function(
        name,
        {"q": start, "rotation": R, "position": p},
        {"reached": reached, "residual": residual, "next": after},
    )


def inverse_kinematics(
    robot: Robot,
    model: RobotModel,
    T_root_flange: Array,
    n_starts: int = N_STARTS,
    redundant: Mapping[int, float] = MappingProxyType({}),
    approach: Approach | None = None,
) -> Array:
    """Find all joint positions of an arm at a flange pose.

    Positions that differ by full turns of a joint count as one.

    Args:
        robot: the arm, with its joint limits.
        model: model of the arm.
        T_root_flange: (4, 4) wanted flange placement in the robot's root frame.
        n_starts: number of start postures for Newton's method.
        redundant: positions of the arm's redundant joints by their indices [rad or m].
        approach: the arm's function of Newton steps; None for CasADi's interpreter.

    Returns:
        (m, n) joint positions of m postures [rad], sorted lexicographically, each with a residual
        below `SOLUTION_TOLERANCE`. Each joint is on the turn nearest the middle of its range.
        Postures with a joint beyond its limits on every turn are left out.
    """
    approach = approach or interpreted_approach(model)
    following = list(model.following)
    centre = (robot.position_lower + robot.position_upper) / 2.0
    half = np.minimum((robot.position_upper - robot.position_lower) / 2.0, np.pi)[following]
    q = np.tile(centre, (n_starts, 1))
    q[:, following] += (2.0 * _spread(n_starts) - 1.0) * half
    for joint, value in redundant.items():
        q[:, joint] = value
    rotation, position = T_root_flange[:3, :3].T, T_root_flange[:3, 3]
    solved = []
    for _ in range(0, MOST_STEPS, STEPS):
        found = approach(q, rotation, position)
        arrived = found["residual"] < SOLUTION_TOLERANCE
        solved.append(found["reached"][arrived])
        q = found["next"][~arrived]
        if len(q) == 0:
            break
    distinct = _distinct(np.concatenate(solved))
    central = distinct + _central_turns(robot, model, distinct, distinct)
    within = (central >= robot.position_lower) & (central <= robot.position_upper)
    possible = central[within.all(axis=1)]
    return possible[np.lexsort(np.round(possible, 6).T[::-1])]


def _spread(count: int) -> Array:
    """Return points (count, 6) that fill the unit cube evenly; they are the same in every call."""
    steps = 1.0 / np.cumprod(np.full(6, SPREAD_ROOT))
    return np.asarray((0.5 + np.arange(count)[:, None] * steps) % 1.0)


def _distinct(q: Array) -> Array:
    """Return those postures that differ from all earlier ones by more than `BRANCH_TOLERANCE`.

    Args:
        q: (m, n) joint positions of m postures [rad]; positions that differ by full turns count as
            equal.
    """
    kept = []
    while len(q):
        kept.append(q[0])
        turns = np.abs(np.remainder(q - q[0] + np.pi, 2 * np.pi) - np.pi)
        q = q[~np.all(turns < BRANCH_TOLERANCE, axis=1)]
    return np.array(kept).reshape(-1, q.shape[1])


def _central_turns(robot: Robot, model: RobotModel, least: Array, greatest: Array) -> Array:
    """Compute by how many full turns to shift each joint path, so that its middle comes as near as
    possible to the middle of the joint's limits.

    The shifts of prismatic and redundant joints are zero.

    Args:
        robot: the arm, with its joint limits.
        model: model of the arm.
        least, greatest: (n,) or (m, n) least and greatest position of each joint on its path [rad].

    Returns:
        Shifts [rad], multiples of 2 pi, of the shape of `least`.
    """
    middle = (robot.position_lower + robot.position_upper) / 2.0
    free = [turns and k in model.following for k, turns in enumerate(model.turning)]
    turns = np.array(free) * np.round((middle - (least + greatest) / 2.0) / (2.0 * np.pi))
    return np.asarray(2.0 * np.pi * turns, dtype=np.float64)


def start_branches(
    workcell: Workcell, arm: int, model: RobotModel, search: ArmSearch | None = None
) -> tuple[StartBranch, ...]:
    """Return all branches of one arm at the first waypoint, best first by `StartBranch.rank`.

    Each branch is followed along the hand-made trajectory. A joint with a range of more than one
    turn starts on the turn that keeps it farthest from its limits.

    Args:
        workcell: the workcell.
        arm: index of the arm, 0 or 1.
        model: model of the arm.
        search: the functions of the search; None for the interpreted functions, without clearance.
    """
    robot, contact = workcell.robots[arm], workcell.contacts[arm]
    search = search or interpreted_search(workcell, arm, model)
    task = workcell.task
    extended = search.poses(extended_waypoints(task, initial_decision(task)))
    poses = np.ascontiguousarray(extended[:, :POSE_SIZE])
    target = start_flange(workcell, robot, contact)
    start = {joint: float(extended[0, place]) for joint, place in model.redundant}
    known = target, robot.position_lower, robot.position_upper, np.array(list(start.values()))
    key = b"".join(values.tobytes() for values in known)
    if key not in search.found:
        search.found[key] = inverse_kinematics(
            robot, model, target, redundant=start, approach=search.approach
        )
    starts = search.found[key]
    tracked = search.follow(starts, extended) if len(starts) else {}
    branches = []
    for k, q in enumerate(starts):
        result = {name: values[k] for name, values in tracked.items()}
        tracked_path = result["q"]
        turns = _central_turns(robot, model, tracked_path.min(axis=0), tracked_path.max(axis=0))
        # A path that leaves the limits may pull the start out of them, where the search found it.
        inside = (q + turns >= robot.position_lower) & (q + turns <= robot.position_upper)
        turns = np.where(inside, turns, 0.0)
        path = np.ascontiguousarray(tracked_path + turns)
        to_limits = np.minimum(path - robot.position_lower, robot.position_upper - path)
        margin, measure = to_limits.min(axis=1), result["manipulability"]
        good = (result["lost"] == 0.0) & (margin >= 0.0) & (measure >= robot.min_manipulability)
        kept = int(np.argmin(good)) if not good.all() else len(poses)
        span = slice(0, max(kept, 1))
        clear = search.clearance(poses[span], path[span]) if search.clearance else float("inf")
        branches.append(
            StartBranch(
                q=q + turns,
                kept=kept,
                clearance=clear,
                limit_margin=float(margin[span].min()),
                manipulability=float(measure[span].min()),
                path=path,
            )
        )
    return tuple(sorted(branches, key=lambda branch: branch.rank))


def start_flange(workcell: Workcell, robot: Robot, contact: Contact) -> Array:
    """Compute the flange pose in the robot's root, T_root_flange (4, 4), at which the robot holds
    the box at the first waypoint.

    Args:
        workcell: the cell.
        robot: the robot.
        contact: the robot's contact with the box.
    """
    start = workcell.task.waypoints[0].lower
    T_world_box = box_placement(workcell.task.orientation, start)
    return inverse(robot.T_world_base) @ T_world_box @ box_flange(robot, contact)
