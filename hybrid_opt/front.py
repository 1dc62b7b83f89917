"""A front: the feasible carries that no other one dominates, from a search or a polish; and the
carry selected from it.

The balanced carry has the least mean of both robots' peak normal forces. Where one robot can
relieve the other at no cost, a polished front is flat: many points have the same mean to five
digits. The most even of such points is selected, which leaves most room for payload. Drivable
fronts reach down to forces at which a carry hardly moves; their knee is selected.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.display_protocol import Displayable
from hybrid_opt.evaluate.evaluation import CandidateEvaluator, Evaluations
from hybrid_opt.indicators import metrics
from hybrid_opt.polishing.records import PolishedFront
from symbolic.array import Array, set_read_only
from symbolic.errors import SettingsError


@dataclass(frozen=True, eq=False, repr=False)
class Front(Displayable):
    """Non-dominated feasible carries of a cell, by increasing first objective; read-only arrays.

    Every member is proven free of collisions between the samples too.

    Attributes:
        cell: the cell.
        algorithm: what found it, as 'nsga2', or a word for how else it came about.
        x: (k, n_var) decision vectors.
        objectives: (k, n_obj).
        evaluations: every candidate of the search, in order.
        polished: record of its polish, None without one.
        replica: of a study, from 0; None where it is of none.
    """

    cell: Cell
    algorithm: str
    x: Array
    objectives: Array
    evaluations: Evaluations
    polished: PolishedFront | None = None
    replica: int | None = None

    def __post_init__(self) -> None:
        set_read_only(self)

    @classmethod
    def of_search(
        cls, cell: Cell, algorithm: str, evaluations: Evaluations, replica: int | None = None
    ) -> Front:
        """Return the front of evaluations that `CandidateEvaluator.certified` has processed."""
        rows = metrics.front_rows(evaluations.objectives, evaluations.feasible)
        x, objectives = evaluations.x[rows], evaluations.objectives[rows]
        return cls(cell, algorithm, x, objectives, evaluations, replica=replica)

    @classmethod
    def of(cls, cell: Cell, x: Array) -> Front:
        """Evaluate carries that are known to be feasible and free, and return them as a front.

        Args:
            x: (k, n_var) decision vectors by increasing first objective.

        Raises:
            SettingsError: x has the wrong shape.
        """
        found = cell.evaluate(x)
        return cls(cell, "given", found.x, found.objectives, found)

    def after(self, polish: PolishedFront) -> Front:
        """Return the front after its polish."""
        return replace(self, x=polish.x, objectives=polish.objectives, polished=polish)

    @property
    def key(self) -> tuple[str, int]:
        """Algorithm and number of the replica, 0 if it belongs to none."""
        return self.algorithm, self.replica or 0

    @property
    def title(self) -> str:
        """The algorithm's, and whether polished."""
        # Not imported at the top: the searches take long to load.
        from hybrid_opt.metaheuristics.run import title

        return title(self.algorithm) + ("" if self.polished is None else ", polished")

    @property
    def source(self) -> str:
        """The title with the number of the replica, as its files have it."""
        return self.title if self.replica is None else f"{self.title}, replica {self.replica}"

    @property
    def objective_names(self) -> tuple[str, ...]:
        """Names of the objectives."""
        return self.cell.objective_names

    def __len__(self) -> int:
        return len(self.x)

    def __getitem__(self, index: int) -> Carry:
        """Return a member in detail, by its index on the front."""
        return self.cell.carry(self.x[index])

    def __iter__(self) -> Iterator[Carry]:
        return (self[index] for index in range(len(self)))

    def balanced(self) -> Carry:
        """Return the member of least mean of both robots' peak normal forces, see `balanced`.

        Raises:
            SettingsError: the front is empty.
        """
        return self[balanced(self._peaks())]

    def lowest_force(self, robot: int) -> Carry:
        """Return the member of least peak normal force of one robot.

        Args:
            robot: 0 or 1.

        Raises:
            SettingsError: the front is empty, or there is no such robot.
        """
        if robot not in (0, 1):
            raise SettingsError(f"robot {robot!r}; allowed are 0 and 1", code="robot")
        return self[int(np.argmin(self._peaks()[:, robot]))]

    def lowest(self, objective: str) -> Carry:
        """Return the member with the least value of one of the objectives.

        Raises:
            SettingsError: the front is empty, or was not searched for that objective.
        """
        if objective not in self.objective_names:
            raise SettingsError(
                f"objective {objective!r}; this front has {', '.join(self.objective_names)}",
                code="unknown-objective",
            )
        self._require_members()
        return self[int(np.argmin(self.objectives[:, self.objective_names.index(objective)]))]

    def hypervolume(self, reference: Array | None = None) -> float:
        """Compute the volume that the front dominates up to a reference point (n_obj,), by default
        the paper's 1.1."""
        point = metrics.reference_point(len(self.objective_names))
        return metrics.hypervolume(self.objectives, point if reference is None else reference)

    def spacing(self) -> float:
        """Compute the unevenness of the front, see `hybrid_opt.indicators.metrics.spacing`."""
        return metrics.spacing(self.objectives)

    def _peaks(self) -> Array:
        self._require_members()
        return peak_normal_forces(self.cell.evaluator, self.x)

    def _require_members(self) -> None:
        if len(self) == 0:
            raise SettingsError(
                "the front is empty: no feasible candidate was found; give the search more "
                "evaluations or the task wider bounds",
                code="empty-front",
            )


