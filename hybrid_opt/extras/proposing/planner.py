"""A collision-free path of the box with both arms, over the closed chain.

First straight motions are tried: out of the start, across, into the goal. If none is free,
RRT-Connect of OMPL (Kuffner and LaValle, ICRA 2000) searches among all poses, from every pose that
straight motions out of start and goal reach. Both move in the coordinates of the box path, which
the later spline has too, and not in joint coordinates. The joints of both arms follow and stay on
their branches; they are stored with every pose. This is the only module that needs OMPL.

The closed chain consists of both arms and the box that they hold. Its free coordinates are the box
pose and the redundant joints. The six other joints of each arm follow by Newton's method from the
pose before, so an arm never changes its branch.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations, product
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from hybrid_opt.extras.proposing.holding import LIMIT_MARGIN, Hold
from hybrid_opt.extras.proposing.kinematics import JUMP, REACHED, TRACKING_STEPS, ArmKinematics
from hybrid_opt.extras.proposing.trial import PayloadSceneChecker, PoseJudge
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import POSE_SIZE, Workcell
from symbolic.records.poses import box_placement, inverse

PATH_STEP = 0.02
"""Distance between configurations that are checked along a path [m], as `distance` measures it."""

LEVER = 0.3
"""Length that a rotation of the box by a radian counts in a distance [m]."""

REDUNDANT_LEVER = 0.2
"""Length that a motion of a redundant joint by a radian counts in a distance [m]."""

TOGETHER = 8
"""Number of configurations that are checked together."""

CHAIN_RESIDUAL = 1e-6
"""Largest pose residual of a closed chain [m, rad]."""

CHAIN_NEWTON_STEPS = 8


@dataclass(frozen=True, eq=False)
class ChainConfiguration:
    """Box pose and joint positions of both arms while both hold the box.

    Attributes:
        extended: (6 + m,) extended pose: the box pose [m, rad] followed by the m redundant joints
            [rad or m].
        q: joint positions (joints,) of each arm [rad or m].
    """

    extended: Array
    q: tuple[Array, Array]


class _Follower:
    """Numeric kinematics by Pinocchio of an arm that follows the box with a fixed pad rotation."""

    def __init__(self, many: ArmKinematics, hold: Hold, model: pin.Model) -> None:
        robot = many.workcell.robots[many.arm]
        self.name, self.model, self.many = robot.name, model, many
        self.data = self.model.createData()
        self.names = list(self.model.names)[1:]
        self.last = self.model.njoints - 1
        self.redundant = many.workcell.task.redundant_places[many.arm]
        self.T_box_joint = many.held(hold.spin)
        self.T_root_world = inverse(robot.T_world_base)
        key = f"robots[{many.arm}].min_manipulability = {robot.min_manipulability:g} m^3"
        self.singular = f"{robot.name} is near a singular posture ({key})"
        self.side = many.side(hold.q_start)
        self.lower, self.upper = many.lower + LIMIT_MARGIN, many.upper - LIMIT_MARGIN

    def close(self, T_world_box: Array, extended: Array, q: Array) -> Array | str:
        """Find the joint positions near q with which the arm holds the box.

        Args:
            T_world_box: (4, 4) pose of the box.
            extended: (6 + m,) box pose followed by m redundant joints, of which only the joints are
                used [rad or m].
            q: (joints,) joint positions at a configuration nearby [rad or m].

        Returns:
            The joint positions (joints,); or a text that says why there are none.
        """
        target = self.T_root_world @ T_world_box @ self.T_box_joint
        before, q = q, q.copy()
        for joint, place in self.redundant:
            q[joint] = extended[place]
        for _ in range(CHAIN_NEWTON_STEPS):
            pin.computeJointJacobians(self.model, self.data, q)
            here = self.data.oMi[self.last]
            turn = pin.log3(target[:3, :3] @ here.rotation.T)
            error = np.concatenate([target[:3, 3] - here.translation, turn])
            J = pin.getJointJacobian(self.model, self.data, self.last, pin.LOCAL_WORLD_ALIGNED)[
                :, self.many.following
            ]
            if error @ error < CHAIN_RESIDUAL**2:
                break
            try:
                step = np.linalg.solve(J, error)
            except np.linalg.LinAlgError:
                return self.singular
            if np.abs(step).max() > JUMP:
                return f"{self.name} does not reach"
            q[self.many.following] += step
        else:
            return f"{self.name} does not reach"
        if np.abs(q - before).max() > JUMP:
            return f"{self.name} does not reach"
        beyond = np.flatnonzero((q < self.lower) | (q > self.upper))
        if len(beyond):
            return f"{self.name}/{self.names[beyond[0]]} is at its limit"
        if self.side * np.linalg.det(J) < self.many.least:
            return self.singular
        return q


class ClosedChain:
    """Kinematics and collision checks of both arms with the box between them, while each pad stays
    fixed on the box.

    Threads must not share an object.

    Attributes:
        judge: checker of collisions.
        looked: number of configurations checked so far.
        refused: number of configurations at which the arms cannot hold the box, by reason;
            collisions do not count.
    """

    def __init__(
        self,
        workcell: Workcell,
        judge: PoseJudge,
        holds: tuple[Hold, Hold],
        models: tuple[pin.Model, pin.Model],
    ) -> None:
        """Prepare the kinematics of both arms.

        Args:
            workcell: the cell, with chosen redundant joints.
            judge: checker of collisions.
            holds: hold of each arm, of which the rotation of the pad is used.
            models: Pinocchio model of each arm (`symbolic.read.arms.arm_model`).
        """
        self.judge, self.looked = judge, 0
        self._orientation = workcell.task.orientation
        self.refused: Counter[str] = Counter()
        self._arms = [
            _Follower(ArmKinematics(workcell, arm, judge.geometry.arms[arm]), hold, model)
            for arm, (hold, model) in enumerate(zip(holds, models, strict=True))
        ]

    def close(self, extended: Array, q: tuple[Array, Array]) -> ChainConfiguration | None:
        """Return the configuration in which both arms hold the box at a given pose; None if an arm
        cannot. Collisions are not checked.

        Args:
            extended: (6 + m,) box pose [m, rad] followed by the m redundant joints [rad or m].
            q: joint positions (joints,) of each arm at a configuration nearby [rad or m].
        """
        T_world_box = box_placement(self._orientation, extended[:POSE_SIZE])
        found = []
        for arm, near in zip(self._arms, q, strict=True):
            closed = arm.close(T_world_box, extended, near)
            if isinstance(closed, str):
                self.refused[closed] += 1
                return None
            found.append(closed)
        return ChainConfiguration(extended, (found[0], found[1]))

    def close_many(
        self, extended: Array, q: tuple[Array, Array], steps: int = TRACKING_STEPS
    ) -> tuple[tuple[Array, Array], NDArray[np.bool_]]:
        """Find the joint positions with which both arms hold the box at n given poses. Collisions
        are not checked.

        Args:
            extended: (n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m].
            q: joint positions (n, joints) of each arm from which the solution starts [rad or m].
            steps: largest number of Newton steps.

        Returns:
            Joint positions (n, joints) of each arm, and (n,) True where both arms hold the box
            within their joint limits.
        """
        T_world_box = box_placement(self._orientation, extended[:, :POSE_SIZE])
        closed, found = np.ones(len(extended), dtype=bool), []
        for arm, near in zip(self._arms, q, strict=True):
            guess = near.copy()
            for joint, place in arm.redundant:
                guess[:, joint] = extended[:, place]
            there = arm.many.solve(guess, T_world_box @ arm.T_box_joint, steps)
            closed &= there.residual <= REACHED
            closed &= arm.side * there.determinant >= arm.many.least
            closed &= np.all((there.q >= arm.lower) & (there.q <= arm.upper), axis=1)
            found.append(there.q)
        return (found[0], found[1]), closed

    def along(self, begin: ChainConfiguration, path: Array) -> Iterator[ChainConfiguration]:
        """Yield the configurations along a path, up to the first that collides or at which an arm
        cannot hold the box.

        Args:
            begin: configuration at the first pose of the path.
            path: (n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m].
        """
        batch: list[ChainConfiguration] = []
        place: ChainConfiguration | None = begin
        for extended in path:
            assert place is not None
            place = self.close(extended, place.q)
            self.looked += 1
            if place is not None:
                batch.append(place)
            if place is None or len(batch) == TOGETHER:
                free = self._free(batch)
                yield from batch[:free]
                if place is None or free < len(batch):
                    return
                batch = []
        yield from batch[: self._free(batch)]

    def along_many(
        self, begins: Sequence[ChainConfiguration], paths: Array
    ) -> list[list[ChainConfiguration]]:
        """Follow k paths at once, each up to its first configuration that collides or at which an
        arm cannot hold the box.

        Args:
            begins: configuration at the beginning of each path.
            paths: (k, n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m];
                neighbours are at most `PATH_STEP` apart.

        Returns:
            Configurations along each path, the one in `begins` first.
        """
        found = [[begin] for begin in begins]
        alive = np.arange(len(begins))
        q = np.array([begin.q[0] for begin in begins]), np.array([begin.q[1] for begin in begins])
        step = np.zeros_like(q[0]), np.zeros_like(q[1])
        for extended in paths.transpose(1, 0, 2)[1:]:
            there, on = self.close_many(extended[alive], (q[0] + step[0], q[1] + step[1]))
            step = there[0] - q[0], there[1] - q[1]
            on &= np.max(np.abs(np.hstack(step)), axis=1) <= JUMP
            alive, q = alive[on], (there[0][on], there[1][on])
            step = step[0][on], step[1][on]
            for row, k in enumerate(alive.tolist()):
                found[k].append(ChainConfiguration(extended[k], (q[0][row], q[1][row])))
            if not len(alive):
                break
        self.looked += sum(map(len, found)) - len(found)
        return [[one[0], *one[1 : 1 + self._free(one[1:])]] for one in found]

    def between(
        self, first: ChainConfiguration, last: ChainConfiguration, path: Array
    ) -> list[ChainConfiguration] | None:
        """Return the configurations along a path from one configuration to another; None if one of
        them collides or an arm cannot hold the box, or if the joints do not arrive at `last`.

        Args:
            first: configuration at the first pose of the path.
            last: configuration at the last pose of the path.
            path: (n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m].
        """
        share = np.linspace(0.0, 1.0, len(path))[:, None]
        near = [(1.0 - share) * a + share * b for a, b in zip(first.q, last.q, strict=True)]
        q, closed = self.close_many(path, (near[0], near[1]), CHAIN_NEWTON_STEPS)
        self.looked += len(path)
        whole = np.hstack(q)
        joined = np.abs(np.diff(whole, axis=0)).max(initial=0.0) <= JUMP
        arrives = np.abs(whole[-1] - np.concatenate(last.q)).max() < MATCH
        begins = np.abs(whole[0] - np.concatenate(first.q)).max() < MATCH
        if not (closed.all() and joined and begins and arrives):
            return None
        places = [ChainConfiguration(each, (q[0][k], q[1][k])) for k, each in enumerate(path)]
        free = self._free(places[1:-1]) == len(places) - 2
        return [first, *places[1:-1], last] if free else None

    def reach(self, begin: ChainConfiguration, extended: Array) -> ChainConfiguration | None:
        """Return the configuration at the end of a straight motion; None if the motion is not free
        of collisions or an arm cannot follow it.

        Args:
            begin: configuration at the beginning of the motion.
            extended: (6 + m,) box pose at the end [m, rad] followed by the m redundant joints [rad
                or m].
        """
        found = self.way(begin, straight(begin.extended, extended))
        return None if found is None else found[-1]

    def way(self, begin: ChainConfiguration, path: Array) -> list[ChainConfiguration] | None:
        """Return the configurations along a whole path; None if one of them collides or an arm
        cannot hold the box there.

        Args:
            begin: configuration at the first pose of the path.
            path: (n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m].
        """
        found = [begin, *self.along(begin, path[1:])]
        return found if len(found) == len(path) else None

    def _free(self, places: list[ChainConfiguration]) -> int:
        """Count the configurations before the first one that collides; all if none does.

        Args:
            places: configurations along a path.
        """
        if not places:
            return 0
        pose = np.array([place.extended[:POSE_SIZE] for place in places])
        q_1, q_2 = (np.array([place.q[arm] for place in places]) for arm in (0, 1))
        hit = self.judge.colliding(pose, q_1, q_2)
        return int(np.argmax(hit)) if hit.any() else len(places)


def metric_weights(size: int) -> Array:
    """Return the factors (size,) that turn a box pose followed by redundant joints into lengths: 1
    for positions, a lever [m/rad] for angles and for redundant joints.

    Args:
        size: number of entries, 6 plus the number of redundant joints.
    """
    found = np.full(size, REDUNDANT_LEVER)
    found[:3], found[3:POSE_SIZE] = 1.0, LEVER
    return found


def distance(first: Array, second: Array) -> float:
    """Compute the distance [m] between two box poses with redundant joints, weighted by
    `metric_weights`.

    Args:
        first: (6 + m,) box pose [m, rad] followed by the m redundant joints [rad or m].
        second: (6 + m,) another such vector.
    """
    return float(np.linalg.norm(metric_weights(len(first)) * (second - first)))


def straight(first: Array, second: Array) -> Array:
    """Interpolate linearly between two box poses with redundant joints.

    Args:
        first: (6 + m,) box pose [m, rad] followed by the m redundant joints [rad or m].
        second: (6 + m,) another such vector.

    Returns:
        (n, 6 + m) vectors, both ends included, neighbours at most `PATH_STEP` apart.
    """
    n = max(int(np.ceil(distance(first, second) / PATH_STEP)), 1)
    return np.asarray(np.linspace(first, second, n + 1))


RETREAT = 0.6
"""Largest length of a straight motion out of the start or the goal [m]."""

SHORT_RETREAT = 0.06
"""Smallest useful length of such a motion [m]."""

DIRECTIONS = np.array([way for way in product((-1.0, 0.0, 1.0), repeat=3) if any(way)])
"""Directions of straight motions out of start and goal: along the world's axes and between them."""

