"""Outcome of a simulation, and the least force with which the box stays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Generic, TypeVar

import numpy as np

from hybrid_opt.errors import WitnessError
from symbolic.array import Array

BEGINS = 0.1
"""Share of the slip that counts as one at which it is said to begin."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of one simulation, at n moments.

    Attributes:
        factor: multiple of the pressing force.
        holds: whether the box slipped by less than the settings' slip.
        time: (n,) when it was looked at, from the settled state on [s].
        slip: (n, 2) largest displacement in the plane of each pad since then [m].
        turn: (n,) angle by which the box turned between its pads since then [rad].
    """

    factor: float
    holds: bool
    time: Array
    slip: Array
    turn: Array

    @property
    def pad(self) -> int:
        """Index of the pad with the larger slip at the end."""
        return int(self.slip[-1].argmax())

    def begins(self, slip: float) -> float:
        """Time at which the slip first exceeds a tenth of `slip` [s]; infinite where never."""
        beyond = np.flatnonzero(self.slip.max(axis=1) > BEGINS * slip)
        return float(self.time[beyond[0]]) if len(beyond) else float("inf")


Shown = TypeVar("Shown", bound=Outcome)


@dataclass(frozen=True)
class Threshold(Generic[Shown]):
    """The least multiple of a force that holds.

    Attributes:
        slips, holds: simulations right below and above it.
    """

    slips: Shown
    holds: Shown

    @property
    def factor(self) -> float:
        """Middle of both multiples."""
        return (self.slips.factor + self.holds.factor) / 2.0


def bisected(
    simulate: Callable[[float], Shown], low: float, high: float, steps: int
) -> Threshold[Shown]:
    """The least factor with which a simulation holds, by bisection.

    Args:
        simulate: a factor to what it shows.
        low, high: factors between which it is looked for.
        steps: bisections.

    Raises:
        WitnessError: the box holds at the lower or slips at the higher factor.
    """
    slips, holds = simulate(low), simulate(high)
    if slips.holds or not holds.holds:
        what = f"holds at {low:g}" if slips.holds else f"slips at {high:g}"
        raise WitnessError(f"the box {what} times the force; give other factors")
    for _ in range(steps):
        middle = simulate((slips.factor + holds.factor) / 2.0)
        slips, holds = (slips, middle) if middle.holds else (middle, holds)
    return Threshold(slips, holds)


def mujoco_module() -> ModuleType:
    """The simulator.

    Raises:
        WitnessError: it is not installed.
    """
    try:
        import mujoco
    except ImportError as error:
        raise WitnessError(
            "MuJoCo is not installed; install the extra: pip install -e '.[sim]'"
        ) from error
    module: ModuleType = mujoco
    return module
