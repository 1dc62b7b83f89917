"""Time steps by what they do to the gap between the pads.

Between two samples a controller makes up the motion: along straight lines of the joints, cubic or
quintic ones. Each arm's pad then misses its path a little, not both alike, and the gap between the
pads changes. Arms of a stiffness k at their pads turn a change d of the gap into a force k d / 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pinocchio as pin
from scipy.interpolate import BPoly, CubicHermiteSpline

from hybrid_opt.job.compliance import HELD, TRACKED
from hybrid_opt.job.records import Job, SampledJob, sample_job
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell
from symbolic.robot.model import build_robot_model

Interpolation = Literal["linear", "cubic", "quintic"]

BETWEEN = (0.25, 0.5, 0.75)
"""Shares of a step at which the pads are looked at."""

MOST_INTERVALS = 1500
"""Steps that are looked at, evenly spread."""


@dataclass(frozen=True)
class Gap:
    """What a time step does to the pads while they hold the box.

    Attributes:
        step: [s].
        interpolation: between two samples.
        along: largest change of the distance between the pads along the normal [m].
        across: largest displacement of one against the other across it [m].
        force: error of the normal forces that the change along the normal makes [N].
        share: the same, of the least commanded normal force.
    """

    step: float
    interpolation: Interpolation
    along: float
    across: float
    force: float
    share: float


def chosen_step(
    job: Job, steps: Sequence[float], interpolation: Interpolation, stiffness: float
) -> float:
    """The longest of the steps whose force error stays within the tracking share.

    Args:
        steps: that the target can have, the longest first [s].
        stiffness: of each arm at its pad [N/m].

    Raises:
        SettingsError: none does.
    """
    for step in steps:
        found = gap_of(sample_job(job, step), interpolation, stiffness)
        if found.share <= TRACKED:
            return step
    raise SettingsError(
        f"with {interpolation} motion between samples {1e3 * steps[-1]:g} ms apart the gap of the "
        f"pads is wrong by {1e3 * found.along:.2f} mm; arms of {stiffness:g} N/m then miss their "
        f"force by {found.force:.1f} N, {100.0 * found.share:.0f} %: choose a slower timing, "
        "another target, or state the stiffness that your arms have (--stiffness)"
    )


def gap_of(sampled: SampledJob, interpolation: Interpolation, stiffness: float) -> Gap:
    """What the samples of a job do to the pads, under an interpolation.

    Args:
        stiffness: of each arm at its pad [N/m].
    """
    job, time = sampled.job, sampled.time
    spans = [sampled.span(k) for k, phase in enumerate(job.phases) if phase.name in HELD]
    starts = np.concatenate([np.arange(span.start, span.stop - 1) for span in spans])
    starts = starts[:: -(-len(starts) // MOST_INTERVALS)]
    steps = np.diff(time)[starts]
    places = np.concatenate([time[starts] + share * steps for share in BETWEEN])
    q = between(sampled, interpolation, places)
    along, across = pad_errors(job.workcell, q)
    least = min(float(sampled.normal_force[span].min()) for span in spans)
    force = stiffness / 2.0 * float(np.abs(along).max())
    return Gap(
        step=float(np.diff(time).max()),
        interpolation=interpolation,
        along=float(np.abs(along).max()),
        across=float(across.max()),
        force=force,
        share=force / least,
    )


def between(sampled: SampledJob, interpolation: Interpolation, places: Array) -> Array:
    """(m, joints) joints at times (m,) as a controller makes them up between the samples."""
    if interpolation == "linear":
        columns = sampled.q.T
        return np.column_stack([np.interp(places, sampled.time, each) for each in columns])
    if interpolation == "cubic":
        return np.asarray(CubicHermiteSpline(sampled.time, sampled.q, sampled.q_rate)(places))
    known = np.stack([sampled.q, sampled.q_rate, sampled.q_second], axis=1)
    return np.asarray(BPoly.from_derivatives(sampled.time, known)(places))


def pad_errors(workcell: Workcell, q: Array) -> tuple[Array, Array]:
    """How the pads of postures stand to one another against how they hold the box.

    Args:
        q: (n, joints) both arms side by side [rad].

    Returns:
        (n,) the distance between the pads along the first one's normal less the planned one [m],
        and (n,) their displacement across it [m].
    """
    first = len(workcell.robots[0].torque_max)
    T = [pad_places(workcell, arm, own) for arm, own in enumerate((q[:, :first], q[:, first:]))]
    apart = np.einsum("nji,nj->ni", T[0][:, :3, :3], T[1][:, :3, 3] - T[0][:, :3, 3])
    one, other = (contact.T_box_pad for contact in workcell.contacts)
    missed = apart - one[:3, :3].T @ (other[:3, 3] - one[:3, 3])
    return missed[:, 2], np.linalg.norm(missed[:, :2], axis=1)


def pad_places(workcell: Workcell, arm: int, q: Array) -> Array:
    """(n, 4, 4) of an arm's pad in the world, at its joints (n, joints) [rad]."""
    robot = workcell.robots[arm]
    model = build_robot_model(robot)
    data, found = model.model.createData(), np.empty((len(q), 4, 4))
    for k, row in enumerate(q):
        pin.framesForwardKinematics(model.model, data, row)
        found[k] = data.oMf[model.flange_id].homogeneous
    return np.asarray(robot.T_world_base @ found @ robot.T_flange_pad)
