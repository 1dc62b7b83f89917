"""The one array type of all packages, and what annotations say of the values of a record."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Floating-point numbers; shape, unit and frame stand beside every use."""


@dataclass(frozen=True)
class Range:
    """Lowest and highest value of a number."""

    low: float
    high: float


@dataclass(frozen=True)
class Shape:
    """Sizes of an array's axes, None for any, and the kind of its numbers."""

    sizes: tuple[int | None, ...]
    kind: type = float


@dataclass(frozen=True)
class Missing:
    """Marks a number, or an array's numbers, that may be missing: not finite."""


Figure = Annotated[float, Missing()]
"""A number, NaN or infinite where there is none."""

Count = Annotated[int, Range(0, 10**12)]

Pair = Annotated[Array, Shape((2,))]
"""(2,) one number per robot."""

Vector = Annotated[Array, Shape((3,))]
"""(3,) one number per axis."""

Row = Annotated[Array, Shape((None,))]
"""(n,) numbers."""
