"""Typed reading of nested tables that gathers every problem instead of stopping at the first.

A getter that meets a problem records it and returns a harmless stand-in, so that reading goes
on. Stand-ins never escape: whoever reads raises when `Problems.found` is not empty.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from symbolic.array import Array
from symbolic.workcell.problems import (
    MAX_NAME_LENGTH,
    Problems,
    shown,
    suggestion,
    text_problem,
)

MOST_UNKNOWN = 10
"""So many unknown keys of one table are told."""


@dataclass(frozen=True)
class Quantity:
    """A physical quantity with the range in which a value is believable.

    Attributes:
        unit: SI unit, empty for a pure number.
        low, high: allowed range, ends included.
        mistaken: units that people write by mistake, each (name, factor to `unit`).
    """

    unit: str
    low: float
    high: float
    mistaken: tuple[tuple[str, float], ...] = ()

    def contains(self, value: float) -> bool:
        """Whether the value is finite and within the range."""
        return math.isfinite(value) and self.low <= value <= self.high

    def allowed(self) -> str:
        """The range in words."""
        unit = f" {self.unit}" if self.unit else ""
        return f"{self.low:g} to {self.high:g}{unit}"

    def suspicion(self, value: float) -> str:
        """Which other unit a value outside the range was probably written in, or ''."""
        for name, factor in self.mistaken:
            if math.isfinite(value) and value != 0 and self.contains(value * factor):
                return (
                    f"; this looks like {name}: {value:g} {name} are "
                    f"{value * factor:.6g} {self.unit}"
                )
        return ""


def read_only(values: Any) -> Array:
    """A read-only float64 copy of an array-like."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


_REQUIRED: Any = object()


