"""References of a simulated cell, and the controllers that follow them.

References state the joint positions and the normal forces of the pads over time. Controllers are
those of real cells: joint impedance, and force control along the contact normal. All feed forward
the arms' own inverse dynamics and the planned forces at the pads, but no moments, which are left to
stiffness. `impedance`: every joint is a spring and a damper about its reference. `leader`: the
leading arm has joint impedance; the other arm has no stiffness along the normal and an integral
control of its normal force instead. `both`: both arms control the mean of their force errors and
have a weak spring along the normal, since nothing else keeps the box in its place between them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pinocchio as pin

from hybrid_opt.carry import Carry, joints_of
from hybrid_opt.cell import Cell
from hybrid_opt.errors import SimulationError
from hybrid_opt.extras.simulation.box import refuse_motion_at_ends
from hybrid_opt.extras.simulation.scene import ArmSettings
from hybrid_opt.robust.squeeze import Squeeze, SqueezeSettings, commanded_forces
from hybrid_opt.timing.jerk import applicable_jerk_limits, driven_timing, without_jumps
from hybrid_opt.timing.records import Timing
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell
from symbolic.records.poses import box_rotation, inverse
from symbolic.robot.model import build_robot_model

REST_TIME = 0.3
"""Time at rest before a carry [s]."""

STANDS = 0.1
"""Part of this time in which a support still holds the box [s]."""

TOUCHES = 5.0
"""Force control is fully active from this reference of the normal force on [N]."""


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Motion of the joints of both arms side by side, at n times that do not decrease.

    Attributes:
        time: (n,) times [s].
        q, q_rate, q_second: (n, all joints) joint positions and their first and second time
            derivatives [rad or m, and s].
    """

    time: Array
    q: Array
    q_rate: Array
    q_second: Array


@dataclass(frozen=True, eq=False)
class BoxJob:
    """Start, goal and support of the box in a simulation.

    Attributes:
        start: (6,) first pose of the box [m, rad].
        goal: (3,) desired final position of the box centre [m]; None if not checked.
        held: first and last time at which only the pads hold the box and slip is measured [s].
        stands: time until which the box is kept in its first pose, in place of a support [s].
    """

    start: Array
    goal: Array | None
    held: tuple[float, float]
    stands: float = -np.inf


@dataclass(frozen=True, eq=False)
class Reference:
    """Commands to both arms for a whole job, at n times.

    Attributes:
        workcell: the cell for which the job was planned.
        motion: motion of the joints.
        normal_force: (n, 2) commanded normal force of each arm [N]; zero while its pads need not
            touch.
        effort: (n, all joints) feedforward joint torques, those of the normal forces included [N m,
            for sliding joints N].
        press_torque: (n, all joints) joint torques per newton of the arm's normal force [m, for
            sliding joints 1].
        job: start, goal and support of the box.
        leader: index of the position-controlled arm if only the other arm controls its force.
    """

    workcell: Workcell
    motion: JointMotion
    normal_force: Array
    effort: Array
    press_torque: Array
    job: BoxJob
    leader: int = 0


def job_reference(
    workcell: Workcell,
    motion: JointMotion,
    normal_force: Array,
    job: BoxJob,
    effort: Array | None = None,
) -> Reference:
    """Build the commands to both arms from the motion of their joints and normal forces.

    Args:
        workcell: the cell.
        motion: motion of the joints at n times.
        normal_force: (n, 2) commanded normal force of each arm [N].
        job: start, goal and support of the box.
        effort: (n, all joints) feedforward joint torques: inverse dynamics and the wrenches of the
            contacts, normal forces included [N m]. None for inverse dynamics and normal forces
            only; the controllers' stiffness then has to carry the box.

    Raises:
        SettingsError: the shapes of the arrays do not fit, or times decrease.
    """
    n, joints = motion.q.shape
    if motion.q_rate.shape != (n, joints) or motion.q_second.shape != (n, joints):
        raise SettingsError("rates of the joints do not fit their positions")
    if motion.time.shape != (n,) or normal_force.shape != (n, 2) or n < 2:
        raise SettingsError(
            f"{len(motion.time)} times and {len(normal_force)} forces for {n} rows", code="shape"
        )
    if (np.diff(motion.time) < 0.0).any():
        raise SettingsError("times decrease", code="times-decrease")
    pressing = press_torque(workcell, motion.q)
    if effort is None:
        repeated = np.repeat(normal_force, _counts(workcell), axis=1)
        effort = inverse_dynamics(workcell, motion) + pressing * repeated
    elif effort.shape != (n, joints):
        raise SettingsError(
            f"efforts of shape {effort.shape} for {n} x {joints} joints", code="shape"
        )
    return Reference(workcell, motion, normal_force, effort, pressing, job)


