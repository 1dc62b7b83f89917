"""Intervals of motions with what is known at both ends: the work list of `between`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array


@dataclass(frozen=True)
class End:
    """One end of m intervals.

    Attributes:
        configuration: (m, 6 + all joints) pose, q_1, q_2.
        clearance: (m, n_pairs), raised in place where FCL measured [m].
        measured: (m, n_pairs) where it did.
    """

    configuration: Array
    clearance: Array
    measured: NDArray[np.bool_]

    def __getitem__(self, rows: NDArray[np.bool_]) -> End:
        return End(self.configuration[rows], self.clearance[rows], self.measured[rows])


@dataclass(frozen=True)
class Intervals:
    """Work list: intervals of equal width, both ends, and the pairs not yet cleared."""

    index: NDArray[np.intp]
    start: Array
    width: float
    a: End
    b: End
    chord: Array
    bend: Array
    pending: NDArray[np.bool_]

    def __getitem__(self, rows: NDArray[np.bool_]) -> Intervals:
        return Intervals(
            self.index[rows],
            self.start[rows],
            self.width,
            self.a[rows],
            self.b[rows],
            self.chord[rows],
            self.bend[rows],
            self.pending[rows],
        )


def joined(parts: Sequence[Intervals]) -> Intervals:
    """Intervals of one width, one part after the other."""

    def ends(some: Sequence[End]) -> End:
        return End(
            np.concatenate([end.configuration for end in some]),
            np.concatenate([end.clearance for end in some]),
            np.concatenate([end.measured for end in some]),
        )

    return Intervals(
        np.concatenate([part.index for part in parts]),
        np.concatenate([part.start for part in parts]),
        parts[0].width,
        ends([part.a for part in parts]),
        ends([part.b for part in parts]),
        np.concatenate([part.chord for part in parts]),
        np.concatenate([part.bend for part in parts]),
        np.concatenate([part.pending for part in parts]),
    )


def alternating(first: Array, second: Array) -> Array:
    """Rows of two arrays in turn."""
    return np.stack([first, second], axis=1).reshape(-1, *first.shape[1:])


def alternating_ends(first: End, second: End) -> End:
    """Ends of two kinds in turn."""
    return End(
        alternating(first.configuration, second.configuration),
        alternating(first.clearance, second.clearance),
        np.stack([first.measured, second.measured], axis=1).reshape(-1, first.measured.shape[1]),
    )
