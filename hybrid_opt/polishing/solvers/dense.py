"""A dense interior-point method for programs of few variables and many inequalities.

The polish's programs have about twenty variables and two hundred rows, nearly all of them
inequalities. Condensed to the variables, Newton's system is a matrix of twenty by twenty, where a
sparse solver factorises one of four hundred. The barrier falls as its problems are solved, as with
Waechter and Biegler (2006), but rows that hold go on to hold in every iterate, in place of their
filter: a step is shortened until they do, and its slacks are what the rows keep (Byrd, Nocedal and
Waltz 2003 call it the feasible mode). A solve may then be cut off anywhere, and large steps do not
wander through obstacles. Rows that do not hold yet have slacks of their own and a price.

With h(z) >= 0 all inequalities, h(z) - s = 0 and the multipliers y, each step solves

    (W + A^T D A + E) dz = -c + A^T (mu / s - D r) + mu / (z - low) - mu / (high - z),

A = dh/dz, D = y / s, r = h - s, W the curvature of the Lagrangian, E that of the bounds' barrier.
What does not call the program is in `dense.c`, which works on the iterate's own arrays.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from codegen.cache import Cache
from hybrid_opt.polishing.native import Native, Records, native
from hybrid_opt.polishing.solvers.base import (
    FEASIBLE,
    PATIENCE,
    TOLERANCE,
    Answer,
    Program,
    Solve,
)

PUSH = 1e-4
"""Least distance of the start from bounds, as a share of their width."""

HAIR = 1e-8
"""Share of their width by which bounds are widened for the solver; its answer is clipped."""

SLACK = 1e-2
"""Least slack at the start: rows nearer than that to their limit may come nearer for a while."""

RENEWALS = 3
"""Times that the least slacks may be renewed where no step was found."""

LINEAR, POWER = 0.2, 1.5
"""The barrier falls to the smaller one of this share of it and this power."""

SOLVED = 10.0
"""A barrier's problem counts as solved at this many times the barrier."""

TRIALS = 8
"""Trials of a line search before it gives up."""

VECTOR = 8
"""As in `common.c`."""


def dense_method(cache: Cache | None = None) -> Solve:
    """The method.

    Args:
        cache: where its library is kept; by default the user's.

    Raises:
        CodegenError: it cannot be compiled, cached or loaded.
    """
    library = native("solvers/dense.c", cache)
    return lambda program, iterations, barrier: _Solver(library, program, barrier).solve(iterations)


class _Solver:
    """One solve of one program.

    The iterate has n variables z and m inequalities with values h and slopes A. Its slacks and
    multipliers (m + 2 n,) are of the inequalities, then of the lower and of the upper bounds.
    """

    def __init__(self, library: Native, program: Program, barrier: float) -> None:
        self._c, self._program, self._mu = library.functions, program, barrier
        self._renewals = 0
        # Bounds are a hair wider than they are, so that no rounding puts an iterate on one.
        hair = HAIR * (program.high - program.low)
        low, high = program.low - hair, program.high + hair
        push = PUSH * (high - low)
        self.z = np.clip(program.start, low + push, high - push)
        self.h, A = program.rows(self.z)
        m, n = A.shape
        slack = np.concatenate([np.maximum(self.h, SLACK), self.z - low, high - self.z])
        self.slack, self.dual = slack, barrier / slack
        # Rows filled up with zeros, as C has them.
        wide = np.zeros((m, -(-n // VECTOR) * VECTOR))
        wide[:, :n] = A
        self._arrays: dict[str, Any] = {
            "cost": program.cost,
            "low": low,
            "high": high,
            "inner_low": low + 1e-3 * hair,
            "inner_high": high - 1e-3 * hair,
            "values": np.empty(m),
            "W": np.empty((n, n)),
            "z": self.z,
            "slack": self.slack,
            "dual": self.dual,
            "h": self.h,
            "A": wide,
            "trial": np.empty(n),
            "ruling": np.zeros(m),
            "errors": np.empty(4),
            "blocking": np.zeros(m, dtype=np.int8),
            "work": np.empty(self._c.dual_arm_dense_work(n, m)),
        }
        self._records = Records(library)
        self._step = self._records.new("Step", n=n, m=m, mu=self._mu, **self._arrays)

    def solve(self, wanted: int) -> Answer:
        """Iterate until an optimum, or as often as wanted and until an iterate is feasible."""
        iterations, message = 0, "Maximum_Iterations_Exceeded"
        for iterations in range(PATIENCE * wanted + 1):
            self._c.dual_arm_dense_errors(self._step)
            if self._error(0.0) <= TOLERANCE:
                message = "Solve_Succeeded"
                break
            if iterations >= wanted and np.max(-self.h, initial=0.0) <= FEASIBLE:
                message = "Stopped_Feasible"
                break
            least = TOLERANCE / SOLVED
            while self._mu > least and self._error(self._mu) <= SOLVED * self._mu:
                self._mu = max(least, min(LINEAR * self._mu, self._mu**POWER))
            if not self._advance() and not self._renew():
                message = "Step_Too_Short"
                break
        z = np.clip(self.z, self._program.low, self._program.high)
        usable = bool(np.isfinite(z).all())
        return Answer(
            z=z,
            message=message if usable else "Not_Finite",
            converged=usable and message == "Solve_Succeeded",
            usable=usable,
            iterations=iterations,
        )

    def _error(self, mu: float) -> float:
        """The largest residual of a barrier's conditions, multipliers scaled as in the paper."""
        rest, least, most, scale = self._arrays["errors"].tolist()
        return float(max(rest, max(most - mu, mu - least) / scale))

    def _advance(self) -> bool:
        """One step; whether one was found, or will be with other multipliers."""
        c, step, program, arrays = self._c, self._step, self._program, self._arrays
        step.mu = self._mu
        c.dual_arm_dense_ruling(step)
        arrays["W"][...] = program.curvature(self.z, arrays["ruling"])
        if not c.dual_arm_dense_direction(step):
            return False
        for _ in range(TRIALS):
            arrays["values"][...] = program.values(arrays["trial"])
            if c.dual_arm_dense_judge(step) == c.TAKEN:
                slopes = program.rows(arrays["trial"])[1]
                arrays["A"][:, : slopes.shape[1]] = slopes
                c.dual_arm_dense_move(step)
                return True
        return bool(c.dual_arm_dense_heed(step))

    def _renew(self) -> bool:
        """Slacks as large as at the start; whether that changes anything."""
        m = len(self.h)
        s, old = np.maximum(self.h, min(SLACK, 10.0 * self._mu)), self.slack[:m].copy()
        self.dual[:m] = np.where(s > old, self._mu / s, self.dual[:m])
        self.slack[:m] = s
        self._renewals += 1
        return not np.allclose(s, old, rtol=1e-6) and self._renewals <= RENEWALS
