"""Hands and arms as springs: their stiffness, and their bodies in MuJoCo.

A hand is a body on an elastic layer, with the normal stiffness `ContactSettings.layer` per area
times `Contact.layer_stiffness`, and `Contact.layer_shear` of that along the patch. Its lip is a set
of points, each a spring normal to the patch; along the patch and about its normal the body moves by
joints. All hands of an arm may be mounted on one more body, which the arm's own stiffness holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, eigh

from hybrid_opt.extras.simulation.box import CarriageMotion
from hybrid_opt.extras.simulation.scene import (
    SimulationSettings,
    mjcf_text,
    placed,
    point_geoms,
)
from symbolic.array import Array
from symbolic.contact.elastic import layer_stiffness
from symbolic.contact.force_closure import wrench_to_box
from symbolic.records import Contact, Workcell
from symbolic.records.poses import transform

HAND_FREQUENCY = 500.0
"""Natural frequency of a hand on its layer, and of an arm that bears nothing [rad/s]. It determines
their masses, whose inertia is fed forward."""

SHEAR_DAMPING = 0.7
"""Damping ratio of the layers along their patches, and of the arms, with the payload's mass."""

RINGS = 3
"""Number of rings of points with equal areas on a disc. The lip of a cup has the points of one
ring."""

HAND_JOINTS = ("x", "y", "turn")
"""Names of the joints of a hand on its layer."""

ARM_JOINTS = ("slide", "hinge")
"""Types of the joints of an arm, three of each along the axes of the box."""


@dataclass(frozen=True)
class ArmStiffness:
    """Stiffness of either arm at the middle of its hands, equal in all directions.

    Attributes:
        linear: against displacement [N/m].
        angular: against rotation [N m/rad].
    """

    linear: float
    angular: float


