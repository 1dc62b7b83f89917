"""The pairs of links that an SRDF, MoveIt's companion of a URDF, takes out of checking."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from symbolic import outside
from symbolic.errors import OutsideError, UrdfError
from symbolic.robot.urdf_elements import Part, parse_elements
from symbolic.workcell.problems import Problems


@dataclass(frozen=True)
class DisabledPair:
    """Two links that are not checked against one another.

    Attributes:
        first, second: names of links.
        reason: the file's, e.g. 'Adjacent' or 'Never'; may be empty.
    """

    first: str
    second: str
    reason: str


def read_srdf(path: Path) -> tuple[DisabledPair, ...]:
    """The `disable_collisions` elements of an SRDF file, in its order; the rest is not read.

    Raises:
        UrdfError: the file cannot be read, is no XML, or one of these elements lacks a link.
    """
    try:
        return _parse(outside.read_bytes(path, outside.URDF_BYTES), path.name)
    except OutsideError as error:
        raise UrdfError(path.name, (str(error),)) from error


@lru_cache(maxsize=8)
def _parse(content: bytes, file: str) -> tuple[DisabledPair, ...]:
    problems = Problems()
    root = Part(parse_elements(outside.xml_text(content)), "", problems)
    pairs = tuple(
        DisabledPair(part.text("link1"), part.text("link2"), part.raw("reason") or "")
        for part in root.all("disable_collisions")
    )
    if problems.found:
        raise UrdfError(file, problems.messages())
    return pairs
