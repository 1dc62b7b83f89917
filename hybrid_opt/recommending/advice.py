"""How far the cell may be off at the commanded force, and what changes of it would change.

The commanded force is in closed form: the worst case at the sample that asks for most. What a small
change of the cell changes there is its derivative, by differences; what more or less force means in
time is the path's own duration within other limits of the force.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from codegen.interpreted import InterpretedFunction
from codegen.source import dense
from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.recommending.choice import LEADER, DrivenPaths, Option
from hybrid_opt.robust.cases import least_friction, nominal_case, worst_cases
from hybrid_opt.robust.force import HOLDS, BoxMotion, pressing_model, thinned
from hybrid_opt.timing.records import Timing
from hybrid_opt.timing.robustness import Margin
from symbolic.array import Array
from symbolic.contact.worst_cases import case_squeeze_function
from symbolic.records import Contact, Workcell
from symbolic.records.poses import box_rotation
from symbolic.records.task import POSE_SIZE, components

BISECTIONS = 20

MILLIMETRE = 1e-3

FRICTION = 0.05

DEGREE = np.pi / 180.0

PITCH = 4
"""Index of the pitch among the numbers of a pose."""

LIMITS = 1.0 + np.array([-0.02, 0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8])
"""Multiples of the force limit at which the path's duration is computed."""

LEAST_HEIGHT = 2e-3
"""Height of the pads over the centre of mass above which the advice mentions it [m]."""


@dataclass(frozen=True)
class Advice:
    """Effect of one change of the cell or the path.

    Attributes:
        change: the quantity, and by how much it changes.
        force: change of the force to command, in the same time [N].
        duration: change of the duration, with the same force [s].
    """

    change: str
    force: float
    duration: float

    def __str__(self) -> str:
        return f"{self.change}: {self.force:+.1f} N, or {self.duration:+.3f} s at the same force"


def commanded_margins(carry: Carry, forces: Array) -> tuple[Margin, ...]:
    """How far friction, mass and centre of mass may be off, each for itself, while commanded forces
    (n, 2) [N] hold the carry."""
    workcell, model = carry.workcell, pressing_model(carry.workcell)
    rows, motion = thinned(carry)
    enough, nominal = forces[rows, 1 - LEADER] * (1.0 + HOLDS), nominal_case(workcell)

    def last(change: Array, end: float) -> tuple[float, str]:
        """Largest multiple of a change up to which it holds: it asks for more and more."""
        low, high = 0.0, end
        for step in range(BISECTIONS):
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
    """Effects of changes of the cell on a recommended carry, most force first."""
    assert timing.carry is not None, "what is driven has a carry"
    # With less the path may not move: a tilted box asks for more than a level one.
    limits = np.minimum(LIMITS * option.limit, max(paths.highest_force, option.limit)).tolist()
    near = [each for limit in limits for each in paths.options(limit, [option.index])]
    forces = np.maximum.accumulate([each.commanded for each in near])
    durations, steps = np.array([each.duration for each in near]), np.flatnonzero(np.diff(forces))
    slope = 0.0
    if len(steps):
        low, high = steps[0], min(steps[0] + 2, len(near) - 1)
        slope = float((durations[high] - durations[low]) / (forces[high] - forces[low]))

    def in_time(force: float) -> float:
        """What a change of the force to command is worth at the same force [s]."""
        spare = float(np.interp(option.commanded - force, forces, durations))
        lost = max(forces[0] - (option.commanded - force), 0.0)
        return float(spare - slope * lost - np.interp(option.commanded, forces, durations))

    found = [
        Advice(change, force, in_time(force))
        for change, force in _of_cell(cell.workcell, timing.carry)
    ]
    found += _of_pitch(cell, paths.x[option.index], option, slope)
    return tuple(sorted(found, key=lambda each: each.force))


