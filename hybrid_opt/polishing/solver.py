"""One point's polish: IPOPT within a trust region that grows and shrinks with the full model.

Each round solves the smooth problem in a box about the best candidate so far, with the constraints
that are near there. The full evaluator then tells what the step violates. Such constraints are
added, or asked for more strictly, and the round is repeated; where that does not help, the box is
halved. Only steps that violate nothing and bring the target closer are taken, so that the answer
is never worse than the start. A step that ends inside the box is an optimum of the smooth problem.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.active import ActiveSet
from hybrid_opt.polishing.carry import Carry, CarryReader
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.passages import Row
from hybrid_opt.polishing.program import Answer, Ipopt, Program, ipopt, run
from hybrid_opt.polishing.records import UNKNOWN, PolishSettings, Residuals
from hybrid_opt.polishing.targets import Target, level, needed_level
from symbolic.array import Array
from symbolic.smooth.blocks import PlaceRow
from symbolic.smooth.problem import (
    ForceRow,
    PressureRow,
    SmoothProblem,
    branch_coefficients,
    smooth_problem,
)

CONE_TIGHT = 0
"""Branch of the normal force that rules unless the box is accelerated across by nearly 1 g."""

BRANCH_ACTIVITY = 0.02
"""Branches within this share of the ruling one are constraints, too."""

STRIDE = 2
"""Of the samples every so many get force rows: forces are smooth along the path. So do those beside
the highest, where the sample decides."""

FREE_STRIDE = 6
"""The same for a robot whose force only breaks ties."""

NEAR_PEAK = 0.98
"""Local maxima of the force above this share of the highest get rows."""

SLACK = 0.1
"""What the epigraph variables start above the peak forces, in units of the range."""

FIRST_RADIUS, LEAST_RADIUS, LARGEST_RADIUS = 1.0, 1e-3, 2.0
"""Half the width of the box of trust, in halves of the decision variables' ranges."""

INSIDE = 0.9
"""Steps shorter than this times the radius are not held by the box."""

STRICTER = 1e-4
"""Least rise of a required value that counts as a new demand [m, rad, 1]."""

LASTING = ("clearance", "lower", "upper")
"""Kinds of rows that are kept when the solve moves on to another candidate."""

LEVEL_BOUND = 2e3
"""Bound of |phi| and |a|; beyond anything the targets ask for."""

KEPT_PROBLEMS = 32
"""Assembled problems kept for reuse."""


@dataclass(frozen=True)
class SolveTask:
    """A start and a target.

    Attributes:
        x: (n_var,) feasible decision vector to start from.
        target: what to aim at.
        radius: of the first box of trust, in halves of the decision variables' ranges.
    """

    x: Array
    target: Target
    radius: float = FIRST_RADIUS


@dataclass(frozen=True)
class Solution:
    """What the solver says; not yet believed.

    Attributes:
        x: (n_var,) the best candidate, the start where nothing was gained.
        message: IPOPT's status in the last round.
        converged: whether the last step ended inside the box at an optimum, by IPOPT's word.
        usable: whether IPOPT returned numbers in any round.
        residuals: of the round that gave x, or of the last one where nothing was gained.
        iterations, rounds: in total.
        rows: constraints at places of the path in the round of the residuals.
    """

    x: Array
    message: str
    converged: bool
    usable: bool
    residuals: Residuals
    iterations: int
    rounds: int
    rows: int


@dataclass
class _Progress:
    """The candidate that a solve has reached, and what it learned of the constraints."""

    x: Array
    carry: Carry
    radius: float
    went_well: bool = False
    rows: set[Row] = field(default_factory=set)
    demanded: dict[Row, float] = field(default_factory=dict)
    forces: set[ForceRow] = field(default_factory=set)
    samples: set[int] = field(default_factory=set)
    pressed: set[PressureRow] = field(default_factory=set)


