"""Where two robots may stand: places beside the carry, compared by how well the arms follow it.

Heights are those of the file, or the world's zero: what a robot stands on is built by people.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from hybrid_opt.proposing.holding import Task, find_holds
from hybrid_opt.proposing.kinematics import ArmKinematics
from hybrid_opt.proposing.problem import Problem
from symbolic.array import Array
from symbolic.geometry.coal_shapes import coal_distance
from symbolic.geometry.pieces import Piece
from symbolic.geometry.shape_reader import MeshReader, shape_pieces
from symbolic.physics.pose import box_placement, pose_matrix
from symbolic.workcell.checks import stretched_length
from symbolic.workcell.records import Cylinder, Workcell

DISTANCES = (0.35, 0.45, 0.55, 0.65, 0.75)
"""Of a base from the middle of its contact's way, sideways, in the stretched arm's length."""

SHIFTS = (0.0, -0.2, 0.2)
"""Of a base along the carry, likewise."""

STARTS = 192
"""Random postures by which a place is judged."""

GUIDES_TRIED = 2
"""Guides by which it is judged."""

FOOT = Cylinder(0.12, 0.20)
"""What stands on the ground at a base and may touch nothing else [m]."""

MOST_CHOICES = 6
"""Pairs of bases that are handed on."""


def base_choices(problem: Problem, spins: Array, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Additions to a problem's tables that give both robots a base, the best first.

    Args:
        spins: of both pads that are tried [rad].
    """
    draft = problem.workcell(_standing(problem, [_near(problem, arm) for arm in (0, 1)]))
    start, goal = problem.poses
    task = Task(draft, start, goal, spins, None, STARTS, GUIDES_TRIED)
    found: list[list[tuple[float, Array]]] = []
    for arm in (0, 1):
        redundant = tuple(joint for joint, _ in draft.task.redundant_of(arm))
        kinematics = ArmKinematics.of(draft, arm, redundant)
        scored = []
        for base in _places(problem, draft, arm):
            if not _stands_free(draft, base):
                continue
            T = pose_matrix(base[:3], base[3:])
            holds = find_holds(task, arm, kinematics.moved(T), rng).holds
            if holds:
                scored.append((holds[0].score + 0.05 * len(holds), base))
        scored.sort(key=lambda item: -item[0])
        found.append(scored[:3])
    pairs = sorted(product(*found), key=lambda pair: -(pair[0][0] + pair[1][0]))
    return [_standing(problem, [base for _, base in pair]) for pair in pairs[:MOST_CHOICES]]


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


def _stands_free(workcell: Workcell, base: Array) -> bool:
    """Whether nothing of the environment is where a robot's foot would be; its floor may be."""
    above = np.array([0.0, 0.0, FOOT.length / 2.0 + 0.02])
    foot = (Piece(FOOT, pose_matrix(base[:3] + above, np.zeros(3))),)
    meshes = MeshReader()
    return all(
        coal_distance(foot, shape_pieces(body.shape, body.pose, body.name, meshes)) > 0.0
        for body in workcell.environment
    )
