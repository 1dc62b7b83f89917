"""Tabulated lower bounds of the distance of two links with two turning joints between them.

The distance depends on the positions of these two joints alone. A table divides one turn of both
joints into a grid of cells. Its entry is a lower bound for the whole cell: the distance at the
cell's centre minus the largest distance by which the later link can move within the cell. Pieces
far from the joint axes move farther, so the motion is bounded piece by piece.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.collision.solids import compiled_distances, shape_table
from symbolic.array import Array
from symbolic.geometry.bodies import WORLD, ArmGeometry, CollisionBody
from symbolic.geometry.covers import close_pairs
from symbolic.geometry.pairs import CellGeometry
from symbolic.geometry.pieces import Piece
from symbolic.geometry.screen import has_hulls, reach_about_joints
from symbolic.records.content import CacheKey, digest_of_parts
from symbolic.records.poses import rotation_from_vector

CELLS = 256
"""Number of cells of a table along each joint; a power of two."""

CELLS_PER_RADIAN = CELLS / (2.0 * np.pi)

FIRST_CELLS = 16
"""Number of cells along each joint of the first grid. Cells with a loose bound are halved."""

TIGHT = 0.25
"""A bound is loose if it is below this share of the distance at the cell's centre."""

TABLE_ROUNDING = 1e-8
"""Margin for rounding: the part of a cell by which a position may fall into the neighbouring cell,
and the displacement of a point by rounded poses [m]."""

POSE_DIGITS = 9
"""Decimals to which the poses of the earlier link's pieces are rounded; they are within a few
metres."""

MOST_ANGLE = 1e6
"""Joint positions beyond this are not looked up, because rounding makes their cell uncertain
[rad]."""


@dataclass(frozen=True)
class JointTable:
    """Table of lower bounds of the distance of one pair of bodies.

    Attributes:
        pair: index of the pair among all pairs that are checked.
        robot: index of the arm.
        joint: index of the first of the two joints between the bodies; the second follows it.
        bounds: (CELLS, CELLS) lower bounds by cells of the first and of the second joint [m]; -1 in
            cells that the joint limits exclude.
    """

    pair: int
    robot: int
    joint: int
    bounds: NDArray[np.float32]

    def look_up(self, q: Array) -> Array:
        """Return lower bounds (n,) of the pair's distance at joint positions of the arm [m].

        A bound is -inf if a position is not finite or beyond `MOST_ANGLE`.

        Args:
            q: (n, joints) joint positions [rad].
        """
        positions = q[:, self.joint : self.joint + 2]
        known = np.all(np.abs(positions) < MOST_ANGLE, axis=1)
        cells = np.floor(np.where(known[:, None], positions, 0.0) * CELLS_PER_RADIAN)
        first, second = (cells.astype(np.int64) & (CELLS - 1)).T
        return np.where(known, self.bounds[first, second].astype(float), -np.inf)


def joint_tables(geometry: CellGeometry) -> tuple[JointTable, ...]:
    """Build tables of lower bounds of distances, over the positions of two joints, for pairs of
    bodies that the compiled bounds often cannot decide.

    A pair gets a table if all of these hold:

    - Exactly two joints lie between its bodies, both revolute joints of one arm.
    - One of the bodies has a convex hull.
    - Simple covers of the bodies overlap in many postures, or the arm is mounted on the body that
      is nearer to its base.
    """
    close, found = close_pairs(geometry), []
    for k, pair in enumerate(geometry.active):
        bodies = geometry.bodies[pair.first], geometry.bodies[pair.second]
        low, high = sorted(bodies, key=lambda body: body.frame.joint)
        robot, joint = high.frame.robot, low.frame.joint + 1
        is_near = (pair.first, pair.second) in close or robot in (low.carries or ())
        if not is_near or not any(map(has_hulls, bodies)) or high.frame.joint != joint + 1:
            continue
        arm = geometry.arms[robot]
        if all(arm.turning[joint : joint + 2]):
            still = _in_root(low, arm)
            known = digest_of_parts((still, high.pieces)), joint, arm.chain
            bounds = _tabulate(CacheKey(still, high, arm, known=known))
            found.append(JointTable(k, robot, joint, bounds))
    return tuple(found)


def _in_root(body: CollisionBody, arm: ArmGeometry) -> tuple[Piece, ...]:
    """Return the pieces (convex solids) of a body in a frame that belongs to an arm.

    Pieces of a link stay in the frame of the link. Pieces of a fixed body are converted from the
    world frame to the frame of the arm's root, and their poses are rounded. The result, and tables
    that are cached under it, are thus the same wherever the arm stands.

    Args:
        body: the body.
        arm: the arm.
    """
    if body.frame != WORLD:
        return body.pieces
    inverse: Array = np.linalg.inv(arm.T_world_root).astype(float)
    moved = [piece.moved(inverse) for piece in body.pieces]
    return tuple(Piece(piece.shape, piece.pose.round(POSE_DIGITS) + 0.0) for piece in moved)


