"""What `studies.calibrate` does: recorded runs to a cell's numbers."""

from __future__ import annotations

import argparse
import json
import sys

from hybrid_opt.calibrating import evidence as found_in
from hybrid_opt.calibrating.recording import read_run
from studies.program import load_workcell
from symbolic.errors import SettingsError
from symbolic.replacing import replace_file

REFUSED = 1


def calibrate(options: argparse.Namespace) -> int:
    """Do what the options ask for, and print it; returns the exit code."""
    output = options.out
    if output is not None and not output.resolve().parent.is_dir():
        raise SettingsError(f"{output.parent} is no folder; make it, or name another --out")
    if output is not None and output.resolve() == options.workcell.resolve():
        raise SettingsError(f"{output} is the workcell itself; name another file by --out")
    workcell = load_workcell(options.workcell)
    evidence = found_in.calibrate(workcell, [read_run(path, workcell) for path in options.runs])
    print(json.dumps(evidence.document, indent=2) if options.json else evidence)
    if output is not None and evidence.changes:
        text = found_in.calibrated_file(workcell.source, evidence, output.resolve())
        replace_file(output, text.encode())
        if not options.json:
            print(f"written: {output}")
    elif output is not None:
        print(f"not written: {output}, because the runs show nothing for it", file=sys.stderr)
    missed = output is not None and not evidence.changes
    return REFUSED if missed or any(fault.serious for fault in evidence.faults) else 0
