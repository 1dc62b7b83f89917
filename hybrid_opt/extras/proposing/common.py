"""Holds of both arms of a machine, found together with the joints that move both, such as a torso.

A posture of the whole machine is a vector of the common joints, followed by the other joints of
either arm. Many postures are computed side by side.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.extras.proposing.holding import (
    GUIDES,
    MOST_HOLDS,
    SAME_REDUNDANT,
    SEARCH_DAMPING,
    SPIN_OF_FILE,
    Hold,
    HoldQuery,
    HoldSearch,
    clear_spins,
    initial_arc,
    limit_room,
    path_score,
    possible_spins,
)
from hybrid_opt.extras.proposing.kinematics import (
    DRIFT_SHARE,
    JUMP,
    LIMIT_MARGIN,
    REACHED,
    STEP_LIMIT,
    TRACKING_STEPS,
    ArmKinematics,
    pose_error,
)
from hybrid_opt.extras.proposing.static_load import MOST_TORQUE, StaticLoad
from symbolic.array import Array
from symbolic.records.poses import box_placement

MACHINE_STARTS = 512
"""Number of random postures of a machine from which Newton's method reaches for the box at once."""

ROOM = (0.06, 0.06, 0.03, 0.0, 0.0, 0.0)
"""Distance from joint limits that Newton steps keep, as a share of the range, for each such set of
postures. With room the motions before and after the carry are possible more often."""

MACHINE_STEPS = 60
"""Number of Newton steps from these postures."""

ENOUGH_TOGETHER = 12
"""Number of pairs of holds after which no further set is tried."""


