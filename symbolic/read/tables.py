"""Typed reading of nested tables, and the parts that several sections of a workcell file share.

Every problem is gathered, reading does not stop at the first. A getter that meets a problem records
it and returns a harmless stand-in, so that reading goes on. Stand-ins never escape: whoever reads
raises when `Problems.found` is not empty.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from symbolic import outside
from symbolic.array import Array
from symbolic.errors import OutsideError
from symbolic.records import Body, Box, Cylinder, Mesh, Shape, Sphere
from symbolic.records import quantities as quantity
from symbolic.records.poses import pose_matrix, read_only
from symbolic.records.problems import MAX_NAME_LENGTH, Problems, shown, suggestion, text_problem
from symbolic.records.quantities import Quantity

MOST_UNKNOWN = 10
"""Most unknown keys of one table that are reported."""


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

    def has(self, key: str) -> bool:
        """Whether an optional key is there; it is known either way."""
        return self.raw(key, None) is not None

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

    def flag(self, key: str) -> bool:
        """True or false; false where the key is missing, or after a problem."""
        value = self.raw(key, False)
        if not isinstance(value, bool):
            self.problems.add(self.at(key), f"found {shown(value)}; allowed is true or false")
            return False
        return value

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


# --- poses, bodies, files, inertias ---


SHAPE_KINDS = ("box", "cylinder", "sphere", "mesh")


def read_pose(table: Table, key: str) -> Array:
    """A transform from a sub-table {xyz, rpy}, both zero by default. Returns (4, 4), read-only."""
    inner = table.table(key)
    pose = _xyz_rpy(inner)
    inner.close()
    return pose


def _xyz_rpy(table: Table) -> Array:
    xyz = table.vector("xyz", (quantity.POSITION,) * 3, default=(0.0, 0.0, 0.0))
    rpy = table.vector("rpy", (quantity.ANGLE,) * 3, default=(0.0, 0.0, 0.0))
    return read_only(pose_matrix(xyz, rpy))


def read_body(table: Table, folder: Path) -> Body:
    """A named collision shape with its pose; mesh paths are relative to `folder`."""
    name = table.text("name")
    kind = table.choice("kind", SHAPE_KINDS)
    pose = _xyz_rpy(table)
    shape: Shape = Sphere(1.0)
    if kind == "box":
        shape = Box(table.vector("size", (quantity.SHAPE_SIZE,) * 3))
    elif kind == "cylinder":
        shape = Cylinder(
            table.number("radius", quantity.SHAPE_SIZE), table.number("length", quantity.SHAPE_SIZE)
        )
    elif kind == "sphere":
        shape = Sphere(table.number("radius", quantity.SHAPE_SIZE))
    elif kind == "mesh":
        path = read_file(table, "path", folder, outside.MESH_BYTES)
        scale = table.vector("scale", (quantity.SCALE,) * 3, (1.0, 1.0, 1.0), scalar_fills=True)
        shape = Mesh(path, scale)
    if kind:  # without a kind nobody can say which keys are unknown
        table.close()
    return Body(name, shape, pose)


def read_file(table: Table, key: str, folder: Path, most: int) -> Path:
    """The absolute path of a file named relative to `folder`; it has to be readable.

    Args:
        table, key: where it is named.
        folder: what its path is relative to.
        most: its largest size [bytes].
    """
    value = table.raw(key)
    if value is None:
        return folder
    if not isinstance(value, str) or not value or "\0" in value:
        table.problems.add(table.at(key), f"found {shown(value)}; allowed is the path of a file")
        return folder
    try:
        path = outside.resolved(folder / value)
        outside.require(path, most)
    except OutsideError as error:
        table.problems.add(
            table.at(key),
            f"found {shown(value)}, which {error}; paths are relative to the workcell file",
        )
        return folder
    return path


def read_inertia(table: Table, bound: float, allowed: str = "a 3 x 3 matrix") -> Array:
    """The (3, 3) matrix of the key `inertia` [kg m^2], a rigid body's.

    Args:
        table: where it stands.
        bound: no principal moment can exceed this [kg m^2].
        allowed: what a message says is allowed.
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
    if problems.clean(path):
        problem = inertia_problem(inertia, bound)
        if problem:
            problems.add(path, problem)
    return inertia


def inertia_problem(inertia: Array, bound: float) -> str:
    """Why a matrix is no inertia of a rigid body, or an empty string.

    Args:
        inertia: (3, 3) [kg m^2].
        bound: no principal moment can exceed this [kg m^2].
    """
    scale = float(np.abs(inertia).max())
    if np.abs(inertia - inertia.T).max() > 1e-9 * scale:
        return "found a matrix that is not symmetric; an inertia is symmetric"
    moments = np.linalg.eigvalsh(inertia)
    listed = ", ".join(f"{moment:.6g}" for moment in moments)
    if moments[0] <= 1e-9 * scale:
        return (
            f"found principal moments {listed} kg m^2, which is singular or not positive "
            "definite; allowed are only positive ones"
        )
    if moments[2] > (moments[0] + moments[1]) * (1 + 1e-9):
        return (
            f"found principal moments {listed} kg m^2; no body has them: each is at most the "
            "sum of the other two"
        )
    if moments[2] > bound:
        return (
            f"found a principal moment of {moments[2]:.6g} kg m^2; mass inside the box gives at "
            f"most {bound:.6g} kg m^2 (are the units kg m^2, about the centre of mass?)"
        )
    return ""
