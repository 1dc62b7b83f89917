"""The paper's experiment: two GoFa 12 carry a box from one board of a rack to another."""

from __future__ import annotations

import argparse
from functools import partial
from importlib.resources import as_file, files

from studies.program import Program
from studies.run import DESCRIPTION, FURTHER, add_options, complete, study_of


def _run(options: argparse.Namespace) -> int:
    with as_file(files("studies")) as folder:
        return study_of(folder / "workcells" / "rack.toml", options, with_paper=True)


main = Program(
    "rack",
    DESCRIPTION,
    partial(add_options, output="results/rack"),
    _run,
    complete=partial(complete, name="rack"),
    further=FURTHER,
)


if __name__ == "__main__":
    main.start()