RETREAT_STOPS = 4
"""Every so many configurations of a retreat the box may rotate to the pose of the other end."""

STRAIGHT_TRIED = 100
"""Largest number of straight motions of the box between two retreats that are tried with the
arms."""

LINE_SHARES = np.array([0.5, 0.25, 0.75, 0.375, 0.625, 0.125, 0.875])
"""Positions on such a motion at which the box alone is checked first."""

REDUNDANT_ASIDE = 5.0
"""Distance by which redundant joints may deviate per metre of deviation of the box [rad/m]."""

MATCH = 1e-3
"""Largest difference of joints where two trees meet [rad]: both arms are then on the same
branch."""


@dataclass(frozen=True)
class AffineSubspace:
    """A bounded set in which a path is searched: the vectors origin + directions @ y with bounds of
    y.

    A vector is a box pose followed by m redundant joints. A coordinate y has d entries.

    Attributes:
        origin: (6 + m,) box pose [m, rad] followed by the m redundant joints [rad or m].
        directions: (6 + m, d) basis. Its scale makes the Euclidean distance between two coordinates
            equal to the `distance` of their vectors.
        lower, upper: (d,) bounds of y [m].
        range: longest motion by which the planner's trees grow [m].
    """

    origin: Array
    directions: Array
    lower: Array
    upper: Array
    range: float

    def extended(self, y: Array) -> Array:
        """Compute the box pose followed by m redundant joints (6 + m,) at a coordinate of the
        subspace.

        Args:
            y: (d,) coordinate [m].
        """
        return np.asarray(self.origin + self.directions @ y)

    def coordinates(self, extended: Array) -> Array:
        """Compute the coordinate (d,) [m] in the subspace of a box pose with redundant joints.

        Args:
            extended: (6 + m,) box pose [m, rad] followed by the m redundant joints [rad or m].
        """
        return np.asarray(np.linalg.pinv(self.directions) @ (extended - self.origin))


