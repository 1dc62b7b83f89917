"""A stored trajectory as a bundle that a cell can run: `python -m studies.export FILE`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from hybrid_opt.bundles import FORMATS, BundleOptions, Origin, export
from hybrid_opt.bundles.manifest import SKEW, warnings_of
from hybrid_opt.job.compliance import (
    SKEWS,
    STIFFNESSES,
    largest_skew,
    position_control,
    position_text,
    skew_text,
    skewed,
)
from hybrid_opt.job.plan import JobModel
from hybrid_opt.job.records import Job
from hybrid_opt.job.smooth import WIDTH
from hybrid_opt.robust.squeeze import FACTOR, SqueezeSettings
from hybrid_opt.store.files import read_bytes
from hybrid_opt.store.trajectory_file import StoredTrajectory, read_trajectory
from hybrid_opt.timing import (
    Timing,
    closest_to_reference_timing,
    fastest_timing,
    force_limited_timing,
)
from hybrid_opt.timing.model import TimingModel
from studies.options import add_leader
from studies.program import Parser, program_of, run_program
from symbolic.errors import SettingsError

PROGRAM = "python -m studies.export"

TIMINGS = ("closest", "fastest", "force")


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=PROGRAM,
        description="Plan the whole job around a stored trajectory (approach, press, lift, carry, "
        "set down, release, retreat) and write it as one bundle with a manifest, in a folder of "
        "its own below DIR.",
    )
    parser.add_argument("file", metavar="TRAJECTORY", help="a trajectory file")
    parser.add_argument("--form", choices=list(FORMATS), required=True, help="what is written")
    parser.add_argument(
        "--output",
        default="bundles",
        metavar="DIR",
        help="folder of bundles (default: %(default)s)",
    )
    parser.add_argument(
        "--use",
        choices=TIMINGS,
        help="the timing of the carry: closest to the reference speed, the fastest, or the fastest "
        "below --force-limit (default: force where that is given, else closest)",
    )
    parser.add_argument(
        "--force-limit",
        type=float,
        metavar="N",
        help="largest planned normal force [N], the largest robust one of a trajectory that was "
        "searched for robust forces",
    )
    parser.add_argument(
        "--squeeze",
        type=float,
        metavar="FACTOR",
        help="commanded squeeze over the least that holds pads that press evenly (default: what "
        f"holds them in every case of the cell's [uncertainty], {FACTOR:g} where it has none)",
    )
    add_leader(parser)
    parser.add_argument(
        "--smoothing",
        type=float,
        default=WIDTH,
        metavar="S",
        help="half the width of the window over which a timing whose acceleration jumps is "
        "averaged [s]; 0 leaves it as it is (default: %(default)g)",
    )
    parser.add_argument(
        "--step", type=float, metavar="S", help="time between samples [s] (default: the form's own)"
    )
    parser.add_argument(
        "--stiffness",
        type=float,
        default=BundleOptions().stiffness,
        metavar="N/m",
        help="of each arm at its pad, for what a late arm does (default: %(default)g)",
    )
    parser.add_argument(
        "--skew",
        type=float,
        metavar="S",
        help="between the starts of both arms [s]; a job whose squeeze it breaks is refused "
        f"(default: {SKEW:g} where a controller of its own drives each arm, else 0)",
    )
    parser.add_argument(
        "--per-arm", action="store_true", help="ros2: a trajectory and a controller per arm"
    )
    parser.add_argument(
        "--any-arm", action="store_true", help="rapid, urscript: also for arms of other makers"
    )
    return parser


def _run(options: argparse.Namespace) -> int:
    path = Path(options.file)
    stored = read_trajectory(path)
    bundle = BundleOptions(
        options.step, options.per_arm, options.any_arm, options.stiffness, options.skew
    )
    squeeze = SqueezeSettings(options.squeeze, options.leader - 1)
    with TemporaryDirectory() as folder:
        job = _planned(stored, Path(folder), options, squeeze)
        origin = Origin.of_file(path, read_bytes(path), stored.provenance)
        files = export(job, options.form, options.output, origin=origin, options=bundle)
        print(_report(job, options.stiffness))
    print(f"\n{len(files)} files in {files[0].parent}")
    return 0


def _planned(
    stored: StoredTrajectory, folder: Path, options: argparse.Namespace, squeeze: SqueezeSettings
) -> Job:
    cell = stored.open_cell(folder)
    timing = _timing(cell.timing_model, stored, options.use, options.force_limit)
    return JobModel(cell.compiled, cell.timing_model).plan(timing, squeeze, options.smoothing)


def _timing(
    model: TimingModel, stored: StoredTrajectory, use: str | None, force: float | None
) -> Timing:
    chosen = use or ("closest" if force is None else "force")
    if chosen == "force":
        if force is None:
            raise SettingsError("--use force needs --force-limit")
        return force_limited_timing(model, stored.x, force)
    return {"closest": closest_to_reference_timing, "fastest": fastest_timing}[chosen](
        model, stored.x
    )


def _report(job: Job, stiffness: float) -> str:
    """The job's phases, what position control and a late arm do, and warnings."""
    parts = [
        repr(job),
        "\nPosition control, by the arms' stiffness at their pads",
        position_text([position_control(job, each) for each in STIFFNESSES]),
        f"\nEither arm late, at {stiffness:g} N/m: up to "
        f"{1e3 * largest_skew(job, stiffness):.1f} ms are survived",
        skew_text([skewed(job, delay, stiffness) for delay in SKEWS]),
    ]
    parts += [f"\nwarning: {warning}" for warning in warnings_of(job)]
    return "\n".join(parts)


main = program_of(PROGRAM, _parser, _run)


if __name__ == "__main__":
    sys.exit(run_program(main))
