"""A collision-free path of the box with both arms, over the closed chain.

First of straight motions alone: out of the start, over, into the goal. Where none is free,
RRT-Connect of OMPL (Kuffner and LaValle, ICRA 2000) looks among all poses, from everything that
straight motions out of start and goal lead to. Both move in the coordinates of the box path, which
the spline joins later too, not in those of the joints: both arms' joints follow, branch and all,
and are kept beside every pose that was reached. It is the only module that needs OMPL.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any

import numpy as np

from hybrid_opt.proposing.closed_chain import ClosedChain, Place, distance, levers, straight
from hybrid_opt.proposing.judge import BoxAlone
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import POSE_SIZE

RETREAT = 0.6
"""Longest straight motion out of the start, or the goal, that is tried [m]."""

SHORT_RETREAT = 0.06
"""Shortest one that is of use [m]."""

RETREAT_STOPS = 4
"""Every so many configurations of a retreat the box may turn to the other end's."""

STRAIGHT_TRIED = 100
"""Straight motions of the box between two retreats that are tried with the arms."""

BETWEEN = np.array([0.5, 0.25, 0.75, 0.375, 0.625, 0.125, 0.875])
"""Where on them the box alone is looked at first."""

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


Retreats = tuple[list[list[Place]], list[list[Place]]]
"""From the start and from the goal, along the same directions: free configurations one after the
other, the end itself first."""


def retreats(chain: ClosedChain, ends: tuple[Place, Place]) -> Retreats:
    """Where straight motions out of start and goal lead, along the world's axes and between them:
    out of a shelf, for instance."""
    signs = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
    found: Retreats = ([], [])
    for way in signs[np.any(signs != 0.0, axis=1)]:
        for end, place in enumerate(ends):
            away = place.extended.copy()
            away[:3] += RETREAT * way / np.linalg.norm(way)
            path = straight(place.extended, away)
            found[end].append([place, *chain.along(place, path[1:])])
    return found


def straight_path(chain: ClosedChain, out: Retreats, box: BoxAlone) -> list[Place] | None:
    """Corners of the shortest free path found of a retreat, a straight motion, and the opposite of
    a retreat along the same direction; None if none is free."""
    ways: dict[tuple[bytes, bytes], tuple[float, list[Place]]] = {}
    for first, last in zip(*out, strict=True):
        for a, b in product(first[::RETREAT_STOPS], last[::RETREAT_STOPS]):
            corners = [first[0], a, b, last[0]]
            length = sum(distance(p.extended, q.extended) for p, q in pairwise(corners))
            ways[a.extended.tobytes(), b.extended.tobytes()] = length, corners
    tried = 0
    for _, corners in sorted(ways.values(), key=lambda way: way[0]):
        begin, end = corners[1].extended, corners[2].extended
        if box.meets((begin + BETWEEN[:, None] * (end - begin))[:, :POSE_SIZE]):
            continue
        there = chain.reach(corners[1], end)
        if there is not None and same(there, corners[2]):
            return corners
        tried += 1
        if tried == STRAIGHT_TRIED:
            break
    return None


def plan(
    chain: ClosedChain,
    out: Retreats,
    room: Freedom,
    *,
    most: int,
    out_of_time: Callable[[], bool],
    seed: int,
) -> list[Place] | None:
    """Corners of a free path from start to goal that RRT-Connect finds, None if it finds none.

    Args:
        chain: the arms in one way of holding.
        out: where straight motions lead out of start and goal.
        room: where the path may go.
        most: configurations that may be looked at.
        out_of_time: whether to come to an end in any case.
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
    last = chain.looked + most
    ways: dict[tuple[float, ...], Place] = {}
    for ways_out, add in zip(out, (problem.addStartState, goals.addState), strict=True):
        place = ways_out[0][0]
        for stop in (place, *_usable([way[-1] for way in ways_out], place, room)):
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
    planner.solve(base.PlannerTerminationCondition(lambda: chain.looked >= last or out_of_time()))
    if not problem.hasExactSolution():
        return None
    path = problem.getSolutionPath()
    keys = [known.key(path.getState(k)) for k in range(path.getStateCount())]
    if any(key not in known.places for key in keys):
        return None
    found = [ways[keys[0]], *(known.places[key] for key in keys), ways[keys[-1]]]
    return [place for k, place in enumerate(found) if k == 0 or place is not found[k - 1]]


def _usable(stops: list[Place], place: Place, room: Freedom) -> list[Place]:
    """Those that lie apart from an end and within the room."""
    at = [room.coordinates(stop.extended) for stop in stops]
    return [
        stop
        for stop, y in zip(stops, at, strict=True)
        if distance(place.extended, stop.extended) >= SHORT_RETREAT
        and bool(np.all((y >= room.lower) & (y <= room.upper)))
    ]


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
