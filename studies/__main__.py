"""All programs: `dual-arm-carry PROGRAM ...`, or `python -m studies.PROGRAM ...`."""

from __future__ import annotations

import ast
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from pathlib import Path

from studies.program import BAD_INPUT, print_version, run_program
from symbolic.records.problems import suggestion

COMMAND = "dual-arm-carry"
"""The command that `pyproject.toml` installs."""

START = "main.start()"
"""Last line of the source file of every program, by which `programs` finds them."""


def programs() -> dict[str, tuple[str, str]]:
    """Return for each program, by name, the full name of its module and the first sentence of its
    description."""
    folder = Path(__file__).parent
    found = {}
    doors = ("*.py", "*/*.py", "*/*/__main__.py")
    for path in sorted(path for door in doors for path in folder.glob(door)):
        text = path.read_text("utf-8")
        if not text.rstrip().endswith(START):
            continue
        parts = path.relative_to(folder).with_suffix("").parts
        name = ".".join(part for part in parts if part != "__main__")
        said = (ast.get_docstring(ast.parse(text)) or "").partition("\n\n")[0]
        # The sentence ends before the command.
        told = " ".join(said.partition(": `")[0].split()).rstrip(".")
        found[name] = (".".join(("studies", *parts)), told)
    return found


def main(arguments: Sequence[str] | None = None, called: str = "python -m studies") -> int:
    """Run the program named by the first argument, or list all programs without one. Return the
    exit code.

    Args:
        arguments: the arguments of the command line, None for those of this process.
        called: name under which this command was called, for messages.
    """
    known = programs()
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given[:1] == ["--version"]:
        print_version()
        return 0
    if given[:1] == ["help"]:  # of a program, or the list
        given = [*given[1:2], "--help"]
    if given and given[0] in known:
        module, _ = known[given[0]]
        code: int = import_module(module).main(given[1:], f"{called} {given[0]}")
        return code
    prefix = "" if called == COMMAND else "studies."
    for word in (word for word in given if word not in ("-h", "--help")):
        meant = suggestion(prefix + word, [prefix + name for name in known])
        print(f"{called}: {word} is no program of it{meant}", file=sys.stderr)
        return BAD_INPUT
    front, width = f"{called} " if called == COMMAND else "python -m studies.", max(map(len, known))
    print("Programs; each explains itself with --help. --version prints the version.\n")
    for name, (_, told) in known.items():
        print(f"{front}{name:<{width}}  {told}")
    return 0


def command() -> None:
    """Run the installed command `dual-arm-carry`, and end the process with its exit code."""
    sys.exit(run_program(partial(main, called=COMMAND)))


if __name__ == "__main__":
    sys.exit(run_program(main))
