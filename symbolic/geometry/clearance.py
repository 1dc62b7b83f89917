"""Lower bounds of the distance between the bodies of a cell, and bounds of their motion between two
samples, as CasADi expressions.

For any unit vector u, two convex bodies are at least  min_A u.x - max_B u.x  apart (a plane across
u separates them). The bound of a pair is the largest such gap over a few directions: the axes of
the environment's box, of the payload, and of the world. For pairs of one arm, and against round
shapes of the environment, chains of spheres are used instead or in addition. A positive bound
proves that the bodies are apart by this distance; any other bound proves nothing. All fifteen axes
of box against box would cost more than the FCL calls that they save.

Between two samples the joints and the box's position and angles change linearly. A point x(s) of a
body, 0 <= s <= 1, then stays within

  |x(s) - x(0)| <= s D + s (1 - s) / 2 K,      |x(s) - x(1)| <= (1 - s) D + s (1 - s) / 2 K,

where the chord D bounds |x(1) - x(0)| and the bend K bounds |x''|. For the bodies of an arm,

  |x''| <= sum_ij |dq_i| |dq_j| r_max(i,j),

with r_j the largest distance of the body's points from the axis of joint j. For a sliding joint r_j
= 1, and in x'' it counts only together with turning joints before it: motion along a fixed line
does not bend. For the box |x''| <= r (sum_i |da_i|)^2, with da_i the steps of its three numbers:
for angles as for joints, and for a rotation vector v = v_0 + s d by Duhamel's formula, |exp(v)''| =
2 |integral of exp d exp d exp over a triangle of area 1/2| <= |d|^2.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.expression import named_function, number, sx_parameters
from symbolic.geometry.bodies import BOX, WORLD, CollisionBody, Frame
from symbolic.geometry.expressions import EXACT, Softness, clean, quaternion, world_placements
from symbolic.geometry.pairs import CellGeometry
from symbolic.geometry.screen import (
    CoverSolid,
    Obstacle,
    Reach,
    Screen,
    ScreenBody,
    columns,
    screen_of,
    turned,
)
from symbolic.path.rotation import rotation_matrix
from symbolic.records import Box, Capsule, Cylinder, Sphere


def screening_functions(
    geometry: CellGeometry,
    joint_placements: tuple[ca.Function, ca.Function],
    softness: Softness = EXACT,
    screen: Screen | None = None,
) -> dict[str, ca.Function]:
    """Build the functions that collision checking calls, by name.

    All take one sample: pose (6,) of the box, joint positions q_1 and q_2 (n,) [m, rad].

    - clearance returns lower bounds (n_near,) [m] of the distances of the near pairs, the first
      `CellGeometry.near` of `CellGeometry.possible`, in order.
    - far_clearance returns lower bounds of the distances of the other possible pairs [m]. It exists
      only if there are any.
    - piece_poses returns the poses in the world of all pieces of all bodies, in the order of the
      bodies: quaternions (4, n_pieces) as w x y z, and positions (3, n_pieces) [m].
    - motion and far_motion are the functions of `motion_function` for the near and for the other
      pairs. They take two samples.

    Args:
        geometry: bodies and pairs of the cell.
        joint_placements: the function `RobotModel.joint_placements` of each robot.
        softness: `EXACT` for screening; `Softness(width)` for smooth bounds that are lower by a few
            widths [m].
        screen: constants of the bodies and pairs for the bounds, as arrays or symbols; None to
            compute them from `geometry`.
    """
    screen = screen_of(geometry) if screen is None else screen
    pose = ca.SX.sym("pose", 6)
    q = [ca.SX.sym(f"q_{i}", arm.joints) for i, arm in enumerate(geometry.arms, start=1)]
    R, p = rotation_matrix(geometry.workcell.task.orientation, pose[3:]), pose[:3]
    first, second = (joint_placements[i](q[i]) for i in (0, 1))
    scene = DistanceBounds(screen, R, p, (first, second), softness)
    placed = {BOX: (R, p)}
    for i, base in enumerate(screen.bases):
        for j, joint in enumerate(world_placements(base, (first, second)[i])):
            placed[Frame("link", i, j)] = joint
    poses = [
        _piece_pose(placed.get(body.frame), *piece)
        for body in screen.bodies
        for piece in body.pieces
    ]
    given = sx_parameters(screen)
    inputs, names = [pose, *q, *given.values()], ["pose", "q_1", "q_2", *given]
    outputs = [ca.horzcat(*column) for column in zip(*poses, strict=True)]
    found = {
        "piece_poses": ca.Function(
            "piece_poses", inputs, outputs, names, ["quaternions", "positions"], {"cse": True}
        )
    }
    for name, pairs in geometry.blocks.items():
        bounds = ca.vertcat(*[scene.bound(pair) for pair in pairs])
        found[f"{name}clearance"] = ca.Function(
            f"{name}clearance", inputs, [bounds], names, ["clearance"], {"cse": True}
        )
        found[f"{name}motion"] = motion_function(
            geometry, joint_placements, screen, f"{name}motion", pairs
        )
    return found


def _piece_pose(placed: tuple[ca.SX, ca.SX] | None, turn: Any, centre: Any) -> tuple[ca.SX, ca.SX]:
    """Compute orientation and position of a piece of a body in the world.

    Args:
        placed: world pose of the body's frame: rotation (3, 3) and position (3,) [m]. None for a
            fixed body, whose pieces are given in the world.
        turn: orientation of the piece. For a moving body: rotation matrix (3, 3) in the body's
            frame, None for the identity. For a fixed body: unit quaternion (4,), w x y z, in the
            world.
        centre: (3,) centre of the piece [m], in the body's frame or, for a fixed body, in the
            world.

    Returns:
        Unit quaternion (4,), w x y z, and position (3,) [m], both in the world.
    """
    position = ca.SX(number(centre))
    if placed is None:
        return ca.SX(number(turn)), position
    R, p = placed
    return quaternion(R if turn is None else ca.mtimes(R, turned(turn))), ca.mtimes(R, position) + p


# --- the bodies of one sample ---


BOX_NUMBERS = 15
"""Number of entries of `box_numbers`."""


def box_numbers(body: CollisionBody) -> Array:
    """Return rotation (3, 3), centre (3,) and half edges (3,) of a fixed box in the world, one
    after the other, as an array (BOX_NUMBERS,) [m]."""
    (piece,) = body.pieces
    assert isinstance(piece.shape, Box)
    half = np.asarray(piece.shape.size) / 2.0
    return np.concatenate([clean(piece.rotation).ravel(), clean(piece.centre), half])


class DistanceBounds:
    """Builder of distance bounds at one sample, as expressions. Each expression is built once."""

    def __init__(
        self,
        screen: Screen,
        R_box: ca.SX,
        p_box: ca.SX,
        placements: tuple[tuple[ca.SX, ca.SX], tuple[ca.SX, ca.SX]],
        softness: Softness,
    ) -> None:
        """Store the placements; expressions are built on demand.

        Args:
            screen: constants of the cell's bodies and pairs, as arrays or symbols.
            R_box, p_box: (3, 3) rotation and (3,) position [m] of the box in the world.
            placements: for each robot the rotations (3, 3 n) and positions (3, n) [m] of the joint
                frames in the root, side by side, from `RobotModel.joint_placements`.
            softness: `EXACT`, or the width of smooth bounds.
        """
        self.screen, self.soft = screen, softness
        self._placed: dict[Frame, tuple[ca.SX, ca.SX]] = {
            WORLD: (ca.SX.eye(3), ca.SX.zeros(3)),
            BOX: (R_box, p_box),
        }
        for i, (base, given) in enumerate(zip(screen.bases, placements, strict=True)):
            rotation, position = ca.SX(number(base.rotation)), ca.SX(number(base.position))
            self._placed[Frame("world", i)] = rotation, position
            for j, placed in enumerate(world_placements(base, given)):
                self._placed[Frame("link", i, j)] = placed
        self._world = Axes("world", ca.SX.eye(3))
        self._between = None if screen.between is None else Axes("between", turned(screen.between))
        self._relative: dict[tuple[Frame, str], tuple[ca.SX, ca.SX]] = {}
        self._intervals: dict[tuple[int, str], list[Interval]] = {}
        self._chains: dict[int, list[ca.SX]] = {}

    def bound(self, pair: int) -> ca.SX:
        """Compute a lower bound [m] of the distance between the two bodies of a pair.

        Args:
            pair: index of the pair among the possible pairs.
        """
        i, j = self.screen.pairs[pair]
        first, second = self.screen.bodies[i], self.screen.bodies[j]
        if second.obstacles:
            obstacles = [self._obstacle(i, j, k) for k in range(len(second.obstacles))]
            return self.soft.minimum_below(obstacles)
        if first.group == second.group:
            own = self._near_bound if self.screen.own[pair] else self._chain_bound
            gaps = [own(i, j)]
            if first.frame.kind == "world":
                gaps.append(self._gap(self._along(i, j, self._world)))
            return self.soft.maximum_below(gaps)
        gaps = [self._gap(self._along(i, j, self._world))]
        if "payload" in (first.group, second.group):
            gaps.append(self._box_bound(j if first.group == "payload" else i))
        elif self._between is not None:
            gaps.append(self._gap(self._along(i, j, self._between)[:1]))
        return self.soft.maximum_below(gaps)

    def separable(self, pair: int) -> bool:
        """Return True if a pair of bodies allows constraints by separating directions
        (`separation`): the payload and a body of the environment that is a single box.

        Args:
            pair: index of the pair among the possible pairs.
        """
        first, second = (self.screen.bodies[body] for body in self.screen.pairs[pair])
        kinds = [obstacle.kind for obstacle in second.obstacles]
        return first.group == "payload" and kinds == [Box]

    def separation(self, obstacle: ca.SX, direction: ca.SX) -> ca.SX:
        """Compute a lower bound of the gap between the payload and a fixed box along a direction
        [m].

        Args:
            obstacle: (BOX_NUMBERS,) rotation row by row, centre and half edges of the fixed box in
                the world, as from `box_numbers`; may be symbols.
            direction: (3,) unit vector in the world, from the fixed box towards the payload.
        """
        rotation, centre = ca.reshape(obstacle[:9], 3, 3).T, obstacle[9:12]
        half = obstacle[12:]
        R, p = self._placed[BOX]
        along = ca.mtimes(direction.T, R)
        payload = next(body for body in self.screen.bodies if body.group == "payload")
        ends = [
            ca.mtimes(along, ca.SX(number(piece.centre)))
            - self._reach(ca.mtimes(along, turned(piece.rotation)), piece)
            for piece in payload.cover
        ]
        across = ca.mtimes(direction.T, rotation)
        reach = sum(half[k] * self.soft.entry_above(across[k]) for k in range(3))
        return self.soft.minimum_below(ends) + ca.dot(direction, p - centre) - reach

    def _along(self, i: int, j: int, axes: Axes) -> list[tuple[Interval, Interval]]:
        return list(zip(self._interval(i, axes), self._interval(j, axes), strict=True))

    def _gap(self, pairs: Sequence[tuple[Interval, Interval]]) -> ca.SX:
        """Compute a lower bound of the distance of two bodies [m]: the largest gap between their
        intervals over several directions.

        Args:
            pairs: for each direction the intervals (least, largest coordinate) of the first and of
                the second body along it [m].
        """
        return self.soft.maximum_below(_gaps(pairs))

    def _interval(self, index: int, axes: Axes) -> list[Interval]:
        """Compute the least and largest coordinate of body `index` along three directions `axes`
        [m]."""
        key = (index, axes.key)
        body = self.screen.bodies[index]
        if body.extent is not None and axes is self._world:
            return _ends(body.extent, 0)
        if key not in self._intervals:
            A, offset = self._seen(body.frame, axes)
            ends = [self._piece_interval(A, offset, piece) for piece in body.cover]
            self._intervals[key] = [
                (
                    self.soft.minimum_below([end[k][0] for end in ends]),
                    self.soft.maximum_above([end[k][1] for end in ends]),
                )
                for k in range(3)
            ]
        return self._intervals[key]

    def _piece_interval(self, A: ca.SX, offset: ca.SX, piece: CoverSolid) -> list[Interval]:
        """Compute the least and largest coordinate of a piece along three directions [m].

        Args:
            A: (3, 3) the directions as rows, in the axes of the piece's frame.
            offset: (3,) coordinates of the frame's origin along the directions [m].
            piece: a piece of a cover, a union of simple shapes that contains the body.
        """
        middle = ca.mtimes(A, ca.SX(number(piece.centre))) + offset
        seen = A if piece.rotation is None else ca.mtimes(A, turned(piece.rotation))
        reach = [self._reach(seen[k, :], piece) for k in range(3)]
        return [(middle[k] - reach[k], middle[k] + reach[k]) for k in range(3)]

    def _reach(self, u: ca.SX, piece: CoverSolid) -> ca.SX:
        """Compute the largest distance of a piece's points from its centre along a direction [m].

        Args:
            u: (1, 3) unit vector in the piece's own axes.
            piece: a piece of a cover, a union of simple shapes that contains the body.
        """
        size = ca.SX(number(piece.size))
        if piece.kind is Box:
            return sum((size[k] * self.soft.entry_above(u[k]) for k in range(3)), ca.SX(0))
        if piece.kind is Sphere:
            return size[0]
        axial = self.soft.entry_above(u[2]) * size[1]
        if piece.kind is Cylinder:
            return axial + size[0] * self.soft.cosine_above(u[2])
        return axial + size[0]

    def _seen(self, frame: Frame, axes: Axes) -> tuple[ca.SX, ca.SX]:
        """Compute the pose of a frame in coordinates along three directions: rotation (3, 3), and
        position (3,) of its origin relative to the world's [m].

        Args:
            frame: the frame.
            axes: the directions.
        """
        key = (frame, axes.key)
        if key not in self._relative:
            R, p = self._placed[frame]
            rotation = ca.SX.eye(3) if axes.key == str(frame) else ca.mtimes(axes.A, R)
            self._relative[key] = (rotation, ca.mtimes(axes.A, p))
        return self._relative[key]

    def _own_axes(self, frame: Frame) -> Axes:
        return Axes(str(frame), self._placed[frame][0].T)

    def _chain(self, index: int) -> tuple[list[ca.SX], ca.SX]:
        """Compute the world positions of the equal spheres in a row that enclose a body: centres
        (3,) and their common radius [m].

        Args:
            index: index of the body.
        """
        body = self.screen.bodies[index]
        assert body.chain is not None, "obstacles have no chains"
        if index not in self._chains:
            R, p = self._placed[body.frame if body.extent is None else WORLD]
            centres = columns(body.chain.centres)
            self._chains[index] = [ca.mtimes(R, centre) + p for centre in centres]
        return self._chains[index], ca.SX(number(body.chain.radius))

    def _nearest(self, squared: Sequence[ca.SX]) -> ca.SX:
        """Compute the smallest of several distances [m], or a smooth lower bound of it, from their
        squares [m^2]."""
        if self.soft.width:
            return self.soft.minimum_below([self.soft.norm_below(s) for s in squared])
        return self.soft.norm_below(self.soft.minimum_below(squared))

    def _chain_bound(self, i: int, j: int) -> ca.SX:
        """Return a lower bound of the distance of bodies i and j, each enclosed in a row of spheres
        [m].

        The bound is the distance of the nearest centres minus both radii.
        """
        (first, r_1), (second, r_2) = self._chain(i), self._chain(j)
        return self._nearest([ca.sumsqr(a - b) for a in first for b in second]) - (r_1 + r_2)

    def _near_bound(self, i: int, j: int) -> ca.SX:
        """Return a lower bound of the distance of bodies i and j, piece by piece [m].

        The pieces are compared along the axes of body i's frame, or of the world if body i is
        fixed.
        """
        first, second = self.screen.bodies[i], self.screen.bodies[j]
        stands = first.extent is not None
        axes = self._world if stands else self._own_axes(first.frame)
        A, offset = self._seen(second.frame, axes)
        if not stands:
            offset = offset - self._seen(first.frame, axes)[1]
        moving = [self._piece_interval(A, offset, piece) for piece in second.cover]
        own, zero = ca.SX.eye(3), ca.SX.zeros(3)
        still = [
            _ends(first.extent, k) if stands else self._piece_interval(own, zero, piece)
            for k, piece in enumerate(first.cover, start=1)
        ]
        return self.soft.minimum_below(
            [self._gap(list(zip(one, other, strict=True))) for one in still for other in moving]
        )

    def _box_bound(self, link: int) -> ca.SX:
        """Return a lower bound of the distance between a link's spheres and the payload's bounding
        box [m].

        Args:
            link: index of the link among the bodies.
        """
        box = self.screen.payload
        half, (R, p) = ca.SX(number(box.size)), self._placed[BOX]
        if isinstance(box.centre, ca.SX) or box.centre.any():
            p = p + ca.mtimes(R, number(box.centre))
        centres, radius = self._chain(link)
        squared = []
        for centre in centres:
            local = ca.mtimes(R.T, centre - p)
            beyond = [
                self.soft.ramp_above(self.soft.absolute_below(local[k]) - half[k]) for k in range(3)
            ]
            squared.append(ca.sumsqr(ca.vertcat(*beyond)))
        # Each of the three ramps may stand half a width above the true one.
        return self._nearest(squared) - radius - 3**0.5 / 2.0 * self.soft.width

    def _obstacle(self, index: int, other: int, k: int) -> ca.SX:
        """Return a lower bound of the distance between a moving body and one piece of an obstacle
        [m]: the largest gap along the world's or the piece's axes and, for elongated bodies, along
        the body's own axes. For a round piece the distance to the body's spheres counts too.

        Args:
            index: index of the moving body among all bodies.
            other: index of the obstacle among all bodies.
            k: index of the piece among the obstacle's pieces.
        """
        body, obstacle = self.screen.bodies[index], self.screen.bodies[other].obstacles[k]
        axes = self._world
        if obstacle.axes is not None:
            axes = Axes(f"obstacle {other} {k}", turned(obstacle.axes))
        pairs = list(zip(self._interval(index, axes), _ends(obstacle.extent, 0), strict=True))
        if body.slanted:
            own = self._own_axes(body.frame)
            still = self._piece_interval(own.A, ca.SX.zeros(3), obstacle.cover)
            pairs += list(zip(self._interval(index, own), still, strict=True))
        gaps = [self._gap(pairs)]
        if obstacle.kind in (Cylinder, Sphere, Capsule):
            gaps.append(self._round_bound(index, obstacle))
        return self.soft.maximum_below(gaps)

    def _round_bound(self, index: int, obstacle: Obstacle) -> ca.SX:
        """Return a lower bound of the distance between a moving body's spheres and a round obstacle
        [m].

        Args:
            index: index of the moving body.
            obstacle: a fixed cylinder, capsule or sphere.
        """
        centres, radius = self._chain(index)
        offset, size = number(obstacle.offset), ca.SX(number(obstacle.cover.size))
        bounds = []
        for centre in centres:
            local = ca.mtimes(turned(obstacle.to_own), centre) + offset
            if obstacle.kind is Sphere:
                bounds.append(self.soft.norm_below(ca.sumsqr(local)) - size[0])
                continue
            cap = size[0] if obstacle.kind is Capsule else 0.0
            radial = self.soft.norm_below(ca.sumsqr(local[:2])) - size[0]
            axial = self.soft.absolute_below(local[2]) - size[1] - cap
            bounds.append(self.soft.maximum_below([radial, axial]))
        return self.soft.minimum_below(bounds) - radius


def _ends(extent: Any, k: int) -> list[Interval]:
    """Return the intervals of a body or piece along three directions, each as (least, largest
    coordinate) [m].

    Args:
        extent: (2 m, 3) coordinates of m bodies or pieces [m]. Rows 2 k and 2 k + 1 hold the least
            and largest coordinates of number k along the directions.
        k: index of the body or piece.
    """
    rows = ca.SX(number(extent))
    return [(rows[2 * k, d], rows[2 * k + 1, d]) for d in range(3)]


def _gaps(pairs: Sequence[tuple[Interval, Interval]]) -> list[ca.SX]:
    """Compute two gaps [m] for each pair of intervals: from the second interval up to the first,
    and from the first up to the second. A gap is negative if the intervals overlap."""
    return [gap for a, b in pairs for gap in (a[0] - b[1], b[0] - a[1])]


Interval = tuple[ca.SX, ca.SX]
"""Least and largest coordinate along a direction."""


@dataclass(frozen=True)
class Axes:
    """Three orthogonal directions.

    Attributes:
        key: name of the directions, under which results are cached.
        A: (3, 3) the directions as rows, in the world.
    """

    key: str
    A: ca.SX


def motion_function(
    geometry: CellGeometry,
    joint_placements: tuple[ca.Function, ca.Function],
    screen: Screen,
    name: str,
    pairs: Iterable[int],
) -> ca.Function:
    """Build the function that bounds how pairs of bodies move relative to each other between two
    configurations a and b.

    Inputs: pose_a (6,), q_1_a, q_2_a (n,), then pose_b, q_1_b, q_2_b [m, rad]. Outputs: chord and
    bend (n_pairs,) [m], each the sum of two bounds, one per body of the pair. A body's chord bounds
    the distance between the positions of any of its points in a and b. A body's bend bounds the
    second derivative of the point's path from a to b, for a path parameter that runs from 0 to 1.

    Two links of one arm are an exception: chord bounds the length of the path of the later link's
    points in the frame of the earlier link, and bend is zero.

    Args:
        geometry: bodies and pairs of the cell.
        joint_placements: the function `RobotModel.joint_placements` of each robot.
        screen: constants of the bodies, as arrays or symbols.
        name: name of the new function.
        pairs: indices among the possible pairs.
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
    given = sx_parameters(screen)
    names = [f"{what}_{end}" for end in ("a", "b") for what in ("pose", "q_1", "q_2")]
    inputs = dict(zip(names, (*inputs_a, *inputs_b), strict=True)) | given
    return named_function(name, inputs, {"chord": ca.vertcat(*chords), "bend": ca.vertcat(*bends)})


def _body_motion(
    screen: Screen,
    body: ScreenBody,
    placed_a: dict[Frame, tuple[ca.SX, ca.SX]],
    placed_b: dict[Frame, tuple[ca.SX, ca.SX]],
    steps: list[ca.SX],
) -> tuple[ca.SX, ca.SX]:
    """Compute two bounds of a body's motion between two configurations a and b: chord and bend [m].

    The chord bounds the distance between the positions of any point of the body in a and b. The
    bend bounds the second derivative of the point's path from a to b, for a path parameter that
    runs from 0 to 1.

    Args:
        screen: constants of the bodies, as arrays or symbols.
        body: the body.
        placed_a, placed_b: rotation (3, 3) and position (3,) [m] of every frame in the world, in
            configuration a and b.
        steps: absolute changes from a to b of box pose (6,), q_1 and q_2 (n,).
    """
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
    """Compute an upper bound of the length of the path of a link's points in the frame of an
    earlier link of the same arm [m].

    Args:
        first, second: the earlier and the later link.
        step: (n,) absolute changes of the arm's joint positions [rad or m].
    """
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
