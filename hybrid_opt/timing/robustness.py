"""How much a carry could bear: heavier payloads, less friction, wrong centres of mass.

All functions are pure and judge a `Carry`, under the search's timing or under a drivable one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.static_hold import mass_at_reference, static_hold
from hybrid_opt.timing.limits import limits_pressure
from hybrid_opt.timing.model import TimingModel, contact_torque
from hybrid_opt.timing.records import TimingLimits
from symbolic.array import Array
from symbolic.contact.elastic import free_shift, pressure_shifts
from symbolic.contact.force_closure import presses_evenly
from symbolic.records import Workcell
from symbolic.records.poses import box_rotation

KILOGRAM_FORCE = 9.80665
"""[N] per kgf."""

SCAN_STEPS = 16
"""Steps of the scan that brackets where a carry fails."""

BISECTIONS = 20
LEAST_FRICTION_SHARE = 0.02
"""The scan of friction ends at this share of the nominal coefficient."""


@dataclass(frozen=True)
class PayloadSensitivity:
    """Forces against payload mass (paper Figure 12); they grow in proportion to it.

    Attributes:
        mass: the workcell's payload [kg].
        resultant: (2,) largest |f_i| of each robot at that mass [N].
        normal: (2,) largest normal force of each robot at that mass [N].
        mass_by_resultant: (2,) payload at which each robot's |f_i| reaches its reference force
            [kg]; the paper's reading.
        mass_by_normal: (2,) payload at which each robot's normal force reaches it [kg].
        static_mass: payload at which the resultant of a robot reaches its reference force in a
            level box at rest [kg].
    """

    mass: float
    resultant: Array
    normal: Array
    mass_by_resultant: Array
    mass_by_normal: Array
    static_mass: float

    @property
    def payload_limit(self) -> float:
        """Payload at which the first robot reaches its reference force with |f_i| [kg]."""
        return float(self.mass_by_resultant.min())

    def force_at(self, masses: Array) -> Array:
        """(n, 2) largest |f_i| [N] at payload masses (n,) [kg]."""
        forces: Array = np.asarray(masses)[:, None] / self.mass * self.resultant
        return forces


@dataclass(frozen=True)
class Margin:
    """How wrong one assumption may be before the carry fails.

    Attributes:
        quantity: what is wrong.
        unit: of the values, '' for a pure number.
        nominal: what the workcell assumes.
        limit: the last value at which the carry holds, found to a 1e-7 of the scanned range.
        fails: what fails beyond it, '' where nothing does within the scanned range.
    """

    quantity: str
    unit: str
    nominal: float
    limit: float
    fails: str


def payload_sensitivity(carry: Carry) -> PayloadSensitivity:
    """Forces against payload mass for an unchanged timing."""
    workcell = carry.workcell
    resultant, normal = carry.peak_resultant_force, carry.peak_normal_force
    return PayloadSensitivity(
        workcell.payload.mass,
        resultant,
        normal,
        mass_at_reference(workcell, resultant),
        mass_at_reference(workcell, normal),
        static_hold(workcell).payload_limit,
    )


def robustness_margins(model: TimingModel, carry: Carry) -> tuple[Margin, ...]:
    """How far friction, centre of mass and patch size may be off before the carry fails.

    The forces are allocated anew for the changed values (the robots squeeze as hard as it takes);
    the carry fails when a normal force exceeds its reference force, a centre of pressure leaves
    its patch, or a joint torque exceeds its maximum. Motion and timing stay as they are. Pads that
    press evenly have a margin until a rim lifts off in place of one of the patch.
    """
    judge = _Judge(model, carry)
    names = [robot.name for robot in model.workcell.robots]
    margins = [
        _friction_margin(judge, "friction of both contacts", np.array([1.0, 1.0])),
        _friction_margin(judge, f"friction of {names[0]}", np.array([1.0, 0.0])),
        _friction_margin(judge, f"friction of {names[1]}", np.array([0.0, 1.0])),
    ]
    margins += [_centre_margin(judge, axis, sign) for axis in range(3) for sign in (1.0, -1.0)]
    return (*margins, *_patch_margins(carry, model.workcell), *_even_margins(model, carry))


class _Judge:
    """Re-evaluates one carry with other friction coefficients and centres of mass.

    Attributes:
        workcell: the cell.
        friction: (2,) nominal coefficients.
        centre: (3,) nominal centre of mass [m].
    """

    def __init__(self, model: TimingModel, carry: Carry) -> None:
        self.workcell = model.workcell
        self.friction = np.array([contact.friction for contact in model.workcell.contacts])
        self.centre = np.array(model.workcell.payload.centre_of_mass)
        self._model = model
        self._carry = carry
        self._own_torque = carry.side_by_side("own_torque")
        self._wrench_torque = model.wrench_torque(carry.q, carry.pose)
        self._torque_max = np.concatenate([robot.torque_max for robot in model.workcell.robots])
        self._radius = np.array([contact.patch_radius for contact in model.workcell.contacts])

    def failure(self, friction: Array, centre: Array) -> str:
        """Name of the limit that is exceeded most, or '' where everything holds."""
        load = self._model.uncertain_load(self._carry, friction, centre)
        torque = contact_torque(self.workcell, self._wrench_torque, load) + self._own_torque
        reference = self.workcell.task.reference_force
        use = {
            "normal force": float((load["normal_force"] / reference).max()),
            "joint torque": float((np.abs(torque) / self._torque_max).max()),
        }
        if limits_pressure(self.workcell, TimingLimits()):
            use["pressure shift"] = float((load["pressure_shift"] / self._radius).max())
        name = max(use, key=lambda key: use[key])
        return "" if use[name] <= 1.0 else name


def _friction_margin(judge: _Judge, name: str, which: Array) -> Margin:
    """Margin of the coefficients marked by `which` (2,), lowered by the same share."""
    nominal = float(judge.friction[which > 0.0].min())
    lost, fails = _last_holding(
        lambda lost: judge.failure(judge.friction * (1.0 - lost * which), judge.centre),
        1.0 - LEAST_FRICTION_SHARE,
    )
    return Margin(name, "", nominal, nominal * (1.0 - lost), fails)


def _centre_margin(judge: _Judge, axis: int, sign: float) -> Margin:
    """Margin of the centre of mass along one box axis, up to the box's faces."""
    nominal, direction = float(judge.centre[axis]), sign * np.eye(3)[axis]
    room = float(judge.workcell.payload.size[axis]) / 2.0 - sign * nominal
    offset, fails = _last_holding(
        lambda offset: judge.failure(judge.friction, judge.centre + offset * direction), room
    )
    name = f"centre of mass towards {'+' if sign > 0.0 else '-'}{'xyz'[axis]}"
    return Margin(name, "m", nominal, nominal + sign * offset, fails)


