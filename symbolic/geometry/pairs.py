"""Pairs of bodies that are checked for collision, and the reasons to leave out the others.

A pair is left out only for a reason that holds for every candidate: the bodies never move
against each other, they are neighbours in an arm and overlap by construction, the user says so,
they touch in every sampled posture, or a bound of their motion proves that they never meet.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.errors import CollisionModelError
from symbolic.geometry.bodies import (
    ArmGeometry,
    CollisionBody,
    arm_geometry,
    collision_bodies,
)
from symbolic.geometry.pieces import (
    shrunk,
)
from symbolic.geometry.separation import (
    anchor,
    coal_distance,
    moving_arms,
    never_meet,
    out_of_reach,
    relative_placement,
    sorted_by_joint,
)
from symbolic.read.arms import one_machine
from symbolic.read.urdf import read_srdf
from symbolic.records import Workcell
from symbolic.records.content import CacheKey, digest_of_parts
from symbolic.records.problems import matching

MOST_ENTERED = 1e-3
"""Depth to which a tool may be drawn into the payload [m], because pads give way."""

CONTACT_POSTURES = 300
"""Number of random postures in all of which a pair has to touch to be excluded as always
touching."""


FAR = "far_"
"""Prefix of the functions for pairs that few cells check; see `CellGeometry.near`."""


@dataclass(frozen=True)
class ActivePair:
    """Indices of two bodies whose distance is checked, in this cell or with other parameters.

    Attributes:
        first, second: indices of the bodies in `CellGeometry.bodies`, first < second.
    """

    first: int
    second: int


@dataclass(frozen=True)
class ExcludedPair:
    """Indices of two bodies whose distance is not checked, and the reason.

    Attributes:
        first, second: indices of the bodies in `CellGeometry.bodies`, first < second.
        reason: the reason in words.
    """

    first: int
    second: int
    reason: str


@dataclass(frozen=True)
class CellGeometry:
    """Collision bodies of a workcell, and the pairs of bodies that are checked.

    Attributes:
        workcell: description of the cell.
        bodies: all collision bodies.
        arms: frames, axes and limits of both arms' joints.
        active: pairs that are checked, in the order of the columns of all clearance arrays.
        excluded: all other pairs, with the reason.
        possible: the active pairs, and pairs that are checked with other parameters of the cell or
            while the box is not held; in the order of compiled functions.
        near: number of possible pairs, from the first, that most cells check. The others are pairs
            that the grasp holds together, and pairs of a body before an arm's second joint with a
            body other than this arm and the payload. Their bounds are computed only if one of them
            is active.
    """

    workcell: Workcell
    bodies: tuple[CollisionBody, ...]
    arms: tuple[ArmGeometry, ArmGeometry]
    active: tuple[ActivePair, ...]
    excluded: tuple[ExcludedPair, ...]
    possible: tuple[ActivePair, ...]
    near: int

    @cached_property
    def blocks(self) -> Mapping[str, range]:
        """Division of the pairs in `possible` into at most two blocks, each with compiled functions
        of its own, such as the one of lower bounds of the distances.

        A key is the prefix of these functions' names, a value the range of the block's indices in
        `possible`. The block '' has the near pairs, which are the first `near` ones. The block
        `FAR` has the others; it is missing if there are none.
        """
        far = range(self.near, len(self.possible))
        return {"": range(self.near)} | ({FAR: far} if far else {})

    @cached_property
    def columns(self) -> NDArray[np.intp]:
        """(n_active,) index of each active pair among the possible pairs. In the outputs of the
        functions `asked`, joined in order, it is the column of the pair's distance."""
        places = {pair: k for k, pair in enumerate(self.possible)}
        return np.array([places[pair] for pair in self.active], dtype=np.intp)

    @cached_property
    def asked(self) -> tuple[str, ...]:
        """Prefixes of the names of those compiled functions that have to be evaluated for the
        active pairs: always '' for the near pairs, and `FAR` if any of the other pairs is active.
        """
        blocks = self.blocks.items()
        return tuple(b for b, pairs in blocks if not b or np.isin(self.columns, pairs).any())

    @cached_property
    def pair_names(self) -> tuple[tuple[str, str], ...]:
        """Names of the two bodies of every active pair, in order."""
        return tuple((self.bodies[p.first].name, self.bodies[p.second].name) for p in self.active)

    @cached_property
    def tolerance(self) -> Array:
        """(n_active,) distance up to which each active pair counts as colliding [m]."""
        bodies = self.bodies
        return np.array(
            [pair_tolerance(self.workcell, bodies[p.first], bodies[p.second]) for p in self.active]
        )

    def index(self, name: str) -> int:
        """Return the index of a body in `bodies`.

        Args:
            name: name of the body.

        Raises:
            CollisionModelError: there is no such body.
        """
        names = [body.name for body in self.bodies]
        if name not in names:
            raise CollisionModelError(f"no collision body {name!r}; there are {', '.join(names)}")
        return names.index(name)


