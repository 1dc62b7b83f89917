"""The trajectories of a report and the whole jobs around them: what robots drive, what the search
assumed, and what is saved. Each is worked out for itself, in any process."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hybrid_opt as ho
from hybrid_opt.campaign.stages import ReadyCell
from hybrid_opt.display.scene import packed
from hybrid_opt.display.table import NOTHING, Table, number
from hybrid_opt.evaluate.objectives import PAPER_OBJECTIVES
from hybrid_opt.job.motions import TICK
from hybrid_opt.job.plan import JobModel
from hybrid_opt.job.records import Job, Phase
from hybrid_opt.job.smooth import driven_timing
from hybrid_opt.robust.cases import LEADER
from hybrid_opt.timing.analysis import drivable_timing
from hybrid_opt.timing.records import JerkLimits, Timing, TimingLimits
from hybrid_opt.timing.robustness import Margin, robustness_margins
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array
from symbolic.errors import DualArmError
from symbolic.path.pieces import resample_decisions
from symbolic.records import Workcell
from symbolic.records.poses import box_rotation

RECOMMENDED_LABEL = "recommended"
RECOMMENDED_TITLE = "Recommended"
"""The carry to run, in lists and pictures of the page."""

CARRY_SAMPLES = 40
PHASE_SAMPLES = 7
"""Samples of the carry, and of every other phase, for a motion on the page."""

WITHOUT_JERK = "; its carry without the limits on jerk, which an export keeps"

_TOUCHES = 1e-6
"""Normal force from which on a pad has a centre of pressure [N]."""


@dataclass(frozen=True)
class DrawnJob:
    """A job as a report shows it, or why there is none.

    Attributes:
        label: whose it is.
        problem: why it cannot be planned, '' where it can.
        job: None where it cannot be planned.
        remark: how its forces came about, and what its timing leaves out.
        timing: of its path, None where that failed.
        margins: of the recommended one, how wrong the cell's description may be.
    """

    label: str
    problem: str = ""
    job: Job | None = None
    remark: str = ""
    timing: Timing | None = None
    margins: tuple[Margin, ...] = ()


def recommended_job(x: Array, cells: Sequence[ReadyCell]) -> DrawnJob:
    """Plan the job around the recommended carry x (n_var,) of the last cell, as robots drive it."""
    model = cells[-1].jobs
    found = drawn(model, RECOMMENDED_LABEL, lambda: driven_timing(model.timing, x), True)
    if found.timing is None or found.timing.carry is None:
        return found
    return replace(found, margins=robustness_margins(model.timing, found.timing.carry))


def drawn_job(label: str, x: Array, limits: TimingLimits, cells: Sequence[ReadyCell]) -> DrawnJob:
    """Plan the job around a path of the first cell, x (n_var,), in the last one: timed within
    limits, with the default forces of an export, within the cell's limits on jerk, which takes
    long."""
    model = cells[-1].jobs
    (path,) = resample_decisions(x, cells[0].cell.workcell.task, model.workcell.task)
    return drawn(model, label, lambda: time_path(model.timing, path, limits), True)


def drawn(
    model: JobModel, label: str, timed: Callable[[], Timing], within_jerk: bool = False
) -> DrawnJob:
    """Plan the job around a path that is timed here, also within the cell's limits on jerk if
    wanted."""
    timing = None
    try:
        timing = timed()
        job = model.plan(timing, within_jerk=within_jerk)
    except DualArmError as error:
        return DrawnJob(label, str(error), timing=timing)
    bounded = within_jerk or JerkLimits.from_workcell(job.workcell) is None
    remark = str(job.squeeze) + ("" if bounded else WITHOUT_JERK)
    return DrawnJob(label, "", job, remark, timing)


def job_samples(job: Job) -> Array:
    """(k, 11 + joints) time, box pose, joints, commanded normal forces and shifts of the centres of
    pressure: some samples of each phase, and the peaks of the forces."""
    parts = []
    for phase in job.phases:
        motion, force = phase.motion, phase.force.normal
        count = CARRY_SAMPLES if phase.name == "carry" else PHASE_SAMPLES
        rows = _rows(motion.time, count, force.argmax(axis=0))
        time, shift = phase.begin + motion.time, pressure_shift(job, phase)
        parts.append(np.column_stack([time, motion.pose, motion.q, force, shift])[rows])
    return _once(np.concatenate(parts))


def _rows(time: Array, count: int, peaks: Iterable[int]) -> NDArray[np.intp]:
    """Rows of samples evenly spread in time, and those of peaks."""
    moments = np.linspace(time[0], time[-1], min(len(time), count))
    even = np.searchsorted(time, moments).clip(max=len(time) - 1)
    return np.unique([0, *even, *peaks, len(time) - 1])


def _once(table: Array) -> Array:
    """Remove samples (n, k) whose time, their first number, repeats: where two phases meet, and
    where an acceleration jumps."""
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


PHASE_LIMITS = (
    "joint velocity",
    "joint acceleration",
    "joint torque",
    "payload velocity",
    "payload acceleration",
)
"""Limits of which every phase states its use."""


def phases(jobs: Sequence[DrawnJob], robots: Sequence[str]) -> Table:
    """Return the phases of whole jobs, with the names of the robots."""
    rows: list[tuple[str, ...]] = []

    def add(
        name: str, begin: float | None, takes: float, force: Array, use: Iterable[float]
    ) -> None:
        figures = [*force, *(100.0 * value for value in use)]
        rows.append((name, number(begin), number(takes), *(number(each, 1) for each in figures)))

    for found in jobs:
        if found.job is None:
            rows.append((f"{found.label}: {found.problem}", *[NOTHING] * (4 + len(PHASE_LIMITS))))
            continue
        used = np.array([[phase.use[name] for name in PHASE_LIMITS] for phase in found.job.phases])
        for phase, use in zip(found.job.phases, used, strict=True):
            name = f"{found.label}: {phase.name.replace('_', ' ')}"
            add(name, phase.begin, phase.duration, phase.force.normal.max(axis=0), use)
        name, peak = f"{found.label}: all, {found.remark}", found.job.peak_normal_force
        add(name, None, found.job.duration, peak, used.max(axis=0))
    return Table(
        "phases",
        "Phases of the whole jobs.",
        (
            "trajectory and phase",
            "begins [s]",
            "takes [s]",
            *(f"presses, {robot} [N]" for robot in robots),
            *(f"{name} [%]" for name in PHASE_LIMITS),
        ),
        tuple(rows),
        "Largest commanded normal forces, and largest uses of the limits with them. The "
        "recommended carry within its force, the others closest to the reference speed, as an "
        "export plans them by default; every phase is certified free of collisions. A carry ends "
        f"with rest until a cycle of {1e3 * TICK:g} ms is over.",
    )


PAGE_SAMPLES = 60
"""Samples of a trajectory on the page; its force peaks are kept besides."""

DRIVEN_TITLE = "as robots drive it"
ASSUMED = "as the search assumed"
WHOLE_JOB = "the whole job"

NO_JOB = "shown of selected carries and of time against force only; an export plans any"
"""Why a trajectory that can be driven has none."""

LAWS = {"constant": "constant speed", "ramped": "ramped speed"}


@dataclass(frozen=True)
class PageTrajectory:
    """One trajectory of the page.

    Attributes:
        source: whose it is, stored with a saved file.
        x: (n_var,) decision vector.
        cell: number of its cell among those of the page.
        recommended: whether it is the carry to run, driven within the cell's limits on jerk, where
            it has any.
        job: the whole job around it, where it is planned already.
        has_job: whether one is planned where it is not.
    """

    source: str
    x: Array
    cell: int = 0
    recommended: bool = False
    job: DrawnJob | None = None
    has_job: bool = True


def _with_job(trajectory: dict[str, Any], found: DrawnJob) -> None:
    """Add a planned job as one more motion of a trajectory, or say why there is none."""
    job, motions = found.job, trajectory["motions"]
    if job is None:
        trajectory["jobProblem"] = found.problem
        return
    contact = [phase.motion.contact_effort(phase.force.wrench) for phase in job.phases]
    motion = {
        "name": WHOLE_JOB,
        "peaks": _rounded(job.peak_normal_force, 4),
        "duration": round(job.duration, 5),
        "payloadLimit": motions[0]["payloadLimit"],
        **_uses(job.workcell, np.concatenate([p.effort for p in job.phases]), contact),
        "data": packed(job_samples(job), np.float32),
        "commanded": round(_commanded(job), 4),
        "remark": found.remark,
        "phases": [_phase(phase) for phase in job.phases],
    }
    motions.insert(1, motion)


def _commanded(job: Job) -> float:
    """Largest force that is commanded of the force-controlled arm [N]."""
    return float(job.peak_normal_force[1 - LEADER])


def _phase(phase: Phase) -> dict[str, Any]:
    return {
        "name": phase.name.replace("_", " "),
        "begin": round(phase.begin, 5),
        "duration": round(phase.duration, 5),
        "peaks": _rounded(phase.force.normal.max(axis=0), 4),
        "most": phase.most_used,
        "use": round(100.0 * phase.use[phase.most_used], 2),
    }


def _rounded(values: Array, digits: int) -> list[float]:
    return [round(value, digits) for value in values.tolist()]


def page_trajectory(cells: Sequence[ReadyCell], shown: PageTrajectory) -> dict[str, Any]:
    """Return a trajectory of the page as JSON values: its motions and texts.

    Args:
        cells: of the page; the last one is the cell that robots drive. Under 'optimal' carries are
            timed within their force limits, else as close to the reference speeds as limits allow.
    """
    cell, driving = cells[shown.cell].cell, cells[-1]
    law = cell.workcell.task.time_law
    judged = cell.carry(shown.x)
    assert judged.judgement is not None, "carries of a cell are judged"
    task = driving.cell.workcell.task
    path = resample_decisions(shown.x, cell.workcell.task, task)[0, : task.n_path]
    limits = _limits(cell, shown.x)
    if shown.recommended:
        # The recommended carry is driven as an export does, others without limits on jerk.
        timing = driven_timing(cell.timing_model, shown.x)
    elif limits.robust:
        # Anew, robust forces take long: as the search found it.
        timing = drivable_timing(cell.timing_model, shown.x)
    else:
        timing = time_path(driving.jobs.timing, path, limits)
    driven = timing.carry
    motions = [] if driven is None else [_motion(DRIVEN_TITLE, driven)]
    if law != "optimal":
        motions.append(_motion(f"{ASSUMED}: {LAWS[law]}", judged))
    if not motions:
        motions.append(_motion(ASSUMED, judged))
    name, values = shown.source, judged.judgement.objectives
    if shown.recommended:
        name = f"{RECOMMENDED_TITLE} ({name})"
    if not judged.judgement.feasible:
        name = f"{name} (infeasible)"
    figures = judged.figures.items()
    found = {
        "label": f"{name}: {_values(cell, judged, timing, shown.job)}",
        "objectives": [float(value) for value in values.values()],
        "problem": "" if timing.ok else f"robots cannot drive it: {timing.reason}",
        "force": max(motions[0]["peaks"]) if driven is None else round(timing.peak_force, 4),
        "motions": motions,
        "cell": shown.cell,
        "decision": shown.x.tolist(),
        "start": [arm.q[0].tolist() for arm in judged.arms],
        "figures": {key: float(value) for key, value in figures if np.isfinite(value)},
        "provenance": {"source": shown.source},
    }
    if shown.job is not None:
        _with_job(found, shown.job)
    elif not shown.has_job:
        found["jobProblem"] = NO_JOB
    elif timing.ok:
        _with_job(found, drawn(driving.jobs, shown.source, lambda: timing))
    return found


def _motion(name: str, carry: ho.Carry) -> dict[str, Any]:
    return {
        "name": name,
        "peaks": _rounded(carry.peak_normal_force, 4),
        "duration": round(carry.duration, 5),
        "payloadLimit": round(carry.payload_limit, 4),
        **_uses(carry.workcell, carry.torque, [carry.contact_torque]),
        "data": packed(_samples(carry), np.float32),
    }


def _uses(workcell: Workcell, whole: Array, contact: Sequence[Array]) -> dict[str, list[float]]:
    """Return uses of the joints' torques, of all loads and of the contacts alone."""
    torques = {"torqueUse": whole, "contactTorqueUse": np.concatenate(contact)}
    return {name: _rounded(torque_use(workcell, each), 3) for name, each in torques.items()}


