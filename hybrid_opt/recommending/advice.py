"""Margins of a cell's description at the commanded force, and effects of changes of the cell on a
carry.

The commanded force is the force that the worst case needs at the most demanding sample. A change of
the cell changes this force; the change is the difference of the forces in both cells. Timings of
the path within other force limits convert it to a change of the duration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from hybrid_opt.carry import BoxMotion, Carry
from hybrid_opt.cell import Cell
from hybrid_opt.compiled_cell import CACHED_WORKCELLS
from hybrid_opt.recommending.choice import DrivenPaths, Option
from hybrid_opt.robust.cases import LEADER, nominal_case
from hybrid_opt.robust.force import HOLDS, RobustModel, robust_model, subsample
from hybrid_opt.timing.records import Timing
from hybrid_opt.timing.robustness import Margin
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.records import Contact, Workcell
from symbolic.records.poses import box_rotation
from symbolic.records.task import POSE_SIZE

MARGIN_BISECTIONS = 20

MILLIMETRE = 1e-3

FRICTION_CHANGE = 0.05

DEGREE_CHANGE = np.pi / 180.0

PITCH = 4
"""Index of the pitch in a pose."""

FORCE_MULTIPLES = 1.0 + np.array([-0.02, 0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8])
"""Multiples of the force limit at which the path's duration is computed."""

LOOKED_AT = 8
"""Number of samples of largest commanded force at which the effects of changes are computed."""

LARGEST_SIDE_COSINE = 0.5
"""A contact counts as at a side of the payload, where it can be moved up or down, if the cosine
between its normal and the upward direction is smaller."""

LEAST_HEIGHT = 2e-3
"""The advice mentions the height of the pads over the centre of mass if it exceeds this [m]."""


@dataclass(frozen=True)
class Advice:
    """Effect of one change, of the cell or of one via-point, on the force and duration of a carry.

    `force` and `duration` state the same effect in two ways.

    Attributes:
        change: changed quantity and the size of its change, as text.
        force: change of the commanded force at an unchanged duration [N].
        duration: change of the duration at an unchanged commanded force [s].
    """

    change: str
    force: float
    duration: float

    def __str__(self) -> str:
        return f"{self.change}: {self.force:+.1f} N, or {self.duration:+.3f} s at the same force"


def commanded_margins(carry: Carry, forces: Array) -> tuple[Margin, ...]:
    """Compute how far friction, mass and centre of mass may be off before the commanded forces no
    longer hold the box along a carry.

    Only one quantity deviates at a time. One more margin states which share of the commanded force
    may be missing.

    Args:
        carry: the carry at n samples.
        forces: (n, 2) commanded normal force of each robot [N].
    """
    workcell, model = carry.workcell, robust_model(carry.workcell)
    rows, motion = subsample(carry)
    enough, nominal = forces[rows, 1 - LEADER] * (1.0 + HOLDS), nominal_case(workcell)

    def last(change: Array, end: float) -> tuple[float, str]:
        """Find the largest multiple of a deviation of the cell at which the commanded forces still
        hold the box.

        The force that the box needs has to grow with the multiple.

        Args:
            change: (18,) deviation from the nominal case, laid out by
                `symbolic.contact.worst_cases.CASE_SIZES` [SI units].
            end: largest multiple that is tried.

        Returns:
            The multiple; and what fails beyond it, '' if the multiple is `end`.
        """
        low, high = 0.0, end
        for step in range(MARGIN_BISECTIONS):
            middle = end if step == 0 else (low + high) / 2.0
            needed = model.least_squeeze(motion, (nominal + middle * change)[None], LEADER)
            holds = bool((needed[0, :, 1 - LEADER] <= enough).all())
            low, high = (middle, high) if holds else (low, middle)
            if low == end:
                return end, ""
        return low, "friction"

    def along(at: slice | int, value: float | Array) -> Array:
        change = np.zeros(len(nominal))
        change[at] = value
        return change

    size, centre = workcell.payload.size / 2.0, workcell.payload.centre_of_mass
    lost, fails = last(along(slice(0, 2), -nominal[0:2]), 0.98)
    least = float(nominal[0:2].min())
    found = [Margin("friction of both contacts", "", least, least * (1.0 - lost), fails)]
    more, fails = last(along(4, nominal[4]), 2.0)
    needed = model.nominal(motion)[:, 1 - LEADER]
    spare = float((1.0 - needed / enough).min())
    found.append(Margin("share of the force that is missing", "", 0.0, spare, "friction"))
    found.append(Margin("mass", "kg", float(nominal[4]), float(nominal[4] * (1.0 + more)), fails))
    for axis in range(3):
        for sign in (1.0, -1.0):
            room = float(size[axis] - sign * centre[axis])
            off, fails = last(along(5 + axis, sign), room)
            name = f"centre of mass towards {'+' if sign > 0.0 else '-'}{'xyz'[axis]}"
            at = float(centre[axis])
            found.append(Margin(name, "m", at, at + sign * off, fails))
    return tuple(found)