class Table:
    """One table of the file, read key by key.

    Args:
        data: the table's content.
        path: its key path, '' for the top level.
        problems: where problems go.
    """

    def __init__(self, data: Mapping[str, Any], path: str, problems: Problems) -> None:
        self._data = data
        self._known: set[str] = set()
        self.path = path
        self.problems = problems

    def __contains__(self, key: str) -> bool:
        return key in self._data

    def __iter__(self) -> Iterator[str]:
        return iter(self._data)

    def at(self, key: str) -> str:
        """The full key path of a key."""
        return f"{self.path}.{key}" if self.path else key

    def raw(self, key: str, default: Any = _REQUIRED) -> Any:
        """The value as it stands; a missing required key is a problem and gives None."""
        self._known.add(key)
        if key in self._data:
            return self._data[key]
        if default is _REQUIRED:
            self.problems.add(self.at(key), "is missing")
            return None
        return default

    def close(self) -> None:
        """Record every key that nobody asked for."""
        unknown = [key for key in self._data if key not in self._known]
        allowed = ", ".join(sorted(self._known))
        for key in unknown[:MOST_UNKNOWN]:
            hint = suggestion(key, self._known - set(self._data))
            self.problems.add(
                self.at(key if key.isprintable() and len(key) <= MAX_NAME_LENGTH else shown(key)),
                f"unknown key{hint or f'; allowed keys are {allowed}'}",
            )
        if len(unknown) > MOST_UNKNOWN:
            self.problems.add(
                self.path or "file", f"{len(unknown) - MOST_UNKNOWN} further unknown keys"
            )

    def number(self, key: str, quantity: Quantity, default: float | None = None) -> float:
        """A finite number within the quantity's range."""
        value = self.raw(key, _REQUIRED if default is None else default)
        if value is None:
            return 1.0
        return checked_number(value, quantity, self.at(key), self.problems)

    def vector(
        self,
        key: str,
        quantities: Sequence[Quantity],
        default: Sequence[float] | None = None,
        scalar_fills: bool = False,
    ) -> Array:
        """An array with one quantity per entry; one number for all where `scalar_fills`."""
        value = self.raw(key, _REQUIRED if default is None else list(default))
        if value is None:
            return read_only(np.ones(len(quantities)))
        if scalar_fills and not isinstance(value, list):
            number = checked_number(value, quantities[0], self.at(key), self.problems)
            return read_only(np.full(len(quantities), number))
        return checked_vector(value, quantities, self.at(key), self.problems)

    def integer(self, key: str, low: int, high: int, default: int | None = None) -> int:
        """A whole number within [low, high]."""
        value = self.raw(key, _REQUIRED if default is None else default)
        if value is None:
            return low
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            self.problems.add(
                self.at(key), f"found {shown(value)}; allowed is a whole number {low} to {high}"
            )
            return low
        return value

    def choice(self, key: str, allowed: Sequence[str], default: str | None = None) -> str:
        """One of the allowed words; '' after a problem."""
        value = self.raw(key, _REQUIRED if default is None else default)
        if value is None:
            return ""
        if value not in allowed:
            hint = suggestion(value, allowed) if isinstance(value, str) else ""
            self.problems.add(
                self.at(key),
                f"found {shown(value)}; allowed is one of "
                f"{', '.join(repr(word) for word in allowed)}{hint}",
            )
            return ""
        return str(value)

    def text(self, key: str, default: str | None = None) -> str:
        """A printable, not empty, single-line text."""
        value = self.raw(key, _REQUIRED if default is None else default)
        if value is None:
            return ""
        problem = text_problem(value)
        if problem:
            self.problems.add(self.at(key), f"found {shown(value)}; {problem}")
            return ""
        return str(value)

    def table(self, key: str, default: Mapping[str, Any] | None = None) -> Table:
        """A sub-table; an empty one after a problem, which then reports nothing further."""
        value = self.raw(key, _REQUIRED if default is None else default)
        if value is not None and isinstance(value, Mapping):
            return Table(value, self.at(key), self.problems)
        if value is not None:
            self.problems.add(self.at(key), f"found {shown(value)}; allowed is a table")
        return Table({}, self.at(key), Problems())

    def tables(self, key: str, exactly: int | None = None) -> list[Table]:
        """An array of tables, of any length (and not required) or of exactly that many.

        Of too many the first ones.
        """
        value = self.raw(key, [] if exactly is None else _REQUIRED)
        if value is None:
            return []
        if not isinstance(value, list) or not all(isinstance(entry, Mapping) for entry in value):
            heading = re.sub(r"\[\d+\]", "", self.at(key))
            self.problems.add(
                self.at(key),
                f"found {shown(value)}; allowed is an array of tables, [[{heading}]]",
            )
            return []
        if exactly is not None and len(value) != exactly:
            self.problems.add(
                self.at(key), f"found {len(value)} tables; allowed are exactly {exactly}"
            )
        return [
            Table(entry, f"{self.at(key)}[{index}]", self.problems)
            for index, entry in enumerate(value[:exactly])
        ]


def checked_number(value: Any, quantity: Quantity, path: str, problems: Problems) -> float:
    """The value as a float, or a recorded problem and a stand-in."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        problems.add(path, f"found {shown(value)}; allowed is a number, {quantity.allowed()}")
        return 1.0
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not quantity.contains(number):
        problems.add(
            path,
            f"found {number:.9g}; allowed is {quantity.allowed()}{quantity.suspicion(number)}",
        )
        return 1.0
    return number


def checked_vector(
    value: Any, quantities: Sequence[Quantity], path: str, problems: Problems
) -> Array:
    """The value as a read-only array, or recorded problems and a stand-in."""
    if not isinstance(value, list) or len(value) != len(quantities):
        problems.add(
            path, f"found {shown(value)}; allowed is an array of {len(quantities)} numbers"
        )
        return read_only(np.ones(len(quantities)))
    return read_only(
        [
            checked_number(entry, quantity, f"{path}[{index}]", problems)
            for index, (entry, quantity) in enumerate(zip(value, quantities, strict=True))
        ]
    )
