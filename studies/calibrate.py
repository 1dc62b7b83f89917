"""Calibrate a cell from its own runs: `dual-arm-carry calibrate CELL RUN... --out CELL2`.

From recordings (MCAP, rosbag2, CSV, also RTDE's) with a side file in TOML each it estimates the
sensors' offsets and crosstalk, mass, centre of mass, a bracket of the friction, the tracking of
forces and the drift of the pads, and writes the workcell file with these values. It names faults of
runs and missing runs (docs/how-to/calibration.md). Exit code 1 if a recording is refused.
"""

from __future__ import annotations

import argparse
import json
import sys

from studies.options import OUTPUT_FILE, RECORDING, add
from studies.program import FAULT, Parser, Program, load_workcell
from symbolic.errors import SettingsError


def _add_options(parser: Parser) -> None:
    add(parser, "WORKCELL")
    parser.add_argument(
        "runs", metavar="RUN", type=RECORDING, nargs="+", help="a recording, RUN.toml beside it"
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=OUTPUT_FILE,
        help="the workcell file to write (default: none is written)",
    )
    add(parser, "--json")


def calibrate(options: argparse.Namespace) -> int:
    """Calibrate a cell from recorded runs, print the result, and write the calibrated workcell file
    if one is named. Return the exit code."""
    from hybrid_opt.extras.calibrating import evidence as found_in
    from hybrid_opt.extras.calibrating.recording import read_run
    from hybrid_opt.store.files import AGAIN, write_atomically

    output = options.out
    if output is not None and output.resolve() == options.workcell.resolve():
        raise SettingsError(f"{output} is the workcell itself; name another file by --out")
    workcell = load_workcell(options.workcell)
    evidence = found_in.calibrate(workcell, [read_run(path, workcell) for path in options.runs])
    print(json.dumps(evidence.document, indent=2) if options.json else evidence)
    if output is not None and evidence.changes:
        text = found_in.calibrated_file(workcell.source, evidence, output.resolve())
        write_atomically(output, text.encode(), AGAIN)
        if not options.json:
            print(f"written: {output}")
    elif output is not None:
        print(f"not written: {output}, because the runs show nothing for it", file=sys.stderr)
    missed = output is not None and not evidence.changes
    return FAULT if missed or any(fault.serious for fault in evidence.faults) else 0


main = Program("calibrate", __doc__, _add_options, "studies.calibrate.calibrate")


if __name__ == "__main__":
    main.start()
