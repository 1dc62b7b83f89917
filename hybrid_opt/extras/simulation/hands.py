"""Gripping hands in MuJoCo, to find the holding force at which nothing slips and no rim lifts.

The carriage moves as planned and bears one body per hand: a cup on bellows, a magnet, or a finger
on its rubber (`hybrid_opt.extras.simulation.hand_bodies`). The holding force is the pull of an
adhesion actuator on the payload, and hands are placed such that it compresses their layers. The
arms may yield, and work against each other because the second one is displaced and rotated.

The sharing of a load among hands, the sliding of a point and the pressure at a rim follow from
these springs and Coulomb's law at each point. A planned carry contributes only its motion.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
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
from hybrid_opt.extras.simulation.hand_bodies import (
    HAND_JOINTS,
    ArmStiffness,
    HandSprings,
    normal_stiffness,
)
from hybrid_opt.extras.simulation.scene import (
    SimulationSettings,
    carriage_text,
    compiled,
    rim,
)
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.errors import SettingsError
from symbolic.records import Contact, Workcell

LIP_DAMPING = 0.05
"""Damping ratio of the layers normal to their patches. Two hands that face each other cannot yield,
so a sliding contact between them is slowed by this damping."""

HAND_SETTINGS = SimulationSettings(time_step=5e-4, settle=0.4)
"""Usual settings. Hands take the payload's weight so slowly that it hardly swings. With steps of
1 ms and longer, swings between facing hands may grow by themselves."""

HAND_IMPRATIO = 1e5
"""MuJoCo's impratio for hands. Displacements of some micrometres load their layers; with the value
for pads, contacts that do not slip lose half of such a force within a second."""

TAKEN = 0.75
"""Share of the settling time in which hands take the payload's weight."""

RIM_PLACES = 32
"""Number of points on a hand's rim at which slip and lift are measured."""

LOW_FACTOR, HIGH_FACTOR = 0.5, 2.0
"""Multiples of the planned forces with which hands lose the payload, and hold it. Other hands take
over a part of the share of one that slips."""

FACTOR_BISECTIONS = 9
"""Number of bisections between them, to about 0.3 %."""


@dataclass(frozen=True)
class HandOutcome(Outcome):
    """Outcome of one simulation of a payload in hands. Its `factor` multiplies the hands' holding
    forces.

    Attributes:
        lift: (n, 2) largest distance between the payload and the rim of a hand, over the hands of
            each robot [m]; negative while all rims are pressed.
        wrench: (hands, 6) force [N] and moment [N m] of each hand on the payload at the end, about
            the hand's origin along its axes. The normal force is the pressure in excess of the
            holding force.
    """

    lift: Array
    wrench: Array

    @property
    def lifts(self) -> bool:
        """True if the payload was off the rim of a hand at the end."""
        return bool(self.lift[-1].max() > 0.0)


