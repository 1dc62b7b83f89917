"""Lower bounds of the distance between the bodies of a cell, as CasADi expressions.

For any unit vector u, two convex bodies are at least  min_A u.x - max_B u.x  apart (a plane
across u separates them). The bound of a pair is the largest such gap over a few directions:
the axes of the environment's box, of the payload, and the world's. In an arm's own pairs, and
against round shapes of the environment, chains of spheres are used instead, or as well.
Positive means surely free by that distance; anything else means nothing. All fifteen axes of box
against box cost more than the FCL calls that they save.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.geometry.bodies import BOX, WORLD, CollisionBody, Frame
from symbolic.geometry.covers import chain_cover, close_pairs, slab_cover
from symbolic.geometry.expressions import EXACT, Softness, clean, world_placements
from symbolic.geometry.motion_bounds import motion_function
from symbolic.geometry.pairs import CellGeometry
from symbolic.geometry.pieces import Piece, SphereChain, axes_with_z, bounding_box, edges, support
from symbolic.path.rotation import rotation_matrix
from symbolic.records import Box, Capsule, Cylinder, Sphere


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


# --- the bodies of one sample ---


BOX_NUMBERS = 15
"""Length of `Scene.box_numbers`."""


class Scene:
    """The bodies of one sample; every expression is built once and shared."""

    def __init__(
        self,
        geometry: CellGeometry,
        R_box: ca.SX,
        p_box: ca.SX,
        placements: tuple[tuple[ca.SX, ca.SX], tuple[ca.SX, ca.SX]],
        softness: Softness,
    ) -> None:
        """See `clearance_expressions`."""
        self.geometry, self.soft = geometry, softness
        self._between = between_bases(geometry)
        self._placed: dict[Frame, tuple[ca.SX, ca.SX]] = {
            Frame("world"): (ca.SX.eye(3), ca.SX.zeros(3)),
            Frame("box"): (R_box, p_box),
        }
        for i, (arm, given) in enumerate(zip(geometry.arms, placements, strict=True)):
            for j, placed in enumerate(world_placements(arm.T_world_root, given)):
                self._placed[Frame("link", i, j)] = placed
        self._world = Axes("world", ca.SX.eye(3))
        self._relative: dict[tuple[Frame, str], tuple[ca.SX, ca.SX]] = {}
        self._intervals: dict[tuple[int, str], list[Interval]] = {}
        self._covers: dict[int, tuple[Piece, ...]] = {}
        self._chains: dict[int, tuple[SphereChain, list[ca.SX]]] = {}

    @cached_property
    def _close(self) -> frozenset[tuple[int, int]]:
        # Random postures are looked at: only where pairs within an arm are asked for.
        return close_pairs(self.geometry)

    def bound(self, i: int, j: int) -> ca.SX:
        """Lower bound of the distance between bodies i and j (i < j)."""
        first, second = self.geometry.bodies[i], self.geometry.bodies[j]
        if second.group == "environment":
            obstacles = [self._obstacle(i, first, piece) for piece in second.pieces]
            return self.soft.minimum_below(obstacles)
        if first.group == second.group:
            own = self._near_bound if (i, j) in self._close else self._chain_bound
            gaps = [own(i, j)]
            if first.frame.kind == "world":
                gaps.append(self._gap(self._along(i, j, self._world)))
            return self.soft.maximum_below(gaps)
        gaps = [self._gap(self._along(i, j, self._world))]
        if "payload" in (first.group, second.group):
            payload, link = (i, j) if first.group == "payload" else (j, i)
            gaps.append(self._box_bound(link, payload))
        elif self._between is not None:
            gaps.append(self._gap(self._along(i, j, self._between)[:1]))
        return self.soft.maximum_below(gaps)

    def separable(self, i: int, j: int) -> bool:
        """Whether bodies i and j (i < j) are the payload and an obstacle of one box."""
        first, second = self.geometry.bodies[i], self.geometry.bodies[j]
        return (
            first.group == "payload"
            and second.group == "environment"
            and len(second.pieces) == 1
            and isinstance(second.pieces[0].shape, Box)
        )

    def separation(self, i: int, obstacle: ca.SX, direction: ca.SX) -> ca.SX:
        """The gap between the payload, body i, and a fixed box along a direction.

        Args:
            obstacle: (BOX_NUMBERS,) of the box, see `box_numbers`; may be symbols.
            direction: (3,) unit vector from the box towards the payload.
        """
        rotation, centre = ca.reshape(obstacle[:9], 3, 3).T, obstacle[9:12]
        half = obstacle[12:]
        R, p = self._placed[self.geometry.bodies[i].frame]
        along = ca.mtimes(direction.T, R)
        ends = [
            ca.mtimes(along, ca.SX(clean(piece.centre)))
            - self._reach(ca.mtimes(along, ca.SX(clean(piece.rotation))), piece)
            for piece in self._cover(i)
        ]
        turned = ca.mtimes(direction.T, rotation)
        reach = sum(half[k] * self.soft.entry_above(turned[k]) for k in range(3))
        return self.soft.minimum_below(ends) + ca.dot(direction, p - centre) - reach

    def box_numbers(self, j: int) -> Array:
        """(BOX_NUMBERS,) of the fixed box j of a `separable` pair: its rotation (3, 3), centre (3,)
        and half edges (3,)."""
        (piece,) = self.geometry.bodies[j].pieces
        assert isinstance(piece.shape, Box)
        half = np.asarray(piece.shape.size) / 2.0
        return np.concatenate([clean(piece.rotation).ravel(), clean(piece.centre), half])

    def _along(self, i: int, j: int, axes: Axes) -> list[tuple[Interval, Interval]]:
        return list(zip(self._interval(i, axes), self._interval(j, axes), strict=True))

    def _gap(self, pairs: Sequence[tuple[Interval, Interval]]) -> ca.SX:
        """Largest separation over directions, given both bodies' intervals."""
        return self.soft.maximum_below(_gaps(pairs))

    def _interval(self, index: int, axes: Axes) -> list[Interval]:
        """Per direction the extent of a body."""
        key = (index, axes.key)
        if key not in self._intervals:
            A, offset = self._seen(self.geometry.bodies[index].frame, axes)
            ends = [self._piece_interval(A, offset, piece) for piece in self._cover(index)]
            self._intervals[key] = [
                (
                    self.soft.minimum_below([end[k][0] for end in ends]),
                    self.soft.maximum_above([end[k][1] for end in ends]),
                )
                for k in range(3)
            ]
        return self._intervals[key]

    def _piece_interval(self, A: ca.SX, offset: ca.SX, piece: Piece) -> list[Interval]:
        """Extent of a cover piece along the rows of A, its frame's origin at offset."""
        rotation, centre = ca.SX(clean(piece.rotation)), ca.SX(clean(piece.centre))
        middle = ca.mtimes(A, centre) + offset
        reach = [self._reach(ca.mtimes(A[k, :], rotation), piece) for k in range(3)]
        return [(middle[k] - reach[k], middle[k] + reach[k]) for k in range(3)]

    def _reach(self, u: ca.SX, piece: Piece) -> ca.SX:
        """Support of a piece about its centre along u (1, 3) in its own axes."""
        shape = piece.shape
        match shape:
            case Box():
                half = np.asarray(shape.size) / 2.0
                return sum((half[k] * self.soft.entry_above(u[k]) for k in range(3)), ca.SX(0))
            case Cylinder():
                axial = self.soft.entry_above(u[2]) * (shape.length / 2.0)
                return axial + shape.radius * self.soft.cosine_above(u[2])
            case Sphere():
                return ca.SX(shape.radius)
            case Capsule():
                return self.soft.entry_above(u[2]) * (shape.length / 2.0) + shape.radius
            case _:
                raise AssertionError("a cover has no hulls")

    def _seen(self, frame: Frame, axes: Axes) -> tuple[ca.SX, ca.SX]:
        """Rotation and position of a frame in coordinates along the axes."""
        key = (frame, axes.key)
        if key not in self._relative:
            R, p = self._placed[frame]
            turned = ca.SX.eye(3) if axes.key == str(frame) else ca.mtimes(axes.A, R)
            self._relative[key] = (turned, ca.mtimes(axes.A, p))
        return self._relative[key]

    def _own_axes(self, frame: Frame) -> Axes:
        return Axes(str(frame), self._placed[frame][0].T)

    def _cover(self, index: int) -> tuple[Piece, ...]:
        if index not in self._covers:
            self._covers[index] = slab_cover(self.geometry.bodies[index])
        return self._covers[index]

    def _chain(self, index: int) -> tuple[list[ca.SX], float]:
        """Centres in the world and the radius of a body's chain of spheres."""
        if index not in self._chains:
            body = self.geometry.bodies[index]
            chain = chain_cover(body)
            R, p = self._placed[body.frame]
            centres = [ca.mtimes(R, ca.SX(clean(centre))) + p for centre in chain.centres]
            self._chains[index] = (chain, centres)
        chain, centres = self._chains[index]
        return centres, chain.radius

    def _nearest(self, squared: Sequence[ca.SX]) -> ca.SX:
        """Root of the least of some squared distances."""
        if self.soft.width:
            return self.soft.minimum_below([self.soft.norm_below(s) for s in squared])
        return self.soft.norm_below(self.soft.minimum_below(squared))

    def _chain_bound(self, i: int, j: int) -> ca.SX:
        """Two chains of spheres: distance of the nearest centres less both radii."""
        (first, r_1), (second, r_2) = self._chain(i), self._chain(j)
        return self._nearest([ca.sumsqr(a - b) for a in first for b in second]) - (r_1 + r_2)

    def _near_bound(self, i: int, j: int) -> ca.SX:
        """Piece by piece, along the axes of the first body's frame."""
        frame = self.geometry.bodies[i].frame
        axes = self._own_axes(frame)
        origin = self._seen(frame, axes)[1]
        A, offset = self._seen(self.geometry.bodies[j].frame, axes)
        moving = [self._piece_interval(A, offset - origin, piece) for piece in self._cover(j)]
        still = [fixed_intervals(piece, np.eye(3)) for piece in self._cover(i)]
        return self.soft.minimum_below(
            [self._gap(list(zip(own, other, strict=True))) for own in still for other in moving]
        )

    def _box_bound(self, link: int, payload: int) -> ca.SX:
        """A chain of spheres against the payload's box, or the one that holds its pieces."""
        pieces = self.geometry.bodies[payload].pieces
        box = pieces[0] if len(pieces) == 1 else bounding_box(pieces, np.eye(3))
        if not isinstance(box.shape, Box):
            box = bounding_box(pieces, np.eye(3))
        assert isinstance(box.shape, Box)
        half = np.asarray(box.shape.size) / 2.0
        R, p = self._placed[Frame("box")]
        if box.centre.any():
            p = p + ca.mtimes(R, ca.DM(box.centre))
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

    def _obstacle(self, index: int, body: CollisionBody, piece: Piece) -> ca.SX:
        """A moving body against one fixed piece."""
        gaps = [self._gap(self._obstacle_intervals(index, body, piece))]
        if isinstance(piece.shape, Cylinder | Sphere | Capsule):
            gaps.append(self._round_bound(index, piece))
        return self.soft.maximum_below(gaps)

    def _obstacle_intervals(
        self, index: int, body: CollisionBody, piece: Piece
    ) -> list[tuple[Interval, Interval]]:
        """Extents of a moving body and of a fixed piece along the directions that matter."""
        axes = self._axes_of(piece)
        fixed = fixed_intervals(piece, np.array(ca.DM(axes.A)))
        pairs = list(zip(self._interval(index, axes), fixed, strict=True))
        if body.frame.kind == "box" or slanted_matters(body, piece):
            own = self._own_axes(body.frame)
            cover = slab_cover(CollisionBody("", "environment", Frame("world"), (piece,)))[0]
            still = self._piece_interval(own.A, ca.SX.zeros(3), cover)
            pairs += list(zip(self._interval(index, own), still, strict=True))
        return pairs

    def _axes_of(self, piece: Piece) -> Axes:
        """A fixed box's own axes; the world's where they agree or the piece is no box."""
        R = clean(piece.rotation)
        if not isinstance(piece.shape, Box) or np.allclose(np.abs(R).max(axis=0), 1.0):
            return self._world
        return Axes(f"fixed {R.tolist()}", ca.SX(R.T))

    def _round_bound(self, index: int, piece: Piece) -> ca.SX:
        """A chain of spheres against a fixed cylinder, capsule or sphere."""
        centres, radius = self._chain(index)
        T = clean(np.asarray(np.linalg.inv(piece.pose), dtype=float))
        shape = piece.shape
        bounds = []
        for centre in centres:
            local = ca.mtimes(ca.SX(T[:3, :3]), centre) + T[:3, 3]
            if isinstance(shape, Sphere):
                bounds.append(self.soft.norm_below(ca.sumsqr(local)) - shape.radius)
                continue
            assert isinstance(shape, Cylinder | Capsule)
            cap = shape.radius if isinstance(shape, Capsule) else 0.0
            radial = self.soft.norm_below(ca.sumsqr(local[:2])) - shape.radius
            axial = self.soft.absolute_below(local[2]) - shape.length / 2.0 - cap
            bounds.append(self.soft.maximum_below([radial, axial]))
        return self.soft.minimum_below(bounds) - radius


