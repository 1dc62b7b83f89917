"""A collision-free path of the box with both arms: RRT-Connect of OMPL over the closed chain.

Kuffner and LaValle, ICRA 2000. The planner moves in the coordinates of the box path, which the
spline joins later too, not in those of the joints: both arms' joints follow, branch and all, and
are kept beside every pose that was reached. It is the only module that needs OMPL.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from hybrid_opt.proposing.closed_chain import ClosedChain, Place, distance, levers, straight
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import POSE_SIZE

RETREAT = 0.6
"""Longest straight motion out of the start, or the goal, that is tried [m]."""

SHORT_RETREAT = 0.06
"""Shortest one that is of use [m]."""

REDUNDANT_ASIDE = 5.0
"""What redundant joints may stray by, in what the box may [rad/m]."""

MATCH = 1e-3
"""Largest difference of joints of two trees that meet [rad]: both arms on the same branch."""


@dataclass(frozen=True)
class Freedom:
    """The extended poses among which a path is looked for: origin + directions @ y.

    Attributes:
        origin: (6 + m,).
        directions: (6 + m, d), so that distances of y are those of `closed_chain.distance`.
        lower, upper: (d,) bounds of y [m].
        range: longest motion that the planner's trees grow by [m].
    """

    origin: Array
    directions: Array
    lower: Array
    upper: Array
    range: float

    def extended(self, y: Array) -> Array:
        """(6 + m,) of coordinates (d,)."""
        return np.asarray(self.origin + self.directions @ y)

    def coordinates(self, extended: Array) -> Array:
        """(d,) of an extended pose."""
        return np.asarray(np.linalg.pinv(self.directions) @ (extended - self.origin))


@dataclass(frozen=True)
class Stray:
    """How far a path may stray.

    Attributes:
        tilt: how far the box may turn away from the turn between start and goal [rad]; 0: it turns
            from the one to the other and no other way.
        range: see `Freedom`.
        aside: how far the box may be beyond start and goal along each of the world's axes [m].
    """

    tilt: float
    range: float
    aside: float


def freedom(start: Array, goal: Array, stray: Stray, limits: Array) -> Freedom:
    """Where a path from start to goal may go.

    Args:
        start, goal: (6 + m,).
        stray: how far it may stray; redundant joints `REDUNDANT_ASIDE` times as far.
        limits: (m, 2) of the redundant joints [rad or m].
    """
    size, weight, tilt = len(start), levers(len(start)), stray.tilt
    aside = np.full(size, stray.aside)
    aside[POSE_SIZE:] *= REDUNDANT_ASIDE
    lower, upper = np.minimum(start, goal) - aside, np.maximum(start, goal) + aside
    lower[POSE_SIZE:] = np.maximum(lower[POSE_SIZE:], limits[:, 0])
    upper[POSE_SIZE:] = np.minimum(upper[POSE_SIZE:], limits[:, 1])
    columns, low, high = [], [], []
    turn = (goal - start) * ((np.arange(size) >= 3) & (np.arange(size) < 6))
    length = float(np.linalg.norm(weight * turn))
    for k in range(size):
        angle = 3 <= k < 6
        if angle and tilt == 0.0:
            continue
        column = np.zeros(size)
        column[k] = 1.0 / weight[k]
        least = min(start[k], goal[k]) - tilt if angle else lower[k]
        most = max(start[k], goal[k]) + tilt if angle else upper[k]
        columns.append(column)
        low.append(weight[k] * (least - start[k]))
        high.append(weight[k] * (most - start[k]))
    if tilt == 0.0 and length > 0.0:
        columns.append(turn / length)
        low.append(0.0)
        high.append(length)
    bounds = np.array(low) - 1e-9, np.array(high) + 1e-9
    return Freedom(start, np.column_stack(columns), *bounds, stray.range)


@dataclass(frozen=True)
class Budget:
    """What may be spent on a path.

    Attributes:
        places: configurations that may be looked at.
        spent: whether to come to an end in any case.
    """

    places: int
    spent: Callable[[], bool]


def plan(
    chain: ClosedChain,
    ends: tuple[Place, Place],
    room: Freedom,
    budget: Budget,
    seed: int,
) -> list[Place] | None:
    """Corners of a free path from the first configuration to the second, None if none is found.

    Args:
        chain: the arms in one way of holding.
        ends: start and goal, both free.
        room: where the path may go.
        budget: what may be spent.
        seed: of the planner's randomness, at least 1.

    Raises:
        SettingsError: OMPL is not installed.
    """
    base, geometric = _library(seed)
    space = base.RealVectorStateSpace(len(room.lower))
    bounds = base.RealVectorBounds(len(room.lower))
    for k, (low, high) in enumerate(zip(room.lower, room.upper, strict=True)):
        bounds.setLow(k, float(low))
        bounds.setHigh(k, float(high))
    space.setBounds(bounds)
    information = base.SpaceInformation(space)
    known = _Known(chain, room)
    information.setStateValidityChecker(lambda state: True)
    validator = _validator(base, information, known.joined)
    information.setMotionValidator(validator)
    information.setup()
    problem = base.ProblemDefinition(information)
    goals = base.GoalStates(information)
    last = chain.looked + budget.places
    ways: dict[tuple[float, ...], Place] = {}
    for place, add in zip(ends, (problem.addStartState, goals.addState), strict=True):
        for stop in (place, *retreats(chain, place, room)):
            state = space.allocState()
            for k, value in enumerate(room.coordinates(stop.extended)):
                state[k] = float(value)
            key = known.key(state)
            known.places[key], ways[key] = stop, place
            add(state)
    problem.setGoal(goals)
    planner = geometric.RRTConnect(information)
    planner.setRange(room.range)
    planner.setProblemDefinition(problem)
    planner.setup()
    planner.solve(base.PlannerTerminationCondition(lambda: chain.looked >= last or budget.spent()))
    if not problem.hasExactSolution():
        return None
    path = problem.getSolutionPath()
    keys = [known.key(path.getState(k)) for k in range(path.getStateCount())]
    if any(key not in known.places for key in keys):
        return None
    found = [ways[keys[0]], *(known.places[key] for key in keys), ways[keys[-1]]]
    return [place for k, place in enumerate(found) if k == 0 or place is not found[k - 1]]


def retreats(chain: ClosedChain, place: Place, room: Freedom) -> list[Place]:
    """Where straight motions out of a configuration lead, along the world's axes and between them:
    out of a shelf, for instance."""
    found = []
    signs = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
    for way in signs[np.any(signs != 0.0, axis=1)]:
        goal = place.extended.copy()
        goal[:3] += RETREAT * way / np.linalg.norm(way)
        path = straight(place.extended, goal)
        last = [place, *chain.along(place, path[1:])][-1]
        inside = room.coordinates(last.extended)
        if distance(place.extended, last.extended) >= SHORT_RETREAT and bool(
            np.all((inside >= room.lower) & (inside <= room.upper))
        ):
            found.append(last)
    return found


class _Known:
    """The configurations of all states that the planner has reached."""

    def __init__(self, chain: ClosedChain, room: Freedom) -> None:
        self.chain, self.room = chain, room
        self.places: dict[tuple[float, ...], Place] = {}

    def key(self, state: Any) -> tuple[float, ...]:
        return tuple(state[k] for k in range(len(self.room.lower)))

    def joined(self, first: Any, second: Any) -> bool:
        """Whether a straight motion between two states is free, one of them known."""
        keys = self.key(first), self.key(second)
        if keys[0] not in self.places:
            keys = keys[1], keys[0]
        begin = self.places.get(keys[0])
        if begin is None:
            return False
        found = self.chain.reach(begin, self.room.extended(np.array(keys[1])))
        if found is None:
            return False
        there = self.places.setdefault(keys[1], found)
        return same(there, found)


def same(first: Place, second: Place) -> bool:
    """Whether both arms stand on the same branches and turns."""
    apart = [np.abs(a - b).max() for a, b in zip(first.q, second.q, strict=True)]
    return bool(max(apart) < MATCH)


def _validator(base: Any, information: Any, joined: Callable[[Any, Any], bool]) -> Any:
    class Validator(base.MotionValidator):  # type: ignore[misc]
        """Asks the closed chain."""

        def checkMotion(self, first: Any, second: Any) -> bool:
            return joined(first, second)

    return Validator(information)


def _library(seed: int) -> tuple[Any, Any]:
    """OMPL's modules, its generator of seeds begun anew."""
    try:
        from ompl import base, geometric, util
    except ImportError as error:
        raise SettingsError(
            "a first path is planned by OMPL, which is not installed: "
            'pip install "dual-arm-carry[propose]"'
        ) from error
    util.setLogLevel(util.LogLevel.LOG_NONE)  # also says that seeds were drawn before
    util.RNG.setSeed(seed)
    return base, geometric