def advice(cell: Cell, paths: DrivenPaths, option: Option, timing: Timing) -> tuple[Advice, ...]:
    """Compute the effects of small changes of the cell and of via-points on a carry, the largest
    decrease of the commanded force first.

    Args:
        cell: the drivable cell: its carries are timed from rest to rest within all limits.
        paths: paths of the front.
        option: path and force limit of the recommended carry.
        timing: timing of the recommended carry.
    """
    assert timing.carry is not None, "what is driven has a carry"
    # With less the path may have no timing: a tilted box needs more than a level one.
    limits = np.minimum(
        FORCE_MULTIPLES * option.limit, max(paths.highest_force, option.limit)
    ).tolist()
    near: list[Option] = []
    for limit in limits:
        near += paths.options(limit, [option.index])
    forces = np.maximum.accumulate([each.commanded for each in near])
    durations, steps = np.array([each.duration for each in near]), np.flatnonzero(np.diff(forces))
    slope = 0.0
    if len(steps):
        low, high = steps[0], min(steps[0] + 2, len(near) - 1)
        slope = float((durations[high] - durations[low]) / (forces[high] - forces[low]))

    def in_time(force: float) -> float:
        """Convert a change of the commanded force at an unchanged duration to the change of the
        duration at an unchanged commanded force [s].

        Args:
            force: change of the commanded force [N].
        """
        spare = float(np.interp(option.commanded - force, forces, durations))
        lost = max(forces[0] - (option.commanded - force), 0.0)
        return float(spare - slope * lost - np.interp(option.commanded, forces, durations))

    found = list[Advice]()
    for change, force in changes_of_cell(cell.workcell, subsample(timing.carry)[1]):
        found.append(Advice(change, force, in_time(force)))
    found += _of_pitch(cell, paths.x[option.index], option, slope)
    return tuple(sorted(found, key=lambda each: each.force))


def changes_of_cell(workcell: Workcell, motion: BoxMotion) -> Iterator[tuple[str, float]]:
    """Yield small changes of the cell as text, each with the resulting change of the largest
    commanded force along a motion [N], negative if the force falls.

    Args:
        workcell: the cell.
        motion: motion of the box.
    """
    doubt = workcell.uncertainty
    now = robust_model(workcell).commanded(motion, doubt, LEADER)
    most = motion.at(np.argsort(-now)[:LOOKED_AT])
    for changed in changed_cells(workcell):
        needed = changed.model.commanded(motion if changed.is_large else most, doubt, LEADER)
        yield changed.change, float(needed.max() / changed.strength - now.max())


@dataclass(frozen=True)
class ChangedCell:
    """A cell with one small change of its pads.

    Attributes:
        change: changed quantity and the size of its change, as text.
        model: computes robust forces of the changed cell.
        strength: ratio of the holding forces (`ContactModel.strength`) of changed to present hands,
            by which forces are divided, because stronger hands may need a larger force.
        is_large: True if the change may move the largest force to other samples of a motion.
    """

    change: str
    model: RobustModel
    strength: float = 1.0
    is_large: bool = False


