"""Collisions before anything is compiled: of the box alone, and of the whole cell by the collision
checker, whose bounds run in CasADi's interpreter."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from codegen.interpreted import InterpretedFunction
from codegen.source import dense
from hybrid_opt.collision.checker import CollisionChecker
from symbolic.array import Array
from symbolic.cell_model import own_pairs
from symbolic.geometry.bodies import MeshReader, shape_pieces
from symbolic.geometry.clearance import screening_functions
from symbolic.geometry.pairs import CellGeometry, coal_distance
from symbolic.records import PAYLOAD, Workcell
from symbolic.records.poses import box_placement
from symbolic.robot.model import build_robot_model

MARGINS = (0.01, 0.004, 0.0015, 0.0005, 0.0)
"""Clearances that a first path may keep beyond the cell's tolerance, the widest possible counts
[m]."""


class BoxAlone:
    """The box among the environment, without the arms."""

    def __init__(self, workcell: Workcell) -> None:
        """Prepare their shapes."""
        meshes = MeshReader()
        self._orientation = workcell.task.orientation
        self._box = shape_pieces(workcell.payload.solid, np.eye(4), PAYLOAD, meshes)
        self._standing = [
            shape_pieces(body.shape, body.pose, body.name, meshes) for body in workcell.environment
        ]

    def meets(self, path: Array) -> bool:
        """Whether the box meets the environment at one of these poses (n, 6)."""
        for T_world_box in box_placement(self._orientation, path):
            box = tuple(piece.moved(T_world_box) for piece in self._box)
            if any(coal_distance(box, pieces) <= 0.0 for pieces in self._standing):
                return True
        return False


class PoseJudge:
    """Says which configurations collide, with some clearance to spare.

    Attributes:
        geometry: the cell's bodies and pairs.
        margin: clearance beyond the cell's tolerance that counts as a collision [m].
        met: how often each pair was in the way since it was emptied.
    """

    def __init__(self, geometry: CellGeometry, checker: CollisionChecker, margin: float) -> None:
        """Use `judge_of`."""
        self.geometry = geometry
        self.margin = margin
        self.met: Counter[tuple[str, str]] = Counter()
        self._checker = checker
        self._others = [
            np.setdiff1d(np.arange(len(geometry.active)), own_pairs(geometry, arm))
            for arm in (0, 1)
        ]

    def with_margin(self, margin: float) -> PoseJudge:
        """The same judge with another clearance to spare."""
        workcell = self.geometry.workcell
        collision = workcell.collision
        wider = replace(collision, tolerance=collision.tolerance - self.margin + margin)
        geometry = replace(self.geometry, workcell=replace(workcell, collision=wider))
        checker = CollisionChecker(geometry, self._checker.functions)
        return PoseJudge(geometry, checker, margin)

    def colliding(self, pose: Array, q_1: Array, q_2: Array) -> NDArray[np.bool_]:
        """(n,) of box poses (n, 6) and both arms' joints (n, joints)."""
        found = self._checker.check(pose, q_1, q_2, np.arange(len(pose), dtype=float))
        if found.first_touch is not None:
            self.met[found.first_touch.first, found.first_touch.second] += 1
        return found.colliding

    def without_screening(self, pose: Array, q_1: Array, q_2: Array) -> NDArray[np.bool_]:
        """The same by FCL alone, for every pair."""
        return np.asarray(self._checker.collision_mask(pose, q_1, q_2).any(axis=1))

    def arm_colliding(self, arm: int, pose: Array, q: Array) -> NDArray[np.bool_]:
        """(n,) of one arm and the box, as if the other arm were not there."""
        absent = np.zeros((len(q), self.geometry.arms[1 - arm].joints))
        q_1, q_2 = (q, absent) if arm == 0 else (absent, q)
        bounds = self._checker.bounds(pose, q_1, q_2)
        bounds[:, self._others[arm]] = np.inf
        times = np.arange(len(pose), dtype=float)
        return self._checker.check(pose, q_1, q_2, times, bounds).colliding

    def resting(self, pose: Array) -> list[tuple[str, bool]]:
        """What stands where the box (6,) is to be: environment bodies, and whether the box enters
        them by more than what rests on something may."""
        names = [(k, pair) for k, pair in enumerate(self.geometry.pair_names) if PAYLOAD in pair]
        standing = {body.name for body in self.geometry.workcell.environment}
        joints = [np.zeros((1, arm.joints)) for arm in self.geometry.arms]
        found = []
        for number, pair in names:
            other = next(name for name in pair if name != PAYLOAD)
            if other in standing and self._checker.collisions(
                pose[None], joints[0], joints[1], [0], [number]
            ) == [True]:
                found.append((other, self._checker.enters(pose, number)))
        return found

    def first_pair(
        self, pose: Array, q_1: Array, q_2: Array, arm: int | None = None
    ) -> tuple[str, str] | None:
        """The first pair that collides in one configuration, of one arm or of all."""
        pose, q_1, q_2 = (np.atleast_2d(part) for part in (pose, q_1, q_2))
        bounds = self._checker.bounds(pose, q_1, q_2)
        if arm is not None:
            bounds[:, self._others[arm]] = np.inf
        touch = self._checker.check(pose, q_1, q_2, np.zeros(1), bounds).first_touch
        return None if touch is None else (touch.first, touch.second)


def judge_of(geometry: CellGeometry) -> PoseJudge:
    """The judge of a cell's collisions, with nothing to spare.

    Raises:
        RobotModelError: a URDF does not give an arm.
    """
    models = [build_robot_model(robot) for robot in geometry.workcell.robots]
    made = screening_functions(geometry, (models[0].joint_placements, models[1].joint_placements))
    functions = {name: InterpretedFunction(dense(made[name])) for name in made if name != "motion"}
    return PoseJudge(geometry, CollisionChecker(geometry, functions), 0.0)
