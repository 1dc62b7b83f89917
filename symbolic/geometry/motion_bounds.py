"""How far a body can be from where it is seen: bounds of the motion between two samples.

Between two samples the joints and the box's position and angles move linearly. A body's point
x(s), 0 <= s <= 1, then stays within

  |x(s) - x(0)| <= s D + s (1 - s) / 2 K,      |x(s) - x(1)| <= (1 - s) D + s (1 - s) / 2 K,

where the chord D bounds |x(1) - x(0)| and the bend K bounds |x''|. For the bodies of an arm,

  |x''| <= sum_ij |dq_i| |dq_j| r_max(i,j),

with r_j the largest distance of the body's points from the axis of joint j. Where a joint slides,
r_j = 1 bounds the motion by it, and in x'' it counts with the joints that turn before it only: what
slides along a fixed line does not bend. Of the box |x''| <= r (sum_i |da_i|)^2, da_i the steps of
its three numbers: for angles as for joints, and for a rotation vector v = v_0 + s d by Duhamel's
formula, |exp(v)''| = 2 |integral of exp d exp d exp over a triangle of area 1/2| <= |d|^2.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.geometry.bodies import BOX, WORLD, ArmGeometry, CollisionBody, Frame
from symbolic.geometry.expressions import clean, world_placements
from symbolic.geometry.pairs import CellGeometry, chain_radius
from symbolic.geometry.pieces import bounding_box, farthest_from_axis, farthest_from_point
from symbolic.path.rotation import rotation_matrix


def reach_about_joints(body: CollisionBody, arm: ArmGeometry) -> Array:
    """(n,) distance from each joint's axis that no point of a link's body exceeds [m]; 1 of a joint
    that slides.

    Joints behind the body do not move it: zero. Own joint: from the shape; joints further down:
    with the chain between stretched.
    """
    reach = np.zeros(arm.joints)
    last = body.frame.joint
    for j in range(last + 1):
        if not arm.turning[j]:
            reach[j] = 1.0
        elif j == last:
            reach[j] = max(farthest_from_axis(p, np.zeros(3), arm.axes[j]) for p in body.pieces)
        else:
            offset = arm.origins[j + 1][:3, 3]
            across = offset - (offset @ arm.axes[j]) * arm.axes[j]
            reach[j] = float(np.linalg.norm(across)) + chain_radius(body, arm, j + 1)
            reach[j] += float(arm.slides[j + 1])
    return reach


def motion_function(
    geometry: CellGeometry, joint_placements: tuple[ca.Function, ca.Function]
) -> ca.Function:
    """`motion`: two configurations -> chord, bend (n_pairs,) [m] of every active pair.

    They are the sums of both bodies' chords and bends, see the module; of two links of one arm,
    the length of the path of one seen from the other, which needs no bend.

    Inputs: pose_a (6,), q_1_a, q_2_a (n,), then pose_b, q_1_b, q_2_b [m, rad].
    """
    ends = []
    for end in ("a", "b"):
        pose = ca.SX.sym(f"pose_{end}", 6)
        q_1, q_2 = (
            ca.SX.sym(f"q_{i}_{end}", arm.joints) for i, arm in enumerate(geometry.arms, start=1)
        )
        rotation = rotation_matrix(geometry.workcell.task.orientation, pose[3:])
        placed = {WORLD: (ca.SX.eye(3), ca.SX.zeros(3)), BOX: (rotation, pose[:3])}
        for i, (arm, q) in enumerate(zip(geometry.arms, (q_1, q_2), strict=True)):
            for j, joint in enumerate(world_placements(arm.T_world_root, joint_placements[i](q))):
                placed[Frame("link", i, j)] = joint
        ends.append(((pose, q_1, q_2), placed))
    (inputs_a, placed_a), (inputs_b, placed_b) = ends
    steps = [ca.fabs(b - a) for a, b in zip(inputs_a, inputs_b, strict=True)]
    own = [_body_motion(geometry, body, placed_a, placed_b, steps) for body in geometry.bodies]
    chords, bends = [], []
    for pair in geometry.active:
        first, second = geometry.bodies[pair.first], geometry.bodies[pair.second]
        if first.group == second.group:
            step = steps[1 + second.frame.robot]
            chords.append(_between_links(first, second, geometry.arms[second.frame.robot], step))
            bends.append(ca.SX(0))
        else:
            chords.append(own[pair.first][0] + own[pair.second][0])
            bends.append(own[pair.first][1] + own[pair.second][1])
    names = [f"{name}_{end}" for end in ("a", "b") for name in ("pose", "q_1", "q_2")]
    return ca.Function(
        "motion",
        [*inputs_a, *inputs_b],
        [ca.vertcat(*chords), ca.vertcat(*bends)],
        names,
        ["chord", "bend"],
        {"cse": True},
    )


def _body_motion(
    geometry: CellGeometry,
    body: CollisionBody,
    placed_a: dict[Frame, tuple[ca.SX, ca.SX]],
    placed_b: dict[Frame, tuple[ca.SX, ca.SX]],
    steps: list[ca.SX],
) -> tuple[ca.SX, ca.SX]:
    """Chord and bend of one body."""
    if body.frame.kind == "world":
        return ca.SX(0), ca.SX(0)
    centre = bounding_box(body.pieces, np.eye(3)).centre
    radius = max(farthest_from_point(piece, centre) for piece in body.pieces)
    (R_a, p_a), (R_b, p_b) = placed_a[body.frame], placed_b[body.frame]
    shift = ca.mtimes(R_b - R_a, ca.SX(clean(centre))) + p_b - p_a
    # |R_b - R_a| as an operator is 2 sin(angle / 2), its Frobenius norm over sqrt(2).
    chord = _norm(shift) + radius * _norm(ca.vec(R_b - R_a)) / np.sqrt(2.0)
    if body.frame.kind == "box":
        turn = ca.sum1(steps[0][3:])
        farthest = max(farthest_from_point(piece, np.zeros(3)) for piece in body.pieces)
        return chord, farthest * turn * turn
    reach = reach_about_joints(body, geometry.arms[body.frame.robot])
    return chord, _bend(reach, geometry.arms[body.frame.robot], steps[1 + body.frame.robot])


def _between_links(
    first: CollisionBody, second: CollisionBody, arm: ArmGeometry, step: ca.SX
) -> ca.SX:
    """Length of the path of the later link seen from the earlier one."""
    reach = reach_about_joints(second, arm)
    moving = range(first.frame.joint + 1, second.frame.joint + 1)
    return sum((reach[j] * step[j] for j in moving), ca.SX(0))


def _bend(reach: Array, arm: ArmGeometry, step: ca.SX) -> ca.SX:
    total, before = ca.SX(0), ca.SX(0)
    for j, turning in enumerate(arm.turning):
        if turning:
            total += reach[j] * step[j] * (step[j] + 2.0 * before)
            before += step[j]
        else:
            total += 2.0 * reach[j] * step[j] * before
    return total


def _norm(vector: ca.SX) -> ca.SX:
    return ca.sqrt(ca.sumsqr(vector))