def pair_tolerance(workcell: Workcell, a: CollisionBody, b: CollisionBody) -> float:
    """Return the distance up to which the bodies a and b count as colliding [m].

    It is the workcell's tolerance. If one body is the payload, the stated uncertainty of the pads'
    positions is added, because a box that is displaced in the grasp stays displaced along the path.
    """
    return _tolerance(workcell, "box" in (a.frame.kind, b.frame.kind))


def _tolerance(workcell: Workcell, of_payload: bool) -> float:
    held = of_payload and workcell.uncertainty.stated
    return workcell.collision.tolerance + (workcell.uncertainty.pad_position if held else 0.0)


def build_geometry(workcell: Workcell) -> CellGeometry:
    """Read all collision shapes of a workcell, and decide which pairs of bodies are checked.

    Raises:
        CollisionModelError: a shape is unusable, a part of a tool enters the payload, or an ignored
            pair names no body.
    """
    bodies = collision_bodies(workcell)
    arms = (arm_geometry(workcell, 0), arm_geometry(workcell, 1))
    ignored = ignored_pairs(workcell, bodies)
    _check_tools(bodies, arms)
    held, said = workcell.uncertainty, frozenset(ignored.items())
    cell = tuple(body.content for body in bodies), tuple(arm.content for arm in arms)
    known = cell, workcell.collision.tolerance, held.stated, held.pad_position, said
    found = _sorted_pairs(CacheKey(workcell, bodies, arms, ignored, known=known))
    return CellGeometry(workcell, bodies, arms, *found)


@lru_cache(maxsize=16)
def _sorted_pairs(
    given: CacheKey,
) -> tuple[tuple[ActivePair, ...], tuple[ExcludedPair, ...], tuple[ActivePair, ...], int]:
    """Sort all pairs of bodies into active, excluded and possible ones, as defined in
    `CellGeometry`.

    Args:
        given: cache key that holds the workcell, all bodies, both arms' geometry, and the reasons
            of ignored pairs by the names of both bodies.

    Returns:
        Active pairs, excluded pairs, possible pairs with the near ones first, and the number of
        near pairs.
    """
    workcell, bodies, arms, ignored = given.given
    # Pairs within an arm are sorted as if its root were the world: where it stands does not matter.
    at_roots = tuple(b if b.root is None else replace(b, pieces=b.root[1]) for b in bodies)
    rooted = tuple(replace(arm, T_world_root=np.eye(4)) for arm in arms)
    active: list[ActivePair] = []
    excluded: list[ExcludedPair] = []
    near: list[ActivePair] = []
    far: list[ActivePair] = []
    order = digest_of_parts(tuple((body.group, body.frame.joint) for body in bodies))
    views = [
        # Bodies by their content, and where the arms are that move them.
        (at, of, ["".join((b.content, *(of[k].content for k in _arms_of(b)), order)) for b in at])
        for at, of in ((bodies, arms), (at_roots, rooted))
    ]
    holds = [body.frame.kind == "box" for body in bodies]
    tolerances = [_tolerance(workcell, False), _tolerance(workcell, True)]
    belong = [(body.group, body.root is not None) for body in bodies]
    for i, j in combinations(range(len(bodies)), 2):
        said = ignored.get(frozenset((bodies[i].name, bodies[j].name)), "") if ignored else ""
        found, pair = _PairStatus(said, False), ActivePair(i, j)
        if not said:
            at, of, known = views[_is_own(*belong[i], *belong[j])]
            tolerance = tolerances[holds[i] or holds[j]]
            key = CacheKey(
                at[i], at[j], of, tolerance, bodies, known=(known[i], known[j], tolerance)
            )
            found = _sorted(key)
        if found.reason:
            excluded.append(ExcludedPair(i, j, found.reason))
        else:
            active.append(pair)
        if found.possible:
            (far if found.far else near).append(pair)
    return tuple(active), tuple(excluded), (*near, *far), len(near)


