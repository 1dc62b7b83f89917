"""Possible bases of two robots: poses beside the carry, ranked by how well the arms follow the
carry from them, and by the number of detours around obstacles that both arms can follow.

Heights of bases are those of the file, or zero: the user builds the stands of the robots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.extras.proposing.holding import Hold, HoldQuery, find_holds
from hybrid_opt.extras.proposing.kinematics import ArmKinematics, shoulder_positions
from hybrid_opt.extras.proposing.problem import Problem
from hybrid_opt.extras.proposing.redundancy import redundancy
from hybrid_opt.extras.proposing.trial import PayloadSceneChecker
from symbolic.array import Array
from symbolic.geometry.bodies import WORLD, MeshReader, collision_bodies, shape_pieces
from symbolic.geometry.pieces import Piece
from symbolic.geometry.separation import coal_distance
from symbolic.read.cell import stretched_length
from symbolic.read.editing import merged
from symbolic.records import Cylinder, Workcell
from symbolic.records.poses import box_placement, inverse, pose_matrix, transform

DISTANCES = (0.35, 0.45, 0.55, 0.65, 0.75)
"""Lateral distances of a base from the middle of its contact's path, in lengths of the stretched
arm."""

MACHINE_DISTANCES = (0.28, 0.34, 0.40, 0.46, 0.52)
"""Distances of the line through a machine's shoulders from the middle of the carry, in lengths of
the stretched arm."""

BASE_SHIFTS = (0.0, -0.2, 0.2)
"""Shifts of a base along the carry, in lengths of the stretched arm."""

BEHIND = 0.05
"""A machine's arms count as reaching ahead if their mean reach over random postures exceeds this
share of the stretched arm."""

REACH_MEAN_POSTURES = 500
"""Number of random postures in this mean."""

MOST_CHOICES = 6
"""Largest number of pairs of bases that are returned."""

BASE_STARTS = 192
"""Number of random postures from which a base is evaluated."""

EVERY_SPIN = 2
"""Every so many spins of the pads are tried when a base is evaluated."""

GUIDES_TRIED = 2
"""Number of guides that are tried when a base is evaluated."""

FOOT = Cylinder(0.12, 0.20)
"""Foot on the ground at a base, which may not touch anything else [m]."""

ROOMY = 4.0
"""Score of a pair of bases if both arms follow the box along all detours."""

ABOVE = 0.02
"""Height above its floor at which a robot is checked for collisions [m]."""

HIDDEN = 2.0
"""Cost if a body of the environment is between a shoulder and its contact."""

ARM_RADIUS = 0.05
"""Radius of the arm that has to fit between shoulder and contact [m]."""

LIFT_HEIGHT = 0.03
"""Height by which the box is lifted from its support, and lowered in the end, on a detour [m]."""

ASIDE = (0.15, 0.25, 0.40)
"""Distances of a detour from the straight line, level in eight directions or upwards [m]."""

POSES = 33
"""Number of poses along a detour."""


def base_choices(problem: Problem, spins: Array, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Propose bases for both robots, the most promising pair first.

    Both arms of a two-armed machine get the same base.

    Args:
        problem: the problem.
        spins: (n,) rotations of the pads about their normals that are tried [rad].
        rng: generator of random postures.

    Returns:
        For each pair of bases the additions to the problem file that state it: new keys and values
        by name of the table, `robots` or `contacts`.
    """
    found: list[tuple[float, dict[str, Any]]] = []
    for side in problem.sides():
        found += _scored(side, spins, rng)
    found.sort(key=lambda item: -item[0])
    return [choice for _, choice in found[:MOST_CHOICES]]


