"""Another path beside the recommended one: at the same force, and at the same duration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hybrid_opt.cell import Cell
from hybrid_opt.recommending.driven_paths import DrivenPaths
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array

BETTER = 1e-3
"""Share by which a rival has to be shorter to count as better: timings agree to so much."""

FORCES = 12
"""Limits at which a front is held against a rival."""


@dataclass(frozen=True, repr=False)
class Rival:
    """A path driven as fast as the same limits allow.

    Attributes:
        label: what it is.
        duration_at_force: [s] with the recommended carry's force, infinite where it cannot.
        force_at_duration: [N] in the recommended carry's time, infinite where it cannot.
        faster_between: least and largest force limit [N] at which it is faster than every member
            of the front, None where it never is.
    """

    label: str
    duration_at_force: float
    force_at_duration: float
    faster_between: tuple[float, float] | None = None

    def __repr__(self) -> str:
        force, time = "cannot move with so little force", "is never so fast"
        if np.isfinite(self.duration_at_force):
            force = f"{self.duration_at_force:.3f} s at the same force"
        if np.isfinite(self.force_at_duration):
            time = f"{self.force_at_duration:.2f} N in the same time"
        return f"{self.label}: {force}, {time}"


@dataclass(frozen=True)
class Reference:
    """The recommended carry and its front, for comparison with rivals.

    Attributes:
        front: the paths of the front.
        member: that of the recommended carry.
        force: its limit on the normal forces [N].
        forces: (n,) limits at which the whole front is held against them [N].
    """

    front: DrivenPaths
    member: int
    force: float
    forces: Array


def rivals(cell: Cell, paths: Mapping[str, Array], beside: Reference) -> tuple[Rival, ...]:
    """Each path (n_path,) by its label beside the recommended carry and its front.

    The duration at the same force is that of the independent timing, as the recommended carry's
    own is; forces and the front's durations are compared by the compiled timing, which also gives
    the duration that the rival has to keep to.
    """
    best = np.array([beside.front.durations(float(limit)).min() for limit in beside.forces])
    in_time = float(beside.front.durations(beside.force)[beside.member])
    found = []
    for label, path in paths.items():
        driven = DrivenPaths.of(cell, path)
        own = np.array([driven.durations(float(limit))[0] for limit in beside.forces])
        ahead = beside.forces[own < best * (1.0 - BETTER)]
        decision = np.append(path, beside.force)
        limits = cell.timing_model.drive_limits(beside.force)
        timing = time_path(cell.timing_model, decision, limits)
        found.append(
            Rival(
                label,
                timing.duration if timing.ok else float("inf"),
                float(driven.forces(in_time)[0]),
                (float(ahead.min()), float(ahead.max())) if len(ahead) else None,
            )
        )
    return tuple(found)


def comparison_forces(points: Array) -> Array:
    """(n,) force limits [N] over a front's own range, closer together where force is least."""
    low, high = float(points[:, 1].min()), float(points[:, 1].max())
    return low + (high - low) * np.linspace(0.0, 1.0, FORCES) ** 2
