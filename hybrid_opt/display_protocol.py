"""Protocol of objects with a display in a terminal and in a notebook.

The modules of `hybrid_opt.display` define how objects look; they are imported when an object is
shown.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, Protocol


def display(module: str) -> Any:
    """Import one of the modules that display objects.

    Args:
        module: 'objects' for text and HTML, or 'scene' for three-dimensional views.
    """
    return import_module(f"hybrid_opt.display.{module}")


class Displayable:
    """Base class of objects that are shown as text in a terminal and as HTML in a notebook."""

    def __repr__(self) -> str:
        return str(display("objects").text_of(self))

    def _repr_html_(self) -> str:
        return str(display("objects").html_of(self))


class Page(Protocol):
    """A self-contained HTML page, which a notebook shows in a cell."""

    def page(self) -> str:
        """Return the HTML text of the page."""

    def save(self, path: str | Path) -> None:
        """Write the page to a file."""

    def _repr_html_(self) -> str: ...
