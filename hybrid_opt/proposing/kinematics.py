"""Many postures of one arm at once: placements, Newton's method, following a box path.

In NumPy over all postures side by side, because spins, bases and branches are compared before
anything is compiled.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.geometry.bodies import ArmGeometry, arm_geometry
from symbolic.read.arms import arm_model, common_joints
from symbolic.records import Contact, Workcell
from symbolic.records.poses import inverse, pose_matrix

REACHED = 1e-6
"""Pose residual of a reached posture [m, rad]."""

STEP_LIMIT = 0.4
"""Largest change of a joint in one step [rad]."""

TRACKING_STEPS = 4
"""Newton steps from one pose of a path to the next."""

CENTRING = 0.03
"""Share of the way to the middle of their ranges that joints drift from pose to pose."""

GUIDE_POSES = 25
"""Poses of a guide that postures are followed along."""

JUMP = 0.5
"""Largest change of a joint between poses of a path [rad]."""


@dataclass(frozen=True)
class Postures:
    """n postures of one arm.

    Attributes:
        q: (n, joints) [rad or m].
        residual: (n,) from the pose that was wanted [m, rad].
        manipulability: (n,) abs(det J) of the joints that follow [m^3].
    """

    q: Array
    residual: Array
    manipulability: Array


class ArmKinematics:
    """One arm of a cell as numbers.

    Attributes:
        geometry: its joints.
        redundant: indices of the joints that stay where they are; the other six follow the box.
        lower, upper: (joints,) limits [rad or m].
    """

    def __init__(self, geometry: ArmGeometry, redundant: tuple[int, ...]) -> None:
        self.geometry = geometry
        self.redundant = redundant
        self.following = [k for k in range(geometry.joints) if k not in redundant]
        self.lower, self.upper = np.asarray(geometry.lower), np.asarray(geometry.upper)

    @classmethod
    def of(cls, workcell: Workcell, arm: int, redundant: tuple[int, ...]) -> ArmKinematics:
        """An arm of a workcell."""
        return cls(arm_geometry(workcell, arm), redundant)

    def moved(self, T_world_root: Array) -> ArmKinematics:
        """The arm at another base."""
        return ArmKinematics(replace(self.geometry, T_world_root=T_world_root), self.redundant)

    def chain(self, q: Array) -> tuple[Array, Array]:
        """Origins (n, joints, 3) and axes (n, joints, 3) of the joints, then T (n, 4, 4) of the
        last, in the world; the last joint's placement is returned with them."""
        n, arm = len(q), self.geometry
        T = np.broadcast_to(arm.T_world_root, (n, 4, 4))
        points, axes = np.empty((n, arm.joints, 3)), np.empty((n, arm.joints, 3))
        for k in range(arm.joints):
            T = T @ arm.origins[k]
            moved = np.zeros((n, 4, 4))
            moved[:, 3, 3] = 1.0
            axis = arm.axes[k]
            if arm.turning[k]:
                moved[:, :3, :3] = _turns(axis, q[:, k])
            else:
                moved[:, :3, :3] = np.eye(3)
                moved[:, :3, 3] = q[:, k, None] * axis
            points[:, k], axes[:, k] = T[:, :3, 3], T[:, :3, :3] @ axis
            T = T @ moved
        return np.concatenate([points, axes], axis=2), T

    def jacobian(self, frames: Array, T: Array) -> Array:
        """(n, 6, joints) of the last joint's origin, world axes, from what `chain` gives."""
        points, axes = frames[:, :, :3], frames[:, :, 3:]
        turning = np.array(self.geometry.turning)[:, None]
        across = np.cross(axes, T[:, None, :3, 3] - points)
        linear = np.where(turning, across, axes)
        return np.concatenate([linear, np.where(turning, axes, 0.0)], axis=2).transpose(0, 2, 1)

    def solve(self, q: Array, target: Array, steps: int, damping: float = 0.0) -> Postures:
        """Newton's method from postures (n, joints) to placements (n, 4, 4) of the last joint.

        Args:
            damping: 0 for pure Newton steps; small values keep far starts on course.
        """
        q = np.array(q, dtype=float)
        for step in range(steps + 1):
            frames, T = self.chain(q)
            J = self.jacobian(frames, T)[:, :, self.following]
            error, residual = _error(target, T)
            if step == steps or float(residual.max(initial=0.0)) < REACHED / 10.0:
                break
            normal = np.einsum("nki,nkj->nij", J, J)
            normal += (damping * np.minimum(residual, 1.0) ** 2 + 1e-12)[:, None, None] * np.eye(6)
            right = np.einsum("nki,nk->ni", J, error)[..., None]
            move = np.linalg.solve(normal, right)[..., 0]
            most = np.maximum(np.abs(move).max(axis=1, keepdims=True), STEP_LIMIT)
            q[:, self.following] += move * (STEP_LIMIT / most)
        return Postures(q, residual, np.abs(np.linalg.det(J)))

    def track(self, q: Array, target: Array) -> Postures:
        """The next posture (n, joints) at placements (n, 4, 4), all joints moving: steps of least
        norm that drift to the middle of the joints' ranges where the box leaves them free."""
        q = np.array(q, dtype=float)
        middle = (self.lower + self.upper) / 2.0
        for step in range(TRACKING_STEPS + 1):
            frames, T = self.chain(q)
            J = self.jacobian(frames, T)
            error, residual = _error(target, T)
            if step == TRACKING_STEPS:
                break
            inverted = J.transpose(0, 2, 1) @ np.linalg.inv(
                J @ J.transpose(0, 2, 1) + 1e-9 * np.eye(6)
            )
            drift = CENTRING * (middle - q) if step == 0 else np.zeros_like(q)
            missing = error - np.einsum("nij,nj->ni", J, drift)
            q += drift + np.einsum("nij,nj->ni", inverted, missing)
        measure = np.abs(np.linalg.det(J[:, :, self.following]))
        return Postures(q, residual, measure)

    def follow(
        self, q: Array, targets: Array, ends: Array | None = None, resolved: bool = False
    ) -> tuple[Array, NDArray[np.intp], Array]:
        """Postures (n, joints) that follow placements (m, 4, 4) of the last joint.

        Args:
            targets: one path for all, or one for each, (m, n, 4, 4).
            ends: (n, redundant) where the redundant joints are at the end; None: they stay.
            resolved: whether they go where the joints keep to the middle of their ranges.

        Returns:
            Joint paths (m, n, joints); of each posture the number of placements that it reached
            without a jump; manipulability (m, n).
        """
        m, n = len(targets), len(q)
        path, measure = np.tile(q, (m, 1, 1)), np.zeros((m, n))
        kept, alive = np.zeros(n, dtype=np.intp), np.arange(n)
        change, redundant = np.zeros_like(q), list(self.redundant)
        for k, target in enumerate(targets):
            before = path[max(k - 1, 0), alive]
            guess = before + change
            if ends is not None:
                begin = q[alive][:, redundant]
                guess[:, redundant] = begin + (ends[alive] - begin) * (k / max(m - 1, 1))
            there = np.broadcast_to(target, (n, 4, 4))[alive]
            found = (
                self.track(before, there) if resolved else self.solve(guess, there, TRACKING_STEPS)
            )
            near = np.abs(found.q - before).max(axis=1) <= JUMP
            on = (found.residual <= REACHED) & near
            alive, change = alive[on], found.q[on] - before[on] if k else change[on]
            path[k:, alive] = found.q[on]
            kept[alive] += 1
            measure[k, alive] = found.manipulability[on]
        return path, kept, measure

    def central(self, path: Array) -> Array:
        """Full turns (n, joints) [rad] that bring joint paths (m, n, joints) nearest to the middle
        of the limits; none of joints that slide."""
        middle = (self.lower + self.upper) / 2.0
        turns = np.round((middle - (path.min(axis=0) + path.max(axis=0)) / 2.0) / (2.0 * np.pi))
        free = np.array(self.geometry.turning)
        free[list(self.redundant)] = False
        return np.asarray(2.0 * np.pi * turns * free)


