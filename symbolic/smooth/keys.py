"""Names of the smooth problem's functions, as types: what a function is of, and which order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Order = Literal["first", "second"]
"""Values with their first derivatives, or weighted second derivatives."""

Quantity = Literal["force", "pressure", "load"]
"""force: F_n and F_t [N]. pressure: 1 - (shift / patch radius)^2 of contacts 1 and 2. load: force
and moment about the box frame's origin, along the box's axes [N, N m]."""

WIDTHS: Mapping[Quantity, int] = {"force": 2, "pressure": 2, "load": 6}
"""Values of each sample."""

Block = Literal["inner", "first", "last", "path"]
"""Inner samples, one at a call; the first two; the last two; all of another time law."""


@dataclass(frozen=True, order=True)
class SampleKey:
    """A function of samples, see `symbolic.smooth.samples.sample_functions`."""

    quantity: Quantity
    block: Block
    order: Order

    @property
    def name(self) -> str:
        """Of the CasADi function."""
        return f"{self.quantity}_{self.block}_{self.order}"


@dataclass(frozen=True, order=True)
class HeldKey:
    """A function of what a sample's load asks of the pads, see `symbolic.smooth.held`."""

    order: Order

    @property
    def name(self) -> str:
        """Of the CasADi function."""
        return f"held_{self.order}"


@dataclass(frozen=True, order=True)
class ClosureKey:
    """A function of an arm, see `symbolic.smooth.closure.closure_functions`."""

    arm: int
    order: Order

    @property
    def name(self) -> str:
        """Of the CasADi function."""
        return f"closure_{self.arm + 1}_{self.order}"


@dataclass(frozen=True, order=True)
class RowKey:
    """A function of one kind of row at places, see `symbolic.smooth.place.row_function`.

    Attributes:
        family: `PlaceConstraint.family`.
        order: of its derivatives.
    """

    family: str
    order: Order

    @property
    def name(self) -> str:
        """Of the CasADi function."""
        return f"row_{self.family}_{self.order}"
