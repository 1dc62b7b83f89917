"""How a proposal is asked for."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from symbolic.errors import SettingsError


@dataclass(frozen=True)
class ProposeSettings:
    """How a carry is looked for.

    Attributes:
        seconds: for all of it.
        feasible: least and largest share of random candidates within the bounds that is feasible.
        bases: whether the robots' bases are proposed too; of those in the file only the height
            counts.
        clock: what seconds are counted by.
    """

    seconds: float = 120.0
    feasible: tuple[float, float] = (0.02, 0.20)
    bases: bool = False
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        if not 1.0 <= self.seconds <= 1e6:
            raise SettingsError(f"seconds: found {self.seconds:g}; allowed is 1 to 1e6")
        low, high = self.feasible
        if not 0.0 < low < high <= 1.0:
            raise SettingsError(
                f"feasible: found {low:g} and {high:g}; allowed are shares 0 < least < largest <= 1"
            )