def _patch_margins(carry: Carry, workcell: Workcell) -> list[Margin]:
    """The least patch radius is the largest pressure shift where no force depends on it."""
    if not limits_pressure(workcell, TimingLimits()):
        return []
    return [
        Margin(
            f"patch radius of {robot.name}",
            "m",
            contact.patch_radius,
            float(shift),
            "pressure shift",
        )
        for robot, contact, shift in zip(
            workcell.robots, workcell.contacts, carry.peak_pressure_shift, strict=True
        )
    ]


def _even_margins(model: TimingModel, carry: Carry) -> list[Margin]:
    """The shift of the pressure that has to be free before an elastic pad lifts off at a rim is the
    largest one of the carry."""
    workcell = model.workcell
    if not presses_evenly(workcell):
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
        name = f"room for the pressure of {robot.name}"
        found.append(Margin(name, "m", room, room * float(share), "pad lifts off"))
    return found


def _last_holding(failure: Callable[[float], str], end: float) -> tuple[float, str]:
    """Largest change in [0, end] up to which nothing fails, and what fails beyond it.

    A scan brackets the first failure, so that a carry that fails and recovers is not misjudged.
    """
    fails = failure(0.0)
    if fails:
        return 0.0, fails
    for low, high in pairwise(np.linspace(0.0, end, SCAN_STEPS + 1).tolist()):
        fails = failure(high)
        if not fails:
            continue
        for _ in range(BISECTIONS):
            middle = (low + high) / 2.0
            reason = failure(middle)
            low, high, fails = (low, middle, reason) if reason else (middle, high, fails)
        return low, fails
    return end, ""
