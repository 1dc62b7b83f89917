"""One arm that follows the box, written plainly over numeric Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from studies.research.plain.motion import box_rotation
from symbolic.array import Array
from symbolic.read.arms import held_joints, moving_joints
from symbolic.read.urdf import read_urdf
from symbolic.records import Contact, Robot
from symbolic.records.poses import Orientation
from symbolic.robot.arm import (
    BEGIN_STEPS,
    CHEAP_STEPS,
    IK_NEWTON_STEPS,
    MAX_JOINT_STEP,
    REACH_TOLERANCE,
    THIRD_STEP_RESIDUAL,
    TRUSTED_RESIDUAL,
)


def held_model(robot: Robot) -> tuple[pin.Model, list[int], Array]:
    """Build Pinocchio's model of a robot's whole description, and find the joints that are held at
    a fixed position, because the workcell locks them or because they do not move the flange.

    Returns:
        The model; the indices of the held joints; and a configuration (nq,) with their positions,
        in which all other joints are neutral.
    """
    urdf = read_urdf(robot.urdf, robot.xacro_arguments, robot.package_dirs)
    moving = moving_joints(urdf, robot.chain_root, robot.flange, robot.locked_joints)
    model = pin.buildModelFromXML(urdf.kinematics)
    q, joints = pin.neutral(model), []
    for name, position in held_joints(urdf, moving, robot.locked_joints):
        joint = model.getJointId(name)
        q[model.joints[joint].idx_q] = position
        joints.append(joint)
    return model, joints, q


class PlainArm:
    """Numeric model of an arm that holds the box with its pad.

    Args:
        robot: description of the arm.
        contact: contact of the arm's pad with the box.
        redundant: indices of the joints that do not follow the box.
        orientation: convention of the last three numbers of poses.
    """

    def __init__(
        self,
        robot: Robot,
        contact: Contact,
        redundant: tuple[int, ...] = (),
        orientation: Orientation | None = None,
    ) -> None:
        self.robot = robot
        self.orientation = orientation or Orientation()
        self.contact = contact
        self.redundant = list(redundant)
        self.model = pin.buildReducedModel(*held_model(robot))
        self.following = [k for k in range(self.model.nq) if k not in redundant]
        self.flange = self.model.getFrameId(robot.flange, pin.FrameType.BODY)
        self.data = self.model.createData()
        self.T_root_world = pin.SE3(robot.T_world_base).inverse()
        self.T_flange_pad = pin.SE3(robot.T_flange_pad)

    def flange_target(self, pose: Array) -> pin.SE3:
        """Compute the flange placement in the root that puts the pad on its contact, for a box pose
        (6,)."""
        world_box = pin.SE3(box_rotation(self.orientation, pose[3:]), pose[:3])
        world_pad = world_box * pin.SE3(self.contact.T_box_pad)
        return self.T_root_world * world_pad * self.T_flange_pad.inverse()

    def place(self, q: Array) -> pin.SE3:
        """Compute the flange placement in the root frame at joint positions q (n,).

        The placements of all frames in `data` are up to date afterwards.
        """
        pin.forwardKinematics(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        return self.data.oMf[self.flange]

    def jacobian(self, q: Array) -> Array:
        """Compute the Jacobian (6, n) of the flange at joint positions q (n,), along the root's
        axes.

        The rows of the linear velocity come first.
        """
        J: Array = pin.computeFrameJacobian(
            self.model, self.data, q, self.flange, pin.LOCAL_WORLD_ALIGNED
        )
        return J

    def newton_step(self, q: Array, target: pin.SE3) -> Array:
        """Return the joint positions (n,) after one Newton step towards a flange pose.

        The step is shortened to `MAX_JOINT_STEP`. In a singular posture the joints stay at q.

        Args:
            q: (n,) joint positions [rad or m].
            target: pose of the flange to reach.
        """
        here = self.place(q)
        turn = Rotation.from_matrix(target.rotation @ here.rotation.T).as_rotvec()
        angle = float(np.linalg.norm(turn))
        error = np.concatenate(
            [target.translation - here.translation, turn * np.sinc(angle / np.pi)]
        )
        try:
            step = np.linalg.solve(self.jacobian(q)[:, self.following], error)
        except np.linalg.LinAlgError:
            return q
        if not np.abs(step).sum() < 1e9:
            return q
        moved = q.copy()
        moved[self.following] += step * (MAX_JOINT_STEP / max(np.abs(step).max(), MAX_JOINT_STEP))
        return moved

    def residual(self, q: Array, target: pin.SE3) -> float:
        """Return the distance of the flange at joints q (n,) from a pose `target`.

        This is the norm of the distance [m] and of twice the sine of half the angle.
        """
        here = self.place(q)
        angle = Rotation.from_matrix(target.rotation @ here.rotation.T).magnitude()
        distance = np.linalg.norm(target.translation - here.translation)
        return float(np.hypot(distance, 2.0 * np.sin(angle / 2.0)))

    def search(
        self, previous: Array, change: Array, curve: Array, target: pin.SE3, values: Array
    ) -> Array:
        """Return joint positions (n,) for the next target, by Newton's method.

        The search starts at an extrapolation of the previous joint positions.

        Args:
            previous: (n,) previous joint positions.
            change: (n,) last difference of the joint positions between samples.
            curve: (n,) last difference of that difference.
            target: placement of the flange.
            values: positions of the redundant joints.
        """
        q, before = previous + change + curve, 0.0
        q[self.redundant] = values
        for _ in range(CHEAP_STEPS):
            before = self.residual(q, target)
            q = self.newton_step(q, target)
        if before > THIRD_STEP_RESIDUAL:
            q = self.newton_step(q, target)
        if self.residual(q, target) <= TRUSTED_RESIDUAL:
            return q
        other = previous + change
        other[self.redundant] = values
        for _ in range(IK_NEWTON_STEPS):
            other = self.newton_step(other, target)
        return min(q, other, key=lambda found: self.residual(found, target))

    def begin(self, start: Array, pose: Array, values: Array) -> Array:
        """Return the posture (n,) at the first sample [rad or m].

        The redundant joints move evenly from the start posture to their values, while the others
        follow the box.

        Args:
            start: (n,) start posture [rad or m].
            pose: (6,) pose of the box at the first sample [m, rad].
            values: positions of the redundant joints at the first sample [rad or m].
        """
        q, change = start.copy(), np.zeros(len(start))
        change[self.redundant] = (values - start[self.redundant]) / BEGIN_STEPS
        for _ in range(BEGIN_STEPS if self.redundant else 0):
            q = self.newton_step(q + change, self.flange_target(pose))
        return q

    def follow(
        self, start: Array, poses: Array, wrenches: Array, values: Array | None = None
    ) -> dict[str, Array]:
        """Return all outputs of `symbolic.robot.arm.TRACK_OUTPUTS` along the samples.

        Args:
            start: (joints,) joint positions at the first pose [rad or m].
            poses: (n, 6) box poses [m, rad].
            wrenches: (n, 6) wrenches on the box about the nominal contact point, world axes [N, N
                m].
            values: (n, k) positions of the redundant joints [rad or m]; None without any.
        """
        values = np.zeros((len(poses), 0)) if values is None else values
        previous = self.begin(start, poses[0], values[0])
        change, curve = np.zeros(len(start)), np.zeros(len(start))
        predicted = previous.copy()
        predicted[self.redundant] = values[1]
        for _ in range(IK_NEWTON_STEPS):
            predicted = self.newton_step(predicted, self.flange_target(poses[1]))
        lost = 0.0
        samples: dict[str, list[object]] = {}
        for k, (pose, wrench) in enumerate(zip(poses, wrenches, strict=True)):
            target = self.flange_target(pose)
            q = self.search(previous, change, curve, target, values[k])
            jump = np.abs(q - previous).max()
            if not (self.residual(q, target) <= REACH_TOLERANCE and jump <= MAX_JOINT_STEP):
                lost = 1.0
            if lost:
                q = previous
            margins = [q - self.robot.position_lower, self.robot.position_upper - q]
            to_root = self.robot.T_world_base[:3, :3].T
            force, moment = to_root @ wrench[:3], to_root @ wrench[3:]
            contact = target * self.T_flange_pad
            lever = contact.translation - target.translation
            at_flange = np.concatenate([force, moment + np.cross(lever, force)])
            sample = {
                "q": q,
                "ik_residual": self.residual(q, target),
                "lost": lost,
                "limit_margin": np.min(margins),
                "manipulability": abs(np.linalg.det(self.jacobian(q)[:, self.following])),
                "joint_torque": self.jacobian(q).T @ at_flange,
            }
            for name, value in sample.items():
                samples.setdefault(name, []).append(value)
            # The second sample has no motion to extrapolate: the prediction takes its place.
            moved = q - previous if k > 0 else predicted - q
            previous, change, curve = q, moved, moved - change if k > 0 else curve
        return {name: np.array(values) for name, values in samples.items()}
