"""The paper's experiment: two GoFa 12 carry a box from one board of a rack to another."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.resources import as_file, files

from studies.program import run_program
from studies.run import main as run


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study on the rack cell; returns the exit code."""
    with as_file(files("studies")) as folder:
        return run(arguments, folder / "workcells" / "rack.toml", "python -m studies.rack")


if __name__ == "__main__":
    sys.exit(run_program(main))