def torque_use(workcell: Workcell, torque: Array) -> Array:
    """(joints,) largest use of each joint's torque (n, joints) in percent."""
    return np.asarray(
        100.0 * np.abs(torque).max(axis=0) / workcell.stack_joint_limits("torque_max")
    )


def _limits(cell: ho.Cell, x: Array) -> ho.TimingLimits:
    if cell.workcell.task.time_law == "optimal":
        return cell.timing_model.drive_limits(float(x[-1]))
    return ho.TimingLimits(reference_speed=True)


def _values(cell: ho.Cell, judged: ho.Carry, timing: ho.Timing, job: DrawnJob | None) -> str:
    """Title of a trajectory: its objectives, forces and times with their units; of one whose job
    is planned what is commanded."""
    if cell.workcell.task.time_law == "optimal":
        if job is not None and job.job is not None:
            duration = job.job.phase("carry").duration
            return f"{duration:.2f} s, pressed with {_commanded(job.job):.1f} N"
        if timing.carry is not None:
            return f"{timing.duration:.2f} s, {timing.peak_force:.2f} N"
        return f"{judged.duration:.2f} s, {judged.peak_normal_force.max():.2f} N"
    assert judged.judgement is not None, "carries of a cell are judged"
    found = judged.judgement.objectives
    if tuple(found) != PAPER_OBJECTIVES:
        return ", ".join(f"{name.replace('_', ' ')} {found[name]:.4f}" for name in found)
    return ", ".join(
        f"{robot.name} {force:.2f} N"
        for robot, force in zip(cell.workcell.robots, judged.peak_normal_force, strict=True)
    )


def _samples(carry: ho.Carry) -> Array:
    """(k, 11 + joints) time, pose, joints, normal forces and pressure shifts at some samples."""
    force, shift = carry.normal_force, carry.pressure_shift
    peaks = np.concatenate([force.argmax(axis=0), force.argmin(axis=0), shift.argmax(axis=0)])
    time = carry.time - carry.time[0]
    table = np.column_stack([time, carry.pose, carry.q, force, shift])
    return _once(table[_rows(time, PAGE_SAMPLES, peaks)])