@dataclass(frozen=True)
class Corridor:
    """Limits on the deviation of a path from the straight motion.

    Attributes:
        tilt: largest rotation of the box away from the straight interpolation between the angles of
            start and goal [rad]; 0 allows none.
        range: longest motion by which the planner's trees grow [m].
        aside: largest distance of the box beyond start and goal along each axis of the world [m].
        towards: -1, 0 or 1 for each axis of the world: the direction in which the box may leave the
            range between start and goal; None for all directions.
    """

    tilt: float
    range: float
    aside: float
    towards: tuple[int, int, int] | None = None


def search_subspace(start: Array, goal: Array, stray: Corridor, limits: Array) -> AffineSubspace:
    """Compute the set of box poses and redundant joints in which a path from start to goal is
    searched.

    Args:
        start, goal: (6 + m,) box pose [m, rad] followed by the m redundant joints [rad or m].
        stray: allowed deviation from the straight motion; redundant joints may deviate
            `REDUNDANT_ASIDE` times as far.
        limits: (m, 2) lower and upper limit of each redundant joint [rad or m].
    """
    size, weight, tilt = len(start), metric_weights(len(start)), stray.tilt
    aside = np.full(size, stray.aside)
    aside[POSE_SIZE:] *= REDUNDANT_ASIDE
    less, more = aside.copy(), aside.copy()
    if stray.towards is not None:
        less[:3] *= np.less(stray.towards, 0)
        more[:3] *= np.greater(stray.towards, 0)
    lower, upper = np.minimum(start, goal) - less, np.maximum(start, goal) + more
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
    return AffineSubspace(start, np.column_stack(columns), *bounds, stray.range)


