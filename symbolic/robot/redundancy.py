"""Which joints of an arm of more than six are redundant, and where they may stand to begin with.

Both are read off one posture path along the hand-made trajectory: of all joints together, by Newton
steps of least norm that drift to the middle of the joints' ranges where the box leaves them free
(Liegeois, IEEE T-SMC 7(12), 1977).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pinocchio as pin

from symbolic.array import Array
from symbolic.physics.path import path_basis
from symbolic.physics.pose import box_placement, inverse
from symbolic.robot.arm import box_flange
from symbolic.robot.urdf import FOLLOWING, arm_model, link_frame
from symbolic.workcell.records import POSE_SIZE, Contact, Robot, Task

SEEDS = 24
"""Random postures from which the start posture is looked for."""

STEPS = 80
"""Newton steps to the start posture, and at most to each pose after it."""

BETWEEN = 4
"""Poses per piece of the path."""

CLOSE = 1e-4
"""Pose error of a reached posture [m, rad]; the values are only a proposal."""

CENTRING = 0.05
"""Share of the way to the middle of their ranges that joints go in a step where they are free."""


@dataclass(frozen=True)
class PosturePath:
    """An arm along the hand-made trajectory.

    Attributes:
        q: (n, joints) at poses evenly spaced along the path parameter, ends included [rad or m].
        jacobian: (n, 6, joints) of the flange there.
    """

    q: Array
    jacobian: Array

    def at_waypoints(self, joint: int) -> Array:
        """(n_waypoints,) positions of a joint, to a thousandth."""
        return np.asarray(np.round(self.q[::BETWEEN, joint], 3))


class _Chain:
    """Numeric kinematics of an arm, some joints held."""

    def __init__(
        self, robot: Robot, contact: Contact, task: Task, held: Mapping[int, float]
    ) -> None:
        self.robot, self.orientation, self.held = robot, task.orientation, dict(held)
        self.model = arm_model(robot)
        self.data = self.model.createData()
        self.flange = link_frame(self.model, robot.flange)
        self.to_root = inverse(robot.T_world_base)
        self.T_box_flange = box_flange(robot, contact)
        self.free = [k for k in range(self.model.nq) if k not in self.held]
        reach = np.clip([robot.position_lower, robot.position_upper], -np.pi, np.pi)
        self.low, self.high = np.minimum(reach[0], reach[1]), np.maximum(reach[0], reach[1])
        self.middle = (self.low + self.high) / 2.0

    def jacobian(self, q: Array) -> Array:
        """(6, joints), axes of the root."""
        J: Array = pin.computeFrameJacobian(
            self.model, self.data, q, self.flange, pin.LOCAL_WORLD_ALIGNED
        )
        return J

    def error(self, q: Array, pose: Array) -> Array:
        """(6,) what is missing to a box pose."""
        T = self.to_root @ box_placement(self.orientation, pose) @ self.T_box_flange
        pin.framesForwardKinematics(self.model, self.data, q)
        here = self.data.oMf[self.flange]
        turn = pin.log3(T[:3, :3] @ here.rotation.T)
        return np.concatenate([T[:3, 3] - here.translation, turn])

    def reach(self, q: Array, pose: Array) -> Array | None:
        """A posture near q that holds the box within the joint limits; None if none is found."""
        for _ in range(STEPS):
            error = self.error(q, pose)
            if np.linalg.norm(error) < CLOSE and self.within(q):
                return q
            J = self.jacobian(q)[:, self.free]
            inverted = J.T @ np.linalg.inv(J @ J.T + 1e-8 * np.eye(6))
            centring = CENTRING * (self.middle - q)[self.free]
            step = inverted @ error + centring - inverted @ (J @ centring)
            q = q.copy()
            q[self.free] += step * min(1.0, 0.4 / max(float(np.abs(step).max()), 1e-12))
        return None

    def within(self, q: Array) -> bool:
        """Whether no joint is beyond its limits."""
        return bool(np.all((q >= self.robot.position_lower) & (q <= self.robot.position_upper)))

    def starts(self) -> Array:
        """The middle posture and random ones."""
        rng = np.random.default_rng(0)
        q = np.vstack([self.middle, rng.uniform(self.low, self.high, (SEEDS, len(self.low)))])
        for joint, value in self.held.items():
            q[:, joint] = value
        return q


def posture_path(
    robot: Robot, contact: Contact, task: Task, held: Mapping[int, float]
) -> PosturePath | None:
    """A path of all joints of an arm along the hand-made trajectory, away from joint limits.

    Args:
        robot, contact: the arm and what it holds the box by.
        task: with or without its redundant joints.
        held: joints that stand still, by their indices [rad or m].

    Returns:
        None where none is found.
    """
    chain = _Chain(robot, contact, task, held)
    points = np.array([waypoint.lower for waypoint in task.waypoints])
    points[list(task.free_indices)] = task.initial
    points[:, 3:] = task.orientation.unwrapped(points[:, 3:])
    u = np.linspace(0.0, 1.0, BETWEEN * (len(points) - 1) + 1)
    poses = path_basis(len(points), u).position @ points[:, :POSE_SIZE]
    best, most = None, -np.inf
    for start in chain.starts():
        q = chain.reach(start, poses[0])
        path = []
        for pose in poses:
            q = None if q is None else chain.reach(q, pose)
            if q is None:
                break
            path.append(q)
        if q is None:
            continue
        jacobian = np.array([chain.jacobian(each) for each in path])
        room = np.minimum(np.array(path) - robot.position_lower, robot.position_upper - path)
        least = np.linalg.svd(jacobian[:, :, chain.free], compute_uv=False)[:, -1].min()
        score = float(least * room[:, chain.free].min())
        if score > most:
            best, most = PosturePath(np.array(path), jacobian), score
    return best


def best_conditioned(
    path: PosturePath | None, n_joints: int, forced: Sequence[int]
) -> tuple[int, ...]:
    """The redundant joints of an arm: those without which the other six are conditioned best.

    Args:
        path: the arm along the hand-made trajectory; None: the joints next to the root.
        n_joints: of the arm.
        forced: indices of joints that are redundant in any case.

    Returns:
        Indices, ascending, n_joints - 6 of them.
    """
    others = [joint for joint in range(n_joints) if joint not in forced]
    chosen = [
        tuple(sorted((*forced, *more)))
        for more in combinations(others, n_joints - FOLLOWING - len(forced))
    ]
    if path is None:
        return chosen[0]

    def condition(joints: tuple[int, ...]) -> float:
        rest = [joint for joint in range(n_joints) if joint not in joints]
        singular = np.linalg.svd(path.jacobian[:, :, rest], compute_uv=False)
        return float(singular[:, -1].min())

    return max(chosen, key=condition)