@cache
def _is_own(first: str, first_stands: bool, second: str, second_stands: bool) -> bool:
    """Return True if the distance of two bodies depends on one arm only.

    This holds if both bodies belong to this arm, or if one is the held payload and the joints of
    the arm move the other.

    Args:
        first, second: groups of the bodies: 'robot 1', 'robot 2', 'payload' or 'environment'.
        first_stands, second_stands: whether the body is fixed to an arm's root.
    """
    groups = {first, second}
    if "payload" in groups and (first_stands or second_stands):
        return False
    return groups - {"payload"} in ({"robot 1"}, {"robot 2"})


def _arms_of(body: CollisionBody) -> tuple[int, ...]:
    """Return the indices of the arms whose joints or base determine a body's pose."""
    if body.frame.kind == "box":
        return (0, 1)
    if body.root is not None:
        return (body.root[0],)
    return (body.frame.robot,) if body.frame.kind == "link" else ()


@dataclass(frozen=True)
class _PairStatus:
    """Decision about a pair of bodies.

    Attributes:
        reason: the reason to exclude the pair; '' if it is checked.
        possible: True if the pair is checked in this cell or with other parameters of the cell
            (`CellGeometry.possible`).
        far: True if only few cells check the pair.
    """

    reason: str
    possible: bool
    far: bool = False


@lru_cache(maxsize=4096)
def _sorted(seen: CacheKey) -> _PairStatus:
    a, b, arms, tolerance, bodies = seen.given
    rigid = _rigid(a, b, arms)
    fixed = ("" if a.frame != b.frame else rigid) or _neighbours(a, b, bodies)
    if fixed:
        return _PairStatus(fixed, possible=False)
    apart = (
        rigid
        or out_of_reach(a, b, arms, tolerance)
        or never_meet(a, b, arms, tolerance)
        or _always_touching(a, b, arms)
    )
    # The distances of an arm's own links do not depend on the payload.
    links = a.group == b.group and not (a.is_tool or b.is_tool)
    return _PairStatus(apart, not (apart and links), bool(rigid) or _is_far(a, b))


def _is_far(a: CollisionBody, b: CollisionBody) -> bool:
    """Return True for a pair that few cells check: one body is an arm's link before the second
    joint, and the other body is neither part of this arm nor the payload."""
    still = any(x.root is not None or (x.frame.joint == 0 and not x.is_tool) for x in (a, b))
    return still and a.group != b.group and "payload" not in (a.group, b.group)


def tools_in_payload(
    bodies: Sequence[CollisionBody], T_joint_box: Sequence[Array]
) -> Iterator[CollisionBody]:
    """Yield the tool bodies that enter the held payload by more than `MOST_ENTERED`.

    Args:
        bodies: all collision bodies.
        T_joint_box: for each arm the pose (4, 4) of the box in the frame of the arm's last joint.
    """
    payload = next(body for body in bodies if body.frame.kind == "box")
    cores = [shrunk(piece, MOST_ENTERED) for piece in payload.pieces]
    for body in bodies:
        if body.is_tool:
            held = tuple(core.moved(T_joint_box[body.frame.robot]) for core in cores)
            if coal_distance(held, body.pieces) <= 0.0:
                yield body


