"""How hard to press: what to command so that the carry holds although nothing is exact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybrid_opt.carry import Carry
from symbolic.array import Array

FACTOR = 1.3
"""Commanded over planned force where nothing says how uncertain the cell is."""


@dataclass(frozen=True)
class Squeeze:
    """What to press with.

    Attributes:
        peak: (2,) largest normal force to command of each robot [N].
        reason: where it comes from.
    """

    peak: Array
    reason: str


def squeeze_of(carry: Carry) -> Squeeze:
    """The forces to command for a carry."""
    extra = (FACTOR - 1.0) * carry.normal_force.mean(axis=1, keepdims=True)
    peak = np.asarray((carry.normal_force + extra).max(axis=0))
    return Squeeze(peak, f"{FACTOR:g} times the planned squeeze")