class MachineKinematics:
    """Numeric kinematics of two arms on common joints.

    Attributes:
        arms: both arms.
        common: number of common joints, the first entries of a posture.
        lower, upper: limits of the entries of a posture [rad or m], with a margin.
        rest: posture to which Newton steps drift: common joints at zero, others at the middle of
            their ranges, as far as limits allow [rad or m].
    """

    def __init__(self, arms: Sequence[ArmKinematics], room: float = 0.0) -> None:
        """Prepare the kinematics.

        Args:
            arms: both arms.
            room: distance from joint limits that postures keep, as a share of the range.
        """
        self.arms, self.common = arms, len(arms[0].common)
        self._own = [np.delete(np.arange(arm.geometry.joints), arm.common) for arm in arms]
        middle = self.common + len(self._own[0])
        self._entries = [slice(self.common, middle), slice(middle, middle + len(self._own[1]))]
        spans = [arm.span for arm in arms]
        shared = [span[:, arm.common] for span, arm in zip(spans, arms, strict=True)]
        own = [span[:, joints] for span, joints in zip(spans, self._own, strict=True)]
        self.lower = np.concatenate([np.maximum(shared[0][0], shared[1][0]), own[0][0], own[1][0]])
        self.upper = np.concatenate([np.minimum(shared[0][1], shared[1][1]), own[0][1], own[1][1]])
        margin = np.maximum(room * (self.upper - self.lower), 1.01 * LIMIT_MARGIN)
        self.lower, self.upper = self.lower + margin, self.upper - margin
        self.rest = (self.lower + self.upper) / 2.0
        still = slice(0, self.common)
        self.rest[still] = np.clip(0.0, self.lower[still], self.upper[still])

    def joints(self, x: Array, arm: int) -> Array:
        """Return the joint positions (n, joints) of an arm [rad or m].

        Args:
            x: (n, size) postures of the machine: common joints, then the other joints of each arm.
            arm: index of the arm.
        """
        q = np.empty((len(x), self.arms[arm].geometry.joints))
        q[:, self.arms[arm].common] = x[:, : self.common]
        q[:, self._own[arm]] = x[:, self._entries[arm]]
        return q

    def posture(self, q: Sequence[Array]) -> Array:
        """Return postures (n, size) from the joint positions (n, joints) of both arms, whose common
        joints agree [rad or m]."""
        own = [part[:, joints] for part, joints in zip(q, self._own, strict=True)]
        return np.hstack([q[0][:, self.arms[0].common], *own])

    def drawn(self, count: int, rng: np.random.Generator) -> Array:
        """Draw random postures (count, size) [rad or m].

        Joints of one arm are uniform between their limits. Common joints are, by a random share,
        between such a position and their position at rest.
        """
        x = rng.uniform(self.lower, self.upper, (count, len(self.rest)))
        x[:, : self.common] += rng.random((count, 1)) * (self.rest - x)[:, : self.common]
        return x

    def solve(
        self, x: Array, targets: Sequence[Array], steps: int, damping: float = 0.0
    ) -> tuple[Array, Array, Array]:
        """Find postures that put the last joint of both arms at given poses. Joints stay within
        their limits.

        The postures follow from Newton steps of least norm. In all but the last steps, joint motion
        that does not change the poses moves the postures towards `rest`.

        Args:
            x: (n, size) initial postures [rad or m].
            targets: for each arm (n, 4, 4) wanted poses of its last joint in the world.
            steps: number of Newton steps.
            damping: damping of the steps far from a solution.

        Returns:
            Postures (n, size) [rad or m]; residuals (n,) of the worse arm [m, rad]; determinants
            (2, n) of the Jacobian of each arm's joints that are not redundant [m^3].
        """
        x = x.copy()
        for step in range(steps + 1):
            J, error, residual, determinant = self._linearised(x, targets)
            if step == steps:
                break
            drift = DRIFT_SHARE * (self.rest - x) * (step < max(1, steps - TRACKING_STEPS))
            weight = (damping * np.minimum(residual, 1.0) ** 2 + 1e-10)[:, None, None] * np.eye(12)
            move, free = np.zeros_like(x), np.ones_like(x)
            for _ in range(2):  # the second time without the joints that would leave their limits
                own = J * free[:, None]
                missing = (error - np.einsum("nij,nj->ni", own, drift))[..., None]
                across = np.linalg.solve(own @ own.transpose(0, 2, 1) + weight, missing)[..., 0]
                move = drift * free + np.einsum("nji,nj->ni", own, across)
                beyond = (x <= self.lower) & (move < 0.0) | (x >= self.upper) & (move > 0.0)
                free[beyond] = 0.0
            most = np.maximum(np.abs(move).max(axis=1, keepdims=True), STEP_LIMIT)
            x = np.clip(x + move * (STEP_LIMIT / most), self.lower, self.upper)
        return x, residual, determinant

    def _linearised(self, x: Array, targets: Sequence[Array]) -> tuple[Array, Array, Array, Array]:
        """Linearise the poses of both arms' last joints about n postures.

        Args:
            x: (n, size) postures [rad or m].
            targets: for each arm (n, 4, 4) wanted poses of its last joint in the world.

        Returns:
            - Jacobians (n, 12, size) of both last joints' frames.
            - Pose errors (n, 12): wanted minus actual poses.
            - Residuals (n,) of the worse arm [m, rad].
            - Determinants (2, n) of the Jacobian of each arm's joints that are not redundant [m^3].
        """
        n = len(x)
        J, error = np.zeros((n, 12, len(self.rest))), np.empty((n, 12))
        residual, determinant = np.zeros(n), np.empty((2, n))
        for k, arm in enumerate(self.arms):
            T, own = arm.pose_and_jacobian(self.joints(x, k))
            rows = slice(6 * k, 6 * k + 6)
            J[:, rows, : self.common] = own[:, :, arm.common]
            J[:, rows, self._entries[k]] = own[:, :, self._own[k]]
            error[:, rows], missing = pose_error(targets[k], T)
            residual = np.maximum(residual, missing)
            determinant[k] = np.linalg.det(own[:, :, arm.following])
        return J, error, residual, determinant


def machine_holds(
    query: HoldQuery, arms: Sequence[ArmKinematics], rng: np.random.Generator
) -> tuple[HoldSearch, list[tuple[Hold, Hold]]]:
    """Find pairs of holds of a machine's arms, one hold per arm, with equal positions of the joints
    that move both arms. A hold is a pad rotation with a start and a goal posture.

    Random postures are solved to hold the box at the start. Those without collisions follow the box
    along several paths (guides) to the goal, with all joints; collisions between start and goal do
    not count.

    Args:
        query: box poses at start and goal, and rotations of the pads to try.
        arms: both arms, on common joints.
        rng: generator of random postures.

    Returns:
        Counts that explain a failure; and the pairs of holds.
    """
    search = _MachineSearch(query, MachineKinematics(arms), rng)
    for room in ROOM:
        search.machine = MachineKinematics(arms, room)
        search.round()
        if len(search.pairs) >= ENOUGH_TOGETHER:
            break
    return search.found, search.pairs