def box_to_last_joint(workcell: Workcell, arm: ArmGeometry, contact: Contact, i: int) -> Array:
    """T_box_joint (4, 4): the arm's last joint in the box that it holds by a contact."""
    # The geometry's own contact is replaced by the one asked for.
    T_pad_joint = inverse(workcell.contacts[i].T_box_pad) @ inverse(arm.T_joint_box)
    return np.asarray(contact.T_box_pad @ T_pad_joint)


def spun(contact: Contact, spin: float) -> Contact:
    """A contact whose pad is turned about its normal by so much more [rad]."""
    turn = pose_matrix(np.zeros(3), np.array([0.0, 0.0, spin]))
    return replace(contact, T_box_pad=contact.T_box_pad @ turn)


def shoulders(workcell: Workcell) -> Array:
    """(2, 3) where each arm's first joint of its own is in the world, all joints at the middle of
    their ranges [m]."""
    found = []
    for i, robot in enumerate(workcell.robots):
        arm = ArmKinematics.of(workcell, i, ())
        names = list(arm_model(robot).names)[1:]
        own = [k for k, name in enumerate(names) if name not in common_joints(workcell.robots)]
        frames, _ = arm.chain((arm.lower + arm.upper)[None] / 2.0)
        found.append(frames[0, own[0], :3])
    return np.array(found)


def possible_spins(contact: Contact, spins: Array) -> Array:
    """Those of spins (n,) [rad] that leave a robot's patches where they are: all of one round pad,
    half turns of a rectangular one, none beside 0 where further pads stand beside the first."""
    if contact.further:
        return np.zeros(1)
    if contact.half_sides is None:
        return spins
    return np.asarray(spins[np.abs(np.sin(spins)) < 1e-9])


def guide(start: Array, goal: Array, bow: Array) -> Array:
    """(GUIDE_POSES, 6 + m) from one extended pose to another, bowing out by (3,) in the middle."""
    poses = np.linspace(start, goal, GUIDE_POSES)
    poses[:, :3] += np.sin(np.linspace(0.0, np.pi, GUIDE_POSES))[:, None] * bow
    return poses


def _turns(axis: Array, angle: Array) -> Array:
    """(n, 3, 3) rotations about a unit axis (Rodrigues)."""
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sine * K + (1.0 - cosine) * (K @ K))


def _error(target: Array, T: Array) -> tuple[Array, Array]:
    """Newton's right-hand side (n, 6) and the pose residual (n,)."""
    R, R_target = T[:, :3, :3], target[:, :3, :3]
    dR = R_target @ R.transpose(0, 2, 1)
    axis = np.stack(
        [dR[:, 2, 1] - dR[:, 1, 2], dR[:, 0, 2] - dR[:, 2, 0], dR[:, 1, 0] - dR[:, 0, 1]], axis=1
    )
    dp = target[:, :3, 3] - T[:, :3, 3]
    turn_squared = np.sum((R_target - R) ** 2, axis=(1, 2)) / 2.0
    residual = np.sqrt(np.sum(dp**2, axis=1) + turn_squared)
    return np.concatenate([dp, axis / 2.0], axis=1), residual
