"""Conversion of nested values of TOML, YAML and JSON to checked records.

The annotations of a record's fields state the allowed values. `checked` supports `bool`, `int`,
`float`, `str`, `Literal`, enumerations, `tuple`, `Mapping[str, ...]`, `... | None`, dataclasses,
`Any` for values that are only passed on, and `Annotated` with the marks of `symbolic.array`. Values
that a record's `__post_init__` refuses are wrong too. (msgspec is not used: it supports neither
numbers that may be missing nor shapes of arrays.)

All problems are collected; reading does not stop at the first. A wrong value is recorded, and a
harmless placeholder of its kind takes its place. Placeholders never escape: the caller raises an
error if `Problems.found` is not empty. `FirstProblem` raises at the first problem.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from types import UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

from symbolic import safe_io
from symbolic.array import AllowMissing, Array, BroadcastScalar, Range, Shape, TextPattern
from symbolic.errors import DualArmError, OutsideError
from symbolic.records import Body, Box, Cylinder, Mesh, Sphere
from symbolic.records import quantities as quantity
from symbolic.records.poses import pose_matrix, read_only
from symbolic.records.problems import MAX_NAME_LENGTH, Label, Problems, shown, suggestion

MOST_UNKNOWN = 10
"""Largest number of unknown keys of one table that are reported."""

ANY_NUMBER = Range(-math.inf, math.inf)

Record = TypeVar("Record")

_REQUIRED: Any = object()


class TableReader:
    """Reader of one table of a document, key by key.

    Args:
        data: content of the table.
        path: key path of the table, '' for the top level.
        problems: collector of problems.
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
        """Return the full key path of a key."""
        return f"{self.path}.{key}" if self.path else key

    def add(self, key: str, text: str) -> None:
        """Record a problem with the value of a key; `text` says what is wrong and what is
        allowed."""
        self.problems.add(self.at(key), text)

    def clean(self, *keys: str) -> bool:
        """Return True if no problem is recorded for the values of these keys."""
        return self.problems.clean(*map(self.at, keys))

    def raw(self, key: str, default: Any = _REQUIRED) -> Any:
        """Return the value of a key as it is in the document, `default` for a missing key.

        Without a default, record a problem for a missing key and return None.
        """
        self._known.add(key)
        if key in self._data:
            return self._data[key]
        if default is _REQUIRED:
            self.add(key, "is missing")
            return None
        return default

    def has(self, key: str) -> bool:
        """Return True if an optional key is present. The key then counts as read, so that `close`
        does not report it as unknown."""
        return self.raw(key, None) is not None

    def refuse(self, key: str, others: Sequence[str]) -> None:
        """Record a problem if a key is present together with another key.

        Args:
            key: the key.
            others: keys that may not be present beside it.
        """
        beside = " and ".join(repr(other) for other in others if other in self._data)
        self._known.update(others)
        if beside:
            self.add(key, f"found beside {beside}; allowed is one or the other")

    def close(self) -> None:
        """Record every key of the table that was not read before as a problem: an unknown key."""
        unknown = [key for key in self._data if key not in self._known]
        allowed = ", ".join(sorted(self._known))
        for key in unknown[:MOST_UNKNOWN]:
            hint = suggestion(key, self._known - set(self._data))
            name = key if key.isprintable() and len(key) <= MAX_NAME_LENGTH else shown(key)
            self.add(name, f"unknown key{hint or f'; allowed keys are {allowed}'}")
        if len(unknown) > MOST_UNKNOWN:
            self.problems.add(
                self.path or "file", f"{len(unknown) - MOST_UNKNOWN} further unknown keys"
            )

    def value(self, key: str, kind: Any, default: Any = _REQUIRED) -> Any:
        """Read a value, checked and converted by `checked`; after a problem a valid placeholder.

        Args:
            key: key of the value.
            kind: annotation that the value has to satisfy.
            default: value for a missing key, returned unchecked; without it a missing key is a
                problem.
        """
        value = self.raw(key, default)
        if key in self._data and not (value is None and default is not _REQUIRED):
            return checked(kind, value, self.at(key), self.problems)
        return _stand_in(kind) if default is _REQUIRED else default

    def number(self, key: str, allowed: Range, default: float | None = None) -> float:
        """Read the number at a key, which has to be in the range `allowed`. A missing key gives
        `default`; without a default it is a problem. After a problem return 1."""
        found: float = self.value(
            key, Annotated[float, allowed], _REQUIRED if default is None else default
        )
        return found

    def vector(
        self,
        key: str,
        allowed: Sequence[Range],
        default: Sequence[float] | Array | None = None,
        filling: bool = False,
    ) -> Array:
        """Read an array of numbers; after a problem a valid placeholder.

        Args:
            key: key of the array.
            allowed: range of each of the n entries.
            default: the array for a missing key; None if the key is required.
            filling: True if the file may state one number for all entries.

        Returns:
            Array (n,), read-only.
        """
        value = self.raw(key, _REQUIRED if default is None else list(default))
        if value is None and (default is not None or key not in self):
            return read_only(np.ones(len(allowed)) if default is None else default)
        return checked_vector(value, allowed, self.at(key), self.problems, filling)

    def integer(self, key: str, low: int, high: int, default: int) -> int:
        """Read the integer at a key, which has to be from `low` to `high`; `default` if the key is
        missing, `low` after a problem."""
        found: int = self.value(key, Annotated[int, Range(low, high)], default)
        return found

    def choice(self, key: str, allowed: Sequence[str], default: str | None = None) -> str:
        """Read the text at a key, one of the words `allowed`; '' after a problem, `default` if it
        is missing. Without a default a missing key is a problem.
        """
        usual = _REQUIRED if default is None else default
        return str(self.value(key, Literal[tuple(allowed)], usual))

    def text(self, key: str, default: str | None = None) -> str:
        """Read the printable, non-empty, single-line text at a key; '' after a problem, `default`
        if it is missing. Without a default a missing key is a problem.
        """
        return str(self.value(key, Label, _REQUIRED if default is None else default))

    def texts(self, key: str, meaning: str) -> tuple[str, ...]:
        """Read an array of texts; () if it is missing or after a problem.

        Args:
            key: key of the array.
            meaning: description of the texts, for messages.
        """
        value = self.raw(key, [])
        if isinstance(value, list) and all(isinstance(entry, str) and entry for entry in value):
            return tuple(value)
        self.add(key, f"found {shown(value)}; allowed is an array of texts, {meaning}")
        return ()

    def table(self, key: str, default: Mapping[str, Any] | None = None) -> TableReader:
        """Read a sub-table.

        After a problem return an empty reader, which reports nothing further.

        Args:
            key: key of the sub-table.
            default: content for a missing key; None if the key is required.
        """
        value = self.raw(key, _REQUIRED if default is None else default)
        if value is not None and isinstance(value, Mapping):
            return TableReader(value, self.at(key), self.problems)
        if value is not None:
            self.add(key, f"found {shown(value)}; allowed is a table")
        return TableReader({}, self.at(key), Problems())

    def tables(self, key: str, exactly: int | None = None) -> list[TableReader]:
        """Read an array of tables; an empty list after a problem with its type.

        Args:
            key: key of the array.
            exactly: required number of tables; another number is a problem, and no more than these
                are returned. None for an optional array of any length.
        """
        value = self.raw(key, [] if exactly is None else _REQUIRED)
        if value is None:
            return []
        if not isinstance(value, list) or not all(isinstance(entry, Mapping) for entry in value):
            heading = re.sub(r"\[\d+\]", "", self.at(key))
            self.add(key, f"found {shown(value)}; allowed is an array of tables, [[{heading}]]")
            return []
        if exactly is not None and len(value) != exactly:
            self.add(key, f"found {len(value)} tables; allowed are exactly {exactly}")
        return [
            TableReader(entry, f"{self.at(key)}[{index}]", self.problems)
            for index, entry in enumerate(value[:exactly])
        ]

    def record(self, kind: type[Record], **given: Any) -> Record:
        """Read a record whose fields are the keys of the table.

        Args:
            kind: class of the record.
            given: values of fields that are not read from the table.

        Raises:
            ValueError: the record's own check refuses the values.
        """
        found, own_hints = dict(given), _hints(cast("Any", kind))
        for field in fields(kind):  # type: ignore[arg-type]
            if field.name in given:
                continue
            own = field.default is MISSING and field.default_factory is MISSING
            if own or field.name in self._data:
                found[field.name] = self.value(field.name, own_hints[field.name])
            self._known.add(field.name)
        if not self.problems.open:
            self.close()
        try:
            return kind(**found)
        except (ValueError, DualArmError) as error:
            raise ValueError(f"{self.path}: {error}") from error


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


