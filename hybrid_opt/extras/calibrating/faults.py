"""Faults of a recorded run, each with its name."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybrid_opt.extras.calibrating.estimate import Load, MeasuredHold, delay, fit_load
from hybrid_opt.extras.calibrating.recording import TARE_TIME, PadMotion, Recording, pad_motion
from symbolic.array import Array
from symbolic.records import Workcell
from symbolic.records.poses import inverse
from symbolic.records.quantities import GRAVITY, STANDARD_GRAVITY

LARGEST_RESIDUAL = 0.1
"""Largest residual force of the fit of a load, as a share of the weight."""

FULL = 0.98
"""Share of a sensor's range above which the sensor may be saturated."""

VANISHED = 0.1
"""Share of a hold's usual squeeze below which the squeeze counts as lost."""

LEAST_NORMAL = 0.5
"""Least normal force as a share of the whole force; with less, which would be a friction of 1.7,
the stated frame is wrong."""

LARGEST_CLOCK_OFFSET = 0.03
"""Least difference of both arms' clocks that is reported [s]: the box transmits normal forces at
once."""

LARGEST_DELAY = 5.0
"""Largest delay between the clocks of both arms that is considered [s]."""

LONGEST_STEP = 0.5
"""Largest usual time step of a recording [s]; with a larger one, the times are in another unit."""

LONGEST_LEVER = 10.0
"""Largest moment about a pad over the normal force and the patch radius; with a larger one, moments
are in another unit. Pressure at the rim of the patch gives 1."""

FORCE_UNITS = (("kgf", 1.0 / STANDARD_GRAVITY), ("lbf", 0.224809), ("kN", 1e-3), ("mN", 1e3))
"""Units in which forces are stated by mistake, with the number of each unit per newton."""

LIKE_UNIT = 0.2
"""Largest relative difference between a force converted from such a unit and the known force."""

LEAST_PULL, SHARE_PULL = 5.0, 0.2
"""Pull on pads outside of labelled holds above which a tare counts as wrong [N], and the same as a
share of the range of the normal force. The larger of both applies."""

TARE_CHANGE, TARE_ERRORS = 2.0, 6.0
"""Change of the mean force within a tare above which an arm counts as touching something [N], and
the same in standard errors."""


@dataclass(frozen=True)
class Fault:
    """A fault of a recording.

    Attributes:
        run: name of the recording, '' for a fault of all runs together.
        name: name of the fault.
        text: the problem and the remedy.
        serious: True if the run, or all runs, cannot be used for sensors, load and friction.
    """

    run: str
    name: str
    text: str
    serious: bool = True

    def __str__(self) -> str:
        where = f"{self.run}: " if self.run else ""
        return f"{where}{self.name}: {self.text}"


def recording_faults(workcell: Workcell, run: Recording, motion: PadMotion) -> list[Fault]:
    """Return the faults of a single run, such as lost samples, wrong units or frames, and unequal
    clocks; empty for none.

    Of faults that would mislead the check of the others only the first kind is returned.

    Args:
        workcell: the cell.
        run: the run.
        motion: pad poses and wrenches of the run, without the sensors' offsets.
    """
    found = [*_dropouts(run), *_range_faults(run)]
    if not run.has_moments:
        text = "the centre of mass and torsion cannot be seen; record all six numbers"
        found.append(Fault(run.name, "moments missing", text, serious=False))
    # One kind of fault is reported at a time: what follows from it would mislead.
    return found + (
        _unit_faults(workcell, run, motion)
        or _tare_faults(run, motion)
        or _frame_faults(run, motion)
        or _clock_faults(run, motion)
        or _pad_faults(workcell, run, motion)
    )


