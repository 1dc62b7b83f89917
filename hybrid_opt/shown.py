"""Objects that show themselves in a terminal and in a notebook.

How they look is told in `hybrid_opt.display`, whose rooms know the objects. The objects know this
module only, the one place that leads from them to their display, when they are shown.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


class Shown:
    """An object for which `hybrid_opt.display.objects` has a text and a page."""

    def __repr__(self) -> str:
        return str(display("objects").text_of(self))

    def _repr_html_(self) -> str:
        return str(display("objects").html_of(self))


def display(room: str) -> Any:
    """A module of `hybrid_opt.display`, imported when it is needed first."""
    return import_module(f"hybrid_opt.display.{room}")