def carry_reference(
    cell: Cell, carry: Carry, press: Array | None = None, leader: int = 0
) -> Reference:
    """Build the commands to both arms for a carry that begins and ends at rest, after some time at
    rest. The planned wrenches are fed forward as joint torques.

    Args:
        cell: the cell.
        carry: the carry at n samples.
        press: (n,) commanded normal force of the force-controlled arm [N]; None for its planned
            force.
        leader: index of the position-controlled arm. Its normal force rises above the planned one
            by as much as `press` exceeds the other arm's planned force.

    Raises:
        SettingsError: the carry does not start and end at rest, or `press` has another shape.
    """
    refuse_motion_at_ends(carry)
    planned = carry.normal_force[:, 1 - leader]
    if press is not None and press.shape != planned.shape:
        raise SettingsError(f"forces of shape {press.shape} for {len(carry)} samples", code="shape")
    extra = np.zeros_like(planned) if press is None else press - planned
    begin = float(carry.time[0])
    motion = JointMotion(
        time=np.concatenate([[begin - REST_TIME, begin], carry.time]),
        q=_with_rest(carry.q, 1.0),
        q_rate=_with_rest(carry.stack_arms("q_rate"), 0.0),
        q_second=_with_rest(carry.stack_arms("q_second"), 0.0),
    )
    pose, rate, second = (
        _with_rest(values, keep)
        for values, keep in ((carry.pose, 1.0), (carry.rate, 0.0), (carry.second_rate, 0.0))
    )
    model, workcell = cell.timing_model, carry.workcell
    known = replace(carry, pose=pose, rate=rate, second_rate=second)
    friction = np.array([contact.friction for contact in workcell.contacts])
    load = model.uncertain_load(known, friction, workcell.payload.centre_of_mass)
    rotation = box_rotation(workcell.task.orientation, pose)
    one, two = (
        np.einsum("nji,nj->ni", rotation, load[name][:, :3]) for name in ("wrench_1", "wrench_2")
    )
    torque = _force_torque(workcell, motion.q, (one, two))
    # At rest before the carry the pads press as they will have to when it begins.
    extra = np.concatenate([[extra[0]] * 2, extra])
    starting = (carry.normal_force[0] - load["normal_force"][0]).max()
    extra[:2] += max(0.0, float(starting))
    normal_force = load["normal_force"] + extra[:, None]
    pressing = press_torque(workcell, motion.q)
    own = inverse_dynamics(workcell, motion)
    repeated = np.repeat(np.column_stack([extra, extra]), _counts(workcell), axis=1)
    job = BoxJob(
        start=carry.pose[0],
        goal=carry.pose[-1, :3],
        held=(begin - REST_TIME / 2.0, float(carry.time[-1])),
        stands=begin - REST_TIME + STANDS,
    )
    effort = own + torque + pressing * repeated
    return Reference(workcell, motion, normal_force, effort, pressing, job, leader)


def with_tracking_error(
    reference: Reference, amplitude: float, rng: np.random.Generator, opposed: float = 0.0
) -> Reference:
    """Return commands with a sinusoidal error of each joint position, and with torques by which the
    arms push against each other.

    The errors start at zero, with random frequencies from 0.3 to 1.5 Hz. Normal forces stay
    unchanged.

    Args:
        reference: the commands.
        amplitude: largest error of each joint [rad].
        rng: generator of frequencies, phases and the direction of the push.
        opposed: force with which each arm pushes along the first pad's face, in a random direction
            [N].
    """
    workcell, turned = reference.workcell, rng.uniform(0.0, 2.0 * np.pi)
    along = opposed * np.array([np.cos(turned), np.sin(turned), 0.0])
    force = workcell.contacts[0].T_box_pad[:3, :3] @ along
    pushed = _force_torque(workcell, reference.motion.q, (force, -force))
    motion = reference.motion
    joints = motion.q.shape[1]
    omega = 2.0 * np.pi * rng.uniform(0.3, 1.5, joints)
    phase = rng.uniform(0.0, 2.0 * np.pi, joints)
    angle = np.outer(motion.time - motion.time[0], omega) + phase
    off = amplitude * (np.sin(angle) - np.sin(phase)) / 2.0
    rate = amplitude * omega * np.cos(angle) / 2.0
    moved = replace(motion, q=motion.q + off, q_rate=motion.q_rate + rate)
    return replace(reference, motion=moved, effort=reference.effort + pushed)


