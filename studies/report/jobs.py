"""The whole jobs around a report's trajectories: what their phases are, and how they are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hybrid_opt.bundles.manifest import phase_documents
from hybrid_opt.display.table import NOTHING, Table, number
from hybrid_opt.job.plan import JobModel
from hybrid_opt.job.records import Job, Phase, contact_effort
from hybrid_opt.timing import JerkLimits, Timing, TimingLimits, time_path
from symbolic.array import Array
from symbolic.errors import DualArmError
from symbolic.records.poses import box_rotation

RECOMMENDED_LABEL = "recommended"

CARRY_SAMPLES = 40
PHASE_SAMPLES = 7
"""Samples of the carry, and of every other phase, for a motion on the page."""

WITHOUT_JERK = "; its carry without the limits on jerk, which an export keeps"

_TOUCHES = 1e-6
"""Normal force from which on a pad has a centre of pressure [N]."""


@dataclass(frozen=True)
class JobRequest:
    """A path to plan the job around.

    Attributes:
        label: whose it is.
        x: (n_var,) decision vector of the report's first experiment.
        limits: within which it is timed.
        within_jerk: whether also within the cell's limits on jerk, which takes long.
    """

    label: str
    x: Array
    limits: TimingLimits
    within_jerk: bool = False


@dataclass(frozen=True)
class DrawnJob:
    """A job as a report shows it, or why there is none.

    Attributes:
        label: whose it is.
        problem: why it cannot be planned, '' where it can.
        duration: [s].
        remark: how its forces came about, and what its timing leaves out.
        peaks: (2,) largest commanded normal forces [N].
        phases: as a bundle's manifest has them, in order.
        samples: (k, 11 + joints) time, box pose, joints, commanded normal forces and shifts of the
            centres of pressure.
        torque_use, contact_torque_use: (joints,) largest use of each joint's torque, of all loads
            and of the contacts alone [-].
    """

    label: str
    problem: str
    duration: float = 0.0
    remark: str = ""
    peaks: tuple[float, float] = (0.0, 0.0)
    phases: tuple[dict[str, Any], ...] = ()
    samples: Array | None = None
    torque_use: Array | None = None
    contact_torque_use: Array | None = None


def drawn_job(model: JobModel, request: JobRequest) -> DrawnJob:
    """The job around a path, with the forces that an export commands by default."""
    try:
        timing = time_path(model.timing, request.x, request.limits)
    except DualArmError as error:
        return DrawnJob(request.label, str(error))
    return drawn(model, request, timing)


def drawn(model: JobModel, request: JobRequest, timing: Timing) -> DrawnJob:
    """The same around a path that is timed already."""
    try:
        job = model.plan(timing, within_jerk=request.within_jerk)
    except DualArmError as error:
        return DrawnJob(request.label, str(error))
    limit = np.concatenate([robot.torque_max for robot in job.workcell.robots])
    contact = [np.abs(contact_effort(p.motion, p.force.wrench)).max(axis=0) for p in job.phases]
    whole = [np.abs(phase.effort).max(axis=0) for phase in job.phases]
    bounded = request.within_jerk or JerkLimits.of(job.workcell) is None
    first, second = job.peak_normal_force.tolist()
    return DrawnJob(
        label=request.label,
        problem="",
        duration=job.duration,
        remark=str(job.squeeze) + ("" if bounded else WITHOUT_JERK),
        peaks=(first, second),
        phases=tuple(phase_documents(job)),
        samples=_samples(job),
        torque_use=np.max(whole, axis=0) / limit,
        contact_torque_use=np.max(contact, axis=0) / limit,
    )


def _samples(job: Job) -> Array:
    """Some samples of each phase, evenly spread in time, and the peaks of the forces."""
    parts = []
    for phase in job.phases:
        time = phase.motion.time
        count = CARRY_SAMPLES if phase.name == "carry" else PHASE_SAMPLES
        even = np.searchsorted(time, np.linspace(time[0], time[-1], count)).clip(max=len(time) - 1)
        rows = np.unique([0, *even, *phase.force.normal.argmax(axis=0), len(time) - 1])
        columns = [
            phase.begin + time[:, None],
            phase.motion.pose,
            phase.motion.q,
            phase.force.normal,
            pressure_shift(job, phase),
        ]
        parts.append(np.concatenate(columns, axis=1)[rows])
    table = np.concatenate(parts)
    # Where two phases meet, and where an acceleration jumps, a moment stands twice.
    return np.asarray(table[np.concatenate([[True], np.diff(table[:, 0]) > 1e-9])])


def pressure_shift(job: Job, phase: Phase) -> Array:
    """(n, 2) distance of each centre of pressure from its nominal contact point [m]."""
    rotation = box_rotation(job.workcell.task.orientation, phase.motion.pose)
    shifts = np.zeros_like(phase.force.normal)
    for arm, contact in enumerate(job.workcell.contacts):
        tangents = rotation @ contact.T_box_pad[:3, :2]
        tilting = np.einsum("nij,ni->nj", tangents, phase.force.wrench[:, arm, 3:])
        normal = phase.force.normal[:, arm]
        pressed = normal > _TOUCHES
        shifts[pressed, arm] = np.linalg.norm(tilting[pressed], axis=1) / normal[pressed]
    return shifts


LIMITS = (
    "joint velocity",
    "joint acceleration",
    "joint torque",
    "payload velocity",
    "payload acceleration",
)
"""Limits of which every phase states its use."""


def phases(jobs: Sequence[DrawnJob], robots: Sequence[str]) -> Table:
    """The phases of whole jobs.

    Args:
        robots: their names.
    """
    rows: list[tuple[str, ...]] = []
    for job in jobs:
        if job.problem:
            rows.append((f"{job.label}: {job.problem}", *[NOTHING] * (4 + len(LIMITS))))
        rows += [
            (
                f"{job.label}: {phase['name'].replace('_', ' ')}",
                number(phase["begin"]),
                number(phase["duration"]),
                *(number(force, 1) for force in phase["peak_normal_force"]),
                *(number(100.0 * phase["limits"][name], 1) for name in LIMITS),
            )
            for phase in job.phases
        ]
        if job.phases:
            forces = [number(force, 1) for force in job.peaks]
            most = [max(phase["limits"][name] for phase in job.phases) for name in LIMITS]
            uses = [number(100.0 * value, 1) for value in most]
            total = number(job.duration)
            rows.append((f"{job.label}: all, {job.remark}", NOTHING, total, *forces, *uses))
    return Table(
        "phases",
        "Phases of the whole jobs.",
        (
            "trajectory and phase",
            "begins [s]",
            "takes [s]",
            *(f"presses, {robot} [N]" for robot in robots),
            *(f"{name} [%]" for name in LIMITS),
        ),
        tuple(rows),
        "Largest commanded normal forces, and largest uses of the limits with them. The "
        "recommended carry within its force, the others closest to the reference speed, as an "
        "export plans them by default; every phase is certified free of collisions.",
    )
