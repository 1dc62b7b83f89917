"""The carry as a phase of a job: its own timing, and rest until the next tick."""

from __future__ import annotations

import numpy as np

from hybrid_opt.carry import Carry, joints_of
from hybrid_opt.job.profile import at_even_steps
from hybrid_opt.job.records import PhaseMotion
from hybrid_opt.job.straight import TICK
from hybrid_opt.timing.model import TimingModel
from symbolic.array import Array

_MOVING = ("rate", "second_rate", "q_rate", "q_second")


def carry_motion(model: TimingModel, carry: Carry) -> PhaseMotion:
    """The carry as it is timed, then at rest until a whole number of ticks is over."""
    q = np.ascontiguousarray(carry.q)
    pose = np.ascontiguousarray(carry.pose)
    values = {
        "pose": pose,
        "rate": carry.rate,
        "second_rate": carry.second_rate,
        "q": q,
        "q_rate": carry.side_by_side("q_rate"),
        "q_second": carry.side_by_side("q_second"),
        "own_torque": carry.side_by_side("own_torque"),
        "wrench_torque": model.wrench_torque(q, pose),
    }
    time = carry.time - carry.time[0]
    still = _standing_torque(model, q[-1], pose[-1])
    last = {
        name: 0.0 * array[-1] if name in _MOVING else array[-1] for name, array in values.items()
    }
    last["own_torque"] = still
    ends = np.array([time[-1], max(at_even_steps(float(time[-1]), TICK), time[-1])])
    return PhaseMotion(
        first=carry.arms[0].q.shape[1],
        time=np.concatenate([time, ends]),
        **{
            name: np.concatenate([array, [last[name]] * len(ends)])
            for name, array in values.items()
        },
    )


def _standing_torque(model: TimingModel, q: Array, pose: Array) -> Array:
    """(joints,) torques that hold the bare arms still [N m]."""
    still = np.zeros((1, 6))
    own = joints_of(model.workcell, q[None])
    parts = [model.arm_motion(arm, own[arm], pose[None], still) for arm in (0, 1)]
    return np.concatenate([part["torque_at_rest"][0] for part in parts])
