"""Joint torques of an arm that holds the box at rest, for the search for a first carry."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from hybrid_opt.static_hold import static_hold
from symbolic.array import Array
from symbolic.read.arms import arm_model
from symbolic.records import POSE_SIZE, Workcell
from symbolic.records.poses import box_placement
from symbolic.records.quantities import GRAVITY
from symbolic.robot.model import gravity_in_root

MOST_TORQUE = 0.9
"""Largest share of a joint's torque limit that holding the box at rest may take; the rest is left
for the motion."""

COMPARED = 300
"""Number of random postures by which an arm is known to be strong."""

NEAR = 0.8
"""If they take less than this share of `MOST_TORQUE`, the torques of the arm are not limited."""


class StaticLoad:
    """Torques of one arm by its own weight, half the weight of the box, and the squeeze at rest.

    They are an estimate for the search: the evaluator computes how the arms share the load.

    Attributes:
        checked: False for a strong arm, for which every share counts as zero.
    """

    def __init__(self, workcell: Workcell, arm: int) -> None:
        """Prepare the torques of an arm.

        Args:
            workcell: the cell.
            arm: index of the arm.
        """
        robot, contact = workcell.robots[arm], workcell.contacts[arm]
        self._model, self._limit = arm_model(robot).copy(), robot.torque_max
        self._model.gravity.linear = gravity_in_root(robot.T_world_base)
        self._data, self._still = self._model.createData(), np.zeros(self._model.nv)
        self._forces = pin.StdVec_Force()
        self._forces.extend([pin.Force.Zero()] * self._model.njoints)
        self._orientation, self._T_box_pad = workcell.task.orientation, contact.T_box_pad
        self._squeeze = float(static_hold(workcell).normal_force[arm])
        self._weight = workcell.payload.mass * np.asarray(GRAVITY) / 2.0
        low, high = (
            np.maximum(robot.position_lower, -np.pi),
            np.minimum(robot.position_upper, np.pi),
        )
        q = np.random.default_rng(0).uniform(low, high, (COMPARED, len(low)))
        pose = np.tile(workcell.task.waypoints[0].lower, (COMPARED, 1))
        self.checked = bool(self._shares(pose, q, np.eye(4)).max() > NEAR * MOST_TORQUE)

    def share(self, pose: Array, q: Array, T_box_joint: Array) -> Array:
        """Compute for each of n postures the largest ratio (n,) of a joint torque to its limit
        while the arm holds the box at rest; 0 for a strong arm, see `checked`.

        Args:
            pose: (n, 6) poses of the box [m, rad].
            q: (n, joints) postures that hold it [rad or m].
            T_box_joint: (4, 4) or (n, 4, 4) pose of the last joint in the box frame.
        """
        return self._shares(pose, q, T_box_joint) if self.checked else np.zeros(len(q))

    def _shares(self, pose: Array, q: Array, T_box_joint: Array) -> Array:
        R_world_box = box_placement(self._orientation, pose[:, :POSE_SIZE])[:, :3, :3]
        T_joint_box = np.broadcast_to(np.linalg.inv(T_box_joint), (len(q), 4, 4))
        down = np.einsum("nji,j->ni", R_world_box, self._weight)
        force = np.einsum(
            "nij,nj->ni", T_joint_box[:, :3, :3], down - self._squeeze * self._T_box_pad[:3, 2]
        )
        arm = T_joint_box[:, :3, :3] @ self._T_box_pad[:3, 3] + T_joint_box[:, :3, 3]
        moment = np.cross(arm, force)
        found = np.zeros(len(q))
        for k, posture in enumerate(q):
            self._forces[-1] = pin.Force(force[k], moment[k])
            torque = pin.rnea(
                self._model, self._data, posture, self._still, self._still, self._forces
            )
            found[k] = np.abs(torque / self._limit).max()
        return found
