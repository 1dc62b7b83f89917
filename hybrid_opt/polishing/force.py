"""Step method of both peak forces: one nonlinear program with exact derivatives.

Variables z = (xi, phi, a): the decision vector scaled to [-1, 1] by its bounds, both robots' peak
forces f (the epigraph of the paper's Eq. 60) as phi = (f - anchor) / span, and a level. With
anchor, span, direction, offset and cost of the scalarisation,

    minimise    cost . (a, phi_1, phi_2)
    subject to  (N_i,k(x) / N_ref,i - anchor_i) / span_i <= phi_i    chosen samples k, robot i
                phi_j <= direction_j a + offset_j                    both objectives
                1 - (shift_i,k(x) / patch radius_i)^2 >= margin      chosen robots and samples
                c_r(x) / scale_r >= required_r / scale_r             chosen rows at chosen points.

A direction of ones is the scalarisation of Pascoletti and Serafini (1984). Another set of rows
costs only its choice. Joints as variables with closure constraints have the same optima and take
four times as long.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hybrid_opt.polishing.cell import CarryReader, PlacedCarry, SmoothCell
from hybrid_opt.polishing.constraints.kinds import RowSelector
from hybrid_opt.polishing.front import Solution
from hybrid_opt.polishing.point import Iterate, Step, StepEvaluation, StepMethod, TrustRegionSolve
from hybrid_opt.polishing.rows import (
    PROGRAM_BRANCH,
    ConstraintRows,
    MinimisedForces,
    Row,
    RowLayout,
)
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.solvers.base import Residuals, Solve, optimality_residuals
from hybrid_opt.polishing.solvers.dense import dense
from hybrid_opt.polishing.solvers.ipopt import ipopt
from symbolic.array import Array

UNBOUNDED_OFFSET = 1e3
"""Offset of an objective that leaves it unbounded [spans]."""

LARGER_WEIGHT = 0.5
"""Weight of the larger objective, relative to the sum of both, in the balanced middle."""

TIE_WEIGHT = 1e-4
"""Weight of the sum of both objectives relative to the level. It excludes weakly efficient
points."""

EPIGRAPH_SLACK = 0.1
"""Difference between the epigraph variables and the peak forces at the start [spans]."""

LEVEL_BOUND = 2e3
"""Bound of |phi| and |a|, larger than any scalarisation needs."""

LEAST_FORCE_RADIUS = 1e-3
"""Radius of the trust region below which a solve ends."""

FORCE_BACKTRACKING = (3 / 4, 2 / 4, 1 / 4)
"""Fractions of a rejected step that are tried in its place."""

BARRIER, WIDE_BARRIER, NEAR_BARRIER = 3e-4, 3e-2, 1e-5
"""First barrier parameters of the solver: usual, wide and near. A point of a search is near the
solution but has no multipliers. Solves that look for other basins first move to the middle of the
feasible set."""

NEAR_ROUNDS, NEAR_ITERATIONS = 12, 30
"""Number of trust-region iterations from a nearly optimal start, and of solver iterations in
each."""

SolveMode = Literal["usual", "wide", "near", "brief"]
"""Effort of a solve. 'usual': improve a search's point. 'wide': look beyond the nearest optimum.
'near': the start is nearly an optimum of the scalarisation, such as a neighbour on the front.
'brief': end after `ProbeSettings.rounds` iterations."""


@dataclass(frozen=True)
class Scalarisation:
    """Objective of one solve: a scalar function of both peak forces.

    A peak force f_j, over the reference force, is scaled to phi_j = (f_j - anchor_j) / span_j. The
    level a is bounded by phi_j <= direction_j a + offset_j, and cost . (a, phi_1, phi_2) is
    minimised.

    Attributes:
        anchor, span: (2,) origin and scale of each peak force.
        direction, offset: (2,) coefficients of the bounds.
        cost: (3,) weights of a, phi_1 and phi_2.
    """

    anchor: Array
    span: Array
    direction: Array
    offset: Array
    cost: Array

    @property
    def limits(self) -> MinimisedForces:
        """For each robot, True if its peak force bounds the minimised level a (see the class);
        False if it only has a small weight, which decides between solutions with equal levels.
        """
        first, second = (self.offset < UNBOUNDED_OFFSET).tolist()
        return first, second

    def least_level(self, phi: Array) -> float:
        """Return the least value of the level a that satisfies phi_j <= direction_j a + offset_j
        for given scaled peak forces phi_j.

        Args:
            phi: (2,) scaled peak force of each robot.
        """
        ahead = self.direction > 0.0
        return float(np.max((phi - self.offset)[ahead] / self.direction[ahead]))

    def level(self, peak: Array) -> float:
        """Return the scalarised objective of given peak forces: `cost` times (a, phi_1, phi_2).

        Here phi_1 and phi_2 are the scaled peak forces, and a is the least level that they allow.

        Args:
            peak: (2,) peak force of each robot over its reference force.
        """
        phi = (peak - self.anchor) / self.span
        return float(self.cost @ np.concatenate([[self.least_level(phi)], phi]))


def pascoletti_serafini(anchor: Array, span: Array) -> Scalarisation:
    """Return the scalarisation max_j (f_j - anchor_j) / span_j of both peak forces f_j.

    Its minimum lies on the front, in the direction -span from the anchor. Small weights on both
    peak forces break ties.

    Args:
        anchor: (2,) peak forces over the reference forces.
        span: (2,) scale of each peak force.
    """
    return Scalarisation(
        anchor, span, np.ones(2), np.zeros(2), np.array([1.0, TIE_WEIGHT, TIE_WEIGHT])
    )


def extreme_scalarisation(anchor: Array, span: Array, objective: int) -> Scalarisation:
    """Return the scalarisation that minimises one peak force; the other one only decides between
    equal results.

    Args:
        anchor: (2,) origin of the scaled peak forces.
        span: (2,) scale of each peak force.
        objective: index of the minimised peak force.
    """
    free = np.where(np.arange(2) == objective, 0.0, UNBOUNDED_OFFSET)
    return Scalarisation(
        anchor, span, np.eye(2)[objective], free, np.array([1.0, TIE_WEIGHT, TIE_WEIGHT])
    )


def balanced_scalarisation(anchor: Array, span: Array) -> Scalarisation:
    """Return the scalarisation sum_j phi_j + `LARGER_WEIGHT` max_j phi_j of both scaled peak forces
    phi_j.

    With it both robots press about equally where one can relieve the other at little cost. This
    leaves most room for payload.

    Args:
        anchor: (2,) peak forces over the reference forces; their mean is the common origin.
        span: (2,) scale of each peak force.
    """
    middle = np.full(2, anchor.mean())
    return Scalarisation(middle, span, np.ones(2), np.zeros(2), np.array([LARGER_WEIGHT, 1.0, 1.0]))


def scalarisation_for(anchor: Array, span: Array, objective: int | None) -> Scalarisation:
    """Return the scalarisation that aims at an end of the front or at its balanced middle.

    A peak force f, given over the reference force, is scaled to (f - anchor) / span; for the
    balanced middle both robots have the mean of `anchor` as origin.

    Args:
        anchor: (2,) origin of the scale of each peak force.
        span: (2,) unit of the scale of each peak force.
        objective: 0 or 1 for the end with the least peak force of this robot; None for the balanced
            middle.
    """
    return (
        balanced_scalarisation(anchor, span)
        if objective is None
        else extreme_scalarisation(anchor, span, objective)
    )


class ForceProgram:
    """Nonlinear program that minimises a scalarisation of both peak forces near one candidate, with
    chosen rows (scalar inequalities).

    Its variables z are the decision variables scaled to [-1, 1], both scaled peak forces, and the
    level that bounds them.

    Attributes:
        layout: order of the rows.
        cost: (n_variables,) gradient of the objective.
        start, low, high: (n_variables,) start and bounds of z.
    """

    def __init__(
        self,
        cell: SmoothCell,
        required: Mapping[Row, float],
        target: Scalarisation,
        carry: PlacedCarry,
        x: Array,
        radius: float,
    ) -> None:
        """Form the nonlinear program of a step from a candidate.

        Args:
            cell: data that all nonlinear programs of the cell share.
            required: value that each row (scalar inequality) has to exceed; for force rows it is
                not used.
            target: the scalarisation that is minimised.
            carry: the candidate, evaluated at points of the path.
            x: (n_var,) decision vector of the candidate.
            radius: half the width of the trust region [half ranges of the variables].
        """
        self._cell, self._target, self._n = cell, target, cell.task.n_var
        self.layout = layout = RowLayout(required, sides=2)
        n, n_z = self._n, self._n + 3
        robot, branch, sample = (
            np.array([getattr(row, name) for row in layout.force_rows], dtype=np.intp)
            for name in ("robot", "branch", "sample")
        )
        span, reference = target.span[robot], cell.task.reference_force[robot]
        own = np.eye(2)[:, None]
        coefficients = np.concatenate([cell.coefficients, own], axis=1)
        mix = -coefficients[robot, branch] / (reference * span)[:, None]
        fixed = np.zeros((layout.n_rows, 3))
        fixed[np.arange(layout.forces.stop), robot] = 1.0
        fixed[layout.sides, :2], fixed[layout.sides, 2] = -np.eye(2), target.direction
        self._rows = ConstraintRows(cell, layout, carry.q, mix, fixed)
        # What the rows lack at the candidate: what the rounded time law takes off, what the
        # program's barriers add, or what makes planned forces robust ones, with their slopes.
        self._rows.values(x, np.zeros(3))
        found = self._rows.forces
        if cell.robust is None:
            held = (branch == PROGRAM_BRANCH)[:, None]
            exact = np.where(held, carry.force[sample], carry.split[sample])
            lacking = np.einsum("rk,rk->r", mix, exact - found)
        else:
            force, by_x = cell.robust.first(x)
            unit = -reference * span
            lacking = force[sample, robot] / unit - np.einsum("rk,rk->r", mix, found)
            slope = by_x[sample, robot] / unit[:, None]
            self._rows.correct_forces(
                slope - np.einsum("rk,rkx->rx", mix, self._rows.force_slopes), x
            )
        pressed, at = (
            np.array([getattr(row, name) for row in layout.pressure_rows], dtype=np.intp)
            for name in ("robot", "sample")
        )
        offset = self._rows.offset
        offset[layout.forces] = lacking + target.anchor[robot] / span
        offset[layout.sides] = target.offset
        offset[layout.patches] = 1.0 - carry.shift[at, pressed] ** 2 - self._rows.left
        offset[layout.patches] -= [required[row] for row in layout.pressure_rows]
        offset[layout.points] = [-required[row] / row.constraint.scale for row in layout.point_rows]

        phi = (carry.peak - target.anchor) / target.span + EPIGRAPH_SLACK
        xi, low, high = (cell.scaled(v) for v in (x, cell.task.lower, cell.task.upper))
        self.cost = np.concatenate([np.zeros(n), target.cost[1:], target.cost[:1]])
        self.start = np.concatenate([xi, phi, [target.least_level(phi) + EPIGRAPH_SLACK]])
        self._own_bounds = np.full((2, n_z), LEVEL_BOUND) * np.array([[-1.0], [1.0]])
        self._own_bounds[:, :n] = low, high
        self.low, self.high = self._own_bounds.copy()
        self.low[:n] = np.maximum(low, xi - radius)
        self.high[:n] = np.minimum(high, xi + radius)
        self._known, self._values = b"", offset
        self._jacobian: Array | None = None

    def values(self, z: Array) -> Array:
        """Return the values (n_rows,) of all rows (scalar inequalities). The last result is cached.

        Args:
            z: (n_variables,) variables of the program.
        """
        key = z.tobytes()
        if key != self._known:
            self._values = self._rows.values(self._cell.unscaled(z[: self._n]), z[self._n :])
            self._known, self._jacobian = key, None
        return self._values

    def rows(self, z: Array) -> tuple[Array, Array]:
        """Return values (n_rows,) and derivatives (n_rows, n_variables) of all rows (scalar
        inequalities).

        Args:
            z: (n_variables,) variables of the program.
        """
        values = self.values(z)
        if self._jacobian is None:
            self._jacobian = self._rows.slopes()
            self._jacobian[:, : self._n] *= self._cell.half
        return values, self._jacobian

    def curvature(self, z: Array, weights: Array) -> Array:
        """Return the Hessian (n_variables, n_variables) of the weighted sum of all rows.

        Args:
            z: (n_variables,) variables of the program.
            weights: (n_rows,) weights of the rows.
        """
        self.rows(z)
        n, half = self._n, self._cell.half
        full = np.zeros((n + 3, n + 3))
        full[:n, :n] = self._rows.curvature(weights) * np.outer(half, half)
        return full

    def residuals_at(self, x: Array, carry: PlacedCarry) -> Residuals:
        """Compute the optimality residuals of a candidate with least-squares multipliers.

        Only the variables' own bounds count as constraints. With the bounds of the trust region,
        every candidate at their edge would look optimal.

        Args:
            x: (n_var,) decision vector of the candidate.
            carry: the candidate, evaluated at points of the path.
        """
        target = self._target
        phi = (carry.peak - target.anchor) / target.span
        z = np.concatenate([self._cell.scaled(x), phi, [target.least_level(phi)]])
        low, high = self._own_bounds
        return optimality_residuals(self, z, (low, high))

    def candidate(self, z: Array) -> Array:
        """Extract the decision vector (n_var,) from the program's variables z (n_variables,), and
        clip it to its bounds and to the trust region.
        """
        n = self._n
        return self._cell.unscaled(np.clip(z[:n], self.low[:n], self.high[:n]))


@dataclass(frozen=True, kw_only=True)
class ForceStep(Step):
    """A step to a decision vector.

    Attributes:
        x: (n_var,) decision vector after the step.
    """

    x: Array


class ForceStepMethod(StepMethod[Iterate, ForceStep]):
    """Step method that minimises one scalarisation of both peak forces."""

    least_radius, backtracking = LEAST_FORCE_RADIUS, FORCE_BACKTRACKING

    def __init__(
        self,
        solver: ForceSolver,
        target: Scalarisation,
        iterations: int,
        barrier: float,
    ) -> None:
        super().__init__(solver.cell, solver.active, solver.reader)
        self._solve, self._target, self.limits = solver.method, target, target.limits
        self._iterations, self._barrier = iterations, barrier

    def evaluate(self, x: Array) -> Iterate:
        """Evaluate a decision vector. Its level is the scalarisation of its peak forces.

        Args:
            x: (n_var,) decision vector.
        """
        carry = self.reader.read(x)
        return Iterate(x, carry, self._target.level(carry.peak))

    def propose_step(
        self, best: Iterate, required: Mapping[Row, float], radius: float
    ) -> ForceStep | None:
        """Solve the nonlinear program about the best iterate.

        Args:
            best: the best iterate so far.
            required: value that each row (scalar inequality) of the program has to exceed.
            radius: half the width of the trust region [half ranges of the variables].

        Returns:
            The step to the solution; None if the solver returns no finite one.
        """
        program = ForceProgram(self.cell, required, self._target, best.carry, best.x, radius)
        answer = self._solve(program, self._iterations, self._barrier)
        if not answer.usable:
            return None
        x = program.candidate(answer.z)
        return ForceStep(
            length=self.cell.step(best.x, x),
            required=required,
            residuals=lambda at: program.residuals_at(at.x, at.carry),
            iterations=answer.iterations,
            converged=answer.converged,
            x=x,
        )

    def evaluate_step(self, best: Iterate, step: ForceStep) -> StepEvaluation[Iterate]:
        """Evaluate the candidate after a step, and compare its level, the minimised value, with
        that of the best iterate.

        Args:
            best: the best iterate so far.
            step: the step.
        """
        trial = self.evaluate(step.x)
        return StepEvaluation(trial, trial.level < best.level)

    def evaluate_fraction(
        self, begin: Iterate, best: Iterate, step: ForceStep, share: float
    ) -> Iterate | None:
        """Evaluate the candidate after a fraction of a step.

        Args:
            begin: iterate from which the step starts.
            best: the best iterate so far.
            step: the step.
            share: the fraction of the step.

        Returns:
            The candidate; None if its level is not below that of the best iterate.
        """
        trial = self.evaluate(begin.x + share * (step.x - begin.x))
        return trial if trial.level < best.level else None

    def missing_rows(self, trial: Iterate) -> set[Row]:
        """Return force rows (scalar inequalities) at and beside the local maxima of a candidate's
        minimised normal forces.

        Args:
            trial: the candidate.
        """
        return set(self.active.forces.peak_rows(trial.carry, self.limits))


class ForceSolver:
    """Minimises scalarisations of both peak forces for one cell. Each process needs its own object.

    Attributes:
        cell: shared data of the polish.
        active: selects the rows of programs.
        reader: evaluates candidates at points of the path.
        method: solver of the nonlinear programs.
    """

    def __init__(self, cell: SmoothCell, settings: PolishSettings) -> None:
        self.cell, self._settings = cell, settings
        self.active, self.reader = RowSelector(cell), CarryReader(cell)
        self.method: Solve = ipopt if settings.solver == "ipopt" else dense

    def solve(
        self, x: Array, target: Scalarisation, radius: float, mode: SolveMode = "usual"
    ) -> Solution:
        """Improve a feasible decision vector by a trust-region solve of one scalarisation.

        Args:
            x: (n_var,) feasible decision vector.
            target: the scalarisation that is minimised.
            radius: radius of the first trust region [half ranges of the decision variables].
            mode: effort of the solve, see `SolveMode`.
        """
        rounds, iterations, barrier = self._settings.rounds, self._settings.max_iterations, BARRIER
        if mode == "near":
            rounds, iterations, barrier = NEAR_ROUNDS, NEAR_ITERATIONS, NEAR_BARRIER
        elif mode == "brief":
            rounds = self._settings.probe.rounds
        elif mode == "wide":
            barrier = WIDE_BARRIER
        step_method = ForceStepMethod(self, target, iterations, barrier)
        return TrustRegionSolve(step_method, x, radius).run(rounds)
