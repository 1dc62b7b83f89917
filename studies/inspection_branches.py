"""The postures of both arms at the start, as `studies.inspect` tells them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybrid_opt.cell import Cell
from symbolic.cell_model import CellModel, own_pairs
from symbolic.robot.branches import StartBranch, initial_poses


@dataclass(frozen=True)
class Branch:
    """A posture of one arm at the start and the least margins of the hand-made trajectory from
    there; see `symbolic.robot.branches.StartBranch`. The clearance is measured by FCL, 0 where
    bodies intersect and None where nothing can collide. Joints that slide are in mm, others in deg;
    `limit_margins` holds the least distance to a limit of either kind by its unit."""

    joints: tuple[float, ...]
    joint_units: tuple[str, ...]
    kept_samples: int
    clearance_mm: float | None
    limit_margins: dict[str, float]
    manipulability: float
    least_manipulability: float
    chosen: bool


def branches_of(cell: Cell, arm: int) -> tuple[Branch, ...]:
    """The postures of one arm (0 or 1) at the start, best first."""
    model = cell.compiled.model
    return tuple(_branch(cell, model, arm, branch) for branch in model.branches[arm])


def _branch(cell: Cell, model: CellModel, arm: int, branch: StartBranch) -> Branch:
    robot, units = cell.workcell.robots[arm], np.where(model.robots[arm].turning, "deg", "mm")
    factor = np.where(units == "deg", np.degrees(1.0), 1e3)
    path = branch.path[: max(branch.kept, 1)]
    room = np.minimum(path - robot.position_lower, robot.position_upper - path).min(axis=0) * factor
    return Branch(
        joints=tuple((branch.q * factor).round(2).tolist()),
        joint_units=tuple(units.tolist()),
        kept_samples=branch.kept,
        clearance_mm=_clearance_mm(cell, arm, branch),
        limit_margins={str(unit): float(room[units == unit].min()) for unit in np.unique(units)},
        manipulability=branch.manipulability,
        least_manipulability=cell.workcell.robots[arm].min_manipulability,
        chosen=bool(np.allclose(branch.q, model.start[arm])),
    )


def _clearance_mm(cell: Cell, arm: int, branch: StartBranch) -> float | None:
    """FCL's least distance of one arm from all but the other along the samples that it keeps."""
    checker, kept = cell.evaluator.checker, max(branch.kept, 1)
    own = own_pairs(cell.geometry, arm)
    if not own:
        return None
    pose = np.ascontiguousarray(initial_poses(cell.workcell)[:kept])
    path = np.ascontiguousarray(branch.path[:kept])
    absent = np.zeros((kept, cell.geometry.arms[1 - arm].joints))
    joints = (path, absent) if arm == 0 else (absent, path)
    bounds = np.full((kept, len(cell.geometry.active)), np.inf)
    bounds[:, own] = checker.bounds(pose, *joints)[:, own]
    return 1e3 * checker.min_distance(pose, joints[0], joints[1], bounds)[0]
