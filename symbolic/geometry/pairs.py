"""Which pairs of bodies are checked for collision, and why the others are not.

A pair is left out only for a reason that holds for every candidate: the bodies never move
against each other, they are neighbours in an arm and overlap by construction, the user says so,
they touch in every sampled posture, or a bound of their motion proves that they never meet.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.geometry.apart import anchor, never_meet, out_of_reach, relative_placement
from symbolic.geometry.bodies import (
    ArmGeometry,
    CollisionBody,
    arm_geometry,
    collision_bodies,
)
from symbolic.geometry.coal_shapes import coal_distance
from symbolic.geometry.ignored import ignored_pairs
from symbolic.geometry.pieces import shrunk
from symbolic.workcell.records import Workcell

MOST_ENTERED = 1e-3
"""Depth by which a tool may be drawn into the payload, as pads that give way are [m]."""

POSTURES = 300
"""Random postures in which a pair has to touch to count as always touching."""


@dataclass(frozen=True)
class ActivePair:
    """Two bodies, as indices into the cell's bodies, that have to be kept apart."""

    first: int
    second: int


@dataclass(frozen=True)
class ExcludedPair:
    """Two bodies that are not checked, and why."""

    first: int
    second: int
    reason: str


@dataclass(frozen=True)
class CellGeometry:
    """Everything that collision checking knows of a workcell.

    Attributes:
        workcell: the description.
        bodies: all collision bodies.
        arms: the joints of both arms as numbers.
        active: pairs to be checked; the order of every clearance vector.
        excluded: all other pairs, with the reason.
    """

    workcell: Workcell
    bodies: tuple[CollisionBody, ...]
    arms: tuple[ArmGeometry, ArmGeometry]
    active: tuple[ActivePair, ...]
    excluded: tuple[ExcludedPair, ...]

    @cached_property
    def pair_names(self) -> tuple[tuple[str, str], ...]:
        """Names of the two bodies of every active pair, in order."""
        return tuple((self.bodies[p.first].name, self.bodies[p.second].name) for p in self.active)

    @cached_property
    def tolerance(self) -> Array:
        """(n_active,) `pair_tolerance` of every active pair, in order [m]."""
        bodies = self.bodies
        return np.array(
            [pair_tolerance(self.workcell, bodies[p.first], bodies[p.second]) for p in self.active]
        )

    def index(self, name: str) -> int:
        """Index of a body.

        Raises:
            CollisionModelError: there is no such body.
        """
        names = [body.name for body in self.bodies]
        if name not in names:
            raise CollisionModelError(f"no collision body {name!r}; there are {', '.join(names)}")
        return names.index(name)


def pair_tolerance(workcell: Workcell, a: CollisionBody, b: CollisionBody) -> float:
    """Distance up to which two bodies count as colliding [m].

    That of the workcell, and for the payload how far displaced pads may have it off its place:
    arms that keep to their paths carry a box that they took hold of elsewhere.
    """
    holds = "box" in (a.frame.kind, b.frame.kind)
    return workcell.collision.tolerance + (workcell.uncertainty.pad_position if holds else 0.0)


def build_geometry(workcell: Workcell) -> CellGeometry:
    """Read all shapes of a workcell and sort its pairs.

    Raises:
        CollisionModelError: a shape is unusable, a part of a tool enters the payload, or an ignored
            pair names no body.
    """
    bodies = collision_bodies(workcell)
    arms = (arm_geometry(workcell, 0), arm_geometry(workcell, 1))
    ignored = ignored_pairs(workcell, bodies)
    _check_tools(bodies, arms)
    active, excluded = [], []
    always = _AlwaysTouching(bodies, arms)
    for i, j in combinations(range(len(bodies)), 2):
        a, b = bodies[i], bodies[j]
        tolerance = pair_tolerance(workcell, a, b)
        reason = (
            ignored.get(frozenset((a.name, b.name)), "")
            or _rigid(a, b, arms)
            or _neighbours(a, b, bodies)
            or out_of_reach(a, b, arms, tolerance)
            or never_meet(a, b, arms, tolerance)
            or always.reason(a, b)
        )
        if reason:
            excluded.append(ExcludedPair(i, j, reason))
        else:
            active.append(ActivePair(i, j))
    return CellGeometry(workcell, bodies, arms, tuple(active), tuple(excluded))


