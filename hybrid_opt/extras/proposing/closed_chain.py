"""The closed chain of both arms and the box that they hold.

Its free coordinates are the box pose and the redundant joints. The six other joints of each arm
follow by Newton's method from the pose before, so an arm never changes its branch.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from hybrid_opt.extras.proposing.holding import Hold
from hybrid_opt.extras.proposing.kinematics import (
    JUMP,
    LIMIT_MARGIN,
    REACHED,
    TRACKING_STEPS,
    ArmKinematics,
    compiled_newton,
)
from hybrid_opt.extras.proposing.static_load import MOST_TORQUE, StaticLoad
from hybrid_opt.extras.proposing.trees import inner_points
from hybrid_opt.extras.proposing.trial import PoseJudge
from symbolic.array import Array
from symbolic.records import POSE_SIZE, Workcell
from symbolic.records.poses import box_placement

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

SAME_LOAD = 1.05
"""Along a path, holding the box may take so many times the torque of its ends."""

MATCH = 1e-3
"""Largest difference of joints where two trees meet [rad]: both arms are then on the same
branch."""


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
    """An arm that follows the box with a fixed rotation of its pad."""

    def __init__(self, many: ArmKinematics, hold: Hold, model: pin.Model) -> None:
        robot, waypoints = many.workcell.robots[many.arm], many.workcell.task.waypoints
        start, goal = waypoints[0].lower, waypoints[-1].lower
        self.name, self.many = robot.name, many
        self.names = list(model.names)[1:]
        self.redundant = many.workcell.task.redundant_entries[many.arm]
        self.T_box_joint = many.held(hold.spin)
        key = f"robots[{many.arm}].min_manipulability = {robot.min_manipulability:g} m^3"
        self.singular = f"{robot.name} is near a singular posture ({key})"
        self.side = many.side(hold.q_start)
        self.load = StaticLoad(many.workcell, many.arm)
        self.heavy = f"holding the box still takes too much torque of {robot.name}"
        ends = zip((start, goal), (hold.q_start, hold.q_goal), strict=True)
        taken = [self.load.share(pose[None], q[None], self.T_box_joint)[0] for pose, q in ends]
        self.most_torque = max(MOST_TORQUE, *(SAME_LOAD * share for share in taken))
        self.lower, self.upper = many.lower + LIMIT_MARGIN, many.upper - LIMIT_MARGIN

    def follow(self, T_world_box: Array, extended: Array, q: Array) -> tuple[Array, str]:
        """Compute the arm's joint positions along poses of the box. Each solution starts from the
        one before it.

        Args:
            T_world_box: (n, 4, 4) poses of the box.
            extended: (n, 6 + m) vectors of which only the m last entries, the redundant joints [rad
                or m], are used; the box poses come from `T_world_box`.
            q: (joints,) joint positions at a configuration near the first pose [rad or m].

        Returns:
            Joint positions (k, joints) [rad or m] of the first k poses, and ''. If the arm cannot
            hold the box at one of the poses, k is the number of poses before it, and the text says
            why; else k is n.
        """
        joints = [joint for joint, _ in self.redundant]
        path, end = self.many.compiled.follow(
            q,
            T_world_box @ self.T_box_joint,
            joints,
            extended[:, [entry for _, entry in self.redundant]],
            CHAIN_NEWTON_STEPS,
            CHAIN_RESIDUAL,
            JUMP,
            self.lower,
            self.upper,
            self.side,
            self.many.least,
        )
        if len(path) == len(extended):
            return path, ""
        singular, at_limit = compiled_newton().SINGULAR, compiled_newton().AT_LIMIT
        if end >= at_limit:
            return path, f"{self.name}/{self.names[end - at_limit]} is at its limit"
        return path, self.singular if end == singular else f"{self.name} does not reach"


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

    def followed(
        self, extended: Array, q: tuple[Array, Array]
    ) -> tuple[list[ChainConfiguration], bool]:
        """Follow a path with both arms, up to the first pose at which an arm cannot hold the box.
        Collisions are not checked.

        Args:
            extended: (n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m].
            q: joint positions (joints,) of each arm at a configuration near the first pose [rad or
                m].

        Returns:
            The configurations, and True if they are all n.
        """
        T_world_box = box_placement(self._orientation, extended[:, :POSE_SIZE])
        (first, why), (second, also) = (
            arm.follow(T_world_box, extended, near) for arm, near in zip(self._arms, q, strict=True)
        )
        count = min(len(first), len(second))
        if count < len(extended):
            self.refused[why if len(first) == count else also] += 1
        joints = zip(first[:count], second[:count], strict=True)
        found = [ChainConfiguration(extended[k], both) for k, both in enumerate(joints)]
        return found, count == len(extended)

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
            for joint, entry in arm.redundant:
                guess[:, joint] = extended[:, entry]
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
        q = begin.q
        for k in range(0, len(path), TOGETHER):
            batch, whole = self.followed(path[k : k + TOGETHER], q)
            self.looked += len(batch) + (not whole)
            free = self._free(batch)
            yield from batch[:free]
            if not whole or free < len(batch):
                return
            q = batch[-1].q

    def along_many(
        self, begins: Sequence[ChainConfiguration], paths: Array
    ) -> list[list[ChainConfiguration]]:
        """Follow k paths at once, each up to its first configuration that collides or at which an
        arm cannot hold the box.

        Args:
            begins: configuration at the beginning of each path.
            paths: (k, n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m];
                the `distance` of neighbours is at most `PATH_STEP`.

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
        configurations = [
            ChainConfiguration(each, (q[0][k], q[1][k])) for k, each in enumerate(path)
        ]
        free = self._free(configurations[1:-1]) == len(configurations) - 2
        return [first, *configurations[1:-1], last] if free else None

    def reach_many(
        self, begins: Sequence[ChainConfiguration], ends: Array
    ) -> list[ChainConfiguration | None]:
        """Return the configurations at the ends of k straight motions; None for motions that are
        not free of collisions or that an arm cannot follow.

        The ends are checked first, then the middles, then all other points.

        Args:
            begins: configuration at the beginning of each motion.
            ends: (k, 6 + m) box pose at its end [m, rad] followed by the m redundant joints [rad or
                m].
        """
        first = np.array([begin.extended for begin in begins])
        q_first = np.array([np.concatenate(begin.q) for begin in begins])
        q_last, fine = self._held(ends, q_first)
        lengths = np.linalg.norm(metric_weights(ends.shape[1]) * (ends - first), axis=1)
        counts = np.maximum(np.ceil(lengths / PATH_STEP), 1).astype(np.intp)
        for which, share in inner_points(counts):
            asked = fine[which]
            which, u = which[asked], share[asked, None]
            near = q_first[which] + u * (q_last[which] - q_first[which])
            q, free = self._held(first[which] + u * (ends[which] - first[which]), near)
            free &= np.abs(q - near).max(axis=1, initial=0.0) <= JUMP
            fine[which[~free]] = False
        joints = self._arms[0].many.geometry.joints
        return [
            ChainConfiguration(end, (q[:joints], q[joints:])) if free else None
            for end, q, free in zip(ends, q_last, fine.tolist(), strict=True)
        ]

    def _held(self, extended: Array, near: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Find the joint positions with which both arms hold the box at n poses, and check them for
        collisions.

        Args:
            extended: (n, 6 + m) box poses [m, rad] followed by the m redundant joints [rad or m].
            near: (n, joints) joint positions of both arms, side by side, from which the solution
                starts [rad or m].

        Returns:
            Joint positions (n, joints) of both arms, side by side; and (n,) True where both arms
            hold the box without collision.
        """
        first, second = np.split(near, [self._arms[0].many.geometry.joints], axis=1)
        q, fine = self.close_many(extended, (first, second), CHAIN_NEWTON_STEPS)
        self.looked += len(extended)
        rows = np.flatnonzero(fine)
        fine[rows] = ~self.blocked(extended[rows, :POSE_SIZE], (q[0][rows], q[1][rows]))
        return np.hstack(q), fine

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

    def _free(self, path: list[ChainConfiguration]) -> int:
        """Count the configurations before the first one that collides; all if none does.

        Args:
            path: the configurations.
        """
        if not path:
            return 0
        pose = np.array([each.extended[:POSE_SIZE] for each in path])
        q_1, q_2 = (np.array([each.q[arm] for each in path]) for arm in (0, 1))
        hit = self.blocked(pose, (q_1, q_2))
        return int(np.argmax(hit)) if hit.any() else len(path)

    def blocked(self, pose: Array, q: tuple[Array, Array]) -> NDArray[np.bool_]:
        """Find configurations that collide, or in which holding the box at rest takes too much of a
        joint's torque.

        Args:
            pose: (n, 6) box poses [m, rad].
            q: joint positions (n, joints) of each arm [rad or m].

        Returns:
            (n,) True for these configurations.
        """
        hit = self.judge.colliding(pose, *q)
        for arm, own in zip(self._arms, q, strict=True):
            heavy = arm.load.share(pose, own, arm.T_box_joint) > arm.most_torque
            if heavy.any():
                self.refused[arm.heavy] += 1
            hit |= heavy
        return hit


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
