"""Selecting one carry of a front: the balanced one, or the least force of one robot.

The balanced carry has the least mean of both robots' peak normal forces. Where one robot can
relieve the other at no cost, a polished front is flat: many points have the same mean to five
digits. The most even of such points is selected, which leaves most room for payload. Drivable
fronts reach down to forces at which a carry hardly moves; their knee is selected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.carry import Carry
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from symbolic.array import Array
from symbolic.errors import SettingsError

TIE = 3e-4
"""Relative difference below which two mean forces are equal to any robot: 15 mN on the rack."""

_CHUNK = 256
"""Candidates evaluated at once; every sample of each is held in memory."""


@dataclass(frozen=True)
class SelectedCarry:
    """The carry that stands for a front.

    Attributes:
        row: its row among the replica's evaluations, or in the polished front.
        carry: the carry with its verdict, under the task's time law.
    """

    row: int
    carry: Carry

    @property
    def objectives(self) -> Array:
        """(n_obj,) without penalty."""
        assert self.carry.judgement is not None
        return np.array(list(self.carry.judgement.objectives.values()))


def balanced(peak_normal_force: Array) -> int:
    """Index of the least mean of both robots' peak forces (k, 2); of equals, whose means differ by
    less than `TIE`, that of the least larger force."""
    mean = peak_normal_force.mean(axis=1)
    equal = mean <= mean.min() * (1.0 + TIE)
    return int(np.argmin(np.where(equal, peak_normal_force.max(axis=1), np.inf)))


def knee(points: Array) -> int:
    """Index of the point (k, 2) whose objectives, both positive, have the least product.

    Beside it one per cent of either objective buys at most one per cent of the other. The distance
    from the line between the front's ends (Das 1999) would depend on how far the ends were
    explored: one long carry at almost the least force moves it by a newton.

    Raises:
        SettingsError: there are no points, or an objective is not positive.
    """
    points = np.asarray(points, dtype=float)
    if len(points) == 0:
        raise SettingsError("the front is empty: it has no knee")
    if not (points > 0.0).all():
        raise SettingsError("the knee needs objectives above zero")
    return int(np.argmin(np.log(points).sum(axis=1)))


def select(
    evaluator: CandidateEvaluator, x: Array, rows: NDArray[np.intp] | None = None
) -> SelectedCarry | None:
    """The carry that stands for a front, None where the front is empty.

    Args:
        x: (k, n_var) the front's decision vectors.
        rows: (k,) what `SelectedCarry.row` names them by, None for their places in the front.
    """
    if len(x) == 0:
        return None
    index = selected_row(evaluator, x)
    row = index if rows is None else int(rows[index])
    return SelectedCarry(row, evaluator.carry(x[index]))


def selected_row(evaluator: CandidateEvaluator, x: Array) -> int:
    """Index of the carry that stands for a front (k, n_var), k > 0: the balanced one, under the
    time law 'optimal' the knee of duration and larger peak force."""
    peaks, durations = _peaks_and_durations(evaluator, x)
    if evaluator.workcell.task.time_law != "optimal":
        return balanced(peaks)
    return knee(np.column_stack([durations, peaks.max(axis=1)]))


def peak_normal_forces(evaluator: CandidateEvaluator, x: Array) -> Array:
    """(n, 2) peak normal force of each robot [N] for decision vectors (n, n_var)."""
    return _peaks_and_durations(evaluator, x)[0]


def _peaks_and_durations(evaluator: CandidateEvaluator, x: Array) -> tuple[Array, Array]:
    """(n, 2) peak normal forces [N] and (n,) durations [s] of decision vectors (n, n_var)."""
    peaks, durations = [], []
    for begin in range(0, len(x), _CHUNK):
        outputs = evaluator.outputs(x[begin : begin + _CHUNK])
        peaks.append(outputs["normal_force"].max(axis=1))
        durations.append(outputs["time"][:, -1])
    return np.concatenate(peaks), np.concatenate(durations)
