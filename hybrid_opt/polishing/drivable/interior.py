"""Convex quadratic programs of a border and a chain, by an interior-point method.

    minimise  d^T H d / 2 + g.d   where  A d <= b,  w.d <= v,  low <= d <= high

H and A as in `hybrid_opt.polishing.drivable.bordered`, w a row that may hold the whole chain. The
method is Mehrotra's predictor and corrector (Nocedal and Wright 2006, chapter 16.6) with slacks s
of the rows and multipliers y, z_low, z_high, until with mu -> 0

    H d + g + A^T y - z_low + z_high = 0,   A d + s = b,
    y s = z_low (d - low) = z_high (high - d) = mu.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hybrid_opt.polishing.drivable.bordered import BorderedMatrix, BorderedRows, Factors
from symbolic.array import Array

ITERATIONS = 50
"""At most; ten to twenty are the rule."""

TO_BOUNDARY = 0.995
"""Share of the way to a bound that a step may take."""

PUSH = 0.1
"""Least distance of the start from the bounds, as a share of their width."""

LEAST = 1e-2
"""Least slack and multiplier at the start."""

ROUNDING = 1e-9
"""Share of its terms that a proof of infeasibility leaves to rounding."""

REFINED = 3
"""Solutions of a linear system with a whole row, each of what the last ones left."""

Ending = Literal["solved", "infeasible", "failed"]


@dataclass(frozen=True)
class QuadraticProgram:
    """A program.

    Attributes:
        H, g: of the objective.
        A, b: (rows,) of the rows but the whole one.
        low, high: (n,) finite, each pair apart.
        whole: (n,) w, None without.
        most: v.
    """

    H: BorderedMatrix
    g: Array
    A: BorderedRows
    b: Array
    low: Array
    high: Array
    whole: Array | None = None
    most: float = 0.0

    @property
    def right(self) -> Array:
        """(all rows,) b, and v behind it."""
        return self.b if self.whole is None else np.append(self.b, self.most)

    def times(self, d: Array) -> Array:
        """(all rows,) A d, and w.d behind it."""
        product = self.A.times(d)
        return product if self.whole is None else np.append(product, self.whole @ d)

    def pulled(self, y: Array) -> Array:
        """(n,) of multipliers (all rows,) A^T y, and w times the last one."""
        if self.whole is None:
            return self.A.pulled(y)
        return np.asarray(self.A.pulled(y[:-1]) + y[-1] * self.whole)


@dataclass(frozen=True)
class Answer:
    """What a solve ends with.

    Attributes:
        d: (n,).
        rows: (all rows,) multipliers, at least zero.
        bounds: (n,) of the bounds, positive above, negative below.
        ending: 'infeasible' where multipliers prove it.
    """

    d: Array
    rows: Array
    bounds: Array
    ending: Ending


@dataclass
class _State:
    """An iterate, or a change of one; fields as in the module's formulas."""

    d: Array
    s: Array
    y: Array
    low: Array
    high: Array

    def moved(self, share: float, change: _State) -> _State:
        """After a share of a change."""
        pairs = zip(vars(self).values(), vars(change).values(), strict=True)
        return _State(*(value + share * by for value, by in pairs))


def solve(program: QuadraticProgram, tolerance: float) -> Answer:
    """Iterate until the conditions hold, or multipliers prove that they never do.

    Args:
        tolerance: of the conditions' residuals relative to their terms, and of the objective.
    """
    return _Solve(program, tolerance).run()