TIE = 3e-4
"""Relative difference below which two mean forces are equal to any robot: 15 mN on the rack."""

_CHUNK = 256
"""Candidates evaluated at once; every sample of each is held in memory."""


@dataclass(frozen=True)
class SelectedCarry:
    """The carry selected from a front.

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
    """Return the index of the least mean of both robots' peak forces (k, 2); among means that
    differ by less than `TIE`, that of the least larger force."""
    mean = peak_normal_force.mean(axis=1)
    equal = mean <= mean.min() * (1.0 + TIE)
    return int(np.argmin(np.where(equal, peak_normal_force.max(axis=1), np.inf)))


def knee(points: Array) -> int:
    """Return the index of the point (k, 2) with the least product of objectives, both positive.

    Beside it one per cent of either objective buys at most one per cent of the other. The distance
    from the line between the front's ends (Das 1999) would depend on how far the ends were
    explored: one long carry at almost the least force moves it by a newton.

    Raises:
        SettingsError: there are no points, or an objective is not positive.
    """
    points = np.asarray(points, dtype=float)
    if len(points) == 0:
        raise SettingsError("the front is empty: it has no knee", code="empty-front")
    if not (points > 0.0).all():
        raise SettingsError("the knee needs objectives above zero", code="not-positive")
    return int(np.argmin(np.log(points).sum(axis=1)))


def select(
    evaluator: CandidateEvaluator, x: Array, rows: NDArray[np.intp] | None = None
) -> SelectedCarry | None:
    """Select the carry that represents a front, None if the front is empty.

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
    """Return the index of the selected carry of a front (k, n_var), k > 0: the balanced one, in
    drivable cells the knee of duration and larger peak force."""
    peaks, durations = _peaks_and_durations(evaluator, x)
    if not evaluator.workcell.task.law.is_drivable:
        return balanced(peaks)
    return knee(np.column_stack([durations, peaks.max(axis=1)]))


def peak_normal_forces(evaluator: CandidateEvaluator, x: Array) -> Array:
    """Compute the peak normal force (n, 2) of each robot [N] for decision vectors (n, n_var)."""
    return _peaks_and_durations(evaluator, x)[0]


def _peaks_and_durations(evaluator: CandidateEvaluator, x: Array) -> tuple[Array, Array]:
    """Compute peak normal forces (n, 2) [N] and durations (n,) [s] of decision vectors (n,
    n_var)."""
    peaks, durations = [], []
    for begin in range(0, len(x), _CHUNK):
        outputs = evaluator.outputs(x[begin : begin + _CHUNK])
        peaks.append(outputs["normal_force"].max(axis=1))
        durations.append(outputs["time"][:, -1])
    return np.concatenate(peaks), np.concatenate(durations)
