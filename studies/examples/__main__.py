"""The examples, and the cells, problems and robots they read: `dual-arm-carry examples FOLDER`.

A notebook and numbered programs are copied to FOLDER/studies and run in FOLDER as they do in the
repository: `python studies/examples/01_evaluate.py`.
"""

from __future__ import annotations

import argparse
from importlib.resources import files
from pathlib import Path

from studies.options import OUTPUT_FOLDER
from studies.program import Parser, Program

SHIPPED = (
    "examples/[0-9]*.py",
    "examples/*.ipynb",
    "problems/*.toml",
    "robots/*.urdf",
    "workcells/*.toml",
)
"""What is copied, below `studies`."""


def _add_options(parser: Parser) -> None:
    parser.add_argument(
        "folder",
        metavar="FOLDER",
        type=OUTPUT_FOLDER,
        nargs="?",
        default=Path("."),
        help="a folder without a folder studies in it (default: this one)",
    )


def _copy(options: argparse.Namespace) -> int:
    from hybrid_opt.errors import ResultsError
    from hybrid_opt.store.files import write_atomically

    source, target = Path(str(files("studies"))), options.folder / "studies"
    if target.exists():
        raise ResultsError(f"{target}: exists already; name another folder", code="folder-in-use")
    found = [path for pattern in SHIPPED for path in sorted(source.glob(pattern))]
    for path in found:
        write_atomically(target / path.relative_to(source), path.read_bytes())
    print(f"{len(found)} files written to {target}")
    return 0


main = Program("examples", __doc__, _add_options, _copy)


if __name__ == "__main__":
    main.start()
