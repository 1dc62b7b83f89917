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
from hybrid_opt.polishing.program import Program
from hybrid_opt.polishing.residuals import UNKNOWN, residuals
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.solvers import Answer
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
class _State:
    """An iterate with its slacks, multipliers and evaluated inequalities."""

    z: Array
    s: Array
    y: Array
    low: Array
    high: Array
    h: Array
    A: Array


class DenseSolver:
    """One solve of one program."""

    def __init__(self, program: Program, settings: PolishSettings) -> None:
        self._program, self._settings = program, settings
        self._rows = Inequalities(program)
        self._mu = settings.solve.barrier
        # Bounds are a hair wider than they are, so that no rounding puts an iterate on one.
        hair = HAIR * (program.high - program.low)
        self._low, self._high = program.low - hair, program.high + hair
        self._inner = self._low + 1e-3 * hair, self._high - 1e-3 * hair
        self._price, self._renewals = 0.0, 0

    def solve(self) -> Answer:
        """Iterate until an optimum, or as long as the settings allow."""
        now = self._start()
        wanted = self._settings.max_iterations
        iterations, message = 0, "Maximum_Iterations_Exceeded"
        for iterations in range(self._settings.solve.patience * wanted + 1):
            if self._error(now, 0.0) <= self._settings.solve.tolerance:
                message = "Solve_Succeeded"
                break
            violation = np.max(-now.h, initial=0.0)
            if iterations >= wanted and violation <= self._settings.solve.feasible:
                message = "Stopped_Feasible"
                break
            self._lower_barrier(now)
            if not self._advance(now) and not self._renew(now):
                message = "Step_Too_Short"
                break
        z = np.clip(now.z, self._program.low, self._program.high)
        lam_z, y = estimated(
            self._program.cost, now.A, (now.h, now.z - self._low, self._high - now.z)
        )
        multipliers = lam_z, self._rows.multipliers(y)
        usable = bool(np.isfinite(z).all())
        return Answer(
            z=z,
            message=message if usable else "Not_Finite",
            converged=usable and message == "Solve_Succeeded",
            usable=usable,
            multipliers=multipliers,
            residuals=residuals(self._program, z, *multipliers) if usable else UNKNOWN,
            iterations=iterations,
        )

    def _start(self) -> _State:
        low, high = self._low, self._high
        push = PUSH * (high - low)
        z = np.clip(self._program.start, low + push, high - push)
        h, A = self._rows.at(z)
        s = np.maximum(h, SLACK)
        return _State(z, s, self._mu / s, self._mu / (z - low), self._mu / (high - z), h, A)

    def _error(self, now: _State, mu: float) -> float:
        """Largest residual of the barrier's conditions, multipliers scaled as in the paper."""
        program = self._program
        n = len(now.y) + 2 * len(now.z)
        mean = (now.y.sum() + now.low.sum() + now.high.sum()) / n
        scale = max(1.0, mean / 100.0)
        slope = program.cost - now.A.T @ now.y - now.low + now.high
        products = (
            now.s * now.y,
            (now.z - self._low) * now.low,
            (self._high - now.z) * now.high,
        )
        return float(
            max(
                np.abs(slope).max() / scale,
                np.abs(now.h - now.s).max(initial=0.0),
                *(np.abs(product - mu).max(initial=0.0) / scale for product in products),
            )
        )

    def _lower_barrier(self, now: _State) -> None:
        least = self._settings.solve.tolerance / SOLVED
        while self._mu > least and self._error(now, self._mu) <= SOLVED * self._mu:
            self._mu = max(least, min(LINEAR * self._mu, self._mu**POWER))

    def _advance(self, now: _State) -> bool:
        """One step; whether one was found."""
        program, mu = self._program, self._mu
        D = now.y / now.s
        to_low, to_high = now.z - self._low, self._high - now.z
        # Rows that are far from ruling are left out of the curvature: most of its cost, and next to
        # nothing of the step.
        least = np.where(now.s > now.y, DISTANT, NEGLIGIBLE) * now.y.max(initial=0.0)
        ruling = np.where(now.y > least, now.y, 0.0)
        M = program.curvature(now.z, self._rows.multipliers(ruling)) + (now.A.T * D) @ now.A
        M[np.diag_indices_from(M)] += now.low / to_low + now.high / to_high
        r = now.h - now.s
        fixed = -program.cost + mu / to_low - mu / to_high
        dz = direction(M, fixed + now.A.T @ (mu / now.s - D * r), self._high - self._low)
        if dz is None:
            return False
        ds = now.A @ dz + r
        dy = mu / now.s - D * ds - now.y
        dlow = mu / to_low - now.low / to_low * dz - now.low
        dhigh = mu / to_high + now.high / to_high * dz - now.high
        found = self._search(now, dz, ds)
        if found is None:
            return self._heed(now)
        now.z, now.s, now.h, now.A = found
        keep = max(TO_BOUNDARY, 1.0 - mu)
        dual = min(
            largest(v, dv, keep) for v, dv in ((now.y, dy), (now.low, dlow), (now.high, dhigh))
        )
        now.y = kept(now.y + dual * dy, mu / now.s)
        now.low = kept(now.low + dual * dlow, mu / (now.z - self._low))
        now.high = kept(now.high + dual * dhigh, mu / (self._high - now.z))
        self._heed(now)
        return True

    def _heed(self, now: _State) -> bool:
        """Raise the multipliers of rows that shortened the last step, which bend away faster than
        their slope tells: with them their curvature enters the next one. Whether any was raised."""
        raised = np.where(self._blocking, np.minimum(1.0, RAISED * now.y), 0.0)
        changed = bool((raised > now.y).any())
        now.y = np.maximum(now.y, raised)
        return changed

    def _search(
        self, now: _State, dz: Array, ds: Array
    ) -> tuple[Array, Array, Array, Array] | None:
        """Along a direction until an iterate is good enough: z, s, h, A; None if none is.

        Rows that hold go on to hold: their slack is what they keep, so that an answer may be
        taken wherever it is cut off.
        """
        program, mu = self._program, self._mu
        keep = max(TO_BOUNDARY, 1.0 - mu)
        theta = float(np.abs(now.h - now.s).sum())
        self._price = max(self._price, PENALTY * now.y.max(initial=0.0)) if theta > 0.0 else 0.0
        slope = float(
            program.cost @ dz
            - mu * (ds / now.s).sum()
            - mu * (dz / (now.z - self._low) - dz / (self._high - now.z)).sum()
            - self._price * theta
        )
        before = self._merit(now.z, now.s, theta)
        rounding = 1e-14 * max(1.0, abs(before))
        held = now.h >= now.s
        alpha = min(
            largest(now.s, ds, keep),
            largest(now.z - self._low, dz, keep),
            largest(self._high - now.z, -dz, keep),
        )
        self._blocking = np.zeros(len(now.s), dtype=np.bool_)
        for _ in range(TRIALS):
            z, s = np.clip(now.z + alpha * dz, *self._inner), now.s + alpha * ds
            h, A = self._rows.at(z)
            share = SHORTENED[0]
            if np.isfinite(h).all():
                lost = np.flatnonzero(held & (h < (1.0 - keep) * now.s))
                if len(lost):
                    share = until(now.s[lost], alpha * ds[lost], h[lost])
                    self._blocking[lost] = True
                else:
                    s = np.maximum(np.where(held, h, np.maximum(s, h)), LEAST)
                    merit = self._merit(z, s, float(np.abs(h - s).sum()))
                    if merit <= before + ARMIJO * alpha * slope + rounding:
                        return z, s, h, A
                    share = -slope * alpha / (2.0 * (merit - before - slope * alpha))
            alpha *= min(max(share, SHORTENED[0]), SHORTENED[1])
        return None

    def _renew(self, now: _State) -> bool:
        """Slacks as large as at the start; whether that changes anything."""
        s = np.maximum(now.h, min(SLACK, 10.0 * self._mu))
        changed = not np.allclose(s, now.s, rtol=1e-6)
        now.y = np.where(s > now.s, self._mu / s, now.y)
        now.s = s
        self._renewals += 1
        return changed and self._renewals <= RENEWALS

    def _merit(self, z: Array, s: Array, theta: float) -> float:
        """The barrier's objective, and the price of the violation of h = s."""
        program = self._program
        logs = np.log(s).sum() + np.log(z - self._low).sum() + np.log(self._high - z).sum()
        return float(program.cost @ z - self._mu * logs + self._price * theta)


def dense(program: Program, settings: PolishSettings) -> Answer:
    """Solve a program with the dense interior-point method."""
    return DenseSolver(program, settings).solve()