class PolishSolver:
    """Solves for one evaluator's cell. A resource: one per process."""

    def __init__(
        self, evaluator: CandidateEvaluator, functions: PolishFunctions, settings: PolishSettings
    ) -> None:
        self._workcell, self._task = evaluator.workcell, evaluator.workcell.task
        self._functions, self._settings = functions, settings
        self._active = ActiveSet(evaluator, functions.rows, settings)
        self._reader = CarryReader(evaluator)
        self._coefficients = branch_coefficients(self._workcell)
        half = (self._task.upper - self._task.lower) / 2.0
        self._half = np.where(half > 0.0, half, 1.0)
        last = self._task.samples - 1
        # One-sided differences make the forces of the first and last samples no smooth function.
        self._every = {*range(0, last, STRIDE), 1, last - 1, last}
        self._kept: OrderedDict[Any, tuple[SmoothProblem, Ipopt]] = OrderedDict()

    def solve(self, task: SolveTask) -> Solution:
        """Improve towards the task's target."""
        x = np.clip(task.x, self._task.lower, self._task.upper)
        now = _Progress(x, self._reader.read(x), task.radius)
        best = Solution(x, "", False, False, UNKNOWN, 0, 0, 0)
        while (
            best.rounds < self._settings.rounds
            and now.radius >= LEAST_RADIUS
            and not best.converged
        ):
            required = self._required(now, lenient=best.rounds == 0)
            answer = self._round(now, task.target, required)
            moved = self._judge(now, task.target, answer, required)
            best = replace(
                best,
                x=now.x,
                message=answer.message,
                converged=moved == "inside" and answer.converged,
                usable=best.usable or answer.usable,
                iterations=best.iterations + answer.iterations,
                rounds=best.rounds + 1,
            )
            if moved != "refused" or not np.isfinite(best.residuals.stationarity):
                best = replace(best, residuals=answer.residuals, rows=len(required))
        return best

    def _required(self, now: _Progress, lenient: bool) -> dict[Row, float]:
        """The rows of the next round and what each has to keep."""
        rows = sorted(now.rows | set(self._active.near(now.carry)))
        required = self._active.required(now.carry, rows, lenient)
        for row, value in now.demanded.items():
            required[row] = max(value, required[row])
        return required

    def _judge(
        self, now: _Progress, target: Target, answer: Answer, required: dict[Row, float]
    ) -> Literal["refused", "held", "inside"]:
        """Take the answer or learn from it; 'held' where the box of trust stopped the step."""
        if not answer.usable:
            now.radius /= 4.0
            return "refused"
        carry = self._reader.read(answer.x)
        missing = set(self._active.violated(carry, now.carry))
        branches = self._other_branches(carry) - now.forces
        pressed = self._active.pressed(carry, share=1.0 - self._settings.margin)
        if missing or branches or pressed or not carry.is_followed:
            now.pressed |= pressed
            self._learn(now, carry, missing, branches, required)
            return "refused"
        step = float(np.max(np.abs(answer.x - now.x) / self._half))
        if level(target, carry.peak) >= level(target, now.carry.peak):
            peaks = self._peaks(carry) - now.samples - self._peaks(now.carry) - self._every
            now.samples |= peaks
            if not peaks:
                now.radius = min(now.radius, step) / 4.0
            return "refused"
        now.x, now.carry = answer.x, carry
        # What was demanded of other rows was relative to the candidate that is left behind.
        now.rows = {row for row in now.rows if row[0].kind in LASTING}
        now.demanded = {row: v for row, v in now.demanded.items() if row[0].kind in LASTING}
        held = step >= INSIDE * now.radius
        if now.went_well and held:
            now.radius = min(2.0 * now.radius, LARGEST_RADIUS)
        now.went_well = True
        return "held" if held else "inside"

    def _learn(
        self,
        now: _Progress,
        carry: Carry,
        missing: set[Row],
        branches: set[ForceRow],
        required: dict[Row, float],
    ) -> None:
        """Take in what a step violated; halve the box where that asks for nothing new."""
        now.went_well = False
        now.rows |= missing
        now.forces |= branches
        demanded = self._active.required(carry, sorted(missing), lenient=False)
        for row in missing:
            if row[0].kind == "singularity" and carry.stranded:
                demanded[row] = self._active.halfway(now.carry, row, required.get(row, 0.0))
        stricter = bool(branches)
        for row, value in demanded.items():
            stricter |= row not in required or value > required[row] + STRICTER
            now.demanded[row] = max(value, now.demanded.get(row, -np.inf))
        if not (stricter and carry.is_followed):
            now.radius /= 2.0

    def _round(self, now: _Progress, target: Target, required: dict[Row, float]) -> Answer:
        """Solve the smooth problem in the box of trust."""
        rows, carry = sorted(required), now.carry
        samples = self._every | now.samples | self._peaks(carry)
        cones = {
            (robot, CONE_TIGHT, k)
            for robot in (0, 1)
            for k in samples
            if target.limits[robot] or k % FREE_STRIDE == 0
        }
        forces = sorted(cones | now.forces | self._other_branches(carry))
        pressed = sorted(now.pressed | self._active.pressed(carry))
        places = sorted({place for _, place in rows})
        index = {place: k for k, place in enumerate(places)}
        placed = tuple((kind, index[place]) for kind, place in rows)
        problem, solver = self._problem(tuple(forces), tuple(pressed), placed, len(places))
        xi, low, high = (
            (x - problem.centre) / problem.scale
            for x in (now.x, self._task.lower, self._task.upper)
        )
        phi = (carry.peak - target.anchor) / target.span + SLACK
        free = len(forces) + 2
        return run(
            problem,
            solver,
            Program(
                start=np.concatenate([xi, phi, [needed_level(target, phi) + SLACK]]),
                parameters=problem.parameters(
                    target.vector(),
                    self._reader.basis[places],
                    self._reader.rate_basis[places],
                    carry.q[0][places],
                    carry.q[1][places],
                ),
                low=np.concatenate([np.maximum(low, xi - now.radius), np.full(3, -LEVEL_BOUND)]),
                high=np.concatenate([np.minimum(high, xi + now.radius), np.full(3, LEVEL_BOUND)]),
                below=np.concatenate(
                    [
                        np.full(free, -np.inf),
                        np.full(len(pressed), self._settings.margin),
                        np.array([required[row] for row in rows]) / problem.row_scale,
                    ]
                ),
                above=np.concatenate([np.zeros(free), np.full(len(pressed) + len(rows), np.inf)]),
            ),
        )

    def _problem(
        self,
        forces: tuple[ForceRow, ...],
        pressed: tuple[PressureRow, ...],
        rows: tuple[PlaceRow, ...],
        places: int,
    ) -> tuple[SmoothProblem, Ipopt]:
        key = (forces, pressed, rows, places)
        if key not in self._kept:
            problem = smooth_problem(
                self._workcell,
                self._functions.samples,
                self._functions.solve,
                self._functions.rows,
                *key,
            )
            self._kept[key] = problem, ipopt(problem, self._settings)
            if len(self._kept) > KEPT_PROBLEMS:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    def _peaks(self, carry: Carry) -> set[int]:
        """Samples at and beside local maxima of either robot's normal force."""
        force = np.einsum("rbk,nk->nrb", self._coefficients, carry.split).max(axis=2)
        inner = force[1:-1]
        high = (
            (inner >= force[:-2]) & (inner >= force[2:]) & (inner >= NEAR_PEAK * inner.max(axis=0))
        )
        tops = np.flatnonzero(high.any(axis=1)) + 1
        return {int(k) for k in (tops[:, None] + np.array([-1, 0, 1])).ravel()}

    def _other_branches(self, carry: Carry) -> set[ForceRow]:
        """Force rows of other branches than the tight cones' that rule, or nearly do."""
        force = np.einsum("rbk,nk->nrb", self._coefficients, carry.split)
        near = force >= (1.0 - BRANCH_ACTIVITY) * force.max(axis=2, keepdims=True)
        near[:, :, CONE_TIGHT] = False
        return {
            (int(robot), int(branch), int(k))
            for k, robot, branch in zip(*np.nonzero(near), strict=True)
        }