def press_torque(workcell: Workcell, q: Array) -> Array:
    """Compute the joint torques that exert a normal force of one newton with each arm.

    Both arms press along their normals if these are opposite, else along the line between the
    middles of their pads. So the additional forces cancel in the payload.

    Args:
        workcell: the cell.
        q: (n, all joints) joint positions of both arms side by side [rad or m].

    Returns:
        (n, all joints) torques per force [m, for sliding joints 1].
    """
    middles = [
        np.mean([pad.T_box_pad[:3, 3] for pad in (contact, *contact.further)], axis=0)
        for contact in workcell.contacts
    ]
    forces = []
    for i, contact in enumerate(workcell.contacts):
        normal, line = contact.T_box_pad[:3, 2], middles[1 - i] - middles[i]
        pushed = normal if workcell.has_opposite_pads else line
        forces.append(pushed / (normal @ pushed))
    return _force_torque(workcell, q, (forces[0], forces[1]))


def _force_torque(workcell: Workcell, q: Array, forces: tuple[Array, Array]) -> Array:
    """Compute the joint torques with which both robots exert forces on the box, each in the middle
    of the robot's pads.

    Args:
        workcell: the cell.
        q: (n, all joints) joint positions of both arms side by side [rad or m].
        forces: force (3,) or (n, 3) of each robot on the box, box frame [N].

    Returns:
        (n, all joints) torques [N m, for sliding joints N].
    """
    found = []
    parts = zip(workcell.robots, workcell.contacts, forces, joints_of(workcell, q), strict=True)
    for robot, contact, force, values in parts:
        T_flange_box = robot.T_flange_pad @ inverse(contact.T_box_pad)
        pads = [T_flange_box @ pad.T_box_pad for pad in contact.further]
        middle = np.mean([robot.T_flange_pad, *pads], axis=0)[:3, 3]
        pushed = np.broadcast_to(force @ T_flange_box[:3, :3].T, (len(values), 3))
        wrench = np.column_stack([pushed, np.cross(middle, pushed)])
        arm = build_robot_model(robot)
        data, torque = arm.model.createData(), np.empty_like(values)
        for k, row in enumerate(values):
            J = pin.computeFrameJacobian(arm.model, data, row, arm.flange_id, pin.LOCAL)
            torque[k] = J.T @ wrench[k]
        found.append(torque)
    return np.concatenate(found, axis=1)


def inverse_dynamics(workcell: Workcell, motion: JointMotion) -> Array:
    """Compute the joint torques that move both arms without contacts, gravity included.

    Args:
        workcell: the cell.
        motion: motion of the joints at n times.

    Returns:
        (n, all joints) torques [N m, for sliding joints N].
    """
    found = []
    parts = [joints_of(workcell, values) for values in (motion.q, motion.q_rate, motion.q_second)]
    for robot, *rows in zip(workcell.robots, *parts, strict=True):
        model = build_robot_model(robot).model
        data = model.createData()
        found.append(np.array([pin.rnea(model, data, *row) for row in zip(*rows, strict=True)]))
    return np.concatenate(found, axis=1)


def _counts(workcell: Workcell) -> list[int]:
    return [len(robot.torque_max) for robot in workcell.robots]


def _with_rest(values: Array, keep: float) -> Array:
    """Insert a time at rest before an array of samples: two rows, each the first row times a
    factor.

    Args:
        values: (n, ...) the array.
        keep: the factor: 1 for positions, which stay, and 0 for their derivatives.

    Returns:
        (n + 2, ...) array.
    """
    return np.concatenate([keep * values[:1], keep * values[:1], values])


Control = Literal["impedance", "leader", "both"]


@dataclass(frozen=True, eq=False)
class ArmState:
    """Measured state of one arm at one time.

    Attributes:
        error, error_rate: (n_joints,) reference minus measured joint position [rad], and its time
            derivative [rad/s].
        jacobian: (6, n_joints) Jacobian of the pad: linear, then angular velocity along world axes
            per joint velocity.
        normal: (3,) normal of the pad into the box, world axes.
        force: measured normal force [N]; if both arms control their force, the commanded force
            minus the mean error of both arms' forces.
    """

    error: Array
    error_rate: Array
    jacobian: Array
    normal: Array
    force: float