Retreats = tuple[list[list[ChainConfiguration]], list[list[ChainConfiguration]]]
"""Free configurations from the start, and from the goal, along the same directions, in order,
beginning with the end itself."""


def retreats(chain: ClosedChain, ends: tuple[ChainConfiguration, ChainConfiguration]) -> Retreats:
    """Find straight collision-free motions of the box out of its start and out of its goal, for
    instance out of a shelf.

    Directions are the world's axes and the diagonals between them.

    Args:
        chain: both arms, whose pads stay fixed on the box.
        ends: configurations at the start and at the goal.

    Returns:
        For the start, then for the goal: a list of configurations along each direction, from the
        end itself to the last one before a collision.
    """
    ways = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1)[:, None]
    begins = [place for place in ends for _ in ways]
    away = np.array([place.extended for place in begins])
    away[:, :3] += RETREAT * np.tile(ways, (len(ends), 1))
    steps = round(RETREAT / PATH_STEP)
    paths = np.linspace([place.extended for place in begins], away, steps + 1, axis=1)
    found = chain.along_many(begins, paths)
    return found[: len(ways)], found[len(ways) :]


def straight_paths(
    chain: ClosedChain, out: Retreats, box: PayloadSceneChecker
) -> Iterator[list[ChainConfiguration]]:
    """Yield collision-free paths of three straight motions, shorter ones first.

    The motions are a retreat from the start, a motion across, and the reverse of a retreat from the
    goal. Both retreats have the same direction, or two different axes of the world; each such pair
    of directions gives at most one path.

    Args:
        chain: both arms, whose pads stay fixed on the box.
        out: result of `retreats`: configurations along straight motions out of start and goal.
        box: collision checker of the box alone.

    Yields:
        Configurations at the four corners of a path.
    """
    ways: dict[tuple[bytes, bytes], tuple[float, tuple[int, int], list[ChainConfiguration]]] = {}
    axes = np.flatnonzero(np.count_nonzero(DIRECTIONS, axis=1) == 1)
    same_way = [(k, k) for k in range(len(DIRECTIONS))]
    for along in (*same_way, *permutations(axes.tolist(), 2)):
        first, last = out[0][along[0]], out[1][along[1]]
        for a, b in product(first[::RETREAT_STOPS], last[::RETREAT_STOPS]):
            corners = [first[0], a, b, last[0]]
            length = sum(distance(p.extended, q.extended) for p, q in pairwise(corners))
            ways.setdefault((a.extended.tobytes(), b.extended.tobytes()), (length, along, corners))
    tried, done = 0, set[tuple[int, int]]()
    for _, along, corners in sorted(ways.values(), key=lambda way: way[0]):
        begin, end = corners[1].extended, corners[2].extended
        if along in done or box.is_between(begin[:POSE_SIZE], end[:POSE_SIZE], LINE_SHARES):
            continue
        there = chain.reach(corners[1], end)
        tried += 1
        if there is not None and same(there, corners[2]):
            done.add(along)
            tried = 0
            yield corners
        elif tried == STRAIGHT_TRIED:
            return


