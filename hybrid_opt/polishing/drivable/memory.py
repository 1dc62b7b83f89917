"""What one climb remembers of geometric rows: what steps violated, and which rows pressed lately.

A step that is refused teaches rows, as in `hybrid_opt.polishing.constraints.learned`. What they ask
for was measured where the step led: bounds of distances are not smooth, and a step that is much
shorter need not keep it. So of what a row asks beyond what it has to keep at the best path, the
share counts that the box of trust reaches of the way to the path that taught it. Asked in full
within a small box, nothing was left to do but to go there.

Rows stand at the lowest places of a path. Where two places are equally low, each step raises the
one that has a row and lowers the other, for ever: rows that pressed lately stay, while steps are
short. After a long one they would hold the payload on its old side of an edge.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from hybrid_opt.polishing.constraints.active import ActiveSet
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
        self._active, self._stricter, self._half = active, stricter, half
        self._taught: dict[Row, tuple[float, Array]] = {}
        self._pressed: dict[PlaceRow, int] = {}

    def required(
        self, carry: PlacedCarry, path: Array, radius: float, lenient: bool
    ) -> dict[Row, float]:
        """The rows of the next program about a path (n_path,), and what each has to keep."""
        near = self._active.near(carry, ANY_TARGET)
        rows = near | self._taught.keys() | self._pressed.keys()
        required = self._active.required(carry, rows, lenient)
        for row, (value, taught_by) in self._taught.items():
            far = float(np.abs((taught_by - path) / self._half).max())
            share = min(1.0, radius / max(far, 1e-300))
            required[row] += share * max(value - required[row], 0.0)
        return required

    def refuse(
        self,
        carry: PlacedCarry,
        known: PlacedCarry,
        path: Array,
        violated: Iterable[Row],
        required: Mapping[Row, float],
    ) -> bool:
        """Take in what the path (n_path,) of a step violated; whether it asks for anything new.

        Args:
            carry, known: after the step, and before.
            required: what the program asked for that led there.
        """
        stricter = False
        for row, value in self._active.demanded(carry, known, violated, required).items():
            taught = self._taught[row][0] if row in self._taught else -np.inf
            stricter |= value > max(required.get(row, -np.inf), taught) + self._stricter
            if value > taught:
                self._taught[row] = value, path
        return stricter

    def press(self, rows: Iterable[PlaceRow]) -> None:
        """Note the rows that have multipliers in an answer."""
        left = {row: count - 1 for row, count in self._pressed.items() if count > 1}
        self._pressed = left | dict.fromkeys(rows, KEPT)

    def move(self, is_short: bool) -> None:
        """Forget what was asked relative to a candidate that is left behind, and after a long step
        also what pressed there."""
        if not is_short:
            self._pressed = {}
        self._taught = {row: v for row, v in self._taught.items() if self._active.lasting(row)}