@dataclass(frozen=True)
class HandSprings:
    """Hands of both arms as springs.

    Attributes:
        workcell: the cell.
        settings: settings of the simulation, with the stiffness of the layers.
        arms: stiffness of the arms; None for stiff arms.
    """

    workcell: Workcell
    settings: SimulationSettings
    arms: ArmStiffness | None = None

    @property
    def middles(self) -> Array:
        """(2, 3) middle of each arm's hands, box frame [m]."""
        contacts = self.workcell.contacts
        places = ([pad.T_box_pad[:3, 3] for pad in (c, *c.further)] for c in contacts)
        return np.array([np.mean(own, axis=0) for own in places])

    @property
    def compliances(self) -> Array:
        """(2, 6, 6) compliance of each arm with its hands: displacement of the payload per wrench
        on the hands of this arm alone, both about the box frame [m/N, 1/N, rad/(N m)].
        """
        found = []
        for contact, middle in zip(self.workcell.contacts, self.middles, strict=True):
            maps = [(wrench_to_box(hand), layer_stiffness(hand)) for hand in _all(contact)]
            soft = np.linalg.inv(self.settings.layer * sum(A @ K @ A.T for A, K in maps))
            if self.arms is not None:
                own = np.repeat([1.0 / self.arms.linear, 1.0 / self.arms.angular], 3)
                to_origin = np.eye(6)
                to_origin[:3, 3:] = _crossed(middle)
                soft = soft + to_origin @ np.diag(own) @ to_origin.T
            found.append(soft)
        return np.array(found)

    def displacement(self, opposed: ArrayLike, turned: ArrayLike) -> Array:
        """Compute how far the second arm has to be displaced for the arms to work against each
        other with a given force.

        Args:
            opposed: (3,) force of the second arm's hands on the payload, box frame [N]. The
                displacement causes it if the arm is not rotated.
            turned: (3,) additional rotation of the second arm about the middle of its hands, box
                frame [rad]. It is returned unchanged.

        Returns:
            (6,) displacement of the middle of the second arm's hands [m], then the rotation [rad],
            box frame.
        """
        series = np.linalg.inv(self.compliances.sum(axis=0))
        moved = np.linalg.solve(series[:3, :3], np.asarray(opposed, dtype=float))
        return np.concatenate([moved, np.asarray(turned, dtype=float)])

    @property
    def swing_frequency(self) -> float:
        """Lowest frequency at which the payload swings in its hands while the arms are at rest
        [Hz]."""
        payload = self.workcell.payload
        stiffness = sum(np.linalg.inv(soft) for soft in self.compliances)
        # Velocities of the centre of mass from those of the box frame.
        to_centre = np.eye(6)
        to_centre[:3, 3:] = -_crossed(payload.centre_of_mass)
        inertia = block_diag(payload.mass * np.eye(3), payload.inertia)
        squares = eigh(stiffness, to_centre.T @ inertia @ to_centre, eigvals_only=True)
        return float(np.sqrt(squares[0]) / (2.0 * np.pi))

    def bodies(self) -> str:
        """Return all hands as MJCF: bodies `hand_K`, mounted on the arms `arm_I` or directly on the
        carriage, the moving body that bears all of them.
        """
        pads, robots = self.workcell.pads, self.workcell.pad_robots
        each = self.workcell.payload.mass / len(pads)
        if self.arms is None:
            return "\n".join(
                _hand_text(hand, self.settings, k, each, hand.T_box_pad)
                for k, hand in enumerate(pads)
            )
        return "\n".join(self._arm_text(i, robots.count(i) * each) for i in (0, 1))

    def _arm_text(self, arm: int, borne: float) -> str:
        """Return an arm with its hands as MJCF: a body on the carriage, the moving body that bears
        all hands.

        Args:
            arm: index of the arm.
            borne: part of the payload's mass that the arm bears [kg].
        """
        assert self.arms is not None, "stiff arms have no bodies"
        stiffness = self.arms.linear, self.arms.angular
        mass, inertia = (value / HAND_FREQUENCY**2 for value in stiffness)
        damping = 2.0 * SHEAR_DAMPING * np.sqrt(self.arms.linear * (mass + borne))
        damped = float(damping), float(damping * self.arms.angular / self.arms.linear)
        joints = "".join(
            f'<joint name="arm_{kind}_{arm}_{axis}" type="{kind}" axis="{mjcf_text(along)}" '
            f'stiffness="{stiff!r}" damping="{lost!r}"/>'
            for kind, stiff, lost in zip(ARM_JOINTS, stiffness, damped, strict=True)
            for axis, along in enumerate(np.eye(3))
        )
        origin = transform(np.eye(3), -self.middles[arm])
        each = borne / self.workcell.pad_robots.count(arm)
        hands = "\n".join(
            _hand_text(hand, self.settings, k, each, origin @ hand.T_box_pad)
            for k, hand in enumerate(self.workcell.pads)
            if self.workcell.pad_robots[k] == arm
        )
        return f"""<body name="arm_{arm}" gravcomp="1" pos="{mjcf_text(self.middles[arm])}">
        {joints}
        <inertial pos="0 0 0" mass="{mass!r}" diaginertia="{inertia!r} {inertia!r} {inertia!r}"/>
        {hands}
      </body>"""

    def own_forces(self, motion: CarriageMotion) -> dict[str, Array]:
        """Compute the forces that accelerate the hands' own inertia along their joints. Applied in
        the simulation, they keep this inertia from loading the springs.

        The inertia of the arms needs no such forces: it displaces both arms equally, which loads no
        hand.

        Args:
            motion: motion at n time steps of the carriage, the body that bears all hands.

        Returns:
            Forces (n,) [N] or moments (n,) [N m] by name of the joint.
        """
        found = dict[str, Array]()
        for k, hand in enumerate(self.workcell.pads):
            inertia = np.array(along_patch(hand, self.settings)) / HAND_FREQUENCY**2
            R = hand.T_box_pad[:3, :3]
            linear = motion.acceleration_at(hand.T_box_pad[:3, 3]) @ R[:, :2]
            turning = motion.acceleration[:, 3:] @ R[:, 2]
            own = *(inertia[0] * linear.T), inertia[1] * turning
            found |= {f"{name}_{k}": force for name, force in zip(HAND_JOINTS, own, strict=True)}
        return found