def plan(
    chain: ClosedChain,
    out: Retreats,
    room: AffineSubspace,
    *,
    most: int,
    out_of_time: Callable[[], bool],
    seed: int,
) -> list[ChainConfiguration] | None:
    """Find a collision-free path from start to goal by the planner RRT-Connect; None if no path is
    found.

    Args:
        chain: both arms, whose pads stay fixed on the box.
        out: result of `retreats`: configurations along straight motions out of start and goal. They
            become further roots of the planner's trees.
        room: box poses and redundant joints that the path may use.
        most: largest number of configurations that may be checked.
        out_of_time: function that returns True if no time is left.
        seed: seed of the planner, at least 1.

    Returns:
        Configurations at the corners of the path; between them the box moves straight.

    Raises:
        SettingsError: OMPL is not installed.
    """
    places: dict[State, ChainConfiguration] = {}
    ways: dict[State, ChainConfiguration] = {}
    ends: tuple[list[State], list[State]] = ([], [])
    for states, ways_out in zip(ends, out, strict=True):
        place = ways_out[0][0]
        for stop in (place, *_usable([way[-1] for way in ways_out], place, room)):
            state: State = tuple(room.coordinates(stop.extended).tolist())
            places[state], ways[state] = stop, place
            states.append(state)

    def joined(first: State, second: State) -> bool:
        """Return True if the straight motion between two coordinates is free of collisions.

        It is False if neither coordinate was reached before.

        Args:
            first: (d,) coordinate in `room`.
            second: (d,) another coordinate.
        """
        if first not in places:
            first, second = second, first
        if first not in places:
            return False
        found = chain.reach(places[first], room.extended(np.array(second)))
        return found is not None and same(places.setdefault(second, found), found)

    last = chain.looked + most
    path = connected(
        (room.lower, room.upper),
        room.range,
        joined,
        ends,
        lambda: chain.looked >= last or out_of_time(),
        seed,
    )
    if path is None or any(state not in places for state in path):
        return None
    found = [ways[path[0]], *(places[state] for state in path), ways[path[-1]]]
    return [place for k, place in enumerate(found) if k == 0 or place is not found[k - 1]]


