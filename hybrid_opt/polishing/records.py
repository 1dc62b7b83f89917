"""Records that the polish returns and stores."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.solvers.base import Residuals
from symbolic.array import AllowMissing, Array, Count, Figure, Range, Shape

Aim = Literal["point", "extreme", "balance", "gap", "probe"]
Status = Literal["accepted", "optimal", "rejected", "failed"]


@dataclass(frozen=True)
class PolishOutcome:
    """Outcome of one attempt.

    Attributes:
        aim: purpose of the attempt. 'point' improves a point of the given front; 'extreme',
            'balance' and 'gap' look for new points; 'probe' is a short solve that chooses where to
            look.
        parent: index of the point of the given front that is improved, -1 for a new point.
        status: accepted; optimal (no improvement beyond the tolerance, so the start stays);
            rejected by the full evaluation; failed in the solver.
        reason: reason why the attempt was not accepted, else ''.
        x: (n_var,) new decision vector if accepted, otherwise the start.
        start, objectives: (2,) objectives before and after the attempt; equal if nothing was
            accepted.
        residuals: optimality residuals of the solver's last result, accepted or not.
        iterations: solver iterations, over all trust-region iterations.
        rounds: number of trust-region iterations.
        rows: number of rows (scalar inequalities) at points of the path in the last program.
        seconds: wall time of the attempt, full evaluation and certification included.
    """

    aim: Aim
    parent: Annotated[int, Range(-1, 10**9)]
    status: Status
    reason: str
    x: Annotated[Array, Shape((None,)), AllowMissing()]
    start: Annotated[Array, Shape((2,)), AllowMissing()]
    objectives: Annotated[Array, Shape((2,)), AllowMissing()]
    residuals: Residuals
    iterations: Count
    rounds: Count
    rows: Count
    seconds: Figure


@dataclass(frozen=True)
class PolishEffort:
    """Effort and success of a polish.

    Attributes:
        solver: solver of the programs: 'dense', 'ipopt', or 'quadratic' for drivable carries.
        attempts: number of attempts.
        counts: number of attempts by status; attempts not accepted also by 'status: reason'.
        success_share: of the attempts to improve a point of the given front, the share that ended
            as accepted or optimal.
        seconds: total wall time [s].
        median_attempt_seconds: median wall time of an attempt [s].
        equivalent_evaluations: number of candidate evaluations that take as long as the polish.
        widest_gap: largest distance between neighbours, as a share of the front's length along both
            objectives; NaN for fewer than two points.
        worst_stationarity, worst_feasibility, median_stationarity: largest and median optimality
            residuals of those points on the final front that a solve made.
    """

    solver: str
    attempts: Count
    counts: Mapping[str, Count]
    success_share: Figure
    seconds: Annotated[float, Range(0.0, 1e12)]
    median_attempt_seconds: Figure
    equivalent_evaluations: Count
    widest_gap: Figure
    worst_stationarity: Figure
    worst_feasibility: Figure
    median_stationarity: Figure


@dataclass(frozen=True)
class PolishedFront:
    """A polished front as it is stored; arrays are read-only.

    Attributes:
        x: (k, n_var) non-dominated decision vectors, by increasing first objective.
        objectives: (k, 2) objectives by the full evaluator.
        parent: (k,) index of the point of the given front that a point is or replaces, -1 for a new
            point.
        polished: (k,) True for points that the polish made.
        outcomes: all attempts, in order.
        solver: solver of the programs: 'dense', 'ipopt', or 'quadratic' for drivable carries.
        seconds: total time [s].
        evaluation_seconds: measured time of one candidate evaluation [s], the unit of a search's
            effort.
    """

    x: Annotated[Array, Shape((None, None))]
    objectives: Annotated[Array, Shape((None, 2))]
    parent: Annotated[NDArray[np.int64], Shape((None,), int)]
    polished: Annotated[NDArray[np.bool_], Shape((None,), bool)]
    outcomes: tuple[PolishOutcome, ...]
    seconds: Annotated[float, Range(0.0, 1e12)]
    evaluation_seconds: Annotated[float, Range(1e-12, 1e12)]
    solver: str

    def __post_init__(self) -> None:
        """Make the arrays read-only.

        Raises:
            ValueError: the arrays have different lengths.
        """
        arrays = (self.x, self.objectives, self.parent, self.polished)
        if len({len(array) for array in arrays}) > 1:
            raise ValueError("its arrays have different lengths")
        for array in arrays:
            array.setflags(write=False)

    @property
    def widest_gap(self) -> float:
        """Largest distance between neighbouring points, as a share of the front's length. Both are
        sums over the objectives, each divided by its range over the front. NaN for fewer than two
        points.
        """
        if len(self.objectives) < 2:
            return float("nan")
        sides = np.abs(np.diff(self.objectives, axis=0))
        return float((sides / sides.sum(axis=0)).sum(axis=1).max() / 2.0)

    @property
    def counts(self) -> dict[str, int]:
        """Number of attempts by status.

        Attempts that were not accepted are also counted by 'status: reason'.
        """
        listed = Counter[str](outcome.status for outcome in self.outcomes)
        listed.update(f"{o.status}: {o.reason}" for o in self.outcomes if o.reason)
        return dict(listed)

    @property
    def effort(self) -> PolishEffort:
        """Record of the effort and success of the polish."""
        own = [o.status in ("accepted", "optimal") for o in self.outcomes if o.aim == "point"]
        # Others were judged as they are, without a solver.
        solved = [o for o in self.outcomes if o.rounds or o.status == "failed"]
        # What was dominated later, probes most of all, is no result.
        standing = {x.tobytes() for x in self.x}
        accepted = [
            o.residuals for o in solved if o.status == "accepted" and o.x.tobytes() in standing
        ]
        return PolishEffort(
            solver=self.solver,
            attempts=len(solved),
            counts=self.counts,
            success_share=float(np.mean(own)) if own else float("nan"),
            seconds=self.seconds,
            median_attempt_seconds=_median([o.seconds for o in solved]),
            equivalent_evaluations=int(np.ceil(self.seconds / self.evaluation_seconds)),
            widest_gap=self.widest_gap,
            worst_stationarity=max((r.stationarity for r in accepted), default=float("nan")),
            worst_feasibility=max((r.feasibility for r in accepted), default=float("nan")),
            median_stationarity=_median([r.stationarity for r in accepted]),
        )


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float("nan")
