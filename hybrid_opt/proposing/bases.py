"""Where two robots may stand: places beside the carry, compared by how well the arms follow it.

Heights are those of the file, or the world's zero: what a robot stands on is built by people.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from hybrid_opt.proposing.holding import HoldQuery, find_holds
from hybrid_opt.proposing.kinematics import ArmKinematics, shoulders
from hybrid_opt.proposing.problem import Problem
from symbolic.array import Array
from symbolic.geometry.coal_shapes import coal_distance
from symbolic.geometry.pieces import Piece
from symbolic.geometry.shape_reader import MeshReader, shape_pieces
from symbolic.physics.pose import box_placement, inverse, pose_matrix, transform
from symbolic.workcell.checks import stretched_length
from symbolic.workcell.records import Cylinder, Workcell

DISTANCES = (0.35, 0.45, 0.55, 0.65, 0.75)
"""Of a base from the middle of its contact's way, sideways, in the stretched arm's length."""

MACHINE_DISTANCES = (0.28, 0.34, 0.40, 0.46, 0.52)
"""The same of the line through a machine's shoulders, from the middle of the carry."""

SHIFTS = (0.0, -0.2, 0.2)
"""Of a base along the carry, likewise."""

STARTS = 192
"""Random postures by which a place is judged."""

GUIDES_TRIED = 2
"""Guides by which it is judged."""

FOOT = Cylinder(0.12, 0.20)
"""What stands on the ground at a base and may touch nothing else [m]."""

LOST = -100.0
"""The score of a place from which an arm does not follow the box."""

HIDDEN = 2.0
"""What it costs if something stands between a shoulder and its contact."""

ARM_RADIUS = 0.05
"""Of what has to find room between them [m]."""

MOST_CHOICES = 6
"""Pairs of bases that are handed on."""


