"""Margins of a carry: heavier payloads, less friction, wrong centres of mass; and the cost of
limits in a fastest timing.

Margins apply to a `Carry`, under the search's timing or under a drivable one.

A timing is a vector s of squared path speeds at grid points. To first order the fastest timing near
it is a linear program: minimise the slope of the duration times ds, within the slack of every limit
that s nearly uses. Where a parameter of the cell raises the ratio of a quantity to its limit by dr
at the same speeds, the slack falls by dr. The program gives the cost: dr times the limit's
multiplier, and where limits are active together, as for both arms of a symmetric cell, the
directional derivative (the envelope theorem). Neither the timing nor its utilisation is recomputed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array

from hybrid_opt.carry import Carry
from hybrid_opt.static_hold import mass_at_reference
from hybrid_opt.timing.model import REFINEMENT, SpeedProfile, TimingModel
from hybrid_opt.timing.records import FRICTION_RATIO, Timing
from symbolic.array import Array
from symbolic.contact.elastic import free_shift, pressure_shifts
from symbolic.contact.registry import contact_model
from symbolic.errors import SettingsError
from symbolic.records.poses import box_rotation

KILOGRAM_FORCE = 9.80665
"""[N] per kgf."""

SCAN_STEPS = 16
"""Steps of the scan that brackets a carry's failure."""

MARGIN_BISECTIONS = 20
LEAST_FRICTION_SHARE = 0.02
"""The scan of friction ends at this share of the nominal coefficient."""


@dataclass(frozen=True)
class PayloadSensitivity:
    """Contact forces against payload mass, to which they are proportional (paper Figure 12).

    Attributes:
        mass: the workcell's payload mass [kg].
        resultant: (2,) largest total contact force of each robot at this mass [N].
        mass_by_resultant: (2,) payload mass [kg] at which each robot's total contact force reaches
            its reference force, as the paper defines it.
    """

    mass: float
    resultant: Array
    mass_by_resultant: Array

    @property
    def payload_limit(self) -> float:
        """The smallest payload mass [kg] at which the total contact force of a robot reaches its
        reference force."""
        return float(self.mass_by_resultant.min())

    def force_at(self, masses: Array) -> Array:
        """Return the largest total contact forces (n, 2) [N] of both robots at other payload
        masses.

        Args:
            masses: (n,) payload masses [kg].
        """
        forces: Array = np.asarray(masses)[:, None] / self.mass * self.resultant
        return forces


@dataclass(frozen=True)
class Margin:
    """Largest error of one assumption that a carry tolerates.

    Attributes:
        quantity: name of the assumed quantity, such as a friction coefficient.
        unit: unit of `nominal` and `limit`, '' for a pure number.
        nominal: value of the quantity in the workcell.
        limit: last value of the quantity at which no limit is exceeded, to 1e-7 of the scanned
            range.
        fails: name of the limit that is exceeded beyond it, '' if none is exceeded in the scanned
            range.
    """

    quantity: str
    unit: str
    nominal: float
    limit: float
    fails: str


def payload_sensitivity(carry: Carry) -> PayloadSensitivity:
    """Return how the contact forces of a carry depend on the payload mass, at unchanged timing."""
    cell = carry.workcell
    forces = carry.peak_normal_force, carry.peak_resultant_force
    limited = contact_model(cell).limited_force(*forces)
    return PayloadSensitivity(cell.payload.mass, limited, mass_at_reference(cell, limited))


