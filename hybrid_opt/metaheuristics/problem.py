"""The search problem that pymoo's algorithms see, and the record of what they evaluated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, Literal, Protocol, get_args

import numpy as np
from pymoo.core.problem import Problem

from hybrid_opt.evaluate.evaluations import NOT_FINITE, REASONS, Evaluations, concatenated
from symbolic.array import Array
from symbolic.errors import SettingsError

ConstraintHandling = Literal["penalty", "constraints"]
"""How a search learns of infeasibility: by the paper's penalised objectives, or by objectives
and violations as inequality constraints."""

WORST_PENALTY = 1.0 + len(REASONS)
"""Penalised objective of a candidate whose figures are not finite: as if every constraint were
violated all the time."""


class Evaluator(Protocol):
    """Interface of an evaluator for the search, see
    `hybrid_opt.evaluate.evaluation.CandidateEvaluator`."""

    objective_names: tuple[str, ...]
    n_var: int
    lower: Array
    upper: Array

    def evaluate(self, x: Array) -> Evaluations:
        """Verdicts on decision vectors (n, n_var)."""

    def certified(self, evaluations: Evaluations) -> Evaluations:
        """The evaluations with their feasible front proven free between the samples."""


def disarmed(evaluations: Evaluations) -> Evaluations:
    """The evaluations with every candidate that has a figure that is not finite made infeasible.

    The last line of defence: whatever an evaluator returns, no NaN or infinity can look like a
    good candidate. Such candidates get `WORST_PENALTY` and the reason `NOT_FINITE`.
    """
    finite = np.isfinite(evaluations.violation).all(axis=1)
    finite &= np.isfinite(evaluations.violation_time).all(axis=1)
    finite &= np.isfinite(evaluations.penalised).all(axis=1)
    # Infeasible candidates may lack objectives: a lost arm has no joint torque.
    finite &= np.isfinite(evaluations.objectives).all(axis=1) | ~evaluations.feasible
    if finite.all():
        return evaluations
    broken = ~finite
    changed = {f.name: getattr(evaluations, f.name).copy() for f in fields(evaluations)}
    changed["penalised"][broken] = WORST_PENALTY
    changed["feasible"][broken] = False
    changed["reason"][broken] = REASONS.index(NOT_FINITE)
    changed["position"][broken] = 0.0
    for name in ("violation", "violation_time"):
        changed[name][broken] = 0.0
        changed[name][broken, REASONS.index(NOT_FINITE)] = 1.0
    return replace(evaluations, **changed)


class CarryProblem(Problem):  # type: ignore[misc]
    """A cell's candidates as a vectorised pymoo problem that keeps what it evaluated.

    With handling 'penalty' the objectives are the penalised ones (paper Eq. 60) and there are no
    constraints; with 'constraints' they are the plain ones, and each of `REASONS` is an
    inequality constraint with its violation as value. Every figure handed out is finite.

    Attributes:
        evaluator: what evaluates.
        handling: see above.
        evaluated: called with the number of candidates after each batch.
        batches: the evaluations of each call, in order.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        handling: ConstraintHandling = "penalty",
        evaluated: Callable[[int], None] = lambda count: None,
    ) -> None:
        if handling not in get_args(ConstraintHandling):
            raise SettingsError(
                f"constraint handling {handling!r}; known are "
                f"{', '.join(get_args(ConstraintHandling))}"
            )
        super().__init__(
            n_var=evaluator.n_var,
            n_obj=len(evaluator.objective_names),
            n_ieq_constr=len(REASONS) if handling == "constraints" else 0,
            xl=evaluator.lower,
            xu=evaluator.upper,
        )
        self.evaluator = evaluator
        self.handling = handling
        self.evaluated = evaluated
        self.batches: list[Evaluations] = []

    @property
    def evaluations(self) -> Evaluations:
        """Every evaluated candidate in the order of evaluation; there has to be one."""
        return concatenated(self.batches)

    def _evaluate(self, x: Array, out: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        batch = disarmed(self.evaluator.evaluate(x))
        self.batches.append(batch)
        self.evaluated(len(batch.feasible))
        if self.handling == "penalty":
            out["F"] = batch.penalised
        else:
            known = np.isfinite(batch.objectives).all(axis=1, keepdims=True)
            out["F"] = np.where(known, batch.objectives, batch.penalised)
            out["G"] = batch.violation