def _scored(
    problem: Problem, spins: Array, rng: np.random.Generator
) -> list[tuple[float, dict[str, Any]]]:
    """Propose bases for both robots, with the positions of the pads on the box kept fixed.

    Args:
        problem: the problem, with contacts.
        spins: (n,) rotations of the pads about their normals that are tried [rad].
        rng: generator of random postures.

    Returns:
        For each proposal its score (larger is better), and the additions to the problem file that
        state the bases: new keys and values by name of the table.
    """
    draft = draft_of(problem)
    scorer = BaseScorer(problem, draft, spins, rng)
    if problem.is_machine:
        found = []
        for base in machine_bases(problem, draft):
            first = scorer.rank(0, base)
            second = None if first is None else scorer.rank(1, base)
            if first is not None and second is not None:
                value = min(first.value, second.value) + shared_room(first, second)
                found.append((value, _standing(problem, [base] * 2)))
        return found
    best: list[list[RankedBase]] = []
    for arm in (0, 1):
        tried = [scorer.rank(arm, base) for base in _tried_bases(problem, draft, arm)]
        ranked = [each for each in tried if each is not None]
        ranked.sort(key=lambda each: -each.value)
        best.append(ranked[:3])
    return [
        (
            first.value + second.value + shared_room(first, second),
            _standing(problem, [first.base, second.base]),
        )
        for first, second in product(*best)
    ]


def draft_of(problem: Problem) -> Workcell:
    """Build a provisional workcell of a problem whose bases are still to be found: the search for
    bases needs its arms, payload and obstacles.

    Each robot stands 0.4 m from the mean of its contact's positions at start and goal, away from
    the carry, and faces the carry. Both arms of a two-armed machine get the mean of these two
    bases. The redundant joints of arms with more than six joints are those of the file, or are
    chosen.

    Args:
        problem: the problem, with contacts.
    """
    sides = [_sideways(problem, arm) for arm in (0, 1)]
    near = [_base(problem, k, at + 0.4 * out, out) for k, (at, out) in enumerate(sides)]
    if problem.is_machine:
        near = [(near[0] + near[1]) / 2.0] * 2
    given = _standing(problem, near)
    return problem.workcell(merged(given, redundancy(problem, problem.workcell(given))))


def _standing(problem: Problem, bases: list[Array]) -> dict[str, Any]:
    robots = [
        {"base": {"xyz": np.round(base[:3], 4).tolist(), "rpy": np.round(base[3:], 6).tolist()}}
        for base in bases
    ]
    return {"contacts": problem.contacts, "robots": robots}


def _sideways(problem: Problem, arm: int) -> tuple[Array, Array]:
    """Compute the middle position of a robot's contact, and in which direction it is from the
    carry.

    Args:
        problem: the problem.
        arm: index of the robot.

    Returns:
        Mean (3,) of the contact's positions at start and goal in the world [m]; and the horizontal
        unit vector (3,) that points from the middle of the box's path to this mean.
    """
    point = np.append(np.array(problem.contacts[arm]["xyz"], dtype=float), 1.0)
    ends = [(box_placement(problem.orientation, pose) @ point)[:3] for pose in problem.poses]
    middle = (ends[0] + ends[1]) / 2.0
    centre = (problem.poses[0][:3] + problem.poses[1][:3]) / 2.0
    outwards = (middle - centre) * [1.0, 1.0, 0.0]
    length = float(np.linalg.norm(outwards))
    return middle, outwards / length if length > 1e-9 else np.array([0.0, 1.0 - 2.0 * arm, 0.0])


def _base(problem: Problem, arm: int, point: Array, outwards: Array) -> Array:
    """Compute the base pose (6,) [m, rad] of a robot that stands below a point and faces the carry.

    The height is the one in the problem file, else 0.

    Args:
        problem: the problem.
        arm: index of the robot.
        point: (3,) position in the world, of which x and y are used [m].
        outwards: (3,) horizontal direction from the carry to the robot; the robot faces the
            opposite way.
    """
    given = problem.data["robots"][arm].get("base", {}).get("xyz", [0.0, 0.0, 0.0])
    yaw = float(np.arctan2(-outwards[1], -outwards[0]))
    return np.array([point[0], point[1], float(given[2]), 0.0, 0.0, yaw])


