"""Kinematics of one arm that holds the box, for many postures side by side in NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.geometry.bodies import ArmGeometry, arm_geometry
from symbolic.read.arms import arm_model, common_joints
from symbolic.records import Contact, Robot, Workcell
from symbolic.records.poses import inverse, pose_matrix, transform

REACHED = 1e-6
"""A posture counts as reached if its pose residual is smaller [m, rad]."""

STEP_LIMIT = 0.4
"""Largest change of a joint in one step [rad]."""

TRACKING_STEPS = 4
"""Number of Newton steps from one pose of a path to the next."""

DRIFT_SHARE = 0.03
"""Share of the way to the middle of their ranges by which joints drift from pose to pose."""

MANIPULABILITY_MARGIN = 1.1
"""Least manipulability of a hold, over the least of the cell."""

JUMP = 0.5
"""Largest change of a joint between poses of a path [rad]."""

SAME_PATCH = 1e-6
"""Difference below which patches cover one another [m, and of unit vectors]."""


@dataclass(frozen=True)
class Postures:
    """n postures of one arm.

    Attributes:
        q: (n, joints) [rad or m].
        residual: (n,) pose residual [m, rad].
        determinant: (n,) det J of the six joints that follow [m^3]. If its sign changes along a
            path, the arm passes a singular posture.
    """

    q: Array
    residual: Array
    determinant: Array

    @property
    def manipulability(self) -> Array:
        """(n,) abs(det J) [m^3]."""
        return np.abs(self.determinant)


class ArmKinematics:
    """Numeric kinematics of one arm of a cell.

    Attributes:
        workcell: the cell.
        arm: index of the arm.
        geometry: joints of the arm.
        redundant: indices of the redundant joints; the other six follow the box.
        common: indices of the redundant joints that move the other arm too, in the order of the
            task.
        lower, upper: (joints,) limits [rad or m].
        least: least manipulability of a first path [m^3].
    """

    def __init__(self, workcell: Workcell, arm: int, geometry: ArmGeometry | None = None) -> None:
        self.workcell, self.arm = workcell, arm
        self.geometry = geometry = geometry or arm_geometry(workcell, arm)
        self.redundant = tuple(joint for joint, _ in workcell.task.redundant_places[arm])
        self.common = [joint.drives[arm] for joint in workcell.task.redundant if joint.is_common]
        self.following = [k for k in range(geometry.joints) if k not in self.redundant]
        self.lower, self.upper = np.asarray(geometry.lower), np.asarray(geometry.upper)
        self.least = workcell.robots[arm].min_manipulability * MANIPULABILITY_MARGIN

    def moved(self, T_world_root: Array) -> ArmKinematics:
        """Return the arm with another placement T_world_root (4, 4)."""
        geometry = replace(self.geometry, T_world_root=T_world_root)
        return ArmKinematics(self.workcell, self.arm, geometry)

    def held(self, spin: float = 0.0) -> Array:
        """Compute T_box_joint (4, 4), the arm's last joint in the frame of the box that it holds,
        with the pad rotated about its normal by `spin` [rad]."""
        contact = self.workcell.contacts[self.arm]
        # The geometry's own contact is replaced by the one asked for.
        T_pad_joint = inverse(contact.T_box_pad) @ inverse(self.geometry.T_joint_box)
        return np.asarray(rotate_about_normal(contact, spin).T_box_pad @ T_pad_joint)

    @property
    def span(self) -> Array:
        """(2, joints) lower and upper joint limits, clipped to plus and minus half a turn [rad or
        m]."""
        return np.array([np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)])

    def drawn(self, count: int, rng: np.random.Generator) -> Array:
        """Draw random postures (count, joints) within `span` [rad or m]."""
        low, high = self.span
        return rng.uniform(low, high, (count, len(low)))

    def chain(self, q: Array) -> tuple[Array, Array]:
        """Compute origins and axes (n, joints, 6) of the joints and the last joint's placement (n,
        4, 4), in the world."""
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
        """Compute the Jacobian (n, 6, joints) of the last joint's origin, along world axes, from
        the results of `chain`."""
        points, axes = frames[:, :, :3], frames[:, :, 3:]
        turning = np.array(self.geometry.turning)[:, None]
        across = np.cross(axes, T[:, None, :3, 3] - points)
        linear = np.where(turning, across, axes)
        return np.concatenate([linear, np.where(turning, axes, 0.0)], axis=2).transpose(0, 2, 1)

    def side(self, q: Array) -> float:
        """Return the sign of det J in a posture (joints,). A path on which it changes passes a
        singular posture."""
        return float(
            np.sign(np.linalg.det(self.jacobian(*self.chain(q[None]))[0][:, self.following]))
        )

    def solve(self, q: Array, target: Array, steps: int, damping: float = 0.0) -> Postures:
        """Find postures with which the last joint has the wanted placements, by Newton's method.

        Args:
            q: (n, joints) initial postures [rad or m].
            target: (n, 4, 4) wanted placements of the last joint in the world.
            steps: number of steps.
            damping: 0 for pure Newton steps; small values stabilise starts far from a solution.
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
        return Postures(q, residual, np.linalg.det(J))

    def track(self, q: Array, target: Array, held: Sequence[int] = ()) -> Postures:
        """Find the next postures (n, joints) near q at placements (n, 4, 4) of the last joint. All
        joints move except those in `held`.

        Steps have least norm and drift to the middle of the joint ranges as far as the box leaves
        joints free.
        """
        q = np.array(q, dtype=float)
        middle = (self.lower + self.upper) / 2.0
        moving = np.isin(np.arange(q.shape[1]), held, invert=True)
        for step in range(TRACKING_STEPS + 1):
            frames, T = self.chain(q)
            J = self.jacobian(frames, T)
            error, residual = _error(target, T)
            if step == TRACKING_STEPS:
                break
            own = J * moving
            inverted = own.transpose(0, 2, 1) @ np.linalg.inv(
                own @ own.transpose(0, 2, 1) + 1e-9 * np.eye(6)
            )
            drift = DRIFT_SHARE * (middle - q) * moving if step == 0 else np.zeros_like(q)
            missing = error - np.einsum("nij,nj->ni", own, drift)
            q += drift + np.einsum("nij,nj->ni", inverted, missing)
        return Postures(q, residual, np.linalg.det(J[:, :, self.following]))

    def follow(
        self, q: Array, targets: Array, ends: Array | None = None, resolved: bool = False
    ) -> tuple[Array, NDArray[np.intp], Array]:
        """Follow m placements of the last joint from n postures, pose by pose.

        Args:
            q: (n, joints) postures at the first placement [rad or m].
            targets: (m, 4, 4) placements for all postures, or (m, n, 4, 4) for each posture.
            ends: (n, redundant) final positions of the redundant joints; None if they do not move.
            resolved: True if redundant joints move freely such that joints stay near the middle of
                their ranges; common joints only without `ends`.

        Returns:
            Joint paths (m, n, joints); for each posture the number of placements reached without a
            jump; manipulability (m, n), negative beyond a singular posture.
        """
        m, n = len(targets), len(q)
        path, measure = np.tile(q, (m, 1, 1)), np.zeros((m, n))
        kept, alive = np.zeros(n, dtype=np.intp), np.arange(n)
        change, redundant, side = np.zeros_like(q), list(self.redundant), np.ones(n)
        for k, target in enumerate(targets):
            before = path[max(k - 1, 0), alive]
            guess = before + change
            if ends is not None:
                begin = q[alive][:, redundant]
                guess[:, redundant] = begin + (ends[alive] - begin) * (k / max(m - 1, 1))
            there = np.broadcast_to(target, (n, 4, 4))[alive]
            if resolved:
                held = [] if ends is None else self.common
                placed = before.copy()
                placed[:, held] = guess[:, held]
                found = self.track(placed, there, held)
            else:
                found = self.solve(guess, there, TRACKING_STEPS)
            near = np.abs(found.q - before).max(axis=1) <= JUMP
            on = (found.residual <= REACHED) & near
            alive, change = alive[on], found.q[on] - before[on] if k else change[on]
            path[k:, alive] = found.q[on]
            kept[alive] += 1
            side = side[on] if k else np.sign(found.determinant[on])
            measure[k, alive] = found.determinant[on] * side
        return path, kept, measure

    def central(self, path: Array) -> Array:
        """Compute the full turns (n, joints) [rad] that bring joint paths (m, n, joints) nearest to
        the middle of the limits; zero for prismatic joints."""
        middle = (self.lower + self.upper) / 2.0
        turns = np.round((middle - (path.min(axis=0) + path.max(axis=0)) / 2.0) / (2.0 * np.pi))
        free = np.array(self.geometry.turning)
        free[list(self.redundant)] = False
        return np.asarray(2.0 * np.pi * turns * free)


