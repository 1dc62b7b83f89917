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
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybrid_opt.polishing.inequalities import Inequalities
from hybrid_opt.polishing.interior_steps import direction, estimated, kept, largest, until
from hybrid_opt.polishing.residuals import UNKNOWN, residuals
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.solvers import Answer, Conditions, Program
from symbolic.array import Array

PUSH = 1e-4
"""Least distance of the start from bounds, as a share of their width."""

HAIR = 1e-8
"""By this share of their width bounds are wider for the solver; its answer is clipped."""

SLACK = 1e-2
"""Least slack at the start: rows nearer than that to their limit may come nearer for a while."""

RAISED = 10.0
"""Factor to the multiplier of a row that shortened a step."""

LEAST = 1e-9
"""Least slack of all."""

RENEWALS = 3
"""Times that the least slacks may be renewed where no step was found."""

LINEAR, POWER = 0.2, 1.5
"""The barrier falls to the smaller one of this share of it and this power."""

SOLVED = 10.0
"""A barrier's problem counts as solved at this many times the barrier."""

TO_BOUNDARY = 0.99
"""Share of the way to a bound that a step may take."""

ARMIJO = 1e-4
"""Share of the predicted gain that a step has to bring."""

PENALTY = 2.0
"""Price of a violation, over its multiplier."""

TRIALS = 8
"""Trials of a line search before it gives up."""

SHORTENED = (0.1, 0.7)
"""Least and largest share of a refused step that is tried next; parabolas tell which between."""

NEGLIGIBLE = 1e-3
"""Share of the largest multiplier below which a row's curvature is left out of a step."""

DISTANT = 2e-2
"""The same of rows whose slack exceeds their multiplier: they will not rule in the end."""


@dataclass
class State:
    """An iterate, n variables and m inequalities.

    Attributes:
        z: (n,) variables.
        slack: (m + 2 n,) of the inequalities, then what the lower and the upper bounds leave.
        dual: (m + 2 n,) their multipliers.
        h, A: (m,) and (m, n) evaluated inequalities.
    """

    z: Array
    slack: Array
    dual: Array
    h: Array
    A: Array


@dataclass(frozen=True)
class Error:
    """Residuals of the barrier's conditions, multipliers scaled as in the paper.

    Attributes:
        rest: the largest one without complementarity.
        least, most: products of slacks and multipliers.
        scale: of these.
    """

    rest: float
    least: float
    most: float
    scale: float

    def at(self, mu: float) -> float:
        """The largest of all for a barrier."""
        return max(self.rest, max(self.most - mu, mu - self.least) / self.scale)