def _tried_bases(problem: Problem, draft: Workcell, arm: int) -> list[Array]:
    middle, outwards = _sideways(problem, arm)
    _, length = stretched_length(draft.robots[arm])
    along = np.cross(outwards, [0.0, 0.0, 1.0])
    return [
        _base(problem, arm, middle + length * (away * outwards + shift * along), outwards)
        for away, shift in product(DISTANCES, BASE_SHIFTS)
    ]


def machine_bases(problem: Problem, draft: Workcell) -> list[Array]:
    """Propose base poses (6,) [m, rad] of a machine with two arms, from which the arms reach the
    carry.

    The line through the machine's shoulders is parallel to the line through both contacts.

    Args:
        problem: the problem, with contacts.
        draft: cell of the problem with a provisional base.
    """
    own = inverse(draft.robots[0].T_world_base)
    at = [(own @ np.append(point, 1.0))[:3] for point in shoulder_positions(draft.robots)]
    middle, outwards = _sideways(problem, 0)
    middle = (middle + _sideways(problem, 1)[0]) / 2.0
    across = at[0] - at[1]
    yaw = float(np.arctan2(outwards[1], outwards[0]) - np.arctan2(across[1], across[0]))
    R = pose_matrix(np.zeros(3), np.array([0.0, 0.0, yaw]))[:3, :3]
    ahead = np.cross(outwards, [0.0, 0.0, 1.0])
    length = min(stretched_length(robot)[1] for robot in draft.robots)
    height = float(problem.data["robots"][0].get("base", {}).get("xyz", [0.0, 0.0, 0.0])[2])
    towards = float(ahead @ R @ _mean_reach(draft, at))
    found = []
    for away, side in product(MACHINE_DISTANCES, (1.0, -1.0)):
        if side * towards < -BEHIND * length:
            continue
        point = middle - side * away * length * ahead - R @ (at[0] + at[1]) / 2.0
        found.append(np.array([point[0], point[1], height, 0.0, 0.0, yaw]))
    return found


def _mean_reach(draft: Workcell, at: list[Array]) -> Array:
    """Compute the mean vector from a machine's shoulders to the last joints of its arms, over
    random postures of both arms.

    Args:
        draft: the cell.
        at: position (3,) of each shoulder in the base frame [m].

    Returns:
        (3,) in the base frame [m].
    """
    rng, reaches = np.random.default_rng(0), []
    for arm in (0, 1):
        kinematics = ArmKinematics(draft, arm)
        T, _ = kinematics.pose_and_jacobian(kinematics.drawn(REACH_MEAN_POSTURES, rng))
        own = inverse(draft.robots[arm].T_world_base)
        reaches.append((own @ T.mean(axis=0)[:, 3])[:3] - at[arm])
    return np.asarray((reaches[0] + reaches[1]) / 2.0)


@dataclass(frozen=True, eq=False)
class RankedBase:
    """A base pose of one robot, with a score and the box paths that its arm can follow from there.

    Attributes:
        base: (6,) pose of the base in the world [m, rad].
        value: score; larger is better.
        follows: (k,) True for each of the k box paths of `BaseScorer` along which the arm can hold
            the box.
    """

    base: Array
    value: float
    follows: NDArray[np.bool_]


