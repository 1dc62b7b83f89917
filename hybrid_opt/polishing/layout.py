"""The rows of a smooth program, and the one record that knows where everything stands in it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, cached_property

from symbolic.smooth.place import PlaceConstraint

HELD = 5
"""Branch of a force row that is the joint allocation's, after the paper's five."""


@dataclass(frozen=True, order=True)
class ForceRow:
    """One branch of `normal_force_branches` of one robot at a sample, or `HELD`, to stay below its
    peak."""

    robot: int
    branch: int
    sample: int


@dataclass(frozen=True, order=True)
class PressureRow:
    """What a robot's shift of the centre of pressure leaves of its patch at a sample."""

    robot: int
    sample: int


@dataclass(frozen=True)
class PlaceRow:
    """One constraint at one place of the path."""

    constraint: PlaceConstraint
    place: int


Row = ForceRow | PressureRow | PlaceRow


@dataclass(frozen=True)
class Layout:
    """The blocks of variables and of rows of one program, in their order.

    Variables: the decision vector in its unit box, both robots' scaled peak forces, the level.
    Rows: forces, the sides of both objectives, patches, places.

    Attributes:
        n_var: length of the decision vector.
        force_rows, pressure_rows, place_rows: the rows of each block.
    """

    n_var: int
    force_rows: tuple[ForceRow, ...]
    pressure_rows: tuple[PressureRow, ...]
    place_rows: tuple[PlaceRow, ...]

    @classmethod
    def of(cls, n_var: int, rows: Iterable[Row]) -> Layout:
        """Rows of all kinds put into their blocks, each block in an order of its own."""
        listed = list(rows)
        places = [row for row in listed if isinstance(row, PlaceRow)]
        return cls(
            n_var,
            tuple(sorted(row for row in listed if isinstance(row, ForceRow))),
            tuple(sorted(row for row in listed if isinstance(row, PressureRow))),
            tuple(sorted(places, key=lambda row: (_name(row.constraint), row.place))),
        )

    @cached_property
    def decision(self) -> slice:
        """The decision vector among the variables."""
        return slice(0, self.n_var)

    @cached_property
    def peaks(self) -> slice:
        """Both scaled peak forces."""
        return slice(self.n_var, self.n_var + 2)

    @cached_property
    def level(self) -> int:
        """The level."""
        return self.n_var + 2

    @cached_property
    def n_variables(self) -> int:
        """All of them."""
        return self.n_var + 3

    @cached_property
    def forces(self) -> slice:
        """The force rows among all rows."""
        return slice(0, len(self.force_rows))

    @cached_property
    def sides(self) -> slice:
        """The rows of both objectives."""
        return slice(self.forces.stop, self.forces.stop + 2)

    @cached_property
    def patches(self) -> slice:
        """The pressure rows."""
        return slice(self.sides.stop, self.sides.stop + len(self.pressure_rows))

    @cached_property
    def places(self) -> slice:
        """The rows at places."""
        return slice(self.patches.stop, self.patches.stop + len(self.place_rows))

    @cached_property
    def n_rows(self) -> int:
        """All of them."""
        return int(self.places.stop)


@cache
def _name(constraint: PlaceConstraint) -> str:
    return repr(constraint)
