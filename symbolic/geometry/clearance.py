"""Lower bounds of the distance between the bodies of a cell, as CasADi expressions.

For any unit vector u, two convex bodies are at least  min_A u.x - max_B u.x  apart (a plane
across u separates them). The bound of a pair is the largest such gap over a few directions:
the axes of the environment's box, of the payload, and the world's. In an arm's own pairs, and
against round shapes of the environment, chains of spheres are used instead, or as well.
Positive means surely free by that distance; anything else means nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import casadi as ca

from symbolic.geometry.bodies import BOX, WORLD, Frame
from symbolic.geometry.motion_bounds import motion_function
from symbolic.geometry.pairs import CellGeometry
from symbolic.geometry.pieces import Piece
from symbolic.geometry.placements import clean, world_placements
from symbolic.geometry.scene import Scene
from symbolic.geometry.softness import EXACT, Softness
from symbolic.physics.rotation import rotation_matrix


def clearance_expressions(
    geometry: CellGeometry,
    R_box: ca.SX,
    p_box: ca.SX,
    placements_1: tuple[ca.SX, ca.SX],
    placements_2: tuple[ca.SX, ca.SX],
    softness: Softness = EXACT,
) -> ca.SX:
    """Lower bounds (n_pairs,) of the distance of every active pair [m], in the pairs' order.

    Args:
        R_box, p_box: (3, 3) and (3,), the box in the world.
        placements_1, placements_2: per robot the rotations (3, 3 n) and positions (3, n) of its
            joint frames in its root, side by side, as `RobotModel.joint_placements` gives them.
        softness: `EXACT` for screening; `Softness(width)` for bounds that are smooth, and lower
            by some multiples of the width [m].
    """
    placements = (placements_1, placements_2)
    scene = Scene(geometry, R_box, p_box, placements, softness)
    return ca.vertcat(*[scene.bound(pair.first, pair.second) for pair in geometry.active])


def screening_functions(
    geometry: CellGeometry,
    joint_placements: tuple[ca.Function, ca.Function],
    softness: Softness = EXACT,
) -> dict[str, ca.Function]:
    """The functions that collision checking calls, by name.

    The first two take pose (6,), q_1 and q_2 (n,) [m, rad] of one sample.
    clearance: -> clearance (n_pairs,), see `clearance_expressions`.
    piece_poses: -> quaternions (4, n_pieces) as w x y z, positions (3, n_pieces) [m]: every
    piece of every body in the world, in the bodies' order.
    motion: see `symbolic.geometry.motion_bounds.motion_function`.

    Args:
        joint_placements: of each robot, `RobotModel.joint_placements`.
    """
    pose = ca.SX.sym("pose", 6)
    q = [ca.SX.sym(f"q_{i}", arm.joints) for i, arm in enumerate(geometry.arms, start=1)]
    R, p = rotation_matrix(geometry.workcell.task.orientation, pose[3:]), pose[:3]
    first, second = (joint_placements[i](q[i]) for i in (0, 1))
    clearance = clearance_expressions(geometry, R, p, first, second, softness)
    placed = {WORLD: (ca.SX.eye(3), ca.SX.zeros(3)), BOX: (R, p)}
    for i, arm in enumerate(geometry.arms):
        for j, joint in enumerate(world_placements(arm.T_world_root, (first, second)[i])):
            placed[Frame("link", i, j)] = joint
    poses = [
        _piece_pose(*placed[body.frame], piece) for body in geometry.bodies for piece in body.pieces
    ]
    names = ["pose", "q_1", "q_2"]
    outputs = [ca.horzcat(*column) for column in zip(*poses, strict=True)]
    return {
        "clearance": ca.Function(
            "clearance", [pose, *q], [clearance], names, ["clearance"], {"cse": True}
        ),
        "piece_poses": ca.Function(
            "piece_poses", [pose, *q], outputs, names, ["quaternions", "positions"], {"cse": True}
        ),
        "motion": motion_function(geometry, joint_placements),
    }


def with_more_pairs(
    known: Mapping[str, ca.Function],
    geometry: CellGeometry,
    more: CellGeometry,
    joint_placements: tuple[ca.Function, ca.Function],
) -> dict[str, ca.Function]:
    """`screening_functions` of a cell in which further pairs are active, put together from those
    that are known, so that these are compiled once.

    Args:
        known: the functions of `geometry`.
        more: the same bodies; its active pairs are those of `geometry`, then others.
    """
    count = len(geometry.active)
    assert more.active[:count] == geometry.active, "further pairs come last"
    others = screening_functions(replace(more, active=more.active[count:]), joint_placements)
    found = dict(known)
    for name in ("clearance", "motion"):
        function = known[name]
        given = [
            ca.MX.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())
        ]
        both = zip(function.call(given), others[name].call(given), strict=True)
        results = [ca.vertcat(*values) for values in both]
        found[name] = ca.Function(name, given, results, function.name_in(), function.name_out())
    return found


def _piece_pose(R: ca.SX, p: ca.SX, piece: Piece) -> tuple[ca.SX, ca.SX]:
    """Unit quaternion (4,) and position (3,) in the world of a piece of a placed body."""
    rotation = ca.mtimes(R, ca.SX(clean(piece.rotation)))
    return quaternion(rotation), ca.mtimes(R, ca.SX(clean(piece.centre))) + p


def quaternion(R: ca.SX) -> ca.SX:
    """The unit quaternion (4,), w x y z, of a rotation (3, 3), stable for every angle.

    Each column below is the quaternion times one of its own components (times 4); the column of
    the largest component is the accurate one (Shepperd 1978).
    """
    trace = ca.trace(R)
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    squares = [1.0 + trace] + [1.0 + 2.0 * R[k, k] - trace for k in range(3)]
    columns = [
        ca.vertcat(squares[0], x, y, z),
        ca.vertcat(x, squares[1], xy, xz),
        ca.vertcat(y, xy, squares[2], yz),
        ca.vertcat(z, xz, yz, squares[3]),
    ]
    best, largest = columns[0], squares[0]
    for column, square in zip(columns[1:], squares[1:], strict=True):
        best = ca.if_else(square > largest, column, best)
        largest = ca.fmax(largest, square)
    return best / ca.norm_2(best)