def _check_tools(bodies: tuple[CollisionBody, ...], arms: tuple[ArmGeometry, ArmGeometry]) -> None:
    """Check that no tool body enters the held payload by more than `MOST_ENTERED`.

    Args:
        bodies: all collision bodies.
        arms: joints of both arms, with the pose of the held box.

    Raises:
        CollisionModelError: a tool body enters the payload.
    """
    for body in tools_in_payload(bodies, [arm.T_joint_box for arm in arms]):
        raise CollisionModelError(
            f"the tool part {body.name!r} enters the payload by more than "
            f"{1e3 * MOST_ENTERED:g} mm where the robot holds it; move or shorten the part, or "
            "move the pad's frame to its tip (robots.pad)",
            code="tool-in-payload",
        )


def _rigid(a: CollisionBody, b: CollisionBody, arms: tuple[ArmGeometry, ArmGeometry]) -> str:
    """Return the reason to exclude a pair of bodies that do not move relative to each other; '' for
    other pairs.

    Such bodies are fixed to one frame, or one is the box and the other the last link of an arm that
    holds the box.

    Args:
        a, b: the two bodies.
        arms: joints of both arms.
    """
    if a.frame != b.frame and "box" not in (a.frame.kind, b.frame.kind):
        return ""
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
    """Return the reason to exclude a pair of bodies that overlap at a joint: two neighbouring links
    of one arm, or an arm's first link and the body on which the arm is mounted. Return '' for other
    pairs.

    Args:
        a, b: the two bodies.
        bodies: all collision bodies.
    """
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


def _always_touching(
    a: CollisionBody, b: CollisionBody, arms: tuple[ArmGeometry, ArmGeometry]
) -> str:
    """Return the reason to exclude two bodies that touch in every one of many random postures: two
    bodies of one arm, or such a body and the held box. Return '' for other pairs.

    Args:
        a, b: the two bodies.
        arms: joints of both arms.
    """
    own = {body.group for body in (a, b) if body.carries is None}
    for robot in moving_arms(a, b):
        group = f"robot {robot + 1}"
        if group not in own or own - {group, "payload"}:
            continue
        arm, (low, high) = arms[robot], sorted_by_joint(a, b, arms, robot)
        postures = np.random.default_rng(0).uniform(
            arm.lower, arm.upper, (CONTACT_POSTURES, arm.joints)
        )
        for q in postures:
            T = relative_placement(arm, low.frame.joint, high.frame.joint, q)
            if coal_distance(tuple(p.moved(T) for p in high.pieces), low.pieces) > 0.0:
                break
        else:
            return f"touch in all of {CONTACT_POSTURES} random postures"
    return ""


# --- pairs that files leave out ---


def ignored_pairs(
    workcell: Workcell, bodies: Sequence[CollisionBody]
) -> Mapping[frozenset[str], str]:
    """Return the pairs of bodies that the workcell file or an SRDF ignores, each with the reason.

    The workcell file has precedence over an SRDF. A link without collision shape in an SRDF has no
    effect.

    Args:
        workcell: the workcell.
        bodies: all collision bodies.

    Returns:
        The reason as text, by the set of both bodies' names.

    Raises:
        CollisionModelError: a name or pattern of `collision.ignored` matches no body.
        UrdfError: an SRDF cannot be read.
    """
    names = [body.name for body in bodies]
    pairs: dict[frozenset[str], str] = {}
    for robot in workcell.robots:
        if robot.srdf is None:
            continue
        owners = workcell.robots if one_machine(workcell.robots) else (robot,)
        for disabled in read_srdf(robot.srdf):
            said = f": {disabled.reason}" if disabled.reason else ""
            for pair in product(owners, owners):
                links = zip(pair, (disabled.first, disabled.second), strict=True)
                named = frozenset(f"{owner.name}/{link}" for owner, link in links)
                pairs[named] = f"disabled in {robot.srdf.name}{said}"
    for ignored in workcell.collision.ignored:
        sides = []
        for pattern in (ignored.first, ignored.second):
            found = matching(pattern, names)
            if not found:
                raise CollisionModelError(
                    f"collision.ignored names {pattern!r}; the bodies are "
                    f"{', '.join(sorted(names))}",
                    code="unknown-body",
                )
            sides.append(found)
        for first in sides[0]:
            for second in sides[1]:
                pairs[frozenset((first, second))] = f"ignored in the file: {ignored.reason}"
    return pairs