def base_choices(problem: Problem, spins: Array, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Additions to a problem's tables that give both robots a base, the best first; both the same
    where they are arms of one machine.

    Args:
        spins: of both pads that are tried [rad].
    """
    found: list[tuple[float, dict[str, Any]]] = []
    for side in problem.sides():
        found += _scored(side, spins, rng)
    found.sort(key=lambda item: -item[0])
    return [choice for _, choice in found[:MOST_CHOICES]]


def _scored(
    problem: Problem, spins: Array, rng: np.random.Generator
) -> list[tuple[float, dict[str, Any]]]:
    """Such additions with their scores, for given contacts."""
    near = [_near(problem, arm) for arm in (0, 1)]
    if problem.is_machine:
        near = [(near[0] + near[1]) / 2.0] * 2
    draft = problem.workcell(_standing(problem, near))
    start, goal = problem.poses
    query = HoldQuery(draft, start, goal, spins, None, STARTS, GUIDES_TRIED)
    arms = []
    for arm in (0, 1):
        redundant = tuple(joint for joint, _ in draft.task.redundant_of(arm))
        arms.append(ArmKinematics.of(draft, arm, redundant))

    own = [inverse(robot.T_world_base) for robot in draft.robots]
    at = [(T @ np.append(p, 1.0))[:3] for T, p in zip(own, shoulders(draft), strict=True)]

    def score(arm: int, base: Array) -> float:
        """How well an arm follows the box from a base, below zero where it does not."""
        T = pose_matrix(base[:3], base[3:])
        holds = find_holds(query, arm, arms[arm].moved(T), rng).holds
        if not holds:
            return LOST
        hidden = _hidden(problem, draft, arm, (T @ np.append(at[arm], 1.0))[:3])
        return holds[0].score + 0.05 * len(holds) - HIDDEN * hidden

    if problem.is_machine:
        places = [base for base in _machine_places(problem, draft, at) if _stands_free(draft, base)]
        both = [(min(score(arm, base) for arm in (0, 1)), base) for base in places]
        return [(value, _standing(problem, [base] * 2)) for value, base in both if value > LOST]
    found: list[list[tuple[float, Array]]] = []
    for arm in (0, 1):
        places = [base for base in _places(problem, draft, arm) if _stands_free(draft, base)]
        scored = [(score(arm, base), base) for base in places]
        scored.sort(key=lambda item: -item[0])
        found.append([item for item in scored[:3] if item[0] > LOST])
    return [
        (first[0] + second[0], _standing(problem, [first[1], second[1]]))
        for first, second in product(*found)
    ]


def _standing(problem: Problem, bases: list[Array]) -> dict[str, Any]:
    robots = [
        {"base": {"xyz": np.round(base[:3], 4).tolist(), "rpy": np.round(base[3:], 6).tolist()}}
        for base in bases
    ]
    return {"contacts": problem.contacts, "robots": robots}


def _sideways(problem: Problem, arm: int) -> tuple[Array, Array]:
    """The middle (3,) of the way of a robot's contact and the direction (3,) outwards from it."""
    point = np.append(np.array(problem.contacts[arm]["xyz"], dtype=float), 1.0)
    ends = [(box_placement(problem.orientation, pose) @ point)[:3] for pose in problem.poses]
    middle = (ends[0] + ends[1]) / 2.0
    centre = (problem.poses[0][:3] + problem.poses[1][:3]) / 2.0
    outwards = (middle - centre) * [1.0, 1.0, 0.0]
    length = float(np.linalg.norm(outwards))
    return middle, outwards / length if length > 1e-9 else np.array([0.0, 1.0 - 2.0 * arm, 0.0])


def _near(problem: Problem, arm: int) -> Array:
    middle, outwards = _sideways(problem, arm)
    return _base(problem, arm, middle + 0.4 * outwards, outwards)


def _base(problem: Problem, arm: int, point: Array, outwards: Array) -> Array:
    """(6,) on the ground below a point, looking at the carry."""
    given = problem.data["robots"][arm].get("base", {}).get("xyz", [0.0, 0.0, 0.0])
    yaw = float(np.arctan2(-outwards[1], -outwards[0]))
    return np.array([point[0], point[1], float(given[2]), 0.0, 0.0, yaw])


def _places(problem: Problem, draft: Workcell, arm: int) -> list[Array]:
    middle, outwards = _sideways(problem, arm)
    _, length = stretched_length(draft.robots[arm])
    along = np.cross(outwards, [0.0, 0.0, 1.0])
    return [
        _base(problem, arm, middle + length * (away * outwards + shift * along), outwards)
        for away, shift in product(DISTANCES, SHIFTS)
    ]


def _machine_places(problem: Problem, draft: Workcell, at: list[Array]) -> list[Array]:
    """Bases (6,) of a machine with both arms: the line through its shoulders as the line through
    both contacts, in front of the carry or behind it.

    Args:
        at: (3,) of both shoulders in the base frame [m].
    """
    middle, outwards = _sideways(problem, 0)
    middle = (middle + _sideways(problem, 1)[0]) / 2.0
    across = at[0] - at[1]
    yaw = float(np.arctan2(outwards[1], outwards[0]) - np.arctan2(across[1], across[0]))
    R = pose_matrix(np.zeros(3), np.array([0.0, 0.0, yaw]))[:3, :3]
    ahead = np.cross(outwards, [0.0, 0.0, 1.0])
    length = min(stretched_length(robot)[1] for robot in draft.robots)
    height = float(problem.data["robots"][0].get("base", {}).get("xyz", [0.0, 0.0, 0.0])[2])
    found = []
    for away, side in product(MACHINE_DISTANCES, (1.0, -1.0)):
        point = middle - side * away * length * ahead - R @ (at[0] + at[1]) / 2.0
        found.append(np.array([point[0], point[1], height, 0.0, 0.0, yaw]))
    return found


def _hidden(problem: Problem, workcell: Workcell, arm: int, shoulder: Array) -> float:
    """Share of start and goal at which the environment stands between a shoulder (3,) and the
    robot's contact, looked at level."""
    point = np.append(np.array(problem.contacts[arm]["xyz"], dtype=float), 1.0)
    meshes = MeshReader()
    hit = 0
    for pose in problem.poses:
        T_world_box = box_placement(problem.orientation, pose)
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
        hit += any(
            coal_distance((way,), shape_pieces(body.shape, body.pose, body.name, meshes)) <= 0.0
            for body in workcell.environment
        )
    return hit / 2.0


def _stands_free(workcell: Workcell, base: Array) -> bool:
    """Whether nothing of the environment is where a robot's foot would be; its floor may be."""
    above = np.array([0.0, 0.0, FOOT.length / 2.0 + 0.02])
    foot = (Piece(FOOT, pose_matrix(base[:3] + above, np.zeros(3))),)
    meshes = MeshReader()
    return all(
        coal_distance(foot, shape_pieces(body.shape, body.pose, body.name, meshes)) > 0.0
        for body in workcell.environment
    )
