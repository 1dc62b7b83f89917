"""The trajectories on the page: what robots drive, what the search assumed, and what is saved.

Each is worked out for itself, in any process.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import hybrid_opt as ho
from hybrid_opt.campaign.cell_source import ReadyCell
from hybrid_opt.display.scene import packed
from hybrid_opt.evaluate.objectives import PAPER_OBJECTIVES
from hybrid_opt.job.smooth import driven_timing
from hybrid_opt.timing import drivable_timing, time_path
from hybrid_opt.work.service import Emit
from studies.report.jobs import DrawnJob, JobRequest, drawn
from symbolic.array import Array

MAX_SAMPLES = 60
"""Samples of a trajectory on the page; its force peaks are kept besides."""

DRIVEN = "as robots drive it"
ASSUMED = "as the search assumed"
WHOLE_JOB = "the whole job"

NO_JOB = "shown of selected carries and of time against force only; an export plans any"
"""Why a trajectory that can be driven has none."""

LAWS = {"constant": "constant speed", "ramped": "ramped speed"}


@dataclass(frozen=True)
class Shown:
    """One trajectory of the page.

    Attributes:
        label: whose it is.
        x: (n_var,) decision vector.
        provenance: how it came about, stored with a saved file.
        cell: number of its cell among those of the page.
        jerk: whether it is driven within the cell's limits on jerk, where it has any.
        job: the whole job around it, where it is planned already.
        has_job: whether one is planned where it is not.
    """

    label: str
    x: Array
    provenance: str
    cell: int = 0
    jerk: bool = False
    job: DrawnJob | None = None
    has_job: bool = True


def _with_job(trajectory: dict[str, Any], job: DrawnJob) -> None:
    """Add a planned job as one more motion of a trajectory, or say why there is none."""
    if job.samples is None:
        trajectory["jobProblem"] = job.problem
        return
    assert job.torque_use is not None, "a planned job uses torques"
    assert job.contact_torque_use is not None, "a planned job presses"
    trajectory["motions"].insert(
        1,
        {
            "name": WHOLE_JOB,
            "peaks": [round(value, 4) for value in job.peaks],
            "duration": round(job.duration, 5),
            "payloadLimit": trajectory["motions"][0]["payloadLimit"],
            "torqueUse": (100.0 * job.torque_use).round(3).tolist(),
            "contactTorqueUse": (100.0 * job.contact_torque_use).round(3).tolist(),
            "data": packed(job.samples, np.float32),
            "remark": job.remark,
            "phases": [_phase(phase) for phase in job.phases],
        },
    )


def _phase(phase: Mapping[str, Any]) -> dict[str, Any]:
    """A phase of a manifest as the page shows it."""
    most = phase["most_used"]
    return {
        "name": phase["name"].replace("_", " "),
        "begin": round(phase["begin"], 5),
        "duration": round(phase["duration"], 5),
        "peaks": [round(value, 4) for value in phase["peak_normal_force"]],
        "most": most,
        "use": round(100.0 * phase["limits"][most], 2),
    }


def page_trajectory(
    cells: Sequence[ReadyCell], shown: Shown, emit: Emit | None = None
) -> dict[str, Any]:
    """A trajectory of the page as JSON values: its motions, and all that is said of it.

    Args:
        cells: of the page; the last one is the cell that robots drive. Under 'optimal' carries are
            timed within their force limits, else as close to the reference speeds as limits allow.
    """
    cell, driving = cells[shown.cell].cell, cells[-1]
    law = cell.workcell.task.time_law
    judged = cell.carry(shown.x)
    assert judged.judgement is not None, "carries of a cell are judged"
    path = shown.x[: cell.workcell.task.n_path]
    request = JobRequest(shown.label, path, _limits(cell, shown.x))
    if shown.jerk:
        # What is recommended is driven as an export does, others without limits on jerk.
        timing = driven_timing(cell.timing_model, shown.x)
    elif request.limits.robust:
        # Anew, robust forces take long: as the search found it.
        timing = drivable_timing(cell.timing_model, shown.x)
    else:
        timing = time_path(driving.jobs.timing, path, request.limits)
    driven = timing.carry
    motions = [] if driven is None else [_motion(DRIVEN, driven)]
    if law != "optimal":
        motions.append(_motion(f"{ASSUMED}: {LAWS[law]}", judged))
    if not motions:
        motions.append(_motion(ASSUMED, judged))
    name, values = shown.label, judged.judgement.objectives
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
        "provenance": {"source": shown.provenance},
    }
    if shown.job is not None:
        _with_job(found, shown.job)
    elif not shown.has_job:
        found["jobProblem"] = NO_JOB
    elif timing.ok:
        _with_job(found, drawn(driving.jobs, request, timing))
    return found


def _motion(name: str, carry: ho.Carry) -> dict[str, Any]:
    return {
        "name": name,
        "peaks": [round(float(value), 4) for value in carry.peak_normal_force],
        "duration": round(carry.duration, 5),
        "payloadLimit": round(carry.payload_limit, 4),
        "torqueUse": torque_use(carry, carry.torque).round(3).tolist(),
        "contactTorqueUse": torque_use(carry, carry.contact_torque).round(3).tolist(),
        "data": packed(_samples(carry), np.float32),
    }


def torque_use(carry: ho.Carry, torque: Array) -> Array:
    """(all joints,) largest use of each joint's torque (n, all joints) in percent."""
    limit = np.concatenate([robot.torque_max for robot in carry.workcell.robots])
    return np.asarray(100.0 * np.abs(torque).max(axis=0) / limit)


def driven_point(trajectory: Mapping[str, Any]) -> tuple[float, float]:
    """Largest limited force [N] and duration [s] of a trajectory as its robots drive it."""
    return trajectory["force"], trajectory["motions"][0]["duration"]


def _limits(cell: ho.Cell, x: Array) -> ho.TimingLimits:
    if cell.workcell.task.time_law == "optimal":
        return cell.timing_model.drive_limits(float(x[-1]))
    return ho.TimingLimits(reference_speed=True)


def _values(cell: ho.Cell, judged: ho.Carry, timing: ho.Timing, job: DrawnJob | None) -> str:
    """Title of a trajectory: its objectives, forces and times with their units; of one whose job
    is planned what is commanded."""
    if cell.workcell.task.time_law == "optimal" and job is not None and job.phases:
        return f"{timing.duration:.2f} s, pressed with {max(job.peaks):.1f} N"
    if cell.workcell.task.time_law == "optimal":
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
    """(k, 23) time, pose, joints, normal forces and pressure shifts at some of the samples, evenly
    spread in time."""
    n = len(carry.time)
    peaks = [
        *carry.normal_force.argmax(axis=0),
        *carry.normal_force.argmin(axis=0),
        *carry.pressure_shift.argmax(axis=0),
    ]
    moments = np.linspace(carry.time[0], carry.time[-1], min(n, MAX_SAMPLES))
    even = np.clip(np.searchsorted(carry.time, moments), 0, n - 1)
    rows = np.unique(np.concatenate([even, peaks, [0, n - 1]]))
    columns = [carry.time[:, None], carry.pose, carry.q, carry.normal_force, carry.pressure_shift]
    table = np.concatenate(columns, axis=1)[rows]
    table[:, 0] -= carry.time[0]
    # A moment may stand twice, once for each side of a jump.
    return np.asarray(table[np.concatenate([[True], np.diff(table[:, 0]) > 0.0])])