def rotate_about_normal(contact: Contact, spin: float) -> Contact:
    """Return a contact with its pad rotated about its normal by an angle [rad]. If the contact has
    several pads, they rotate together about their middle."""
    turn = pose_matrix(np.zeros(3), np.array([0.0, 0.0, spin]))
    if not contact.further:
        return replace(contact, T_box_pad=contact.T_box_pad @ turn)
    points = [pad.T_box_pad[:3, 3] for pad in (contact, *contact.further)]
    middle = transform(contact.T_box_pad[:3, :3], np.mean(points, axis=0))
    return moved(contact, middle @ turn @ inverse(middle))


def moved(contact: Contact, motion: Array) -> Contact:
    """Return a contact with all its pads moved by a transform (4, 4), in the box frame."""
    further = tuple(replace(pad, T_box_pad=motion @ pad.T_box_pad) for pad in contact.further)
    return replace(contact, T_box_pad=motion @ contact.T_box_pad, further=further)


def covers_the_same(contact: Contact, other: Contact) -> bool:
    """Return True if two contacts have pads of the same kind that cover the same patches, in any
    order."""

    def alike(a: Contact, b: Contact) -> bool:
        apart = np.abs(a.T_box_pad[:3, 2:] - b.T_box_pad[:3, 2:]).max()
        turned = abs(float(a.T_box_pad[:3, 0] @ b.T_box_pad[:3, 0]))
        return bool(apart < SAME_PATCH and (a.half_sides is None or turned > 1.0 - SAME_PATCH))

    pads = (other, *other.further)
    return all(any(alike(pad, one) for one in pads) for pad in (contact, *contact.further))


