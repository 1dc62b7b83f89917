"""IPOPT on one program, through CasADi's callbacks on buffers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np

from hybrid_opt.polishing.residuals import UNKNOWN, residuals
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.solvers import Answer, Program
from symbolic.array import Array

Buffers = tuple[memoryview, ...]

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
}


class _Called(ca.Callback):  # type: ignore[misc]  # CasADi has no types
    """A Python function of dense vectors and matrices as CasADi calls it, without copies."""

    def __init__(
        self,
        name: str,
        inputs: Mapping[str, ca.Sparsity],
        outputs: Mapping[str, ca.Sparsity],
        evaluate: Callable[[Buffers, Buffers], None],
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs = list(inputs.items()), list(outputs.items())
        self._evaluate = evaluate
        self.construct(name, {})

    def get_n_in(self) -> int:
        """CasADi's question."""
        return len(self._inputs)

    def get_n_out(self) -> int:
        """CasADi's question."""
        return len(self._outputs)

    def get_name_in(self, index: int) -> str:
        """CasADi's question."""
        return self._inputs[index][0]

    def get_name_out(self, index: int) -> str:
        """CasADi's question."""
        return self._outputs[index][0]

    def get_sparsity_in(self, index: int) -> ca.Sparsity:
        """CasADi's question."""
        return self._inputs[index][1]

    def get_sparsity_out(self, index: int) -> ca.Sparsity:
        """CasADi's question."""
        return self._outputs[index][1]

    def has_eval_buffer(self) -> bool:
        """CasADi's question."""
        return True

    def eval_buffer(self, arguments: Buffers, results: Buffers) -> int:
        """Fill the results; 0 for success."""
        self._evaluate(arguments, results)
        return 0


class _Functions:
    """A program's functions as nlpsol wants them, and what ends a solve.

    A solve that is cut off wherever it stands ends in an obstacle more often than not: it ends
    after the wanted number of iterations, as soon as an iterate is feasible.
    """

    def __init__(self, program: Program, settings: PolishSettings) -> None:
        self._program, self._settings = program, settings
        self._iterations = 0
        n, m = len(program.start), len(program.below)
        x, p, g = ca.Sparsity.dense(n), ca.Sparsity(0, 0), ca.Sparsity.dense(m)
        one, jacobian = ca.Sparsity.dense(1), ca.Sparsity.dense(m, n)
        upper = ca.Sparsity.upper(n)
        self._rows, self._columns = (np.array(index) for index in upper.get_triplet())
        given = {"x": x, "p": p}
        self.nlp = _Called("nlp", given, {"f": one, "g": g}, self._values)
        self.options = {
            "grad_f": _Called("nlp_grad_f", given, {"f": one, "grad_f_x": x}, self._gradient),
            "jac_g": _Called("nlp_jac_g", given, {"g": g, "jac_g_x": jacobian}, self._jacobian),
            "hess_lag": _Called(
                "nlp_hess_l",
                given | {"lam_f": one, "lam_g": g},
                {"triu_hess_gamma_x_x": upper},
                self._hessian,
            ),
            "iteration_callback": _Called(
                "stop",
                {
                    "x": x,
                    "f": one,
                    "g": g,
                    "lam_x": x,
                    "lam_g": g,
                    "lam_p": p,
                },
                {"ret": one},
                self._stop,
            ),
        }

    def _values(self, given: Buffers, results: Buffers) -> None:
        z = _read(given[0])
        _write(results, 0, [float(self._program.cost @ z)])
        if results[1] is not None and len(results[1]):
            _write(results, 1, self._program.constraints(z)[0])

    def _gradient(self, given: Buffers, results: Buffers) -> None:
        _write(results, 0, [float(self._program.cost @ _read(given[0]))])
        _write(results, 1, self._program.cost)

    def _jacobian(self, given: Buffers, results: Buffers) -> None:
        values, jacobian = self._program.constraints(_read(given[0]))
        _write(results, 0, values)
        _write(results, 1, jacobian.ravel(order="F"))

    def _hessian(self, given: Buffers, results: Buffers) -> None:
        curvature = self._program.curvature(_read(given[0]), _read(given[3]))
        _write(results, 0, curvature[self._rows, self._columns])

    def _stop(self, given: Buffers, results: Buffers) -> None:
        self._iterations += 1
        stop = False
        if self._iterations > self._settings.max_iterations:
            g = _read(given[2])
            program = self._program
            violation = max(np.max(program.below - g), np.max(g - program.above))
            stop = bool(violation <= self._settings.solve.feasible)
        _write(results, 0, [float(stop)])


def _read(buffer: memoryview) -> Array:
    return np.array(np.frombuffer(buffer, dtype=np.float64))


def _write(results: Buffers, index: int, values: Any) -> None:
    if results[index] is not None and len(results[index]):
        np.frombuffer(results[index], dtype=np.float64)[:] = values


def ipopt(program: Program, settings: PolishSettings) -> Answer:
    """Solve a program with IPOPT."""
    functions = _Functions(program, settings)
    options = OPTIONS | functions.options
    options |= {
        "ipopt.mu_init": settings.solve.barrier,
        "ipopt.tol": settings.solve.tolerance,
        "ipopt.max_iter": settings.solve.patience * settings.max_iterations,
        "ipopt.max_wall_time": settings.max_seconds,
    }
    solver = ca.nlpsol("polish", "ipopt", functions.nlp, options)
    try:
        found = solver(
            x0=program.start,
            lbx=program.low,
            ubx=program.high,
            lbg=program.below,
            ubg=program.above,
        )
    except RuntimeError as error:
        # CasADi's way to report that a function failed outright.
        message = str(error).strip().splitlines()[-1]
        nowhere = np.full(len(program.start), np.nan)
        none = np.zeros(len(program.start)), np.zeros(len(program.below))
        return Answer(nowhere, message, False, False, 0, lambda: (none, UNKNOWN))
    statistics = solver.stats()
    z, lam_z, lam_g = (found[name].full().ravel() for name in ("x", "lam_x", "lam_g"))
    usable = bool(np.isfinite(z).all())
    return Answer(
        z=z,
        message=str(statistics["return_status"]),
        converged=statistics["return_status"] == "Solve_Succeeded",
        usable=usable,
        iterations=int(statistics["iter_count"]),
        conditions=lambda: (
            (lam_z, lam_g),
            residuals(program, z, lam_z, lam_g) if usable else UNKNOWN,
        ),
    )
