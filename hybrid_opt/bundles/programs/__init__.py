"""Programs that are copied into bundles as they are; they need nothing of this project."""

from __future__ import annotations

from importlib.resources import files


def program(name: str) -> str:
    """The text of a program as it stands beside the others in a bundle."""
    text = (files(__name__) / name).read_text("utf-8")
    return text.replace(f"from {__name__}.", "from ")
