"""A dense interior-point method for programs of few variables and many inequalities.

The polish's programs have about twenty variables and one to two hundred rows, nearly all of them
inequalities. Condensed to the variables, Newton's system is a matrix of twenty by twenty, where a
sparse solver factorises one of three hundred. The method is that of Waechter and Biegler (2006):
a barrier that falls as its problems are solved, a filter, second-order corrections, with dense
algebra and without its restoration phase. In its place slacks are renewed, and where that does
not help, the answer is what was reached: the polish then tries a smaller box.

With h(z) >= 0 all inequalities, h(z) - s = 0 and the multipliers y, each step solves

    (W + A^T D A + E) dz = -c + A^T (mu / s - D r) + mu / (z - low) - mu / (high - z),

A = dh/dz, D = y / s, r = h - s, W the curvature of the Lagrangian, E that of the bounds' barrier.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from hybrid_opt.polishing.program import Program
from hybrid_opt.polishing.residuals import UNKNOWN, residuals
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.solvers import Answer
from symbolic.array import Array

PUSH = 1e-4
"""Least distance of the start from bounds, as a share of their width, and least slack."""

LINEAR, POWER = 0.2, 1.5
"""The barrier falls to the smaller one of this share of it and this power."""

SOLVED = 10.0
"""A barrier's problem counts as solved at this many times the barrier."""

TO_BOUNDARY = 0.99
"""Share of the way to a bound that a step may take."""

ARMIJO, FILTER = 1e-4, 1e-5
"""Shares of the predicted gain, and of the violation, that a step has to bring."""

SHORTEST = 1e-4
"""Shares of a step below which a line search gives up."""

CORRECTIONS = 2
"""Second-order corrections of a full step that was refused for its violation."""

SHIFT, SHIFTED = 1e-6, 8.0
"""First shift that makes an indefinite matrix definite, and the factor to the next one."""

RENEWALS = 3
"""Times that the slacks may be renewed in a solve."""

