"""A carry's mirror image, where both arms stand face to face: each takes the other's part.

In a cell that is symmetric about the plane between both bases, the image of a carry is as good
with its objectives exchanged: what is found at one end of the front is known at the other. Nothing
is taken for granted: the full evaluator judges every image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from symbolic.array import Array
from symbolic.records import Task, Workcell

SIGNS = {
    0: np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0]),
    1: np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0]),
}
"""By the plane's normal, x or y: what a pose's entries (6,) are multiplied by. The angle about the
normal stays, the other two change their signs."""

SAME = 1e-6
"""Differences below this are rounding [m, rad]."""


@dataclass(frozen=True)
class Mirror:
    """The reflection of one cell's decision vectors; see `mirror_of`.

    Attributes:
        task: the cell's.
        sign, shift: (n_var,) an image is sign * x + shift.
    """

    task: Task
    sign: Array
    shift: Array

    def image(self, x: Array) -> Array | None:
        """(n_var,) the image of a decision vector; None where it is out of the bounds."""
        low, high, image = self.task.lower, self.task.upper, self.sign * x + self.shift
        inside = (image >= low - SAME) & (image <= high + SAME)
        return np.clip(image, low, high) if inside.all() else None


def mirror_of(workcell: Workcell) -> Mirror | None:
    """The reflection about the plane between both bases, where it is upright along an axis of the
    world and leaves the ends of the path where they are; otherwise None."""
    task = workcell.task
    first, second = (robot.T_world_base[:3, 3] for robot in workcell.robots)
    across = np.flatnonzero(np.abs(first - second) > SAME).tolist()
    if len(across) != 1 or across[0] not in SIGNS or task.redundant:
        return None
    sign, shift = SIGNS[across[0]], (first + second) * np.eye(3)[across[0]]
    shift = np.append(shift, np.zeros(3))
    fixed = [waypoint.lower for waypoint in task.waypoints if waypoint.is_fixed]
    if any(np.abs(sign * pose + shift - pose).max() > SAME for pose in fixed):
        return None
    count = len(task.free_indices)
    return Mirror(task, np.tile(sign, count), np.tile(shift, count))
