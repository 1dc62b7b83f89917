"""Robust forces as rows of the joint program of path and timing.

At every point the cases that ask for most have a row each, with exact values and slopes: where two
cases rule in turn one row alone would let a step through that the other forbids. Their curvature is
that of the planned force's branch which rules there, so that the model is exact to first order.
"""

from __future__ import annotations

import numpy as np

from hybrid_opt.robust.path_force import PathPoints, robust_path
from symbolic.array import Array
from symbolic.contact.paper import normal_force_branches
from symbolic.records import Workcell
from symbolic.smooth.driven import driven_layout

CASES = 3
"""Cases per robot and point."""

ROBUST_ROWS = 2 * CASES


class RobustForces:
    """Robust forces at driven points of one workcell, robot by robot."""

    def __init__(self, workcell: Workcell, pose: int) -> None:
        """pose: entries of the extended pose."""
        self._forces, self._pose = robust_path(workcell), pose
        self._branches = planned_branches(workcell)

    def at(self, path: tuple[Array, ...], a: Array, w: Array) -> tuple[Array, Array]:
        """(points, ROBUST_ROWS) [N], and their slopes (points, ROBUST_ROWS, 3 pose + 2) by the
        extended pose and its derivatives, u'' and u'^2.

        Args:
            path: extended poses and their derivatives by u (points, pose).
        """
        pose, first, second = (np.ascontiguousarray(part[:, :6]) for part in path)
        force, slope = self._forces.most_demanding(PathPoints(pose, first, second, a, w), CASES)
        n = len(a)
        found = np.zeros((n, ROBUST_ROWS, 3 * self._pose + 2))
        by = slope.reshape(n, ROBUST_ROWS, -1)
        for k in range(3):
            found[:, :, k * self._pose : k * self._pose + 6] = by[:, :, 6 * k : 6 * k + 6]
        found[:, :, -2:] = by[:, :, -2:]
        return force.reshape(n, ROBUST_ROWS), found

    def as_planned(self, weight: Array, value: Array) -> Array:
        """Weights (points, quantities) that bend the planned forces as those of robust ones, given
        behind them, are taken to bend.

        Args:
            weight, value: (points, quantities and robust forces).
        """
        size = weight.shape[1] - ROBUST_ROWS
        found = weight[:, :size].copy()
        shares = weight[:, size:].reshape(-1, 2, CASES).sum(axis=2)
        for arm, branches in enumerate(self._branches):
            ruling = branches[np.argmax(value[:, :size] @ branches.T, axis=1)]
            found += shares[:, arm, None] * ruling
        return found


def planned_branches(workcell: Workcell) -> Array:
    """(2, branches, quantities) both planned normal forces' branches as sums of a point's
    quantities: the paper's five, or soft fingers' one."""
    layout = driven_layout(workcell)
    if workcell.task.allocation == "soft-finger":
        return np.eye(layout.size)[layout.block("force")][:, None]
    forces = np.zeros((2, 5, layout.size))
    friction = (workcell.contacts[0].friction, workcell.contacts[1].friction)
    for column, split in ((0, (1.0, 0.0)), (1, (0.0, 1.0))):
        branches = np.array(normal_force_branches(*split, friction)).reshape(-1)
        forces[:, :, layout.block("force").start + column] = branches
    forces[0, :, layout.block("force").start] += 1.0  # N_1 = N_2 + F_n
    return forces
