"""The forces of a job's phases, and how far each phase uses its limits with them.

Forces hold the box; they are pressed on and let go smoothly. Limits are those of arms, box and
contacts.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybrid_opt.job.motions import PEAK_RATE, SAMPLES, TICK, at_even_steps, rise
from hybrid_opt.job.records import Force, PhaseMotion, contact_effort
from hybrid_opt.robust.force import BoxMotion
from hybrid_opt.robust.squeeze import (
    Squeeze,
    SqueezeSettings,
    pressed_beyond,
    pressed_together,
)
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import JerkLimits
from symbolic.array import Array
from symbolic.contact.grasp import Grasp
from symbolic.contact.load import robot_wrenches
from symbolic.records import Workcell
from symbolic.records.poses import box_rotation

EXCESS = 1.005
"""Use of a limit beyond which a job is refused."""

_FORCE_FLOOR = 1e-9

_SAME_TIME = 1e-9

_NO_JUMP = 1e-6


def holding(
    model: TimingModel, settings: SqueezeSettings, motions: Sequence[PhaseMotion]
) -> tuple[list[Force], Squeeze]:
    """Forces of phases that follow one another, with the box held in all of them, and how they came
    about.

    Raises:
        SettingsError: the uncertainty leaves no friction or patch.
    """
    ends = np.cumsum([0.0, *(motion.duration for motion in motions)])
    time = np.concatenate([m.time + at for m, at in zip(motions, ends[:-1], strict=True)])
    box = BoxMotion(
        *(
            np.ascontiguousarray(np.concatenate([getattr(motion, name) for motion in motions]))
            for name in ("pose", "rate", "second_rate")
        )
    )
    load = model.load(box.pose, box.rate, box.second_rate)
    least, wrench = load["normal_force"], np.stack([load["wrench_1"], load["wrench_2"]], axis=1)
    extra, squeeze = pressed_beyond(model.workcell, settings, time, box, least)
    normal = least + np.multiply.outer(extra, pressed_together(model.workcell, squeeze.leader))
    wrench = wrench + extra[:, None, None] * unit_squeeze(model.workcell, box.pose, squeeze.leader)
    cuts = np.cumsum([len(motion.time) for motion in motions])[:-1]
    parts = zip(*(np.split(values, cuts) for values in (normal, least, wrench)), strict=True)
    return [Force(*part) for part in parts], squeeze


def pressing(hold: Force, sample: int, rate: float) -> tuple[float, Force]:
    """Forces that rise from nothing to those of one sample, or fall for the last, and how long [s].

    The box's weight goes over from what it stands on to the arms with the same profile, so that
    friction is used no more than when the box is held.

    Args:
        rate: fastest change of a normal force [N/s].
    """
    peak = float(hold.normal[sample].max())
    duration = at_even_steps(PEAK_RATE * peak / rate, TICK)
    share = rise(duration, SAMPLES).value[:: 1 if sample == 0 else -1]

    def scaled(values: Array) -> Array:
        return np.asarray(np.multiply.outer(share, values[sample]))

    return duration, Force(scaled(hold.normal), scaled(hold.least), scaled(hold.wrench))


def without_force(motion: PhaseMotion) -> Force:
    """Pads that touch nothing."""
    n = len(motion.time)
    return Force(np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 2, 6)))


def unit_squeeze(workcell: Workcell, pose: Array, leader: int = 0) -> Array:
    """(n, 2, 6) wrenches about the nominal contact points of 1 N that is commanded beyond the plan.

    Of pads with opposite normals both forces act on one line, midway between the nominal points,
    and balance one another. Of others it is an internal squeeze within all friction cones.

    Args:
        pose: (n, 6) of the box [m, rad].
        leader: index of the arm that is not commanded.
    """
    turned = box_rotation(workcell.task.orientation, pose)
    if not workcell.has_opposite_pads:
        grasp = Grasp(workcell)
        parts = robot_wrenches(workcell) @ grasp.squeeze_wrenches().ravel()
        axes = workcell.contacts[0].T_box_pad[:3, :3]
        wrenches = parts.reshape(2, 2, 3) @ axes.T / grasp.squeeze_normals()[1 - leader]
        return np.asarray(np.einsum("nij,abj->nabi", turned, wrenches).reshape(len(pose), 2, 6))
    first, second = (contact.T_box_pad for contact in workcell.contacts)
    normal = first[:3, 2]
    apart = second[:3, 3] - first[:3, 3]
    beside = (apart - (apart @ normal) * normal) / 2.0
    wrenches = np.array(
        [
            np.concatenate([sign * normal, np.cross(sign * beside, sign * normal)])
            for sign in (1.0, -1.0)
        ]
    ).reshape(2, 2, 3)
    return np.asarray(np.einsum("nij,abj->nabi", turned, wrenches).reshape(len(pose), 2, 6))


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