def _tare_faults(run: Recording, motion: PadMotion) -> list[Fault]:
    """Check the labelled tares of a run: instants at which the arms touch nothing and the sensors'
    offsets are measured.

    A tare has a fault if nothing was recorded, or if an arm touches something.

    Args:
        run: the run.
        motion: pad poses and wrenches of the run.

    Returns:
        The faults; an empty list for none.
    """
    found = []
    recorded = [instant for instant in run.labels.tare if run.around(instant).any()]
    if not recorded:
        found.append("name an instant of the recording at which both arms touch nothing")
    for instant in recorded:
        inside = run.around(instant)
        force, asked = run.wrench[inside, :, :3], np.nan_to_num(run.commanded[inside]).max()
        first, second = (half.mean(axis=0) for half in np.array_split(force, 2))
        error = force.std(axis=0) * np.sqrt(4.0 / len(force))
        change = np.abs(second - first)
        at = f"at {instant:g} s "
        if any(begin <= instant <= end for begin, end in run.labels.held):
            found.append(f"{at}the pads hold the box; name an instant when both are free")
        elif asked > 1.0:
            found.append(f"{at}{asked:.1f} N are commanded; name an instant when both are free")
        elif (change > np.maximum(TARE_CHANGE, TARE_ERRORS * error)).any():
            found.append(
                f"{at}forces change by {change.max():.1f} N; name an instant at which both arms "
                "stand still and touch nothing"
            )
    held = _held(run)
    free = np.cumsum(held) * np.cumsum(held[::-1])[::-1] == 0
    if not found and held.any() and free.any() and not run.labels.empty:
        wide = max(1, round(TARE_TIME / run.steps.max()))
        smooth = np.apply_along_axis(np.convolve, 0, motion.normal, np.ones(wide) / wide, "same")
        least, pressed = smooth[free].min(axis=0), smooth[held].min(axis=0)
        pull = np.maximum(LEAST_PULL, SHARE_PULL * np.ptp(smooth, axis=0))
        if (least < np.minimum(pressed, 0.0) - pull).any():
            found.append(
                f"the pads pull by {-least.min():.0f} N before or after all holds: at the tare "
                "they pressed, or the tool's weight is not compensated"
            )
    return [Fault(run.name, "missing tare", text) for text in found]


def _frame_faults(run: Recording, motion: PadMotion) -> list[Fault]:
    held = _held(run)
    if not held.any() or run.labels.empty:
        return []
    normal = np.median(motion.normal[held], axis=0)
    force = np.median(np.linalg.norm(motion.wrench[held, :, :3], axis=2), axis=0)
    if (normal >= LEAST_NORMAL * force).all():
        return []
    told = ", ".join(f"{n:.0f} of {f:.0f} N" for n, f in zip(normal, force, strict=True))
    text = f"arms press with {told}; tell what acts on the arm, in the stated frame"
    return [Fault(run.name, "wrong sign or frame", text)]


def _held(run: Recording) -> Array:
    """Find the samples of a run within a labelled hold.

    Returns:
        (n,) True for these samples.
    """
    found = np.zeros(len(run.time), dtype=bool)
    for span in run.labels.held:
        found |= run.within(*span)
    return found


def _unit_faults(workcell: Workcell, run: Recording, motion: PadMotion) -> list[Fault]:
    found = []
    if run.steps.max() > LONGEST_STEP:
        found.append(f"a sample every {run.steps.max():g} s; times look like ms")
    for robot, q in zip(workcell.robots, run.joints, strict=True):
        beyond = np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper))
        if (np.abs(q).max(axis=0) > 1.5 * beyond).any():
            found.append(f"{robot.name!r} is far beyond its joint limits; they look like degrees")
    held = _held(run)
    if not found and held.any() and not run.labels.empty:
        found = _force_units(run, motion, held) or _moment_units(workcell, motion, held)
    return [Fault(run.name, "unit error", text) for text in found]


