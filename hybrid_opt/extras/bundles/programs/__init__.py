"""Files that are copied into bundles as they are, or with a job's values in them; what is copied
needs nothing of this project."""

from __future__ import annotations

from importlib.resources import files
from string import Template


def program(name: str) -> str:
    """Return the text of a program as it stands beside the others in a bundle."""
    text = (files(__name__) / name).read_text("utf-8")
    return text.replace(f"from {__name__}.", "from ")


def filled(name: str, **values: object) -> str:
    """Return the text of a file with values for its $names.

    Raises:
        KeyError: a value is missing.
    """
    return Template(program(name)).substitute(values)
