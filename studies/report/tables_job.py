"""The table of jobs: every phase with its duration, its forces, and how far it uses its limits."""

from __future__ import annotations

from collections.abc import Sequence

from studies.report.jobs import DrawnJob
from studies.report.table_text import NOTHING, Table, number

LIMITS = (
    "joint velocity",
    "joint acceleration",
    "joint torque",
    "payload velocity",
    "payload acceleration",
)
"""Limits of which every phase states its use."""


def phases(jobs: Sequence[DrawnJob], robots: tuple[str, str]) -> Table:
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
    left, right = robots
    return Table(
        "phases",
        "Phases of the whole jobs.",
        (
            "trajectory and phase",
            "begins [s]",
            "takes [s]",
            f"presses, {left} [N]",
            f"presses, {right} [N]",
            *(f"{name} [%]" for name in LIMITS),
        ),
        tuple(rows),
        "Largest commanded normal forces, and largest uses of the limits with them. The "
        "recommended carry within its force, the others closest to the reference speed, as an "
        "export plans them by default; every phase is certified free of collisions.",
    )