def _all(contact: Contact) -> Sequence[Contact]:
    return (contact, *contact.further)


def _crossed(vector: Array) -> Array:
    """Return the matrix (3, 3) whose product with another vector is `vector` cross that vector."""
    return np.cross(np.eye(3), vector)


def lip_points(hand: Contact, points: int) -> Array:
    """Compute points in the plane of a hand's patch at which the hand presses on the payload.

    The mean of x^2 and of y^2 over these points equals the mean over the patch, or over the rim of
    a cup. So they transmit moments like the patch.

    Args:
        hand: the hand.
        points: approximate number of points of a patch; the lip of a cup has a third of them.

    Returns:
        (n, 2) points [m].
    """
    if hand.half_sides is None:
        angle = 2.0 * np.pi * np.arange(points // RINGS) / (points // RINGS)
        around = np.column_stack([np.cos(angle), np.sin(angle)])
        radii = [1.0] if hand.is_ring else np.sqrt((np.arange(RINGS) + 0.5) / RINGS)
        return np.concatenate([hand.patch_radius * r * around for r in radii])
    x, y = hand.half_sides
    rows = max(2, round(float(np.sqrt(points * y / x))))
    columns = max(2, round(points / rows))
    # Centres of equal parts, apart as far as makes up for the spread of each part.
    across, along = (
        ((2.0 * np.arange(n) + 1.0) / n - 1.0) / np.sqrt(1.0 - 1.0 / n**2) for n in (columns, rows)
    )
    return np.asarray([(x * a, y * b) for a in across for b in along])


def normal_stiffness(hand: Contact, settings: SimulationSettings) -> float:
    """Return the stiffness of a hand's elastic layer along the normal, per area [N/m^3].

    Args:
        hand: the hand.
        settings: settings of the simulation, with the stiffness of a usual layer.
    """
    return settings.layer * hand.layer_stiffness


def along_patch(hand: Contact, settings: SimulationSettings) -> tuple[float, float]:
    """Return the stiffness of a hand's elastic layer against displacement along the patch [N/m],
    and against rotation about the normal [N m/rad].

    Args:
        hand: the hand.
        settings: settings of the simulation.
    """
    points = lip_points(hand, settings.points)
    shear = hand.layer_shear * normal_stiffness(hand, settings) * hand.area
    return shear, shear * float((points**2).sum(axis=1).mean())


def _hand_text(hand: Contact, settings: SimulationSettings, k: int, borne: float, T: Array) -> str:
    """Return a hand as MJCF.

    Args:
        hand: the hand.
        settings: settings of the simulation.
        k: index of the hand, for names.
        borne: part of the payload's mass that the hand bears [kg].
        T: (4, 4) pose of the hand in the body that it is mounted on.
    """
    shear, torsion = along_patch(hand, settings)
    points = lip_points(hand, settings.points)
    mass, inertia = shear / HAND_FREQUENCY**2, torsion / HAND_FREQUENCY**2
    damping = 2.0 * SHEAR_DAMPING * np.sqrt(shear * (mass + borne))
    twisting = damping * torsion / shear
    joints = "".join(
        f'<joint name="{name}_{k}" type="slide" axis="{axis}" stiffness="{shear!r}" '
        f'damping="{float(damping)!r}"/>'
        for name, axis in zip(HAND_JOINTS[:2], ("1 0 0", "0 1 0"), strict=True)
    )
    return f"""<body name="hand_{k}" gravcomp="1" {placed(T)}>
        {joints}
        <joint name="turn_{k}" type="hinge" axis="0 0 1" stiffness="{torsion!r}"
          damping="{float(twisting)!r}"/>
        <inertial pos="0 0 0" mass="{mass!r}" diaginertia="{inertia!r} {inertia!r} {inertia!r}"/>
        {point_geoms(hand, normal_stiffness(hand, settings), points, np.eye(4))}
      </body>"""