class HandSimulation:
    """Simulation of one workcell's payload in its hands.

    Attributes:
        workcell, settings: the cell, and settings of the simulation.
        springs: hands and arms as springs.
        displacement: (6,) displacement of the middle of the second arm's hands [m] and rotation of
            the arm [rad], box frame.
    """

    def __init__(
        self,
        workcell: Workcell,
        settings: SimulationSettings | None = None,
        disturbance: ArrayLike = (0.0, 0.0, 0.0),
        opposed: ArrayLike = (0.0, 0.0, 0.0),
        turned: ArrayLike = (0.0, 0.0, 0.0),
        arms: ArmStiffness | None = None,
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
            turned: (3,) rotation of the second arm about the middle of its hands, in addition to
                that displacement, box frame [rad].
            arms: stiffness of the arms; None for stiff arms.

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
        self.springs = HandSprings(workcell, self.settings, arms)
        self.displacement = self.springs.displacement(opposed, turned)
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
        stiffness = np.array([normal_stiffness(hand, settings) * hand.area for hand in hands])
        for k, hand in enumerate(hands):
            depth = max(0.0, force[k]) / stiffness[k]
            model.body(f"hand_{k}").pos[:] += depth * hand.T_box_pad[:3, 2]
        data = mujoco.MjData(model)
        held = HeldInHands(model, data, self.workcell)
        second = _Displaced(model, held, self)
        box = int(model.joint("box").qposadr[0])
        own = self.springs.own_forces(motion)
        joints = [int(model.joint(name).dofadr[0]) for name in own]
        efforts = np.column_stack([*own.values()])
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
            second.displace(given)
            data.qfrc_applied[joints] = efforts[k]
            mujoco.mj_step(model, data)
            if k % every or time < motion.time[0] + taken:
                continue
            slip, lift, turned = held.look()
            seen.append((float(time), slip, lift, turned))
            if not (slip.max() <= settings.slip and lift.max() <= 0.0):
                break
        times, slips, lifts, turns = (np.array(values) for values in zip(*seen, strict=True))
        holds = bool(slips[-1].max() <= settings.slip and lifts[-1].max() <= 0.0)
        return HandOutcome(factor, holds, times, slips, turns, lifts, held.wrenches(model))

    @property
    def _hands(self) -> tuple[Contact, ...]:
        return self.workcell.pads

    def _compiled(self) -> Any:
        pulls = "".join(
            f'<adhesion body="hand_{k}" ctrlrange="0 1e6" gain="1"/>'
            for k in range(len(self._hands))
        )
        text = carriage_text(
            self.workcell,
            self.settings,
            self._disturbance,
            self.springs.bodies(),
            pulls,
            HAND_IMPRATIO,
        )
        return compiled(self._mujoco, text, LIP_DAMPING)[0]


def own_forces(workcell: Workcell, forces: Array) -> Array:
    """Convert the holding forces of a contact model to those of each robot's own hands.

    The contact model assumes equal hands for both robots, with the lesser one of the two holding
    forces. The force of a robot is multiplied by the ratio of its own holding force to the lesser
    one.

    Args:
        workcell: the cell.
        forces: (2,) force for each robot by the contact model [N].

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
        bodies: (hands,) indices of MuJoCo's bodies of the hands.
        joints: (hands, 3) addresses in MuJoCo's `qpos` of the joints by which the layers give way
            along the patches and about their normals.
    """

    def __init__(self, model: Any, data: Any, workcell: Workcell) -> None:
        """Find hands and payload in a model of the scene.

        Args:
            model, data: MuJoCo's model and its state.
            workcell: the cell.
        """
        self.each, self._robots = range(len(workcell.pads)), np.array(workcell.pad_robots)
        self.bodies = np.array([int(model.body(f"hand_{k}").id) for k in self.each])
        joints = [[model.joint(f"{name}_{k}") for name in HAND_JOINTS] for k in self.each]
        self.joints = np.array([[int(joint.qposadr[0]) for joint in own] for own in joints])
        self._stiffness = np.array([[joint.stiffness[0] for joint in own] for own in joints])
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
        axes = data.xmat[self.bodies].reshape(-1, 3, 3)
        rotation = data.xmat[self._box].reshape(3, 3)
        face = self._on_box @ rotation.T + data.xpos[self._box] - data.xpos[self.bodies][:, None]
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

    def wrenches(self, model: Any) -> Array:
        """Measure the wrench (hands, 6) of each hand on the payload: force [N] and moment [N m]
        about the hand's origin, along its axes. The normal force does not include the holding
        force.

        Args:
            model: MuJoCo's model of the scene, with the rest positions of the springs after the
                displacement of the arms.
        """
        data, contact = self._data, self._data.contact
        active = contact.efc_address >= 0
        pressed = np.zeros((model.nbody, 3))
        # Of the two bodies of a contact one is a hand, whose frame the place is taken to.
        for body in model.geom_bodyid[contact.geom[active]].T:
            place = contact.pos[active] - data.xpos[body]
            x, y, _ = np.einsum("nji,nj->in", data.xmat[body].reshape(-1, 3, 3), place)
            force = data.efc_force[contact.efc_address[active]]
            np.add.at(pressed, body, np.column_stack([force, y * force, -x * force]))
        stretch = model.qpos_spring[self.joints] - data.qpos[self.joints]
        along = self._stiffness * stretch
        normal = pressed[self.bodies]
        return np.column_stack([along[:, :2], normal[:, 0] - data.ctrl, normal[:, 1:], along[:, 2]])


class _Displaced:
    """The second arm's hands in one simulation, displaced little by little.

    In MuJoCo a body that is set to another pose causes no friction. So a displacement along a patch
    and a rotation about its normal move the rest positions of the layer's springs; only the
    displacement along the normal and the tilt change the pose of the hand itself.
    """

    def __init__(self, model: Any, held: HeldInHands, simulation: HandSimulation) -> None:
        workcell = simulation.workcell
        second = [k for k, i in enumerate(workcell.pad_robots) if i == 1]
        self._model, self._bodies, self._joints = model, held.bodies[second], held.joints[second]
        self._at, self._turn = (
            values[self._bodies].copy() for values in (model.body_pos, model.body_quat)
        )
        T = np.array([workcell.pads[k].T_box_pad for k in second])
        moved, turned = simulation.displacement[:3], simulation.displacement[3:]
        places = moved + np.cross(turned, T[:, :3, 3] - simulation.springs.middles[1])
        self._normals = T[:, :3, 2]
        self._linear = np.einsum("nji,nj->ni", T[:, :3, :3], places)
        self._angular = turned @ T[:, :3, :3]

    def displace(self, share: float) -> None:
        """Move the second arm's hands to a share of their final displacement, 0 for none and 1 for
        all.
        """
        linear, angular = share * self._linear, share * self._angular
        self._model.qpos_spring[self._joints] = np.column_stack([linear[:, :2], angular[:, 2]])
        self._model.body_pos[self._bodies] = self._at + linear[:, 2:] * self._normals
        tilt = Rotation.from_rotvec(angular * [1.0, 1.0, 0.0])
        turn = Rotation.from_quat(self._turn, scalar_first=True) * tilt
        self._model.body_quat[self._bodies] = turn.as_quat(scalar_first=True)
