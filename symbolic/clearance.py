"""Lower bounds of the distance between the bodies of a cell, as CasADi expressions.

For any unit vector u, two convex bodies are at least  min_A u.x - max_B u.x  apart (a plane
across u separates them). The bound of a pair is the largest such gap over a few directions:
the axes of the environment's box, of the payload, and the world's. In an arm's own pairs, and
against round shapes of the environment, chains of spheres are used instead, or as well.
Positive means surely free by that distance; anything else means nothing.
"""

from __future__ import annotations

import casadi as ca

from symbolic.collision_pairs import CellGeometry
from symbolic.rotation import rotation_matrix
from symbolic.scene import Scene, world_placements
from symbolic.softness import EXACT, Softness


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
        placements_1, placements_2: per robot the rotations (3, 18) and positions (3, 6) of its
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
    """The functions of one sample that collision checking calls, by name.

    Both take pose (6,), q_1 (6,) and q_2 (6,) [m, rad].
    clearance: -> clearance (n_pairs,), see `clearance_expressions`.
    frames: -> rotations (3, 39), positions (3, 13): the moving frames in the world, side by
    side: the box, the six joints of robot 1, the six joints of robot 2.

    Args:
        joint_placements: of each robot, `RobotModel.joint_placements`.
    """
    pose = ca.SX.sym("pose", 6)
    q = ca.SX.sym("q_1", 6), ca.SX.sym("q_2", 6)
    R, p = rotation_matrix(pose[3:]), pose[:3]
    first, second = (joint_placements[i](q[i]) for i in (0, 1))
    clearance = clearance_expressions(geometry, R, p, first, second, softness)
    frames = [(R, p)]
    for arm, placements in zip(geometry.arms, (first, second), strict=True):
        frames += world_placements(arm.T_world_root, placements)
    names = ["pose", "q_1", "q_2"]
    outputs = [ca.horzcat(*[R for R, _ in frames]), ca.horzcat(*[p for _, p in frames])]
    return {
        "clearance": ca.Function(
            "clearance", [pose, *q], [clearance], names, ["clearance"], {"cse": True}
        ),
        "frames": ca.Function(
            "frames", [pose, *q], outputs, names, ["rotations", "positions"], {"cse": True}
        ),
    }
