"""A workcell with its robots' models and start postures."""

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
from symbolic.geometry.screen import Screen, screen_of
from symbolic.records import Workcell
from symbolic.records.numbered import ParameterGroup
from symbolic.robot.branches import (
    ArmSearch,
    Clearance,
    StartBranch,
    interpreted_search,
    start_branches,
)
from symbolic.robot.model import RobotModel, build_robot_model


@dataclass(frozen=True, eq=False)
class CellBodies:
    """Arms and collision bodies of a cell, without start postures.

    Attributes:
        workcell: description of the cell.
        robots: models of the two arms.
        geometry: collision bodies, and the pairs of bodies whose distances are checked.
    """

    workcell: Workcell
    robots: tuple[RobotModel, RobotModel]
    geometry: CellGeometry

    @cached_property
    def screen(self) -> Screen:
        """Numbers of the cell's bodies in the formulas for lower bounds of their distances."""
        return screen_of(self.geometry)

    @cached_property
    def screening(self) -> dict[str, ca.Function]:
        """CasADi functions that compute lower bounds of the bodies' distances, by name;
        `symbolic.geometry.clearance.screening_functions` lists them.
        """
        placements = (self.robots[0].joint_placements, self.robots[1].joint_placements)
        return screening_functions(self.geometry, placements, screen=self.screen)


@dataclass(frozen=True, eq=False)
class CellModel(CellBodies):
    """Workcell with its arms, bodies and start postures, from which all functions of the cell are
    built.

    Attributes:
        branches: for each arm all inverse-kinematics branches at the start, the best first.
        start: for each arm the joint positions (n,) at the first waypoint [rad, or m for a sliding
            joint].
        given: the start postures as a parameter group if they are symbols, else None.
    """

    branches: tuple[tuple[StartBranch, ...], tuple[StartBranch, ...]]
    start: tuple[Array, Array]
    given: ParameterGroup | None = None


def build_cell_bodies(workcell: Workcell, known: CellBodies | None = None) -> CellBodies:
    """Read the models of both robots and all bodies of a workcell, without start postures. It takes
    a fifth of the time of `build_cell_model`.

    Args:
        workcell: description of the cell.
        known: arms and bodies of another cell that differs only in the path or in how the pads hold
            the box; None without one. Its distance functions are reused if both cells check the
            same pairs of bodies.

    Raises:
        RobotModelError: a URDF does not describe a usable arm.
        CollisionModelError: a collision shape is unusable.
    """
    task = workcell.task
    first, second = (
        build_robot_model(robot, task.redundant_entries[i], task.extended_size, task.orientation)
        for i, robot in enumerate(workcell.robots)
    )
    found = CellBodies(workcell, (first, second), build_geometry(workcell))
    if known is not None and _compared(found) == _compared(known):
        vars(found)["screening"] = known.screening
    return found


def _compared(bodies: CellBodies) -> tuple[object, ...]:
    """Return the pairs of bodies whose distances the functions of a cell compute. Cells with equal
    results can share these functions.

    Returns:
        Indices of the possible pairs of bodies, near pairs first; and the number of near pairs.
    """
    return bodies.geometry.possible, bodies.geometry.near


Searches = tuple[ArmSearch, ArmSearch]


def build_cell_model(
    workcell: Workcell, bodies: CellBodies | None = None, searches: Searches | None = None
) -> CellModel:
    """Build the model of a cell: read both robots and all bodies, list the start branches of each
    arm, and choose one branch per arm.

    `start_branch` in the workcell selects a branch by its index in the ranking; -1 selects the
    best.

    Args:
        workcell: description of the cell.
        bodies: arms and bodies of a cell that differs only in the path; None to read them.
        searches: compiled functions that search for the start branches of both arms; None for
            interpreted ones.

    Raises:
        RobotModelError: a URDF does not describe a usable arm.
        CollisionModelError: a collision shape is unusable.
        WorkcellError: an arm cannot reach the start, or the selected branch does not exist.
    """
    bodies = bodies or build_cell_bodies(workcell)
    robots, geometry = bodies.robots, bodies.geometry
    searches = searches or _interpreted(workcell, bodies)
    branches = (
        start_branches(workcell, 0, robots[0], searches[0]),
        start_branches(workcell, 1, robots[1], searches[1]),
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
    # The bodies are the same: their functions are not made again.
    vars(model).update({k: v for k, v in vars(bodies).items() if k in ("screen", "screening")})
    return model


def own_pairs(geometry: CellGeometry, arm: int) -> list[int]:
    """Return the indices of the active pairs that contain a body of one arm and no body of the
    other arm. Parts of the machine that no joint moves belong to neither arm.

    Args:
        geometry: the collision bodies and pairs.
        arm: index of the arm.
    """
    own, other = (f"robot {i + 1}" for i in (arm, 1 - arm))
    groups = [
        {geometry.bodies[body].group for body in (pair.first, pair.second)}
        for pair in geometry.active
    ]
    return [k for k, both in enumerate(groups) if own in both and other not in both]


def own_clearance(geometry: CellGeometry, arm: int, bounds: Bounds) -> Clearance:
    """Return a function that computes a lower bound of the distance between one arm and all bodies
    except those of the other arm.

    The function takes box poses (n, 6) and the arm's joint positions (n, joints) at n samples. It
    returns the smallest bound over all samples [m]; infinity if no pairs are checked.

    Args:
        geometry: the collision bodies and pairs.
        arm: index of the arm.
        bounds: function of the distance bounds of all active pairs.
    """
    rows = own_pairs(geometry, arm)

    def least(poses: Array, path: Array) -> float:
        if not rows:
            return float("inf")
        absent = np.zeros((len(path), geometry.arms[1 - arm].joints))
        joints = (path, absent) if arm == 0 else (absent, path)
        return float(bounds(poses, *joints)[:, rows].min())

    return least


Bounds = Callable[[Array, Array, Array], Array]
"""Function from box poses (n, 6) and the joint positions of both arms, (n, joints) each, to lower
bounds of the distances of all active pairs (n, n_pairs) [m]."""


def _interpreted(workcell: Workcell, bodies: CellBodies) -> Searches:
    geometry = bodies.geometry
    asked = [bodies.screening[f"{block}clearance"] for block in geometry.asked]

    def bounds(poses: Array, q_1: Array, q_2: Array) -> Array:
        at, n = (poses.T, q_1.T, q_2.T), len(poses)
        parts = [np.array(function.map(n)(*at)).T for function in asked]
        return np.column_stack(parts).take(geometry.columns, axis=1)

    first, second = (
        interpreted_search(workcell, arm, model, own_clearance(bodies.geometry, arm, bounds))
        for arm, model in enumerate(bodies.robots)
    )
    return first, second
