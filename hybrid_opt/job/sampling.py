"""A job at even time steps, as robot controllers take it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from hybrid_opt.job.records import Job, Phase
from symbolic.array import Array
from symbolic.errors import SettingsError

LEAST_STEP = 1e-3
LARGEST_STEP = 1.0
"""Range of the time step [s]."""


@dataclass(frozen=True, eq=False)
class SampledJob:
    """A job at n samples; both arms' joints side by side, world frame, read-only.

    Where two phases meet stands one sample, the last of the earlier one.

    Attributes:
        job: the job.
        time: (n,) from the beginning of the job [s].
        last: per phase the index of its last sample.
        pose: (n, 6) of the box [m, rad].
        q, q_rate, q_second: (n, joints) [rad, s].
        effort: (n, joints) torques of arms and commanded contact wrenches [N m].
        normal_force: (n, 2) commanded [N].
        wrench: (n, 2, 6) of each robot on the box about its nominal contact point [N, N m].
    """

    job: Job
    time: Array
    last: tuple[int, ...]
    pose: Array
    q: Array
    q_rate: Array
    q_second: Array
    effort: Array
    normal_force: Array
    wrench: Array

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    def span(self, index: int) -> slice:
        """The samples of a phase, both ends included."""
        return slice(self.last[index - 1] if index else 0, self.last[index] + 1)

    @property
    def phase_names(self) -> tuple[str, ...]:
        """(n,) the phase that leads to each sample."""
        names: list[str] = []
        for phase, last in zip(self.job.phases, self.last, strict=True):
            names += [phase.name] * (last + 1 - len(names))
        return tuple(names)

    def arm(self, index: int, values: Array) -> Array:
        """The columns of one arm (0 or 1) of (n, joints)."""
        first = len(self.job.joint_names[0])
        return values[:, :first] if index == 0 else values[:, first:]


def sample_job(job: Job, step: float) -> SampledJob:
    """A job at even time steps within each phase, from time 0.

    Joints and box follow cubic Hermite pieces between the job's own samples, which are denser than
    any sensible step; accelerations, torques and forces are interpolated linearly.

    Args:
        step: time between samples [s]; it is shrunk so that whole steps fill each phase.

    Raises:
        SettingsError: the step is out of range.
    """
    if not LEAST_STEP <= step <= LARGEST_STEP:
        raise SettingsError(f"time step {step:g} s; allowed is {LEAST_STEP:g} to {LARGEST_STEP:g}")
    parts = [_sampled(phase, step) for phase in job.phases]
    last = np.cumsum([len(part["time"]) for part in parts]) - 1
    # The sample where two phases meet is the earlier one's last.
    last -= np.arange(len(parts))
    joined = {
        name: np.concatenate(
            [part[name] if k == 0 else part[name][1:] for k, part in enumerate(parts)]
        )
        for name in parts[0]
    }
    return SampledJob(job, last=tuple(last.tolist()), **joined)


def _sampled(phase: Phase, step: float) -> dict[str, Array]:
    motion, force = phase.motion, phase.force
    keep = np.concatenate([[True], np.diff(motion.time) > 0.0])
    time = motion.time[keep]
    grid = np.linspace(0.0, motion.duration, math.ceil(motion.duration / step - 1e-9) + 1)

    def between(values: Array) -> Array:
        flat = values[keep].reshape(len(time), -1)
        rows = np.stack([np.interp(grid, time, column) for column in flat.T], axis=1)
        found = rows.reshape(len(grid), *values.shape[1:])
        found[-1] = values[-1]
        return found

    joints = CubicHermiteSpline(time, motion.q[keep], motion.q_rate[keep])
    box = CubicHermiteSpline(time, motion.pose[keep], motion.rate[keep])
    return {
        "time": phase.begin + grid,
        "pose": box(grid),
        "q": joints(grid),
        "q_rate": joints(grid, 1),
        "q_second": between(motion.q_second),
        "effort": between(phase.effort),
        "normal_force": between(force.normal),
        "wrench": between(force.wrench),
    }
