"""One arm as symbolic kinematics and dynamics, from its URDF through Pinocchio.

Frames: "root" is the URDF's root link, which stands at `Robot.T_world_base`; the "flange" is the
URDF frame that the tool is mounted on. Everything here is expressed in the root; gravity is
turned into it, so that a tilted or hanging arm gets its true torques.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path

import casadi
import numpy as np
import pinocchio

from symbolic import bridge
from symbolic.errors import RobotModelError
from symbolic.workcell import Array, Robot

DOF = 6
"""Joints of an arm; fewer cannot follow a box pose, more would leave it undetermined."""


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
        return int(self.model.getFrameId(self.flange))

    @cached_property
    def kinematics(self) -> casadi.Function:
        """q -> rotation (3, 3), position (3,) [m], jacobian (6, 6): `placement` and `jacobian`
        in one, sharing their common terms."""
        return bridge.frame_kinematics(self.model, self.flange_id)

    @cached_property
    def placement(self) -> casadi.Function:
        """q -> rotation (3, 3) and position (3,) [m] of the flange in the root."""
        q = casadi.SX.sym("q", DOF)
        rotation, position, _ = self.kinematics(q)
        return casadi.Function(
            "placement", [q], [rotation, position], ["q"], ["rotation", "position"]
        )

    @cached_property
    def jacobian(self) -> casadi.Function:
        """q -> jacobian (6, 6) of the flange: rows 0-2 the linear velocity of its origin, rows 3-5
        its angular velocity, both along the root's axes."""
        q = casadi.SX.sym("q", DOF)
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
        RobotModelError: the URDF cannot be read, a locked joint or the flange is not in it, or
            other than six joints of one degree of freedom each remain.
    """
    model = load_model(robot.urdf, robot.locked_joints)
    model.gravity.linear = gravity_in_root(robot.T_world_base)
    if model.nq != DOF or model.nv != DOF:
        joints = ", ".join(
            f"{name} ({joint.nq} coordinates)" for name, joint in zip(model.names, model.joints)
        )
        raise RobotModelError(
            f"{robot.urdf}: robot {robot.name!r} moves {model.nv} joints; {DOF} joints with limits "
            f"are needed (lock others with 'locked_joints'): {joints}"
        )
    frames = [frame.name for frame in model.frames]
    if frames.count(robot.flange) == 0:
        raise RobotModelError(
            f"{robot.urdf}: there is no frame {robot.flange!r} to serve as the flange"
            f"{_suggestion(robot.flange, frames)}"
        )
    return RobotModel(robot.name, model, robot.flange)


def load_model(
    urdf: Path, locked_joints: Iterable[tuple[str, float]] = ()
) -> pinocchio.Model:
    """Read a URDF as a numeric Pinocchio model on a fixed root; meshes are not needed.

    Args:
        urdf: the model file.
        locked_joints: name and position [rad or m] of each joint to be fixed and removed.

    Raises:
        RobotModelError: the file cannot be read, or a locked joint is not in it.
    """
    if not urdf.is_file():
        raise RobotModelError(f"{urdf}: there is no such URDF file")
    try:
        model = pinocchio.buildModelFromUrdf(str(urdf))
    except (ValueError, RuntimeError) as error:
        raise RobotModelError(f"{urdf}: Pinocchio cannot read it: {error}") from error
    positions = dict(locked_joints)
    if not positions:
        return model
    configuration = pinocchio.neutral(model)
    for name, position in positions.items():
        if name not in list(model.names)[1:]:
            raise RobotModelError(
                f"{urdf}: there is no joint {name!r} to lock{_suggestion(name, model.names)}"
            )
        joint = model.joints[model.getJointId(name)]
        configuration[joint.idx_q : joint.idx_q + joint.nq] = (
            position if joint.nq == 1 else (np.cos(position), np.sin(position))
        )
    locked = [model.getJointId(name) for name in positions]
    return pinocchio.buildReducedModel(model, locked, configuration)


def gravity_in_root(T_world_base: Array) -> Array:
    """(3,) acceleration of gravity [m/s^2] along the axes of a base at T_world_base (4, 4)."""
    gravity: Array = T_world_base[:3, :3].T @ pinocchio.Model.gravity981
    return gravity


def _suggestion(name: str, known: Iterable[str]) -> str:
    close = get_close_matches(name, list(known), n=3)
    return f"; did you mean {' or '.join(repr(match) for match in close)}?" if close else ""
