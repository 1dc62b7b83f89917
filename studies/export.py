"""A stored trajectory as a bundle that a cell can run: `dual-arm-carry export FILE`.

Plans the whole job around the trajectory (approach, press, lift, carry, set down, release, retreat)
and writes it as one bundle with a manifest, in a folder of its own below DIR.
"""

from __future__ import annotations

from pathlib import Path

from studies.options import WORKCELL_FILE, add, stated
from studies.program import Parser, Program

TIMINGS = ("closest", "fastest", "force")


def _add_options(parser: Parser) -> None:
    add(parser, "FILE")
    parser.add_argument(
        "--target",
        metavar="NAME",
        required=True,
        help=f"kind of bundle: {', '.join(stated('hybrid_opt.extras.bundles.targets.TARGETS'))}",
    )
    add(
        parser,
        "--output",
        default=Path("bundles"),
        metavar="DIR",
        help="folder of bundles",
    )
    parser.add_argument(
        "--use",
        choices=TIMINGS,
        help="timing of the carry: closest to the reference speed, fastest, or fastest within "
        "--planned-limit (default: force if that is given or the trajectory has its own limit, as "
        "recommended ones; else closest)",
    )
    add(
        parser,
        "--planned-limit",
        help="largest planned normal force [N]; the largest robust force if the trajectory was "
        "searched for robust forces (default: the trajectory's own limit, if any)",
    )
    parser.add_argument(
        "--squeeze",
        type=float,
        metavar="FACTOR",
        help="commanded squeeze over the least that holds evenly pressing pads (default: the force "
        "that holds in every case of the cell's [uncertainty], or of the usual one)",
    )
    add(parser, "--leader")
    parser.add_argument(
        "--smoothing",
        type=float,
        default=stated("hybrid_opt.timing.smoothing.SMOOTHING_WIDTH"),
        metavar="S",
        help="half the width of the window over which a timing with jumps of acceleration is "
        "averaged [s]; 0 keeps it unchanged",
    )
    parser.add_argument(
        "--step",
        type=float,
        metavar="S",
        help="time between samples [s] (default: the longest that keeps the forces)",
    )
    parser.add_argument(
        "--stiffness",
        type=float,
        metavar="N/m",
        help="stiffness of each arm at its pad along the normal; it turns errors of a late arm and "
        "of the time step into forces (default: that of [robots.driver], or of the bundle's gains)",
    )
    parser.add_argument(
        "--skew",
        type=float,
        metavar="S",
        help="delay between the starts of both arms that the job must tolerate [s] (default: the "
        "largest of the target, 0 if one clock drives both arms)",
    )
    parser.add_argument(
        "--driver",
        type=WORKCELL_FILE,
        metavar="FILE",
        help="take [robots.driver] and [robots.tool_load] of the robots, by name, from this file: "
        "a workcell file, or one with these sections alone (default: those of the stored cell)",
    )
    parser.add_argument(
        "--address",
        nargs=2,
        metavar=("HOST", "HOST"),
        help="host names or IP addresses of both controllers, in the order of the robots (default: "
        "those of the workcell)",
    )
    parser.add_argument(
        "--any-arm",
        action="store_true",
        help="write a maker's own language also for other arms",
    )


main = Program(
    "export",
    __doc__,
    _add_options,
    "studies.programs.trajectory.export_file",
    further=("--use", "--planned-limit", "--squeeze", "--smoothing", "--step", "--any-arm"),
)


if __name__ == "__main__":
    main.start()