class DenseSolver:
    """One solve of one program."""

    def __init__(self, program: Program, settings: PolishSettings) -> None:
        self._program, self._settings = program, settings
        self._rows = Inequalities(program)
        self._mu = settings.solve.barrier
        # Bounds are a hair wider than they are, so that no rounding puts an iterate on one.
        hair = HAIR * (program.high - program.low)
        self._low, self._high = program.low - hair, program.high + hair
        self._width = self._high - self._low
        self._inner = self._low + 1e-3 * hair, self._high - 1e-3 * hair
        self._price, self._renewals = 0.0, 0

    def solve(self) -> Answer:
        """Iterate until an optimum, or as long as the settings allow."""
        now = self._start()
        wanted = self._settings.max_iterations
        iterations, message = 0, "Maximum_Iterations_Exceeded"
        for iterations in range(self._settings.solve.patience * wanted + 1):
            error = self._error(now)
            if error.at(0.0) <= self._settings.solve.tolerance:
                message = "Solve_Succeeded"
                break
            violation = np.max(-now.h, initial=0.0)
            if iterations >= wanted and violation <= self._settings.solve.feasible:
                message = "Stopped_Feasible"
                break
            self._lower_barrier(error)
            if not self._advance(now) and not self._renew(now):
                message = "Step_Too_Short"
                break
        z = np.clip(now.z, self._program.low, self._program.high)
        usable = bool(np.isfinite(z).all())
        return Answer(
            z=z,
            message=message if usable else "Not_Finite",
            converged=usable and message == "Solve_Succeeded",
            usable=usable,
            iterations=iterations,
            conditions=lambda: self._conditions(now, z),
        )

    def _conditions(self, now: State, z: Array) -> Conditions:
        """Multipliers that satisfy the conditions best where the solve ended, and residuals."""
        lam_z, y = estimated(
            self._program.cost, now.A, (now.h, now.z - self._low, self._high - now.z)
        )
        multipliers = lam_z, self._rows.multipliers(y)
        usable = bool(np.isfinite(z).all())
        return multipliers, residuals(self._program, z, *multipliers) if usable else UNKNOWN

    def _start(self) -> State:
        push = PUSH * self._width
        z = np.clip(self._program.start, self._low + push, self._high - push)
        h, A = self._rows.values(z), self._rows.slopes(z)
        slack = self._slack(z, np.maximum(h, SLACK))
        return State(z, slack, self._mu / slack, h, A)

    def _slack(self, z: Array, s: Array) -> Array:
        """All slacks, of those of the inequalities."""
        return np.concatenate([s, z - self._low, self._high - z])

    def _error(self, now: State) -> Error:
        m, n = now.A.shape
        scale = max(1.0, float(now.dual.sum()) / len(now.dual) / 100.0)
        slope = self._program.cost - now.dual[:m] @ now.A - now.dual[m : m + n] + now.dual[m + n :]
        products = now.slack * now.dual
        rest = max(
            float(np.abs(slope).max()) / scale,
            float(np.abs(now.h - now.slack[:m]).max(initial=0.0)),
        )
        return Error(rest, float(products.min()), float(products.max()), scale)

    def _lower_barrier(self, error: Error) -> None:
        least = self._settings.solve.tolerance / SOLVED
        while self._mu > least and error.at(self._mu) <= SOLVED * self._mu:
            self._mu = max(least, min(LINEAR * self._mu, self._mu**POWER))

    def _advance(self, now: State) -> bool:
        """One step; whether one was found."""
        mu, (m, n) = self._mu, now.A.shape
        y, s = now.dual[:m], now.slack[:m]
        # Rows that are far from ruling are left out of the curvature: most of its cost, and next to
        # nothing of the step.
        least = np.where(s > y, DISTANT, NEGLIGIBLE) * y.max(initial=0.0)
        ruling = np.where(y > least, y, 0.0)
        D, ideal = now.dual / now.slack, mu / now.slack
        M = self._program.curvature(now.z, self._rows.multipliers(ruling))
        M += (now.A * D[:m, None]).T @ now.A
        M.flat[:: n + 1] += D[m : m + n] + D[m + n :]
        r = now.h - s
        right = (ideal[:m] - D[:m] * r) @ now.A - self._program.cost
        right += ideal[m : m + n] - ideal[m + n :]
        dz = direction(M, right, self._width)
        if dz is None:
            return False
        change = np.concatenate([now.A @ dz + r, dz, -dz])
        by_dual = ideal - D * change - now.dual
        found = self._search(now, dz, change)
        if found is None:
            return self._heed(now)
        now.z, now.slack, now.h = found
        now.A = self._rows.slopes(now.z)
        share = largest(now.dual, by_dual, max(TO_BOUNDARY, 1.0 - mu))
        now.dual = kept(now.dual + share * by_dual, mu / now.slack)
        self._heed(now)
        return True

    def _heed(self, now: State) -> bool:
        """Raise the multipliers of rows that shortened the last step, which bend away faster than
        their slope tells: with them their curvature enters the next one. Whether any was raised."""
        blocking = self._blocking.nonzero()[0]
        y = now.dual[blocking]
        raised = np.maximum(y, np.minimum(1.0, RAISED * y))
        now.dual[blocking] = raised
        return bool((raised > y).any())

    def _search(self, now: State, dz: Array, change: Array) -> tuple[Array, Array, Array] | None:
        """Along a direction until an iterate is good enough: z, slack, h; None if none is.

        Rows that hold go on to hold: their slack is what they keep, so that an answer may be
        taken wherever it is cut off.
        """
        mu, m = self._mu, len(now.h)
        keep = max(TO_BOUNDARY, 1.0 - mu)
        kept_s, ds = now.slack[:m], change[:m]
        theta = float(np.abs(now.h - kept_s).sum())
        self._price = max(self._price, PENALTY * now.dual[:m].max(initial=0.0)) if theta else 0.0
        slope = float(self._program.cost @ dz) - mu * float((change / now.slack).sum())
        slope -= self._price * theta
        before = self._merit(now.z, now.slack, theta)
        rounding = 1e-14 * max(1.0, abs(before))
        held, left = now.h >= kept_s, (1.0 - keep) * kept_s
        alpha = largest(now.slack, change, keep)
        self._blocking = np.zeros(m, dtype=np.bool_)
        for _ in range(TRIALS):
            z = (now.z + alpha * dz).clip(*self._inner)
            h = self._rows.values(z)
            share = SHORTENED[0]
            if np.isfinite(h).all():
                lost = (held & (h < left)).nonzero()[0]
                if len(lost):
                    share = until(kept_s[lost], alpha * ds[lost], h[lost])
                    self._blocking[lost] = True
                else:
                    s = np.where(held, h, np.maximum(kept_s + alpha * ds, h))
                    slack = self._slack(z, np.maximum(s, LEAST))
                    merit = self._merit(z, slack, float(np.abs(h - slack[:m]).sum()))
                    if merit <= before + ARMIJO * alpha * slope + rounding:
                        return z, slack, h
                    share = -slope * alpha / (2.0 * (merit - before - slope * alpha))
            alpha *= min(max(share, SHORTENED[0]), SHORTENED[1])
        return None

    def _renew(self, now: State) -> bool:
        """Slacks as large as at the start; whether that changes anything."""
        m = len(now.h)
        s = np.maximum(now.h, min(SLACK, 10.0 * self._mu))
        old = now.slack[:m].copy()
        changed = not np.allclose(s, old, rtol=1e-6)
        now.dual[:m] = np.where(s > old, self._mu / s, now.dual[:m])
        now.slack[:m] = s
        self._renewals += 1
        return changed and self._renewals <= RENEWALS

    def _merit(self, z: Array, slack: Array, theta: float) -> float:
        """The barrier's objective, and the price of the violation of h = s."""
        logs = float(np.log(slack).sum())
        return float(self._program.cost @ z) - self._mu * logs + self._price * theta


def dense(program: Program, settings: PolishSettings) -> Answer:
    """Solve a program with the dense interior-point method."""
    return DenseSolver(program, settings).solve()
