"""What one climb remembers of geometric rows: what steps violated, and which rows pressed lately.

Rows stand at the lowest places of a path. Where two places are equally low, each step raises the
one that has a row and lowers the other, for ever: rows that pressed lately stay, while steps are
short. After a long one they would hold the payload on its old side of an edge.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from hybrid_opt.polishing.constraints.active import ActiveSet
from hybrid_opt.polishing.constraints.learned import Learned
from hybrid_opt.polishing.layout import PlaceRow, Row
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.targets import pascoletti_serafini
from symbolic.array import Array

ANY_TARGET = pascoletti_serafini(np.zeros(2), np.ones(2))
"""Geometric constraints do not look at what is aimed at."""

KEPT = 3
"""Programs that a row stays in after it pressed last."""


class Memory:
    """The rows of one climb. It grows with refused steps."""

    def __init__(self, active: ActiveSet, stricter: float, half: Array) -> None:
        """Nothing is remembered yet.

        Args:
            active: chooses rows.
            stricter: least raise of a value that counts as new.
            half: (n_path,) half ranges of the path's variables.
        """
        self._learned = Learned(active, stricter, half)
        self._pressed: dict[PlaceRow, int] = {}

    def required(
        self, carry: PlacedCarry, path: Array, radius: float, lenient: bool
    ) -> dict[Row, float]:
        """The rows of the next program about a path (n_path,), and what each has to keep."""
        return self._learned.required(carry, ANY_TARGET, (path, radius), lenient, self._pressed)

    def refuse(
        self,
        carry: PlacedCarry,
        known: PlacedCarry,
        path: Array,
        violated: Iterable[Row],
        required: Mapping[Row, float],
    ) -> bool:
        """See `Learned.refuse`; path (n_path,) of the step."""
        return self._learned.refuse(carry, known, path, violated, required)

    def press(self, rows: Iterable[PlaceRow]) -> None:
        """Note the rows that have multipliers in an answer."""
        left = {row: count - 1 for row, count in self._pressed.items() if count > 1}
        self._pressed = left | dict.fromkeys(rows, KEPT)

    def move(self, is_short: bool) -> None:
        """Forget what was asked relative to a candidate that is left behind, and after a long step
        also what pressed there."""
        if not is_short:
            self._pressed = {}
        self._learned.move()