def _check_tools(bodies: tuple[CollisionBody, ...], arms: tuple[ArmGeometry, ArmGeometry]) -> None:
    """The tools touch the payload that they hold, and do not enter it."""
    payload = next(body for body in bodies if body.frame.kind == "box")
    cores = [shrunk(piece, MOST_ENTERED) for piece in payload.pieces]
    for body in bodies:
        if not body.is_tool:
            continue
        held = tuple(core.moved(arms[body.frame.robot].T_joint_box) for core in cores)
        if coal_distance(held, body.pieces) <= 0.0:
            raise CollisionModelError(
                f"the tool part {body.name!r} enters the payload by more than "
                f"{1e3 * MOST_ENTERED:g} mm where the robot holds it; move or shorten the part, or "
                "move the pad's frame to its tip (robots.pad)"
            )


def _rigid(a: CollisionBody, b: CollisionBody, arms: tuple[ArmGeometry, ArmGeometry]) -> str:
    """The pair does not move against each other: fixed, or held by the exact grasp."""
    for robot in (0, 1):
        left, right = anchor(a, arms, robot), anchor(b, arms, robot)
        if left.frame == right.frame:
            gap = coal_distance(left.pieces, right.pieces)
            state = f"gap {1e3 * gap:.1f} mm" if gap > 0.0 else "touching"
            where = {
                "world": "both stand still",
                "link": "they move as one body" if a.frame == b.frame else "held by the grasp",
                "box": "they move as one body",
            }[left.frame.kind]
            return f"{where}: {state}, always"
    return ""


def _neighbours(a: CollisionBody, b: CollisionBody, bodies: tuple[CollisionBody, ...]) -> str:
    """Links of one arm with no shape on the joints between them."""
    for standing, link in ((a, b), (b, a)):
        if link.frame.robot in (standing.carries or ()) and not link.is_tool:
            before = [
                x for x in bodies if x.group == link.group and x.frame.joint < link.frame.joint
            ]
            return "" if before else "the arm is mounted on it, they overlap at their joint"
    if a.group != b.group or a.group == "environment" or a.is_tool or b.is_tool:
        return ""
    low, high = sorted((a.frame.joint, b.frame.joint))
    between = [x for x in bodies if x.group == a.group and low < x.frame.joint < high]
    return "neighbours in the arm, they overlap at their joint" if not between else ""


class _AlwaysTouching:
    """Pairs within an arm (the box it holds included) that touch in every sampled posture."""

    def __init__(
        self, bodies: tuple[CollisionBody, ...], arms: tuple[ArmGeometry, ArmGeometry]
    ) -> None:
        self.arms = arms
        rng = np.random.default_rng(0)
        self.postures = [rng.uniform(arm.lower, arm.upper, (POSTURES, arm.joints)) for arm in arms]

    def reason(self, a: CollisionBody, b: CollisionBody) -> str:
        for robot in (0, 1):
            left, right = anchor(a, self.arms, robot), anchor(b, self.arms, robot)
            group = f"robot {robot + 1}"
            own = {body.group for body in (a, b) if body.carries is None}
            if group not in own or own - {group, "payload"}:
                continue
            low, high = sorted((left, right), key=lambda body: body.frame.joint)
            for q in self.postures[robot]:
                T = relative_placement(self.arms[robot], low.frame.joint, high.frame.joint, q)
                if coal_distance(tuple(p.moved(T) for p in high.pieces), low.pieces) > 0.0:
                    break
            else:
                return f"touch in all of {POSTURES} random postures"
        return ""
