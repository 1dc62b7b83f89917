"""Bounds around a carry in which a wanted share of random candidates is feasible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array

LARGEST_BOUND_FACTOR = 8.0
"""Largest common factor of the half-widths of bounds."""

LEAST_FACTOR = 0.02
"""Smallest common factor of the half-widths."""

CANDIDATES_PER_ROUND = 64
"""Number of random candidates per round of the bisection."""

CONFIRMED = 250
"""Number of random candidates with which the share within the final bounds is measured."""

BISECTION_ROUNDS = 7
"""Number of rounds of the bisection."""

CANDIDATES_PER_BATCH = 32
"""Number of candidates that are evaluated between two looks at the clock."""

BOUND_FACTORS = (0.8, 1.2)
"""Factors on the bounds after a measurement with too few, and with too many, feasible
candidates."""

EMPTY_STEP = 0.5
"""Factor on the bounds after a measurement without feasible candidates."""

BOUND_CENTRES = (1.0, 0.75, 0.5)
"""Positions at which a feasible carry near the given one is looked for: 1 at the given carry, 0 at
the middle of the bounds."""

CENTRING_MOVES = 3
"""Largest number of times that bounds move to the middle of the feasible candidates."""


@dataclass(frozen=True)
class Bounds:
    """Bounds of a decision vector, with a feasible carry between them.

    Attributes:
        carry: (n_var,) feasible decision vector within the bounds, as near as possible to the carry
            around which they were searched.
        lower, upper: (n_var,) bounds [m, rad].
        share: share of random candidates within the bounds that is feasible.
        candidates: number of candidates by which the share was measured.
    """

    carry: Array
    lower: Array
    upper: Array
    share: float
    candidates: int


@dataclass(frozen=True)
class Sampling:
    """Functions and settings for a search for bounds by random candidates.

    Attributes:
        feasible: function from decision vectors (n, n_var) to (n,) True for those whose carries are
            feasible at all samples.
        certain: function that returns True if the carry of one decision vector (n_var,) is feasible
            between its samples too.
        unit: (n_var,) half-widths of the bounds before the search multiplies all by one factor [m,
            rad].
        limits: (2, n_var) smallest allowed lower bounds and largest allowed upper bounds [m, rad].
        rng: generator of random candidates.
        low, high: wanted range of the share of random candidates that is feasible.
        out_of_time: function that returns True if no time is left.
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
        """Find bounds of the decision vector such that the wanted share of random candidates
        between them is feasible.

        All half-widths are multiplied by one factor, which is bisected. Between bisections the
        bounds move to the mean of the feasible candidates, which allows wider bounds. The result
        also has a certified carry within the bounds: the given one if possible, otherwise one
        between it and the middle of the bounds.

        Args:
            carry: (n_var,) feasible decision vector.
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
        """Bisect the factor of the half-widths for which the wanted share of candidates is
        feasible.

        Args:
            centre: (n_var,) middle of the bounds [m, rad].
            scale: factor at the beginning.

        Returns:
            The factor, and feasible candidates (k, n_var) at a factor near it.
        """
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
        """Evaluate random candidates until it is nearly certain that the share of feasible ones
        lies outside a range.

        The evaluation also ends after `most` candidates, or if no time is left.

        Args:
            centre: (n_var,) middle of the bounds [m, rad].
            scale: factor of the half-widths.
            most: largest number of candidates.
            wanted: least and largest share of feasible candidates, the range.

        Returns:
            Candidates (n, n_var), and (n,) True for feasible ones.
        """
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
