"""The drive of the witness: the box's planned motion and the pressing force, per time step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.witness.scene import PAD_MASS, SimulationSettings, quaternion, tilt_centre
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records.poses import box_rotation

SAME_TIME = 1e-9
"""Samples closer than this stand for both sides of one instant [s]."""


@dataclass(frozen=True)
class Drive:
    """The carriage's motion and the pressing force at n time steps; world frame.

    Attributes:
        leader: index of the pad that keeps its place on the carriage.
        time: (n,) from minus the time to settle to the end of the carry [s].
        position, velocity, acceleration: (n, 3) of the box frame [m, s].
        rotation: (n, 3, 3) R_world_box.
        quaternion: (n, 4) the same, real part first.
        spin, spin_rate: (n, 3) angular velocity and acceleration in the box frame [rad, s].
        press: (n,) normal force of the other pad [N].
        tilt: (n, 2, 2) planned moments of both pads about the x and y axes of their frames [N m].
        own: (n,) force that the sliding pad's own mass takes along its normal [N].
    """

    leader: int
    time: Array
    position: Array
    velocity: Array
    acceleration: Array
    rotation: Array
    quaternion: Array
    spin: Array
    spin_rate: Array
    press: Array
    tilt: Array
    own: Array


@dataclass(frozen=True, eq=False)
class PlannedMoments:
    """Moments that each robot's pads are to exert on the box about their middle, world frame.

    Attributes:
        along: (n, 2, 3) at the carry's samples [N m].
        at_rest: (2, 3) at rest before it [N m].
    """

    along: Array
    at_rest: Array


def planned_moments(cell: Cell, carry: Carry) -> PlannedMoments:
    """The moments of a carry's planned wrenches, for its own friction and centre of mass."""
    workcell = carry.workcell
    friction = np.array([contact.friction for contact in workcell.contacts])
    still = np.zeros_like(carry.pose[:1])
    resting = replace(carry, pose=carry.pose[:1], rate=still, second_rate=still)
    along, at_rest = (
        np.stack([_about_middle(each, load, i) for i in (0, 1)], axis=1)
        for each, load in (
            (c, cell.timing_model.uncertain_load(c, friction, workcell.payload.centre_of_mass))
            for c in (carry, resting)
        )
    )
    return PlannedMoments(along, at_rest[0])


def _about_middle(carry: Carry, load: Mapping[str, Array], robot: int) -> Array:
    """(n, 3) moments of one robot's planned wrenches about the middle of its pads."""
    workcell, wrench = carry.workcell, load[f"wrench_{robot + 1}"]
    contact = workcell.contacts[robot]
    in_box = contact.T_box_pad[:3, :3] @ tilt_centre(contact)
    arm = box_rotation(workcell.task.orientation, carry.pose) @ in_box
    return np.asarray(wrench[:, 3:] - np.cross(arm, wrench[:, :3]))


def drive_of(
    carry: Carry,
    settings: SimulationSettings,
    press: Array | None = None,
    leader: int = 0,
    moments: PlannedMoments | None = None,
) -> Drive:
    """A carry from rest to rest, with the box at rest before it.

    Args:
        press: (n,) force to press with at the carry's samples; the planned normal force of the
            arm that does not lead by default [N].
        leader: index of the arm that keeps its place.
        moments: what drives pads that tilt; none by default.

    Raises:
        SettingsError: the carry does not start and end at rest, or the force does not fit it.
    """
    if max(np.abs(carry.rate[[0, -1]]).max(), np.abs(carry.angular_velocity[[0, -1]]).max()) > 1e-3:
        raise SettingsError("the carry does not start and end at rest; give one with a timing")
    force = carry.normal_force[:, 1 - leader] if press is None else press
    if force.shape != carry.time.shape:
        raise SettingsError(f"forces of shape {force.shape} for {len(carry)} samples")
    begin, end = float(carry.time[0]), float(carry.time[-1])
    steps = int(np.ceil((end - begin + settings.settle) / settings.time_step)) + 1
    time = begin - settings.settle + settings.time_step * np.arange(steps)
    clipped = np.clip(time, begin, end)
    moving = ((time > begin) & (time < end))[:, None]
    pose, rate = _pose(carry, clipped)
    rotation = box_rotation(carry.workcell.task.orientation, pose)
    acceleration, omega, alpha = (
        moving * _interpolated(clipped, carry.time, values)
        for values in (carry.second_rate[:, :3], carry.angular_velocity, carry.angular_acceleration)
    )
    T_box_pad = carry.workcell.contacts[1 - leader].T_box_pad
    arm, normal = rotation @ T_box_pad[:3, 3], rotation @ T_box_pad[:3, 2]
    at_pad = acceleration + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
    return Drive(
        leader=leader,
        time=np.asarray(time),
        position=pose[:, :3],
        velocity=moving * rate[:, :3],
        acceleration=acceleration,
        rotation=rotation,
        quaternion=quaternion(rotation),
        spin=np.einsum("nji,nj->ni", rotation, omega),
        spin_rate=np.einsum("nji,nj->ni", rotation, alpha),
        press=np.interp(clipped, carry.time, force),
        tilt=_tilt(carry, np.asarray(time), rotation, moments),
        own=PAD_MASS * np.einsum("ni,ni->n", at_pad, normal),
    )


def _tilt(carry: Carry, time: Array, rotation: Array, moments: PlannedMoments | None) -> Array:
    """(steps, 2, 2) moments about the axes in the planes of the pads."""
    tilt = np.zeros((len(time), 2, 2))
    if moments is None:
        return tilt
    for i, contact in enumerate(carry.workcell.contacts):
        moment = _interpolated(time, carry.time, moments.along[:, i])
        moment[time < carry.time[0]] = moments.at_rest[i]
        axes = rotation @ contact.T_box_pad[:3, :2]
        tilt[:, i] = np.einsum("nji,nj->ni", axes, moment)
    return tilt


def _pose(carry: Carry, time: Array) -> tuple[Array, Array]:
    """Poses and rates (n, 6) at times within the carry, which fit one another."""
    single = np.concatenate([[True], np.diff(carry.time) > SAME_TIME])
    spline = CubicHermiteSpline(carry.time[single], carry.pose[single], carry.rate[single])
    return spline(time), spline(time, 1)


def _interpolated(at: Array, time: Array, values: Array) -> Array:
    return np.column_stack([np.interp(at, time, column) for column in values.T])