def _gaps(pairs: Sequence[tuple[Interval, Interval]]) -> list[ca.SX]:
    """Gaps between two intervals, either one below the other, for all given pairs of them."""
    return [gap for a, b in pairs for gap in (a[0] - b[1], b[0] - a[1])]


# --- directions of comparison ---


Interval = tuple[ca.SX, ca.SX]
"""Least and largest coordinate along a direction."""


LONG = 0.25
"""Bodies longer than wide by more than this [m] are also compared along their own axes: across
the world's axes, a slanted body seems wider by up to that much."""


VAST = 2.0
"""Obstacles this many times as wide as a body is long (a floor) need no such comparison."""


@dataclass(frozen=True)
class Axes:
    """Three orthogonal directions: rows of A (3, 3)."""

    key: str
    A: ca.SX


def slanted_matters(body: CollisionBody, obstacle: Piece) -> bool:
    """Whether a body is long, and the obstacle no plane for it."""
    _, width, length = edges(body.pieces)
    return bool(length - width > LONG and edges((obstacle,))[1] < VAST * length)


def between_bases(geometry: CellGeometry) -> Axes | None:
    """Axes whose first points from one robot's base to the other's; None if the world's do."""
    first, second = (arm.T_world_root[:3, 3] for arm in geometry.arms)
    along = second - first
    distance = float(np.linalg.norm(along))
    if distance < 1e-6 or np.max(np.abs(along)) > 0.99 * distance:
        return None
    return Axes("between", ca.SX(clean(axes_with_z(along / distance)[:, [2, 0, 1]].T)))


def fixed_intervals(piece: Piece, A: Array) -> list[Interval]:
    """Along the rows of A (3, 3), of a piece that does not move."""
    high, low = support(piece, A), -support(piece, -A)
    return [(ca.SX(low[k]), ca.SX(high[k])) for k in range(3)]
