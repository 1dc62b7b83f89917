"""Both arms and the box that they hold as one closed chain: where it can go from where it is.

The box pose and the redundant joints' values are free, the six other joints of each arm follow by
Newton's method from the pose before, so that an arm never changes its branch.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from hybrid_opt.proposing.holding import LIMIT_MARGIN, MANIPULABILITY_MARGIN, Hold
from hybrid_opt.proposing.judge import PoseJudge
from hybrid_opt.proposing.kinematics import (
    JUMP,
    REACHED,
    TRACKING_STEPS,
    ArmKinematics,
    box_to_last_joint,
    spun,
)
from symbolic.array import Array
from symbolic.records import POSE_SIZE, Workcell
from symbolic.records.poses import box_placement, inverse

STEP = 0.02
"""Distance between configurations that are looked at, see `LEVERS` [m]."""

LEVER = 0.3
"""What a turn of the box counts beside a distance [m]."""

REDUNDANT_LEVER = 0.2
"""What a redundant joint's turn counts [m]."""

TOGETHER = 8
"""Configurations that are judged at once."""

CLOSED = 1e-6
"""Pose residual of a closed chain [m, rad]."""

NEWTON_STEPS = 8


@dataclass(frozen=True, eq=False)
class Place:
    """A configuration of the closed chain.

    Attributes:
        extended: (6 + m,) box pose [m, rad] and redundant joints [rad or m].
        q: per arm the joints (n,) [rad or m].
    """

    extended: Array
    q: tuple[Array, Array]


class _Follower:
    """One arm with pinocchio's numbers."""

    def __init__(
        self, workcell: Workcell, judge: PoseJudge, arm: int, hold: Hold, model: pin.Model
    ) -> None:
        robot, geometry = workcell.robots[arm], judge.geometry.arms[arm]
        self.name = robot.name
        self.model = model
        self.data = self.model.createData()
        self.names = list(self.model.names)[1:]
        self.last = self.model.njoints - 1
        self.redundant = workcell.task.redundant_of(arm)
        apart = [joint for joint, _ in self.redundant]
        self.following = [k for k in range(self.model.nq) if k not in apart]
        contact = spun(workcell.contacts[arm], hold.spin)
        self.T_box_joint = box_to_last_joint(workcell, geometry, contact, arm)
        self.T_root_world = inverse(robot.T_world_base)
        self.many = ArmKinematics(geometry, tuple(apart))
        self.lower = np.asarray(robot.position_lower) + LIMIT_MARGIN
        self.upper = np.asarray(robot.position_upper) - LIMIT_MARGIN
        self.least = robot.min_manipulability * MANIPULABILITY_MARGIN

    def close(self, T_world_box: Array, extended: Array, q: Array) -> Array | str:
        """The joints near q that hold the box there, or what is in the way."""
        target = self.T_root_world @ T_world_box @ self.T_box_joint
        before, q = q, q.copy()
        for joint, place in self.redundant:
            q[joint] = extended[place]
        for _ in range(NEWTON_STEPS):
            pin.computeJointJacobians(self.model, self.data, q)
            here = self.data.oMi[self.last]
            turn = pin.log3(target[:3, :3] @ here.rotation.T)
            error = np.concatenate([target[:3, 3] - here.translation, turn])
            J = pin.getJointJacobian(self.model, self.data, self.last, pin.LOCAL_WORLD_ALIGNED)[
                :, self.following
            ]
            if error @ error < CLOSED**2:
                break
            try:
                step = np.linalg.solve(J, error)
            except np.linalg.LinAlgError:
                return f"{self.name} is singular"
            if np.abs(step).max() > JUMP:
                return f"{self.name} does not reach"
            q[self.following] += step
        else:
            return f"{self.name} does not reach"
        if np.abs(q - before).max() > JUMP:
            return f"{self.name} does not reach"
        beyond = np.flatnonzero((q < self.lower) | (q > self.upper))
        if len(beyond):
            return f"{self.name}/{self.names[beyond[0]]} is at its limit"
        if abs(np.linalg.det(J)) < self.least:
            return f"{self.name} is near a singular posture"
        return q


