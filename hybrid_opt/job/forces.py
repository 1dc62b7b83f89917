"""The forces of a job's phases: those that hold the box, pressed on and let go smoothly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybrid_opt.job.profile import PEAK_RATE, at_even_steps, rise
from hybrid_opt.job.records import Force, PhaseMotion
from hybrid_opt.job.straight import SAMPLES, TICK
from hybrid_opt.robust.force import BoxMotion
from hybrid_opt.robust.squeeze import Squeeze, extra_force
from hybrid_opt.timing.model import TimingModel
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell
from symbolic.records.poses import box_rotation


def held(model: TimingModel, squeeze: Squeeze, motions: Sequence[PhaseMotion]) -> list[Force]:
    """Forces of phases that follow one another, with the box held in all of them.

    Raises:
        SettingsError: the uncertainty leaves no friction or patch, or the contacts are not two pads
            with opposite normals.
    """
    if not model.workcell.has_opposite_pads:
        raise SettingsError(
            "a job presses with two pads whose normals are opposite; carries with other pads can "
            "be searched, timed and simulated"
        )
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
    extra = extra_force(model.workcell, squeeze, time, box, least)
    normal = least + extra[:, None]
    wrench = wrench + extra[:, None, None] * unit_squeeze(model.workcell, box.pose)
    cuts = np.cumsum([len(motion.time) for motion in motions])[:-1]
    parts = zip(*(np.split(values, cuts) for values in (normal, least, wrench)), strict=True)
    return [Force(*part) for part in parts]


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


def unit_squeeze(workcell: Workcell, pose: Array) -> Array:
    """(n, 2, 6) wrenches about the nominal contact points of 1 N that either pad presses more.

    Both forces act on one line, midway between the nominal points, and balance one another.

    Args:
        pose: (n, 6) of the box [m, rad].
    """
    first, second = (contact.T_box_pad for contact in workcell.contacts)
    normal = first[:3, 2]
    apart = second[:3, 3] - first[:3, 3]
    beside = (apart - (apart @ normal) * normal) / 2.0
    turned = box_rotation(workcell.task.orientation, pose)
    wrenches = np.array(
        [
            np.concatenate([sign * normal, np.cross(sign * beside, sign * normal)])
            for sign in (1.0, -1.0)
        ]
    ).reshape(2, 2, 3)
    return np.asarray(np.einsum("nij,abj->nabi", turned, wrenches).reshape(len(pose), 2, 6))
