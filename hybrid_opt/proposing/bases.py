"""Where two robots may stand: places beside the carry, compared by how well the arms follow it.

Heights are those of the file, or the world's zero: what a robot stands on is built by people.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from hybrid_opt.proposing.document import merged
from hybrid_opt.proposing.kinematics import ArmKinematics, shoulders
from hybrid_opt.proposing.places import Place, PlaceScorer, shared_room
from hybrid_opt.proposing.problem import Problem
from hybrid_opt.proposing.setup import redundancy
from symbolic.array import Array
from symbolic.read.checks import stretched_length
from symbolic.records import Workcell
from symbolic.records.poses import box_placement, inverse, pose_matrix

DISTANCES = (0.35, 0.45, 0.55, 0.65, 0.75)
"""Of a base from the middle of its contact's way, sideways, in the stretched arm's length."""

MACHINE_DISTANCES = (0.28, 0.34, 0.40, 0.46, 0.52)
"""The same of the line through a machine's shoulders, from the middle of the carry."""

SHIFTS = (0.0, -0.2, 0.2)
"""Of a base along the carry, likewise."""

BEHIND = 0.05
"""A machine's arms reach ahead if they do so by this much in the mean of their postures, in the
stretched arm's length."""

POSTURES = 500
"""Of that mean."""

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
    draft = draft_of(problem)
    scorer = PlaceScorer(problem, draft, spins, rng)
    if problem.is_machine:
        found = []
        for base in machine_places(problem, draft):
            first = scorer.place(0, base)
            second = None if first is None else scorer.place(1, base)
            if first is not None and second is not None:
                value = min(first.value, second.value) + shared_room(first, second)
                found.append((value, _standing(problem, [base] * 2)))
        return found
    best: list[list[Place]] = []
    for arm in (0, 1):
        tried = [scorer.place(arm, base) for base in _places(problem, draft, arm)]
        places = [place for place in tried if place is not None]
        places.sort(key=lambda place: -place.value)
        best.append(places[:3])
    return [
        (
            first.value + second.value + shared_room(first, second),
            _standing(problem, [first.base, second.base]),
        )
        for first, second in product(*best)
    ]


def draft_of(problem: Problem) -> Workcell:
    """The cell, its robots somewhere, its redundant joints chosen."""
    near = [_near(problem, arm) for arm in (0, 1)]
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


def machine_places(problem: Problem, draft: Workcell) -> list[Array]:
    """Bases (6,) of a machine with both arms: the line through its shoulders as the line through
    both contacts, the carry where its arms reach."""
    own = inverse(draft.robots[0].T_world_base)
    at = [(own @ np.append(point, 1.0))[:3] for point in shoulders(draft)]
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
    """(3,) from a machine's shoulders to where its arms' last joints are, in the mean of random
    postures of both, in the base frame [m]."""
    rng, reaches = np.random.default_rng(0), []
    for arm in (0, 1):
        kinematics = ArmKinematics.of(draft, arm, ())
        low, high = np.maximum(kinematics.lower, -np.pi), np.minimum(kinematics.upper, np.pi)
        _, T = kinematics.chain(rng.uniform(low, high, (POSTURES, len(low))))
        own = inverse(draft.robots[arm].T_world_base)
        reaches.append((own @ T.mean(axis=0)[:, 3])[:3] - at[arm])
    return np.asarray((reaches[0] + reaches[1]) / 2.0)
