"""Bounds that keep two bodies apart in every posture, so that their pair is never checked."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from symbolic.array import Array
from symbolic.geometry.bodies import (
    ArmGeometry,
    CollisionBody,
    Frame,
)
from symbolic.geometry.coal_shapes import coal_distance
from symbolic.geometry.enclosing import ball, swept_cylinder
from symbolic.geometry.pieces import Piece, farthest_from_axis, farthest_from_point


def anchor(body: CollisionBody, arms: tuple[ArmGeometry, ArmGeometry], robot: int) -> CollisionBody:
    """The body with a carried box seen as part of a robot's last link."""
    if body.frame.kind != "box":
        return body
    pieces = tuple(piece.moved(arms[robot].T_joint_box) for piece in body.pieces)
    return CollisionBody(
        body.name, body.group, Frame("link", robot, arms[robot].joints - 1), pieces
    )


def out_of_reach(
    a: CollisionBody,
    b: CollisionBody,
    arms: tuple[ArmGeometry, ArmGeometry],
    tolerance: float,
) -> str:
    """A bound of the motion of one about the other keeps them apart."""
    margin = tolerance + 1e-3
    if {a.frame.robot, b.frame.robot} == {0, 1}:
        zones = [_zone(body, arms[body.frame.robot], -1) for body in (a, b)]
        gap = coal_distance((zones[0],), (zones[1],))
        return f"out of reach: their zones stay {1e3 * gap:.0f} mm apart" if gap > margin else ""
    for robot in (0, 1):
        left, right = anchor(a, arms, robot), anchor(b, arms, robot)
        low, high = sorted((left, right), key=lambda body: body.frame.joint)
        if high.frame.robot != robot or low.frame.robot not in (robot, -1):
            continue
        gap = coal_distance((_zone(high, arms[robot], low.frame.joint),), low.pieces)
        if gap > margin:
            return f"out of reach: the zone of {high.name} stays {1e3 * gap:.0f} mm away"
    return ""


def never_meet(
    a: CollisionBody,
    b: CollisionBody,
    arms: tuple[ArmGeometry, ArmGeometry],
    tolerance: float,
) -> str:
    """Bodies two joints apart that no position of the two joints brings together.

    The farther body is replaced by its swept cylinder about the second joint's axis; the first
    joint's range is cut into intervals, each cleared by the distance at its middle, which is
    more than the body can move within half the interval.
    """
    for robot, arm in enumerate(arms):
        left, right = anchor(a, arms, robot), anchor(b, arms, robot)
        low, high = sorted((left, right), key=lambda body: body.frame.joint)
        own_base = (
            low.frame.robot == robot or low.group == f"robot {robot + 1}" or low.carries is not None
        )
        if high.frame.robot != robot or not own_base or high.frame.joint - low.frame.joint != 2:
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
    """What a body behind joint `body.frame.joint` can reach, seen from joint `below` (-1: world).

    One joint that turns between them: the swept cylinder about its axis. Else the ball about the
    first joint's origin whose radius is the stretched chain.
    """
    first = below + 1
    T = arm.T_world_root @ arm.origins[0] if first == 0 else arm.origins[first]
    if body.frame.joint == first and arm.turning[first]:
        return swept_cylinder(body.pieces, np.zeros(3), arm.axes[first]).moved(T)
    return ball(T[:3, 3], chain_radius(body, arm, first) + float(arm.slides[first]))


def chain_radius(body: CollisionBody, arm: ArmGeometry, first: int) -> float:
    """Distance from the origin of joint `first` that no point of a body behind it exceeds [m]."""
    behind = slice(first + 1, body.frame.joint + 1)
    offsets = np.linalg.norm(arm.origins[behind, :3, 3], axis=1) + arm.slides[behind]
    own = max(farthest_from_point(piece, np.zeros(3)) for piece in body.pieces)
    return float(offsets.sum()) + own


def relative_placement(arm: ArmGeometry, below: int, joint: int, q: Array) -> Array:
    """(4, 4) of a joint's frame in the frame of an earlier joint (-1: world) at q (n,)."""
    T: Array = arm.T_world_root if below < 0 else np.eye(4)
    for k in range(below + 1, joint + 1):
        moved = np.eye(4)
        if arm.turning[k]:
            moved[:3, :3] = pin.exp3(arm.axes[k] * q[k])
        else:
            moved[:3, 3] = arm.axes[k] * q[k]
        T = T @ arm.origins[k] @ moved
    return T
