"""Both arms of one machine in one place of the joints that move both, a lift or a torso."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybrid_opt.proposing.holding import LIMIT_MARGIN, MANIPULABILITY_MARGIN, Hold
from hybrid_opt.proposing.kinematics import REACHED, ArmKinematics, box_to_last_joint, spun
from symbolic.array import Array
from symbolic.records import Workcell
from symbolic.records.poses import box_placement

SHARES = np.array([0.5, 0.25, 0.75, 0.0, 1.0])
"""Of the way from the first arm's value to the second's: what is tried, in this order."""

STEPS = 15
"""Newton steps from each arm's own posture."""


class Agreement:
    """Moves the joints that move both arms to values that suit both."""

    def __init__(self, workcell: Workcell, ends: tuple[Array, Array]) -> None:
        """Prepare both arms.

        Args:
            workcell: with its redundant joints chosen.
            ends: start and goal poses of the box (6,).
        """
        task = workcell.task
        self._workcell = workcell
        self._common = np.array(
            [joint.drives for joint in task.redundant if min(joint.drives) >= 0], dtype=np.intp
        ).reshape(-1, 2)
        self._T_world_box = [box_placement(task.orientation, end) for end in ends]
        self._arms = [
            ArmKinematics.of(workcell, arm, tuple(joint for joint, _ in task.redundant_of(arm)))
            for arm in (0, 1)
        ]

    def of(self, holds: tuple[Hold, Hold]) -> tuple[Hold, Hold] | None:
        """Both arms' ways to hold with the same values of the joints that move both, None where
        no tried values suit both."""
        if not len(self._common):
            return holds
        ends = [
            self._agreed(end, (q_1, q_2), (holds[0].spin, holds[1].spin))
            for end, (q_1, q_2) in enumerate(
                ((holds[0].q_start, holds[1].q_start), (holds[0].q_goal, holds[1].q_goal))
            )
        ]
        if ends[0] is None or ends[1] is None:
            return None
        first, second = (
            replace(hold, q_start=ends[0][arm], q_goal=ends[1][arm])
            for arm, hold in enumerate(holds)
        )
        return first, second

    def _agreed(
        self, end: int, q: tuple[Array, Array], spins: tuple[float, float]
    ) -> tuple[Array, Array] | None:
        """Both arms' postures at the start (0) or the goal (1)."""
        own = [q[arm][self._common[:, arm]] for arm in (0, 1)]
        values = own[0] + SHARES[:, None] * (own[1] - own[0])
        moved, fine = [], np.ones(len(SHARES), dtype=bool)
        for arm, kinematics in enumerate(self._arms):
            contact = spun(self._workcell.contacts[arm], spins[arm])
            T = box_to_last_joint(self._workcell, kinematics.geometry, contact, arm)
            begin = np.tile(q[arm], (len(SHARES), 1))
            begin[:, self._common[:, arm]] = values
            target = np.tile(self._T_world_box[end] @ T, (len(SHARES), 1, 1))
            found = kinematics.solve(begin, target, STEPS)
            least = self._workcell.robots[arm].min_manipulability * MANIPULABILITY_MARGIN
            inside = (found.q >= kinematics.lower + LIMIT_MARGIN) & (
                found.q <= kinematics.upper - LIMIT_MARGIN
            )
            fine &= (found.residual <= REACHED) & (found.manipulability >= least)
            fine &= inside.all(axis=1)
            moved.append(found.q)
        if not fine.any():
            return None
        at = int(np.argmax(fine))
        return moved[0][at], moved[1][at]
