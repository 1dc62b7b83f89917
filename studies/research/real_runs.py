"""Real runs against the model: `python -m studies.research.real_runs --folder FOLDER`.

Reads the logs of two UR5e that squeeze boxes where you have fetched them, nothing of theirs comes
with this project; without `--folder` it says how to get them. For every run that is labelled it
tells what the model asks for beside what was measured, and what happened to the box
(docs/explanation/validation.md).
"""

from __future__ import annotations

import argparse

from studies.options import INPUT_FOLDER
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    parser.add_argument(
        "--folder", metavar="FOLDER", type=INPUT_FOLDER, help="of the repository that was fetched"
    )
    parser.add_argument(
        "--markdown", action="store_true", help="print the table as the documentation has it"
    )


def _run(options: argparse.Namespace) -> int:
    from studies.research import logged_carries

    if options.folder is None:
        print(f"get the logs, then name FOLDER by --folder\n{logged_carries.DOWNLOAD_COMMAND}")
        return 0
    table = logged_carries.table(options.folder)
    print(table.markdown() if options.markdown else table.text())
    return 0


main = Program("research.real_runs", __doc__, _add_options, _run)


if __name__ == "__main__":
    main.start()
