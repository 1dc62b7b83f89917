"""IPOPT on one assembled program, and the residuals of what it returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from hybrid_opt.polishing.records import UNKNOWN, PolishSettings, Residuals
from symbolic.array import Array
from symbolic.smooth.problem import SmoothProblem

IPOPT: dict[str, Any] = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": False,
    # A metaheuristic's point is near the solution but has no multipliers: a small barrier, little
    # push off the bounds (docs/polish.md has the comparison).
    "ipopt.mu_init": 1e-3,
    "ipopt.bound_push": 1e-4,
    "ipopt.bound_frac": 1e-4,
    "ipopt.slack_bound_push": 1e-4,
    "ipopt.mu_linear_decrease_factor": 0.5,
    "ipopt.mu_superlinear_decrease_power": 1.2,
    "ipopt.tol": 1e-6,
    "ipopt.honor_original_bounds": "yes",
    "no_nlp_grad": True,
    "calc_lam_p": False,
    "calc_lam_x": False,
    "calc_f": False,
    "calc_g": False,
    "error_on_fail": False,
}


FEASIBLE = 1e-3
"""Violation, in the program's scaled constraints, at which an iterate counts as feasible."""

PATIENCE = 3
"""Times the wanted number of iterations that IPOPT may take to become feasible."""


class _Stop(ca.Callback):  # type: ignore[misc]  # CasADi has no types
    """Ends a solve after the wanted number of iterations, as soon as an iterate is feasible.

    A solve that is cut off wherever it stands ends in an obstacle more often than not.
    """

    def __init__(self, problem: SmoothProblem, iterations: int) -> None:
        ca.Callback.__init__(self)
        self._problem, self._iterations, self._count = problem, iterations, 0
        self._below = self._above = np.empty(0)
        self.construct("stop", {})

    def begin(self, below: Array, above: Array) -> None:
        """Before every solve: bounds of the constraints."""
        self._below, self._above, self._count = below, above, 0

    def get_n_in(self) -> int:
        """CasADi's question."""
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        """CasADi's question."""
        return 1

    def get_sparsity_in(self, index: int) -> ca.Sparsity:
        """CasADi's question."""
        name, nlp = ca.nlpsol_out(index), self._problem.nlp
        shapes = {"f": (1, 1), "x": nlp.size_in(0), "lam_x": nlp.size_in(0)}
        shapes |= {"g": nlp.size_out(1), "lam_g": nlp.size_out(1), "lam_p": (0, 0)}
        return ca.Sparsity.dense(*shapes[name])

    def eval(self, arguments: list[ca.DM]) -> list[ca.DM]:
        """1 to stop, 0 to go on."""
        self._count += 1
        if self._count <= self._iterations:
            return [ca.DM(0)]
        g = arguments[2].full().ravel()
        violation = max(np.max(self._below - g), np.max(g - self._above))
        return [ca.DM(float(violation <= FEASIBLE))]


@dataclass(frozen=True)
class Program:
    """The numbers of a program: start z, parameters p, bounds of z and of the constraints."""

    start: Array
    parameters: Array
    low: Array
    high: Array
    below: Array
    above: Array


@dataclass(frozen=True)
class Answer:
    """What IPOPT returned.

    Attributes:
        x: (n_var,) decision vector within its bounds.
        message: IPOPT's status.
        converged: whether it claims an optimum.
        usable: whether x is finite.
        residuals: recomputed here.
        iterations: IPOPT's.
    """

    x: Array
    message: str
    converged: bool
    usable: bool
    residuals: Residuals
    iterations: int


@dataclass(frozen=True)
class Ipopt:
    """IPOPT for one program, and what ends it."""

    solver: ca.Function
    stop: _Stop


def ipopt(problem: SmoothProblem, settings: PolishSettings) -> Ipopt:
    """IPOPT for a program."""
    stop = _Stop(problem, settings.max_iterations)
    options = IPOPT | {
        "grad_f": problem.grad_f,
        "jac_g": problem.jac_g,
        "hess_lag": problem.hess_lag,
        "ipopt.max_iter": PATIENCE * settings.max_iterations,
        "iteration_callback": stop,
        "ipopt.max_wall_time": settings.max_seconds,
    }
    return Ipopt(ca.nlpsol("polish", "ipopt", problem.nlp, options), stop)


def run(problem: SmoothProblem, solver: Ipopt, program: Program) -> Answer:
    """Solve a program."""
    n = len(problem.scale)
    solver.stop.begin(program.below, program.above)
    try:
        found = solver.solver(
            x0=program.start,
            p=program.parameters,
            lbx=program.low,
            ubx=program.high,
            lbg=program.below,
            ubg=program.above,
        )
    except RuntimeError as error:
        # CasADi's way to report that a function failed outright.
        message = str(error).strip().splitlines()[-1]
        return Answer(np.full(n, np.nan), message, False, False, UNKNOWN, 0)
    statistics = solver.solver.stats()
    z = np.asarray(found["x"].full()).ravel()
    usable = bool(np.isfinite(z).all())
    x = problem.centre + problem.scale * np.clip(z[:n], program.low[:n], program.high[:n])
    multipliers = (found["lam_x"].full().ravel(), found["lam_g"].full().ravel())
    return Answer(
        x=x,
        message=str(statistics["return_status"]),
        converged=statistics["return_status"] == "Solve_Succeeded",
        usable=usable,
        residuals=residuals(problem, program, z, *multipliers) if usable else UNKNOWN,
        iterations=int(statistics["iter_count"]),
    )


def residuals(
    problem: SmoothProblem, program: Program, z: Array, lam_x: Array, lam_g: Array
) -> Residuals:
    """Residuals of the optimality conditions at z with the given multipliers.

    In CasADi's convention: positive multipliers belong to upper bounds, negative to lower ones.
    """
    gradient = problem.grad_f(z, program.parameters)[1].full().ravel()
    g, jacobian = problem.jac_g(z, program.parameters)
    values = g.full().ravel()
    lagrangian = gradient + ca.mtimes(jacobian.T, lam_g).full().ravel() + lam_x
    sides = (
        (z, program.low, program.high, lam_x),
        (values, program.below, program.above, lam_g),
    )
    violation, product = 0.0, 0.0
    for value, low, high, multiplier in sides:
        violation = max(
            violation, np.max(low - value, initial=0.0), np.max(value - high, initial=0.0)
        )
        slack = np.where(multiplier > 0.0, high - value, value - low)
        # A multiplier of an absent bound has nothing to be complementary to: it must vanish.
        scaled = np.where(np.isfinite(slack), np.abs(slack), 1.0)
        product = max(product, np.max(np.abs(multiplier) * scaled, initial=0.0))
    return Residuals(float(np.max(np.abs(lagrangian))), float(violation), float(product))
