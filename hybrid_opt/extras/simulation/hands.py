"""Gripping hands in MuJoCo, to find the holding force at which nothing slips and no rim lifts.

The carriage moves as planned and has one body per hand: a cup on bellows, a magnet, or a finger on
its rubber. The hand's lip is a set of points, each a spring normal to the patch; between the lip
and the carriage the layer yields along the patch and about its normal. Both form one elastic layer,
with the normal stiffness `ContactSettings.layer` per area times `Contact.layer_stiffness`, and
`Contact.layer_shear` of that along the patch. The holding force is the pull of an adhesion actuator
on the payload, and hands are placed such that it compresses their layers.

The sharing of a load among hands, the sliding of a point and the pressure at a rim follow from
these springs and Coulomb's law at each point. A planned carry contributes only its motion.
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, eigh
from scipy.spatial.transform import Rotation

from hybrid_opt.carry import Carry
from hybrid_opt.extras.simulation.box import (
    SLIP_INTERVAL,
    CarriageMotion,
    Outcome,
    Threshold,
    bisected,
    carriage_motion,
    mujoco_module,
)
from hybrid_opt.extras.simulation.scene import (
    SimulationSettings,
    carriage_text,
    compiled,
    placed,
    point_geoms,
    rim,
)
from symbolic.array import Array
from symbolic.contact.elastic import layer_stiffness
from symbolic.contact.force_closure import wrench_to_box
from symbolic.contact.registry import contact_model
from symbolic.errors import SettingsError
from symbolic.records import Contact, Workcell

HAND_FREQUENCY = 500.0
"""Natural frequency of a hand on its layer [rad/s]. It determines the mass of a hand, whose inertia
is fed forward."""

LIP_DAMPING = 0.05
"""Damping ratio of the layers normal to their patches. Two hands that face each other cannot yield,
so a sliding contact between them is slowed by this damping."""

SHEAR_DAMPING = 0.7
"""Damping ratio of the layers along their patches, with the payload's mass."""

HAND_SETTINGS = SimulationSettings(time_step=5e-4, settle=0.4)
"""Usual settings. Hands take the payload's weight so slowly that it hardly swings. With steps of
1 ms and longer, swings between facing hands may grow by themselves."""

HAND_IMPRATIO = 1e5
"""MuJoCo's impratio for hands. Displacements of some micrometres load their layers; with the value
for pads, contacts that do not slip lose half of such a force within a second."""

TAKEN = 0.75
"""Share of the settling time in which hands take the payload's weight."""

RINGS = 3
"""Number of rings of points with equal areas on a disc. The lip of a cup has the points of one
ring."""

RIM_PLACES = 32
"""Number of points on a hand's rim at which slip and lift are measured."""

LOW_FACTOR, HIGH_FACTOR = 0.5, 2.0
"""Multiples of the planned forces with which hands lose the payload, and hold it. Other hands take
over a part of the share of one that slips."""

FACTOR_BISECTIONS = 9
"""Number of bisections between them, to about 0.3 %."""

HAND_JOINTS = ("x", "y", "turn")
"""Names of the joints of a hand on its layer."""


@dataclass(frozen=True)
class HandOutcome(Outcome):
    """Outcome of one simulation of a payload in hands. Its `factor` multiplies the hands' holding
    forces.

    Attributes:
        lift: (n, 2) largest distance between the payload and the rim of a hand, over the hands of
            each robot [m]; negative while all rims are pressed.
        force: (hands, 3) force of each hand on the payload at the end, along the hand's axes [N].
            Its normal part is the pressure in excess of the holding force.
    """

    lift: Array
    force: Array

    @property
    def lifts(self) -> bool:
        """True if the payload was off the rim of a hand at the end."""
        return bool(self.lift[-1].max() > 0.0)