@lru_cache(maxsize=CACHED_WORKCELLS)
def changed_cells(workcell: Workcell) -> tuple[ChangedCell, ...]:
    """Return a cell with each small change that the advice considers; cached per workcell."""
    up, height = _height(workcell)
    changes: dict[str, Callable[[Contact], Contact]] = {
        f"friction {FRICTION_CHANGE:g} higher": _with_friction,
        "patches 1 mm wider to each side": _wider,
    }
    is_held_at_sides = all(
        abs(each.T_box_pad[:3, 2] @ up) < LARGEST_SIDE_COSINE for each in workcell.contacts
    )
    changes |= contact_model(workcell).own_changes
    if is_held_at_sides:
        changes["pads 1 mm lower"] = partial(_moved, by=-MILLIMETRE * up)
    found = []
    for name, change in changes.items():
        other = _with_pads(workcell, change)
        stronger = contact_model(other).strength / contact_model(workcell).strength
        found.append(ChangedCell(name, RobustModel(other), stronger))
    if is_held_at_sides and abs(height) > LEAST_HEIGHT:
        level = _with_pads(workcell, partial(_moved, by=-height * up))
        side = "above" if height > 0.0 else "below"
        now = f"now {1e3 * abs(height):.0f} mm {side} it"
        name = f"pads at the height of the centre of mass, {now}"
        found.append(ChangedCell(name, RobustModel(level), is_large=True))
    return tuple(found)


def _height(workcell: Workcell) -> tuple[Array, float]:
    """Compute the world's upward direction (3,) in the box frame at the start, and the height [m]
    of the pads' centres above the centre of mass, averaged over both robots.
    """
    pose = workcell.task.waypoints[0].lower
    up: Array = box_rotation(workcell.task.orientation, pose)[2]
    middles = [
        np.mean([pad.T_box_pad[:3, 3] for pad in (contact, *contact.further)], axis=0)
        for contact in workcell.contacts
    ]
    return up, float((np.mean(middles, axis=0) - workcell.payload.centre_of_mass) @ up)


def _with_pads(workcell: Workcell, change: Callable[[Contact], Contact]) -> Workcell:
    """Return the cell with a changed copy of every pad.

    Args:
        workcell: the cell.
        change: function from a pad to its changed copy.
    """
    first, second = (
        replace(change(contact), further=tuple(change(pad) for pad in contact.further))
        for contact in workcell.contacts
    )
    return replace(workcell, contacts=(first, second))


def _with_friction(pad: Contact) -> Contact:
    return replace(pad, friction=pad.friction + FRICTION_CHANGE)


def _moved(pad: Contact, by: Array) -> Contact:
    """Return a pad that is moved along its face.

    Args:
        pad: the pad.
        by: (3,) displacement in the box frame [m], which is projected onto the face.
    """
    T, normal = pad.T_box_pad.copy(), pad.T_box_pad[:3, 2]
    T[:3, 3] += by - (by @ normal) * normal
    return replace(pad, T_box_pad=T)


def _wider(pad: Contact) -> Contact:
    if pad.half_sides is None:
        return replace(pad, patch_radius=pad.patch_radius + MILLIMETRE)
    x, y = (side + MILLIMETRE for side in pad.half_sides)
    return replace(pad, patch_radius=float(np.hypot(x, y)), half_sides=(x, y))


def _of_pitch(cell: Cell, path: Array, option: Option, slope: float) -> Iterator[Advice]:
    """Yield the effect of one degree more, or less, pitch of the box at each via-point.

    A change is yielded only if it shortens the carry at the same commanded force. Via-points at
    which the changed path has no timing are left out.

    Args:
        cell: the drivable cell.
        path: (n_path,) decision vector of the carry without its force limit.
        option: timing of this path within a force limit.
        slope: change of the path's shortest duration per newton of commanded force, negative [s/N];
            0 if it is not known, for which nothing is yielded.
    """
    if slope == 0.0:
        return
    task, varied, names = cell.workcell.task, [], []
    for place in range(len(task.free_indices)):
        for sign in (1.0, -1.0):
            other = path.copy()
            other[POSE_SIZE * place + PITCH] += sign * DEGREE_CHANGE
            varied.append(other)
            name = task.pose_names[PITCH]
            names.append(f"{sign:+.0f} degree of {name} at via-point {place + 1}")
    for one in DrivenPaths(cell, np.array(varied)).options(option.limit):
        harder = one.commanded - option.commanded
        longer = one.duration - option.duration - slope * harder
        if longer < 0.0:
            yield Advice(names[one.index], -longer / slope, longer)