# --- values as annotations say ---


def checked(kind: Any, value: Any, path: str, problems: Problems) -> Any:
    """Return a value if it satisfies an annotation; otherwise record a problem and return a
    placeholder.

    Args:
        kind: the annotation.
        value: the value in the document.
        path: key path of the value.
        problems: collector of problems.
    """
    marks: tuple[Any, ...] = ()
    if get_origin(kind) is Annotated:
        kind, *marks = get_args(kind)  # type: ignore[assignment]
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, UnionType):
        (kind,) = (choice for choice in arguments if choice is not type(None))
        return None if value is None else checked(kind, value, path, problems)
    problem = ""
    shape = next((mark for mark in marks if isinstance(mark, Shape)), None)
    if shape is not None:
        return _array(shape, marks, value, path, problems)
    if isinstance(kind, type) and is_dataclass(kind):
        if isinstance(value, Mapping):
            return TableReader(value, path, problems).record(kind)
        problem = "allowed is a table"
    elif origin is tuple:
        kinds = arguments
        if isinstance(value, list):
            kinds = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
            problem = "" if len(value) == len(kinds) else f"allowed are {len(kinds)} entries"
        else:
            problem = "allowed is an array"
        if not problem:
            return tuple(
                checked(each, entry, f"{path}[{k}]", problems)
                for k, (each, entry) in enumerate(zip(kinds, value, strict=True))
            )
    elif isinstance(origin, type) and issubclass(origin, Mapping):
        if isinstance(value, Mapping):
            return {
                checked(str, key, path, problems): checked(
                    arguments[1], entry, f"{path}.{key}".removeprefix("."), problems
                )
                for key, entry in value.items()
            }
        problem = "allowed is a table"
    else:
        if value is None and any(isinstance(mark, AllowMissing) for mark in marks):
            return math.nan
        return _single(kind, marks, value, path, problems)
    problems.add(path, f"found {shown(value)}; {problem}")
    return _stand_in(kind)


