"""A whole cell in MuJoCo: both arms under their controllers, the box between their pads.

Only joint torques, gravity and contacts move anything. `simulate_carry` finds the least multiple of
the planned forces that holds the box during a carry, and simulates the carry with the commanded
forces.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.errors import SimulationError
from hybrid_opt.extras.simulation.box import (
    SAME_TIME,
    HeldBox,
    Outcome,
    Threshold,
    bisected,
    mujoco_module,
)
from hybrid_opt.extras.simulation.reference import (
    ArmController,
    ArmState,
    Control,
    Reference,
    carry_reference,
    pressed_reference,
)
from hybrid_opt.extras.simulation.scene import (
    IMPEDANCE,
    PRESSES,
    ArmSettings,
    cell_text,
    compiled,
    joint_names,
    patch_area,
)
from hybrid_opt.robust.squeeze import Squeeze
from symbolic.array import Array, interpolated
from symbolic.contact.registry import require_squeeze
from symbolic.records import Workcell
from symbolic.records.poses import box_rotation

LOOK_INTERVAL = 5e-3
"""Time between two measurements of the box [s]."""

LOW, HIGH, BISECTIONS = 0.9, 2.0, 9
"""Factors between which a threshold is searched by so many bisections, to about 0.2 %."""


@dataclass(frozen=True)
class ArmOutcome(Outcome):
    """Outcome of one simulation of a whole cell, with measurements at n times. Slip is measured
    only while the pads alone hold the box.

    Attributes:
        normal_force: (n, 2) measured normal force of each arm [N].
        normal_force_reference: (n, 2) commanded normal force of each arm [N].
        q: (n, all joints) joint positions of both arms side by side [rad, or m for sliding joints].
        tracking_error: (n, all joints) reference minus simulated joint position [rad or m].
        torque_use: (all joints,) largest torque of each joint over its limit.
        box_position: (n, 3) position of the box frame in the world [m].
        box_rotation: (n, 3, 3) R_world_box.
        misses: final distance of the box centre from its goal [m]; zero if there is no goal.
        arrives: True if the box did not slip and ended at its goal.
    """

    normal_force: Array
    normal_force_reference: Array
    q: Array
    tracking_error: Array
    torque_use: Array
    box_position: Array
    box_rotation: Array
    misses: float
    arrives: bool


class PressedBox(HeldBox):
    """A simulated box between pads: measures the pads' normal forces, and corrects MuJoCo's
    contacts for the rotation of the pads."""

    def __init__(self, mujoco: ModuleType, model: Any, data: Any, workcell: Workcell) -> None:
        """Find the box, the pads and the contact points of each pad in a model.

        Args:
            mujoco: MuJoCo's Python module.
            model, data: MuJoCo's model of the cell, from `cell_text`, and its state.
            workcell: the cell.
        """
        super().__init__(model, data, workcell)
        self._mujoco, self._model = mujoco, model
        self._bodies = [int(model.site_bodyid[site]) for site in self.sites]
        self._pad_of_geom = np.full(model.ngeom, -1)
        self._seen = np.zeros(2)
        for i, body in enumerate(self._bodies):
            points = (model.geom_bodyid == body) & (model.geom_contype == PRESSES)
            self._pad_of_geom[points] = i
            damping = -float(model.geom_solref[points, 1].min()) / IMPEDANCE
            self._seen[i] = 1.0 - damping * model.opt.timestep / 2.0
        self._change = np.zeros((3, model.nv))

    @property
    def normal_forces(self) -> Array:
        """(2,) normal force of each robot's pads in the last step [N]."""
        pad, _, address, _ = self._contacts()
        return np.bincount(pad, self._data.efc_force[address], 2).astype(float)

    def mend_contacts(self) -> None:
        """Add a neglected term to the reference accelerations of the contacts. This method has to
        run between MuJoCo's `mj_step1` and `mj_step2`.

        With contact Jacobian J and joint velocities v, the box accelerates relative to a pad by
        J dv/dt + dJ/dt v. MuJoCo neglects the second term, some tenths of m/s^2 where arms swing;
        without it contacts creep by millimetres per second and lift off.

        In a step of length dt the pads move along arcs, the box along a straight line. This
        separates them by half of dJ/dt v dt^2; the added term is reduced so that the contacts'
        damping compensates for it.
        """
        pad, is_first, address, axes = self._contacts()
        if not len(pad):
            return
        unseen = np.array([self._seen[i] * self._unseen(i) for i in (0, 1)])[pad]
        sign = np.where(is_first, -1.0, 1.0)[:, None]  # the second body's less the first's
        rows = address[:, None] + np.arange(3)
        self._data.efc_aref[rows] -= sign * np.einsum("nij,nj->ni", axes, unseen)

    def _unseen(self, pad: int) -> Array:
        """Compute the acceleration dJ/dt v (3,) of a pad relative to the box, which MuJoCo
        neglects, along world axes [m/s^2]. J is the Jacobian of the contact, v the joint
        velocities.

        Args:
            pad: index of the pad's robot.
        """
        place, found = self._data.site_xpos[self.sites[pad]], []
        for body in (self._bodies[pad], self.box):
            self._mujoco.mj_jacDot(self._model, self._data, self._change, None, place, body)
            found.append(self._change @ self._data.qvel)
        less: Array = found[0] - found[1]
        return less

    def _contacts(self) -> tuple[Indices, NDArray[np.bool_], Indices, Array]:
        """Return the n active contacts between pads and box.

        Returns:
            - Index (n,) of the pad's robot.
            - True (n,) if the pad is the first of the two bodies in MuJoCo's contact.
            - Index (n,) of the first of the contact's three constraint rows.
            - Axes (n, 3, 3) of the contact as rows, world frame.
        """
        contact = self._data.contact
        sides = self._pad_of_geom[contact.geom]
        pad = sides.max(axis=1)
        active = (pad >= 0) & (contact.efc_address >= 0)
        axes = contact.frame[active].reshape(-1, 3, 3)
        return pad[active], sides[active, 0] >= 0, contact.efc_address[active], axes


