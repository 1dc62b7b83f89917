"""What is wrong with a recorded run, each fault by its name."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybrid_opt.calibrating.estimate import Hold, Load, delay, fit_load, swapped
from hybrid_opt.calibrating.recording import Places, Run
from symbolic.array import Array
from symbolic.records import Workcell
from symbolic.records.poses import inverse
from symbolic.records.quantities import GRAVITY, STANDARD_GRAVITY

LARGEST_RESIDUAL = 0.1
"""Force that the fit of a load may leave, over the weight."""

FULL = 0.98
"""Share of a sensor's range from which on it may not show all."""

VANISHED = 0.1
"""Share of a hold's median squeeze below which it has vanished."""

APART = 0.03
"""Difference of both arms' clocks that is told [s]: the box hands normal forces on at once."""

LONGEST_STEP = 0.5
"""Usual step of a recording above which its times are in another unit [s]."""

LONGEST_LEVER = 3.0
"""Moments over forces above which moments are in another unit [m]."""

FORCE_UNITS = (("kgf", 1.0 / STANDARD_GRAVITY), ("lbf", 0.224809), ("mN", 1e3))
"""Units that forces are told in by mistake, in newtons."""

LIKE_UNIT = 0.2
"""How near the mass in another unit has to be to the known one, as a share."""


@dataclass(frozen=True)
class Fault:
    """Something that is wrong.

    Attributes:
        run: its name; '' for all.
        name: of the fault.
        text: what was found, and what to do.
        serious: whether the run (all runs) says nothing of sensors, load and friction.
    """

    run: str
    name: str
    text: str
    serious: bool = True

    def __str__(self) -> str:
        where = f"{self.run}: " if self.run else ""
        return f"{where}{self.name}: {self.text}"


def recording_faults(workcell: Workcell, run: Run, places: Places) -> list[Fault]:
    """What a run shows by itself."""
    units = _unit_faults(workcell, run)
    if units:
        return units
    found = [
        *_dropouts(run),
        *_range_faults(run),
        *_pad_faults(workcell, run, places),
        *_clock_faults(run, places),
    ]
    if not any(run.around(instant).any() for instant in run.labels.tare):
        text = "name an instant of the recording at which both arms touch nothing"
        found.append(Fault(run.name, "missing tare", text))
    if not run.has_moments:
        text = "the centre of mass and torsion cannot be seen; record all six numbers"
        found.append(Fault(run.name, "moments missing", text, serious=False))
    held = _held(run)
    if held.any() and not run.labels.empty:
        normal = np.median(places.normal[held], axis=0)
        if (normal < 0.0).any():
            text = "the sensors tell of pulling; tell what acts on the arm, in the stated frame"
            found.append(Fault(run.name, "wrong sign or frame", text))
    return found


def _held(run: Run) -> Array:
    """(n,) which samples lie in a hold."""
    found = np.zeros(len(run.time), dtype=bool)
    for span in run.labels.held:
        found |= run.within(*span)
    return found


def _unit_faults(workcell: Workcell, run: Run) -> list[Fault]:
    found = []
    step = float(np.median(np.diff(run.time)))
    if step > LONGEST_STEP:
        found.append(f"a sample every {step:g} s; times look like ms")
    for robot, q in zip(workcell.robots, run.joints, strict=True):
        beyond = np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper))
        if (np.abs(q).max(axis=0) > 1.5 * beyond).any():
            found.append(f"{robot.name!r} is far beyond its joint limits; they look like degrees")
    if run.has_moments:
        force, moment = (float(np.linalg.norm(part)) for part in np.split(run.wrench, 2, axis=2))
        if moment > LONGEST_LEVER * force:
            found.append(f"moments are {moment / force:.0f} m times forces; they look like N mm")
    return [Fault(run.name, "unit error", text) for text in found]