def _usable(
    stops: list[ChainConfiguration], place: ChainConfiguration, room: AffineSubspace
) -> list[ChainConfiguration]:
    """Select the configurations that lie in a region and at least `SHORT_RETREAT` from one end of
    the carry.

    Args:
        stops: the configurations.
        place: configuration at the end of the carry: the start or the goal.
        room: the region.

    Returns:
        The selected configurations.
    """
    at = [room.coordinates(stop.extended) for stop in stops]
    return [
        stop
        for stop, y in zip(stops, at, strict=True)
        if distance(place.extended, stop.extended) >= SHORT_RETREAT
        and bool(np.all((y >= room.lower) & (y <= room.upper)))
    ]


def same(first: ChainConfiguration, second: ChainConfiguration) -> bool:
    """Return True if the joint positions of both arms agree within `MATCH` in two configurations.

    Args:
        first: a configuration.
        second: another configuration.
    """
    apart = [np.abs(a - b).max() for a, b in zip(first.q, second.q, strict=True)]
    return bool(max(apart) < MATCH)


State = tuple[float, ...]
"""Coordinates in which the planner moves."""


def connected(
    bounds: tuple[Array, Array],
    longest: float,
    joined: Callable[[State, State], bool],
    ends: Sequence[Sequence[State]],
    ended: Callable[[], bool],
    seed: int,
) -> list[State] | None:
    """Find the corners of a path between two sets of states by the planner RRT-Connect; None if no
    path is found.

    Args:
        bounds: lower and upper bounds (d,) of the states; a state is a point with d coordinates.
        longest: longest motion by which the planner's trees grow, in the unit of the states.
        joined: function that returns True if the straight motion between two states is free.
        ends: states (d,) at which the path may begin, and states at which it may end.
        ended: function that returns True if the search has to end.
        seed: seed of the planner, at least 1.

    Raises:
        SettingsError: OMPL is not installed.
    """
    try:
        from ompl import base, geometric, util
    except ImportError as error:
        raise SettingsError(
            "a first path is planned by OMPL, which is not installed: "
            'pip install "dual-arm-carry[propose]"'
        ) from error
    util.setLogLevel(util.LogLevel.LOG_NONE)  # also says that seeds were drawn before
    util.RNG.setSeed(seed)
    size = len(bounds[0])

    def values(state: Any) -> State:
        return tuple(state[k] for k in range(size))

    class Validator(base.MotionValidator):  # type: ignore[misc]
        """OMPL's validator of motions, which calls `joined`."""

        def checkMotion(self, first: Any, second: Any) -> bool:
            return joined(values(first), values(second))

    space, limits = base.RealVectorStateSpace(size), base.RealVectorBounds(size)
    for k, (low, high) in enumerate(zip(*bounds, strict=True)):
        limits.setLow(k, float(low))
        limits.setHigh(k, float(high))
    space.setBounds(limits)
    information = base.SpaceInformation(space)
    information.setStateValidityChecker(lambda state: True)
    asked = Validator(information)
    information.setMotionValidator(asked)
    information.setup()
    problem, goals = base.ProblemDefinition(information), base.GoalStates(information)
    for states, add in zip(ends, (problem.addStartState, goals.addState), strict=True):
        for known in states:
            state = space.allocState()
            for k, value in enumerate(known):
                state[k] = value
            add(state)
    problem.setGoal(goals)
    planner = geometric.RRTConnect(information)
    planner.setRange(longest)
    planner.setProblemDefinition(problem)
    planner.setup()
    planner.solve(base.PlannerTerminationCondition(ended))
    if not problem.hasExactSolution():
        return None
    path = problem.getSolutionPath()
    return [values(path.getState(k)) for k in range(path.getStateCount())]
