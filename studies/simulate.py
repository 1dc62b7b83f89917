"""A simulator as witness of a stored trajectory: `dual-arm-carry simulate FILE`.

Drives it in MuJoCo, pressed or held with multiples of the planned forces: the least multiple that
holds, when and where the box slips, and random cases of the workcell's [uncertainty] under its
robust forces.
"""

from __future__ import annotations

from studies.options import (
    FILM_FILE,
    HANDS,
    OUTPUT_FILE,
    PAD_WITNESSES,
    add,
    number,
    require_extra,
    stated,
    whole,
)
from studies.program import Parser, Program


def _add_options(parser: Parser) -> None:
    add(parser, "FILE")
    parser.add_argument(
        "--controller",
        choices=(
            HANDS,
            *PAD_WITNESSES,
            *stated("hybrid_opt.extras.simulation.reference.Control"),
        ),
        help="controllers: one arm leads and the other is force-controlled along the normal "
        "(leader), both are force-controlled (both), both are springs about the plan (impedance); "
        "or without arms: pads on a carriage that follows the plan exactly (pads), pads that press "
        "at their rims, turned by the planned moments, as the allocation paper assumes "
        "(pads-driven), or hands that hold by themselves (hands) (default: hands for such hands, "
        "else leader)",
    )
    parser.add_argument(
        "--timing",
        choices=("search", "closest", "fastest"),
        default="search",
        help="timing: that of its search (within its force limit, else closest to the reference "
        "speeds), closest to the reference speeds, or fastest",
    )
    add(
        parser,
        "--planned-limit",
        help="fastest timing within this limit of the planned normal forces [N]",
    )
    add(parser, "--leader")
    parser.add_argument(
        "--runs", type=whole(0, 10**6), default=20, help="random cases of the uncertainty"
    )
    add(parser, "--seed", help="seed of the random cases")
    parser.add_argument(
        "--tracking-error",
        type=number(0.0, 1.0),
        default=1e-4,
        metavar="RAD",
        help="amplitude of each joint's error in the random cases, a sinusoid of 0.3 to 1.5 Hz",
    )
    parser.add_argument(
        "--stiffness",
        type=number(1e-3, 1e9),
        default=stated("hybrid_opt.extras.simulation.scene.ArmSettings.stiffness"),
        metavar="1/RAD",
        help="stiffness of each joint over its largest torque",
    )
    parser.add_argument(
        "--time-step",
        type=number(1e-6, 1.0),
        metavar="S",
        help="time step of the simulation (default: 0.001, of hands 0.0005)",
    )
    parser.add_argument(
        "--sweep", action="store_true", help="repeat with half and twice the time step"
    )
    parser.add_argument(
        "--film",
        type=FILM_FILE,
        metavar="FILE",
        help="write the simulated motion, .gif or .mp4 (with arms)",
    )
    parser.add_argument(
        "--mjcf",
        type=OUTPUT_FILE,
        metavar="FILE",
        help="write the simulated cell as MuJoCo reads it (with arms)",
    )


main = Program(
    "simulate",
    __doc__,
    _add_options,
    "studies.programs.simulation.simulate_file",
    complete=lambda options: require_extra("sim", "a simulation"),
    further=("--tracking-error", "--stiffness", "--time-step", "--sweep"),
)


if __name__ == "__main__":
    main.start()