class CellSimulation:
    """Simulation of a whole workcell with both arms.

    Attributes:
        workcell, settings: the cell, and settings of the simulation.
        mujoco, model, text: MuJoCo's Python module, its model of the cell, and the model as MJCF.
        disturbance: (3,) acceleration that the pads have to give the box in addition, world frame
            [m/s^2].
    """

    def __init__(
        self,
        workcell: Workcell,
        settings: ArmSettings | None = None,
        disturbance: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Build the model of the cell. Nothing is simulated yet.

        Args:
            workcell: the cell.
            settings: settings of the simulation; None for the defaults.
            disturbance: (3,) acceleration that the pads have to give the box in addition to the
                acceleration of the motion, world frame [m/s^2].

        Raises:
            SimulationError: MuJoCo is not installed, or a joint's largest torque is unknown.
            SettingsError: the cell has hands that hold without a squeeze.
        """
        if not np.isfinite(workcell.stack_joint_limits("torque_max")).all():
            raise SimulationError(
                "controllers of simulated arms are scaled by torque_max, which is unknown here; "
                "give torques of all joints",
                code="unknown-torques",
            )
        self.workcell = workcell
        self.settings = settings or ArmSettings()
        self.disturbance = np.asarray(disturbance, dtype=float)
        self.mujoco = mujoco_module()
        require_squeeze(workcell, "a simulation of pads")
        self.model, self.text = compiled(self.mujoco, cell_text(workcell, self.settings))

    def simulate(
        self,
        reference: Reference,
        control: Control = "leader",
        factor: float = 1.0,
    ) -> ArmOutcome:
        """Simulate one job, up to its end or to a slip.

        Args:
            reference: commands to both arms. Their cell may differ from the simulated one in
                payload, friction and the positions of the pads.
            control: 'impedance' for two position-controlled arms, 'leader' if only the
                force-controlled arm of the commands controls its normal force, 'both' if both arms
                do.
            factor: number by which the commanded normal forces are multiplied.
        """
        return _ArmSimulation(self, reference, control, factor).outcome()


class _ArmSimulation:
    """State of one simulation of a whole cell while it runs."""

    def __init__(
        self,
        witness: CellSimulation,
        reference: Reference,
        control: Control,
        factor: float,
    ) -> None:
        self._settings, self._workcell = witness.settings, witness.workcell
        self._reference, self._factor = reference, factor
        self._shares_squeeze = control == "both"
        self._mujoco, self._model = witness.mujoco, witness.model
        self._data = self._mujoco.MjData(self._model)
        self._pads = PressedBox(self._mujoco, self._model, self._data, self._workcell)
        names = joint_names(self._workcell)
        self._q = np.array([int(self._model.joint(name).qposadr[0]) for name in names])
        self._v = np.array([int(self._model.joint(name).dofadr[0]) for name in names])
        box = self._model.joint("box")
        self._pose = slice(int(box.qposadr[0]), int(box.qposadr[0]) + 7)
        self._box_v = slice(int(box.dofadr[0]), int(box.dofadr[0]) + 6)
        split = len(self._workcell.robots[0].torque_max)
        self._arms = (slice(0, split), slice(split, None))
        self._ticks = _Ticks.of(reference, factor, self._settings)
        self._limit = self._workcell.stack_joint_limits("torque_max")
        self._torque_use = np.zeros(len(self._limit))
        self._jacobian = np.zeros((6, self._model.nv))
        self._standing = self._place(witness.disturbance)
        stiffness = self._settings.stiffness * self._limit
        critical = 2.0 * np.sqrt(stiffness * self._joint_inertia())
        damping = self._settings.damping_ratio * critical
        pressing = {"impedance": (), "leader": (1 - reference.leader,), "both": (0, 1)}[control]
        self._controllers = [
            ArmController(
                self._settings,
                (stiffness[arm], damping[arm]),
                self._settings.layer * patch_area(contact),
                is_force_controlled=i in pressing,
                drift_stiffness=self._settings.drift_stiffness if self._shares_squeeze else 0.0,
            )
            for i, arm, contact in zip((0, 1), self._arms, self._workcell.contacts, strict=True)
        ]

    def outcome(self) -> ArmOutcome:
        """Run the simulation and return its outcome."""
        settings, pads, held = self._settings, self._pads, self._reference.job.held
        per_tick = round(settings.control_period / settings.time_step)
        every = max(1, round(LOOK_INTERVAL / settings.control_period))
        seen: list[tuple[Any, ...]] = []
        holds = True
        for k, time in enumerate(self._ticks.time):
            measured = pads.normal_forces
            self._begin_step(time)
            self._data.qfrc_applied[self._v] = self._torque(k, measured)
            if k % every == 0:
                slip, turn = np.zeros(2), 0.0
                if held[0] <= time <= held[1]:
                    slip, turn = pads.look()
                joints = self._data.qpos[self._q].copy()
                place = self._data.xpos[pads.box].copy()
                rotation = self._data.xmat[pads.box].reshape(3, 3).copy()
                seen.append((time, slip, turn, measured, k, joints, place, rotation))
                if not slip.max() <= settings.slip:
                    holds = False
                    break
            self._mujoco.mj_step2(self._model, self._data)
            for _ in range(per_tick - 1):
                self._begin_step(time)
                self._mujoco.mj_step2(self._model, self._data)
        return self._told(seen, holds)

    def _told(self, seen: list[tuple[Any, ...]], holds: bool) -> ArmOutcome:
        columns = (np.array(values) for values in zip(*seen, strict=True))
        time, slip, turn, force, ticks, q, position, rotation = columns
        goal = self._reference.job.goal
        misses = 0.0 if goal is None else float(np.linalg.norm(position[-1] - goal))
        return ArmOutcome(
            factor=self._factor,
            holds=holds,
            time=time,
            slip=slip,
            turn=turn,
            normal_force=force,
            normal_force_reference=self._ticks.normal_force[ticks],
            q=q,
            tracking_error=self._ticks.q[ticks] - q,
            torque_use=self._torque_use,
            box_position=position,
            box_rotation=rotation,
            misses=misses,
            arrives=holds and misses <= self._settings.arrival,
        )

    def _place(self, disturbance: Array) -> Array:
        """Set arms and box to their first poses, and apply a disturbance to the box.

        Args:
            disturbance: (3,) acceleration that the pads have to give the box in addition, world
                frame [m/s^2].

        Returns:
            (7,) position [m] of the box, then unit quaternion with the real part first.
        """
        data, job = self._data, self._reference.job
        data.qpos[self._q], data.qvel[self._v] = self._ticks.q[0], self._ticks.q_rate[0]
        rotation = box_rotation(self._workcell.task.orientation, job.start)
        # The arms grip where they were told: pads elsewhere on the box mean a box elsewhere.
        pairs = zip(self._workcell.contacts, self._reference.workcell.contacts, strict=True)
        displaced = np.mean([real.T_box_pad - told.T_box_pad for real, told in pairs], axis=0)
        position = job.start[:3] - rotation @ displaced[:3, 3]
        turn = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
        standing = np.concatenate([position, turn])
        data.qpos[self._pose] = standing
        data.xfrc_applied[self._pads.box, :3] = -self._workcell.payload.mass * disturbance
        self._mujoco.mj_forward(self._model, data)
        return standing

    def _begin_step(self, time: float) -> None:
        """Make the first half of a step of the physics: compute poses and contacts.

        Args:
            time: time of the step [s].
        """
        if time < self._reference.job.stands:
            self._data.qpos[self._pose] = self._standing
            self._data.qvel[self._box_v] = 0.0
        self._mujoco.mj_step1(self._model, self._data)
        self._pads.mend_contacts()

    def _torque(self, k: int, measured: Array) -> Array:
        """Compute the joint torques of both arms, clipped to the torque limits.

        Args:
            k: index of the controllers' time step.
            measured: (2,) measured normal force of each arm [N].

        Returns:
            (all joints,) torques, both arms side by side [N m, for sliding joints N].
        """
        data, ticks = self._data, self._ticks
        error = ticks.q[k] - data.qpos[self._q]
        error_rate = ticks.q_rate[k] - data.qvel[self._v]
        asked = ticks.normal_force[k]
        # What both squeeze is controlled, not what the box takes of it on one side.
        felt = asked - (asked - measured).mean() if self._shares_squeeze else measured
        torque = np.empty(len(self._limit))
        linear, angular = self._jacobian[:3], self._jacobian[3:]
        for i, arm in enumerate(self._arms):
            site = self._pads.sites[i]
            self._mujoco.mj_jacSite(self._model, data, linear, angular, site)
            state = ArmState(
                error[arm],
                error_rate[arm],
                self._jacobian[:, self._v[arm]],
                data.site_xmat[site].reshape(3, 3)[:, 2],
                float(felt[i]),
            )
            effort = ticks.effort[k, arm]
            torque[arm] = self._controllers[i].torque(state, effort, float(asked[i]))
        np.maximum(self._torque_use, np.abs(torque) / self._limit, out=self._torque_use)
        return np.clip(torque, -self._limit, self._limit)

    def _joint_inertia(self) -> Array:
        """Compute the inertia about each joint while all other joints are fixed.

        Returns:
            (all joints,) both arms side by side [kg m^2, for sliding joints kg].
        """
        found = np.empty(len(self._v))
        for k, joint in enumerate(self._v):
            unit, moved = np.zeros(self._model.nv), np.zeros(self._model.nv)
            unit[joint] = 1.0
            self._mujoco.mj_mulM(self._model, self._data, moved, unit)
            found[k] = moved[joint]
        return found


@dataclass(frozen=True, eq=False)
class _Ticks:
    """References of both arms at the n times of the controllers. Normal forces are already
    multiplied by the factor of the simulation.

    Attributes:
        time: (n,) times [s].
        q, q_rate: (n, all joints) joint positions and velocities [rad or m, and s].
        effort: (n, all joints) feedforward joint torques, those of the normal forces included [N m,
            for sliding joints N].
        normal_force: (n, 2) commanded normal force of each arm [N].
    """

    time: Array
    q: Array
    q_rate: Array
    effort: Array
    normal_force: Array

    @classmethod
    def of(cls, reference: Reference, factor: float, settings: ArmSettings) -> _Ticks:
        motion, period = reference.motion, settings.control_period
        begin, end = motion.time[[0, -1]]
        time = begin + period * np.arange(round((end - begin) / period) + 1)
        single = np.concatenate([[True], np.diff(motion.time) > SAME_TIME])
        spline = CubicHermiteSpline(motion.time[single], motion.q[single], motion.q_rate[single])
        at = np.minimum(time, end)

        counts = [len(robot.torque_max) for robot in reference.workcell.robots]
        limit = reference.workcell.stack_joint_limits("torque_max")
        motors = settings.armature * limit * motion.q_second
        more = (factor - 1.0) * np.repeat(reference.normal_force, counts, axis=1)
        return cls(
            time=time,
            q=spline(at),
            q_rate=spline(at, 1),
            effort=interpolated(
                at, motion.time, reference.effort + motors + more * reference.press_torque
            ),
            normal_force=factor * interpolated(at, motion.time, reference.normal_force),
        )


Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class CarrySimulation:
    """Simulations of one carry.

    Attributes:
        threshold: the least factor of the planned forces that holds the box; None if there is none
            between `LOW` and `HIGH`.
        problem: reason why there is no threshold, else ''.
        reference: commands to both arms in the simulation `shown`.
        squeeze: how the commanded forces were chosen.
        shown: outcome of the simulation with the commanded forces.
    """

    threshold: Threshold[ArmOutcome] | None
    problem: str
    reference: Reference
    squeeze: Squeeze
    shown: ArmOutcome


def simulate_carry(
    cell: Cell, carry: Carry, witness: CellSimulation, control: Control = "leader", leader: int = 0
) -> CarrySimulation:
    """Simulate a carry in two ways: with multiples of its planned forces, to find the least one
    that holds the box, and once with the commanded forces of its job.

    Args:
        cell: the cell.
        carry: carry from rest to rest.
        witness: simulation of the cell.
        control: kind of force control, as in `CellSimulation.simulate`.
        leader: index of the position-controlled arm; the other one is force-controlled.

    Raises:
        SettingsError: the carry does not start and end at rest.
    """
    reference = carry_reference(cell, carry, leader=leader)
    threshold, problem = None, ""
    try:
        threshold = bisected(
            lambda s: witness.simulate(reference, control, s), LOW, HIGH, BISECTIONS
        )
    except SimulationError as error:
        problem = str(error)
    pressed, squeeze = pressed_reference(cell, carry, leader)
    shown = witness.simulate(pressed, control)
    return CarrySimulation(threshold, problem, pressed, squeeze, shown)
