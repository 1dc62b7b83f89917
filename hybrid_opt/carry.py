"""One carry: motion of box and arms, and the forces between them, under one timing.

`Cell.carry` returns a carry under the task's time law. `time_path` returns a timing within the
limits of the robots, which contains a carry as well. Arrays of forces have an axis over the two
robots. Joint arrays are kept per arm in `arms`, because the arms may have different numbers of
joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction
from hybrid_opt.display_protocol import Displayable, Page, display
from hybrid_opt.indicators.metrics import excess_above_static
from hybrid_opt.static_hold import payload_limit, static_hold
from symbolic.array import Array, set_read_only
from symbolic.contact.registry import contact_model
from symbolic.path.spline import sample_basis, waypoints_of
from symbolic.records import Workcell

OBJECTIVE = "objective_"
"""Prefix of an objective's name among a carry's figures."""


FORCE_LIMIT = "force_limit"
JOINT_TORQUE = "joint_torque"
NO_TIMING = "no_timing"
DRIVE_CONSTRAINTS = (FORCE_LIMIT, JOINT_TORQUE, NO_TIMING)
"""Constraints of drivable cells, whose carries are timed from rest to rest within all limits.

force_limit, joint_torque: holding the box at rest needs more than the limit allows; the violation
is the needed value over the limit, minus 1.
no_timing: the timing solver rejects the path for any other reason; the violation is 1.
"""

STANDSTILL = 1e-30
"""Squared length of a path's tangent below which the tangent counts as zero [(m, rad per u)^2]."""


@dataclass(frozen=True)
class Judgement:
    """Feasibility and objectives of one candidate, evaluated at the task's samples.

    Attributes:
        feasible: True if the candidate satisfies every constraint.
        reason: name of the constraint that is violated first along the path; '' if the candidate is
            feasible.
        position: path parameter in [0, 1] of the first violation; None if the candidate is
            feasible.
        objectives: objective values by name, without penalty.
    """

    feasible: bool
    reason: str
    position: float | None
    objectives: Mapping[str, float]

    def __str__(self) -> str:
        if self.position is None:
            return "feasible"
        where = f"at {100.0 * self.position:.0f} % of the path"
        return f"infeasible, {self.reason.replace('_', ' ')} {where}"


@dataclass(frozen=True, eq=False)
class ArmMotion:
    """One arm along a carry, n samples; arrays are read-only.

    Attributes:
        q, q_rate, q_second: (n, n_joints) joint positions [rad], velocities [rad/s] and
            accelerations [rad/s^2].
        contact_torque: (n, n_joints) joint torques of the contact wrench alone [N m].
        own_torque: (n, n_joints) joint torques of the bare arm's motion and weight [N m].
    """

    q: Array
    q_rate: Array
    q_second: Array
    contact_torque: Array
    own_torque: Array

    def __post_init__(self) -> None:
        set_read_only(self)

    @property
    def torque(self) -> Array:
        """(n, n_joints) total joint torques [N m]: those of the bare arm's motion and weight, and
        those of the contact wrench."""
        return self.contact_torque + self.own_torque