def robustness_margins(model: TimingModel, carry: Carry) -> tuple[Margin, ...]:
    """Compute the largest errors of friction, centre of mass and patch size that a carry tolerates.

    Motion and timing stay the same. For each changed value the forces are computed anew, so the
    robots press as hard as necessary. The carry fails if a normal force exceeds its reference
    force, a centre of pressure leaves its patch, or a joint torque exceeds its maximum.

    Args:
        model: timing model of the workcell.
        carry: the carry.

    Returns:
        One margin for each changed quantity. Elastic pads have no margin of the patch size; theirs
        states how far the centre of pressure may shift until the pad's rim lifts off.
    """
    workcell = model.workcell
    payload, contacts, task = workcell.payload, workcell.contacts, workcell.task
    names = [robot.name for robot in workcell.robots]
    friction = np.array([contact.friction for contact in contacts])
    radius = np.array([contact.patch_radius for contact in contacts])
    centre, own_torque = np.array(payload.centre_of_mass), carry.stack_arms("own_torque")
    wrench_torque = model.wrench_torque(carry.q, carry.pose)
    has_patches = model.carry_limits.has_pressure_limit

    def failure(friction: Array, centre: Array) -> str:
        """Return the name of the limit that is exceeded most in a cell with other friction and
        centre of mass; '' if none is exceeded.

        Args:
            friction: (2,) friction coefficients.
            centre: (3,) centre of mass in the box frame [m].
        """
        load = model.uncertain_load(carry, friction, centre)
        torque = model.contact_torque(wrench_torque, load) + own_torque
        use = {
            "normal force": float((load["normal_force"] / task.reference_force).max()),
            "joint torque": float(
                (np.abs(torque) / workcell.stack_joint_limits("torque_max")).max()
            ),
        }
        if has_patches:
            use["pressure shift"] = float((load["pressure_shift"] / radius).max())
        name = max(use, key=lambda key: use[key])
        return "" if use[name] <= 1.0 else name

    def lowered(whose: str, which: Array) -> Margin:
        """Return the margin of the friction coefficients of some contacts, all multiplied by one
        factor below 1.

        Args:
            whose: name of these contacts, for the margin.
            which: (2,) 1 for these contacts, 0 for the other one.
        """
        nominal = float(friction[which > 0.0].min())
        lost, fails = _largest_feasible_change(
            lambda lost: failure(friction * (1.0 - lost * which), centre),
            1.0 - LEAST_FRICTION_SHARE,
        )
        return Margin(f"friction of {whose}", "", nominal, nominal * (1.0 - lost), fails)

    def shifted(axis: int, sign: float) -> Margin:
        """Return how far the centre of mass may shift along one axis of the box, at most to the
        box's face.

        Args:
            axis: index of the axis: 0, 1 or 2.
            sign: 1 or -1, the direction along the axis.
        """
        nominal, direction = float(centre[axis]), sign * np.eye(3)[axis]
        offset, fails = _largest_feasible_change(
            lambda offset: failure(friction, centre + offset * direction),
            float(payload.size[axis]) / 2.0 - sign * nominal,
        )
        name = f"centre of mass towards {'+' if sign > 0.0 else '-'}{'xyz'[axis]}"
        return Margin(name, "m", nominal, nominal + sign * offset, fails)

    margins = [
        lowered("both contacts", np.array([1.0, 1.0])),
        *(lowered(name, which) for name, which in zip(names, np.eye(2), strict=True)),
        *(shifted(axis, sign) for axis in range(3) for sign in (1.0, -1.0)),
    ]
    if has_patches:
        # The least patch radius is the largest shift where no force depends on it.
        patches = zip(names, radius.tolist(), carry.peak_pressure_shift.tolist(), strict=True)
        margins += [
            Margin(f"patch radius of {name}", "m", nominal, shift, "pressure shift")
            for name, nominal, shift in patches
        ]
    return (*margins, *_even_margins(model, carry))


def _even_margins(model: TimingModel, carry: Carry) -> list[Margin]:
    """Compute the margin of each elastic pad against lift-off of its rim [m]: the shift of the
    centre of pressure at which the rim lifts off, and the part of this shift that the carry leaves
    unused.

    The list is empty for contact models without elastic pads.

    Args:
        model: timing model of the workcell.
        carry: the carry.
    """
    workcell = model.workcell
    if not contact_model(workcell).has_elastic_layers:
        return []
    load = model.load(carry.pose, carry.rate, carry.second_rate)
    turned = box_rotation(workcell.task.orientation, carry.pose)
    about = np.zeros((len(carry), 6))
    for i, contact in enumerate(workcell.contacts):
        parts = load[f"wrench_{i + 1}"].reshape(-1, 2, 3)
        force, moment = np.einsum("nji,nkj->kni", turned, parts)
        lever = np.cross(contact.T_box_pad[:3, 3], force)
        about += np.hstack([force, moment + lever])
    largest = pressure_shifts(workcell, about, load["normal_force"]).max(axis=0)
    found = []
    for robot, contact, share in zip(workcell.robots, workcell.contacts, largest, strict=True):
        room = free_shift(contact)
        name = f"room left for the pressure of {robot.name}"
        found.append(Margin(name, "m", room, room * (1.0 - float(share)), "pad lifts off"))
    return found


def _largest_feasible_change(failure: Callable[[float], str], end: float) -> tuple[float, str]:
    """Find the largest change before the first failure.

    A scan brackets the first failure, so that a later recovery does not hide it.

    Args:
        failure: function from a change to the name of what fails, '' if nothing fails.
        end: largest change that is tried; the smallest is 0.

    Returns:
        The change, and the name of the failure beyond it, '' if nothing fails up to `end`.
    """
    fails = failure(0.0)
    if fails:
        return 0.0, fails
    for low, high in pairwise(np.linspace(0.0, end, SCAN_STEPS + 1).tolist()):
        fails = failure(high)
        if not fails:
            continue
        for _ in range(MARGIN_BISECTIONS):
            middle = (low + high) / 2.0
            reason = failure(middle)
            low, high, fails = (low, middle, reason) if reason else (middle, high, fails)
        return low, fails
    return end, ""


LINEARISED_UTILISATION = 0.97
"""Limits used beyond this share enter the linear program."""

TRUST_RADIUS = 0.02
"""Largest relative change of every squared speed in a nearby timing."""

