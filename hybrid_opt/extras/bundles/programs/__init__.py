"""Files that are copied into bundles as they are, or with a job's values in them; what is copied
needs nothing of this project."""

from __future__ import annotations

from importlib.resources import files
from string import Template


def program(name: str) -> str:
    """Return the text of a program as it stands in a bundle: it imports its neighbours in the same
    folder by their plain names, not from this package."""
    text = (files(__name__) / name).read_text("utf-8")
    return text.replace(f"from {__name__}.", "from ")


def filled(name: str, **values: object) -> str:
    """Return the text of a template file with its placeholders `$NAME` replaced by values.

    Args:
        name: name of the file.
        values: value of each placeholder by NAME.

    Raises:
        KeyError: a value is missing.
    """
    return Template(program(name)).substitute(values)


SHARED = ("bring_up.py", "carry_job.py", "carry_machine.py", "carry_program.py")
"""Programs in every bundle whose arms are supervised by a program."""


def programs(name: str) -> dict[str, str]:
    """Return a program that runs a job, and the modules that it imports, as files of a bundle.

    Args:
        name: file name of the program.

    Returns:
        Text of each file, by its path in the bundle.
    """
    return {each: program(each) for each in (name, *SHARED)}
