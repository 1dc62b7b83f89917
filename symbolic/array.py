"""The one array type of all packages, and the annotations of allowed values of a record."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from symbolic.errors import SettingsError

Array = NDArray[np.float64]
"""Floating-point numbers; shape, unit and frame stand beside every use."""


@dataclass(frozen=True)
class Range:
    """Allowed range of a number.

    Attributes:
        low, high: lowest and highest allowed value.
        unit: SI unit; '' for a pure number.
        mistaken: units that people write by mistake, each with its name and its factor to `unit`.
    """

    low: float
    high: float
    unit: str = ""
    mistaken: tuple[tuple[str, float], ...] = ()

    def contains(self, value: float) -> bool:
        """Return True if the value is finite and within the range."""
        return math.isfinite(value) and self.low <= value <= self.high

    def allowed(self) -> str:
        """Return the range in words, for a message."""
        if self.low == -math.inf and self.high == math.inf:
            return "any that is finite"
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()

    def suspicion(self, value: float) -> str:
        """Return text for a message if a value outside the range lies inside after conversion from
        one of the units `mistaken`: this unit, and the converted value. Return '' otherwise.
        """
        for name, factor in self.mistaken:
            if math.isfinite(value) and value != 0 and self.contains(value * factor):
                return (
                    f"; this looks like {name}: {value:g} {name} are "
                    f"{value * factor:.6g} {self.unit}"
                )
        return ""


@dataclass(frozen=True)
class TextPattern:
    """Allowed form of a text.

    Attributes:
        problem: function that returns what is wrong with a value, '' if nothing is.
    """

    problem: Callable[[Any], str]


@dataclass(frozen=True)
class Shape:
    """Allowed shape of an array.

    Attributes:
        sizes: size of each axis; None for any size.
        kind: type of the array's entries, for example float or int.
    """

    sizes: tuple[int | None, ...]
    kind: type = float


@dataclass(frozen=True)
class BroadcastScalar:
    """Annotation of an array field: a single number may stand for an array of equal entries."""


@dataclass(frozen=True)
class AllowMissing:
    """Annotation of a number or an array: NaN and infinity are allowed and mean a missing value."""


Figure = Annotated[float, AllowMissing()]
"""A number; NaN or infinite if the value does not exist."""

Count = Annotated[int, Range(0, 10**12)]

Pair = Annotated[Array, Shape((2,))]
"""(2,) one number per robot."""

Vector = Annotated[Array, Shape((3,))]
"""(3,) one number per axis."""

Row = Annotated[Array, Shape((None,))]
"""(n,) numbers."""


def interpolated(at: Array, along: Array, values: Array) -> Array:
    """Interpolate tabulated values linearly, entry by entry.

    Args:
        at: (m,) positions at which values are wanted.
        along: (n,) ascending positions of the table.
        values: (n, ...) values at `along`.

    Returns:
        (m, ...) values at `at`; outside the table those at its nearest end.
    """
    found = np.empty((len(at), *values.shape[1:]))
    for column in np.ndindex(values.shape[1:]):
        every = (slice(None), *column)
        found[every] = np.interp(at, along, values[every])
    return found


def evenly(count: int, most: int) -> NDArray[np.intp]:
    """Return at most `most` evenly spread indices from 0 to `count` - 1, the first and last
    included."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.intp)


def set_read_only(record: object) -> None:
    """Make every array field of a record read-only, in place."""
    for value in vars(record).values():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)


def require_allowed(settings: object, whose: str = "") -> None:
    """Raise an error if a field of a settings record has a value that its annotation does not
    allow: a value other than those of a `Literal`, or a number outside a `Range`. None passes if
    the annotation includes None.

    Args:
        settings: the settings record, a dataclass.
        whose: text at the front of the message that names the owner of the settings.

    Raises:
        SettingsError: a value is not allowed; the message states the value and the allowed ones.
    """
    for name, kind in get_type_hints(type(settings), include_extras=True).items():
        value: Any = getattr(settings, name)
        if get_origin(kind) in (Union, UnionType):
            choices = [choice for choice in get_args(kind) if choice is not type(None)]
            if value is None or len(choices) > 1:
                continue
            (kind,) = choices
        if get_origin(kind) is Literal and value not in get_args(kind):
            known = ", ".join(get_args(kind))
            raise SettingsError(
                f"{whose}{name.replace('_', ' ')} {value!r}; known are {known}",
                code="unknown-choice",
            )
        allowed = [mark for mark in getattr(kind, "__metadata__", ()) if isinstance(mark, Range)]
        whole = get_args(kind)[:1] == (int,)
        numbers = int if whole else int | float
        for mark in allowed:
            is_number = isinstance(value, numbers) and not isinstance(value, bool)
            if not (is_number and mark.low <= value <= mark.high):
                kind_of = "are whole numbers" if whole else "is"
                raise SettingsError(
                    f"{whose}{name} is {value!r}; allowed {kind_of} {mark.low} to {mark.high}",
                    code="range",
                )