class ArmController:
    """Controller of one arm's joint positions and, if wanted, of its normal force by an integral.

    Attributes:
        is_force_controlled: True if the arm controls its normal force.
    """

    def __init__(
        self,
        settings: ArmSettings,
        gains: tuple[Array, Array],
        pad_stiffness: float,
        is_force_controlled: bool,
        drift_stiffness: float,
    ) -> None:
        """Start with a zero integral of the force error.

        Args:
            settings: settings of the controllers.
            gains: stiffness and damping (n_joints,) of the joints [N m/rad, N m s/rad].
            pad_stiffness: stiffness of all layers of the arm's pads along the normal [N/m]. An arm
                without force control aims beyond the contact by the compression of the layers.
            is_force_controlled: True if the arm controls its normal force.
            drift_stiffness: stiffness along the normal that a force-controlled arm keeps [N/m].
        """
        self.is_force_controlled = is_force_controlled
        self._settings = settings
        self._stiffness, self._damping = gains
        self._pad_stiffness = pad_stiffness
        self._drift_stiffness = drift_stiffness
        self._integral = 0.0

    def torque(self, state: ArmState, effort: Array, normal_force: float) -> Array:
        """Compute the joint torques (n_joints,) of one time step [N m].

        Args:
            state: measured state of the arm.
            effort: (n_joints,) feedforward joint torques [N m].
            normal_force: commanded normal force [N].
        """
        pressed, moved = 0.0, -normal_force / self._pad_stiffness
        along = state.normal @ state.jacobian[:3]
        if self.is_force_controlled:
            touches = min(1.0, max(0.0, normal_force / TOUCHES))
            if touches == 1.0 and state.force > 0.0:
                gain = self._settings.force_gain * self._settings.control_period
                self._integral += gain * (normal_force - state.force)
            distance = float(along @ state.error)
            pressed = touches * (self._integral + self._drift_stiffness * distance)
            moved = touches * distance
        # Without the part that moves the pad along its normal, or with more of it.
        linear = np.concatenate([moved * state.normal, np.zeros(3)])
        error = state.error - np.linalg.pinv(state.jacobian) @ linear
        sprung: Array = self._stiffness * error + self._damping * state.error_rate
        return effort + sprung + pressed * along


def pressed_reference(cell: Cell, carry: Carry, leader: int = 0) -> tuple[Reference, Squeeze]:
    """Build the commands to both arms for a carry with the commanded normal forces of a job.

    The forces hold the box in every case of the uncertainty, if the workcell states one. They are
    smooth, so controllers can follow them, and never below the required forces.

    Args:
        cell: the cell.
        carry: carry from rest to rest.
        leader: index of the position-controlled arm; the other one is force-controlled.

    Returns:
        The commands, and how the forces were chosen.
    """
    forces, squeeze = commanded_forces(cell.workcell, carry, SqueezeSettings(leader=leader))
    return carry_reference(cell, carry, forces[:, 1 - leader], leader), squeeze


def driven_carry(cell: Cell, x: Array) -> Carry:
    """Compute the carry of a decision vector, timed as in a job from rest to rest without jumps of
    acceleration.

    Args:
        cell: the cell.
        x: (n_var,) decision vector.

    Raises:
        SimulationError: the path has no timing.
        JobError: there is no timing without jumps of acceleration.
    """
    return exported_carry(cell, driven_timing(cell.timing_model, x))


def exported_carry(cell: Cell, timing: Timing) -> Carry:
    """Compute the carry of a timing as a job drives it, without jumps of acceleration.

    Args:
        cell: the cell.
        timing: timing of a path of the cell.

    Raises:
        SimulationError: the timing has no carry.
        JobError: there is no timing without jumps of acceleration.
    """
    if not timing.ok or timing.carry is None:
        raise SimulationError(
            f"the trajectory cannot be driven: {timing.reason}", code="not-drivable"
        )
    jerk = applicable_jerk_limits(cell.workcell, timing.limits)
    found = without_jumps(cell.timing_model, timing, jerk).carry
    assert found is not None, "a timing without jumps has a carry"
    return found