@dataclass(frozen=True, eq=False, repr=False)
class Carry(Displayable):
    """A carry with its timing and every physical quantity; n samples, world frame, read-only.

    Where the path acceleration jumps there may be two samples of the same time, one with the values
    before the jump and one with the values after it.

    Attributes:
        workcell: the description of the cell.
        x: (n_var,) decision vector.
        timing: name of the time law, 'constant' or 'ramped', or 'limits' for a computed timing.
        parameter: (n,) path parameter u in [0, 1].
        time: (n,) time of each sample [s].
        pose, rate, second_rate: (n, 6) box pose [m, rad] and its first and second time derivative.
        angular_velocity, angular_acceleration: (n, 3) angular velocity [rad/s] and angular
            acceleration [rad/s^2] of the box.
        normal_force, tangential_force: (n, 2) normal and tangential force of each robot [N].
        contact_force: (n, 2, 3) force vector of each robot on the box [N].
        pressure_shift: (n, 2) length of the shift of the centre of pressure at each contact [m].
        point_moment_residual: (n, 3) required moment about the centre of mass less the moment of
            the contact forces, if these act at the nominal contact points [N m].
        moment_residual: (n, 3) required moment about the centre of mass less the moment of the
            contacts, if the forces act at the shifted centres of pressure [N m].
        arms: the motion of each robot's joints.
        judgement: feasibility and objectives of the candidate, None if not evaluated.
    """

    workcell: Workcell
    x: Array
    timing: str
    parameter: Array
    time: Array
    pose: Array
    rate: Array
    second_rate: Array
    angular_velocity: Array
    angular_acceleration: Array
    normal_force: Array
    tangential_force: Array
    contact_force: Array
    pressure_shift: Array
    point_moment_residual: Array
    moment_residual: Array
    arms: tuple[ArmMotion, ArmMotion]
    judgement: Judgement | None = None

    def __post_init__(self) -> None:
        set_read_only(self)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def peak_normal_force(self) -> Array:
        """(2,) largest normal force of each robot [N]."""
        return np.asarray(self.normal_force.max(axis=0))

    @property
    def mean_normal_force(self) -> Array:
        """(2,) normal force of each robot averaged over time [N]."""
        return np.asarray(np.trapezoid(self.normal_force, self.time, axis=0) / self.duration)

    @property
    def force_ratio(self) -> Array:
        """(2,) ratio of each robot's peak normal force to its reference force: the paper's
        objectives (Eq. 60).
        """
        return np.asarray(self.peak_normal_force / self.workcell.task.reference_force)

    @property
    def peak_resultant_force(self) -> Array:
        """(2,) largest magnitude of each robot's contact force [N], its normal and tangential part
        together.
        """
        return np.asarray(np.linalg.norm(self.contact_force, axis=2).max(axis=0))

    @property
    def payload_limit(self) -> float:
        """Payload mass [kg] up to which neither robot exceeds its reference force on the same
        motion.

        All forces grow in proportion to the mass.
        """
        forces = self.peak_normal_force, self.peak_resultant_force
        return payload_limit(self.workcell, contact_model(self.workcell).limited_force(*forces))

    @property
    def excess_above_static(self) -> Array:
        """(2,) relative excess of each robot's peak normal force over its normal force when the
        payload is held level and at rest [%].
        """
        return excess_above_static(self.peak_normal_force, static_hold(self.workcell).normal_force)

    @property
    def mean_excess_above_static(self) -> float:
        """Relative excess of the mean of both peak normal forces over the mean of both normal
        forces when the payload is held level and at rest [%].
        """
        still = static_hold(self.workcell).normal_force.mean()
        return float(excess_above_static(self.peak_normal_force.mean(), still))

    @property
    def friction_margin(self) -> Array:
        """(n, 2) friction left at each contact [N]: friction coefficient times normal force, less
        the tangential force; zero where the contact force is on the friction cone.
        """
        friction = [contact.friction for contact in self.workcell.contacts]
        return np.asarray(self.normal_force * friction - self.tangential_force)

    @property
    def peak_pressure_shift(self) -> Array:
        """(2,) largest shift of the centre of pressure at each contact [m]."""
        return np.asarray(self.pressure_shift.max(axis=0))

    @property
    def peak_contact_torque_use(self) -> Array:
        """(2,) for each arm, the largest ratio of a joint torque of the contact wrench to the
        joint's torque limit.
        """
        return np.array(
            [
                float((np.abs(arm.contact_torque) / robot.torque_max).max())
                for arm, robot in zip(self.arms, self.workcell.robots, strict=True)
            ]
        )

    @property
    def q(self) -> Array:
        """(n, all joints) both arms' joint positions side by side [rad]."""
        return self.stack_arms("q")

    @property
    def contact_torque(self) -> Array:
        """(n, all joints) joint torques of the contact wrenches, both arms side by side [N m]."""
        return self.stack_arms("contact_torque")

    @property
    def torque(self) -> Array:
        """(n, all joints) joint torques of arm motion, weight and contact wrench together, both
        arms side by side [N m].
        """
        return self.stack_arms("torque")

    def stack_arms(self, name: str) -> Array:
        """Return one quantity of both arms side by side (n, all joints), the first arm first.

        Args:
            name: attribute name in `ArmMotion`.
        """
        return np.concatenate([getattr(arm, name) for arm in self.arms], axis=1)

    @property
    def figures(self) -> dict[str, float]:
        """Numbers that describe an evaluated carry, by name, in SI units, for storage and reports.

        `feasible` is 1 or 0. `objective_<name>` has no penalty. Mean forces are means over time.
        """
        judgement = self.judgement
        assert judgement is not None, "figures are those of a carry that the evaluator judged"
        figures = {
            "feasible": float(judgement.feasible),
            "duration": self.duration,
            "payload_limit": self.payload_limit,
        }
        figures |= {f"{OBJECTIVE}{name}": value for name, value in judgement.objectives.items()}
        per_robot = {
            "peak_normal_force": self.peak_normal_force,
            "mean_normal_force": self.mean_normal_force,
            "peak_resultant_force": self.peak_resultant_force,
            "peak_pressure_shift": self.peak_pressure_shift,
            "peak_contact_torque_use": self.peak_contact_torque_use,
        }
        for i in range(len(self.arms)):
            figures |= {f"{name}_{i + 1}": float(values[i]) for name, values in per_robot.items()}
        return figures

    def view(self, height: int = 480) -> Page:
        """Show the carry in three dimensions: in a notebook's cell, or saved as a page.

        Args:
            height: height of the view in a notebook [px].
        """
        page: Page = display("scene").CarryView(self, height)
        return page


