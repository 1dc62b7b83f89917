"""Kinematics of one arm that holds the box. `newton.cpp` computes poses, Jacobians and Newton
steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.extension import compiled_module
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

LIMIT_MARGIN = 0.02
"""Distance of a first path from joint limits [rad]."""

JUMP = 0.5
"""Largest change of a joint between poses of a path [rad]."""

SAME_PATCH = 1e-6
"""Difference below which patches cover one another [m, and of unit vectors]."""


@cache
def compiled_newton() -> Any:
    """Return the compiled module of `newton.cpp`, which solves the inverse kinematics of many
    postures by Newton's method. It is the same for every arm and was compiled at installation.

    Raises:
        BridgeError: it is missing or cannot be loaded.
    """
    return compiled_module("hybrid_opt.extras.proposing._newton", "the compiled part of proposals")


@dataclass(frozen=True)
class Postures:
    """n postures of one arm, and how well each puts the last joint at its wanted placement.

    Attributes:
        q: (n, joints) joint positions [rad or m].
        residual: (n,) distance of the last joint from its wanted placement: root of the squared
            position error [m] plus the squared rotation error [rad].
        determinant: (n,) determinant of the Jacobian of the six joints that are not redundant
            [m^3]. If its sign changes along a path, the arm passes a singular posture.
    """

    q: Array
    residual: Array
    determinant: Array

    @property
    def manipulability(self) -> Array:
        """(n,) manipulability of each posture: the absolute value of `determinant` [m^3]."""
        return np.abs(self.determinant)


class ArmKinematics:
    """Numeric kinematics of one arm of a cell.

    Attributes:
        workcell: the cell.
        arm: index of the arm.
        geometry: joint axes and limits of the arm, and the transform to the box that it holds.
        redundant: indices of the redundant joints; the other six are solved for the box pose.
        common: indices of the redundant joints that also move the other arm, in the order of the
            task's redundant joints.
        lower, upper: (joints,) joint limits [rad or m].
        least: least manipulability of a hold [m^3], `MANIPULABILITY_MARGIN` times the robot's
            `min_manipulability`.
        compiled: the arm in the compiled module.
    """

    def __init__(
        self,
        workcell: Workcell,
        arm: int,
        geometry: ArmGeometry | None = None,
        redundant: tuple[int, ...] | None = None,
    ) -> None:
        self.workcell, self.arm = workcell, arm
        self.geometry = geometry = geometry or arm_geometry(workcell, arm)
        own = tuple(joint for joint, _ in workcell.task.redundant_entries[arm])
        self.redundant = own if redundant is None else redundant
        self.common = [joint.drives[arm] for joint in workcell.task.redundant if joint.is_common]
        self.following = [k for k in range(geometry.joints) if k not in self.redundant]
        self.lower, self.upper = np.asarray(geometry.lower), np.asarray(geometry.upper)
        self.least = workcell.robots[arm].min_manipulability * MANIPULABILITY_MARGIN
        self.compiled = compiled_newton().Arm(
            geometry.T_world_root,
            geometry.origins,
            geometry.axes,
            geometry.turning,
            self.following,
        )

    def moved(self, T_world_root: Array) -> ArmKinematics:
        """Return the same arm with its root, the frame in which the first joint is fixed, at
        another pose.

        Args:
            T_world_root: (4, 4) pose of the root in the world.
        """
        geometry = replace(self.geometry, T_world_root=T_world_root)
        return ArmKinematics(self.workcell, self.arm, geometry)

    def with_redundant(self, joints: tuple[int, ...]) -> ArmKinematics:
        """Return the same arm with other redundant joints, given by their indices."""
        return ArmKinematics(self.workcell, self.arm, self.geometry, joints)

    def held(self, spin: float = 0.0) -> Array:
        """Compute T_box_joint (4, 4), the pose in the box frame of the arm's last joint while the
        arm holds the box.

        Args:
            spin: rotation of the pad about its normal, in addition to the one in the file [rad].
        """
        contact = self.workcell.contacts[self.arm]
        # The geometry's own contact is replaced by the one asked for.
        T_pad_joint = inverse(contact.T_box_pad) @ inverse(self.geometry.T_joint_box)
        return np.asarray(rotate_about_normal(contact, spin).T_box_pad @ T_pad_joint)

    @property
    def span(self) -> Array:
        """(2, joints) lower and upper joint limits, each clipped to [-pi, pi] [rad or m]."""
        return np.array([np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)])

    def drawn(self, count: int, rng: np.random.Generator) -> Array:
        """Draw random postures (count, joints) [rad or m], uniform between the limits of `span`.

        Args:
            count: number of postures.
            rng: generator of the postures.
        """
        low, high = self.span
        return rng.uniform(low, high, (count, len(low)))

    def pose_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Compute pose and Jacobian of the arm's last joint.

        Args:
            q: (n, joints) joint positions [rad or m].

        Returns:
            - (n, 4, 4) pose of the last joint's frame in the world.
            - (n, 6, joints) its Jacobian: linear velocity of its origin, then angular velocity,
              along world axes, per joint velocity [m/rad, 1].
        """
        T, jacobian = self.compiled.places(q)
        return T, jacobian

    def side(self, q: Array) -> float:
        """Return the sign of the determinant of the six non-redundant joints' Jacobian. A path
        along which this sign changes passes a singular posture.

        Args:
            q: (joints,) posture [rad or m].
        """
        return float(
            np.sign(np.linalg.det(self.pose_and_jacobian(q[None])[1][0][:, self.following]))
        )

    def solve(self, q: Array, target: Array, steps: int, damping: float = 0.0) -> Postures:
        """Find postures that put the last joint at given poses, by Newton's method. Redundant
        joints keep their initial positions.

        Args:
            q: (n, joints) initial postures [rad or m].
            target: (n, 4, 4) wanted poses of the last joint in the world.
            steps: largest number of Newton steps.
            damping: 0 for pure Newton steps; small values stabilise starts far from a solution.
        """
        found = self.compiled.solve(q, target, steps, damping, REACHED / 10.0, STEP_LIMIT)
        return Postures(*found)

    def track(self, q: Array, target: Array, held: Sequence[int] = ()) -> Postures:
        """Find the postures near q that put the last joint at given poses. All joints move,
        redundant ones too, except those in `held`.

        Newton steps have least norm. The first one also moves the joints towards the middle of
        their ranges, as far as the poses leave them free. Joints stay within their limits as long
        as six others can move.

        Args:
            q: (n, joints) postures at which the search starts, such as those at the previous pose
                of a path [rad or m].
            target: (n, 4, 4) wanted poses of the last joint in the world.
            held: indices of the joints that do not move.
        """
        moving = np.isin(np.arange(q.shape[1]), held, invert=True).astype(float)
        limits = self.lower + LIMIT_MARGIN, self.upper - LIMIT_MARGIN
        found = self.compiled.track(q, target, TRACKING_STEPS, moving, *limits, DRIFT_SHARE)
        return Postures(*found)

    def follow(
        self, q: Array, targets: Array, ends: Array | None = None, resolved: bool = False
    ) -> tuple[Array, NDArray[np.intp], Array]:
        """Move the last joint through m given poses in the world, from each of n postures.

        Args:
            q: (n, joints) postures at the first pose [rad or m].
            targets: (m, 4, 4) poses for all postures, or (m, n, 4, 4) for each posture.
            ends: (n, redundant) positions of the redundant joints at the last pose [rad or m],
                reached at an even rate; None if they do not move.
            resolved: True if redundant joints move freely, near the middle of their ranges. Joints
                that also move the other arm then follow `ends`; they move freely if `ends` is None.

        Returns:
            - Joint paths (m, n, joints) [rad or m]; a path stays at its last position where it
              ends.
            - Number (n,) of poses on each path. A path ends before a pose that the arm does not
              reach, or only by a jump of a joint.
            - Manipulability (m, n) [m^3], negative beyond a singular posture.
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
        """Compute by how many full turns each joint of a path may be shifted to lie nearest to the
        middle of its limits.

        Args:
            path: (m, n, joints) n joint paths of m poses each [rad or m].

        Returns:
            Angles (n, joints) to add to each path, multiples of 2 pi [rad]; zero for sliding and
            for redundant joints.
        """
        middle = (self.lower + self.upper) / 2.0
        turns = np.round((middle - (path.min(axis=0) + path.max(axis=0)) / 2.0) / (2.0 * np.pi))
        free = np.array(self.geometry.turning)
        free[list(self.redundant)] = False
        return np.asarray(2.0 * np.pi * turns * free)


def rotate_about_normal(contact: Contact, spin: float) -> Contact:
    """Return a contact whose pad is rotated about its normal. Several pads of one contact rotate
    together about their middle.

    Args:
        contact: the contact.
        spin: angle of the rotation [rad].
    """
    turn = pose_matrix(np.zeros(3), np.array([0.0, 0.0, spin]))
    if not contact.further:
        return replace(contact, T_box_pad=contact.T_box_pad @ turn)
    points = [pad.T_box_pad[:3, 3] for pad in (contact, *contact.further)]
    middle = transform(contact.T_box_pad[:3, :3], np.mean(points, axis=0))
    return moved(contact, middle @ turn @ inverse(middle))


def moved(contact: Contact, motion: Array) -> Contact:
    """Return a contact with all its pads moved by a transform.

    Args:
        contact: the contact.
        motion: (4, 4) transform in the box frame, applied to each T_box_pad from the left.
    """
    further = tuple(replace(pad, T_box_pad=motion @ pad.T_box_pad) for pad in contact.further)
    return replace(contact, T_box_pad=motion @ contact.T_box_pad, further=further)


def covers_the_same(contact: Contact, other: Contact) -> bool:
    """Return True if two contacts cover the same patches of the box, whatever the order of their
    pads.

    Args:
        contact: a contact, each of whose pads needs a partner in `other`.
        other: contact whose pads are compared.
    """

    def alike(a: Contact, b: Contact) -> bool:
        apart = np.abs(a.T_box_pad[:3, 2:] - b.T_box_pad[:3, 2:]).max()
        turned = abs(float(a.T_box_pad[:3, 0] @ b.T_box_pad[:3, 0]))
        return bool(apart < SAME_PATCH and (a.half_sides is None or turned > 1.0 - SAME_PATCH))

    pads = (other, *other.further)
    return all(any(alike(pad, one) for one in pads) for pad in (contact, *contact.further))


def shoulder_positions(robots: tuple[Robot, Robot]) -> Array:
    """Compute the shoulder position of each arm in the world (2, 3) [m], with all joints at the
    middle of their ranges.

    The shoulder is the origin of the first joint that moves this arm only.

    Args:
        robots: both robots.
    """
    found = []
    for robot in robots:
        model = arm_model(robot)
        own = [name not in common_joints(robots) for name in list(model.names)[1:]].index(True)
        data, q = model.createData(), (robot.position_lower + robot.position_upper) / 2.0
        pin.forwardKinematics(model, data, q)
        found.append((robot.T_world_base @ data.oMi[own + 1].homogeneous)[:3, 3])
    return np.array(found)


def has_wrist_spin(kinematics: ArmKinematics) -> bool:
    """Return True if the arm's last joint rotates the pad about its normal and is not redundant.

    Args:
        kinematics: the arm, with its contact.
    """
    geometry, contact = kinematics.geometry, kinematics.workcell.contacts[kinematics.arm]
    T_joint_pad = geometry.T_joint_box @ contact.T_box_pad
    axis = geometry.axes[-1]
    aside = T_joint_pad[:3, 3] - (T_joint_pad[:3, 3] @ axis) * axis
    parallel = abs(float(T_joint_pad[:3, 2] @ axis)) > 1.0 - 1e-6
    last_follows = geometry.joints - 1 not in kinematics.redundant
    return bool(geometry.turning[-1] and last_follows and parallel and np.linalg.norm(aside) < 1e-4)


def pose_error(target: Array, T: Array) -> tuple[Array, Array]:
    """Compute the error of poses as Newton's method uses it: wanted pose minus actual pose.

    Args:
        target: (n, 4, 4) wanted poses.
        T: (n, 4, 4) actual poses, in the same frame as `target`.

    Returns:
        - Errors (n, 6) along the axes of the common frame: difference of positions [m], then the
          sine of the angle from the actual to the wanted orientation times the rotation axis.
        - Magnitudes (n,) of the errors: root of the squared distance [m^2] plus a squared measure
          of the angle, equal to the squared angle [rad^2] for small angles.
    """
    R, R_target = T[:, :3, :3], target[:, :3, :3]
    dR = R_target @ R.transpose(0, 2, 1)
    axis = np.stack(
        [dR[:, 2, 1] - dR[:, 1, 2], dR[:, 0, 2] - dR[:, 2, 0], dR[:, 1, 0] - dR[:, 0, 1]], axis=1
    )
    dp = target[:, :3, 3] - T[:, :3, 3]
    turn_squared = np.sum((R_target - R) ** 2, axis=(1, 2)) / 2.0
    residual = np.sqrt(np.sum(dp**2, axis=1) + turn_squared)
    return np.concatenate([dp, axis / 2.0], axis=1), residual
