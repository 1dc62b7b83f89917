"""Simulation of a stored trajectory with controlled arms or with pads alone, for
`studies.simulate`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.campaign.stages import build_study
from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.errors import SimulationError
from hybrid_opt.extras.simulation.arms import (
    BISECTIONS,
    HIGH,
    LOW,
    ArmOutcome,
    CellSimulation,
    simulate_carry,
)
from hybrid_opt.extras.simulation.box import (
    AnyOutcome,
    BoxSimulation,
    Outcome,
    Threshold,
    bisected,
    carriage_motion,
    drive_of,
    planned_moments,
    workcell_of_case,
)
from hybrid_opt.extras.simulation.hand_bodies import HandSprings
from hybrid_opt.extras.simulation.hand_cases import (
    hand_case_threshold,
    random_hand_cases,
    worst_hand_case,
)
from hybrid_opt.extras.simulation.hands import (
    HAND_SETTINGS,
    hand_threshold,
    own_forces,
)
from hybrid_opt.extras.simulation.reference import (
    Control,
    Reference,
    carry_reference,
    driven_carry,
    exported_carry,
    with_tracking_error,
)
from hybrid_opt.extras.simulation.scene import (
    LARGEST_TIME_STEP,
    ArmSettings,
    Pads,
    SimulationSettings,
)
from hybrid_opt.progress import Progress
from hybrid_opt.robust.cases import nominal_case, random_cases
from hybrid_opt.robust.force import robust_model
from hybrid_opt.robust.squeeze import SqueezeSettings, commanded_forces
from hybrid_opt.store.files import AGAIN, storing
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing.analysis import closest_to_reference_timing
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.timing.solve import time_path
from studies.options import HANDS, PAD_WITNESSES, PADS_DRIVEN
from studies.report.looks import Film, write_animation
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.records import Workcell


def simulate_arms(
    cell: Cell, carry: Carry, settings: ArmSettings, options: argparse.Namespace
) -> str:
    """Simulate a carry with both arms, print the results, and return the simulated cell as MJCF.

    The results are: the least factor on the planned forces with which the box holds; the job with
    the commanded forces; and random cases of the uncertainty. With `--sweep` the factor is also
    found for a shorter and a longer time step.

    Args:
        cell: the cell.
        carry: the carry.
        settings: settings of the simulation.
        options: parsed command line.

    Raises:
        SimulationError: with `--sweep`, the factor is not within the searched range.
    """
    control, leader, workcell = options.controller, options.leader - 1, cell.workcell
    witness = CellSimulation(workcell, settings)
    found = simulate_carry(cell, carry, witness, control, leader)
    threshold = found.threshold
    print(f"  {found.problem}" if threshold is None else threshold_text(threshold, settings.slip))
    reference = carry_reference(cell, carry, leader=leader)
    if options.sweep:
        for step in _swept(settings.time_step):
            period = max(step, settings.control_period)
            other = CellSimulation(
                workcell, replace(settings, time_step=step, control_period=period)
            )
            simulate = partial(other.simulate, reference, control)
            _tell_sweep(step, bisected(simulate, LOW, HIGH, BISECTIONS))
    peak = found.reference.normal_force.max(axis=0)
    print(f"  pressed up to {peak[0]:.2f} / {peak[1]:.2f} N, {found.squeeze}:")
    _tell(found.shown, carry)
    if found.squeeze.uncertainty is not None:
        _cases(cell, found.reference, settings, options)
        rubs_less = CellSimulation(worst_friction(workcell), settings)
        pressed = partial(rubs_less.simulate, found.reference, control)
        _tell_worst(pressed, partial(rubs_less.simulate, reference, control), workcell)
    if options.film:
        _film(cell, found.shown, Path(options.film))
    return witness.text


def _tell(outcome: ArmOutcome, carry: Carry) -> None:
    during = outcome.time >= carry.time[0]
    missing = (outcome.normal_force / outcome.normal_force_reference)[during] - 1.0
    print(
        f"  the box "
        f"{'arrives' if outcome.arrives else 'does NOT arrive'}: slip up to "
        f"{1e3 * outcome.slip.max():.3f} mm, {1e3 * outcome.misses:.2f} mm from its goal; normal "
        f"forces within {100.0 * np.abs(missing).max():.1f} % of their reference, rms "
        f"{100.0 * np.sqrt((missing**2).mean()):.2f} %; joints off by up to "
        f"{1e3 * np.abs(outcome.tracking_error[during]).max():.2f} mrad; torques up to "
        f"{100.0 * outcome.torque_use.max():.0f} % of the largest"
    )


def _cases(
    cell: Cell, pressed: Reference, settings: ArmSettings, options: argparse.Namespace
) -> None:
    """Simulate random cases of the uncertainty with errors of the joints, and print in how many of
    them the box arrives at its goal.

    Args:
        cell: the cell.
        pressed: commands to both arms, with the normal forces of a job.
        settings: settings of the simulation.
        options: parsed command line, with the number of cases and the seed.
    """
    workcell, rng, leader = cell.workcell, np.random.default_rng(options.seed), options.leader - 1
    control: Control = options.controller
    outcomes = []
    with Progress().stage("random cases", options.runs, "simulations") as advance:
        for case in random_cases(workcell, workcell.uncertainty, options.runs, rng, leader):
            witness = CellSimulation(workcell_of_case(workcell, case), settings, case[8:11])
            told = with_tracking_error(pressed, options.tracking_error, rng, float(case[17]))
            outcomes.append(witness.simulate(told, control, tracked_share(case, leader)))
            advance(1)
    arrived = sum(outcome.arrives for outcome in outcomes)
    slip = max((outcome.slip.max() for outcome in outcomes), default=0.0)
    print(
        f"  {arrived} of {len(outcomes)} random cases arrive (seed {options.seed}, joints off by "
        f"up to {options.tracking_error:g} rad); slip up to {1e3 * slip:.3f} mm"
    )


def tracked_share(case: Array, leader: int) -> float:
    """Return the actual over the commanded normal force of the force-controlled arm in a case of
    the uncertainty.

    Args:
        case: (18,) the case, in the order of `symbolic.contact.worst_cases.CASE_SIZES`.
        leader: index of the other arm.
    """
    return 1.0 - float(case[16 - leader])


def _film(cell: Cell, outcome: ArmOutcome, path: Path) -> None:
    angles: Array = Rotation.from_matrix(outcome.box_rotation).as_euler("xyz")
    pose = np.concatenate([outcome.box_position, angles], axis=1)
    label = f"simulated, {outcome.factor:g} times the force"
    write_animation(cell.geometry, Film(label, outcome.time, pose, outcome.q), path)
    print(f"  film written to {path}")


PAD_BISECTIONS = 9
"""Number of bisections of the factor for pads without arms, to about 0.1 %."""

CREEP_FACTOR = 1.05

USUAL_CONTROLLER: Control = "leader"


def simulate_pads(
    cell: Cell, carry: Carry, settings: SimulationSettings, options: argparse.Namespace
) -> None:
    """Simulate a carry with pads but without arms, and print the results.

    These are: the least factor on the planned forces with which the box holds; the speed at which
    it creeps on the elastic layers at slightly larger forces; and how many random cases of the
    uncertainty hold with the commanded forces of a job. With `--sweep` the factor is also found for
    a shorter and a longer time step.

    Args:
        cell: the cell.
        carry: the carry.
        settings: settings of the simulation.
        options: parsed command line.
    """
    leader, workcell = options.leader - 1, cell.workcell
    moments = planned_moments(cell, carry) if settings.pads == "driven" else None
    witness = BoxSimulation(workcell, settings)
    drive = drive_of(carry, settings, leader=leader, moments=moments)
    threshold = bisected(partial(witness.simulate, drive), LOW, HIGH, PAD_BISECTIONS)
    print(threshold_text(threshold, settings.slip))
    creep = witness.simulate(drive, CREEP_FACTOR * threshold.factor)
    if creep.holds:
        rate = creep.slip[-1].max() / carry.duration
        print(f"  at {CREEP_FACTOR:g} times this force the box creeps {1e6 * rate:.2f} um/s")
    if options.sweep:
        for step in _swept(settings.time_step):
            other = replace(settings, time_step=step)
            finer = drive_of(carry, other, leader=leader, moments=moments)
            simulate = partial(BoxSimulation(workcell, other).simulate, finer)
            _tell_sweep(step, bisected(simulate, LOW, HIGH, PAD_BISECTIONS))
    if workcell.uncertainty.is_empty:
        return
    forces, squeeze = commanded_forces(workcell, carry, SqueezeSettings(leader=leader))
    pressed = drive_of(carry, settings, forces[:, 1 - leader], leader, moments)
    rng = np.random.default_rng(options.seed)
    cases = random_cases(workcell, workcell.uncertainty, options.runs, rng, leader)
    held = sum(
        BoxSimulation(workcell_of_case(workcell, case), settings, case[8:11])
        .simulate(pressed, tracked_share(case, leader))
        .holds
        for case in cases
    )
    print(
        f"  pressed up to {forces[:, 0].max():.2f} / {forces[:, 1].max():.2f} N, {squeeze}: {held} "
        f"of {len(cases)} random cases hold (seed {options.seed})"
    )
    rubs_less = BoxSimulation(worst_friction(workcell), settings).simulate
    _tell_worst(partial(rubs_less, pressed), partial(rubs_less, drive), workcell)


def simulate_hands(
    cell: Cell, carry: Carry, settings: SimulationSettings, options: argparse.Namespace
) -> None:
    """Simulate a carry in hands without arms, and print the results.

    These are: the least factor on the planned forces with which the payload holds; how many random
    cases of the uncertainty hold with the holding forces of a job; and the least factor on these
    forces in the case that requires most according to the contact model.

    Args:
        cell: the cell.
        carry: the carry.
        settings: settings of the simulation.
        options: parsed command line.
    """
    workcell = cell.workcell
    swings = HandSprings(workcell, settings).swing_frequency
    print(f"  without arms; the payload swings at {swings:.1f} Hz on layers of rubber")
    found = hand_threshold(carry, settings)
    slips = found.slips
    what = "a rim lifts" if slips.lifts else f"one slips beyond {1e3 * settings.slip:g} mm"
    print(
        f"  holds from {found.holds.factor:.4f} times the planned forces on; at "
        f"{slips.factor:.4f} {what}: a hand of arm {slips.pad + 1}, {_moment(slips.time[-1])}"
    )
    if workcell.uncertainty.is_empty:
        return
    forces, squeeze = commanded_forces(workcell, carry, SqueezeSettings(leader=options.leader - 1))
    holding, motion = own_forces(workcell, forces.max(axis=0)), carriage_motion(carry, settings)
    cases = random_hand_cases(workcell, options.runs, np.random.default_rng(options.seed))
    full, half = (
        sum(case.simulate(motion, holding, share, settings).holds for case in cases)
        for share in (1.0, 0.5)
    )
    print(
        f"  hold with {holding[0]:.2f} / {holding[1]:.2f} N, {squeeze}: {full} of {len(cases)} "
        f"random cases hold (seed {options.seed}), {half} with half of it"
    )
    worst = worst_hand_case(carry, robust_model(workcell))
    try:
        least = hand_case_threshold(worst, motion, holding, settings)
        print(f"  the model's worst case holds from {least.holds.factor:.3f} times this force on")
    except SimulationError as error:
        print(f"  in the model's worst case {error}")


def _swept(step: float) -> tuple[float, float]:
    """Return the two time steps of `--sweep` [s]: half of `step`, and twice `step` but at most
    `LARGEST_TIME_STEP`.
    """
    return step / 2.0, min(2.0 * step, LARGEST_TIME_STEP)


def _tell_sweep(step: float, threshold: Threshold[AnyOutcome]) -> None:
    print(f"  with a time step of {step:g} s: {threshold.factor:.4f}")


def _tell_worst(
    pressed: Callable[[float], Outcome], planned: Callable[[], Outcome], workcell: Workcell
) -> None:
    """Print whether the box holds with the least friction coefficients of the uncertainty: under
    the commanded forces with the largest tracking error, and under the planned forces.

    Args:
        pressed: function that simulates the carry with the commanded forces times its argument.
        planned: function that simulates the carry with the planned forces.
        workcell: the cell, with its uncertainty.
    """
    tracked = 1.0 - workcell.uncertainty.tracking
    outcome = pressed(tracked)
    print(
        f"  with the set's worst friction and {100.0 * tracked:g} % of the force it "
        f"{'holds' if outcome.holds else 'SLIPS'}: slip up to {1e3 * outcome.slip.max():.3f} mm"
    )
    word = "hold" if planned().holds else "slip"
    print(f"  least forces with the set's worst friction: {word}")


def threshold_text(threshold: Threshold[AnyOutcome], slip: float) -> str:
    """Format a result of the search for the least force in one line: the factors of the planned
    force just below and above the threshold, and where and when the box slips.

    Args:
        threshold: simulations just below and just above the threshold.
        slip: displacement that counts as slip [m].
    """
    slips, holds = threshold.slips, threshold.holds
    return (
        f"  holds from {holds.factor:.4f} times the planned force on, slips at {slips.factor:.4f}: "
        f"at pad {slips.pad + 1}, beginning {_moment(slips.begins(slip))}, beyond "
        f"{1e3 * slip:g} mm at {slips.time[-1]:.3f} s, turned {slips.turn[-1]:.4f} rad"
    )


def _moment(time: float) -> str:
    """Format a time from the beginning of the carry [s]. A negative time belongs to the pressing
    before the carry, and the text says so."""
    return f"{-time:.3f} s before the carry" if time < 0.0 else f"at {time:.3f} s"


def worst_friction(workcell: Workcell) -> Workcell:
    """Return the workcell with the least friction coefficients that its uncertainty allows. All
    other values stay as described."""
    case = nominal_case(workcell)
    case[0:2] *= 1.0 - workcell.uncertainty.friction
    return workcell_of_case(workcell, case)


def simulate_file(options: argparse.Namespace) -> int:
    """Simulate a trajectory file and print the results. Return the exit code."""
    pads: Pads = "driven" if options.controller == PADS_DRIVEN else "even"
    step = options.time_step or SimulationSettings.time_step
    settings = SimulationSettings(step, pads=pads)
    period = max(step, ArmSettings.control_period)
    arms = ArmSettings(step, control_period=period, stiffness=options.stiffness)
    stored = read_trajectory(options.file)
    with TemporaryDirectory() as folder:
        cell = stored.open_cell(Path(folder))
        options.controller = _controller(cell.workcell, options)
        progress = Progress()
        build_study(cell, progress, polish=False, drivable=False)
        carry = _timed(cell, stored.x, options)
        peak = carry.peak_normal_force
        held = "holding" if options.controller == HANDS else "normal"
        print(
            f"{cell.workcell.name}: {carry.duration:.2f} s, planned {held} forces up to "
            f"{peak[0]:.2f} / {peak[1]:.2f} N; controller {options.controller}, arm "
            f"{options.leader} leads",
            flush=True,
        )
        progress.note("simulating: the least force that holds, then random cases")
        if options.controller == HANDS:
            hands = replace(HAND_SETTINGS, time_step=options.time_step or HAND_SETTINGS.time_step)
            simulate_hands(cell, carry, hands, options)
            return 0
        if options.controller in PAD_WITNESSES:
            simulate_pads(cell, carry, settings, options)
            return 0
        text = simulate_arms(cell, carry, arms, options)
    if options.mjcf:
        path = Path(options.mjcf)
        with storing(path, AGAIN):
            path.write_text(text, encoding="utf-8")
        print(f"  cell written to {path}")
    return 0


def _controller(workcell: Workcell, options: argparse.Namespace) -> str:
    """Return the name of the controller to simulate: the one in the options, or one that suits the
    cell.

    Raises:
        SimulationError: the requested controller does not suit the cell.
    """
    model, chosen = contact_model(workcell), options.controller
    usual = USUAL_CONTROLLER if model.is_squeeze else HANDS
    if (chosen or usual) in (HANDS, *PAD_WITNESSES) and (options.film or options.mjcf):
        raise SimulationError(
            "films and MJCF files are of cells with arms; give another --controller",
            code="controller",
        )
    if chosen is not None and (chosen == HANDS) != (usual == HANDS):
        raise SimulationError(
            f"--controller {chosen} does not fit this cell of {model.assumption}; leave it out",
            code="controller",
        )
    if chosen == PADS_DRIVEN and not model.has_pressure_limit:
        raise SimulationError(
            "planned moments at the wrists belong to pads that choose their pressure; this "
            f"carry is of {model.assumption}: give another --controller",
            code="controller",
        )
    return chosen or usual


def _timed(cell: Cell, x: Array, options: argparse.Namespace) -> Carry:
    """Compute a carry with the timing that the options request, by default the timing of an
    exported job.

    Args:
        cell: the cell.
        x: (n_var,) decision vector.
        options: parsed command line.
    """
    model = cell.timing_model
    if options.planned_limit is not None:
        return exported_carry(cell, time_path(model, x, model.drive_limits(options.planned_limit)))
    if options.timing == "fastest":
        return exported_carry(cell, time_path(model, x, TimingLimits()))
    if options.timing == "closest":
        return exported_carry(cell, closest_to_reference_timing(model, x))
    return driven_carry(cell, x)
