"""How long fronts take at the same forces: the fastest member of each, timed anew."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybrid_opt.evaluate.objectives import PLANNED_FORCE, ForceKind
from hybrid_opt.recommending.driven_paths import DrivenPaths
from hybrid_opt.robust.force import BoxMotion, robust_model
from hybrid_opt.static_hold import static_hold
from symbolic.array import Array
from symbolic.records import Workcell

ABOVE_STILL = (1.02, 1.04, 1.06, 1.08, 1.12, 1.2)
"""Forces of the table over that of holding the payload level and still."""

MEMBERS = 24
"""Members of a front that are timed, evenly spread over it."""


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
