"""Slip thresholds of many carries in the simulator, stored one by one."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.errors import SimulationError
from hybrid_opt.extras.simulation.box import BoxSimulation, Outcome, bisected, drive_of
from hybrid_opt.extras.simulation.scene import SimulationSettings
from hybrid_opt.front import search
from hybrid_opt.store.files import read_record, to_json, write_json
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array, Figure
from symbolic.records import Workcell

WORKCELLS = Path(__file__).parents[1] / "workcells"

CANDIDATE_KINDS = ("hand-made", "fastest", "random", "middle", "random", "gentlest")
"""Candidates of a cell, in turn; all but the hand-made and the random ones of a short search."""

FRICTIONS, SHARES = (1.0, 0.6, 0.3), (1.0, 0.9, 0.8)
"""Frictions of pads with opposite normals; for others, which little friction does not close, shares
of the cell's own."""

SEARCHED = 500
"""Evaluations of the search whose front members are simulated."""

DRAWN_CANDIDATES = 100
"""Random candidates among which a feasible one is looked for at a time."""

LOW, HIGH, BISECTIONS = 0.97, 1.03, 4
"""Factors between which a threshold is looked for, to 0.2 %."""

WIDER, MORE_BISECTIONS = (0.5, 2.0), 9
"""Range and bisections with which a threshold beyond them is looked for."""

FINE_POINTS = 91
"""Points of a patch where normals are not opposite: force rises there by up to five times the share
by which friction falls, and so does the error of a disc's torsion with 37 points."""

PRESSED_SHARE, HOLDING_SHARE = 0.95, 1.05
"""Shares of the holding force that are pressed all along to see where the box slips first: where it
moves farther with the first than with the second."""

FARTHER = 2e-5
"""Slip beyond that of a box that is held, at which the box is said to slip [m]. A plan often asks
for its most for some hundredths of a second, in which a box that lacks some percent of its force
moves by no more. Later on a held one may creep as far, and as much again as pads give along the
normals of others."""

ALLOWED = {"disc": 0.03, "rectangle": 0.05, "fork": 0.05}
"""How far from one a threshold may be, by the kind of pads."""

SAME_PLACE = 0.1
"""Time around the plan's first demand within which the first slip counts as there [s]."""


@dataclass(frozen=True)
class Slip:
    """Result of the simulator for one carry.

    Attributes:
        cell, candidate: name of the cell and kind of the candidate.
        friction: friction coefficient for which the forces are planned.
        pads: kind of the pads, a key of `ALLOWED`.
        duration: duration of the carry [s].
        force: largest planned normal force of pad 2 [N].
        threshold: least multiple of the planned force that holds the box; NaN if there is none.
        begins: time at which the box slips first under a constant force a little below the least
            that holds [s], see `first_slip`; NaN if it does not slip.
        planned: time at which the planned force first exceeds nearly its largest value [s].
    """

    cell: str
    candidate: str
    friction: float
    pads: str
    duration: float
    force: float
    threshold: Figure
    begins: Figure
    planned: float

    @property
    def within(self) -> bool:
        """True if the least multiple of the planned force that holds the box differs from 1 by at
        most the tolerance in `ALLOWED`.
        """
        return abs(self.threshold - 1.0) <= ALLOWED[self.pads]

    @property
    def in_place(self) -> bool:
        """True if the box first slips at about the time at which the planned force is largest."""
        return abs(self.begins - self.planned) <= SAME_PLACE

    def __str__(self) -> str:
        return (
            f"{self.cell:9} {self.candidate:10} {self.friction:8.2f} {self.duration:8.3f} s "
            f"{self.force:8.2f} N {self.threshold:9.4f} {self.begins:10.3f} s {self.planned:7.3f} s"
        )


@dataclass(frozen=True)
class Slips:
    """Results of all carries so far, as stored in a file.

    Attributes:
        seed: seed with which the carries are drawn.
        layer: stiffness of the pads' elastic layers [N/m^3].
        found: result of each carry, in order.
    """

    seed: int
    layer: float
    found: tuple[Slip, ...]


def thresholds(options: argparse.Namespace) -> int:
    """Find for every requested carry the least multiple of its planned force that holds the box in
    the simulator. Print and store the results, and return the exit code.

    Results in an existing file are kept, and the work goes on behind them.
    """
    path, done = options.output, Slips(options.seed, options.layer, ())
    if path.exists():
        done = read_record(Slips, path, "delete it to begin anew")
        if (done.seed, done.layer) != (options.seed, options.layer):
            raise SimulationError(
                f"{path} was begun with seed {done.seed} and layer {done.layer:g}; give these or "
                "a new file",
                code="another-seed",
            )
    paths = options.cells or sorted(WORKCELLS.glob("*.toml"))
    sources = {path.stem: _Source(path, options.seed) for path in paths}
    print("cell      candidate  friction  duration      force  threshold  slips first  planned")
    for slip in done.found:
        print(slip)
    for k in range(len(done.found), options.carries):
        have = Counter(slip.cell for slip in done.found)
        name = min(sources, key=lambda name: have[name])  # the first one of those with fewest
        slip = slip_of(*sources[name].case(have[name]), layer=options.layer)
        done = replace(done, found=(*done.found, slip))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, to_json(done))
        print(slip, f"  {k + 1} of {options.carries}", flush=True)
    print(summary(done.found))
    return 0


