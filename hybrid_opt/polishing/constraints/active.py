"""All kinds of constraints together: which rows a program gets, and what they have to keep.

What rows ask for that a refused step taught was measured where the step led: bounds of distances
are not smooth, and a step that is much shorter need not keep it. So of what a row asks beyond what
it has to keep at the best candidate, the share counts that the box of trust reaches of the way to
the candidate that taught it. Asked in full within a small box, nothing was left to do but to go
there.

Rows stand at the lowest places of a path. Where two places are equally low, each step raises the
one that has a row and lowers the other, for ever: in the polish of drivable carries rows that
pressed lately stay, while steps are short. After a long one they would hold the payload on its old
side of an edge.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

import numpy as np

from hybrid_opt.polishing.carry import PlacedCarry
from hybrid_opt.polishing.cell import SmoothCell
from hybrid_opt.polishing.constraints.distances import (
    Clearances,
    DistanceKind,
    Passings,
    Separations,
)
from hybrid_opt.polishing.constraints.kinds import (
    Forces,
    JointLimits,
    Kind,
    Limits,
    Pressure,
    Reaches,
)
from hybrid_opt.polishing.rows import ForceRow, PlaceRow, PressureRow, Row
from symbolic.array import Array
from symbolic.smooth.passage import Passing, Separation
from symbolic.smooth.places import Clearance, JointLimit, Reach

STRICTER = 1e-4
"""Least rise of a required value that counts as a new demand [m, rad, 1]."""

KEPT = 3
"""Programs that a row stays in after it pressed last."""


class ActiveSet:
    """Chooses rows for candidates of one evaluator.

    Carries under the time law 'optimal' have no rows at samples: `hybrid_opt.polishing.drive` has
    their forces.
    """

    def __init__(self, cell: SmoothCell) -> None:
        self.forces = Forces(cell)
        self._movable = cell.grid.movable
        self._distances = Clearances(cell)
        sampled: dict[type, Kind[Any]] = {ForceRow: self.forces}
        if cell.task.allocation == "paper":
            sampled[PressureRow] = Pressure(cell)
        driven = cell.task.time_law == "optimal"
        self._kinds: dict[type, Kind[Any]] = ({} if driven else sampled) | {
            Clearance: self._distances,
            Separation: Separations(cell),
            Passing: Passings(cell),
            JointLimit: JointLimits(cell),
            Reach: Reaches(cell),
        }

    def near(self, carry: PlacedCarry, limits: Limits) -> set[Row]:
        """Rows of everything near a candidate."""
        return self._rows(lambda kind: kind.near(carry, limits))

    def violated(self, carry: PlacedCarry, known: PlacedCarry, asked: Collection[Row]) -> set[Row]:
        """Rows of everything that a step from a known candidate violates.

        Args:
            asked: rows of the program that led there. Its forces are no violation: they raise the
                peaks.
        """
        violated = self._rows(lambda kind: kind.violated(carry, known))
        return {row for row in violated if row not in asked or not isinstance(row, ForceRow)}

    def violates(self, carry: PlacedCarry, known: PlacedCarry, asked: Collection[Row]) -> bool:
        """Whether a step violates anything, as `violated` has it; distances, the dearest, last and
        only until one is too small."""
        return any(
            row not in asked or not isinstance(row, ForceRow)
            for kind in self._kinds.values()
            if not isinstance(kind, DistanceKind)
            for row in kind.violated(carry, known)
            if self._counts(row)
        ) or not carry.distances.keep(self._distances.least)

    def required(
        self, carry: PlacedCarry, rows: Iterable[Row], lenient: bool = False
    ) -> dict[Row, float]:
        """The value that each row has to keep, as learned from a candidate, see `Kind`."""
        return self._by_kind(rows, lambda kind, own: kind.required(carry, own, lenient))

    def demanded(
        self,
        carry: PlacedCarry,
        known: PlacedCarry,
        rows: Iterable[Row],
        before: Mapping[Row, float],
    ) -> dict[Row, float]:
        """The value that rows have to keep that a step violates, see `Kind`."""

        def asked(kind: Kind[Any], own: list[Row]) -> list[float]:
            return kind.demanded(carry, known, own, [before.get(row, 0.0) for row in own])

        return self._by_kind(rows, asked)

    def lasting(self, row: Row) -> bool:
        """Whether what a row has to keep outlasts the candidate that it was learned from."""
        return self._kind_of(row).lasting

    def _kind_of(self, row: Row) -> Kind[Any]:
        return self._kinds[type(row.constraint) if isinstance(row, PlaceRow) else type(row)]

    def _rows(self, ask: Callable[[Kind[Any]], Iterable[Row]]) -> set[Row]:
        kinds = self._kinds.values()
        return {row for kind in kinds for row in ask(kind) if self._counts(row)}

    def _counts(self, row: Row) -> bool:
        return not isinstance(row, PlaceRow) or self._movable(row.place)

    def _by_kind(
        self, rows: Iterable[Row], ask: Callable[[Kind[Any], list[Row]], list[float]]
    ) -> dict[Row, float]:
        groups: dict[Kind[Any], list[Row]] = {}
        for row in rows:
            groups.setdefault(self._kind_of(row), []).append(row)
        return {
            row: value
            for kind, own in groups.items()
            for row, value in zip(own, ask(kind, own), strict=True)
        }


class LearnedRows:
    """Rows learned by the steps of one climb, beside those near its candidate, and the value that
    each has to keep from then on. It grows with refused steps."""

    def __init__(self, active: ActiveSet, half: Array) -> None:
        """Nothing is learned yet.

        Args:
            active: chooses rows.
            half: (n,) half ranges of the variables that steps move.
        """
        self._active, self._half = active, half
        self._taught: dict[Row, tuple[float, Array]] = {}
        self._pressed: dict[Row, int] = {}

    def required(
        self, carry: PlacedCarry, limits: Limits, x: Array, radius: float, lenient: bool
    ) -> dict[Row, float]:
        """The rows of the next program about a candidate, and what each of them has to keep.

        Args:
            carry: the candidate's.
            x: its variables, (n,) or more.
            radius: half the width of the box of trust.
            lenient: see `Kind.required`.
        """
        rows = self._active.near(carry, limits) | self._taught.keys() | self._pressed.keys()
        required = self._active.required(carry, rows, lenient)
        for row, (value, taught_by) in self._taught.items():
            n = len(self._half)
            far = float(np.abs((taught_by[:n] - x[:n]) / self._half).max())
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
        """Take in what a step to x violated; whether it asks for anything new.

        Args:
            carry, known: after the step, and before.
            required: what the program asked for that led there.
        """
        stricter = False
        for row, value in self._active.demanded(carry, known, violated, required).items():
            taught = self._taught[row][0] if row in self._taught else -np.inf
            stricter |= value > max(required.get(row, -np.inf), taught) + STRICTER
            if value > taught:
                self._taught[row] = value, x
        return stricter

    def ask(self, rows: Iterable[Row], x: Array) -> None:
        """Ask that rows hold, as a step to x showed."""
        self._taught.update(dict.fromkeys(rows, (-np.inf, x)))

    def press(self, rows: Iterable[Row]) -> None:
        """Note the rows that have multipliers in an answer."""
        left = {row: count - 1 for row, count in self._pressed.items() if count > 1}
        self._pressed = left | dict.fromkeys(rows, KEPT)

    def move(self, is_short: bool = False) -> None:
        """Forget what was asked relative to a candidate that is left behind, and after a long step
        also what pressed there."""
        if not is_short:
            self._pressed = {}
        self._taught = {row: v for row, v in self._taught.items() if self._active.lasting(row)}