def _of_cell(workcell: Workcell, carry: Carry) -> Iterator[tuple[str, float]]:
    """Changes of the cell, and what each adds to the largest commanded force [N]."""
    model, doubt = pressing_model(workcell), workcell.uncertainty
    _, motion = thinned(carry)
    cases = worst_cases(model.workcell, doubt, LEADER)

    def needed(cases: Array, motion: BoxMotion = motion) -> Array:
        return model.least_squeeze(motion, cases, LEADER)[:, :, 1 - LEADER]

    least = needed(cases)
    ruling, sample = np.unravel_index(int(least.argmax()), least.shape)
    peak, case = float(least.max()), cases[[ruling]]
    at = BoxMotion(*[getattr(motion, name)[[sample]] for name in vars(motion)])
    changed = case.copy()
    changed[:, 0:2] = least_friction(_with_friction(model.workcell, FRICTION), doubt)
    yield f"friction {FRICTION:g} higher", float(needed(changed, at).max()) - peak
    if not workcell.has_opposite_pads:
        return
    up, height = _height(workcell)
    changed = case.copy()
    changed[:, 11:15] -= MILLIMETRE * np.tile(up, 2)
    yield "pads 1 mm lower", float(needed(changed, at).max()) - peak
    if abs(height) > LEAST_HEIGHT:
        cases[:, 11:15] -= height * np.tile(up, 2)
        side = "above" if height > 0.0 else "below"
        yield (
            f"pads at the height of the centre of mass, now {1e3 * abs(height):.0f} mm {side} it",
            float(needed(cases).max()) - peak,
        )
    wider = InterpretedFunction(dense(case_squeeze_function(_with_wider(model.workcell))))
    found = wider(*[getattr(at, name)[0] for name in vars(at)], case[0])["normal_force"]
    yield "patches 1 mm wider to each side", float(found.ravel()[1 - LEADER]) - peak


def _height(workcell: Workcell) -> tuple[Array, float]:
    """(2,) the way up along the tangents of contact 1, as the box stands at its start, and how high
    the pads are over the centre of mass that way [m]."""
    pose = workcell.task.waypoints[0].lower
    axes = workcell.contacts[0].T_box_pad[:3, :2]
    up = (box_rotation(workcell.task.orientation, pose) @ axes)[2]
    places = [contact.T_box_pad[:3, 3] for contact in workcell.contacts]
    over = axes.T @ (np.mean(places, axis=0) - workcell.payload.centre_of_mass)
    return up, float(over @ up)


def _with_friction(workcell: Workcell, more: float) -> Workcell:
    first, second = (
        replace(contact, friction=contact.friction + more) for contact in workcell.contacts
    )
    return replace(workcell, contacts=(first, second))


def _with_wider(workcell: Workcell) -> Workcell:
    def wider(contact: Contact) -> Contact:
        sides = contact.half_sides
        return replace(
            contact,
            patch_radius=contact.patch_radius + MILLIMETRE,
            half_sides=None if sides is None else (sides[0] + MILLIMETRE, sides[1] + MILLIMETRE),
        )

    first, second = (wider(contact) for contact in workcell.contacts)
    return replace(workcell, contacts=(first, second))


def _of_pitch(cell: Cell, path: Array, option: Option, slope: float) -> Iterator[Advice]:
    """One more degree of pitch at every via-point, the better way round, if nothing is in the
    way."""
    if slope == 0.0 or not cell.path_timer.compiled:
        return
    task, varied, names = cell.workcell.task, [], []
    for place in range(len(task.free_indices)):
        for sign in (1.0, -1.0):
            other = path.copy()
            other[POSE_SIZE * place + PITCH] += sign * DEGREE
            varied.append(other)
            name = components(task.orientation)[PITCH]
            names.append(f"{sign:+.0f} degree of {name} at via-point {place + 1}")
    for one in DrivenPaths.of(cell, np.array(varied)).options(option.limit):
        harder = one.commanded - option.commanded
        longer = one.duration - option.duration - slope * harder
        if longer < 0.0:
            yield Advice(names[one.index], -longer / slope, longer)
