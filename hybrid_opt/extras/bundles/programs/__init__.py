"""Files that are copied into bundles as they are, or with a job's values in them; what is copied
needs nothing of this project."""

from __future__ import annotations

from importlib.resources import files
from string import Template


def program(name: str) -> str:
    """Return the text of a program that is copied into bundles, with imports changed to its folder
    there.

    Args:
        name: file name of the program.
    """
    text = (files(__name__) / name).read_text("utf-8")
    return text.replace(f"from {__name__}.", "from ")


def filled(name: str, **values: object) -> str:
    """Return the text of a template file, in which each `$name` is replaced by the value of that
    name.

    Args:
        name: path of the template.

    Raises:
        KeyError: a value is missing.
    """
    return Template(program(name)).substitute(values)


SHARED = ("bring_up.py", "carry_job.py", "carry_machine.py")
"""Programs in every bundle whose arms are supervised by a program."""


def programs(name: str) -> dict[str, str]:
    """Return a program that runs a job, and the modules that it imports.

    Args:
        name: file name of the program.

    Returns:
        Text of each file, by its path in the bundle.
    """
    return {each: program(each) for each in (name, *SHARED)}
