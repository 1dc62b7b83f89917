"""Limits of robust forces in the convex program of a timing: every case's wrenches as variables.

At a point of the path one force is commanded; each case has wrenches of its own that carry it with
this force of the second pad, and the leading arm then feels what the motion leaves. The balance is
the true rigid body's in every case.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hybrid_opt.timing.model import PathMotion, TimingModel
from studies.research.plain.motion import PLAIN_GRAVITY, angular_rates, rotation
from symbolic.array import Array
from symbolic.records import Workcell
from tests.hybrid_opt.timing.convex_oracle import Affine, Program, Terms
from tests.symbolic.contact.oracle import points_of

FORCE_UNIT = 50.0
"""[N], so that the program's unknowns are around one."""

GRID = 4, 8
"""Rings of a patch and points on each."""


def robust_limit(
    cases: list[Array], lightest: float
) -> Callable[[Program, TimingModel, PathMotion, int, float, Affine], None]:
    """What limits the forces of cases (15,), see `case_squeeze.CASE_SIZES`, of the largest mass.

    Args:
        lightest: least over largest mass.
    """

    def limit_force(
        program: Program,
        model: TimingModel,
        motion: PathMotion,
        i: int,
        force: float,
        affine: Affine,
    ) -> None:
        commanded = program.fresh(1)
        program.at_most({commanded: FORCE_UNIT}, force)
        path = (motion.pose[i, :6], motion.pose_first[i, :6], motion.pose_second[i, :6])
        for case in cases:
            loads = [load_of(model.workcell, path, z, case) for z in ((0, 0), (1, 0), (0, 1))]
            rest, by_a, by_w = loads[0], loads[1] - loads[0], loads[2] - loads[0]
            load = [(affine(a, w), r) for a, w, r in zip(by_a, by_w, rest, strict=True)]
            # Leading less commanded force: the normal part of the load, contact 2's being against.
            terms, constant = load[2]
            for share in (1.0, lightest):
                over = {k: share * v for k, v in terms.items()}
                program.at_most({commanded: FORCE_UNIT, **over}, force - share * constant)
            _held(program, model.workcell, case, load, commanded)

    return limit_force


def load_of(
    workcell: Workcell, path: tuple[Array, Array, Array], z: tuple[float, float], case: Array
) -> Array:
    """(6,) force and moment about the case's centre of mass, in the axes of contact 1, at u'' and
    u'^2 (2,)."""
    (pose, first, second), (a, w), payload = path, z, workcell.payload
    mass, centre, disturbance = case[4], case[5:8], case[8:11]
    rate, acceleration = first * np.sqrt(w), first * a + second * w
    R, d = rotation(pose[3:]), centre - payload.centre_of_mass
    nominal = mass / payload.mass * payload.inertia
    inertia = R @ (nominal - mass * (d @ d * np.eye(3) - np.outer(d, d))) @ R.T
    omega, alpha = angular_rates(pose[3:], rate[3:], acceleration[3:])
    c = R @ centre
    moved = acceleration[:3] + np.cross(alpha, c) + np.cross(omega, np.cross(omega, c))
    force = mass * (moved + disturbance - PLAIN_GRAVITY)
    moment = inertia @ alpha + np.cross(omega, inertia @ omega)
    to_pad = (R @ workcell.contacts[0].T_box_pad[:3, :3]).T
    return np.concatenate([to_pad @ force, to_pad @ moment])


def _held(
    program: Program,
    workcell: Workcell,
    case: Array,
    load: list[tuple[Terms, float]],
    commanded: int,
) -> None:
    """Wrenches of both pads, about their nominal points, that carry a load: even pressure, and at
    each point of a patch a tangential force within its friction cone."""
    axes = workcell.contacts[0].T_box_pad[:3, :3]
    arms = np.array([c.T_box_pad[:3, 3] - case[5:8] for c in workcell.contacts]) @ axes
    own = program.fresh(2)
    program.zero([({own + 1: 1.0, commanded: -1.0}, 0.0)])
    found: list[Terms] = [{} for _ in range(6)]
    for pad, (sign, contact) in enumerate(zip((1.0, -1.0), workcell.contacts, strict=True)):
        points, share = points_of(contact, *GRID)
        # Few points bear pure torsion as the disc does: their mean distance from its centre.
        mean = share @ np.linalg.norm(points, axis=1)
        points = points * (2.0 / 3.0 * contact.patch_radius / mean)
        first = program.fresh(2 * len(points))
        forces = [(own + pad, np.array([0.0, 0.0, sign]), arms[pad])]
        for k, (point, part) in enumerate(zip(points, share.tolist(), strict=True)):
            at = first + 2 * k
            bound = ({own + pad: float(case[pad]) * part}, 0.0)
            program.norm([bound, ({at: 1.0}, 0.0), ({at + 1: 1.0}, 0.0)])
            place = arms[pad] + np.array([*point, 0.0])
            forces += [(at + j, np.eye(3)[j], place) for j in (0, 1)]
        for column, force, arm in forces:
            for row, value in enumerate([*force, *np.cross(arm, force)]):
                if value:
                    found[row][column] = found[row].get(column, 0.0) - FORCE_UNIT * value
    for k in range(6):
        program.zero([(load[k][0] | found[k], load[k][1])])
