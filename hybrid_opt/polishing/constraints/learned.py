"""What the steps of one solve taught: rows, and the value that each has to keep from then on.

What rows ask for that a refused step taught was measured where the step led: bounds of distances
are not smooth, and a step that is much shorter need not keep it. So of what a row asks beyond what
it has to keep at the best candidate, the share counts that the box of trust reaches of the way to
the candidate that taught it. Asked in full within a small box, nothing was left to do but to go
there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from hybrid_opt.polishing.constraints.active import ActiveSet
from hybrid_opt.polishing.layout import Row
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.targets import Target
from symbolic.array import Array


class Learned:
    """The rows of one solve beside those near its candidate. It grows with refused steps."""

    def __init__(self, active: ActiveSet, stricter: float, half: Array) -> None:
        """Nothing is learned yet.

        Args:
            active: chooses rows.
            stricter: least raise of a value that counts as new.
            half: (n,) half ranges of the variables.
        """
        self._active, self._stricter, self._half = active, stricter, half
        self._taught: dict[Row, tuple[float, Array]] = {}

    def required(
        self,
        carry: PlacedCarry,
        target: Target,
        at: tuple[Array, float],
        lenient: bool,
        others: Iterable[Row] = (),
    ) -> dict[Row, float]:
        """The rows of the next program about a candidate, and what each of them has to keep.

        Args:
            carry: the candidate's.
            at: its variables (n,), and half the width of the box of trust.
            lenient: see `Kind.required`.
            others: rows that are wanted as well.
        """
        x, radius = at
        rows = self._active.near(carry, target) | self._taught.keys() | set(others)
        required = self._active.required(carry, rows, lenient)
        for row, (value, taught_by) in self._taught.items():
            far = float(np.abs((taught_by - x) / self._half).max())
            share = min(1.0, radius / max(far, 1e-300))
            required[row] += share * max(value - required[row], 0.0)
        return required

    def refuse(
        self,
        carry: PlacedCarry,
        known: PlacedCarry,
        x: Array,
        violated: Iterable[Row],
        required: Mapping[Row, float],
    ) -> bool:
        """Take in what a step to x (n,) violated; whether it asks for anything new.

        Args:
            carry, known: after the step, and before.
            required: what the program asked for that led there.
        """
        stricter = False
        for row, value in self._active.demanded(carry, known, violated, required).items():
            taught = self._taught[row][0] if row in self._taught else -np.inf
            stricter |= value > max(required.get(row, -np.inf), taught) + self._stricter
            if value > taught:
                self._taught[row] = value, x
        return stricter

    def ask(self, rows: Iterable[Row], x: Array) -> None:
        """Ask that rows hold, as a step to x (n,) showed."""
        self._taught.update(dict.fromkeys(rows, (-np.inf, x)))

    def move(self) -> None:
        """Forget what was asked relative to a candidate that is left behind."""
        self._taught = {row: v for row, v in self._taught.items() if self._active.lasting(row)}
