"""One arm as symbolic kinematics and dynamics, from its URDF through Pinocchio.

Frames: "root" is the URDF's root link, which stands at `Robot.T_world_base`; the "flange" is the
URDF frame that the tool is mounted on. Everything here is expressed in the root; gravity is
turned into it, so that a tilted or hanging arm gets its true torques.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi
import pinocchio

from symbolic.array import Array
from symbolic.robot import bridge
from symbolic.robot.urdf import N_JOINTS, arm_model, link_frame
from symbolic.workcell.records import Robot


@dataclass(frozen=True, eq=False)
class RobotModel:
    """An arm's numeric model and, built on first use, its CasADi functions.

    The functions are `casadi.Function` objects over SX with dense outputs; call them on SX, MX or
    numbers. q (6,) [rad], v (6,) [rad/s], a (6,) [rad/s^2].

    Attributes:
        name: the robot's name in the workcell.
        model: Pinocchio's numeric model with the locked joints removed; not to be modified. Its
            gravity is expressed in the root.
        flange: name of the flange frame.
    """

    name: str
    model: pinocchio.Model
    flange: str

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The six joints in the order of q."""
        return tuple(self.model.names)[1:]

    @property
    def flange_id(self) -> int:
        """Index of the flange among the frames of `model`."""
        return link_frame(self.model, self.flange)

    @cached_property
    def kinematics(self) -> casadi.Function:
        """q -> rotation (3, 3), position (3,) [m], jacobian (6, 6): `placement` and `jacobian`
        in one, sharing their common terms."""
        return bridge.frame_kinematics(self.model, self.flange_id)

    @cached_property
    def placement(self) -> casadi.Function:
        """q -> rotation (3, 3) and position (3,) [m] of the flange in the root."""
        q = casadi.SX.sym("q", N_JOINTS)
        rotation, position, _ = self.kinematics(q)
        return casadi.Function(
            "placement", [q], [rotation, position], ["q"], ["rotation", "position"]
        )

    @cached_property
    def jacobian(self) -> casadi.Function:
        """q -> jacobian (6, 6) of the flange: rows 0-2 the linear velocity of its origin, rows 3-5
        its angular velocity, both along the root's axes."""
        q = casadi.SX.sym("q", N_JOINTS)
        return casadi.Function("jacobian", [q], [self.kinematics(q)[2]], ["q"], ["jacobian"])

    @cached_property
    def drift(self) -> casadi.Function:
        """q, v -> drift (6,): the flange's acceleration at a = 0, rows as in `jacobian`, so that
        its classical acceleration is jacobian @ a + drift [m/s^2, rad/s^2]."""
        return bridge.frame_drift(self.model, self.flange_id)

    @cached_property
    def joint_placements(self) -> casadi.Function:
        """q -> rotations (3, 18) and positions (3, 6) [m] of the six joint frames in the root,
        side by side in the order of q."""
        return bridge.joint_placements(self.model)

    @cached_property
    def inverse_dynamics(self) -> casadi.Function:
        """q, v, a -> torque (6,) [N m] that moves the bare arm, gravity included."""
        return bridge.inverse_dynamics(self.model)


def build_robot_model(robot: Robot) -> RobotModel:
    """Read a robot's URDF and prepare its functions.

    Raises:
        RobotModelError: the URDF cannot be read, or does not describe a serial arm of six revolute
            joints that ends in the flange.
    """
    model = arm_model(robot)
    model.gravity.linear = gravity_in_root(robot.T_world_base)
    return RobotModel(robot.name, model, robot.flange)


def gravity_in_root(T_world_base: Array) -> Array:
    """(3,) acceleration of gravity [m/s^2] along the axes of a base at T_world_base (4, 4)."""
    gravity: Array = T_world_base[:3, :3].T @ pinocchio.Model.gravity981
    return gravity
