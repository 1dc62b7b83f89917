"""Objects that show themselves in a terminal and in a notebook.

They know this module only, and not how they look: the front door (`hybrid_opt`) tells where the
rooms are that do, which are imported when an object is shown.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

_rooms: list[Callable[[str], Any]] = []


def shown_by(room: Callable[[str], Any]) -> None:
    """Tell what gives the module of a name that shows objects: 'objects' as text and HTML, 'view'
    in three dimensions."""
    _rooms[:] = [room]


def display(room: str) -> Any:
    """The module of that name."""
    return _rooms[0](room)


class Displayable:
    """An object that has a text and a page."""

    def __repr__(self) -> str:
        return str(display("objects").text_of(self))

    def _repr_html_(self) -> str:
        return str(display("objects").html_of(self))


class Page(Protocol):
    """A self-contained page, which a notebook shows in a cell."""

    def page(self) -> str:
        """Its text."""

    def save(self, path: str | Path) -> None:
        """Write it into a file."""

    def _repr_html_(self) -> str: ...
