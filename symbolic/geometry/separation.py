"""Distances between bodies, and bounds of motion that keep two bodies apart at all joint positions.

Coal measures the distances of convex pieces. A bound encloses a body in a zone that contains it at
all positions of the joints between the two bodies.
"""

from __future__ import annotations

from functools import cache, lru_cache
from math import hypot

import coal
import numpy as np
import pinocchio as pin

from symbolic.array import Array
from symbolic.geometry.bodies import ArmGeometry, CollisionBody, Frame
from symbolic.geometry.pieces import (
    Hull,
    Piece,
    ball,
    farthest_from_axis,
    farthest_from_point,
    swept_cylinder,
)
from symbolic.records import Box, Capsule, Cylinder, Sphere
from symbolic.records.content import CacheKey


def anchor(body: CollisionBody, arms: tuple[ArmGeometry, ArmGeometry], robot: int) -> CollisionBody:
    """Return a body with a frame that does not depend on the other arm: a held box becomes a copy
    that is fixed to the last link of one arm. Any other body is returned unchanged.

    Args:
        body: the body.
        arms: joints of both arms.
        robot: index of the arm to which the box is fixed.
    """
    if body.frame.kind != "box":
        return body
    known = body.content, arms[robot].content, robot
    return _anchored(CacheKey(body, arms[robot], robot, known=known))


@lru_cache(maxsize=16)
def _anchored(seen: CacheKey) -> CollisionBody:
    body, arm, robot = seen.given
    pieces = tuple(piece.moved(arm.T_joint_box) for piece in body.pieces)
    return CollisionBody(body.name, body.group, Frame("link", robot, arm.joints - 1), pieces)


def moving_arms(a: CollisionBody, b: CollisionBody) -> tuple[int, ...]:
    """Return the indices of the arms, 0 or 1, that may move bodies a and b relative to each other.
    If one body is the payload, these are both arms."""
    if "box" in (a.frame.kind, b.frame.kind):
        return (0, 1)
    return tuple(robot for robot in (0, 1) if robot in (a.frame.robot, b.frame.robot))


def sorted_by_joint(
    a: CollisionBody, b: CollisionBody, arms: tuple[ArmGeometry, ArmGeometry], robot: int
) -> tuple[CollisionBody, CollisionBody]:
    """Return two bodies in the order of the joints that carry them, the earlier joint first.

    Args:
        a, b: the bodies.
        arms: joints of both arms.
        robot: index of the arm to whose last joint a held box counts as fixed (`anchor`).
    """
    left, right = anchor(a, arms, robot), anchor(b, arms, robot)
    return (left, right) if left.frame.joint <= right.frame.joint else (right, left)


def out_of_reach(
    a: CollisionBody,
    b: CollisionBody,
    arms: tuple[ArmGeometry, ArmGeometry],
    tolerance: float,
) -> str:
    """Return the reason to exclude two bodies that no joint positions bring together; '' for other
    pairs.

    Each moving body is enclosed in a zone that contains all its poses. The pair is excluded if the
    gap of the zones exceeds the tolerance.

    Args:
        a, b: the bodies.
        arms: joints of both arms.
        tolerance: distance up to which the bodies count as colliding [m].
    """
    margin = tolerance + 1e-3
    if {a.frame.robot, b.frame.robot} == {0, 1}:
        zones = [_zone(body, arms[body.frame.robot], -1) for body in (a, b)]
        gap = _gap(zones[0], (zones[1],))
        return f"out of reach: their zones stay {1e3 * gap:.0f} mm apart" if gap > margin else ""
    for robot in moving_arms(a, b):
        low, high = sorted_by_joint(a, b, arms, robot)
        if high.frame.robot != robot or low.frame.robot not in (robot, -1):
            continue
        gap = _gap(_zone(high, arms[robot], low.frame.joint), low.pieces)
        if gap > margin:
            return f"out of reach: the zone of {high.name} stays {1e3 * gap:.0f} mm away"
    return ""


