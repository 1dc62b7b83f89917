"""Calibrate a cell from its own runs: `python -m studies.calibrate CELL RUN... --out CELL2`.

From recordings (MCAP, rosbag2, CSV, RTDE's as well) with a side file in TOML each it
tells the sensors' offsets and crosstalk, mass, centre of mass, a bracket of the friction, how
forces follow their commands, how the pads drift; and writes the workcell file with that in it. It
names what is wrong with a run, or missing (docs/calibration.md). Exit code 1 where something is
refused.
"""

from __future__ import annotations

import sys
from pathlib import Path

from studies.options import add
from studies.program import Parser, Program, later, run_program


def _add_options(parser: Parser) -> None:
    add(parser, "WORKCELL")
    parser.add_argument(
        "runs", metavar="RUN", type=Path, nargs="+", help="a recording, RUN.toml beside it"
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        help="the workcell file to write (default: none is written)",
    )
    add(parser, "--json")


main = Program("calibrate", __doc__, _add_options, later("studies.programs.calibration.calibrate"))


if __name__ == "__main__":
    sys.exit(run_program(main))
