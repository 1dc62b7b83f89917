"""Paths beside one another: at the same force, and at the same duration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.objectives import PLANNED_FORCE, ForceKind
from hybrid_opt.recommending.choice import DrivenPaths
from hybrid_opt.robust.force import BoxMotion, robust_model
from hybrid_opt.static_hold import static_hold
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array
from symbolic.records import Workcell

BETTER = 1e-3
"""Share by which a rival has to be shorter to count as better: timings agree to so much."""

FORCES = 12
"""Limits at which a front is held against a rival."""

ABOVE_STILL = (1.02, 1.04, 1.06, 1.08, 1.12, 1.2)
"""Forces of the table over that of holding the payload level and still."""

MEMBERS = 24
"""Members of a front that are timed, evenly spread over it."""


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


def rivals(
    cell: Cell,
    paths: Mapping[str, Array],
    *,
    front: DrivenPaths,
    points: Array,
    member: int,
    force: float,
) -> tuple[Rival, ...]:
    """Each path (n_path,) by its label beside the recommended carry and its front.

    The duration at the same force is that of the independent timing, as the recommended carry's
    own is; forces and the front's durations are compared by the compiled timing, which also gives
    the duration that the rival has to keep to.

    Args:
        front: the paths of the front.
        points: (k, 2) duration [s] and largest limited force [N] of its members.
        member: that of the recommended carry.
        force: its limit on the normal forces [N].
    """
    low, high = float(points[:, 1].min()), float(points[:, 1].max())
    # Over the front's own range, closer together where force is least.
    compared = low + (high - low) * np.linspace(0.0, 1.0, FORCES) ** 2
    best = np.array([front.durations(float(limit)).min() for limit in compared])
    in_time = float(front.durations(force)[member])
    found = []
    for label, path in paths.items():
        driven = DrivenPaths.of(cell, path)
        own = np.array([driven.durations(float(limit))[0] for limit in compared])
        ahead = compared[own < best * (1.0 - BETTER)]
        limits = cell.timing_model.drive_limits(force)
        timing = time_path(cell.timing_model, np.append(path, force), limits)
        found.append(
            Rival(
                label,
                timing.duration if timing.ok else float("inf"),
                float(driven.forces(in_time)[0]),
                (float(ahead.min()), float(ahead.max())) if len(ahead) else None,
            )
        )
    return tuple(found)


def level_force(workcell: Workcell, kind: ForceKind) -> float:
    """Largest force of a robot that holds the payload level and still [N].

    Raises:
        SettingsError: the uncertainty leaves no friction or patch.
    """
    if not kind.robust:
        return float(static_hold(workcell).normal_force.max())
    still = np.zeros((1, 6))
    model = robust_model(workcell)
    return float(np.max(model.hold(BoxMotion(still, still, still), workcell.uncertainty)))


def table_forces(workcell: Workcell, kind: ForceKind = PLANNED_FORCE) -> Array:
    """(n,) force limits of the table [N], those within the force limit's bounds."""
    forces = level_force(workcell, kind) * np.array(ABOVE_STILL)
    low, high = workcell.task.force_limit
    return np.asarray(forces[(forces >= low) & (forces <= high)])


def front_durations(paths: DrivenPaths, forces: Array) -> Array:
    """(n,) shortest duration [s] of any of the paths at each force, infinite for none."""
    return np.array([paths.durations(float(force)).min(initial=np.inf) for force in forces])


def spread_members(paths: Array) -> Array:
    """At most `MEMBERS` different ones of a front's paths (k, n), both ends among them."""
    different = np.sort(np.unique(paths, axis=0, return_index=True)[1])
    rows = np.linspace(0, len(different) - 1, min(len(different), MEMBERS)).round().astype(int)
    return np.asarray(paths[different[np.unique(rows)]])


def over_replicas(durations: Sequence[Array]) -> tuple[Array, Array, Array]:
    """Median, least and largest (n,) of the replicas' durations at each force."""
    every = np.array(durations)
    return np.median(every, axis=0), every.min(axis=0), every.max(axis=0)