def summary(found: Sequence[Slip]) -> str:
    """Return lines of text on how many carries are held by about the planned force, and how many
    slip first at about the time at which the planned force is largest.
    """
    lines = []
    for pads, allowed in ALLOWED.items():
        some = np.array([slip.threshold for slip in found if slip.pads == pads])
        if len(some):
            within = int((np.abs(some - 1.0) <= allowed).sum())
            lines.append(
                f"{len(some)} carries, {pads} pads: threshold from {np.nanmin(some):.4f} to "
                f"{np.nanmax(some):.4f}, median {np.nanmedian(some):.4f}; {within} within "
                f"{100.0 * allowed:g} % of 1"
            )
    in_place = sum(slip.in_place for slip in found)
    lines.append(
        f"{in_place} of {len(found)} slip first within {SAME_PLACE:g} s of where the plan asks for "
        "most"
    )
    return "\n".join(lines)


def slip_of(
    name: str, candidate: str, carry: Carry, layer: float = SimulationSettings.layer
) -> Slip:
    """Simulate one carry with its planned forces, and find where the box slips first.

    Args:
        name: name of the cell.
        candidate: kind of the candidate.
        carry: the carry.
        layer: stiffness of the pads' elastic layers [N/m^3].
    """
    needed, settings = carry.normal_force[:, 1], SimulationSettings(layer=layer)
    if not carry.workcell.has_opposite_pads:
        settings = replace(settings, points=FINE_POINTS)
    witness, drive = BoxSimulation(carry.workcell, settings), drive_of(carry, settings)
    simulate = partial(witness.simulate, drive)
    factor = begins = float("nan")
    try:
        try:
            factor = bisected(simulate, LOW, HIGH, BISECTIONS).factor
        except SimulationError:
            factor = bisected(simulate, *WIDER, MORE_BISECTIONS).factor
        steady = replace(drive, press=np.full_like(drive.press, needed.max()))
        lacks, held = (
            witness.simulate(steady, share * factor) for share in (PRESSED_SHARE, HOLDING_SHARE)
        )
        begins = first_slip(lacks, held)
    except SimulationError:
        pass  # stays without a number
    return Slip(
        cell=name,
        candidate=candidate,
        friction=carry.workcell.contacts[0].friction,
        pads=pads_of(carry.workcell),
        duration=carry.duration,
        force=float(needed.max()),
        threshold=factor,
        begins=begins,
        planned=float(carry.time[needed > PRESSED_SHARE * needed.max()][0]),
    )


def first_slip(lacks: Outcome, held: Outcome) -> float:
    """Return the time [s] at which a box starts to slip; NaN if it does not.

    This is when its displacement in the plane of a pad exceeds that of a well-held box by
    `FARTHER`.

    Args:
        lacks: outcome of the simulation with too little force.
        held: outcome of the simulation with enough force.
    """
    n = min(len(lacks.time), len(held.time))
    beyond = np.flatnonzero((lacks.slip[:n] - held.slip[:n]).max(axis=1) > FARTHER)
    return float(lacks.time[beyond[0]]) if len(beyond) else float("nan")


def pads_of(workcell: Workcell) -> str:
    """Return the kind of a cell's pads, a key of `ALLOWED`: 'fork', 'rectangle' or 'disc'."""
    if len(workcell.pads) > 2:
        return "fork"
    return "rectangle" if any(pad.half_sides for pad in workcell.pads) else "disc"


class _Source:
    """Source of the carries of one cell; carry number k does not depend on the carries drawn
    before."""

    def __init__(self, path: Path, seed: int) -> None:
        self._drivable = cell = Cell.load(path).drivable()  # its files last as long as it
        self._name, self._seed = path.stem, seed
        if cell.workcell.task.allocation != "soft-finger":
            task = replace(cell.workcell.task, allocation="soft-finger")
            cell = Cell(replace(cell.workcell, task=task), cell.objective_names)
        self._cell = cell
        self._front: Array | None = None

    def case(self, k: int) -> tuple[str, str, Carry]:
        """Draw carry number k.

        Returns:
            Name of the cell, kind of the candidate, and the carry with its forces planned for the
            friction of case k.
        """
        cell, kind = self._cell, CANDIDATE_KINDS[k % len(CANDIDATE_KINDS)]
        model = cell.timing_model
        while True:
            x = self._candidate(kind, k)
            timing = time_path(model, x, model.drive_limits(float(x[-1])))
            if timing.ok and timing.carry is not None:
                break
            kind, k = "random", k + len(CANDIDATE_KINDS) * 10**6
        payload, contacts = cell.workcell.payload, cell.workcell.contacts
        opposite, own = cell.workcell.has_opposite_pads, contacts[0].friction
        known = FRICTIONS if opposite else tuple(share * own for share in SHARES)
        friction = np.full(2, known[(k + k // len(known)) % len(known)])
        load = model.uncertain_load(timing.carry, friction, payload.centre_of_mass)
        rubs = tuple(replace(contact, friction=float(friction[0])) for contact in contacts)
        workcell = replace(cell.workcell, contacts=(rubs[0], rubs[1]))
        carry = replace(timing.carry, workcell=workcell, normal_force=load["normal_force"])
        return self._name, kind, carry

    def _candidate(self, kind: str, k: int) -> Array:
        if kind == "hand-made":
            return self._cell.initial
        if kind == "random":
            return self._random(np.random.default_rng([self._seed, k]))
        if self._front is None:
            rng = np.random.default_rng(self._seed)
            self._front = search(self._cell, evaluations=SEARCHED, rng=rng).x
        row = {"fastest": 0, "middle": len(self._front) // 2, "gentlest": -1}[kind]
        return np.asarray(self._front[row])

    def _random(self, rng: np.random.Generator) -> Array:
        cell = self._cell
        while True:
            x = cell.random(DRAWN_CANDIDATES, rng)
            feasible = np.flatnonzero(cell.evaluate(x).feasible)
            if len(feasible):
                return np.asarray(x[feasible[0]])