class ClosedChain:
    """Both arms in one way of holding. Not to be shared between threads.

    Attributes:
        judge: of collisions.
        looked: configurations looked at so far.
        refused: how often what other than a collision was in the way.
    """

    def __init__(
        self,
        workcell: Workcell,
        judge: PoseJudge,
        holds: tuple[Hold, Hold],
        models: tuple[pin.Model, pin.Model],
    ) -> None:
        """Prepare both arms.

        Args:
            workcell: with its redundant joints chosen.
            judge, holds: see the class.
            models: of both arms (`symbolic.read.arms.arm_model`).
        """
        self.judge = judge
        self._orientation = workcell.task.orientation
        self.looked = 0
        self.refused: Counter[str] = Counter()
        self._arms = [_Follower(workcell, judge, arm, holds[arm], models[arm]) for arm in (0, 1)]

    def close(self, extended: Array, q: tuple[Array, Array]) -> Place | None:
        """The configuration near given joints; collisions do not count."""
        T_world_box = box_placement(self._orientation, extended[:POSE_SIZE])
        found = []
        for arm, near in zip(self._arms, q, strict=True):
            closed = arm.close(T_world_box, extended, near)
            if isinstance(closed, str):
                self.refused[closed] += 1
                return None
            found.append(closed)
        return Place(extended, (found[0], found[1]))

    def close_many(
        self, extended: Array, q: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array], NDArray[np.bool_]]:
        """Configurations near given joints, all side by side; collisions do not count.

        Args:
            extended: (n, 6 + m).
            q: per arm (n, joints).

        Returns:
            Per arm the joints (n, joints), and which configurations (n,) are closed within limits.
        """
        T_world_box = box_placement(self._orientation, extended[:, :POSE_SIZE])
        closed, found = np.ones(len(extended), dtype=bool), []
        for arm, near in zip(self._arms, q, strict=True):
            guess = near.copy()
            for joint, place in arm.redundant:
                guess[:, joint] = extended[:, place]
            there = arm.many.solve(guess, T_world_box @ arm.T_box_joint, TRACKING_STEPS)
            closed &= (there.residual <= REACHED) & (there.manipulability >= arm.least)
            closed &= np.all((there.q >= arm.lower) & (there.q <= arm.upper), axis=1)
            found.append(there.q)
        return (found[0], found[1]), closed

    def along(self, begin: Place, path: Array) -> Iterator[Place]:
        """Follow extended poses (n, 6 + m) as far as they are free; the first is where to begin."""
        batch: list[Place] = []
        place: Place | None = begin
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

    def reach(self, begin: Place, extended: Array) -> Place | None:
        """The configuration at the end of a straight motion, None if it is not free."""
        found = self.way(begin, straight(begin.extended, extended))
        return None if found is None else found[-1]

    def way(self, begin: Place, path: Array) -> list[Place] | None:
        """The configurations along a path (n, 6 + m) of extended poses from one of them on, None if
        not all are free."""
        found = [begin, *self.along(begin, path[1:])]
        return found if len(found) == len(path) else None

    def _free(self, places: list[Place]) -> int:
        """How many of these are free before the first that is not."""
        if not places:
            return 0
        pose = np.array([place.extended[:POSE_SIZE] for place in places])
        q_1, q_2 = (np.array([place.q[arm] for place in places]) for arm in (0, 1))
        hit = self.judge.colliding(pose, q_1, q_2)
        return int(np.argmax(hit)) if hit.any() else len(places)


def levers(size: int) -> Array:
    """(size,) what each entry of an extended pose counts in a distance."""
    found = np.full(size, REDUNDANT_LEVER)
    found[:3], found[3:POSE_SIZE] = 1.0, LEVER
    return found


def distance(first: Array, second: Array) -> float:
    """Between extended poses [m]."""
    return float(np.linalg.norm(levers(len(first)) * (second - first)))


def straight(first: Array, second: Array) -> Array:
    """(n, 6 + m) extended poses on the straight line, `STEP` apart or less, ends included."""
    n = max(int(np.ceil(distance(first, second) / STEP)), 1)
    return np.asarray(np.linspace(first, second, n + 1))