class _MachineSearch:
    """The search for pairs of holds of a machine's arms.

    Attributes:
        machine: both arms, with the room that postures keep from joint limits.
        found: counts of the search so far.
        pairs: pairs of holds so far.
    """

    def __init__(
        self, query: HoldQuery, machine: MachineKinematics, rng: np.random.Generator
    ) -> None:
        self.query, self.rng, self.machine = query, rng, machine
        self.found, self.pairs = HoldSearch(), list[tuple[Hold, Hold]]()
        self._known = np.empty((0, 2 * len(self.machine.rest)))
        arms = machine.arms
        workcell = arms[0].workcell
        self._orientation = workcell.task.orientation
        self._loads = [StaticLoad(workcell, arm.arm) for arm in arms]
        possible = (possible_spins(workcell.contacts[arm.arm], query.spins) for arm in arms)
        self._spins = [clear_spins(query, *both) for both in zip(arms, possible, strict=True)]
        self._held = [
            np.array([arm.held(spin) for spin in spins])
            for arm, spins in zip(arms, self._spins, strict=True)
        ]

    def round(self) -> None:
        """Draw random postures, move them from start to goal, and add a pair of holds for each
        posture that arrives without collision. A hold is a pad rotation with a start and a goal
        posture.
        """
        machine, query = self.machine, self.query
        which = [self.rng.integers(0, len(spins), MACHINE_STARTS) for spins in self._spins]
        x = machine.drawn(MACHINE_STARTS, self.rng)
        x, residual, determinant = machine.solve(
            x, self._targets(query.start, which), MACHINE_STEPS, SEARCH_DAMPING
        )
        fine = (residual <= REACHED) & self._regular(np.abs(determinant))
        x, which = x[fine], [part[fine] for part in which]
        x = self._settled(0, x, which)
        self.found.within += len(x)
        free = ~self._blocked(query.start, x, which)
        x, which = x[free], [part[free] for part in which]
        self.found.free += len(x)
        for bow in GUIDES[: query.guides]:
            arrived = self._lead(x, which, initial_arc(query.start, query.goal, bow))
            x, which = x[~arrived], [part[~arrived] for part in which]

    def _lead(self, x: Array, which: Sequence[NDArray[np.intp]], guide: Array) -> NDArray[np.bool_]:
        """Follow box poses from the start to the goal, and add a pair of holds for each posture
        that arrives without collision.

        Args:
            x: (n, size) postures of the machine at the start [rad or m].
            which: for each arm the index (n,) of its pad's rotation in each posture.
            guide: (m, 6) box poses from start to goal [m, rad].

        Returns:
            (n,) True for postures that reach the goal, with or without collision.
        """
        machine = self.machine
        path, measure = np.tile(x, (len(guide), 1, 1)), np.zeros((2, len(guide), len(x)))
        alive, side = np.ones(len(x), dtype=bool), np.ones((2, len(x)))
        kept = np.zeros(len(x), dtype=np.intp)
        for k, pose in enumerate(guide):
            before = path[max(k - 1, 0)]
            path[k], residual, determinant = machine.solve(
                before, self._targets(pose, which), TRACKING_STEPS
            )
            side = np.sign(determinant) if k == 0 else side
            measure[:, k] = side * determinant
            alive &= (residual <= REACHED) & self._regular(measure[:, k])
            alive &= np.abs(path[k] - before).max(axis=1, initial=0.0) <= JUMP
            kept += alive
        if kept.max(initial=0) > self.found.kept * len(guide):
            self.found.kept = float(kept.max()) / len(guide)
            self.found.stopped = "both arms together do not reach farther in one motion"
        rows = np.flatnonzero(alive)
        there = [part[rows] for part in which]
        path[-1, rows] = self._settled(1, path[-1, rows], there)
        free = ~self._blocked(self.query.goal, path[-1, rows], there)
        for row in rows[free].tolist():
            ends = np.concatenate([path[0, row], path[-1, row]])
            if np.abs(self._known - ends).max(axis=1).min(initial=np.inf) > SAME_REDUNDANT:
                self._known = np.vstack([self._known, ends])
                self.pairs.append(self._holds(path[:, row], measure[:, :, row], which, row))
        return alive

    def _settled(self, end: int, x: Array, which: Sequence[NDArray[np.intp]]) -> Array:
        """Move the common and the redundant joints of postures x (n, size) to positions with which
        both arms can follow the motions before or after the carry, because they do not move then.

        All joints follow these motions. Those that do not move in a job stay where this ends, and
        the arms return to the start (`end` 0) or the goal (1).

        Returns:
            (n, size) postures; those that cannot be improved are unchanged.
        """
        handling, arms = self.query.handling, self.machine.arms
        if handling is None or not len(x):
            return x
        ways = [
            handling.targets(arm, end, held[part])
            for arm, held, part in zip(arms, self._held, which, strict=True)
        ]
        q = [self.machine.joints(x, k) for k in (0, 1)]
        shares = [
            handling.followed(arm, own, way)[0] for arm, own, way in zip(arms, q, ways, strict=True)
        ]
        rows = np.flatnonzero(np.minimum(*shares) < 1.0)
        away = x[rows]
        for both in zip(*ways, strict=True):
            away, _, _ = self.machine.solve(away, [way[rows] for way in both], TRACKING_STEPS)
        better, back = np.ones(len(rows), dtype=bool), []
        for k, (arm, way) in enumerate(zip(arms, ways, strict=True)):
            share, path = handling.followed(arm, self.machine.joints(away, k), way[::-1, rows])
            better &= (share == 1.0) & (limit_room(arm, path[-1:])[0] >= LIMIT_MARGIN)
            back.append(path[-1])
        found = x.copy()
        found[rows[better]] = self.machine.posture(back)[better]
        return found

    def _holds(
        self, path: Array, measure: Array, which: Sequence[NDArray[np.intp]], row: int
    ) -> tuple[Hold, Hold]:
        """Build the hold of each arm, a pad rotation with a start and a goal posture, from a path
        of the machine.

        Args:
            path: (m, size) postures of the machine from start to goal [rad or m].
            measure: (2, m) manipulability of each arm along the path [m^3].
            which: for each arm the index of its pad's rotation, for all paths.
            row: index of this path in `which`.
        """
        found = []
        for k, arm in enumerate(self.machine.arms):
            q, spin = self.machine.joints(path, k), float(self._spins[k][which[k][row]])
            room = limit_room(arm, q[:, None])
            score = path_score(arm, q[:, None], room, measure[k][:, None])[0]
            found.append(Hold(spin, q[0], q[-1], float(score + SPIN_OF_FILE * (spin == 0.0))))
        return found[0], found[1]

    def _targets(self, pose: Array, which: Sequence[NDArray[np.intp]]) -> list[Array]:
        """Compute the poses (n, 4, 4) in the world that both arms' last joints need at a box pose.

        Args:
            pose: (6,) box pose [m, rad].
            which: for each arm the indices (n,) of its pad's rotations.
        """
        T_world_box = box_placement(self._orientation, pose)
        return [T_world_box @ held[part] for held, part in zip(self._held, which, strict=True)]

    def _regular(self, measure: Array) -> NDArray[np.bool_]:
        """Return (n,) True where the manipulability `measure` (2, n) [m^3] of both arms is at least
        its lower limit.
        """
        least = np.array([[arm.least] for arm in self.machine.arms])
        return np.asarray(np.all(measure >= least, axis=0))

    def _blocked(
        self, pose: Array, x: Array, which: Sequence[NDArray[np.intp]]
    ) -> NDArray[np.bool_]:
        """Find postures that are not allowed while the machine holds the box, because bodies
        collide or a joint needs too much torque; count collisions by pair of bodies.

        Args:
            pose: (6,) box pose [m, rad].
            x: (n, size) postures of the machine [rad or m].
            which: for each arm the index (n,) of its pad's rotation in each posture.

        Returns:
            Mask (n,), True for postures that are not allowed.
        """
        judge, poses = self.query.judge, np.tile(pose, (len(x), 1))
        if judge is None or not len(x):
            return np.zeros(len(x), dtype=bool)
        q = [self.machine.joints(x, arm) for arm in (0, 1)]
        hit = judge.colliding(poses, *q)
        for row in np.flatnonzero(hit)[:MOST_HOLDS].tolist():
            pair = judge.first_pair(pose, q[0][row], q[1][row])
            if pair is not None:
                self.found.pairs[pair] += 1
        for load, own, held, part in zip(self._loads, q, self._held, which, strict=True):
            hit |= load.share(poses, own, held[part]) > MOST_TORQUE
        return hit