@lru_cache(maxsize=64)
def _tabulate(given: CacheKey) -> NDArray[np.float32]:
    still, high, arm = given.given
    joint = high.frame.joint - 1
    distances = _PieceDistances(still, high, arm, joint)
    reach = np.array([_reach(piece, high, arm)[joint : joint + 2] for piece in high.pieces])
    table = np.full((CELLS, CELLS), -1.0)
    cells, n = np.stack(np.divmod(np.arange(FIRST_CELLS**2), FIRST_CELLS), axis=1), FIRST_CELLS
    bounds = np.full((len(cells), len(reach)), -1.0)  # of every piece of the later link
    loose = np.ones(bounds.shape, dtype=bool)
    while len(cells):
        width = 2.0 * np.pi / n
        within = _are_within_limits(cells, width, arm, joint)
        cells, bounds, loose = cells[within], bounds[within], loose[within]
        rows, moving = np.nonzero(loose)
        lower, upper = distances.bounds((cells + 0.5) * width, rows, moving)
        motion = reach[moving].sum(axis=1) * (0.5 + TABLE_ROUNDING) * width + TABLE_ROUNDING
        bounds[rows, moving] = np.maximum(bounds[rows, moving], lower - motion)
        nearest, farthest = np.full((2, len(cells)), np.inf)
        np.minimum.at(nearest, rows, lower)
        np.minimum.at(farthest, rows, upper + motion)
        loose = (bounds <= 0.0) | (bounds < TIGHT * nearest[:, None])
        done = ~loose.any(axis=1) | (farthest < 0.0) | (n == CELLS)
        wide = CELLS // n
        first, second = cells[done].T
        blocks = table.reshape(n, wide, n, wide)
        blocks[first, :, second, :] = bounds[done].min(axis=1)[:, None, None]
        halves = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
        cells, n = (2 * cells[~done, None] + halves).reshape(-1, 2), 2 * n
        bounds, loose = (np.repeat(each[~done], 4, axis=0) for each in (bounds, loose))
    return np.nextafter(table.astype(np.float32), np.float32(-np.inf))


def _are_within_limits(
    cells: NDArray[np.intp], width: float, arm: ArmGeometry, joint: int
) -> NDArray[np.bool_]:
    """Find the cells of a table that hold positions within the limits of two successive joints, up
    to whole turns.

    Args:
        cells: (n, 2) indices of cells along both joints.
        width: width of a cell [rad].
        arm: the arm.
        joint: index of the first joint.

    Returns:
        (n,) True for such cells.
    """
    low, high = arm.lower[joint : joint + 2], arm.upper[joint : joint + 2]
    off = np.mod((cells + 0.5) * width - (low + high) / 2.0 + np.pi, 2.0 * np.pi) - np.pi
    return np.asarray(np.all(np.abs(off) <= (high - low + width) / 2.0, axis=1))


def _reach(piece: Piece, body: CollisionBody, arm: ArmGeometry) -> Array:
    return reach_about_joints(replace(body, pieces=(piece,)), arm)


class _PieceDistances:
    """Distances between the pieces (convex solids) of two links of an arm, as functions of two
    joint positions.

    Attributes:
        still: pieces of the earlier link, in the frame of its joint or of the arm's root.
        moving: pieces of the later link.
    """

    def __init__(
        self, still: Sequence[Piece], body: CollisionBody, arm: ArmGeometry, joint: int
    ) -> None:
        self.still, self.moving = still, body.pieces
        self._origins = arm.origins[joint : joint + 2]
        self._axes = arm.axes[joint : joint + 2]
        shapes = [piece.shape for piece in (*self.still, *self.moving)]
        # The earlier link is one body, every piece of the later one another.
        first_piece = np.concatenate([[0], len(still) + np.arange(len(self.moving) + 1)])
        self._native = compiled_distances().Bodies(
            *shape_table(shapes), first_piece, np.arange(len(shapes))
        )

    def bounds(
        self, q: Array, rows: NDArray[np.intp], moving: NDArray[np.intp]
    ) -> tuple[Array, Array]:
        """Compute lower and upper bounds (m,) [m] of the distances between the link nearer to the
        base and pieces (convex solids) of the other link.

        Args:
            q: (n, 2) positions of the two joints between the links [rad].
            rows: (m,) index in `q` of the joint positions of each query.
            moving: (m,) index of the piece of each query among the other link's pieces, the
                attribute `moving`.
        """
        # Not imported at the top: SciPy takes long to start, and cells without meshes need none.
        from scipy.spatial.transform import Rotation

        n, n_still = len(q), len(self.still)
        T = np.broadcast_to(np.eye(4), (n, 4, 4))
        for k in range(2):
            moved = np.tile(np.eye(4), (n, 1, 1))
            moved[:, :3, :3] = rotation_from_vector(q[:, k, None] * self._axes[k])
            T = T @ self._origins[k] @ moved
        poses = np.empty((n, n_still + len(self.moving), 4, 4))
        poses[:, :n_still] = [piece.pose for piece in self.still]
        for k, piece in enumerate(self.moving, start=n_still):
            poses[:, k] = T @ piece.pose
        turned = Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3))
        quaternions = turned.as_quat(scalar_first=True).reshape(n, -1, 4)
        positions = np.ascontiguousarray(poses[..., :3, 3])
        lower, upper = self._native.distances(
            quaternions, positions, rows, np.zeros_like(rows), 1 + moving
        )
        return lower, upper