def _gap(zone: Piece, pieces: tuple[Piece, ...]) -> float:
    """Compute the distance [m] between a region and several pieces; at most 0 if they meet.

    Args:
        zone: the region.
        pieces: the pieces, in the frame of the region.
    """
    if isinstance(zone.shape, Sphere):
        return min(_from_point(p, zone.centre) for p in pieces) - zone.shape.radius
    return coal_distance((zone,), pieces)


def _from_point(piece: Piece, point: Array) -> float:
    """Compute the distance [m] of a point (3,) from a piece; at most 0 if the point is inside.
    Point and piece are in one frame."""
    x, y, z = ((point - piece.centre) @ piece.rotation).tolist()
    shape = piece.shape
    match shape:
        case Box():
            a, b, c = shape.size.tolist()
            beyond = abs(x) - a / 2.0, abs(y) - b / 2.0, abs(z) - c / 2.0
            return hypot(*(max(v, 0.0) for v in beyond))
        case Cylinder():
            over = abs(z) - shape.length / 2.0
            return hypot(max(hypot(x, y) - shape.radius, 0.0), max(over, 0.0))
        case Capsule():
            return hypot(x, y, max(abs(z) - shape.length / 2.0, 0.0)) - shape.radius
        case Sphere():
            return hypot(x, y, z) - shape.radius
        case Hull():
            return coal_distance((ball(point, 0.0),), (piece,))


def never_meet(
    a: CollisionBody,
    b: CollisionBody,
    arms: tuple[ArmGeometry, ArmGeometry],
    tolerance: float,
) -> str:
    """Return the reason to exclude two bodies that collide at no position of the two joints between
    them; '' for other pairs.

    The body behind the second joint is replaced by the cylinder that it sweeps about this joint's
    axis. The range of the first joint is cut into intervals. An interval is free of collisions if
    the distance at its middle, minus the largest motion of the cylinder within half the interval,
    exceeds the tolerance.

    Args:
        a, b: the bodies.
        arms: joints of both arms.
        tolerance: distance up to which the bodies count as colliding [m].
    """
    for robot in moving_arms(a, b):
        arm, (low, high) = arms[robot], sorted_by_joint(a, b, arms, robot)
        if high.frame.robot != robot or high.frame.joint - low.frame.joint != 2:
            continue
        own = low.frame.robot == robot or low.group == f"robot {robot + 1}"
        if not own and low.carries is None:
            continue
        first = low.frame.joint + 1
        if not all(arm.turning[first : first + 2]):
            continue
        swept = _zone(high, arm, first)
        reach = farthest_from_axis(swept, np.zeros(3), arm.axes[first])
        turn = min(float(arm.upper[first] - arm.lower[first]), 2.0 * np.pi)
        ranges = [(float(arm.lower[first]), float(arm.lower[first]) + turn)]
        least = np.inf
        while ranges:
            start, end = ranges.pop()
            q = np.zeros(arm.joints)
            q[first] = (start + end) / 2.0
            T = relative_placement(arm, low.frame.joint, first, q)
            gap = coal_distance((swept.moved(T),), low.pieces)
            if gap <= tolerance + 1e-3:
                return ""
            kept = gap - reach * (end - start) / 2.0
            if kept > tolerance:
                least = min(least, kept)
            else:
                ranges += [(start, q[first]), (q[first], end)]
        return f"never meet: at least {1e3 * least:.1f} mm apart at all positions of both joints"
    return ""


def _zone(body: CollisionBody, arm: ArmGeometry, below: int) -> Piece:
    """Return a region that contains a body of an arm at all positions of the joints after the joint
    `below`, up to the body's own joint.

    If this is one turning joint, the region is the cylinder that the body sweeps about the joint's
    axis. Otherwise it is a ball about the first of the joints, with the length of the stretched
    links as radius.

    Args:
        body: a body of the arm.
        arm: joints of the arm.
        below: index of the joint in whose frame the region is returned; -1 for the world.
    """
    return _zone_of(CacheKey(body, arm, below, known=(body.content, arm.content, below)))


