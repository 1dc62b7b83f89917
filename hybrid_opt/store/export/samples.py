"""A timed carry at even time steps, as robot controllers take it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import Timing
from symbolic.array import Array
from symbolic.errors import SettingsError

LEAST_STEP = 1e-3
LARGEST_STEP = 1.0
"""Range of the time step [s]."""


@dataclass(frozen=True)
class SampledTrajectory:
    """Joint motion of both arms and the box's motion at even time steps; n samples.

    Attributes:
        name: the workcell's name.
        robots: names of the two robots.
        joints: names of each robot's joints.
        time: (n,) [s], from 0; the last step may be shorter by rounding of the duration.
        position, velocity, acceleration: (n, 2, 6) of the joints [rad, s].
        pose: (n, 6) of the box: x, y, z [m], roll, pitch, yaw [rad].
        normal_force: (n, 2) [N].
    """

    name: str
    robots: tuple[str, str]
    joints: tuple[tuple[str, ...], tuple[str, ...]]
    time: Array
    position: Array
    velocity: Array
    acceleration: Array
    pose: Array
    normal_force: Array


def sample_trajectory(model: TimingModel, timing: Timing, step: float) -> SampledTrajectory:
    """A timing at even time steps.

    Joints follow cubic Hermite pieces between the timing's own samples, which are denser than any
    sensible step; the acceleration is that of the pieces.

    Args:
        step: time between samples [s]; it is shrunk so that whole steps fill the duration.

    Raises:
        SettingsError: the step is out of range, or there is no timing to export.
    """
    if not LEAST_STEP <= step <= LARGEST_STEP:
        raise SettingsError(f"time step {step:g} s; allowed is {LEAST_STEP:g} to {LARGEST_STEP:g}")
    carry = timing.carry
    if carry is None or not timing.ok:
        raise SettingsError(
            f"there is no timing to export ({timing.status}: {timing.reason}); export one that "
            "robots can drive"
        )
    keep = np.concatenate([[True], np.diff(carry.time) > 0.0])
    time = carry.time[keep]
    grid = np.linspace(0.0, carry.duration, math.ceil(carry.duration / step - 1e-9) + 1)
    joints = CubicHermiteSpline(time, carry.q[keep], carry.q_rate[keep])
    box = CubicHermiteSpline(time, carry.pose[keep], carry.rate[keep])
    shape = (len(grid), 2, 6)
    return SampledTrajectory(
        name=model.workcell.name,
        robots=(model.workcell.robots[0].name, model.workcell.robots[1].name),
        joints=model.joint_names,
        time=grid,
        position=joints(grid).reshape(shape),
        velocity=joints(grid, 1).reshape(shape),
        acceleration=joints(grid, 2).reshape(shape),
        pose=box(grid),
        normal_force=np.stack(
            [np.interp(grid, time, carry.normal_force[keep, i]) for i in (0, 1)], axis=1
        ),
    )