DUAL_RANGE = 1e10
"""Multipliers stay within this factor of what the barrier asks for."""


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
        upper = np.flatnonzero(np.isfinite(program.above))
        lower = np.flatnonzero(np.isfinite(program.below))
        self._rows = np.concatenate([upper, lower])
        self._sign = np.concatenate([-np.ones(len(upper)), np.ones(len(lower))])
        self._shift = np.concatenate([program.above[upper], -program.below[lower]])
        self._mu = settings.solve.barrier
        self._filter: list[tuple[float, float]] = []
        self._renewals = 0

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
            if not self._advance(now):
                message = "Step_Too_Short"
                break
        z = now.z
        if not np.isfinite(z).all():
            return Answer(z, "Not_Finite", False, False, UNKNOWN, iterations)
        lam_g = np.zeros(len(self._program.below))
        np.add.at(lam_g, self._rows, -self._sign * now.y)
        return Answer(
            z=z,
            message=message,
            converged=message == "Solve_Succeeded",
            usable=True,
            residuals=residuals(self._program, z, now.high - now.low, lam_g),
            iterations=iterations,
        )

    def _start(self) -> _State:
        low, high = self._program.low, self._program.high
        push = PUSH * (high - low)
        z = np.clip(self._program.start, low + push, high - push)
        h, A = self._inequalities(z)
        s = np.maximum(h, PUSH)
        return _State(z, s, self._mu / s, self._mu / (z - low), self._mu / (high - z), h, A)

    def _inequalities(self, z: Array) -> tuple[Array, Array]:
        values, jacobian = self._program.constraints(z)
        return (
            self._sign * values[self._rows] + self._shift,
            self._sign[:, None] * jacobian[self._rows],
        )

    def _error(self, now: _State, mu: float) -> float:
        """Largest residual of the barrier's conditions, multipliers scaled as in the paper."""
        program = self._program
        n = len(now.y) + 2 * len(now.z)
        mean = (now.y.sum() + now.low.sum() + now.high.sum()) / n
        scale = max(1.0, mean / 100.0)
        slope = program.cost - now.A.T @ now.y - now.low + now.high
        products = (
            now.s * now.y,
            (now.z - program.low) * now.low,
            (program.high - now.z) * now.high,
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
            self._filter.clear()

    def _advance(self, now: _State) -> bool:
        """One step; whether one was found."""
        program, mu = self._program, self._mu
        D = now.y / now.s
        to_low, to_high = now.z - program.low, program.high - now.z
        multipliers = np.zeros(len(program.below))
        np.add.at(multipliers, self._rows, -self._sign * now.y)
        # The objective is linear: all curvature is the constraints'.
        M = program.curvature(now.z, multipliers) + (now.A.T * D) @ now.A
        M[np.diag_indices_from(M)] += now.low / to_low + now.high / to_high
        factor = _factorised(M)
        if factor is None:
            return False
        fixed = -program.cost + mu / to_low - mu / to_high

        def direction(r: Array) -> tuple[Array, Array]:
            dz = lapack.dpotrs(factor, fixed + now.A.T @ (mu / now.s - D * r), lower=1)[0]
            return dz, now.A @ dz + r

        dz, ds = direction(now.h - now.s)
        dy = mu / now.s - D * ds - now.y
        dlow = mu / to_low - now.low / to_low * dz - now.low
        dhigh = mu / to_high + now.high / to_high * dz - now.high
        found = self._search(now, dz, ds, direction)
        if found is None:
            return self._renew(now)
        now.z, now.s, now.h, now.A = found
        keep = max(TO_BOUNDARY, 1.0 - mu)
        dual = min(
            _largest(v, dv, keep) for v, dv in ((now.y, dy), (now.low, dlow), (now.high, dhigh))
        )
        now.y = _kept(now.y + dual * dy, mu / now.s)
        now.low = _kept(now.low + dual * dlow, mu / (now.z - program.low))
        now.high = _kept(now.high + dual * dhigh, mu / (program.high - now.z))
        return True

    def _search(
        self,
        now: _State,
        dz: Array,
        ds: Array,
        direction: Callable[[Array], tuple[Array, Array]],
    ) -> tuple[Array, Array, Array, Array] | None:
        """Along a direction until the filter takes an iterate: z, s, h, A; None if none is."""
        program, mu = self._program, self._mu
        keep = max(TO_BOUNDARY, 1.0 - mu)

        def longest(dz: Array, ds: Array) -> float:
            return min(
                _largest(now.s, ds, keep),
                _largest(now.z - program.low, dz, keep),
                _largest(program.high - now.z, -dz, keep),
            )

        theta, phi = self._measures(now.z, now.s, now.h)
        slope = float(
            program.cost @ dz
            - mu * (ds / now.s).sum()
            - mu * (dz / (now.z - program.low) - dz / (program.high - now.z)).sum()
        )
        alpha = longest(dz, ds)
        trials = 0
        while alpha > SHORTEST:
            z, s = now.z + alpha * dz, now.s + alpha * ds
            h, A = self._inequalities(z)
            if self._accepts(theta, phi, slope, alpha, self._measures(z, s, h)):
                return z, np.maximum(s, h), h, A
            if trials == 0 and np.abs(h - s).sum() >= theta:
                r = now.h - now.s
                for _ in range(CORRECTIONS):
                    r = alpha * r + h - s
                    dz_2, ds_2 = direction(r)
                    beta = longest(dz_2, ds_2)
                    # The corrected step's slacks move by what the constraints are to do.
                    z, s = now.z + beta * dz_2, now.s + beta * (ds_2 - r + now.h - now.s)
                    if (s <= 0.0).any():
                        break
                    h, A = self._inequalities(z)
                    if self._accepts(theta, phi, slope, alpha, self._measures(z, s, h)):
                        return z, np.maximum(s, h), h, A
            trials += 1
            alpha /= 2.0
        return None

    def _measures(self, z: Array, s: Array, h: Array) -> tuple[float, float]:
        """Violation of h = s, and the barrier's objective."""
        program = self._program
        logs = np.log(s).sum() + np.log(z - program.low).sum() + np.log(program.high - z).sum()
        return float(np.abs(h - s).sum()), float(program.cost @ z - self._mu * logs)

    def _accepts(
        self, theta: float, phi: float, slope: float, alpha: float, trial: tuple[float, float]
    ) -> bool:
        """Whether an iterate is better in violation or objective than all that were left."""
        new_theta, new_phi = trial
        if not np.isfinite(new_theta + new_phi):
            return False
        if any(new_theta >= t and new_phi >= p for t, p in self._filter):
            return False
        rounding = 1e-14 * max(1.0, abs(phi))
        steep = slope < 0.0 and alpha * (-slope) ** 2.3 > theta**1.1 and theta <= 1e-4
        if steep:
            return new_phi <= phi + ARMIJO * alpha * slope + rounding
        if new_theta <= (1.0 - FILTER) * theta or new_phi <= phi - FILTER * theta + rounding:
            self._filter.append(((1.0 - FILTER) * theta, phi - FILTER * theta))
            return True
        return False

    def _renew(self, now: _State) -> bool:
        """Slacks as the constraints are, and an empty filter; whether that changes anything."""
        s = np.maximum(now.h, min(PUSH, self._mu))
        changed = bool(self._filter) or not np.allclose(s, now.s, rtol=1e-6)
        now.s, now.y = s, self._mu / s
        self._filter.clear()
        self._renewals += 1
        return changed and self._renewals <= RENEWALS


def _largest(value: Array, change: Array, keep: float) -> float:
    """Largest share of a change, at most 1, that leaves values above zero."""
    falling = change < 0.0
    if not falling.any():
        return 1.0
    return float(min(1.0, (-keep * value[falling] / change[falling]).min()))


def _kept(value: Array, ideal: Array) -> Array:
    """Multipliers within a range of what the barrier asks for."""
    return np.clip(value, ideal / DUAL_RANGE, ideal * DUAL_RANGE)


def _factorised(M: Array) -> Array | None:
    """Lower Cholesky factor of a matrix, shifted until it is definite; None where it never is."""
    shift, scale = 0.0, max(1.0, float(np.abs(np.diag(M)).max()))
    while np.isfinite(scale) and shift < 1e12 * scale:
        shifted = M + shift * np.eye(len(M)) if shift else M
        factor, info = lapack.dpotrf(shifted, lower=1)
        if info == 0:
            return np.asarray(factor)
        shift = max(SHIFT * scale, SHIFTED * shift)
    return None


def dense(program: Program, settings: PolishSettings) -> Answer:
    """Solve a program with the dense interior-point method."""
    return DenseSolver(program, settings).solve()