class _Solve:
    """One solve of one program."""

    def __init__(self, program: QuadraticProgram, tolerance: float) -> None:
        self._program, self._tolerance = program, tolerance
        self._low, self._high, self._right = program.low, program.high, program.right
        self._products = len(self._right) + 2 * len(program.g)

    def run(self) -> Answer:
        """See `solve`."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return self._run()

    def _run(self) -> Answer:
        program, now = self._program, self._start()
        ending: Ending = "failed"
        for _ in range(ITERATIONS):
            pull, bend = program.pulled(now.y), program.H.times(now.d)
            slope = bend + program.g + pull - now.low + now.high
            lack = program.times(now.d) + now.s - self._right
            mu, missing = self._mean(now), float(np.abs(lack).max(initial=0.0))
            if not np.isfinite(mu):
                break
            size = 1.0 + max(np.abs(bend).max(), np.abs(pull).max())
            if max(np.abs(slope).max() / size, missing, self._products * mu) <= self._tolerance:
                ending = "solved"
                break
            if missing > self._tolerance and self._is_impossible(now.y, pull):
                ending = "infeasible"
                break
            moved = self._advanced(now, slope, lack, mu)
            if moved is None:
                break
            now = moved
        return Answer(now.d, now.y, now.high - now.low, ending)

    def _is_impossible(self, y: Array, pull: Array) -> bool:
        """Whether the rows that y >= 0 weighs ask for more together than any d within the bounds
        can give."""
        least = float(np.minimum(pull * self._low, pull * self._high).sum())
        size = float(np.abs(self._right) @ y + np.abs(pull).sum())
        return least > float(self._right @ y) + ROUNDING * size

    def _start(self) -> _State:
        push = PUSH * (self._high - self._low)
        d = np.clip(np.zeros(len(push)), self._low + push, self._high - push)
        s = np.maximum(self._right - self._program.times(d), LEAST)
        low, high = (LEAST / np.maximum(to, LEAST) for to in (d - self._low, self._high - d))
        return _State(d, s, np.full(len(s), LEAST), low, high)

    def _mean(self, now: _State) -> float:
        """Mean product of a slack and its multiplier."""
        bounds = (now.d - self._low) @ now.low + (self._high - now.d) @ now.high
        return float(now.s @ now.y + bounds) / self._products

    def _advanced(self, now: _State, slope: Array, lack: Array, mu: float) -> _State | None:
        """After one step; None where there is none."""
        to_low, to_high = now.d - self._low, self._high - now.d
        newton = self._newton(now.y / now.s, now.low / to_low + now.high / to_high)
        if newton is None:
            return None

        def change(goals: tuple[Array, Array, Array]) -> _State:
            """What changes the products of rows and bounds by these."""
            rows, low, high = goals
            right = low / to_low - high / to_high - slope
            d = newton(right - self._program.pulled((rows + now.y * lack) / now.s))
            s = -lack - self._program.times(d)
            y = (rows - now.y * s) / now.s
            return _State(d, s, y, (low - now.low * d) / to_low, (high + now.high * d) / to_high)

        rows, low, high = now.s * now.y, to_low * now.low, to_high * now.high
        first = change((-rows, -low, -high))
        reached = self._mean(now.moved(min(1.0, self._longest(now, first)), first))
        goal = mu * (max(reached, 0.0) / mu) ** 3
        bent = first.d * first.low, -first.d * first.high
        second = change(
            (goal - rows - first.s * first.y, goal - low - bent[0], goal - high - bent[1])
        )
        share = min(1.0, TO_BOUNDARY * self._longest(now, second))
        return now.moved(share, second) if share > self._tolerance else None

    def _newton(self, D: Array, E: Array) -> Callable[[Array], Array] | None:
        """How to solve (H + A^T D A + E) d = right; None where rounding has made it indefinite."""
        program, whole = self._program, self._program.whole
        m = len(program.b)
        matrix = program.H.plus(program.A.squares(D[:m])).raised(E)
        factors = Factors(matrix)
        if not factors.ok:
            return None
        if whole is None:
            return factors.solve
        # One row more is a matrix of rank one more (Sherman and Morrison), which cancels digits.
        pull = factors.solve(whole)
        share = pull / (1.0 / D[-1] + whole @ pull)

        def solved(right: Array) -> Array:
            d = np.zeros(len(right))
            for _ in range(REFINED):
                left = right - matrix.times(d) - D[-1] * (whole @ d) * whole
                more = factors.solve(left)
                d += more - share * (whole @ more)
            return d

        return solved

    def _longest(self, now: _State, change: _State) -> float:
        """Share of a change at which the first slack or multiplier is gone."""
        values = np.concatenate(
            [now.s, now.y, now.low, now.high, now.d - self._low, self._high - now.d]
        )
        by = np.concatenate([change.s, change.y, change.low, change.high, change.d, -change.d])
        return float(1.0 / max(1e-300, (-by / values).max()))
