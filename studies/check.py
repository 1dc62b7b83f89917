"""Judge any joint trajectory of both arms: `dual-arm-carry check WORKCELL TRAJECTORY`.

The trajectory may be a bundle's, edited or not, or another planner's: CSV, JSON, or ROS 2's
JointTrajectory in YAML. Tells how well the chain of arms and box is closed, the limits that it
uses, collisions and the forces that the box needs. Exit code 1 where it cannot be driven.
"""

from __future__ import annotations

from studies.options import INPUT_FILE, add, number, stated
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    add(parser, "WORKCELL")
    parser.add_argument(
        "trajectory", metavar="TRAJECTORY", type=INPUT_FILE, help="the file to check"
    )
    parser.add_argument(
        "--held",
        nargs=2,
        type=number(0.0, 1e6),
        metavar=("BEGIN", "END"),
        help="interval in which the pads hold the box [s] (default: the carry that the file names, "
        "else the longest interval in which the pads' relative pose holds it)",
    )
    parser.add_argument(
        "--interpolation",
        choices=stated("hybrid_opt.extras.bundles.job_file.Interpolation"),
        help="interpolation of the controller between samples (default: the highest order that the "
        "file's velocities and accelerations allow)",
    )
    add(parser, "--json")


main = Program("check", __doc__, _add_options, "studies.programs.trajectory.check_file")


if __name__ == "__main__":
    main.start()