@dataclass(frozen=True)
class BoxMotion:
    """Box poses and their time derivatives at n samples, world frame.

    Attributes:
        pose: (n, 6) box poses [m, rad].
        rate, second_rate: (n, 6) first and second time derivative of the pose.
    """

    pose: Array
    rate: Array
    second_rate: Array

    def at(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> BoxMotion:
        """Return the motion at the samples `rows`: indices (m,), or a mask (n,) that is True for
        them.
        """
        return BoxMotion(self.pose[rows], self.rate[rows], self.second_rate[rows])


HeldMotion = BoxMotion | Carry
"""A motion given by box poses and their time derivatives."""


def motion_inputs(motion: HeldMotion) -> tuple[Array, Array, Array]:
    """Return pose, first and second time derivative (n, 6) of the box along a motion, the inputs of
    the compiled force functions.
    """
    return motion.pose, motion.rate, motion.second_rate


def box_motion(motion: HeldMotion) -> BoxMotion:
    """Return the box poses of a motion and their time derivatives, without the other quantities of
    a carry.
    """
    return BoxMotion(*motion_inputs(motion))


def tile_motion(motion: HeldMotion, times: int) -> BoxMotion:
    """Repeat the samples of a motion several times, one copy after the other.

    Args:
        motion: motion of n samples.
        times: number of copies.

    Returns:
        Motion of times * n samples.
    """
    return BoxMotion(*[np.tile(values, (times, 1)) for values in motion_inputs(motion)])


def at_rest() -> BoxMotion:
    """Return a motion of one sample: the box at rest in the world's origin, with its axes along the
    world's.
    """
    return BoxMotion(*[np.zeros((1, 6))] * 3)


def at_standstill(motion: HeldMotion) -> BoxMotion:
    """Return a motion with the same box poses, whose time derivatives are zero."""
    return BoxMotion(motion.pose, 0.0 * motion.rate, 0.0 * motion.second_rate)


def joints_of(workcell: Workcell, values: Array) -> tuple[Array, Array]:
    """Split joint values of both arms side by side into one array (n, n_joints) per arm.

    Args:
        workcell: the cell.
        values: (n, all joints) values, the first arm first.
    """
    first = len(workcell.robots[0].velocity_max)
    return values[:, :first], values[:, first:]


def carry_from_outputs(
    workcell: Workcell,
    functions: Mapping[str, NumericFunction],
    x: Array,
    outputs: Mapping[str, Array],
    judgement: Judgement | None = None,
) -> Carry:
    """Build the carry of one candidate from the outputs of the compiled candidate function.

    Args:
        workcell: the description of the cell.
        functions: compiled functions by name, with `inverse_dynamics_1` and `inverse_dynamics_2`.
        x: (n_var,) decision vector.
        outputs: output arrays by name for x, without an axis over candidates.
        judgement: feasibility and objectives of the candidate, None if not evaluated.
    """
    time = outputs["time"].reshape(-1)
    arms = [_arm(workcell, functions[f"inverse_dynamics_{arm}"], x, outputs, arm) for arm in (1, 2)]
    return Carry(
        workcell=workcell,
        x=np.array(x),
        timing=workcell.task.law.name,
        parameter=np.linspace(0.0, 1.0, len(time)),
        time=time,
        pose=outputs["pose"],
        rate=outputs["rate"],
        second_rate=outputs["second_rate"],
        angular_velocity=outputs["angular_velocity"],
        angular_acceleration=outputs["angular_acceleration"],
        normal_force=outputs["normal_force"],
        tangential_force=outputs["tangential_force"],
        contact_force=outputs["contact_force"].reshape(-1, 2, 3),
        pressure_shift=outputs["pressure_shift"],
        point_moment_residual=outputs["point_moment_residual"],
        moment_residual=outputs["moment_residual"],
        arms=(arms[0], arms[1]),
        judgement=judgement,
    )


def decision_of(carry: Carry | Array) -> Array:
    """Return the decision vector (n_var,) of a carry; return a given vector unchanged."""
    return carry.x if isinstance(carry, Carry) else carry


def _arm(
    workcell: Workcell,
    inverse_dynamics: NumericFunction,
    x: Array,
    outputs: Mapping[str, Array],
    arm: int,
) -> ArmMotion:
    q = np.ascontiguousarray(outputs[f"q_{arm}"])
    q_rate, q_second = _joint_rates(workcell, x, q, outputs)
    (own_torque,) = inverse_dynamics.batch(q, q_rate, q_second).values()
    return ArmMotion(q, q_rate, q_second, outputs[f"joint_torque_{arm}"], own_torque)


def _joint_rates(
    workcell: Workcell, x: Array, q: Array, outputs: Mapping[str, Array]
) -> tuple[Array, Array]:
    """Compute the first and second time derivative (n, n_joints) of one arm's joint positions.

    Under the time law 'constant' they are second-order finite differences over the time of the
    samples, one-sided at the ends, as the paper differentiates the box pose. Under 'ramped' they
    are finite differences over the path parameter u, multiplied with the time derivatives of u by
    the chain rule, so that the arm rests wherever the box rests.

    Args:
        workcell: the description of the cell.
        x: (n_var,) decision vector.
        q: (n, n_joints) joint positions [rad].
        outputs: output arrays of the compiled candidate function by name.
    """
    if workcell.task.law.has_differences:
        time = outputs["time"].reshape(-1)
        rate = np.gradient(q, time, axis=0, edge_order=2)
        return rate, np.gradient(rate, time, axis=0, edge_order=2)
    basis = sample_basis(workcell.task)
    waypoints = waypoints_of(workcell.task, x)
    tangent, curvature = basis.first @ waypoints, basis.second @ waypoints
    length = np.maximum((tangent**2).sum(axis=1), STANDSTILL)
    speed = ((outputs["rate"] * tangent).sum(axis=1) / length)[:, None]
    bend = outputs["second_rate"] - curvature * speed**2
    acceleration = ((bend * tangent).sum(axis=1) / length)[:, None]
    first = np.gradient(q, basis.parameter, axis=0, edge_order=2)
    second = np.gradient(first, basis.parameter, axis=0, edge_order=2)
    return first * speed, second * speed**2 + first * acceleration
