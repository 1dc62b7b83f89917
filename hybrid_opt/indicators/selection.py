"""The balanced solution of a front: the least mean of both robots' peak normal forces.

Where one robot can relieve the other at no cost, a polished front is flat: many points have the
same mean to five digits. Of such points the most even one is selected, which leaves most room for
payload.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hybrid_opt.campaign.polish_stage import PolishedReplica
from hybrid_opt.campaign.results import Replica
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.static_hold import StaticHold
from hybrid_opt.indicators.metrics import excess_above_static
from hybrid_opt.store.trajectory_figures import trajectory_figures
from symbolic.array import Array

TIE = 3e-4
"""Relative difference below which two mean forces are equal to any robot: 15 mN on the rack."""

_CHUNK = 256
"""Candidates evaluated at once; every sample of each is held in memory."""


@dataclass(frozen=True)
class Selected:
    """A front's balanced solution.

    Attributes:
        row: its row among the replica's evaluations, or in the polished front.
        x: (n_var,) decision vector.
        objectives: (n_obj,).
        peak_normal_force, minimum_normal_force: (2,) of each robot along the carry [N].
        excess_above_static: (2,) of the peaks above the static hold [%].
        mean_excess_above_static: of the mean of both peaks above that of the static hold [%].
        figures: those that are stored with its trajectory.
    """

    row: int
    x: Array
    objectives: Array
    peak_normal_force: Array
    minimum_normal_force: Array
    excess_above_static: Array
    mean_excess_above_static: float
    figures: Mapping[str, float]


def balanced(peak_normal_force: Array) -> int:
    """Index of the least mean of both robots' peak forces (k, 2); of equals, whose means differ by
    less than `TIE`, that of the least larger force."""
    mean = peak_normal_force.mean(axis=1)
    equal = mean <= mean.min() * (1.0 + TIE)
    return int(np.argmin(np.where(equal, peak_normal_force.max(axis=1), np.inf)))


def select(evaluator: CandidateEvaluator, replica: Replica, static: StaticHold) -> Selected | None:
    """The balanced solution of a replica's front, None where the front is empty."""
    if len(replica.front_rows) == 0:
        return None
    row = int(replica.front_rows[balanced(peak_normal_forces(evaluator, replica.front_x))])
    found = replica.evaluations
    return _selected(evaluator, row, found.x[row], found.objectives[row], static)


def select_polished(
    evaluator: CandidateEvaluator, front: PolishedReplica, static: StaticHold
) -> Selected | None:
    """The balanced solution of a polished front, by its row in that front."""
    if len(front.x) == 0:
        return None
    row = balanced(peak_normal_forces(evaluator, front.x))
    return _selected(evaluator, row, front.x[row], front.objectives[row], static)


def _selected(
    evaluator: CandidateEvaluator, row: int, x: Array, objectives: Array, static: StaticHold
) -> Selected:
    normal = evaluator.outputs(x[None])["normal_force"][0]
    peak = normal.max(axis=0)
    return Selected(
        row,
        x,
        objectives,
        peak,
        normal.min(axis=0),
        excess_above_static(peak, static.normal_force),
        float(excess_above_static(peak.mean(), static.normal_force.mean())),
        trajectory_figures(evaluator, x),
    )


def peak_normal_forces(evaluator: CandidateEvaluator, x: Array) -> Array:
    """(n, 2) peak normal force of each robot [N] for decision vectors (n, n_var)."""
    return np.concatenate(
        [
            evaluator.outputs(x[begin : begin + _CHUNK])["normal_force"].max(axis=1)
            for begin in range(0, len(x), _CHUNK)
        ]
    )
