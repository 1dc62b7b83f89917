"""One arm as symbolic kinematics and dynamics, from its URDF through Pinocchio.

Frames: "root" is the URDF's root link, which is at `Robot.T_world_base`; the "flange" is the URDF
frame on which the tool is mounted. Everything is expressed in the root. Gravity is rotated into it,
so a tilted or hanging arm has correct torques.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import casadi
import pinocchio

from symbolic.array import Array
from symbolic.expression import Expression
from symbolic.read.arms import arm_model, link_frame, turning_joints
from symbolic.records import POSE_SIZE, Robot
from symbolic.records.poses import Orientation
from symbolic.robot import bridge


@dataclass(frozen=True, eq=False)
class RobotModel:
    """An arm's numeric model, and its CasADi functions, which are built on first use.

    The functions are `casadi.Function` objects over SX with dense outputs; call them on SX, MX or
    numbers. q (n,) are joint positions [rad, or m for a sliding joint], v (n,) and a (n,) their
    time derivatives.

    An arm follows the extended pose (6 + m,): the box pose, then the values of the cell's m
    redundant joints (`symbolic.records.RedundantJoint`). The extended pose sets the arm's redundant
    joints; the other six joints follow the box.

    Attributes:
        name: the robot's name in the workcell.
        model: Pinocchio's numeric model with the locked joints removed; not to be modified. Its
            gravity is expressed in the root.
        flange: name of the flange frame.
        redundant: for each redundant joint of the arm its index in q and its index in the extended
            pose.
        pose_size: number of entries of the extended pose, 6 + m.
        orientation: convention of entries 3 to 5 of the extended pose, the rotation of the box.
    """

    name: str
    model: pinocchio.Model
    flange: str
    redundant: tuple[tuple[int, int], ...] = ()
    pose_size: int = POSE_SIZE
    orientation: Orientation = field(default_factory=Orientation)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the n joints in the order of q."""
        return tuple(self.model.names)[1:]

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return int(self.model.nq)

    @cached_property
    def following(self) -> tuple[int, ...]:
        """Indices in q of the six joints that make the flange follow the box; the other joints are
        redundant."""
        set_apart = [joint for joint, _ in self.redundant]
        return tuple(k for k in range(self.n_joints) if k not in set_apart)

    @cached_property
    def turning(self) -> tuple[bool, ...]:
        """(n,) booleans in the order of q: True for a revolute joint, False for a prismatic
        joint."""
        return turning_joints(self.model)

    def with_redundant(self, q: Expression, extended: Expression) -> Expression:
        """Return the joints (n,) with the redundant ones replaced by their values in the extended
        pose.

        Args:
            q: (n,) joint positions [rad or m].
            extended: (6 + m,) extended pose.
        """
        columns = dict(self.redundant)
        if not columns:
            return q
        return casadi.vertcat(
            *[extended[columns[k]] if k in columns else q[k] for k in range(self.n_joints)]
        )

    @property
    def flange_id(self) -> int:
        """Index of the flange among the frames of `model`."""
        return link_frame(self.model, self.flange)

    @cached_property
    def kinematics(self) -> casadi.Function:
        """Function from q to rotation (3, 3), position (3,) [m] and jacobian (6, n) of the flange.

        The outputs are those of `placement` and `jacobian`, computed with their common terms once.
        """
        return bridge.frame_kinematics(self.model, self.flange_id)

    @cached_property
    def placement(self) -> casadi.Function:
        """Function from q to rotation (3, 3) and position (3,) [m] of the flange in the root."""
        q = casadi.SX.sym("q", self.n_joints)
        rotation, position, _ = self.kinematics(q)
        return casadi.Function(
            "placement", [q], [rotation, position], ["q"], ["rotation", "position"]
        )

    @cached_property
    def jacobian(self) -> casadi.Function:
        """Function from q to the Jacobian (6, n) of the flange.

        Rows 0-2 give the linear velocity of the flange's origin, rows 3-5 the angular velocity,
        both along the root's axes.
        """
        q = casadi.SX.sym("q", self.n_joints)
        return casadi.Function("jacobian", [q], [self.kinematics(q)[2]], ["q"], ["jacobian"])

    @cached_property
    def drift(self) -> casadi.Function:
        """Function from q and v (n,) to drift (6,), the flange's acceleration if all joint
        accelerations are zero.

        With joint accelerations a (n,), the flange's classical acceleration is jacobian @ a + drift
        [m/s^2, rad/s^2], with rows as in `jacobian`.
        """
        return bridge.frame_drift(self.model, self.flange_id)

    @cached_property
    def joint_placements(self) -> casadi.Function:
        """Function from q to rotations (3, 3 n) and positions (3, n) [m] of the joint frames in the
        root.

        Columns follow the order of q, three per joint for rotations and one for positions.
        """
        return bridge.joint_placements(self.model)

    @cached_property
    def inverse_dynamics(self) -> casadi.Function:
        """Function from q, v, a to the joint torques (n,) that move the arm without the box,
        gravity included [N m or N].
        """
        return bridge.inverse_dynamics(self.model)


def build_robot_model(
    robot: Robot,
    redundant: tuple[tuple[int, int], ...] = (),
    pose_size: int = POSE_SIZE,
    orientation: Orientation | None = None,
) -> RobotModel:
    """Read a robot's URDF and prepare its functions.

    Args:
        robot: the arm.
        redundant: for each redundant joint of the arm, its index in q and its index in the extended
            pose.
        pose_size: number of entries of the extended pose.
        orientation: convention of entries 3 to 5 of the extended pose; None for the default.

    Raises:
        RobotModelError: the URDF cannot be read, or does not describe a serial arm that ends in the
            flange.
    """
    model = arm_model(robot)
    model.gravity.linear = gravity_in_root(robot.T_world_base)
    turned = orientation or Orientation()
    return RobotModel(robot.name, model, robot.flange, redundant, pose_size, turned)


def gravity_in_root(T_world_base: Array) -> Array:
    """Compute the acceleration of gravity (3,) along the axes of an arm's root [m/s^2].

    Args:
        T_world_base: (4, 4) pose of the root in the world.
    """
    gravity: Array = T_world_base[:3, :3].T @ pinocchio.Model.gravity981
    return gravity + 0.0  # no negative zeros: upright arms are alike