def _force_units(run: Recording, motion: PadMotion, held: Array) -> list[str]:
    """Return texts about forces that seem to be in another unit, compared with the commanded forces
    or with the forces of the other arm.

    Args:
        run: the run.
        motion: pad poses and wrenches of the run.
        held: (n,) True for samples within a labelled hold.
    """
    force = np.median(np.linalg.norm(motion.wrench[held, :, :3], axis=2), axis=0)
    commands = np.isfinite(run.commanded).any(axis=0)
    asked = np.nanmedian(np.where(commands, run.commanded[held], 0.0), axis=0)
    for unit, factor in FORCE_UNITS:
        for i in range(2):
            near = LIKE_UNIT * factor
            told = f"{force[i]:.3g} measured by arm {i + 1} where {asked[i]:.3g} are commanded"
            if abs(force[i] - factor * asked[i]) < near * asked[i]:
                return [f"{told}; the measured look like {unit}"]
            if factor < 1.0 and abs(asked[i] - factor * force[i]) < near * force[i]:
                return [f"{told}; the commanded look like {unit}"]
            if factor < 1.0 and abs(force[i] - factor * force[1 - i]) < near * force[1 - i]:
                return [
                    f"arm {i + 1} measures {force[i]:.3g}, the other {force[1 - i]:.3g}; the "
                    f"first look like {unit}"
                ]
    return []


def _moment_units(workcell: Workcell, motion: PadMotion, held: Array) -> list[str]:
    """Return texts about moments that seem to be in another unit, compared with what the contact
    patches can transmit.

    Args:
        workcell: the cell.
        motion: pad poses and wrenches of the run.
        held: (n,) True for samples within a labelled hold.
    """
    normal = np.abs(np.median(motion.normal[held], axis=0)).mean()
    for i, contact in enumerate(workcell.contacts):
        moment = float(np.median(np.linalg.norm(motion.wrench[held, i, 3:], axis=1)))
        if moment > LONGEST_LEVER * contact.patch_radius * normal:
            unit = "N mm" if moment > 2.0 * normal else "N cm"
            return [f"moments of arm {i + 1} are {moment:.3g}; they look like {unit}"]
    return []


def _dropouts(run: Recording) -> list[Fault]:
    """Return faults of intervals without new samples, and of labelled holds that the recording does
    not contain; empty for none.

    Args:
        run: the run.
    """
    found = [
        f"nothing new for {end - begin:.2f} s from {begin:.2f} s on" for begin, end in run.lost
    ]
    room = run.steps.max()
    first, last = run.time[0] - room, run.time[-1] + room
    outside = [span for span in run.labels.held if span[0] < first or span[1] > last]
    if outside:
        spans = ", ".join(f"{begin:g} to {end:g}" for begin, end in outside)
        found.append(
            f"both arms recorded from {run.time[0]:.2f} to {run.time[-1]:.2f} s, not all of the "
            f"holds from {spans} s"
        )
    text = "; holds with it are left out"
    return [Fault(run.name, "dropout", each + text, serious=False) for each in found]


def _range_faults(run: Recording) -> list[Fault]:
    found = []
    for what, largest, part in zip(
        ("force", "moment"), run.largest, np.split(run.wrench, 2, axis=2), strict=True
    ):
        most = float(np.nanmax(np.abs(part), initial=0.0))
        if most >= FULL * largest:
            text = f"{what} {most:.1f} of {largest:g}; squeeze less, or take another sensor"
            found.append(Fault(run.name, "beyond the sensor's range", text))
    return found