def shoulder_positions(robots: tuple[Robot, Robot]) -> Array:
    """Return the position (2, 3) of the first joint that moves only one arm, for each arm in the
    world [m], with all joints at the middle of their ranges."""
    found = []
    for robot in robots:
        model = arm_model(robot)
        own = [name not in common_joints(robots) for name in list(model.names)[1:]].index(True)
        data, q = model.createData(), (robot.position_lower + robot.position_upper) / 2.0
        pin.forwardKinematics(model, data, q)
        found.append((robot.T_world_base @ data.oMi[own + 1].homogeneous)[:3, 3])
    return np.array(found)


def has_wrist_spin(kinematics: ArmKinematics) -> bool:
    """Return True if the arm's last joint rotates the pad about its normal."""
    geometry, contact = kinematics.geometry, kinematics.workcell.contacts[kinematics.arm]
    T_joint_pad = geometry.T_joint_box @ contact.T_box_pad
    axis = geometry.axes[-1]
    aside = T_joint_pad[:3, 3] - (T_joint_pad[:3, 3] @ axis) * axis
    parallel = abs(float(T_joint_pad[:3, 2] @ axis)) > 1.0 - 1e-6
    last_follows = geometry.joints - 1 not in kinematics.redundant
    return bool(geometry.turning[-1] and last_follows and parallel and np.linalg.norm(aside) < 1e-4)


def _turns(axis: Array, angle: Array) -> Array:
    """Compute rotation matrices (n, 3, 3) for angles (n,) about a unit axis (3,)."""
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sine * K + (1.0 - cosine) * (K @ K))


def _error(target: Array, T: Array) -> tuple[Array, Array]:
    """Return the pose errors (n, 6) of placements T (n, 4, 4), the right-hand side of Newton's
    equations, and their residuals (n,) [m, rad]."""
    R, R_target = T[:, :3, :3], target[:, :3, :3]
    dR = R_target @ R.transpose(0, 2, 1)
    axis = np.stack(
        [dR[:, 2, 1] - dR[:, 1, 2], dR[:, 0, 2] - dR[:, 2, 0], dR[:, 1, 0] - dR[:, 0, 1]], axis=1
    )
    dp = target[:, :3, 3] - T[:, :3, 3]
    turn_squared = np.sum((R_target - R) ** 2, axis=(1, 2)) / 2.0
    residual = np.sqrt(np.sum(dp**2, axis=1) + turn_squared)
    return np.concatenate([dp, axis / 2.0], axis=1), residual
