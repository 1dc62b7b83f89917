"""Work on a trajectory for several programs: replay, export, check, robust forces."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hybrid_opt.campaign.stages import build_study
from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.compiled_cell import InterpretedCell
from hybrid_opt.display.table import number, text_table
from hybrid_opt.extras.bundles import BundleOptions, Origin, export
from hybrid_opt.extras.bundles.bundle import README, warnings_of
from hybrid_opt.extras.bundles.check import as_document, check
from hybrid_opt.extras.bundles.check import read_trajectory as joint_trajectory
from hybrid_opt.extras.bundles.targets import require_target
from hybrid_opt.job.compliance import (
    SKEWS,
    STIFFNESSES,
    largest_skew,
    position_control,
    position_text,
    skew_text,
    skewed,
)
from hybrid_opt.job.plan import command_forces, job_model
from hybrid_opt.job.records import Job
from hybrid_opt.progress import Progress
from hybrid_opt.robust.force import LARGEST_FACTOR, RobustModel, robust_model
from hybrid_opt.robust.price import robust_price
from hybrid_opt.robust.squeeze import SqueezeSettings
from hybrid_opt.store.bundle_file import read_manifest
from hybrid_opt.store.files import read_bytes, to_json
from hybrid_opt.store.trajectory_file import Replay, StoredTrajectory, read_trajectory, replay
from hybrid_opt.timing.analysis import time_trajectory, timing_document
from hybrid_opt.timing.jerk import driven_limits, driven_timing
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import Timing, TimingLimits
from hybrid_opt.timing.solve import time_path
from studies.program import FAULT, ProgramResult, load_workcell, print_findings
from studies.study.answer import job_text
from studies.study.tables import force_curve, margins, timings
from symbolic import safe_io
from symbolic.array import Array
from symbolic.errors import DualArmError, OutsideError, SettingsError, WorkcellError
from symbolic.records import Workcell

NOT_STATED = "the usual one, because the workcell states no [uncertainty]"


def replay_file(options: argparse.Namespace) -> int:
    """Evaluate a trajectory file again, and print stored and new figures. Return the exit code."""
    stored = read_trajectory(options.file)
    with TemporaryDirectory() as folder:
        cell = stored.open_cell(Path(folder))
        build_study(cell, Progress(), polish=False, drivable=False)
        replayed = replay(stored, cell)
        print_findings(_replayed(stored, replayed, options), options.json)
    return 0 if replayed.reproduced else FAULT


def _replayed(
    stored: StoredTrajectory, replayed: Replay, options: argparse.Namespace
) -> Iterator[ProgramResult]:
    workcell, values = replayed.cell.workcell, dict[str, Any]()
    rows = [("figure", "stored", "recomputed", "")]
    for figure in replayed.figures:
        recomputed = "-" if figure.recomputed is None else f"{figure.recomputed:.9g}"
        mark = "" if figure.same else "DIFFERS"
        rows.append((figure.name, f"{figure.stored:.9g}", recomputed, mark))
        both = {"stored": figure.stored, "recomputed": figure.recomputed}
        values[figure.name] = both | {"same": figure.same}
    lines = (
        f"{workcell.name}, {len(stored.x)} variables",
        text_table(rows, left=(0, 3)),
        f"start postures differ by at most {replayed.start_difference:.2e} rad",
        "reproduced" if replayed.reproduced else "NOT reproduced",
    )
    document = {
        "workcell": workcell.name,
        "digest": workcell.digest,
        "reproduced": replayed.reproduced,
        "start_difference": replayed.start_difference,
        "figures": values,
        "provenance": dict(stored.provenance),
    }
    yield ProgramResult(document, lines)
    if workcell.task.law.is_drivable:
        yield _driven(replayed.cell, stored.x)
    asked = (options.planned_limit, options.force_curve)
    if options.timing or any(option is not None for option in asked):
        Progress().note("timing it, which takes some seconds")
        timing = timing_document(time_trajectory(replayed.cell.timing_model, stored.x, *asked))
        found = [timings([("", timing)], [robot.name for robot in workcell.robots])]
        found += [margins([("", timing)])] if timing.margins else []
        found += [force_curve(timing.force_curve)] if timing.force_curve is not None else []
        texts = [f"\n{table.text()}" for table in found]
        texts += [
            f"TOPP-RA confirms {name}: {check.duration:.3f} s against {check.reference:.3f} s"
            if check.is_confirmed
            else f"TOPP-RA disagrees on {name}: {check.duration:.3f} s, {check.reference:.3f} s"
            for name, check in timing.validations.items()
        ]
        yield ProgramResult({"timing": to_json(timing)}, tuple(texts))


def _driven(cell: Cell, x: Array) -> ProgramResult:
    """Plan the job around a drivable carry, with the default settings of studies and exports.

    Args:
        cell: the cell.
        x: (n_var,) decision vector of the carry.

    Returns:
        Durations of carry and job [s] and commanded force [N]; or the reason why no job can be
        planned.
    """
    try:
        job = job_model(cell.timing_model).plan(driven_timing(cell.timing_model, x))
    except DualArmError as error:
        return ProgramResult({"job": None}, (f"no job can be planned: {error}",))
    values = {
        "duration": job.phase("carry").duration,
        "commanded_force": job.squeeze.force,
        "job_duration": job.duration,
    }
    return ProgramResult({"job": values}, (f"as its job drives it: {job_text(job)}",))


def export_file(options: argparse.Namespace) -> int:
    """Write the bundle of a trajectory file, and print its job. Return the exit code."""
    require_target(options.target)
    path = Path(options.file)
    stored = read_trajectory(path)
    hosts = None if options.address is None else (options.address[0], options.address[1])
    bundle = BundleOptions(options.step, options.any_arm, options.stiffness, options.skew, hosts)
    squeeze = SqueezeSettings(options.squeeze, options.leader - 1)
    with TemporaryDirectory() as folder:
        cell = stored.open_cell(Path(folder))
        if options.driver is not None:
            cell = cell.changed(driver_changes(options.driver, cell.workcell))
        build_study(cell, Progress(), polish=False, drivable=False)
        timing = _chosen(cell.timing_model, stored, options.use, options.planned_limit)
        jobs = job_model(cell.timing_model)
        job = jobs.plan(timing, squeeze, options.smoothing)
        origin = Origin.of_file(path, read_bytes(path), stored.provenance)
        files = export(job, options.target, options.output, origin=origin, options=bundle)
        document = read_manifest(files[0].parent)
        print(f"{job_text(job)}\n\n{_report(job, document['start_skew']['stiffness'])}")
    place = files[0].parent
    print(f"\n{len(files)} files in {place}; {README} there says what they are and how they run")
    print(f"next: cd {shlex.quote(str(place))}, then {document['how_to_run']}")
    return 0


def driver_changes(path: Path, workcell: Workcell) -> dict[str, Any]:
    """Read the drivers and tool loads of a workcell's robots from a file.

    Args:
        path: TOML file with a section `[[robots]]` for each robot, of which only the keys `name`,
            `driver` and `tool_load` are read.
        workcell: the workcell.

    Returns:
        Changes of the workcell by key path, as for `Cell.changed`.

    Raises:
        WorkcellError: the file cannot be read, or states nothing about these robots.
    """
    try:
        entries = safe_io.toml_tables(safe_io.read_bytes(path, safe_io.WORKCELL_BYTES))
    except OutsideError as error:
        raise WorkcellError(str(path), (f"file: {error}",)) from error
    robots, names = entries.get("robots"), [robot.name for robot in workcell.robots]
    found = {
        f"robots[{names.index(entry['name'])}].{key}": entry[key]
        for entry in (robots if isinstance(robots, list) else ())
        if isinstance(entry, dict) and entry.get("name") in names
        for key in ("driver", "tool_load")
        if key in entry
    }
    if not found:
        known = " or ".join(map(repr, names))
        problem = f"robots: states no driver and no tool_load of a robot called {known}"
        raise WorkcellError(str(path), (problem,))
    return found


def _chosen(
    model: TimingModel, stored: StoredTrajectory, use: str | None, force: float | None
) -> Timing:
    force = driven_limits(model, stored.x).force if force is None else force
    chosen = use or ("closest" if force is None else "force")
    limits = TimingLimits(reference_speed=chosen == "closest")
    if chosen == "force":
        if force is None:
            raise SettingsError("--use force needs --planned-limit")
        limits = model.drive_limits(force)
    return time_path(model, stored.x, limits)


def _report(job: Job, stiffness: float | None) -> str:
    """Return a text on a job: its phases, the contact forces if both arms are position-controlled,
    the contact forces if one arm lags behind the other, and warnings.

    Args:
        job: the job.
        stiffness: stiffness of each arm at its pad along the normal [N/m], for the lag; None to
            leave the lag out.
    """
    parts = [repr(job)]
    if job.follower is not None:
        parts += [
            "\nPosition control, by the arms' stiffness at their pads",
            position_text([position_control(job, each) for each in STIFFNESSES]),
        ]
    if stiffness is not None:
        parts += [
            f"\nEither arm late, at {stiffness:.6g} N/m: up to "
            f"{1e3 * largest_skew(job, stiffness):.1f} ms are survived",
            skew_text([skewed(job, delay, stiffness) for delay in SKEWS]),
        ]
    parts += [f"\nwarning: {warning}" for warning in warnings_of(job)]
    return "\n".join(parts)


def check_file(options: argparse.Namespace) -> int:
    """Check a file of joint positions: whether both arms hold the box along it, within all limits
    of the cell. Print the result and return the exit code.
    """
    workcell = load_workcell(options.workcell)
    cell = Cell(workcell, compiled=InterpretedCell(workcell))
    trajectory = joint_trajectory(options.trajectory, cell.workcell)
    held = None if options.held is None else (options.held[0], options.held[1])
    found = check(cell, trajectory, held, options.interpolation)
    print(json.dumps(as_document(found), indent=1) if options.json else found)
    return FAULT if found.problems else 0


def robust_forces(options: argparse.Namespace) -> int:
    """Print the normal forces that a trajectory file needs in every case of the uncertainty. Return
    the exit code."""
    stored = read_trajectory(options.file)
    with TemporaryDirectory() as folder:
        cell = stored.open_cell(Path(folder))
        build_study(cell, Progress(), polish=False, drivable=False)
        return _robust_forces(cell, stored.x, options)


def _robust_forces(cell: Cell, x: Array, options: argparse.Namespace) -> int:
    workcell, leader, model = cell.workcell, options.leader - 1, cell.timing_model
    timing = driven_timing(model, x)
    if timing.carry is None or not timing.ok:
        raise SettingsError(f"the trajectory cannot be driven: {timing.reason}")
    uncertainty = workcell.uncertainty
    named = "the workcell's [uncertainty]" if uncertainty.stated else NOT_STATED
    print(
        f"{workcell.name}: {timing.duration:.3f} s as robots drive it; arm {options.leader} leads, "
        "the other's force is commanded"
    )
    print(f"  the set is {named}: {uncertainty}", flush=True)
    held = command_forces(job_model(cell.timing_model), timing, SqueezeSettings(leader=leader))
    whose = "the whole job" if held.job else f"the carry alone (no whole job: {held.problem})"
    print(f"  commanded of {whose}: {held.squeeze.breakdown}", flush=True)
    exit_code = 0
    if uncertainty.is_empty:
        print("  nothing is uncertain, so there is nothing to check: state what may be off")
    else:
        exit_code = _priced(robust_model(workcell), timing.carry, options)
    for text in [] if options.planned_limit is None else _timed(cell, x, options.planned_limit):
        print(f"  {text}")
    return exit_code


def _priced(model: RobustModel, carry: Carry, options: argparse.Namespace) -> int:
    """Print how much a carry's normal forces grow with the size of the uncertainty. Return the exit
    code.

    The forces are computed for several factors on all ranges of the uncertainty. The forces at
    factor 1 are tested in random cases of the uncertainty.

    Args:
        model: model that computes robust forces.
        carry: the carry.
        options: parsed command line.
    """
    price = robust_price(
        model,
        carry,
        np.random.default_rng(options.seed),
        options.leader - 1,
        options.cases,
        threads=0,
        points=options.points,
    )
    check, largest = price.check, price.largest_factor
    most = f"at least {LARGEST_FACTOR:g}" if largest == LARGEST_FACTOR else f"{largest:.3f}"
    print(f"  peak forces of the carry that hold in all cases: {_both(price.commanded)} N")
    print(f"  the reference forces {_both(price.limit)} N hold {most} times the set")
    rows = [("times the set", "peak force 1 [N]", "peak force 2 [N]")]
    rows += [
        (number(factor, 2), number(peak[0], 2), number(peak[1], 2))
        for factor, peak in zip(price.factors, price.peak, strict=True)
    ]
    print(f"\n{text_table(rows, left=())}")
    verdict = "all hold" if check.holds else f"{check.failing} FAIL"
    print(
        f"\n  {check.cases} random cases (seed {options.seed}): {verdict}; the hardest needs "
        f"{check.hardest} of the least force that holds in all cases"
    )
    return 0 if check.holds else FAULT


def _timed(cell: Cell, x: Array, limit: float) -> list[str]:
    """Time a path as fast as possible within a force limit. Return two lines of text with the
    durations: with planned forces, then with robust forces.

    Args:
        cell: the cell.
        x: (n_var,) decision vector of the path.
        limit: force limit [N].
    """
    found = []
    for text, robust in (("planned forces", False), ("forces that hold in all cases", True)):
        timing = time_path(cell.timing_model, x, TimingLimits(force=limit, robust=robust))
        told = f"{timing.duration:.3f} s" if timing.ok else timing.reason
        found.append(f"{text} below {limit:g} N: {told}")
    return found


def _both(values: Array) -> str:
    return " / ".join(f"{value:.2f}" for value in values)