def _pad_faults(workcell: Workcell, run: Recording, motion: PadMotion) -> list[Fault]:
    """Return faults that the holds of a run show: swapped arms, pads that stand beside each other,
    and normal forces that vanish. The list is empty for none.

    Args:
        workcell: the cell.
        run: the run.
        motion: pad poses and wrenches of the run.
    """
    found = []
    nominal = inverse(workcell.contacts[0].T_box_pad) @ workcell.contacts[1].T_box_pad
    room = sum(contact.patch_radius for contact in workcell.contacts)

    def apart(pads: Array) -> float:
        between = np.linalg.inv(pads[:, 0]) @ pads[:, 1]
        return float(np.median(np.linalg.norm(between[:, :2, 3] - nominal[:2, 3], axis=1)))

    for begin, end in run.labels.held:
        inside = run.within(begin, end)
        if not inside.any() or run.labels.empty:
            continue
        far = apart(motion.pads[inside])
        if far > room and run.joints[0].shape == run.joints[1].shape:
            other = pad_motion(workcell, replace(run, joints=run.joints[::-1]))
            if apart(other.pads[inside]) < room:
                text = (
                    "with the joints exchanged the pads face one another; check which arm is which"
                )
                return [Fault(run.name, "swapped arms", text)]
        if far > room:
            text = (
                f"they stand {1e3 * far:.0f} mm beside one another from {begin:g} to {end:g} s; "
                "check the joints' order, which arm is which, and the bases"
            )
            found.append(Fault(run.name, "pads do not overlap", text))
        gone = vanished(motion.normal[inside])
        if gone.any():
            at = run.time[inside][int(np.argmax(gone))]
            text = f"at {at:.2f} s, in a hold from {begin:g} to {end:g} s, which is left out"
            found.append(Fault(run.name, "squeeze vanishes", text, serious=False))
    return found


def vanished(normal: Array) -> Array:
    """Find the samples of a hold at which the smaller of both normal forces nearly vanishes.

    Args:
        normal: (n, 2) normal force of each arm [N].

    Returns:
        (n,) True for these samples.
    """
    squeeze = normal.min(axis=1)
    usual = np.quantile(squeeze, 0.75) if len(squeeze) else 0.0
    return np.asarray((squeeze < VANISHED * usual) & (usual > 0.0))


def _clock_faults(run: Recording, motion: PadMotion) -> list[Fault]:
    late = delay(
        run.time, motion.normal[:, 0], motion.normal[:, 1], LARGEST_DELAY, LARGEST_CLOCK_OFFSET
    )
    if late is None or abs(late) <= LARGEST_CLOCK_OFFSET:
        return []
    text = (
        f"arm 2's normal force comes {late:.2f} s after arm 1's, although the box hands it on at "
        "once; record both on one clock"
    )
    return [Fault(run.name, "clock offset", text)]


def load_faults(holds: list[MeasuredHold], load: Load, moments: bool) -> list[Fault]:
    """Return the faults that the balance of forces in all holds shows: wrong units, swapped arms,
    or an unknown cause. The list is empty for none.

    Args:
        holds: measurements of the box held still.
        load: the load estimated from all of them.
        moments: True if the sensors measure moments.
    """
    left = LARGEST_RESIDUAL * abs(load.mass * GRAVITY[2])
    if load.residual > left:
        other = fit_load([replace(hold, wrench=hold.wrench[::-1]) for hold in holds], moments)
        if other.residual < load.residual / 2.0:
            text = (
                f"with the sensors exchanged {other.residual:.1f} N of the forces are left, as "
                f"they are {load.residual:.1f} N; check which arm is which"
            )
            return [Fault("", "swapped arms", text)]
    free = fit_load([replace(hold, mass=None) for hold in holds], moments)
    weighed = next((hold.mass for hold in holds if hold.mass), None)
    for unit, factor in FORCE_UNITS if weighed else ():
        near = LIKE_UNIT * factor * (weighed or 0.0)
        if abs(free.mass - factor * (weighed or 0.0)) < near and free.deviations[0] < near:
            text = f"forces of a box of {weighed:g} kg look like {unit}, not N"
            return [Fault("", "unit error", text)]
    if load.residual <= left:
        return []
    text = (
        f"{load.residual:.1f} N of the forces are not explained by a weight of "
        f"{10.0 * left:.1f} N; allowed are 10 %: check frames, tares and the tool's weight"
    )
    return [Fault("", "residual", text)]