@lru_cache(maxsize=256)
def _zone_of(seen: CacheKey) -> Piece:
    body, arm, below = seen.given
    zone = _zone_in_root(CacheKey(*seen.given, known=(body.content, arm.chain, below)))
    return zone.moved(arm.T_world_root) if below < 0 else zone


@lru_cache(maxsize=256)
def _zone_in_root(seen: CacheKey) -> Piece:
    """Return the region that `_zone` describes, in the frame of the joint `below`; for -1 in the
    frame of the arm's root.

    Args:
        seen: cache key that holds the arguments of `_zone`: body, arm and below.
    """
    body, arm, below = seen.given
    first = below + 1
    T = arm.origins[first]
    if body.frame.joint == first and arm.turning[first]:
        return swept_cylinder(body.pieces, np.zeros(3), arm.axes[first]).moved(T)
    return ball(T[:3, 3], chain_radius(body, arm, first) + float(arm.slides[first]))


def chain_radius(body: CollisionBody, arm: ArmGeometry, first: int) -> float:
    """Return an upper bound of the distance of a link's points from the origin of an earlier joint,
    with the links in between stretched [m].

    Args:
        body: the link.
        arm: joints of the arm.
        first: index of the earlier joint.
    """
    behind = slice(first + 1, body.frame.joint + 1)
    offsets = np.linalg.norm(arm.origins[behind, :3, 3], axis=1) + arm.slides[behind]
    own = max(farthest_from_point(piece, np.zeros(3)) for piece in body.pieces)
    return float(offsets.sum()) + own


def relative_placement(arm: ArmGeometry, below: int, joint: int, q: Array) -> Array:
    """Return the pose (4, 4) of a joint's frame in the frame of an earlier joint.

    Args:
        arm: joints of the arm.
        below: index of the earlier joint; -1 for the world.
        joint: index of the joint.
        q: (n,) joint positions [rad or m].
    """
    T: Array = arm.T_world_root if below < 0 else np.eye(4)
    for k in range(below + 1, joint + 1):
        moved = np.eye(4)
        if arm.turning[k]:
            moved[:3, :3] = pin.exp3(arm.axes[k] * q[k])
        else:
            moved[:3, 3] = arm.axes[k] * q[k]
        T = T @ arm.origins[k] @ moved
    return T


# --- Coal's distances ---


def coal_geometry(piece: Piece) -> tuple[coal.CollisionGeometry, coal.Transform3s]:
    """Convert a piece to a shape of Coal and its pose in the body's frame."""
    pose = coal.Transform3s(piece.rotation, piece.centre)
    shape = piece.shape
    match shape:
        case Box():
            return coal.Box(np.asarray(shape.size)), pose
        case Cylinder():
            return coal.Cylinder(shape.radius, shape.length), pose
        case Sphere():
            return coal.Sphere(shape.radius), pose
        case Capsule():
            return coal.Capsule(shape.radius, shape.length), pose
        case Hull():
            return _convex(shape), pose


@cache
def _convex(hull: Hull) -> coal.CollisionGeometry:
    points = coal.StdVec_Vec3s()
    points.extend([np.asarray(vertex) for vertex in hull.vertices])
    return coal.Convex.convexHull(points, False, "")


def coal_distance(first: tuple[Piece, ...], second: tuple[Piece, ...]) -> float:
    """Compute the least distance [m] between two bodies, given as convex pieces in one frame.

    The distance is negative if the bodies overlap.

    Args:
        first, second: pieces of the bodies.
    """
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    left, right = [coal_geometry(p) for p in first], [coal_geometry(p) for p in second]
    distances = []
    for a, T_a in left:
        for b, T_b in right:
            result.clear()
            distances.append(coal.distance(a, T_a, b, T_b, request, result))
    return float(min(distances))