OPTIMALITY_GAP = 5e-3
"""A timing counts as the fastest if the linear program shortens it by less than this share."""

EXTRAPOLATED_CHANGE, NEGLIGIBLE_CHANGE = 1e-4, 1e-10
"""Largest change of a ratio in a program, by scaling, and changes that count as zero [share of a
limit]."""

DIFFERENCE_STEP = 1e-6
"""Step of finite differences, relative to the largest value."""


class TimingSensitivity:
    """Linear program of the timings near the fastest timing of a path. It tells how parameters of
    the workcell change the shortest duration.

    Attributes:
        speeds: path speeds of the fastest timing.
    """

    def __init__(self, model: TimingModel, timing: Timing) -> None:
        """Linearise the limits that a timing uses almost fully.

        Args:
            model: timing model of the workcell, with as many intervals as the timing.
            timing: fastest timing of a path, by `time_path`.

        Raises:
            SettingsError: there is no timing, or the timing is not the fastest.
        """
        if timing.carry is None or not len(timing.grid_speed):
            raise SettingsError(f"there is no timing: {timing.reason}")
        self.speeds = at = SpeedProfile.from_grid_speed(timing.grid_speed)
        motion, intervals = model.path_motion(timing.carry.x), model.intervals

        def ratios(**more: float) -> dict[str, Array]:
            carry = at.carry(model, motion, **more)
            return model.carry_limits.ratios(carry, timing.limits)

        here = ratios()
        del here[FRICTION_RATIO]  # tight by construction
        self._used = {
            name: np.nonzero(ratio >= LINEARISED_UTILISATION) for name, ratio in here.items()
        }
        used = self._select_used(here)
        step_a, step_w = (DIFFERENCE_STEP * float(np.abs(part).max()) for part in (at.a, at.w))
        by_a = (self._select_used(ratios(a=step_a)) - used) / step_a
        by_w = (self._select_used(ratios(w=step_w)) - used) / step_w
        sample = np.concatenate([rows for rows, _ in self._used.values()])
        # Within an interval w = s_0 + share (s_1 - s_0) and a = (s_1 - s_0) / (2 width).
        turn, share, interval = by_a * intervals / 2.0, at.share[sample], sample // (REFINEMENT + 1)
        values = np.concatenate([(1.0 - share) * by_w - turn, share * by_w + turn])
        places = np.tile(np.arange(len(sample)), 2), np.concatenate([interval, interval + 1])
        matrix = csr_array((values, places), shape=(len(sample), intervals + 1))[:, 1:-1]
        speed = timing.grid_speed
        pace = 2.0 / intervals / (speed[:-1] + speed[1:]) ** 2
        slope = -(pace[:-1] + pace[1:]) / (2.0 * speed[1:-1])  # both ends stand still
        scale = speed[1:-1] ** 2  # shares of these are around one
        self._slope, self._matrix = slope * scale, matrix * scale[None, :]
        self._left = np.maximum(1.0 - used, 0.0)
        self._least = self._least_change(self._left)
        if not self._least > -OPTIMALITY_GAP * timing.duration:
            raise SettingsError(
                "the timing is not the fastest within its limits; time it again", code="not-fastest"
            )

    def changes(self, low: dict[str, Array], high: dict[str, Array]) -> tuple[float, float]:
        """Compute to first order how the shortest duration changes if one number of the workcell
        file is raised or lowered by a small step.

        Args:
            low: ratios of all limited quantities to their limits (`CarryLimits.ratios`) with the
                number lowered by the step. Path and speeds (attribute `speeds`) are those of the
                fastest timing.
            high: the same ratios with the number raised by the step.

        Returns:
            Change of the duration [s] with the number raised, and with it lowered; NaN if no timing
            near the fastest one satisfies the changed limits.
        """
        more = (self._select_used(high) - self._select_used(low)) / 2.0
        largest = float(np.abs(more).max(initial=0.0))
        if largest < NEGLIGIBLE_CHANGE:
            return 0.0, 0.0
        # Large enough for the program's tolerance.
        times = EXTRAPOLATED_CHANGE / largest
        rise, fall = (
            (self._least_change(self._left - sign * times * more) - self._least) / times
            for sign in (1.0, -1.0)
        )
        return rise, fall

    def _select_used(self, ratios: dict[str, Array]) -> Array:
        return np.concatenate([ratios[name][places] for name, places in self._used.items()])

    def _least_change(self, left: Array) -> float:
        """Return the smallest change of the duration [s], negative if it falls, that the limits
        allow; NaN if no timing satisfies them.

        Args:
            left: (m,) slack of each of m limits.
        """
        found = linprog(
            self._slope,
            A_ub=self._matrix,
            b_ub=left,
            bounds=(-TRUST_RADIUS, TRUST_RADIUS),
            method="highs",
            options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
        )
        return float(found.fun) if found.status == 0 else float("nan")
