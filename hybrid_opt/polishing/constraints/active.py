"""All kinds of constraints together: which rows a program gets, and what they have to keep."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

from hybrid_opt.polishing.constraints.clearances import Clearances
from hybrid_opt.polishing.constraints.distances import DistanceKind
from hybrid_opt.polishing.constraints.forces import Forces
from hybrid_opt.polishing.constraints.joint_limits import JointLimits
from hybrid_opt.polishing.constraints.kind import Kind, Surroundings
from hybrid_opt.polishing.constraints.passages import Passings, Separations
from hybrid_opt.polishing.constraints.pressure import Pressure
from hybrid_opt.polishing.constraints.reaches import Reaches
from hybrid_opt.polishing.layout import ForceRow, PlaceRow, PressureRow, Row
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.targets import Target
from symbolic.smooth.clearance import Clearance
from symbolic.smooth.joint_limit import JointLimit
from symbolic.smooth.passage import Passing, Separation
from symbolic.smooth.reach import Reach


class ActiveSet:
    """Chooses rows for candidates of one evaluator.

    A new kind of constraint is a class beside `kind.Kind`'s others and a line here. Carries
    under the time law 'optimal' have no rows at samples: `hybrid_opt.polishing.drivable` has their
    forces.
    """

    def __init__(self, around: Surroundings) -> None:
        self.forces = Forces(around)
        self._movable = around.movable
        self._distances = Clearances(around)
        sampled: dict[type, Kind[Any]] = {ForceRow: self.forces}
        if around.workcell.task.allocation == "paper":
            sampled[PressureRow] = Pressure(around)
        driven = around.workcell.task.time_law == "optimal"
        self._kinds: dict[type, Kind[Any]] = ({} if driven else sampled) | {
            Clearance: self._distances,
            Separation: Separations(around),
            Passing: Passings(around),
            JointLimit: JointLimits(around),
            Reach: Reaches(around),
        }

    def near(self, carry: PlacedCarry, target: Target) -> set[Row]:
        """Rows of everything near a candidate."""
        return self._rows(lambda kind: kind.near(carry, target))

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
        ) or not carry.keeps(self._distances.least)

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
