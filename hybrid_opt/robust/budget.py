"""Grip budget: the force that holds the payload at rest in every case of the uncertainty, compared
with the allowed force, and the smallest changes of the cell with which the force fits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, copysign, floor, log10

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from hybrid_opt.carry import BoxMotion, HeldMotion, at_standstill
from hybrid_opt.robust.cases import LEADER
from hybrid_opt.robust.force import RobustModel, interpreted_robust_model
from hybrid_opt.robust.squeeze import UNCERTAINTY_SOURCES
from symbolic.array import Array, Figure, Pair
from symbolic.errors import SettingsError
from symbolic.records import Contact, Uncertainty, Workcell
from symbolic.records.quantities import FRICTION

LISTED = 3
"""Number of remedies that are listed, the smallest changes first."""

PRECISION = 1e-4
"""Error of the factor of a remedy, on the safe side."""

UNBOUNDED = 1e3
"""Value of the excess if no force holds a case, because root finding needs finite numbers."""

NARROWEST = 1e-6
"""Factor on a range in place of zero, because a range of zero width would change the number of
worst cases."""

LEAST_MASS = 1e-3
"""Lighter payloads are considered down to this share of the mass."""

ROUNDING = 1e-6
"""Share by which a force may exceed its limit through rounding."""

HEAVIEST = 1e3
"""Heavier payloads are considered up to this multiple of the mass."""

LEAST_FRICTION = 0.02
"""Less friction is considered down to this share of the coefficients."""


@dataclass(frozen=True)
class Remedy:
    """One change of the cell with which the required normal forces stay within the reference
    forces.

    Attributes:
        change: changed quantity and its new value as text, such as 'a mass of 4.2 kg'.
        share: new value over present value, minus one.
    """

    change: str
    share: Figure

    def __str__(self) -> str:
        return f"{self.change} ({100.0 * self.share:+.1f} %)"


@dataclass(frozen=True)
class Reserve:
    """Largest payload and least friction with which the required normal forces stay within the
    reference forces.

    Payload and friction are changed one at a time, on an unchanged motion. The required forces hold
    the box in every case of the uncertainty around the changed value.

    Attributes:
        payload: largest mass of the payload [kg]; its inertia grows in proportion to the mass. NaN
            if no mass suffices.
        friction: least friction coefficient of the more slippery pad; the other pad's coefficient
            changes by the same factor. NaN if no coefficient suffices.
    """

    payload: Figure
    friction: Figure

    def __str__(self) -> str:
        return f"a box of up to {self.payload:.1f} kg, or friction down to {self.friction:.2f}"


@dataclass(frozen=True)
class GripBudget:
    """Normal forces that hold the payload at rest in every case of the uncertainty, compared with
    the reference forces.

    Attributes:
        required: (2,) normal force that each robot needs [N], the larger of those at the start and
            at the goal; infinite if no force holds the box in every case.
        allowed: (2,) reference force of each robot [N].
        uncertainty: ranges of friction, mass and the other uncertain quantities.
        remedies: smallest changes of the cell with which `required` stays within `allowed`; empty
            if no change is necessary or none suffices.
    """

    required: Pair
    allowed: Pair
    uncertainty: Uncertainty
    remedies: tuple[Remedy, ...]

    @property
    def fits(self) -> bool:
        """True if each robot holds the payload at rest within its reference force."""
        return bool((self.required <= self.allowed * (1.0 + ROUNDING)).all())

    def __str__(self) -> str:
        arm = int(np.argmax(self.required / self.allowed))
        required, allowed = self.required[arm], self.allowed[arm]
        force = f"{required:.1f} N of {allowed:.1f} N"
        if self.fits:
            force += f", {100.0 * (1.0 - required / allowed):.0f} % left for the motion"
        if not np.isfinite(required):
            force = f"no force holds every case, {allowed:.1f} N are allowed"
        return f"at rest, with {self.uncertainty.title}: {force}"

    @property
    def advice(self) -> str:
        """Sentence that lists the remedies as alternatives; '' if `remedies` is empty."""
        return remedies_text(self.remedies, "to hold it still; a motion takes more")


def budget_text(workcell: Workcell) -> str:
    """Describe the grip budget of a cell in one line for a terminal, with remedies if the required
    force exceeds the reference force.

    If the budget cannot be computed, the line states why.
    """
    try:
        budget = grip_budget(workcell)
    except SettingsError as error:
        return f"grip at rest: {error}"
    if budget.fits:
        return f"grip {budget}"
    return f"grip {budget}, which no carry can do; {budget.advice or 'no single change would do'}"


def remedies_text(remedies: tuple[Remedy, ...], purpose: str) -> str:
    """Return a sentence that lists remedies as alternatives; '' if there are none.

    Args:
        remedies: changes of the cell, each of which suffices alone.
        purpose: end of the sentence 'any of these would do ...', such as 'to hold it still'.
    """
    if not remedies:
        return ""
    return f"{', or '.join(map(str, remedies))}: any of these would do {purpose}"


def grip_budget(workcell: Workcell) -> GripBudget:
    """Compute the normal forces that hold the payload at rest at start and goal, and compare them
    with the reference forces. Nothing is compiled.

    Raises:
        SettingsError: no force holds the box in some case of the uncertainty, or the uncertainty
            leaves no friction or contact patch.
    """
    model, motion = interpreted_robust_model(workcell), _ends_at_rest(workcell)
    required, allowed = largest_forces(model, motion), workcell.task.reference_force
    budget = GripBudget(required, allowed, workcell.uncertainty, ())
    if budget.fits:
        return budget
    return replace(budget, remedies=cheapest_remedies(model, motion, required, allowed))


def required_at_rest(workcell: Workcell) -> Array:
    """Compute the normal force (2,) [N] with which each robot holds the payload at rest at start
    and goal in every case of the uncertainty.

    Raises:
        SettingsError: no force holds the box in some case of the uncertainty, or the uncertainty
            leaves no friction or contact patch.
    """
    return largest_forces(interpreted_robust_model(workcell), _ends_at_rest(workcell))


def _ends_at_rest(workcell: Workcell) -> BoxMotion:
    """Build a box motion of two samples: the payload at rest at the start and at the goal."""
    poses = np.array(
        [way.lower for way in (workcell.task.waypoints[0], workcell.task.waypoints[-1])]
    )
    return BoxMotion(poses, np.zeros_like(poses), np.zeros_like(poses))


def largest_forces(
    model: RobustModel, motion: HeldMotion, rows: NDArray[np.intp] | None = None
) -> Array:
    """Compute the largest normal force (2,) [N] that each robot needs over a motion to hold the box
    in every case of the uncertainty.

    Both the motion and a standstill in each of its poses count.

    Args:
        model: computes robust normal forces, which hold the box in every case of the uncertainty.
        motion: box poses and their time derivatives.
        rows: indices of the rows of `RobustModel.worst_cases` to consider; None for all.

    Raises:
        SettingsError: the uncertainty leaves no friction or contact patch.
    """
    uncertainty, forces = model.workcell.uncertainty, np.zeros(2)
    for each in (motion, at_standstill(motion)):
        command, leading = model.hold(each, uncertainty, LEADER, rows)
        forces = np.maximum(forces, np.array([leading.max(), command.max()]))
    return forces


def cheapest_remedies(
    model: RobustModel,
    motion: HeldMotion,
    required: Array,
    allowed: Array,
    most: int = LISTED,
) -> tuple[Remedy, ...]:
    """Find changes of the cell that bring the required forces along a motion within the reference
    forces.

    The reference forces, the mass, the friction and ranges of the uncertainty are changed, one of
    them at a time.

    Args:
        model: computes robust normal forces, which hold the box in every case of the uncertainty.
        motion: samples of the motion at which the required forces are largest.
        required: (2,) largest required normal force of each robot [N]. It may be larger than the
            samples need, for example because commanded forces are smoothed over time.
        allowed: (2,) reference force of each robot [N].
        most: largest number of remedies.

    Returns:
        At most `most` remedies, the smallest relative change first.
    """
    excess = _excess(model, motion, required, allowed)
    found = [*_stronger(required, allowed), *_of_cell(model.workcell, excess)]
    return tuple(sorted(found, key=lambda each: abs(each.share))[:most])


def reserve(model: RobustModel, motion: HeldMotion, required: Array, allowed: Array) -> Reserve:
    """Compute the largest payload, and the least friction, with which the required forces along a
    motion stay within the reference forces. Each is changed alone.

    Args:
        model: computes robust forces of the workcell.
        motion: samples of the motion at which the required forces are largest.
        required: (2,) largest required normal force of each robot [N].
        allowed: (2,) reference force of each robot [N].

    Returns:
        Mass [kg] and friction coefficient; NaN if no value within the considered range suffices.
    """
    excess, workcell = _excess(model, motion, required, allowed), model.workcell
    friction = min(pad.friction for pad in workcell.contacts)
    heavier = _last_factor(lambda f: excess(_with_mass(workcell, f)), LEAST_MASS, HEAVIEST)
    rougher = FRICTION.high / max(pad.friction for pad in workcell.contacts)
    smoother = _last_factor(lambda f: excess(_with_friction(workcell, f)), rougher, LEAST_FRICTION)
    return Reserve(heavier * workcell.payload.mass, smoother * friction)


def _last_factor(excess: Callable[[float], float], near: float, far: float) -> float:
    """Search from `near` towards `far` for the last factor at which a function is not positive. The
    function may change its sign once.

    Args:
        excess: function of the factor.
        near: factor at which the search begins.
        far: other end of the searched range, larger or smaller than `near`.

    Returns:
        The factor; NaN if the function is positive at `near`.
    """
    if excess(near) > 0.0:
        return float("nan")
    if excess(far) <= 0.0:
        return far
    root = float(brentq(excess, near, far, xtol=PRECISION))
    return root + copysign(PRECISION, near - far)


def _excess(
    model: RobustModel, motion: HeldMotion, required: Array, allowed: Array
) -> Callable[[Workcell], float]:
    """Return a function that computes by how much the required forces of a changed cell exceed the
    reference forces.

    The function takes the changed cell. It returns the largest ratio of a required force to its
    reference force, minus one: zero if the forces just fit. The required forces of the changed cell
    are estimated: `required` changes in proportion to the forces that hold the box in every case of
    the uncertainty.

    Args:
        model: computes robust normal forces of the unchanged cell, which hold the box in every case
            of the uncertainty.
        motion: samples of the motion at which the required forces are largest.
        required: (2,) required normal force of each robot in the unchanged cell [N].
        allowed: (2,) reference force of each robot [N].
    """
    known = largest_forces(model, motion)
    rows = model.governing_rows(motion, model.workcell.uncertainty, LEADER)
    # What a command holds beyond its motion, as by smoothing, stays in proportion.
    scale = required / known if np.isfinite(required).all() else np.ones(2)

    def excess(changed: Workcell) -> float:
        other = model.with_workcell(changed)
        if not other.has_worst_cases(changed.uncertainty):
            return UNBOUNDED
        force = largest_forces(other, motion, rows)
        return min(float((scale * force / allowed).max()) - 1.0, UNBOUNDED)

    return excess


def _with_mass(workcell: Workcell, factor: float) -> Workcell:
    payload = workcell.payload
    heavier = replace(payload, mass=factor * payload.mass, inertia=factor * payload.inertia)
    return replace(workcell, payload=heavier)


def _with_friction(workcell: Workcell, factor: float) -> Workcell:
    def changed(pad: Contact) -> Contact:
        further = tuple(changed(each) for each in pad.further)
        return replace(pad, friction=factor * pad.friction, further=further)

    first, second = map(changed, workcell.contacts)
    return replace(workcell, contacts=(first, second))


def _stronger(required: Array, allowed: Array) -> Iterator[Remedy]:
    if np.isfinite(required).all():
        least = required if len({*allowed.tolist()}) > 1 else required.max()
        forces = np.maximum(allowed, np.ceil(10.0 * least) / 10.0)
        named = " and ".join(f"{force:.1f}" for force in sorted({*forces.tolist()}))
        yield Remedy(f"a reference force of {named} N", float((forces / allowed).max() - 1.0))


def _of_cell(workcell: Workcell, excess: Callable[[Workcell], float]) -> Iterator[Remedy]:
    """Yield the smallest changes of a cell that bring its required forces within the reference
    forces.

    Each change concerns one quantity: the mass, the friction, or a range of the uncertainty.

    Args:
        workcell: the cell.
        excess: function of a changed cell from `_excess`; zero if the forces just fit.
    """
    payload, contacts, uncertainty = workcell.payload, workcell.contacts, workcell.uncertainty

    lighter = _smallest_change(lambda factor: excess(_with_mass(workcell, factor)), LEAST_MASS)
    if lighter is not None:
        mass = _three_digits(lighter * payload.mass, floor)
        yield Remedy(f"a mass of {mass:g} kg", mass / payload.mass - 1.0)
    coefficients = sorted({pad.friction for pad in contacts})
    rougher = _smallest_change(
        lambda factor: excess(_with_friction(workcell, factor)), FRICTION.high / coefficients[-1]
    )
    if rougher is not None:
        rounded = [_three_digits(rougher * value, ceil) for value in coefficients]
        named = " and ".join(f"{value:g}" for value in rounded)
        yield Remedy(f"friction of {named}", rounded[0] / coefficients[0] - 1.0)

    def with_ranges(names: tuple[str, ...], factor: float) -> Uncertainty:
        return replace(uncertainty, **{name: factor * getattr(uncertainty, name) for name in names})

    def excess_within(names: tuple[str, ...], factor: float) -> float:
        return excess(replace(workcell, uncertainty=with_ranges(names, factor)))

    every = tuple(name for names in UNCERTAINTY_SOURCES.values() for name in names)
    for names in (every, *UNCERTAINTY_SOURCES.values()):
        if uncertainty.restrict_to(names).is_empty:
            continue
        narrower = _smallest_change(partial(excess_within, names), NARROWEST)
        if narrower is not None:
            factor = floor(100.0 * narrower) / 100.0
            change = f"[uncertainty] with {with_ranges(names, factor).restrict_to(names)}"
            if names == every:
                change = f"every range of the uncertainty {factor:g} times as wide"
            yield Remedy(change, factor - 1.0)


def _smallest_change(excess: Callable[[float], float], far: float) -> float | None:
    """Search from 1 towards `far` for the first factor at which a function is not positive.

    Args:
        excess: function of the factor, positive at 1.
        far: other end of the searched range of factors.

    Returns:
        The factor; None if the function is positive at `far`.
    """
    if excess(far) > 0.0:
        return None
    root = float(brentq(excess, 1.0, far, xtol=PRECISION))
    low, high = sorted((1.0, far))
    return min(max(root + copysign(2.0 * PRECISION, far - 1.0), low), high)


def _three_digits(value: float, rounded: Callable[[float], int]) -> float:
    unit = 10.0 ** (floor(log10(value)) - 2)
    return float(round(rounded(value / unit) * unit, 12))
