"""A timed carry at even time steps, as robot controllers take it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from hybrid_opt.carry import ArmMotion, Carry
from hybrid_opt.timing.records import Timing
from symbolic.array import Array
from symbolic.errors import SettingsError

LEAST_STEP = 1e-3
LARGEST_STEP = 1.0
"""Range of the time step [s]."""


def sample_timing(timing: Timing, step: float) -> Carry:
    """A timing's carry at even time steps, from time 0.

    Joints and box follow cubic Hermite pieces between the timing's own samples, which are denser
    than any sensible step; rates and accelerations are those of the pieces. Everything else is
    interpolated linearly.

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
    time = carry.time[keep] - carry.time[0]
    grid = np.linspace(0.0, carry.duration, math.ceil(carry.duration / step - 1e-9) + 1)

    def between(values: Array) -> Array:
        flat = values[keep].reshape(len(time), -1)
        columns = [np.interp(grid, time, column) for column in flat.T]
        return np.stack(columns, axis=1).reshape(len(grid), *values.shape[1:])

    def arm_between(arm: ArmMotion) -> ArmMotion:
        joints = CubicHermiteSpline(time, arm.q[keep], arm.q_rate[keep])
        return ArmMotion(
            joints(grid),
            joints(grid, 1),
            joints(grid, 2),
            between(arm.contact_torque),
            between(arm.own_torque),
        )

    box = CubicHermiteSpline(time, carry.pose[keep], carry.rate[keep])
    return replace(
        carry,
        parameter=between(carry.parameter),
        time=grid,
        pose=box(grid),
        rate=box(grid, 1),
        second_rate=box(grid, 2),
        angular_velocity=between(carry.angular_velocity),
        angular_acceleration=between(carry.angular_acceleration),
        normal_force=between(carry.normal_force),
        tangential_force=between(carry.tangential_force),
        contact_force=between(carry.contact_force),
        pressure_shift=between(carry.pressure_shift),
        point_moment_residual=between(carry.point_moment_residual),
        moment_residual=between(carry.moment_residual),
        arms=(arm_between(carry.arms[0]), arm_between(carry.arms[1])),
    )
