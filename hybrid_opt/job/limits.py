"""How far each phase of a job uses the limits of arms, box and contacts."""

from __future__ import annotations

import numpy as np

from hybrid_opt.job.records import Force, PhaseMotion, contact_effort
from hybrid_opt.timing.records import JerkLimits
from symbolic.array import Array
from symbolic.records import Workcell

EXCESS = 1.005
"""Use of a limit beyond which a job is refused."""

_FORCE_FLOOR = 1e-9
_SAME_TIME = 1e-9
_NO_JUMP = 1e-6


def phase_use(
    workcell: Workcell, motion: PhaseMotion, force: Force, jerk: JerkLimits | None = None
) -> dict[str, float]:
    """Largest value over its limit by constraint, of what every phase has.

    Torques are those of arms and commanded contact wrenches together. Friction and pressure are
    judged where forces are planned (`hybrid_opt.timing`): pressing harder only helps them.
    """

    def joints(name: str) -> Array:
        return np.concatenate([getattr(robot, name) for robot in workcell.robots])

    lower, upper = joints("position_lower"), joints("position_upper")
    effort = motion.own_torque + contact_effort(motion, force.wrench)
    payload = workcell.payload
    bounded = {} if jerk is None else _jerk_use(motion, jerk)
    return bounded | {
        "joint position": _most(np.abs(2.0 * motion.q - lower - upper) / (upper - lower)),
        "joint velocity": _most(np.abs(motion.q_rate) / joints("velocity_max")),
        "joint acceleration": _most(np.abs(motion.q_second) / joints("acceleration_max")),
        "joint torque": _most(np.abs(effort) / joints("torque_max")),
        "payload velocity": _most(_length(motion.rate) / payload.velocity_max),
        "payload acceleration": _most(_length(motion.second_rate) / payload.acceleration_max),
        "least normal force": _most(force.least / np.maximum(force.normal, _FORCE_FLOOR)),
    }


def _jerk_use(motion: PhaseMotion, limits: JerkLimits) -> dict[str, float]:
    joints = _jerk(motion.time, motion.q_second)
    box = _length(_jerk(motion.time, motion.second_rate))
    use = {"joint jerk": _most(joints / limits.joints), "payload jerk": _most(box / limits.payload)}
    limited = {
        "joint jerk": np.isfinite(limits.joints).any(),
        "payload jerk": np.isfinite(limits.payload),
    }
    return {name: ratio for name, ratio in use.items() if limited[name]}


def _jerk(time: Array, second: Array) -> Array:
    """(n - 1, k) magnitudes of the change of accelerations (n, k) per time; infinite at jumps."""
    steps, change = np.diff(time)[:, None], np.abs(np.diff(second, axis=0))
    jumps = np.where(change > _NO_JUMP, np.inf, 0.0)
    return np.where(steps > _SAME_TIME, change / np.maximum(steps, _SAME_TIME), jumps)


def _most(ratio: Array) -> float:
    return float(ratio.max())


def _length(rate: Array) -> Array:
    return np.asarray(np.linalg.norm(rate[:, :3], axis=1))
