"""A workcell together with its robots' models and the postures it starts from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.errors import WorkcellError
from symbolic.geometry.clearance import screening_functions
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.records import Workcell
from symbolic.robot.branches import StartBranch, start_branches
from symbolic.robot.model import RobotModel, build_robot_model


@dataclass(frozen=True)
class CellBodies:
    """A cell's arms and bodies, which do not depend on the postures that arms start in.

    Attributes:
        workcell: the description.
        robots: the models of the two arms.
        geometry: the collision bodies and the pairs to be checked.
    """

    workcell: Workcell
    robots: tuple[RobotModel, RobotModel]
    geometry: CellGeometry

    @cached_property
    def screening(self) -> dict[str, ca.Function]:
        """The functions of `symbolic.geometry.clearance.screening_functions`."""
        placements = (self.robots[0].joint_placements, self.robots[1].joint_placements)
        return screening_functions(self.geometry, placements)


@dataclass(frozen=True)
class CellModel(CellBodies):
    """Everything that the symbolic model of a cell is built from.

    Attributes:
        branches: per arm every branch at the start, best first.
        start: (n,) joint positions of each arm at the first waypoint [rad].
    """

    branches: tuple[tuple[StartBranch, ...], tuple[StartBranch, ...]]
    start: tuple[Array, Array]


def build_cell_bodies(workcell: Workcell) -> CellBodies:
    """Read the robots and the bodies, which takes a fifth of what the whole model takes.

    Raises:
        RobotModelError: a URDF does not give an arm.
        CollisionModelError: a collision shape is unusable.
    """
    task = workcell.task
    first, second = (
        build_robot_model(robot, task.redundant_of(i), task.extended_size, task.orientation)
        for i, robot in enumerate(workcell.robots)
    )
    return CellBodies(workcell, (first, second), build_geometry(workcell))


def build_cell_model(workcell: Workcell, bodies: CellBodies | None = None) -> CellModel:
    """Read the robots, list all start branches and choose one per arm.

    The workcell's `start_branch` picks from the ranked branches; -1 stands for the best.

    Args:
        bodies: of the same cell, if they are known; its path may be another one.

    Raises:
        RobotModelError: a URDF does not give an arm.
        CollisionModelError: a collision shape is unusable.
        WorkcellError: an arm cannot reach the start, or a chosen branch does not exist.
    """
    bodies = bodies or build_cell_bodies(workcell)
    robots, geometry = bodies.robots, bodies.geometry
    clearance = bodies.screening["clearance"]
    branches = (
        start_branches(workcell, 0, robots[0], _own_clearance(geometry, clearance, 0)),
        start_branches(workcell, 1, robots[1], _own_clearance(geometry, clearance, 1)),
    )
    problems = []
    for i, found in enumerate(branches):
        name, wanted = workcell.robots[i].name, workcell.start_branch[i]
        if not found:
            problems.append(
                f"task.start: robot {name!r} has no posture within its joint limits that holds "
                "its contact there; move the start, the contact or the robot's base"
            )
        elif wanted >= len(found):
            problems.append(
                f"robots[{i}].start_branch: {wanted}; robot {name!r} has branches 0 to "
                f"{len(found) - 1} at the start"
            )
    if problems:
        raise WorkcellError(str(workcell.source), tuple(problems))
    start = [
        np.array(found[max(workcell.start_branch[i], 0)].q) for i, found in enumerate(branches)
    ]
    model = CellModel(workcell, robots, geometry, branches, (start[0], start[1]))
    vars(model)["screening"] = bodies.screening  # of the same bodies: not made again
    return model


def own_pairs(geometry: CellGeometry, arm: int) -> list[int]:
    """Active pairs of one arm's bodies with anything but the other arm."""
    own, other = (f"{geometry.workcell.robots[i].name}/" for i in (arm, 1 - arm))
    return [
        k
        for k, names in enumerate(geometry.pair_names)
        if any(name.startswith(own) for name in names)
        and not any(name.startswith(other) for name in names)
    ]


def _own_clearance(
    geometry: CellGeometry, clearance: ca.Function, arm: int
) -> Callable[[Array, Array], float]:
    """Least clearance bound [m] of one arm over samples, the other arm left out.

    The returned function takes box poses (n, 6) and the arm's joint positions (n, joints).
    """
    rows = own_pairs(geometry, arm)

    def least(poses: Array, path: Array) -> float:
        if not rows:
            return float("inf")
        absent = np.zeros((len(path), geometry.arms[1 - arm].joints))
        joints = (path, absent) if arm == 0 else (absent, path)
        bounds = np.array(clearance.map(len(poses))(poses.T, joints[0].T, joints[1].T))
        return float(bounds[rows].min())

    return least
