"""Slip thresholds of many carries in the simulator."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count, islice
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.errors import WitnessError
from hybrid_opt.store.trajectory_file import read_trajectory
from hybrid_opt.timing import TimingLimits
from hybrid_opt.timing.solve import time_path
from hybrid_opt.witness.box import Witness, drive_of, planned_moments
from hybrid_opt.witness.scene import SimulationSettings
from symbolic.array import Array
from symbolic.records.task import initial_decision

CELLS = ("rack", "transfer")
FRICTIONS = (1.0, 0.6, 0.3)
TIMINGS = {
    "closest": TimingLimits(reference_speed=True),
    "55 N": TimingLimits(force=55.0),
    "fastest": TimingLimits(),
}
DRAWN = 400
"""Random candidates among which feasible ones are looked for at a time."""

LOW, HIGH, BISECTIONS = 0.98, 1.04, 3
"""Factors between which a threshold is looked for, to 0.4 %."""

WIDER, MORE_BISECTIONS = 1.62, 6
"""Upper end for what slips at the usual one, and what is as exact there."""

PRESSED_SHARE = 0.97
"""Share of the holding force that is pressed all along to see where the box slips first."""

TILT_STIFFNESS = 300.0
"""Tilt stiffness of pads that the planned moments drive [N m/rad]."""


@dataclass(frozen=True)
class Case:
    """One carry to simulate: where it comes from, and the friction that it is pressed for."""

    name: str
    candidate: str
    timing: str
    friction: float
    cell: Cell
    carry: Carry


def thresholds(options: argparse.Namespace) -> int:
    """Print the threshold of every carry that the options ask for; returns the exit code."""
    settings = SimulationSettings(
        tilt_stiffness=TILT_STIFFNESS if options.pads == "driven" else None
    )
    found: list[float] = []
    away_in_time: list[float] = []
    rng = np.random.default_rng(options.seed)
    print("cell      candidate   timing   friction  force [N]  threshold  first slip [s]  planned")
    with TemporaryDirectory() as folder:
        for case in islice(
            _cases(options.files, Path(folder), rng), options.skip, options.skip + options.carries
        ):
            factor, begins, planned = _threshold(case, settings)
            found.append(factor)
            away_in_time.append(abs(begins - planned))
            print(
                f"{case.name:9} {case.candidate:11} {case.timing:8} {case.friction:8.2f}  "
                f"{case.carry.peak_normal_force.max():9.2f}  {factor:9.4f}  {begins:14.3f}  "
                f"{planned:7.3f}",
                flush=True,
            )
    away = np.abs(np.array(found) - 1.0)
    print(
        f"{len(found)} carries: median {np.median(found):.4f}, from {min(found):.4f} to "
        f"{max(found):.4f}; {int((away <= 0.03).sum())} within 3 % of 1; the first slip within "
        f"0.1 s of the plan's in {int((np.array(away_in_time) <= 0.1).sum())}"
    )
    return 0


def _threshold(case: Case, settings: SimulationSettings) -> tuple[float, float, float]:
    """The least factor; when the box slips first under a force that is the same all along and a
    little below; and when the plan asks for more than that."""
    carry, witness = case.carry, Witness(case.carry.workcell, settings)
    moments = planned_moments(case.cell, carry)
    drive = drive_of(carry, settings, moments=moments)
    try:
        factor = witness.threshold(drive, LOW, HIGH, BISECTIONS).factor
    except WitnessError:
        factor = witness.threshold(drive, LOW, WIDER, MORE_BISECTIONS).factor
    needed = carry.normal_force[:, 1]
    steady = drive_of(carry, settings, np.full(len(carry), needed.max()), moments=moments)
    slips = witness.simulate(steady, PRESSED_SHARE * factor)
    planned = carry.time[np.flatnonzero(needed > PRESSED_SHARE * needed.max())[0]]
    return factor, slips.begins(settings.slip), float(planned)


def _cases(files: Sequence[str], folder: Path, rng: np.random.Generator) -> Iterator[Case]:
    """Endless: hand-made trajectories with every timing and friction, then the files' and random
    ones, which take the frictions in turn."""
    shipped = Path(__file__).parents[1] / "workcells"
    cells = {name: Cell.load(shipped / f"{name}.toml") for name in CELLS}
    for name, cell in cells.items():
        x = initial_decision(cell.workcell.task)
        for friction in FRICTIONS:
            yield from _timed(cell, (name, "hand-made"), x, (friction,) * len(TIMINGS))
    for k, file in enumerate(files):
        stored = read_trajectory(file)
        cell = stored.open_cell(folder / str(k))
        yield from _timed(cell, ("file", Path(file).parent.name[-11:]), stored.x, _turned(k))
    for k in count():
        for name, cell in cells.items():
            yield from _timed(cell, (name, "random"), _feasible(cell, rng), _turned(k))


def _turned(k: int) -> tuple[float, ...]:
    """One friction per timing, others for the next trajectory."""
    return tuple(FRICTIONS[(k + i) % len(FRICTIONS)] for i in range(len(TIMINGS)))


def _timed(
    cell: Cell, names: tuple[str, str], x: Array, frictions: tuple[float, ...]
) -> Iterator[Case]:
    """A trajectory with every timing that can be had, and one friction for each."""
    for (timing, limits), friction in zip(TIMINGS.items(), frictions, strict=True):
        timed = time_path(cell.timing_model, x, limits)
        if timed.ok and timed.carry is not None:
            yield Case(*names, timing, friction, cell, _pressed(cell, timed.carry, friction))


def _feasible(cell: Cell, rng: np.random.Generator) -> Array:
    """(n_var,) a feasible candidate drawn evenly from the bounds."""
    while True:
        x = rng.uniform(cell.lower, cell.upper, (DRAWN, cell.n_var))
        feasible = np.flatnonzero(cell.evaluate(x).feasible)
        if len(feasible):
            found: Array = x[feasible[0]]
            return found


def _pressed(cell: Cell, carry: Carry, friction: float) -> Carry:
    """The carry in a cell of another friction, with the forces planned for it."""
    workcell = cell.workcell
    first, second = (replace(contact, friction=friction) for contact in workcell.contacts)
    load = cell.timing_model.uncertain_load(
        carry, np.full(2, friction), workcell.payload.centre_of_mass
    )
    return replace(
        carry,
        workcell=replace(workcell, contacts=(first, second)),
        normal_force=load["normal_force"],
    )
