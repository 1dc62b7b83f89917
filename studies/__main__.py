"""List the programs: `python -m studies`."""

from __future__ import annotations

import ast
import sys
from collections.abc import Sequence
from pathlib import Path

from studies.program import BAD_INPUT, run_program
from symbolic.records.problems import suggestion

START = "sys.exit(run_program(main))"
"""What every program ends with."""


def programs() -> dict[str, str]:
    """Every program's name, as `python -m` takes it, and what it says of itself first."""
    folder = Path(__file__).parent
    found = {}
    for path in sorted([*folder.glob("*.py"), *folder.glob("*/__main__.py")]):
        text = path.read_text("utf-8")
        if (path.stem == "__main__" and path.parent == folder) or not text.rstrip().endswith(START):
            continue
        parts = path.relative_to(folder.parent).with_suffix("").parts
        name = ".".join(part for part in parts if part != "__main__")
        found[name] = (ast.get_docstring(ast.parse(text)) or "").partition("\n\n")[0]
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    known = programs()
    given = sys.argv[1:] if arguments is None else arguments
    for word in (word for word in given if word not in ("-h", "--help")):
        meant = suggestion(f"studies.{word}", known)
        print(f"python -m studies: {word} is no option of it{meant}", file=sys.stderr)
        return BAD_INPUT
    width = max(map(len, known))
    print("Programs; each explains itself with --help.\n")
    for name, text in known.items():
        # What it is called by stands in front.
        print(
            f"python -m {name:<{width}}  {' '.join(text.partition(': `')[0].split()).rstrip('.')}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(run_program(main))