def _single(kind: Any, marks: Sequence[Any], value: Any, path: str, problems: Problems) -> Any:
    """Return a value that has to be a number, a text, one of some words, or a boolean; after a
    problem a valid placeholder.

    Args:
        kind: type that is allowed.
        marks: further annotations, such as a `Range`.
        value: the value in the document.
        path: key path of the value.
        problems: collector of problems.
    """
    ranges = [mark for mark in marks if isinstance(mark, Range)]
    if kind is float:
        return checked_number(value, ranges[0] if ranges else ANY_NUMBER, path, problems)
    choices: tuple[Any, ...] = ()
    if isinstance(kind, type) and issubclass(kind, Enum):
        choices = tuple(member.value for member in kind)
    elif get_origin(kind) is Literal:
        choices = get_args(kind)
    if choices:
        if value in choices and not isinstance(value, bool):
            return kind(value) if isinstance(kind, type) else value
        hint = suggestion(value, choices) if isinstance(value, str) else ""
        problem = f"allowed is one of {', '.join(map(repr, choices))}{hint}"
    elif kind is bool:
        problem = "" if isinstance(value, bool) else "allowed is true or false"
    elif kind is int:
        low, high = (ranges[0].low, ranges[0].high) if ranges else (-math.inf, math.inf)
        is_whole = isinstance(value, int) and not isinstance(value, bool)
        fits = is_whole and low <= value <= high
        span = f" {low} to {high}" if ranges else ""
        problem = "" if fits else f"allowed is a whole number{span}"
    else:
        forms = [mark.problem(value) for mark in marks if isinstance(mark, TextPattern)]
        problem = "".join(forms) if isinstance(value, str) or forms else "allowed is a text"
    if not problem:
        return value
    problems.add(path, f"found {shown(value)}; {problem}")
    return _stand_in(kind, marks)


