"""What the steps of one solve taught: rows, and the value that each has to keep from then on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from hybrid_opt.polishing.constraints.active import ActiveSet
from hybrid_opt.polishing.layout import Row
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.targets import Target


class Learned:
    """The rows of one solve beside those near its candidate. It grows with refused steps."""

    def __init__(self, active: ActiveSet, stricter: float) -> None:
        """Nothing is learned yet.

        Args:
            active: chooses rows.
            stricter: least raise of a value that counts as new.
        """
        self._active, self._stricter = active, stricter
        self._values: dict[Row, float] = {}

    def required(self, carry: PlacedCarry, target: Target, lenient: bool) -> dict[Row, float]:
        """The rows of the next program from a candidate, and what each of them has to keep."""
        rows = self._active.near(carry, target) | self._values.keys()
        required = self._active.required(carry, rows, lenient)
        for row, value in self._values.items():
            required[row] = max(value, required[row])
        return required

    def refuse(
        self,
        carry: PlacedCarry,
        known: PlacedCarry,
        violated: Iterable[Row],
        required: Mapping[Row, float],
    ) -> bool:
        """Take in what a step from a known candidate violated; whether it asks for anything new.

        Args:
            required: what the program asked for that led there.
        """
        stricter = False
        for row, value in self._active.demanded(carry, known, violated, required).items():
            stricter |= value > required.get(row, -np.inf) + self._stricter
            self._values[row] = max(value, self._values.get(row, -np.inf))
        return stricter

    def ask(self, rows: Iterable[Row]) -> None:
        """Ask that rows hold."""
        self._values.update(dict.fromkeys(rows, 0.0))

    def move(self) -> None:
        """Forget what was asked relative to a candidate that is left behind."""
        self._values = {row: v for row, v in self._values.items() if self._active.lasting(row)}
