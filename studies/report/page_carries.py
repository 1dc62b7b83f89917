"""The trajectories on the page: what robots drive, what the search assumed, and what is saved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import hybrid_opt as ho
from hybrid_opt.display.scene import packed
from hybrid_opt.evaluate.objectives import PAPER_OBJECTIVES
from hybrid_opt.store.trajectory_figures import trajectory_figures
from hybrid_opt.timing.jerk import drive_with_jerk
from studies.report.jobs import DrawnJob, JobRequest
from symbolic.array import Array

MAX_SAMPLES = 60
"""Samples of a trajectory on the page; its force peaks are kept besides."""

DRIVEN = "as robots drive it"
WITHIN_JERK = "within the limits on jerk"
ASSUMED = "as the search assumed"
WHOLE_JOB = "the whole job"

LAWS = {"constant": "constant speed", "ramped": "ramped speed"}


@dataclass(frozen=True)
class Shown:
    """One trajectory of the page.

    Attributes:
        label: whose it is.
        x: (n_var,) decision vector.
        provenance: how it came about, stored with a saved file.
        jerk: whether it is also shown within the cell's limits on jerk, where it has any.
        job: the whole job around it, where it is planned already.
    """

    label: str
    x: Array
    provenance: str
    jerk: bool = False
    job: DrawnJob | None = None


@dataclass
class Collected:
    """The trajectories of a page, as they are put together.

    Attributes:
        n_var: length of the report's first experiment's decision vectors.
        trajectories: JSON values.
        jobs: what to plan a job around, by the trajectory's number.
    """

    n_var: int
    trajectories: list[dict[str, Any]] = field(default_factory=list)
    jobs: dict[int, JobRequest] = field(default_factory=dict)

    def add_job(self, number: int, job: DrawnJob) -> None:
        """Add a planned job as one more motion of its trajectory, or say why there is none."""
        trajectory = self.trajectories[number]
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


class PageCarries:
    """Collects the trajectories of one cell for the page."""

    def __init__(self, cell: ho.Cell, number: int, sink: Collected) -> None:
        """Take trajectories of a cell.

        Args:
            cell: the cell; under 'optimal' its carries are timed within their force limits, else
                as close to the reference speeds as limits allow.
            number: of the cell among those whose files the page holds.
            sink: takes the trajectories.
        """
        self._cell, self._number, self._sink = cell, number, sink
        self._limit = np.concatenate([robot.torque_max for robot in cell.workcell.robots])
        self._optimal = cell.workcell.task.time_law == "optimal"

    def add(self, shown: Shown) -> int:
        """Add a trajectory; returns its number on the page."""
        judged = self._cell.carry(shown.x)
        assert judged.judgement is not None, "carries of a cell are judged"
        limits = self._limits(shown.x)
        driven, problem = self._driven(shown.x, limits)
        motions = [] if driven is None else [self._motion(DRIVEN, driven)]
        if shown.jerk:
            motions += self._within_jerk(shown.x)
        if not self._optimal:
            law = LAWS[self._cell.workcell.task.time_law]
            motions.append(self._motion(f"{ASSUMED}: {law}", judged))
        if not motions:
            motions.append(self._motion(ASSUMED, judged))
        name, values = shown.label, judged.judgement.objectives
        if not judged.judgement.feasible:
            name = f"{name} (infeasible)"
        figures = trajectory_figures(judged).items()
        number = len(self._sink.trajectories)
        if not problem and shown.job is None:
            x = shown.x[: self._sink.n_var]
            self._sink.jobs[number] = JobRequest(shown.label, x, limits)
        self._sink.trajectories.append(
            {
                "label": f"{name}: {self._values(judged, driven)}",
                "objectives": [float(value) for value in values.values()],
                "problem": problem,
                "motions": motions,
                "cell": self._number,
                "decision": shown.x.tolist(),
                "start": [arm.q[0].tolist() for arm in judged.arms],
                "figures": {key: float(value) for key, value in figures if np.isfinite(value)},
                "provenance": {"source": shown.provenance},
            }
        )
        if shown.job is not None:
            self._sink.add_job(number, shown.job)
        return number

    def point(self, number: int) -> tuple[float, float]:
        """Largest normal force [N] and duration [s] of a trajectory as its robots drive it."""
        motion = self._sink.trajectories[number]["motions"][0]
        return max(motion["peaks"]), motion["duration"]

    def _values(self, judged: ho.Carry, driven: ho.Carry | None) -> str:
        """What it is named by: what is minimised, forces and times with their units."""
        if self._optimal:
            carry = driven or judged
            return f"{carry.duration:.2f} s, {carry.peak_normal_force.max():.2f} N"
        assert judged.judgement is not None, "carries of a cell are judged"
        found = judged.judgement.objectives
        if tuple(found) != PAPER_OBJECTIVES:
            return ", ".join(f"{name.replace('_', ' ')} {found[name]:.4f}" for name in found)
        return ", ".join(
            f"{robot.name} {force:.2f} N"
            for robot, force in zip(
                self._cell.workcell.robots, judged.peak_normal_force, strict=True
            )
        )

    def _limits(self, x: Array) -> ho.TimingLimits:
        if self._optimal:
            return ho.TimingLimits(force=float(x[-1]))
        return ho.TimingLimits(reference_speed=True)

    def _driven(self, x: Array, limits: ho.TimingLimits) -> tuple[ho.Carry | None, str]:
        """The carry as robots drive it, or why they cannot."""
        timing = ho.time_path(self._cell, x, limits)
        return timing.carry, "" if timing.ok else f"robots cannot drive it: {timing.reason}"

    def _within_jerk(self, x: Array) -> list[dict[str, Any]]:
        """The carry within the cell's limits on jerk, where it has any."""
        found = drive_with_jerk(self._cell.timing_model, x)
        carry = None if found is None else found.timing.carry
        return [] if carry is None else [self._motion(WITHIN_JERK, carry)]

    def _motion(self, name: str, carry: ho.Carry) -> dict[str, Any]:
        torque = 100.0 * np.abs(carry.torque).max(axis=0) / self._limit
        contact = 100.0 * np.abs(carry.contact_torque).max(axis=0) / self._limit
        return {
            "name": name,
            "peaks": [round(float(value), 4) for value in carry.peak_normal_force],
            "duration": round(carry.duration, 5),
            "payloadLimit": round(carry.payload_limit, 4),
            "torqueUse": [round(float(value), 3) for value in torque],
            "contactTorqueUse": [round(float(value), 3) for value in contact],
            "data": packed(_samples(carry), np.float32),
        }


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