def _stand_in(kind: Any, marks: Sequence[Any] = ()) -> Any:
    """Return a valid placeholder for a wrong or missing value.

    Args:
        kind: type of the value.
        marks: further annotations of the type, such as a `Range`.
    """
    if get_origin(kind) is Annotated:
        kind, *marks = get_args(kind)
    for mark in marks:
        if isinstance(mark, Shape):
            return read_only(np.ones([size or 0 for size in mark.sizes]))
    if kind is int:
        return next((mark.low for mark in marks if isinstance(mark, Range)), 0)
    origin = get_origin(kind)
    if origin is tuple:
        return ()
    simple = {float: 1.0, bool: False, str: ""}
    return "" if origin is Literal else simple.get(kind)


def checked_number(value: Any, allowed: Range, path: str, problems: Problems) -> float:
    """Return a value as a finite float in a range; otherwise record a problem and return a
    placeholder.

    Args:
        value: the value in the document.
        allowed: the range.
        path: key path of the value.
        problems: collector of problems.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        problems.add(path, f"found {shown(value)}; allowed is a number, {allowed.allowed()}")
        return 1.0
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not allowed.contains(number):
        problems.add(
            path, f"found {number:.9g}; allowed is {allowed.allowed()}{allowed.suspicion(number)}"
        )
        return 1.0
    return number


def checked_vector(
    value: Any, allowed: Sequence[Range], path: str, problems: Problems, filling: bool = False
) -> Array:
    """Return a value as a read-only array (n,); otherwise record problems and return a placeholder.

    Args:
        value: the value in the document.
        allowed: ranges of the n entries.
        path: key path of the value.
        problems: collector of problems.
        filling: True if one number may stand for all entries.
    """
    if filling and not isinstance(value, list):
        return read_only(np.full(len(allowed), checked_number(value, allowed[0], path, problems)))
    if not isinstance(value, list) or len(value) != len(allowed):
        problems.add(path, f"found {shown(value)}; allowed is an array of {len(allowed)} numbers")
        return read_only(np.ones(len(allowed)))
    return read_only(
        [
            checked_number(entry, each, f"{path}[{index}]", problems)
            for index, (entry, each) in enumerate(zip(value, allowed, strict=True))
        ]
    )


def _array(
    shape: Shape, marks: Sequence[Any], value: Any, path: str, problems: Problems
) -> np.ndarray[Any, Any]:
    """Return a value as a read-only array of finite numbers; after a problem a valid placeholder.

    NaN is accepted if the annotations allow missing entries.

    Args:
        shape: shape that is allowed.
        marks: further annotations, such as a `Range`.
        value: the value in the document.
        path: key path of the value.
        problems: collector of problems.
    """
    for mark in marks:
        if isinstance(mark, Range):
            filling = any(isinstance(other, BroadcastScalar) for other in marks)
            return checked_vector(value, (mark,) * (shape.sizes[0] or 0), path, problems, filling)
    may_miss = any(isinstance(mark, AllowMissing) for mark in marks)
    expected = " x ".join("any" if size is None else str(size) for size in shape.sizes)
    try:
        found = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        problems.add(path, f"no numbers of shape {expected}")
        return np.asarray(_stand_in(Any, (shape,)))
    if found.size == 0 and shape.sizes[0] is None:
        found = found.reshape(0, *(size or 0 for size in shape.sizes[1:]))
    fits = len(found.shape) == len(shape.sizes) and all(
        wanted in (None, size) for size, wanted in zip(found.shape, shape.sizes, strict=True)
    )
    with np.errstate(invalid="ignore"):
        numbers = found if shape.kind is float else found.astype(shape.kind)
    problem = ""
    if not fits:
        problem = f"found an array of shape {found.shape}; allowed is {expected}"
    elif np.isinf(found).any() or (np.isnan(found).any() and not may_miss):
        problem = "holds numbers that are missing or not finite"
    elif not may_miss and (numbers != found).any():
        problem = "holds numbers that are not whole, or neither true nor false"
    if problem:
        problems.add(path, problem)
        return np.asarray(_stand_in(Any, (shape,)))
    numbers.setflags(write=False)
    return numbers


# --- poses, bodies, files, inertias ---


SHAPES = {"box": Box, "cylinder": Cylinder, "sphere": Sphere, "mesh": Mesh}
"""Classes of a body's shape by the kind in a file."""


