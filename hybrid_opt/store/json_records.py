"""Frozen records as JSON and back, checked once at the door.

The annotations of a dataclass's fields say what is allowed: `bool`, `int`, `float`, `str`,
`Literal`, enumerations, `tuple`, `Mapping[str, ...]`, `... | None`, further dataclasses, `Any` for
JSON values that are only passed on, and `Annotated` with what `symbolic.array` has. Numbers are
finite; what is `Missing` is NaN here and null in the file. What a record's own `__post_init__`
refuses is damaged as well. (msgspec, which was tried, knows neither numbers that may be missing nor
shapes of arrays.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from hybrid_opt.errors import ResultsError
from hybrid_opt.store.files import json_of, read_bytes
from symbolic.array import Missing, Range, Shape
from symbolic.errors import DualArmError

Record = TypeVar("Record")


class _Damaged(ValueError):
    """Where in a document, and what."""

    def __init__(self, where: str, problem: str) -> None:
        super().__init__(problem)
        self.where, self.problem = where, problem


def to_json(value: Any) -> Any:
    """A record as JSON values.

    Numbers that are not finite become null. Fields without a value that have none by default are
    left out.
    """
    if is_dataclass(value):
        return {
            field.name: to_json(getattr(value, field.name))
            for field in fields(value)
            if not (field.default is None and getattr(value, field.name) is None)
        }
    if isinstance(value, np.ndarray):
        return to_json(value.tolist())
    if isinstance(value, Mapping):
        return {key: to_json(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(entry) for entry in value]
    if isinstance(value, Enum):
        return value.value
    return None if isinstance(value, float) and not math.isfinite(value) else value


def from_json(kind: type[Record], value: Any, path: Path | str, remedy: str) -> Record:
    """The record that JSON values describe.

    Args:
        kind: the record's class.
        value: the values.
        path: of the file, or what else they are called in messages.
        remedy: what to do about a damaged file.

    Raises:
        ResultsError: they describe none; with the field and what is wrong with it.
    """
    try:
        record: Record = _read(kind, value, "")
    except _Damaged as error:
        place = f" at {error.where}" if error.where else ""
        raise ResultsError(f"{path}: damaged{place}: {error.problem}; {remedy}") from error
    return record


def read_record(kind: type[Record], path: Path, remedy: str) -> Record:
    """Read a file with one record; see `from_json`.

    Raises:
        ResultsError: it cannot be read or is damaged.
    """
    return record_of(kind, read_bytes(path), path, remedy)


def record_of(kind: type[Record], content: bytes, path: Path | str, remedy: str) -> Record:
    """The record in a file's content; see `read_record`."""
    return from_json(kind, json_of(content, path, remedy), path, remedy)


def _read(kind: Any, value: Any, where: str) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin is Annotated:
        return _annotated(arguments[0], arguments[1:], value, where)
    if origin in (Union, UnionType):
        if value is None:
            return None
        (wanted,) = (choice for choice in arguments if choice is not type(None))
        return _read(wanted, value, where)
    if origin is Literal:
        return _one_of(arguments, value, where)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return kind(_one_of(tuple(member.value for member in kind), value, where))
    if origin is tuple:
        return _tuple(arguments, value, where)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _mapping(arguments[1], value, where)
    if is_dataclass(kind):
        return _record(kind, value, where)
    return _plain(kind, value, where)


def _one_of(allowed: tuple[str, ...], value: Any, where: str) -> Any:
    if value not in allowed or isinstance(value, bool):
        raise _Damaged(where, f"found {_short(value)}; allowed is {' or '.join(allowed)}")
    return value


def _plain(kind: Any, value: Any, where: str) -> Any:
    if kind is float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise _Damaged(where, f"found {_short(value)}, no number")
        if not abs(value) < math.inf or (isinstance(value, int) and abs(value) > 2**1023):
            raise _Damaged(where, "found a number that is not finite")
        return float(value)
    names = {int: "whole number", str: "text", bool: "true or false"}
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise _Damaged(where, f"found {_short(value)}, no {names[kind]}")
    if kind is str and not value.isascii():
        try:
            value.encode()
        except UnicodeEncodeError as error:
            raise _Damaged(where, "found a text with half a letter (a lone surrogate)") from error
    return value


def _annotated(kind: Any, marks: tuple[Any, ...], value: Any, where: str) -> Any:
    may_miss = any(isinstance(mark, Missing) for mark in marks)
    for mark in marks:
        if isinstance(mark, Shape):
            return _array(mark, value, where, may_miss)
    if may_miss and value is None:
        return math.nan
    found = _read(kind, value, where)
    for mark in marks:
        if isinstance(mark, Range) and not mark.low <= found <= mark.high:
            raise _Damaged(where, f"found {found!r}; allowed is {mark.low} to {mark.high}")
    return found


def _array(shape: Shape, value: Any, where: str, may_miss: bool) -> np.ndarray[Any, Any]:
    """A read-only array of numbers, finite unless they may miss."""
    expected = " x ".join("any" if size is None else str(size) for size in shape.sizes)
    try:
        found = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise _Damaged(where, f"no numbers of shape {expected}") from error
    if found.size == 0 and shape.sizes[0] is None:
        found = found.reshape(0, *(size or 0 for size in shape.sizes[1:]))
    fits = len(found.shape) == len(shape.sizes) and all(
        wanted in (None, size) for size, wanted in zip(found.shape, shape.sizes, strict=True)
    )
    if not fits:
        raise _Damaged(where, f"found an array of shape {found.shape}; allowed is {expected}")
    if np.isinf(found).any() or (np.isnan(found).any() and not may_miss):
        raise _Damaged(where, "holds numbers that are missing or not finite")
    numbers = found if shape.kind is float else found.astype(shape.kind)
    if not may_miss and (numbers != found).any():
        raise _Damaged(where, "holds numbers that are not whole, or neither true nor false")
    numbers.setflags(write=False)
    return numbers


def _tuple(kinds: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise _Damaged(where, f"found {_short(value)}, no list")
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if len(value) != len(kinds):
        raise _Damaged(where, f"found {len(value)} entries; allowed are {len(kinds)}")
    return tuple(
        _read(kind, entry, f"{where}[{k}]")
        for k, (kind, entry) in enumerate(zip(kinds, value, strict=True))
    )


def _mapping(kind: Any, value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise _Damaged(where, f"found {_short(value)}, no object")
    return {
        _plain(str, key, where): _read(kind, entry, f"{where}.{key}".removeprefix("."))
        for key, entry in value.items()
    }


def _record(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise _Damaged(where, f"found {_short(value)}, no object")
    read = {}
    for field in fields(kind):
        place = f"{where}.{field.name}".removeprefix(".")
        if field.name in value:
            read[field.name] = _read(_hints(kind)[field.name], value[field.name], place)
        elif field.default is MISSING and field.default_factory is MISSING:
            raise _Damaged(place, "is missing")
    try:
        return kind(**read)
    except (ValueError, DualArmError) as error:
        raise _Damaged(where, str(error)) from error


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _short(value: object) -> str:
    text = "null" if value is None else ascii(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
