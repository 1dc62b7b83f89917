"""What a place for a robot is worth: how well its arm follows the box from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.proposing.detours import free_detours
from hybrid_opt.proposing.holding import Hold, HoldQuery, find_holds
from hybrid_opt.proposing.kinematics import ArmKinematics, box_to_last_joint, shoulders, spun
from hybrid_opt.proposing.problem import Problem
from symbolic.array import Array
from symbolic.geometry.bodies import WORLD, MeshReader, collision_bodies, shape_pieces
from symbolic.geometry.pairs import coal_distance
from symbolic.geometry.pieces import Piece
from symbolic.records import Cylinder, Workcell
from symbolic.records.poses import box_placement, inverse, pose_matrix, transform

STARTS = 192
"""Random postures by which a place is judged."""

EVERY_SPIN = 2
"""Every so many spins of the pads it is judged by."""

GUIDES_TRIED = 2
"""Guides by which it is judged."""

FOOT = Cylinder(0.12, 0.20)
"""What stands on the ground at a base and may touch nothing else [m]."""

ROOMY = 4.0
"""What it is worth if both arms follow the box along all of them."""

ABOVE = 0.02
"""How far above its floor a robot is looked at [m]."""

HIDDEN = 2.0
"""What it costs if something stands between a shoulder and its contact."""

ARM_RADIUS = 0.05
"""Of what has to find room between them [m]."""


@dataclass(frozen=True, eq=False)
class Place:
    """A base from which an arm follows the box.

    Attributes:
        base: (6,) its pose.
        value: how well.
        follows: (k,) along which detours.
    """

    base: Array
    value: float
    follows: NDArray[np.bool_]


class PlaceScorer:
    """Compares places of robots for given contacts."""

    def __init__(
        self, problem: Problem, draft: Workcell, spins: Array, rng: np.random.Generator
    ) -> None:
        """Prepare both arms.

        Args:
            problem: with its contacts.
            draft: its cell, the robots somewhere, redundant joints chosen.
            spins: of both pads that are tried [rad].
            rng: its only randomness.
        """
        self._problem, self._draft, self._rng = problem, draft, rng
        start, goal = problem.poses
        self._detours = free_detours(draft, start, goal)
        own = [inverse(robot.T_world_base) for robot in draft.robots]
        at = zip(own, shoulders(draft), strict=True)
        self._shoulders = [(T @ np.append(point, 1.0))[:3] for T, point in at]
        self._queries, self._arms = [], []
        for arm in (0, 1):
            joints = tuple(joint for joint, _ in draft.task.redundant_of(arm))
            self._arms.append(ArmKinematics.of(draft, arm, joints))
            few = spins[::EVERY_SPIN]
            self._queries.append(HoldQuery(draft, start, goal, few, None, STARTS, GUIDES_TRIED))
        meshes = MeshReader()
        self._environment = [
            shape_pieces(body.shape, body.pose, body.name, meshes) for body in draft.environment
        ]
        self._feet = [_feet(draft, arm) for arm in (0, 1)]

    def place(self, arm: int, base: Array) -> Place | None:
        """What a base (6,) is worth to an arm, None where it cannot stand there or does not follow
        the box from there."""
        if not self._stands_free(arm, base):
            return None
        T = pose_matrix(base[:3], base[3:])
        kinematics = self._arms[arm].moved(T)
        holds = find_holds(self._queries[arm], arm, kinematics, self._rng).holds
        if not holds:
            return None
        hidden = self._hidden(arm, (T @ np.append(self._shoulders[arm], 1.0))[:3])
        value = holds[0].score + 0.05 * len(holds) - HIDDEN * hidden
        return Place(base, value, self._followed(arm, kinematics, holds))

    def _stands_free(self, arm: int, base: Array) -> bool:
        """Whether nothing of the environment is where the robot would stand; its floor may be."""
        T = pose_matrix(base[:3] + np.array([0.0, 0.0, ABOVE]), base[3:])
        feet = tuple(piece.moved(T) for piece in self._feet[arm])
        return all(coal_distance(feet, pieces) > 0.0 for pieces in self._environment)

    def _followed(
        self, arm: int, kinematics: ArmKinematics, holds: Sequence[Hold]
    ) -> NDArray[np.bool_]:
        """(k,) detours along which an arm follows the box in one of these ways to hold, its
        redundant joints where they are."""
        robot, contact = self._draft.robots[arm], self._draft.contacts[arm]
        k, m, _ = self._detours.shape
        if not k:
            return np.zeros(0, dtype=bool)
        T_world_box = box_placement(self._draft.task.orientation, self._detours.reshape(k * m, -1))
        rows = []
        for hold in holds:
            T = box_to_last_joint(self._draft, kinematics.geometry, spun(contact, hold.spin), arm)
            rows.append((T_world_box @ T).reshape(k, m, 4, 4))
        targets = np.concatenate(rows).swapaxes(0, 1)
        q = np.repeat([hold.q_start for hold in holds], k, axis=0)
        path, kept, measure = kinematics.follow(q, targets)
        inside = (path >= kinematics.lower) & (path <= kinematics.upper)
        fine = inside.all(axis=(0, 2)) & (measure.min(axis=0) >= robot.min_manipulability)
        return np.asarray((fine & (kept == m)).reshape(len(holds), k).any(axis=0))

    def _hidden(self, arm: int, shoulder: Array) -> float:
        """Share of start and goal at which the environment stands between a shoulder (3,) and the
        robot's contact, looked at level."""
        point = np.append(np.array(self._problem.contacts[arm]["xyz"], dtype=float), 1.0)
        hit = 0
        for pose in self._problem.poses:
            T_world_box = box_placement(self._problem.orientation, pose)
            there = (T_world_box @ point)[:3]
            aside = there - T_world_box[:3, 3]
            there = there + 2.0 * ARM_RADIUS * aside / max(float(np.linalg.norm(aside)), 1e-9)
            line = (shoulder - there) * [1.0, 1.0, 0.0]
            length = float(np.linalg.norm(line))
            if length < ARM_RADIUS:
                continue
            # The cylinder's axis along the line.
            turn = pose_matrix(np.zeros(3), [0.0, np.pi / 2.0, np.arctan2(line[1], line[0])])
            way = Piece(Cylinder(ARM_RADIUS, length), transform(turn[:3, :3], there + line / 2.0))
            hit += any(coal_distance((way,), pieces) <= 0.0 for pieces in self._environment)
        return hit / 2.0


def _feet(draft: Workcell, arm: int) -> tuple[Piece, ...]:
    """What stands still of a robot, or of the machine that it is an arm of, and a foot, in the
    base frame; of a machine they are listed with the first arm."""
    robot = draft.robots[arm]
    own = inverse(robot.T_world_base)
    standing = [
        piece.moved(own)
        for body in collision_bodies(draft)
        if body.frame == WORLD and body.name.startswith(f"{robot.name}/")
        for piece in body.pieces
    ]
    return (Piece(FOOT, pose_matrix([0.0, 0.0, FOOT.length / 2.0], np.zeros(3))), *standing)


def shared_room(first: Place, second: Place) -> float:
    """What it is worth along how many detours both arms follow the box."""
    both = first.follows & second.follows
    return ROOMY * float(both.mean()) if len(both) else 0.0