def read_pose(table: TableReader, key: str) -> Array:
    """Read a pose (4, 4), read-only, from the sub-table at `key`. Its keys xyz [m] and rpy [rad]
    are zero by default."""
    inner = table.table(key)
    pose = _xyz_rpy(inner)
    inner.close()
    return pose


def _xyz_rpy(table: TableReader) -> Array:
    xyz = table.vector("xyz", (quantity.POSITION,) * 3, default=(0.0, 0.0, 0.0))
    rpy = table.vector("rpy", (quantity.ANGLE,) * 3, default=(0.0, 0.0, 0.0))
    return read_only(pose_matrix(xyz, rpy))


def read_body(table: TableReader, folder: Path) -> Body:
    """Read a named collision shape with its pose.

    Args:
        table: table of the body.
        folder: folder to which the path of a mesh is relative.
    """
    name, pose = table.text("name"), _xyz_rpy(table)
    kind = table.choice("kind", tuple(SHAPES))
    if not kind:  # without a kind no key is known
        return Body(name, Sphere(1.0), pose)
    files = {"path": read_file(table, "path", folder, safe_io.MESH_BYTES)} if kind == "mesh" else {}
    return Body(name, table.record(SHAPES[kind], **files), pose)


def read_file(
    table: TableReader, key: str, folder: Path, most: int, at: Path | None = None
) -> Path:
    """Read the name of a file, check that the file can be read, and return its absolute path. After
    a problem return `folder`.

    Args:
        table, key: table and key that name the file.
        folder: folder to which the path is relative.
        most: largest allowed size [bytes].
        at: path of the file if its name is an address; None if its name is a path.
    """
    value = table.raw(key)
    if value is None:
        return folder
    if not isinstance(value, str) or not value or "\0" in value:
        table.add(key, f"found {shown(value)}; allowed is the path of a file")
        return folder
    try:
        path = safe_io.resolved(at or folder / value)
        safe_io.require(path, most)
    except OutsideError as error:
        hint = "" if at else "; paths are relative to the workcell file"
        table.add(key, f"found {shown(value)}, which {error}{hint}")
        return folder
    return path


def read_inertia(table: TableReader, bound: float, allowed: str = "a 3 x 3 matrix") -> Array:
    """Read the (3, 3) matrix of the key `inertia` [kg m^2], which has to be the inertia of a rigid
    body. After a problem return a matrix that need not be one.

    Args:
        table: table with the key.
        bound: upper bound of the principal moments [kg m^2].
        allowed: description of the allowed values, for messages.
    """
    value = table.raw("inertia")
    path, problems = table.at("inertia"), table.problems
    if not isinstance(value, list) or len(value) != 3:
        problems.add(path, f"found {shown(value)}; allowed is {allowed}")
        return read_only(np.eye(3))
    rows = [
        checked_vector(row, (quantity.INERTIA,) * 3, f"{path}[{index}]", problems)
        for index, row in enumerate(value)
    ]
    inertia = read_only(np.stack(rows))
    if problems.clean(path) and (problem := inertia_problem(inertia, bound)):
        problems.add(path, problem)
    return inertia


def inertia_problem(inertia: Array, bound: float) -> str:
    """Return why a matrix is not the inertia of a rigid body; '' if it is.

    Args:
        inertia: (3, 3) [kg m^2].
        bound: upper bound of the principal moments [kg m^2].
    """
    scale = float(np.abs(inertia).max())
    if np.abs(inertia - inertia.T).max() > 1e-9 * scale:
        return "found a matrix that is not symmetric; an inertia is symmetric"
    moments = np.linalg.eigvalsh(inertia)
    why = ""
    if moments[0] <= 1e-9 * scale:
        why = "which is singular or not positive definite; allowed are only positive ones"
    elif moments[2] > (moments[0] + moments[1]) * (1 + 1e-9):
        why = "but each moment of a body is at most the sum of the other two"
    elif moments[2] > bound:
        why = (
            f"but mass inside the box gives at most {bound:.6g} (are the units kg m^2, about the "
            "centre of mass?)"
        )
    listed = ", ".join(f"{moment:.6g}" for moment in moments)
    return f"found principal moments {listed} kg m^2, {why}" if why else ""