def _dropouts(run: Run) -> list[Fault]:
    return [
        Fault(
            run.name,
            "dropout",
            f"nothing new for {end - begin:.2f} s from {begin:.2f} s on; holds with it are left "
            "out",
            serious=False,
        )
        for begin, end in run.lost
    ]


def _range_faults(run: Run) -> list[Fault]:
    found = []
    for what, largest, part in zip(
        ("force", "moment"), run.largest, np.split(run.wrench, 2, axis=2), strict=True
    ):
        most = float(np.nanmax(np.abs(part), initial=0.0))
        if most >= FULL * largest:
            text = f"{what} {most:.1f} of {largest:g}; squeeze less, or take another sensor"
            found.append(Fault(run.name, "beyond the sensor's range", text))
    return found


def _pad_faults(workcell: Workcell, run: Run, places: Places) -> list[Fault]:
    """Pads that do not stand as they hold the box, and a squeeze that vanishes."""
    found = []
    nominal = inverse(workcell.contacts[0].T_box_pad) @ workcell.contacts[1].T_box_pad
    room = sum(contact.patch_radius for contact in workcell.contacts)
    for begin, end in run.labels.held:
        inside = run.within(begin, end)
        if not inside.any() or run.labels.empty:
            continue
        between = np.linalg.inv(places.pads[inside, 0]) @ places.pads[inside, 1]
        beside = between[:, :2, 3] - nominal[:2, 3]
        far = float(np.median(np.linalg.norm(beside, axis=1)))
        if far > room:
            text = (
                f"they stand {1e3 * far:.0f} mm beside one another from {begin:g} to {end:g} s; "
                "check the joints' order, which arm is which, and the bases"
            )
            found.append(Fault(run.name, "pads do not overlap", text))
        squeeze = places.normal[inside].min(axis=1)
        gone = squeeze < VANISHED * np.median(squeeze)
        if np.median(squeeze) > 0.0 and gone.any():
            at = run.time[inside][int(np.argmax(gone))]
            text = f"at {at:.2f} s, in a hold from {begin:g} to {end:g} s, which is left out"
            found.append(Fault(run.name, "squeeze vanishes", text, serious=False))
    return found


def _clock_faults(run: Run, places: Places) -> list[Fault]:
    late = delay(run.time, places.normal[:, 0], places.normal[:, 1])
    if late is None or abs(late) <= APART:
        return []
    text = (
        f"arm 2's normal force comes {late:.2f} s after arm 1's, although the box hands it on at "
        "once; record both on one clock"
    )
    return [Fault(run.name, "clock offset", text)]


def load_faults(holds: list[Hold], load: Load, known: float, moments: bool) -> list[Fault]:
    """What the balance of all holds shows: other units, swapped arms, or what nobody knows.

    Args:
        load: what they show together.
        known: mass of the box that is known, from a scale or the workcell [kg].
        moments: whether the sensors tell moments.
    """
    left = LARGEST_RESIDUAL * abs(load.mass * GRAVITY[2])
    if load.residual > left:
        other = fit_load([swapped(hold) for hold in holds], moments)
        if other.residual < load.residual / 2.0:
            text = (
                f"with the sensors exchanged {other.residual:.1f} N of the forces are left, as "
                f"they are {load.residual:.1f} N; check which arm is which"
            )
            return [Fault("", "swapped arms", text)]
    free = fit_load([replace(hold, mass=None) for hold in holds], moments)
    for unit, factor in FORCE_UNITS:
        near = LIKE_UNIT * factor * known
        if abs(free.mass - factor * known) < near and free.deviations[0] < near:
            text = f"forces of a box of {known:g} kg look like {unit}, not N"
            return [Fault("", "unit error", text)]
    if load.residual <= left:
        return []
    text = (
        f"{load.residual:.1f} N of the forces are not explained by a weight of "
        f"{10.0 * left:.1f} N; allowed are 10 %: check frames, tares and the tool's weight"
    )
    return [Fault("", "residual", text)]
