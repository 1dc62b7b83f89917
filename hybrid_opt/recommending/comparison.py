"""Paths beside one another: at the same force, and at the same duration."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.cell import Cell
from hybrid_opt.errors import JobError
from hybrid_opt.evaluate.objectives import PLANNED_FORCE, ForceKind
from hybrid_opt.job.smooth import driven_timing
from hybrid_opt.recommending.choice import (
    DrivenPaths,
    Goal,
    best_of_paths,
    commanded_at_most,
    duration_alone,
    force_alone,
)
from hybrid_opt.robust.force import at_rest, robust_model
from hybrid_opt.static_hold import static_hold
from hybrid_opt.timing.records import Timing
from symbolic.array import Array, Figure
from symbolic.records import Workcell

BETTER = 1e-3
"""Share by which a rival must be shorter to count as better: timings agree that closely."""

ABOVE_STILL = (1.02, 1.04, 1.06, 1.08, 1.12, 1.2)
"""Forces of the table over that of holding the payload level and still."""

MEMBERS = 24
"""Members of a front that are timed, evenly spread over it."""


@dataclass(frozen=True, repr=False)
class Rival:
    """A path driven as fast as the same limits allow, those on jerk among them.

    Attributes:
        label: what it is.
        duration_at_force: [s] with the recommended carry's commanded force, infinite where it
            cannot.
        force_at_duration: force to command [N] in the recommended carry's time, infinite where it
            cannot.
    """

    label: str
    duration_at_force: Figure
    force_at_duration: Figure

    def __repr__(self) -> str:
        force = "cannot be held with the same force"
        time = "cannot be driven in the same time"
        if np.isfinite(self.duration_at_force):
            force = f"{self.duration_at_force:.3f} s at the same force"
        if np.isfinite(self.force_at_duration):
            time = f"{self.force_at_duration:.1f} N in the same time"
        return f"{self.label}: {force}, {time}"


def rival(cell: Cell, label: str, path: Array, timing: Timing, force: float) -> Rival:
    """A path (n_path,) beside a recommended carry: its timing, and the force to command [N]."""
    assert timing.limits.force is not None, "drivable carries have a force limit"
    paths = DrivenPaths.of(cell, path)
    options = paths.all_options(timing.limits.force)
    goal = Goal(np.inf, commanded_at_most(force), duration_alone)
    found = next(best_of_paths(paths, options, goal, 1), None)
    longer, duration = 1.0, float("inf")
    if found is not None:
        with suppress(JobError):
            driven = driven_timing(cell.timing_model, np.append(path, found.limit))
            duration = driven.duration if driven.ok else duration
            longer = max(driven.duration / found.duration, 1.0) if driven.ok else 1.0
    in_time = Goal(timing.duration / longer, np.full(2, np.inf), force_alone)
    same = next(best_of_paths(paths, options, in_time, 1), None)
    return Rival(label, duration, float("inf") if same is None else same.commanded)


def level_force(workcell: Workcell, kind: ForceKind) -> float:
    """Largest force of a robot that holds the payload level and still [N].

    Raises:
        SettingsError: the uncertainty leaves no friction or patch.
    """
    if not kind.robust:
        return float(static_hold(workcell).normal_force.max())
    return float(np.max(robust_model(workcell).hold(at_rest(), workcell.uncertainty)))


def table_forces(workcell: Workcell, kind: ForceKind = PLANNED_FORCE) -> Array:
    """(n,) force limits of the table [N], those within the force limit's bounds."""
    forces = level_force(workcell, kind) * np.array(ABOVE_STILL)
    low, high = workcell.task.force_limit
    return np.asarray(forces[(forces >= low) & (forces <= high)])


def front_durations(paths: DrivenPaths, forces: Array) -> Array:
    """(n,) shortest duration [s] of any of the paths at each force, infinite for none."""
    return np.array([paths.durations(float(force)).min(initial=np.inf) for force in forces])


def spread_rows(paths: Array) -> NDArray[np.intp]:
    """Rows of at most `MEMBERS` different ones of a front's paths (k, n), both ends among them."""
    different = np.sort(np.unique(paths, axis=0, return_index=True)[1])
    rows = np.linspace(0, len(different) - 1, min(len(different), MEMBERS)).round().astype(int)
    return np.asarray(different[np.unique(rows)])


def over_replicas(durations: Sequence[Array]) -> tuple[Array, Array, Array]:
    """Median, least and largest (n,) of the replicas' durations at each force."""
    every = np.array(durations)
    return np.median(every, axis=0), every.min(axis=0), every.max(axis=0)