class BaseScorer:
    """Evaluator of base poses of robots, for given contacts."""

    def __init__(
        self, problem: Problem, draft: Workcell, spins: Array, rng: np.random.Generator
    ) -> None:
        """Prepare both arms, and the paths of the box that they should be able to follow.

        Args:
            problem: the problem, with contacts.
            draft: cell of the problem with provisional bases and chosen redundant joints.
            spins: (n,) rotations of the pads about their normals that are tried [rad].
            rng: generator of random postures.
        """
        self._problem, self._draft, self._rng = problem, draft, rng
        start, goal = problem.poses
        self._detours = free_detours(draft, start, goal)
        own = [inverse(robot.T_world_base) for robot in draft.robots]
        at = zip(own, shoulder_positions(draft.robots), strict=True)
        self._shoulders = [(T @ np.append(point, 1.0))[:3] for T, point in at]
        self._arms = [ArmKinematics(draft, arm) for arm in (0, 1)]
        self._query = HoldQuery(start, goal, spins[::EVERY_SPIN], None, BASE_STARTS, GUIDES_TRIED)
        meshes = MeshReader()
        self._environment = [
            shape_pieces(body.shape, body.pose, body.name, meshes) for body in draft.environment
        ]
        self._feet = [_feet(draft, arm) for arm in (0, 1)]

    def rank(self, arm: int, base: Array) -> RankedBase | None:
        """Evaluate a base of an arm. Return None if the robot collides there, or if the arm cannot
        hold the box from start to goal.

        Args:
            arm: index of the arm.
            base: (6,) pose of the base in the world [m, rad].
        """
        if not self._stands_free(arm, base):
            return None
        T = pose_matrix(base[:3], base[3:])
        kinematics = self._arms[arm].moved(T)
        holds = find_holds(self._query, kinematics, self._rng).holds
        if not holds:
            return None
        hidden = self._hidden(arm, (T @ np.append(self._shoulders[arm], 1.0))[:3])
        value = holds[0].score + 0.05 * len(holds) - HIDDEN * hidden
        return RankedBase(base, value, self._followed(kinematics, holds))

    def _stands_free(self, arm: int, base: Array) -> bool:
        """Return True if a robot's foot and fixed bodies touch no body of the environment.

        A floor below the base does not count.

        Args:
            arm: index of the robot.
            base: (6,) pose of its base in the world [m, rad].
        """
        T = pose_matrix(base[:3] + np.array([0.0, 0.0, ABOVE]), base[3:])
        feet = tuple(piece.moved(T) for piece in self._feet[arm])
        return all(coal_distance(feet, pieces) > 0.0 for pieces in self._environment)

    def _followed(self, kinematics: ArmKinematics, holds: Sequence[Hold]) -> NDArray[np.bool_]:
        """Find which box paths of this scorer an arm can follow while its redundant joints stay
        fixed.

        Args:
            kinematics: the arm.
            holds: pad rotations with postures of the arm at start and goal; a path counts as
                followed if one of them works.

        Returns:
            (k,) True for the paths that the arm can follow.
        """
        robot = self._draft.robots[kinematics.arm]
        k, m, _ = self._detours.shape
        if not k:
            return np.zeros(0, dtype=bool)
        T_world_box = box_placement(self._draft.task.orientation, self._detours.reshape(k * m, -1))
        rows = [(T_world_box @ kinematics.held(hold.spin)).reshape(k, m, 4, 4) for hold in holds]
        targets = np.concatenate(rows).swapaxes(0, 1)
        q = np.repeat([hold.q_start for hold in holds], k, axis=0)
        path, kept, measure = kinematics.follow(q, targets)
        inside = (path >= kinematics.lower) & (path <= kinematics.upper)
        fine = inside.all(axis=(0, 2)) & (measure.min(axis=0) >= robot.min_manipulability)
        return np.asarray((fine & (kept == m)).reshape(len(holds), k).any(axis=0))

    def _hidden(self, arm: int, shoulder: Array) -> float:
        """Compute for which share of the two ends of the carry, 0, 0.5 or 1, a body of the
        environment stands between an arm's shoulder and its contact, seen from above.

        Args:
            arm: index of the arm.
            shoulder: (3,) position of the shoulder in the world [m].
        """
        point = np.append(np.array(self._problem.contacts[arm]["xyz"], dtype=float), 1.0)
        hit = 0
        for pose in self._problem.poses:
            T_world_box = box_placement(self._problem.orientation, pose)
            there = (T_world_box @ point)[:3]
            aside = there - T_world_box[:3, 3]
            there = there + 2.0 * ARM_RADIUS * aside / max(float(np.linalg.norm(aside)), 1e-9)
            line = (shoulder - there) * [1.0, 1.0, 0.0]
            length = float(np.linalg.norm(line))
            if length < ARM_RADIUS:
                continue
            # The cylinder's axis along the line.
            turn = pose_matrix(np.zeros(3), [0.0, np.pi / 2.0, np.arctan2(line[1], line[0])])
            way = Piece(Cylinder(ARM_RADIUS, length), transform(turn[:3, :3], there + line / 2.0))
            hit += any(coal_distance((way,), pieces) <= 0.0 for pieces in self._environment)
        return hit / 2.0


