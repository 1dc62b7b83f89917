"""How far the straight motions of a job before and after a carry are possible with given holds.

Before the carry the pads approach the standing box and the arms lift it to the start; after it they
set it down below the goal and retreat. Holds with which these motions work are preferred, because a
carry alone is no job.
"""

from __future__ import annotations

import numpy as np

from hybrid_opt.extras.proposing.kinematics import LIMIT_MARGIN, ArmKinematics
from hybrid_opt.extras.proposing.trial import PoseJudge
from hybrid_opt.job.plan import standing_height
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.geometry.bodies import WORLD
from symbolic.geometry.separation import coal_distance
from symbolic.records import PAYLOAD_NAME, Workcell
from symbolic.records.poses import box_placement

HANDLING_STEP = 0.0125
"""Distance between neighbouring checked poses of a straight motion [m]."""


class HandlingMotions:
    """The straight motions of one cell around its carries."""

    def __init__(self, workcell: Workcell, judge: PoseJudge, ends: tuple[Array, Array]) -> None:
        """Find how far the box is lowered at both ends.

        Args:
            workcell: the cell.
            judge: checker of collisions.
            ends: start and goal pose (6,) of the box [m, rad].
        """
        handling = workcell.handling
        self._workcell, self._judge, self._ends = workcell, judge, ends
        self._T_world_box = box_placement(workcell.task.orientation, np.array(ends))
        stated = (handling.lift_height, handling.set_down_height)
        self._drops = [
            self._drop(T) if height is None else height
            for T, height in zip(self._T_world_box, stated, strict=True)
        ]

    def _drop(self, T_world_box: Array) -> float:
        """Compute how far a box falls until it stands [m]; 0 if nothing is below it."""
        geometry = self._judge.geometry
        box = geometry.bodies[geometry.index(PAYLOAD_NAME)].pieces
        standing = [body.pieces for body in geometry.bodies if body.frame == WORLD]

        def gap(drop: float) -> float:
            lowered = T_world_box.copy()
            lowered[2, 3] -= drop
            pieces = tuple(piece.moved(lowered) for piece in box)
            return max(min(coal_distance(pieces, other) for other in standing), 0.0)

        return standing_height(gap) if standing else 0.0

    def targets(self, kinematics: ArmKinematics, end: int, T_box_joint: Array) -> Array:
        """Compute the poses (m, n, 4, 4) of an arm's last joint on its way from the carry's end,
        down with the box, and back from it by the stand-off.

        Args:
            kinematics: the arm.
            end: 0 for the start, 1 for the goal.
            T_box_joint: (n, 4, 4) poses of the last joint in the box frame.
        """
        T_world_box, drop = self._T_world_box[end], self._drops[end]
        stand_off = self._workcell.handling.stand_off
        normal = T_world_box[:3, :3] @ contact_model(self._workcell).approach(kinematics.arm)
        down = np.linspace(0.0, drop, int(np.ceil(drop / HANDLING_STEP)) + 1)[:, None]
        back = np.linspace(0.0, stand_off, int(np.ceil(stand_off / HANDLING_STEP)) + 1)[1:, None]
        shifts = np.vstack([down * [0.0, 0.0, -1.0], [0.0, 0.0, -drop] - back * normal])
        found = np.tile(T_world_box @ T_box_joint, (len(shifts), 1, 1, 1))
        found[:, :, :3, 3] += shifts[:, None]
        return found

    def settled(self, kinematics: ArmKinematics, end: int, T_box_joint: Array, q: Array) -> Array:
        """Choose the redundant joints of n postures at an end of the carry such that the arm can
        follow the motions with the other joints alone, as a job does.

        Args:
            kinematics: the arm.
            end: 0 for the start, 1 for the goal.
            T_box_joint: (n, 4, 4) poses of the last joint in the box frame.
            q: (n, joints) postures [rad or m].

        Returns:
            (n, joints) postures; those that need no change or cannot be improved are unchanged.
        """
        found, targets = q.copy(), self.targets(kinematics, end, T_box_joint)
        rows = np.flatnonzero(self.followed(kinematics, q, targets)[0] < 1.0)
        held = q[rows][:, list(kinematics.redundant)] if kinematics.common else None
        away, _, _ = kinematics.follow(q[rows], targets[:, rows], held, resolved=True)
        share, back = self.followed(kinematics, away[-1], targets[::-1, rows])
        room = np.minimum(back - kinematics.lower, kinematics.upper - back)[-1].min(axis=1)
        better = (share == 1.0) & (room >= LIMIT_MARGIN)
        found[rows[better]] = back[-1, better]
        return found

    def shares(
        self, kinematics: ArmKinematics, T_box_joint: Array, ends: tuple[Array, Array]
    ) -> Array:
        """Compute how far an arm can follow the motions: the share of the poses that it reaches
        within its joint limits, at the worse of both ends. Motions to a pose at which the arm
        collides count half.

        Args:
            kinematics: the arm.
            T_box_joint: (n, 4, 4) poses of the last joint in the box frame.
            ends: postures (n, joints) at the start and at the goal [rad or m].

        Returns:
            (n,) shares; 1 if all motions are possible.
        """
        worst = np.ones(len(T_box_joint))
        for end, q in enumerate(ends):
            share, path = self.followed(kinematics, q, self.targets(kinematics, end, T_box_joint))
            whole = np.flatnonzero(share == 1.0)
            pose = np.tile(self._ends[end], (len(whole), 1))
            hit = self._judge.arm_colliding(kinematics.arm, pose, path[-1, whole], with_box=False)
            share[whole[hit]] = 0.5
            worst = np.minimum(worst, share)
        return worst

    @staticmethod
    def followed(kinematics: ArmKinematics, q: Array, targets: Array) -> tuple[Array, Array]:
        """Follow poses with an arm. Its redundant joints stand still.

        Args:
            kinematics: the arm.
            q: (n, joints) postures at the first pose [rad or m].
            targets: (m, n, 4, 4) poses of the last joint.

        Returns:
            Shares (n,) of the poses that are reached within joint limits; joint paths
            (m, n, joints) [rad or m].
        """
        path, kept, _ = kinematics.follow(q, targets)
        inside = ((path >= kinematics.lower) & (path <= kinematics.upper)).all(axis=2)
        until = np.where(inside.all(axis=0), len(targets), np.argmin(inside, axis=0))
        return np.minimum(kept, until) / len(targets), path
