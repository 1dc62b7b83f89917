"""What is known of pairs of bodies in configurations, and in which order it is asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array

Separations = dict[tuple[bytes, int], float | None]
"""By configuration and pair the distance that it surely keeps [m], None where it collides."""


@dataclass(frozen=True)
class MotionBounds:
    """Chord and bend (n, n_pairs) [m] of every pair between configurations, see
    `symbolic.geometry.motion_bounds`."""

    chord: Array
    bend: Array


def by_sample(bounds: Array, unsure: NDArray[np.bool_]) -> dict[int, list[int]]:
    """The pairs of each sample that has open ones: least bound first, ties in order."""
    # Flat indices: much faster to find than those of two axes.
    open_pairs = np.flatnonzero(unsure)
    samples, pairs = np.divmod(open_pairs, unsure.shape[1])
    order = np.lexsort((bounds.ravel()[open_pairs], samples))
    found: dict[int, list[int]] = {}
    for sample, pair in zip(samples[order].tolist(), pairs[order].tolist(), strict=True):
        found.setdefault(sample, []).append(pair)
    return found
