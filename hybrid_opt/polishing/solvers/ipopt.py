"""IPOPT on one program, through CasADi's callbacks."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from hybrid_opt.polishing.solvers.base import (
    FEASIBILITY_PATIENCE,
    FEASIBLE_ROW,
    MOST_SOLVE_SECONDS,
    OPTIMALITY_TOLERANCE,
    Answer,
    NonlinearProgram,
)
from symbolic.array import Array

OPTIONS: dict[str, Any] = {
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "print_time": False,
    # A metaheuristic's point is near the solution but has no multipliers: a small barrier, little
    # push off the bounds.
    "ipopt.bound_push": 1e-4,
    "ipopt.bound_frac": 1e-4,
    "ipopt.slack_bound_push": 1e-4,
    "ipopt.mu_linear_decrease_factor": 0.5,
    "ipopt.mu_superlinear_decrease_power": 1.2,
    "ipopt.honor_original_bounds": "yes",
    "no_nlp_grad": True,
    "calc_lam_p": False,
    "calc_lam_x": False,
    "calc_f": False,
    "calc_g": False,
    "error_on_fail": False,
    "ipopt.tol": OPTIMALITY_TOLERANCE,
    "ipopt.max_wall_time": MOST_SOLVE_SECONDS,
}

Shapes = Mapping[str, ca.Sparsity]


class _Callback(ca.Callback):  # type: ignore[misc]  # CasADi has no types
    """A Python function of vectors (n,) as a function of CasADi. CasADi calls the `get_` methods to
    learn its inputs and outputs.
    """

    def __init__(
        self, name: str, inputs: Shapes, outputs: Shapes, evaluate: Callable[..., list[Any]]
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs = list(inputs.items()), list(outputs.items())
        self._evaluate = evaluate
        self.construct(name, {})

    def get_n_in(self) -> int:
        """Return the number of inputs."""
        return len(self._inputs)

    def get_n_out(self) -> int:
        """Return the number of outputs."""
        return len(self._outputs)

    def get_name_in(self, index: int) -> str:
        """Return the name of the input with an index."""
        return self._inputs[index][0]

    def get_name_out(self, index: int) -> str:
        """Return the name of the output with an index."""
        return self._outputs[index][0]

    def get_sparsity_in(self, index: int) -> ca.Sparsity:
        """Return the sparsity of the input with an index."""
        return self._inputs[index][1]

    def get_sparsity_out(self, index: int) -> ca.Sparsity:
        """Return the sparsity of the output with an index."""
        return self._outputs[index][1]

    def eval(self, arguments: Sequence[ca.DM]) -> list[Any]:
        """Return the values of all outputs.

        Args:
            arguments: values of all inputs.
        """
        return self._evaluate(*[argument.full().ravel() for argument in arguments])


def _functions(program: NonlinearProgram, wanted: int) -> tuple[_Callback, dict[str, _Callback]]:
    """Convert a nonlinear program to the functions that CasADi's `nlpsol` takes.

    The stopping rule ends the solve at the first feasible iterate after the wanted number of
    iterations. An arbitrary iterate usually lies in an obstacle.

    Args:
        program: the nonlinear program.
        wanted: number of iterations after which the solve may stop.

    Returns:
        - One function of the variables, whose outputs are the objective and the rows.
        - Functions for the derivatives and the stopping rule, by the names of nlpsol's options.
    """
    n, m, iterations = len(program.start), len(program.values(program.start)), 0
    x, p, g = ca.Sparsity.dense(n), ca.Sparsity(0, 0), ca.Sparsity.dense(m)
    one, upper = ca.Sparsity.dense(1), ca.Sparsity.upper(n)
    given, multiplied = {"x": x, "p": p}, {"lam_f": one, "lam_g": g}

    def values(z: Array, _: Array) -> list[Any]:
        return [program.cost @ z, program.values(z)]

    def gradient(z: Array, _: Array) -> list[Any]:
        return [program.cost @ z, program.cost]

    def jacobian(z: Array, _: Array) -> list[Any]:
        return list(program.rows(z))

    def hessian(z: Array, _: Array, __: Array, lam_g: Array) -> list[Any]:
        return [ca.triu(ca.DM(program.curvature(z, lam_g)))]

    def stop(_: Array, __: Array, g: Array, *___: Array) -> list[Any]:
        nonlocal iterations
        iterations += 1
        return [float(iterations > wanted and g.min() >= -FEASIBLE_ROW)]

    slopes = {"g": g, "jac_g_x": ca.Sparsity.dense(m, n)}
    bent = {"triu_hess_gamma_x_x": upper}
    reached = {"x": x, "f": one, "g": g, "lam_x": x, "lam_g": g, "lam_p": p}
    return _Callback("nlp", given, {"f": one, "g": g}, values), {
        "grad_f": _Callback("nlp_grad_f", given, {"f": one, "grad_f_x": x}, gradient),
        "jac_g": _Callback("nlp_jac_g", given, slopes, jacobian),
        "hess_lag": _Callback("nlp_hess_l", given | multiplied, bent, hessian),
        "iteration_callback": _Callback("stop", reached, {"ret": one}, stop),
    }


def ipopt(program: NonlinearProgram, iterations: int, barrier: float) -> Answer:
    """Solve a nonlinear program with IPOPT.

    Args:
        program: the nonlinear program.
        iterations: number of iterations after which the solve stops at the next feasible iterate.
        barrier: first weight of the logarithmic barrier.
    """
    nlp, functions = _functions(program, iterations)
    limits = {"ipopt.mu_init": barrier, "ipopt.max_iter": FEASIBILITY_PATIENCE * iterations}
    solver = ca.nlpsol("polish", "ipopt", nlp, OPTIONS | functions | limits)
    try:
        found = solver(
            x0=program.start,
            lbx=program.low,
            ubx=program.high,
            lbg=0.0,
        )
    except RuntimeError as error:
        # CasADi's way to report that a function failed outright.
        message = str(error).strip().splitlines()[-1]
        nowhere = np.full(len(program.start), np.nan)
        return Answer(nowhere, message, False, False, 0)
    statistics, z = solver.stats(), found["x"].full().ravel()
    return Answer(
        z=z,
        message=str(statistics["return_status"]),
        converged=statistics["return_status"] == "Solve_Succeeded",
        usable=bool(np.isfinite(z).all()),
        iterations=int(statistics["iter_count"]),
    )


def use_one_thread() -> None:
    """Limit IPOPT's linear algebra to one thread, so that it does not wait on cores that other
    workers use; its matrices are too small for threads. Its library is loaded with the first solve,
    too late for `codegen.native.one_thread`."""
    for library in Path(ca.__file__).parent.glob("*openblas*.so*"):
        with suppress(OSError, AttributeError):
            ctypes.CDLL(str(library)).openblas_set_num_threads(1)