class HandSimulation:
    """Simulation of one workcell's payload in its hands.

    Attributes:
        workcell, settings: the cell, and settings of the simulation.
        displacement: (3,) displacement of the second arm, box frame [m].
    """

    def __init__(
        self,
        workcell: Workcell,
        settings: SimulationSettings | None = None,
        disturbance: ArrayLike = (0.0, 0.0, 0.0),
        opposed: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Build the model of the scene. Nothing is simulated yet.

        Args:
            workcell: the cell.
            settings: settings of the simulation; None for `HAND_SETTINGS`.
            disturbance: (3,) acceleration that the hands have to give the payload in addition to
                the acceleration of the motion, world frame [m/s^2].
            opposed: (3,) force of the second arm's hands on the payload with which the arms work
                against each other, box frame [N]. The second arm is displaced such that this force
                results while no hand slips.

        Raises:
            SimulationError: MuJoCo is not installed.
            SettingsError: the pads press the payload between them.
        """
        if contact_model(workcell).is_squeeze:
            raise SettingsError(
                "pads press the payload between them; simulate them as pads", code="needs-hands"
            )
        self.workcell = workcell
        self.settings = settings or HAND_SETTINGS
        self._mujoco = mujoco_module()
        self._disturbance = disturbance
        self.displacement = _displacement(workcell, self.settings.layer, opposed)
        self._model = cache(self._compiled)

    def simulate(
        self, motion: CarriageMotion, holding_force: ArrayLike, factor: float = 1.0
    ) -> HandOutcome:
        """Simulate one carry until its end, until a hand slips or until the payload is off the rim
        of a hand.

        Args:
            motion: motion of the carriage, which bears all hands.
            holding_force: holding force [N], one number for all hands or (2,) for the hands of each
                robot.
            factor: number by which the holding forces are multiplied.
        """
        mujoco, settings = self._mujoco, self.settings
        model = copy(self._model())
        hands = self._hands
        robots = self.workcell.pad_robots
        force = factor * np.broadcast_to(holding_force, 2)[list(robots)]
        stiffness = np.array([_normal_stiffness(hand, settings) * hand.area for hand in hands])
        for k, hand in enumerate(hands):
            depth = max(0.0, force[k]) / stiffness[k]
            model.body(f"hand_{k}").pos[:] = hand.T_box_pad[:3, 3] + depth * hand.T_box_pad[:3, 2]
        data = mujoco.MjData(model)
        held = HeldInHands(model, data, self.workcell)
        second = [k for k, i in enumerate(robots) if i == 1]
        bodies = [int(model.body(f"hand_{k}").id) for k in second]
        at, along = model.body_pos[bodies].copy(), self._displaced_along(second)
        normals = np.array([hands[k].T_box_pad[:3, 2] for k in second])
        box = int(model.joint("box").qposadr[0])
        joints = [
            [int(model.joint(f"{name}_{k}").dofadr[0]) for name in HAND_JOINTS] for k in held.each
        ]
        own = np.stack([_own(hand, settings, motion) for hand in hands], axis=1)
        data.qpos[box : box + 7] = motion.pose[0]
        data.ctrl[:] = force
        gravity, taken = model.opt.gravity.copy(), TAKEN * settings.settle
        every = max(1, round(SLIP_INTERVAL / settings.time_step))
        motion.apply(data, 0)
        mujoco.mj_kinematics(model, data)
        seen = [(float(motion.time[0]), *held.look())]
        for k, time in enumerate(motion.time):
            motion.apply(data, k)
            # What stands beneath the payload gives its weight to the hands little by little.
            given = min(1.0, (time - motion.time[0]) / taken)
            given *= given * (3.0 - 2.0 * given)
            model.opt.gravity[:] = gravity * given
            # Friction does not feel a body that is placed elsewhere. So a displacement along a
            # patch moves the rest position of the layer's springs.
            model.qpos_spring[held.slides[second]] = given * along[:, :2]
            model.body_pos[bodies] = at + given * along[:, 2:] * normals
            data.qfrc_applied[joints] = own[k]
            mujoco.mj_step(model, data)
            if k % every or time < motion.time[0] + taken:
                continue
            slip, lift, turned = held.look()
            seen.append((float(time), slip, lift, turned))
            if not (slip.max() <= settings.slip and lift.max() <= 0.0):
                break
        times, slips, lifts, turns = (np.array(values) for values in zip(*seen, strict=True))
        holds = bool(slips[-1].max() <= settings.slip and lifts[-1].max() <= 0.0)
        return HandOutcome(factor, holds, times, slips, turns, lifts, held.forces(model))

    def _displaced_along(self, hands: list[int]) -> Array:
        """Return the displacement of the second arm (n, 3) along the axes of n of its hands [m].

        Args:
            hands: indices of the hands.
        """
        axes = np.array([self._hands[k].T_box_pad[:3, :3] for k in hands])
        return np.asarray(self.displacement @ axes)

    @property
    def _hands(self) -> tuple[Contact, ...]:
        return self.workcell.pads

    def _compiled(self) -> Any:
        settings, payload = self.settings, self.workcell.payload
        each = payload.mass / len(self._hands)
        hands = "\n".join(_hand_text(hand, settings, k, each) for k, hand in enumerate(self._hands))
        pulls = "".join(
            f'<adhesion body="hand_{k}" ctrlrange="0 1e6" gain="1"/>'
            for k in range(len(self._hands))
        )
        text = carriage_text(
            self.workcell, settings, self._disturbance, hands, pulls, HAND_IMPRATIO
        )
        return compiled(self._mujoco, text, LIP_DAMPING)[0]


def own_forces(workcell: Workcell, forces: Array) -> Array:
    """Scale the needed holding forces from the weaker hands of a cell to each robot's own hands.

    The contact model states for each robot the force that hands as weak as the weaker ones of the
    cell would need. It is multiplied by the robot's holding force over the lesser of both robots'.

    Args:
        workcell: the cell.
        forces: (2,) force for each robot, stated for the weaker hands [N].

    Returns:
        (2,) holding force of each robot's own hands [N].
    """
    own = np.array([contact.holding_force for contact in workcell.contacts])
    return np.asarray(forces * own / own.min())


def hand_threshold(
    carry: Carry, settings: SimulationSettings = HAND_SETTINGS
) -> Threshold[HandOutcome]:
    """Find the least factor of a carry's planned forces with which no hand slips and the payload
    stays on the rims of all hands.

    Args:
        carry: the carry.
        settings: settings of the simulation.

    Raises:
        SimulationError: MuJoCo is not installed, the payload slips or lifts at `HIGH_FACTOR`, or it
            holds at `LOW_FACTOR`.
        SettingsError: the pads press the payload between them.
    """
    planned = own_forces(carry.workcell, carry.peak_normal_force)
    witness = HandSimulation(carry.workcell, settings)
    simulate = partial(witness.simulate, carriage_motion(carry, settings), planned)
    return bisected(simulate, LOW_FACTOR, HIGH_FACTOR, FACTOR_BISECTIONS)


class HeldInHands:
    """Measurement of the payload's pose in its hands in one simulation.

    Attributes:
        each: indices of the hands, those of the first robot first.
        slides: (hands, 2) addresses in MuJoCo's `qpos` of the joints by which the layers give way
            along the patches.
    """

    def __init__(self, model: Any, data: Any, workcell: Workcell) -> None:
        """Find hands and payload in a model of the scene.

        Args:
            model, data: MuJoCo's model and its state.
            workcell: the cell.
        """
        self.each, self._robots = range(len(workcell.pads)), np.array(workcell.pad_robots)
        self._bodies = [int(model.body(f"hand_{k}").id) for k in self.each]
        slides = [[model.joint(f"{name}_{k}") for name in HAND_JOINTS[:2]] for k in self.each]
        self.slides = np.array([[int(joint.qposadr[0]) for joint in own] for own in slides])
        self._slide_stiffness = np.array([[joint.stiffness[0] for joint in own] for own in slides])
        self._box, self._carriage = (int(model.body(name).id) for name in ("box", "carriage"))
        self._data = data
        rims = np.array([rim(hand, RIM_PLACES) for hand in workcell.pads])
        self._rims = np.concatenate([rims, np.zeros((*rims.shape[:2], 1))], axis=2)
        T = np.array([hand.T_box_pad for hand in workcell.pads])
        self._on_box = self._rims @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        self._settled: tuple[Array, Array] | None = None

    def look(self) -> tuple[Array, Array, float]:
        """Measure how far the payload has moved in the hands.

        Returns:
            - Slip (2,), for each robot the largest displacement of the payload along the patches of
              its hands since the first call [m].
            - Lift (2,), for each robot the largest height of the payload above a rim of its hands,
              negative while all rims are pressed [m].
            - Rotation of the payload since the first call [rad], relative to the carriage, the body
              that bears all hands.
        """
        data = self._data
        axes = data.xmat[self._bodies].reshape(-1, 3, 3)
        rotation = data.xmat[self._box].reshape(3, 3)
        face = self._on_box @ rotation.T + data.xpos[self._box] - data.xpos[self._bodies][:, None]
        on_lip = face @ axes
        turned = data.xmat[self._carriage].reshape(3, 3).T @ rotation
        if self._settled is None:
            self._settled = on_lip, turned
        moved = np.linalg.norm((on_lip - self._settled[0])[..., :2], axis=2).max(axis=1)
        off = on_lip[..., 2].max(axis=1)
        slip, lift = (
            np.array([values[self._robots == i].max() for i in (0, 1)]) for values in (moved, off)
        )
        turn = Rotation.from_matrix(self._settled[1].T @ turned).magnitude()
        return slip, lift, float(turn)

    def forces(self, model: Any) -> Array:
        """Measure the force (hands, 3) of each hand on the payload along the hand's axes, the
        normal part without the holding force [N].

        Args:
            model: MuJoCo's model of the scene, with the rest positions of the springs after the
                displacement of the arms.
        """
        data, contact = self._data, self._data.contact
        active = contact.efc_address >= 0
        pressed = np.zeros(model.nbody)
        bodies = model.geom_bodyid[contact.geom[active]]
        np.add.at(pressed, bodies, data.efc_force[contact.efc_address[active]][:, None])
        stretch = model.qpos_spring[self.slides] - data.qpos[self.slides]
        along = self._slide_stiffness * stretch
        return np.column_stack([along, pressed[self._bodies] - data.ctrl])


def swing_frequency(workcell: Workcell, settings: SimulationSettings = HAND_SETTINGS) -> float:
    """Compute the lowest frequency at which the payload swings on the elastic layers of its hands
    while the arms are at rest [Hz].

    Args:
        workcell: the cell.
        settings: settings of the simulation, with the stiffness of the layers.
    """
    payload, stiffness = workcell.payload, _stiffness(workcell.pads, settings.layer)
    # Velocities of the centre of mass from those of the box frame.
    to_centre = np.eye(6)
    to_centre[:3, 3:] = np.cross(np.eye(3), payload.centre_of_mass)
    inertia = block_diag(payload.mass * np.eye(3), payload.inertia)
    squares = eigh(stiffness, to_centre.T @ inertia @ to_centre, eigvals_only=True)
    return float(np.sqrt(squares[0]) / (2.0 * np.pi))


def _stiffness(hands: Iterable[Contact], layer: float) -> Array:
    """Compute the stiffness matrix (6, 6) of hands on their elastic layers about the box frame
    [N/m, N, N m/rad].

    Args:
        hands: the hands.
        layer: stiffness of the layers per area [N/m^3].
    """
    maps = [(wrench_to_box(hand), layer * layer_stiffness(hand)) for hand in hands]
    return np.asarray(sum(A @ K @ A.T for A, K in maps))


def _displacement(workcell: Workcell, layer: float, opposed: ArrayLike) -> Array:
    """Compute how far the second arm is to be displaced, without rotation, so that the arms work
    against each other with a given force.

    Args:
        workcell: the cell.
        layer: stiffness of the hands' elastic layers per area [N/m^3].
        opposed: (3,) force of the second arm's hands on the payload, box frame [N].

    Returns:
        (3,) displacement in the box frame [m].
    """
    hands = list(zip(workcell.pads, workcell.pad_robots, strict=True))
    softness = sum(
        np.linalg.inv(_stiffness([hand for hand, robot in hands if robot == i], layer))
        for i in (0, 1)
    )
    return np.linalg.solve(np.linalg.inv(softness)[:3, :3], np.asarray(opposed, dtype=float))


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


def _normal_stiffness(hand: Contact, settings: SimulationSettings) -> float:
    """Return the stiffness of a hand's elastic layer along the normal, per area [N/m^3].

    Args:
        hand: the hand.
        settings: settings of the simulation, with the stiffness of a usual layer.
    """
    return settings.layer * hand.layer_stiffness


def _along(hand: Contact, settings: SimulationSettings) -> tuple[float, float]:
    """Return the stiffness of a hand's elastic layer against displacement along the patch [N/m],
    and against rotation about the normal [N m/rad].

    Args:
        hand: the hand.
        settings: settings of the simulation.
    """
    points = lip_points(hand, settings.points)
    shear = hand.layer_shear * _normal_stiffness(hand, settings) * hand.area
    return shear, shear * float((points**2).sum(axis=1).mean())


def _own(hand: Contact, settings: SimulationSettings, motion: CarriageMotion) -> Array:
    """Compute the forces that accelerate a hand's own inertia.

    Args:
        hand: the hand.
        settings: settings of the simulation.
        motion: motion at n time steps of the carriage, the body that bears the hands.

    Returns:
        (n, 3) forces along both axes of the patch [N], and moment about the normal [N m].
    """
    inertia = np.array(_along(hand, settings)) / HAND_FREQUENCY**2
    R = hand.T_box_pad[:3, :3]
    linear = motion.acceleration_at(hand.T_box_pad[:3, 3]) @ R[:, :2]
    return np.column_stack(
        [inertia[0] * linear, inertia[1] * (motion.acceleration[:, 3:] @ R[:, 2])]
    )


def _hand_text(hand: Contact, settings: SimulationSettings, k: int, borne: float) -> str:
    """Return a hand as MJCF, a body of the carriage.

    Args:
        hand: the hand.
        settings: settings of the simulation.
        k: index of the hand, for names.
        borne: part of the payload's mass that the hand bears [kg].
    """
    shear, torsion = _along(hand, settings)
    points = lip_points(hand, settings.points)
    mass, inertia = shear / HAND_FREQUENCY**2, torsion / HAND_FREQUENCY**2
    damping = 2.0 * SHEAR_DAMPING * np.sqrt(shear * (mass + borne))
    twisting = damping * torsion / shear
    joints = "".join(
        f'<joint name="{name}_{k}" type="slide" axis="{axis}" stiffness="{shear!r}" '
        f'damping="{float(damping)!r}"/>'
        for name, axis in zip(HAND_JOINTS[:2], ("1 0 0", "0 1 0"), strict=True)
    )
    return f"""<body name="hand_{k}" gravcomp="1" {placed(hand.T_box_pad)}>
        {joints}
        <joint name="turn_{k}" type="hinge" axis="0 0 1" stiffness="{torsion!r}"
          damping="{float(twisting)!r}"/>
        <inertial pos="0 0 0" mass="{mass!r}" diaginertia="{inertia!r} {inertia!r} {inertia!r}"/>
        {point_geoms(hand, _normal_stiffness(hand, settings), points, np.eye(4))}
      </body>"""
