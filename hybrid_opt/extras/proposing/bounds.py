"""Bounds around a carry in which a wanted share of random candidates is feasible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array

LARGEST_BOUND_FACTOR = 8.0
"""Largest factor of the half-widths."""

LEAST_FACTOR = 0.02
"""Least factor."""

CANDIDATES_PER_ROUND = 64
"""Candidates per round of the bisection."""

CONFIRMED = 250
"""Candidates by which the share of the final bounds is measured."""

BISECTION_ROUNDS = 7
"""Rounds of the bisection."""

CANDIDATES_PER_BATCH = 32
"""Candidates that are judged before the clock is looked at."""

BOUND_FACTORS = (0.8, 1.2)
"""Factor of the next bounds where too few, or too many, are feasible."""

EMPTY_STEP = 0.5
"""The same where none is."""

BOUND_CENTRES = (1.0, 0.75, 0.5)
"""How near the carry is looked for to the one that bounds were asked for, from their middle."""

CENTRING_MOVES = 3
"""Times that bounds may move to where feasible candidates lie."""


@dataclass(frozen=True)
class Bounds:
    """Bounds of a decision vector.

    Attributes:
        carry: (n_var,) a feasible one within them, as near as possible to the given one.
        lower, upper: (n_var,) [m, rad].
        share: of random candidates that is feasible.
        candidates: number of candidates by which the share was measured.
    """

    carry: Array
    lower: Array
    upper: Array
    share: float
    candidates: int


@dataclass(frozen=True)
class Sampling:
    """How bounds are measured.

    Attributes:
        feasible: (n,) verdicts on decision vectors (n, n_var).
        certain: whether one decision vector is feasible between its samples too.
        unit: (n_var,) half-widths that are scaled together [m, rad].
        limits: (2, n_var) limits of all bounds.
        rng: the randomness.
        low, high: share that is wanted.
        out_of_time: whether to come to an end.
    """

    feasible: Callable[[Array], NDArray[np.bool_]]
    certain: Callable[[Array], bool]
    unit: Array
    limits: Array
    rng: np.random.Generator
    low: float
    high: float
    out_of_time: Callable[[], bool]

    def bounds_around(self, carry: Array) -> Bounds:
        """Find bounds around a feasible carry (n_var,).

        Their common factor is bisected. In between they move to the middle of the feasible
        candidates found, which makes room for wider ones. The carry itself stays, if it is within
        them: where they move to is longer.
        """
        scale, centre = 0.5, carry
        for _ in range(CENTRING_MOVES):
            scale, good = self._bisected(centre, scale)
            if len(good) < 6 or self.out_of_time():
                break
            moved = np.round(good.mean(axis=0), 4)
            if not self.certain(moved):
                break
            centre = moved
        wanted = 1.3 * self.low, 0.85 * self.high
        tried: list[tuple[float, float, int]] = []
        for _ in range(BISECTION_ROUNDS):
            _, fine = self._judged(centre, scale, CONFIRMED, wanted)
            share = float(fine.mean())
            tried.append((scale, share, len(fine)))
            if wanted[0] <= share <= wanted[1] or self.out_of_time():
                break
            step = EMPTY_STEP if share == 0.0 else BOUND_FACTORS[share > self._aim]
            scale = float(np.clip(step * scale, LEAST_FACTOR, LARGEST_BOUND_FACTOR))
        scale, share, count = min(tried, key=lambda one: abs(np.log((one[1] + 1e-3) / self._aim)))
        lower, upper = self._box(centre, scale)
        near = np.clip(carry, lower, upper)
        between = (np.round(centre + keep * (near - centre), 4) for keep in BOUND_CENTRES)
        found = next((x for x in between if self.certain(x)), centre)
        return Bounds(found, lower, upper, share, count)

    @property
    def _aim(self) -> float:
        return float(np.sqrt(self.low * self.high))

    def _bisected(self, centre: Array, scale: float) -> tuple[float, Array]:
        """Bisect the factor at which about the wanted share is feasible; return it and feasible
        candidates near it."""
        low, high, aim = LEAST_FACTOR, LARGEST_BOUND_FACTOR, self._aim
        good = np.empty((0, len(centre)))
        for _ in range(BISECTION_ROUNDS):
            x, fine = self._judged(centre, scale, CANDIDATES_PER_ROUND, (0.65 * aim, 1.35 * aim))
            share = float(fine.mean())
            if share >= aim:
                low, good = scale, x[fine]
            else:
                high = scale
            if abs(share - aim) < 0.35 * aim or self.out_of_time():
                break
            scale = (
                float(np.sqrt(low * high))
                if high < LARGEST_BOUND_FACTOR
                else min(2.0 * scale, LARGEST_BOUND_FACTOR)
            )
        return scale, good

    def _judged(
        self, centre: Array, scale: float, most: int, wanted: tuple[float, float]
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Evaluate candidates (n, n_var): at most `most`, fewer if the share of feasible ones is
        surely outside the wanted range, or the time is up."""
        x, fine = np.empty((0, len(centre))), np.empty(0, dtype=bool)
        bounds = self._box(centre, scale)
        while len(x) < most:
            more = self.rng.uniform(
                *bounds, (min(CANDIDATES_PER_BATCH, most - len(x)), len(centre))
            )
            x, fine = np.vstack([x, more]), np.append(fine, self.feasible(more))
            found, spread = int(fine.sum()), 2.0 * np.sqrt(fine.sum() + 1.0)
            beyond = found + spread < wanted[0] * len(x) or found - spread > wanted[1] * len(x)
            if beyond or self.out_of_time():
                break
        return x, fine

    def _box(self, centre: Array, scale: float) -> tuple[Array, Array]:
        half = scale * self.unit
        least, most = np.minimum(self.limits[0], centre), np.maximum(self.limits[1], centre)
        return np.maximum(centre - half, least), np.minimum(centre + half, most)
