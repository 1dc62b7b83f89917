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

from collections.abc import Iterable

import casadi as ca
import numpy as np

from symbolic.expression import number, sx_given
from symbolic.geometry.bodies import BOX, WORLD, Frame
from symbolic.geometry.expressions import world_placements
from symbolic.geometry.pairs import CellGeometry
from symbolic.geometry.screen import Reach, Screen, ScreenBody
from symbolic.path.rotation import rotation_matrix


def motion_function(
    geometry: CellGeometry,
    joint_placements: tuple[ca.Function, ca.Function],
    screen: Screen,
    name: str,
    pairs: Iterable[int],
) -> ca.Function:
    """Two configurations -> chord, bend (n_pairs,) [m] of some possible pairs.

    They are the sums of both bodies' chords and bends, see the module; of two links of one arm,
    the length of the path of one seen from the other, which needs no bend.

    Inputs: pose_a (6,), q_1_a, q_2_a (n,), then pose_b, q_1_b, q_2_b [m, rad].

    Args:
        screen: of the geometry.
        name: of the function.
        pairs: among the possible ones.
    """
    ends = []
    for end in ("a", "b"):
        pose = ca.SX.sym(f"pose_{end}", 6)
        q_1, q_2 = (
            ca.SX.sym(f"q_{i}_{end}", arm.joints) for i, arm in enumerate(geometry.arms, start=1)
        )
        rotation = rotation_matrix(geometry.workcell.task.orientation, pose[3:])
        placed = {WORLD: (ca.SX.eye(3), ca.SX.zeros(3)), BOX: (rotation, pose[:3])}
        for i, (base, q) in enumerate(zip(screen.bases, (q_1, q_2), strict=True)):
            for j, joint in enumerate(world_placements(base, joint_placements[i](q))):
                placed[Frame("link", i, j)] = joint
        ends.append(((pose, q_1, q_2), placed))
    (inputs_a, placed_a), (inputs_b, placed_b) = ends
    steps = [ca.fabs(b - a) for a, b in zip(inputs_a, inputs_b, strict=True)]
    own = [_body_motion(screen, body, placed_a, placed_b, steps) for body in screen.bodies]
    chords, bends = [], []
    for i, j in (screen.pairs[pair] for pair in pairs):
        first, second = screen.bodies[i], screen.bodies[j]
        if first.group == second.group:
            chords.append(_between_links(first, second, steps[1 + second.frame.robot]))
            bends.append(ca.SX(0))
        else:
            chords.append(own[i][0] + own[j][0])
            bends.append(own[i][1] + own[j][1])
    given = sx_given(screen)
    names = [f"{what}_{end}" for end in ("a", "b") for what in ("pose", "q_1", "q_2")]
    return ca.Function(
        name,
        [*inputs_a, *inputs_b, *given.values()],
        [ca.vertcat(*chords), ca.vertcat(*bends)],
        [*names, *given],
        ["chord", "bend"],
        {"cse": True},
    )


def _body_motion(
    screen: Screen,
    body: ScreenBody,
    placed_a: dict[Frame, tuple[ca.SX, ca.SX]],
    placed_b: dict[Frame, tuple[ca.SX, ca.SX]],
    steps: list[ca.SX],
) -> tuple[ca.SX, ca.SX]:
    """Chord and bend of one body."""
    if body.reach is None:
        return ca.SX(0), ca.SX(0)
    centre, spans = number(body.reach.centre), number(body.reach.spans)
    (R_a, p_a), (R_b, p_b) = placed_a[body.frame], placed_b[body.frame]
    shift = ca.mtimes(R_b - R_a, ca.SX(centre)) + p_b - p_a
    # |R_b - R_a| as an operator is 2 sin(angle / 2), its Frobenius norm over sqrt(2).
    chord = _norm(shift) + spans[0] * _norm(ca.vec(R_b - R_a)) / np.sqrt(2.0)
    if body.frame.kind == "box":
        turn = ca.sum1(steps[0][3:])
        return chord, spans[1] * turn * turn
    robot = body.frame.robot
    return chord, _bend(body.reach, screen.turning[robot], steps[1 + robot])


def _between_links(first: ScreenBody, second: ScreenBody, step: ca.SX) -> ca.SX:
    """Length of the path of the later link seen from the earlier one."""
    assert second.reach is not None, "the later of two links moves"
    reach = number(second.reach.joints)
    moving = range(first.frame.joint + 1, second.frame.joint + 1)
    return sum((reach[j] * step[j] for j in moving), ca.SX(0))


def _bend(reach: Reach, turning: tuple[bool, ...], step: ca.SX) -> ca.SX:
    total, before, joints = ca.SX(0), ca.SX(0), number(reach.joints)
    for j in range(joints.shape[0]):
        if turning[j]:
            total += joints[j] * step[j] * (step[j] + 2.0 * before)
            before += step[j]
        else:
            total += 2.0 * joints[j] * step[j] * before
    return total


def _norm(vector: ca.SX) -> ca.SX:
    return ca.sqrt(ca.sumsqr(vector))
