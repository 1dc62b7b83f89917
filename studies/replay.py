"""Re-evaluate a stored trajectory from its file alone: `python -m studies.replay FILE`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from hybrid_opt.store.json_records import to_json
from hybrid_opt.store.trajectory_file import Replay, StoredTrajectory, read_trajectory, replay
from hybrid_opt.timing import timed_trajectory
from hybrid_opt.timing.document import timing_document
from studies.program import Parser, add_verbose, program_of, run_program
from studies.text_table import text_table
from studies.timing_text import timing_text

PROGRAM = "python -m studies.replay"

EXIT_DIFFERENT = 1


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=PROGRAM,
        description="Re-evaluate a stored trajectory from its file alone and compare its figures, "
        "and time it for real robots (studies.export writes it for them). Exit code 1 where a "
        "figure differs.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("file", metavar="FILE", help="a trajectory file")
    parser.add_argument(
        "--timing", action="store_true", help="report timings that robots can drive, and margins"
    )
    parser.add_argument(
        "--force-limit",
        type=float,
        metavar="N",
        help="largest normal force of each robot [N], adds the fastest timing below it",
    )
    parser.add_argument(
        "--force-curve",
        type=int,
        metavar="POINTS",
        help="durations at this many force limits",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")
    add_verbose(parser)
    return parser


def _run(options: argparse.Namespace) -> int:
    stored = read_trajectory(options.file)
    with TemporaryDirectory() as folder:
        replayed = replay(stored, Path(folder))
        document: dict[str, Any] = _replay_json(stored, replayed)
        text = [_replay_text(stored, replayed)]
        asked = (options.force_limit, options.force_curve)
        if options.timing or any(option is not None for option in asked):
            document["timing"], timing = _time(stored, replayed, options)
            text += ["", timing]
    if options.json:
        print(json.dumps(document, indent=1, allow_nan=False))
    else:
        print("\n".join(text))
    return 0 if replayed.reproduced else EXIT_DIFFERENT


def _time(
    stored: StoredTrajectory, replayed: Replay, options: argparse.Namespace
) -> tuple[dict[str, Any], str]:
    model = replayed.cell.timing_model
    timed = timed_trajectory(model, stored.x, options.force_limit, options.force_curve)
    return to_json(timing_document(timed)), timing_text(timed)


def _replay_json(stored: StoredTrajectory, replayed: Replay) -> dict[str, Any]:
    return {
        "workcell": replayed.cell.workcell.name,
        "digest": replayed.cell.workcell.digest,
        "reproduced": replayed.reproduced,
        "start_difference": replayed.start_difference,
        "figures": {
            figure.name: {
                "stored": figure.stored,
                "recomputed": figure.recomputed,
                "same": figure.same,
            }
            for figure in replayed.figures
        },
        "provenance": dict(stored.provenance),
    }


def _replay_text(stored: StoredTrajectory, replayed: Replay) -> str:
    rows = [("figure", "stored", "recomputed", "")]
    for figure in replayed.figures:
        recomputed = "-" if figure.recomputed is None else f"{figure.recomputed:.9g}"
        mark = "" if figure.same else "DIFFERS"
        rows.append((figure.name, f"{figure.stored:.9g}", recomputed, mark))
    return "\n".join(
        [
            f"{replayed.cell.workcell.name}, {len(stored.x)} variables",
            text_table(rows, left=(0, 3)),
            f"start postures differ by at most {replayed.start_difference:.2e} rad",
            "reproduced" if replayed.reproduced else "NOT reproduced",
        ]
    )


main = program_of(PROGRAM, _parser, _run)


if __name__ == "__main__":
    sys.exit(run_program(main))
