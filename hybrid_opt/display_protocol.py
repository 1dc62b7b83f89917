"""Protocol of objects with a display in a terminal and in a notebook.

The modules of `hybrid_opt.display` define how objects look; they are imported when an object is
shown.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, Protocol


def display(room: str) -> Any:
    """Import a module that displays objects: 'objects' as text and HTML, 'scene' in three
    dimensions."""
    return import_module(f"hybrid_opt.display.{room}")


class Displayable:
    """An object that has a text and a page."""

    def __repr__(self) -> str:
        return str(display("objects").text_of(self))

    def _repr_html_(self) -> str:
        return str(display("objects").html_of(self))


class Page(Protocol):
    """A self-contained page, which a notebook shows in a cell."""

    def page(self) -> str:
        """Return its text."""

    def save(self, path: str | Path) -> None:
        """Write it into a file."""

    def _repr_html_(self) -> str: ...