def _feet(draft: Workcell, arm: int) -> tuple[Piece, ...]:
    """Return the solids that stand where a robot stands, in its base frame: a cylinder as its foot,
    and the bodies of the robot that do not move.

    Those of a machine with two arms belong to its first arm.

    Args:
        draft: the cell.
        arm: index of the robot.
    """
    robot = draft.robots[arm]
    own = inverse(robot.T_world_base)
    standing = [
        piece.moved(own)
        for body in collision_bodies(draft)
        if body.frame == WORLD and body.name.startswith(f"{robot.name}/")
        for piece in body.pieces
    ]
    return (Piece(FOOT, pose_matrix([0.0, 0.0, FOOT.length / 2.0], np.zeros(3))), *standing)


def shared_room(first: RankedBase, second: RankedBase) -> float:
    """Score two bases by the share of the tried box paths along which both arms can hold the box.

    Args:
        first: a base of the first robot.
        second: a base of the second robot.

    Returns:
        The share times the weight `ROOMY`; larger is better.
    """
    both = first.follows & second.follows
    return ROOMY * float(both.mean()) if len(both) else 0.0


def free_detours(workcell: Workcell, start: Array, goal: Array) -> Array:
    """Compute collision-free paths of the box that are not straight.

    On each path the box is lifted, moved to a side, moved along, moved back and lowered.

    Args:
        workcell: the cell.
        start, goal: (6,) box poses [m, rad].

    Returns:
        (k, POSES, 6) box poses of k paths [m, rad]; k may be 0.
    """
    angles = np.arange(8) * np.pi / 4.0
    ways = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(8)])
    ways = np.vstack([ways, [0.0, 0.0, 1.0]])
    found = [_detour(start, goal, away * way) for away in ASIDE for way in ways]
    straight = _detour(start, goal, np.zeros(3))
    box = PayloadSceneChecker(workcell)

    def free(path: Array) -> bool:
        lifts = (
            np.minimum(abs(path - path[0]).max(axis=1), abs(path - path[-1]).max(axis=1))
            < LIFT_HEIGHT
        )
        return not box.meets(path[~lifts])

    return np.array([path for path in (straight, *found) if free(path)]).reshape(-1, POSES, 6)


def _detour(start: Array, goal: Array, aside: Array) -> Array:
    lift = np.array([0.0, 0.0, LIFT_HEIGHT, 0.0, 0.0, 0.0])
    beside = np.append(aside, np.zeros(3))
    corners = [start, start + lift, start + lift + beside]
    corners += [end + lift + beside * far for end, far in ((goal, 1.0), (goal, 0.0))] + [goal]
    points = np.array(corners)
    length = np.linalg.norm(np.diff(points[:, :3], axis=0), axis=1)
    length[2] = max(length[2], 1e-3)  # a turn on the spot takes place there
    along = np.concatenate([[0.0], np.cumsum(np.maximum(length, 1e-9))])
    at = np.linspace(0.0, along[-1], POSES)
    return np.column_stack([np.interp(at, along, points[:, k]) for k in range(6)])
