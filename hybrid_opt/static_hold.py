"""Static hold: contact forces with the payload at rest, the largest payload that can be held, and a
check of all limits at rest.

The forces along a carry are never much smaller than at rest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from hybrid_opt.compiled_cell import CACHED_WORKCELLS
from symbolic.array import Array, Pair
from symbolic.contact.load import LOAD_OUTPUTS, uncertain_load_function
from symbolic.contact.registry import contact_model
from symbolic.errors import WorkcellError
from symbolic.records import Workcell
from symbolic.records.poses import box_rotation
from symbolic.records.quantities import FRICTION
from symbolic.records.task import initial_decision

if TYPE_CHECKING:
    from symbolic.robot.model import RobotModel

UTILISATION_TOLERANCE = 1e-6
"""Share of a limit by which a value may exceed the limit, for rounding errors."""

Outputs = Callable[[Array], dict[str, Array]]
"""Function from decision vectors (n, n_var) to all per-sample output arrays by name."""

REMEDY_BISECTIONS = 24
"""Number of bisections for the mass or the friction with which the payload could be held."""


@dataclass(frozen=True)
class StaticHold:
    """Contact forces that hold the payload level and at rest.

    Attributes:
        normal_force: (2,) normal force of each robot [N], read-only.
        contact_force: (2,) magnitude of each robot's contact force, normal and tangential together
            [N], read-only.
        payload_limit: payload mass at which a robot's contact force reaches its reference force
            [kg].
    """

    normal_force: Pair
    contact_force: Pair
    payload_limit: float


@lru_cache(maxsize=CACHED_WORKCELLS)
def static_hold(workcell: Workcell) -> StaticHold:
    """Compute the contact forces that hold the payload level and at rest; cached per workcell.

    If both pads have the friction coefficient mu, each normal force is m g / (2 mu) and each
    contact force has the magnitude (m g / 2) sqrt(1 + 1 / mu^2), with m the payload mass and g =
    9.81 m/s^2.
    """
    outputs = still_load(workcell, np.zeros(6))
    normal = outputs["normal_force"]
    whole = np.linalg.norm(outputs["contact_force"].reshape(2, 3), axis=1)
    for force in (normal, whole):
        force.setflags(write=False)
    limited = contact_model(workcell).limited_force(normal, whole)
    return StaticHold(normal, whole, payload_limit(workcell, limited))


def mass_at_reference(workcell: Workcell, force: Array) -> Array:
    """Compute for each robot the payload mass (2,) [kg] at which its force reaches its reference
    force.

    Forces along an unchanged motion are proportional to the mass (paper Figure 12).

    Args:
        workcell: the cell.
        force: (2,) peak force of each robot with the workcell's payload mass [N].
    """
    mass: Array = workcell.payload.mass * (workcell.task.reference_force / force)
    return mass


def payload_limit(workcell: Workcell, contact_force: Array) -> float:
    """Compute the least payload mass [kg] at which a robot's contact force reaches its reference
    force.

    Args:
        workcell: the cell.
        contact_force: (2,) peak magnitude of each robot's contact force with the workcell's payload
            mass [N].
    """
    return float(mass_at_reference(workcell, contact_force).min())


_load_of = lru_cache(maxsize=CACHED_WORKCELLS)(uncertain_load_function)


def still_load(
    workcell: Workcell, pose: Array, friction: float = 1.0, function: ca.Function | None = None
) -> dict[str, Array]:
    """Compute the contact forces and moments that hold the payload at rest in one pose.

    Args:
        workcell: the description of the cell.
        pose: (6,) box pose [m, rad].
        friction: factor on both friction coefficients.
        function: load function from `uncertain_load_function`; None for the cell's.

    Returns:
        Flat arrays by the names in `symbolic.contact.load.LOAD_OUTPUTS`.
    """
    coefficients = [friction * contact.friction for contact in workcell.contacts]
    centre = workcell.payload.centre_of_mass
    found = (function or _load_of(workcell))(pose, np.zeros(6), np.zeros(6), coefficients, centre)
    return {
        name: np.array(value, dtype=float).reshape(-1)
        for name, value in zip(LOAD_OUTPUTS, found, strict=True)
    }


@dataclass(frozen=True)
class StaticUtilisation:
    """Needed and allowed value of one limited quantity when the payload is at rest.

    Attributes:
        quantity: name of the limited quantity.
        whose: name of the robot, or of robot and joint as 'robot/joint'.
        where: end of the path, 'start' or 'goal'.
        needed: needed value [unit].
        allowed: limit [unit].
        unit: unit of both values, as text.
    """

    quantity: str
    whose: str
    where: str
    needed: float
    allowed: float
    unit: str

    @property
    def share(self) -> float:
        """Ratio of the needed value to the limit."""
        return self.needed / self.allowed

    @property
    def exceeded(self) -> bool:
        """True if the needed value exceeds the limit."""
        return self.share > 1.0 + UTILISATION_TOLERANCE

    def __str__(self) -> str:
        return (
            f"{self.whose} needs a {self.quantity} of {self.needed:.4g} {self.unit} at the "
            f"{self.where}, allowed are {self.allowed:.4g} {self.unit}"
        )


NORMAL, WHOLE = "normal force", "force in all"
PRESSURE, TORQUE = "shift of the pressure", "joint torque"


def static_hold_error(workcell: Workcell, outputs: Outputs | None = None) -> str:
    """Return why the payload cannot be held at rest, with a remedy; '' if it can be held.

    The payload is checked at the start and the goal. Forces are compared with the reference
    forces, and pressure shifts with the patch radius if the contact model limits them.

    Args:
        workcell: the description of the cell.
        outputs: `CandidateEvaluator.outputs`, to check joint torques as well, in the first and
            last posture of the hand-made trajectory; None for no check of torques.

    Raises:
        RobotModelError: a URDF does not give an arm.
    """
    still = _Still(workcell, [] if outputs is None else _ends(workcell, outputs))
    exceeded = still.exceeded()
    if not exceeded:
        return ""
    worst: dict[tuple[str, str], StaticUtilisation] = {}
    for use in sorted(exceeded, key=lambda use: -use.share):
        worst.setdefault((use.quantity, use.whose), use)
    told = "; ".join(str(use) for use in worst.values())
    return f"it cannot be held still: {told}. {still.remedy(exceeded)}"


def require_hold(workcell: Workcell, outputs: Outputs | None = None) -> None:
    """Raise an error if the payload of a cell cannot be held at rest.

    Args:
        workcell: the description of the cell.
        outputs: `CandidateEvaluator.outputs`, to check joint torques as well, or None.

    Raises:
        WorkcellError: the payload cannot be held; the message has the reason and a remedy.
    """
    told = static_hold_error(workcell, outputs)
    if told:
        raise hold_error(workcell, told)


def hold_error(workcell: Workcell, reason: str) -> WorkcellError:
    """Return the error, to be raised, of a payload that cannot be held at rest.

    Args:
        workcell: the cell.
        reason: reason why the payload cannot be held, with a remedy.
    """
    return WorkcellError(str(workcell.source), (f"payload: {reason}",))


def _ends(workcell: Workcell, outputs: Outputs) -> list[tuple[Array, Array]]:
    """Return the joint positions of both arms at the start and at the goal of the hand-made
    trajectory.

    Args:
        workcell: the cell.
        outputs: `CandidateEvaluator.outputs`.

    Returns:
        Joint positions (n_joints,) of each arm [rad or m] at start and goal; an end that an arm
        does not reach is left out.
    """
    found = outputs(initial_decision(workcell.task)[None])
    return [
        (found["q_1"][0, sample], found["q_2"][0, sample])
        for sample in (0, -1)
        if not (found["lost_1"][0, sample] or found["lost_2"][0, sample])
    ]


class _Still:
    """Check of all limits with the payload at rest at start and goal, for other values of payload
    mass and friction.
    """

    def __init__(self, workcell: Workcell, postures: list[tuple[Array, Array]]) -> None:
        ends = (workcell.task.waypoints[0].lower, workcell.task.waypoints[-1].lower)
        self._workcell = workcell
        self._poses = dict(zip(("start", "goal"), ends, strict=True))
        self._postures = dict(zip(self._poses, postures, strict=False))
        self._models: list[RobotModel] = []
        if postures:
            # Not imported at the top: forces alone need no Pinocchio.
            from symbolic.robot.model import build_robot_model

            self._models = [build_robot_model(robot) for robot in workcell.robots]

    def exceeded(self, mass: float = 1.0, friction: float = 1.0) -> list[StaticUtilisation]:
        """Return the limits that are exceeded at start or goal; empty for none.

        Args:
            mass: factor on the payload's mass.
            friction: factor on both friction coefficients.
        """
        found = []
        for where, pose in self._poses.items():
            load = still_load(self._workcell, pose, friction)
            uses = [*self._contact_uses(where, load, mass), *self._torques(where, load, mass)]
            found += [use for use in uses if use.exceeded]
        return found

    def _contact_uses(
        self, where: str, load: dict[str, Array], mass: float
    ) -> Iterator[StaticUtilisation]:
        workcell, contact = self._workcell, contact_model(self._workcell)
        whole = np.linalg.norm(load["contact_force"].reshape(2, 3), axis=1)
        limited = contact.limited_force(load["normal_force"], whole)
        for i, robot in enumerate(workcell.robots):
            allowed = float(workcell.task.reference_force[i])
            normal = mass * float(load["normal_force"][i])
            most = mass * float(limited[i])
            # Where a pad presses too hard already, its whole force says nothing new.
            name, force = (WHOLE, most) if normal <= allowed < most else (NORMAL, normal)
            yield StaticUtilisation(name, robot.name, where, force, allowed, "N")
            if contact.has_pressure_limit:
                shift, radius = float(load["pressure_shift"][i]), workcell.contacts[i].patch_radius
                yield StaticUtilisation(
                    PRESSURE, robot.name, where, 1e3 * shift, 1e3 * radius, "mm"
                )

    def _torques(
        self, where: str, load: dict[str, Array], mass: float
    ) -> Iterator[StaticUtilisation]:
        """Yield for each arm the torque of the joint that is nearest to its limit, if the arm's
        posture is known.

        Args:
            where: end of the path, 'start' or 'goal'.
            load: contact forces and moments of the payload at rest, from `still_load`.
            mass: factor on the payload's mass.
        """
        from symbolic.robot.arm import joint_torque

        workcell = self._workcell
        rotation = ca.DM(box_rotation(workcell.task.orientation, self._poses[where]))
        for i, q in enumerate(self._postures.get(where, ())):
            robot, model = workcell.robots[i], self._models[i]
            zero, wrench = np.zeros(len(q)), ca.DM(load[f"wrench_{i + 1}"])
            contact, jacobian = workcell.contacts[i], model.jacobian(q)
            held = joint_torque(robot, contact, jacobian, rotation, wrench)
            torque = np.abs(np.array(model.inverse_dynamics(q, zero, zero) + mass * held)).ravel()
            joint = int(np.argmax(torque / robot.torque_max))
            whose, most = f"{robot.name}/{model.joint_names[joint]}", robot.torque_max[joint]
            unit = "N m" if model.turning[joint] else "N"
            yield StaticUtilisation(TORQUE, whose, where, float(torque[joint]), float(most), unit)

    def remedy(self, exceeded: list[StaticUtilisation]) -> str:
        """Return a text on what would bring all given limits into reach: a smaller payload mass or
        more friction, each with everything else unchanged, and for pressure shifts a larger patch
        radius.

        Args:
            exceeded: the limits that the present cell exceeds.
        """
        ways = []
        if any(use.quantity != PRESSURE for use in exceeded):
            ways = [way for way in (self._mass(), self._friction()) if way]
        found = [" or ".join(ways)] if ways else []
        if any(use.quantity == PRESSURE for use in exceeded):
            most = max(use.needed for use in exceeded if use.quantity == PRESSURE)
            found.append(f'patches of at least {most:.1f} mm radius or allocation = "soft-finger"')
        if not found:
            return "No mass, friction or patch alone would do"
        return f"This would do: {', and '.join(found)}"

    def _mass(self) -> str:
        factor = _nearest(self._bears, 1.0, 0.0)
        if factor is None:
            return ""
        mass = np.floor(1e3 * self._workcell.payload.mass * factor) / 1e3
        return f"a mass of at most {mass:g} kg" if mass > 0.0 else ""

    def _friction(self) -> str:
        coefficients = [contact.friction for contact in self._workcell.contacts]
        factor = _nearest(
            lambda factor: self._bears(friction=factor), 1.0, FRICTION.high / max(coefficients)
        )
        if factor is None:
            return ""
        rounded = [np.ceil(1e3 * factor * value) / 1e3 for value in sorted({*coefficients})]
        wanted = " and ".join(f"{value:g}" for value in rounded)
        return f"friction of at least {wanted}"

    def _bears(self, mass: float = 1.0, friction: float = 1.0) -> bool:
        """Return True if all forces and joint torques at rest are within their limits. Pressure
        shifts are ignored.

        Args:
            mass: factor on the payload's mass.
            friction: factor on both friction coefficients.
        """
        return all(use.quantity == PRESSURE for use in self.exceeded(mass, friction))


def _nearest(enough: Callable[[float], bool], here: float, far: float) -> float | None:
    """Find by bisection the factor nearest to `here`, between `here` and `far`, at which a
    condition holds. The condition may change once in between.

    Args:
        enough: function that returns True if the condition holds at a factor.
        here, far: ends of the searched interval, in either order.

    Returns:
        The factor; None if the condition does not hold at `far`.
    """
    if not enough(far):
        return None
    for _ in range(REMEDY_BISECTIONS):
        middle = (here + far) / 2.0
        here, far = (here, middle) if enough(middle) else (middle, far)
    return far
