"""What `studies.live` does: a cell in the browser until Ctrl-C."""

from __future__ import annotations

import argparse
import sys
import threading

import hybrid_opt as ho
from studies.program import load_workcell


def serve(options: argparse.Namespace) -> int:
    """Serve a cell until Ctrl-C; returns the exit code.

    Raises:
        DualArmError: the cell has no drivable form, or viser is missing.
    """
    workcell = load_workcell(options.workcell)
    print("compiling what is not compiled yet", file=sys.stderr)
    page = ho.live(ho.Cell(workcell), port=options.port)
    print(f"Open {page.url} in a browser; Ctrl-C ends it.", file=sys.stderr)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        page.close()
    return 0
