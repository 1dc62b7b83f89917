"""What the polish reports."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from hybrid_opt.errors import ResultsError
from hybrid_opt.polishing.solvers.base import Residuals
from symbolic.array import Array

Aim = Literal["point", "extreme", "balance", "gap", "probe"]
Status = Literal["accepted", "optimal", "rejected", "failed"]


@dataclass(frozen=True)
class PolishOutcome:
    """What became of one attempt.

    Attributes:
        aim: 'point' improves a point of the given front; 'extreme', 'balance' and 'gap' look for
            new ones; 'probe' is a short solve that tells where to look.
        parent: row of the given front that is to be replaced, -1 for a new point.
        status: accepted; optimal (not improved by more than the tolerance: the original stays);
            rejected by the re-evaluation; failed in the solver.
        reason: why it was not accepted, empty if it was.
        x: (n_var,) the new decision vector if accepted, otherwise the one started from.
        start, objectives: (2,) before and after; equal where nothing was accepted.
        residuals: of the solver's last answer, whatever became of it.
        iterations: of the solver, over all rounds.
        rounds: solves, one more for every time that constraints were added.
        rows: constraints at places of the path in the last round.
        seconds: spent on this attempt, re-evaluation and certification included.
    """

    aim: Aim
    parent: int
    status: Status
    reason: str
    x: Array
    start: Array
    objectives: Array
    residuals: Residuals
    iterations: int
    rounds: int
    rows: int
    seconds: float


@dataclass(frozen=True)
class PolishedFront:
    """A front after the polish; arrays are read-only.

    Attributes:
        x: (k, n_var) non-dominated decision vectors, by increasing first objective.
        objectives: (k, 2) as the full evaluator gives them.
        parent: (k,) row of the given front that the point replaced or still is, -1 for a new one.
        polished: (k,) whether the polish made the point.
        outcomes: every attempt, in order.
        solver: what solved its programs: 'dense', 'ipopt', or 'quadratic' for drivable carries.
        seconds: spent in total.
        evaluation_seconds: measured for one candidate evaluation, the unit of the search.
    """

    x: Array
    objectives: Array
    parent: np.ndarray[tuple[int], np.dtype[np.int64]]
    polished: np.ndarray[tuple[int], np.dtype[np.bool_]]
    outcomes: tuple[PolishOutcome, ...]
    seconds: float
    evaluation_seconds: float
    solver: str

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for name in ("x", "objectives", "parent", "polished"):
            getattr(self, name).setflags(write=False)

    @property
    def equivalent_evaluations(self) -> int:
        """Candidate evaluations that take as long as the polish did."""
        return int(np.ceil(self.seconds / self.evaluation_seconds))

    @property
    def widest_gap(self) -> float:
        """Share of the front's length, along both objectives, between the neighbours that are
        farthest apart; NaN for fewer than two points."""
        if len(self.objectives) < 2:
            return float("nan")
        sides = np.abs(np.diff(self.objectives, axis=0))
        return float((sides / sides.sum(axis=0)).sum(axis=1).max() / 2.0)

    @property
    def counts(self) -> dict[str, int]:
        """Attempts by status, and those not accepted also by 'status: reason'."""
        listed = Counter[str](outcome.status for outcome in self.outcomes)
        listed.update(f"{o.status}: {o.reason}" for o in self.outcomes if o.reason)
        return dict(listed)

    @property
    def success_share(self) -> float:
        """Share of the attempted points of the given front that were accepted or optimal; NaN
        where none was attempted."""
        own = [o.status for o in self.outcomes if o.aim == "point"]
        good = sum(status in ("accepted", "optimal") for status in own)
        return good / len(own) if own else float("nan")


def outcome_to_json(outcome: PolishOutcome) -> dict[str, object]:
    """An outcome as JSON values; NaN becomes null."""
    values: dict[str, object] = {}
    for field in fields(outcome):
        value = getattr(outcome, field.name)
        if isinstance(value, np.ndarray):
            values[field.name] = [_number(float(v)) for v in value]
        elif isinstance(value, Residuals):
            values |= {f.name: _number(getattr(value, f.name)) for f in fields(value)}
        else:
            values[field.name] = _number(value) if isinstance(value, float) else value
    return values


def outcome_from_json(values: Mapping[str, Any]) -> PolishOutcome:
    """The outcome that `outcome_to_json` wrote.

    Raises:
        ResultsError: the values are not those of an outcome.
    """

    def numbers(name: str) -> Array:
        return np.array([np.nan if v is None else v for v in values[name]], dtype=float)

    def number(name: str) -> float:
        return float("nan") if values[name] is None else float(values[name])

    try:
        return PolishOutcome(
            aim=values["aim"],
            parent=int(values["parent"]),
            status=values["status"],
            reason=str(values["reason"]),
            x=numbers("x"),
            start=numbers("start"),
            objectives=numbers("objectives"),
            residuals=Residuals(*(number(field.name) for field in fields(Residuals))),
            iterations=int(values["iterations"]),
            rounds=int(values["rounds"]),
            rows=int(values["rows"]),
            seconds=float(values["seconds"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ResultsError(f"a recorded polish attempt is damaged ({error!r})") from error


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None
