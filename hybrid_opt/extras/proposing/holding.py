"""Holds of one arm: spin of its pad, start posture, and the path of the arm to the goal.

Many postures are computed side by side, because spins, bases and branches are compared before
anything is compiled.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.extras.proposing.handling import HandlingMotions
from hybrid_opt.extras.proposing.kinematics import (
    LIMIT_MARGIN,
    MANIPULABILITY_MARGIN,
    REACHED,
    ArmKinematics,
    covers_the_same,
    has_wrist_spin,
    rotate_about_normal,
)
from hybrid_opt.extras.proposing.trial import PoseJudge
from symbolic.array import Array
from symbolic.geometry.bodies import WORLD, Frame
from symbolic.geometry.pairs import CellGeometry, tools_in_payload
from symbolic.geometry.separation import coal_distance
from symbolic.read.arms import arm_model
from symbolic.records import Contact
from symbolic.records.poses import box_placement, inverse

GUIDE_POSES = 25
"""Number of poses of a guide, a path along which postures are followed."""


def possible_spins(contact: Contact, spins: Array) -> Array:
    """Select rotations of an arm's pads about their normals that leave the covered patches
    unchanged.

    These are all rotations for one round pad, half turns for a rectangular pad, and quarter turns
    for a square array of cups.

    Args:
        contact: contact of the arm.
        spins: (n,) rotations [rad].

    Returns:
        (k,) the selected rotations [rad].
    """
    same = [covers_the_same(contact, rotate_about_normal(contact, float(spin))) for spin in spins]
    return np.asarray(spins[same])


def clear_spins(query: HoldQuery, kinematics: ArmKinematics, spins: Array) -> Array:
    """Select rotations of an arm's pads about their normals at which the bodies of the arm's last
    link (hand, tool and pad) do not collide, neither at the start nor at the goal.

    They must not enter the payload and not touch bodies that are fixed in the world. If every
    rotation collides, all rotations are returned. In a narrow place such as a shelf few rotations
    are free, and the search for postures then tries only these.

    Args:
        query: box poses at start and goal.
        kinematics: the arm.
        spins: (n,) rotations [rad].

    Returns:
        (k,) the selected rotations [rad].
    """
    if query.judge is None:
        return spins
    geometry = query.judge.geometry
    last = Frame("link", kinematics.arm, kinematics.geometry.joints - 1)
    bodies = [
        (geometry.bodies[pair.first], geometry.bodies[pair.second]) for pair in geometry.active
    ]
    pairs = [
        (a, b) if a.frame == last else (b, a)
        for a, b in bodies
        if last in (a.frame, b.frame) and WORLD in (a.frame, b.frame)
    ]
    task = kinematics.workcell.task
    ends = box_placement(task.orientation, np.array([query.start, query.goal]))

    def clear(spin: float) -> bool:
        T_box_joint = kinematics.held(spin)
        if enters_payload(geometry, kinematics, spin):
            return False
        return all(
            coal_distance(
                tuple(piece.moved(end @ T_box_joint) for piece in hand.pieces), standing.pieces
            )
            > 0.0
            for end in ends
            for hand, standing in pairs
        )

    found = np.array([spin for spin in spins if clear(spin)])
    return found if len(found) else spins


def enters_payload(geometry: CellGeometry, kinematics: ArmKinematics, spin: float) -> bool:
    """Return True if a tool of an arm enters the payload that the arm holds.

    Args:
        geometry: bodies of the cell.
        kinematics: the arm.
        spin: rotation of the pad about its normal, in addition to the one in the file [rad].
    """
    T_joint_box = [inverse(kinematics.held(spin))] * 2
    entering = tools_in_payload(geometry.bodies, T_joint_box)
    return any(body.frame.robot == kinematics.arm for body in entering)


def initial_arc(start: Array, goal: Array, bow: Array) -> Array:
    """Compute a simple path of the box from start to goal, as an initial guess for the arms'
    motion.

    The path is straight in the numbers of the pose, plus half a sine wave of displacement that is
    largest in the middle. The m redundant joints move at an even rate.

    Args:
        start: (6 + m,) first box pose [m, rad] followed by the m redundant joints [rad or m].
        goal: (6 + m,) last box pose and redundant joints.
        bow: (3,) displacement of the box in the middle of the path, world frame [m]; or (6,) with
            the change of its angles there [rad].

    Returns:
        (GUIDE_POSES, 6 + m) box poses followed by the redundant joints.
    """
    poses = np.linspace(start, goal, GUIDE_POSES)
    poses[:, : len(bow)] += np.sin(np.linspace(0.0, np.pi, GUIDE_POSES))[:, None] * bow
    return poses


STARTS = 768
"""Number of random starts of the search for postures."""

SEARCH_STEPS = 50
"""Number of Newton steps of the search."""

SEARCH_DAMPING = 1e-3
"""Damping of these Newton steps."""

GUIDES = np.array(
    [[0, 0, 0], [0, 0, 0.2], [0, 0, 0.4], [0.25, 0, 0], [-0.25, 0, 0], [0, 0.25, 0], [0, -0.25, 0]]
)
"""Displacements of guides from the straight line at its middle [m]. Collisions do not count along
guides."""

FURTHER_GUIDES = np.random.default_rng(0).uniform(-1.0, 1.0, (32, 6)) * np.repeat([0.35, 0.3], 3)
"""Displacements [m] and rotations [rad] of further guides, random ones, for arms with few holds: an
arm that passes a singular posture on the straight way may pass beside it."""

FEW_HOLDS = 4
"""An arm with fewer holds looks for more along further guides, and with other redundant joints."""

SAME_POSTURE = 0.05
"""Postures of a six-joint arm count as one if they differ by less in every joint [rad]."""

SAME_REDUNDANT = 0.3
"""The same limit for an arm with redundant joints [rad]."""

SPIN_OF_FILE = 0.1
"""Score for keeping the spin in the file."""

LENGTH_COST = 0.3
"""Cost of the straight joint path between start and goal [1/rad]."""

ENOUGH_HOLDS = 96
"""After so many holds of one arm no further guide is tried; the first guides are the
straightest."""

MOST_HOLDS = 24
"""Largest number of holds of one arm that are kept, the best first."""


@dataclass(frozen=True, eq=False)
class Hold:
    """A rotation of one arm's pad, and postures of the arm at start and goal between which it can
    hold the box all the way.

    Attributes:
        spin: rotation of the pad about its normal, in addition to the file's [rad].
        q_start, q_goal: (joints,) postures at start and goal, connected along one of the box paths
            `GUIDES` [rad or m].
        score: larger is better.
    """

    spin: float
    q_start: Array
    q_goal: Array
    score: float


@dataclass
class HoldSearch:
    """Result of the search for the holds (`Hold`) of one arm, and counts that explain a failure.

    Attributes:
        holds: the holds, best first.
        within: number of postures at the start that hold the box, within joint limits and away from
            singularities.
        free: number of those postures that do not collide.
        joints: number of postures beyond the limits of a joint, by index of the joint.
        pairs: number of collisions by pair of bodies, at the start and at the goal.
        kept: largest share of a guide, a path of the box from start to goal, that a collision-free
            posture follows.
        stopped: reason why the posture that came farthest stops there.
        manipulability: largest manipulability of a posture at the start within joint limits [m^3].
    """

    holds: list[Hold] = field(default_factory=list)
    within: int = 0
    free: int = 0
    joints: Counter[int] = field(default_factory=Counter)
    pairs: Counter[tuple[str, str]] = field(default_factory=Counter)
    kept: float = 0.0
    stopped: str = ""
    manipulability: float = 0.0


@dataclass(frozen=True)
class HoldQuery:
    """The box poses that an arm has to hold, and the effort of the search.

    Attributes:
        start, goal: (6,) box poses in the world [m, rad].
        spins: (n,) rotations of the pad about its normal that are tried, in addition to the one in
            the file [rad].
        judge: checker of collisions; None if collisions do not count.
        starts: number of random starts of the search for postures.
        guides: number of box paths that are tried, those of `GUIDES` before `FURTHER_GUIDES`.
        common: (k,) positions of the k joints that also move the other arm, which they keep
            [rad or m]; None if these joints are free like other redundant joints.
        handling: straight motions before and after the carry, which redundant joints shall allow;
            None if they do not count.
    """

    start: Array
    goal: Array
    spins: Array
    judge: PoseJudge | None
    starts: int = STARTS
    guides: int = len(GUIDES) + len(FURTHER_GUIDES)
    common: Array | None = None
    handling: HandlingMotions | None = None


def find_holds(query: HoldQuery, kinematics: ArmKinematics, rng: np.random.Generator) -> HoldSearch:
    """Find holds of one arm: a rotation of its pad, and postures at start and goal between which
    the arm can hold the box all the way.

    Only the ends are checked for collisions, and collisions with the other arm do not count.

    Args:
        query: box poses and effort of the search.
        kinematics: the arm.
        rng: generator of random postures.

    Returns:
        The holds, the best first, and counts that explain a failure.
    """
    finder = _Finder(query, kinematics, rng)
    found, contact = finder.found, kinematics.workcell.contacts[kinematics.arm]
    spins = clear_spins(query, kinematics, possible_spins(contact, query.spins))
    T_box_joint = [kinematics.held(spin) for spin in spins]
    q, which = finder.start_postures(T_box_joint)
    if not len(q):
        return found
    q = finder.settled(0, np.array(T_box_joint)[which], q)
    hit = finder.colliding(query.start, q)
    q, which = q[~hit], which[~hit]
    found.free = len(q)
    finder.lead(spins[which], np.array(T_box_joint)[which], q)
    found.holds.sort(key=lambda hold: -hold.score)
    compared = kinematics.geometry.joints - has_wrist_spin(kinematics)
    found.holds = _diverse(found.holds, compared)[:MOST_HOLDS]
    return found


class _Finder:
    """The search for one arm's holds, its postures at start and goal.

    Attributes:
        found: the result so far.
    """

    def __init__(
        self, query: HoldQuery, kinematics: ArmKinematics, rng: np.random.Generator
    ) -> None:
        self.query, self.kinematics, self.rng = query, kinematics, rng
        self.found = HoldSearch()
        self._orientation = kinematics.workcell.task.orientation

    def start_postures(self, T_box_joint: Sequence[Array]) -> tuple[Array, NDArray[np.intp]]:
        """Find distinct postures that hold the box at the start, for each tried rotation of the
        pad.

        Args:
            T_box_joint: pose (4, 4) of the arm's last joint in the box frame, for each rotation.

        Returns:
            Postures (n, joints) [rad or m]; and for each posture the index (n,) of its rotation in
            `T_box_joint`.
        """
        kinematics, found, start = self.kinematics, self.found, self.query.start
        T_world_box = box_placement(self._orientation, start)
        which = np.arange(self.query.starts) % len(T_box_joint)
        targets = np.array([T_world_box @ T for T in T_box_joint])[which]
        centre = (kinematics.lower + kinematics.upper) / 2.0
        half = (kinematics.upper - kinematics.lower) / 2.0
        half = np.where(kinematics.geometry.turning, np.minimum(half, np.pi), half)
        q = centre + half * self.rng.uniform(-1.0, 1.0, (self.query.starts, len(half)))
        if self.query.common is not None:
            q[:, kinematics.common] = self.query.common
        solved = kinematics.solve(q, targets, SEARCH_STEPS, SEARCH_DAMPING)
        good = solved.residual <= REACHED
        q, which, measure = solved.q[good], which[good], solved.manipulability[good]
        if not len(q):
            return q, which
        q = q + np.vstack([kinematics.central(row[None, None])[0] for row in q])
        beyond = (q < kinematics.lower + LIMIT_MARGIN) | (q > kinematics.upper - LIMIT_MARGIN)
        for joint in np.flatnonzero(beyond.any(axis=0)).tolist():
            found.joints[joint] = int(beyond[:, joint].sum())
        inside = ~beyond.any(axis=1)
        found.manipulability = float(measure[inside].max(initial=0.0))
        fine = inside & (measure >= kinematics.least)
        q, which = q[fine], which[fine]
        kept: list[int] = []
        same = SAME_REDUNDANT if kinematics.redundant else SAME_POSTURE
        for k in range(len(q)):
            rivals = [j for j in kept if which[j] == which[k]]
            if not rivals or np.abs(q[rivals] - q[k]).max(axis=1).min() > same:
                kept.append(k)
        found.within = len(kept)
        return q[kept], which[kept]

    def colliding(self, pose: Array, q: Array) -> NDArray[np.bool_]:
        """Find postures in which the arm collides while it holds the box, and count these
        collisions by pair of bodies.

        Args:
            pose: (6,) pose of the box [m, rad].
            q: (n, joints) postures [rad or m].

        Returns:
            (n,) True for postures that collide.
        """
        judge, arm = self.query.judge, self.kinematics.arm
        if judge is None or not len(q):
            return np.zeros(len(q), dtype=bool)
        hit = judge.arm_colliding(arm, np.tile(pose, (len(q), 1)), q)
        absent = np.zeros(judge.geometry.arms[1 - arm].joints)
        for row in np.flatnonzero(hit)[:MOST_HOLDS].tolist():
            q_1, q_2 = (q[row], absent) if arm == 0 else (absent, q[row])
            pair = judge.first_pair(pose, q_1, q_2, arm)
            if pair is not None:
                self.found.pairs[pair] += 1
        return hit

    def settled(self, end: int, T_box_joint: Array, q: Array) -> Array:
        """Move the redundant joints of postures at the start (`end` 0) or the goal (1) such that
        the motions before or after the carry are possible, where they can be; arguments as of
        `HandlingMotions.settled`."""
        handling, kinematics = self.query.handling, self.kinematics
        if handling is None or not kinematics.redundant or not len(q):
            return q
        return handling.settled(kinematics, end, T_box_joint, q)

    def lead(self, spin: Array, T_box_joint: Array, q: Array) -> None:
        """Find holds: move the arm with the box from each start posture to the goal, and store
        every start posture that arrives there without a collision.

        The paths of the box in `GUIDES` are tried one after the other, each with the postures that
        have not arrived yet, until `ENOUGH_HOLDS` holds are found; then those in `FURTHER_GUIDES`,
        until there are `FEW_HOLDS`.

        Args:
            spin: (n,) rotation of the pad about its normal, for each posture [rad].
            T_box_joint: (n, 4, 4) pose of the last joint in the box frame, for each posture.
            q: (n, joints) postures at the start [rad or m].
        """
        start, goal = self.query.start, self.query.goal
        waiting = np.arange(len(q))
        for number, bow in enumerate((*GUIDES, *FURTHER_GUIDES)[: self.query.guides]):
            enough = ENOUGH_HOLDS if number < len(GUIDES) else FEW_HOLDS
            if not len(waiting) or len(self.found.holds) >= enough:
                return
            T_world_box = box_placement(self._orientation, initial_arc(start, goal, bow))
            targets = T_world_box[:, None] @ T_box_joint[waiting]
            arrived, path, score = self._followed(targets, q[waiting])
            left = np.setdiff1d(np.arange(len(waiting)), arrived)
            if self.kinematics.redundant and len(left):
                also, path[:, left], score[left] = self._resolved(
                    targets[:, left], q[waiting[left]]
                )
                arrived = np.union1d(arrived, left[also])
            ends = self.settled(1, T_box_joint[waiting[arrived]], path[-1, arrived])
            path[-1, arrived] = ends
            hit = self.colliding(goal, ends)
            for at in arrived[~hit].tolist():
                row = waiting[at]
                value = float(score[at] + SPIN_OF_FILE * (spin[row] == 0.0))
                hold = Hold(float(spin[row]), path[0, at], path[-1, at], value)
                self.found.holds.append(hold)
            waiting = np.delete(waiting, arrived)

    def _followed(self, targets: Array, q: Array) -> tuple[NDArray[np.intp], Array, Array]:
        """Move the arm from n postures along given poses of its last joint, within joint limits and
        away from singular postures.

        If the arm has redundant joints, these stay fixed for about half of the postures. For the
        other postures they move at an even rate to random positions.

        Args:
            targets: (m, n, 4, 4) poses of the last joint in the world, m for each posture.
            q: (n, joints) postures at the first pose [rad or m].

        Returns:
            - Indices of the postures that reach the last pose.
            - Joint paths (m, n, joints) of all postures [rad or m].
            - Scores (n,) of all paths by `path_score`, larger is better.
        """
        kinematics, redundant = self.kinematics, list(self.kinematics.redundant)
        ends = None
        if redundant:  # half of them keep their redundant joints, half move them elsewhere
            ends = q[:, redundant].copy()
            low, high = kinematics.lower[redundant], kinematics.upper[redundant]
            moving = self.rng.random(len(q)) < 0.5
            drawn = self.rng.uniform(low + LIMIT_MARGIN, high - LIMIT_MARGIN, ends.shape)
            ends[moving] = np.clip(drawn, ends - 2.0, ends + 2.0)[moving]
            self._place_common(ends)
        path, kept, measure = kinematics.follow(q, targets, ends)
        path = path + kinematics.central(path)
        room = limit_room(kinematics, path)
        fine = (room >= LIMIT_MARGIN) & (measure >= kinematics.least)
        until = np.where(fine.all(axis=0), len(targets), np.argmin(fine, axis=0))
        share = np.minimum(kept, until)
        self._note(share, kept, path, measure)
        arrived = np.flatnonzero(share == len(targets))
        return arrived, path, path_score(kinematics, path, room, measure)

    def _note(self, share: Array, kept: NDArray[np.intp], path: Array, measure: Array) -> None:
        """Remember the farthest of n postures along a guide of m poses, and why it stops there.

        Args:
            share: (n,) number of poses that a posture follows within its limits.
            kept: (n,) number of poses that it reaches.
            path: (m, n, joints) joint paths [rad or m].
            measure: (m, n) manipulability [m^3].
        """
        farthest = int(np.argmax(share))
        at = int(share[farthest])
        if at > self.found.kept * len(path):
            self.found.kept = at / len(path)
            if at < len(path):
                where = path[at, farthest], float(measure[at, farthest])
                self.found.stopped = self._stop(*where, bool(at < kept[farthest]))

    def _stop(self, q: Array, measure: float, reaches: bool) -> str:
        """Return as text why the arm cannot follow a path beyond a posture: it does not reach
        farther, the posture is too near a singular one, or a joint is at its limit.

        Args:
            q: (joints,) posture [rad or m].
            measure: manipulability, negative beyond a singular posture [m^3].
            reaches: True if the arm reaches the pose of the box there.
        """
        kinematics = self.kinematics
        if not reaches:
            return "it does not reach farther in one motion"
        if measure < kinematics.least:
            return manipulability_hint(kinematics, f"is {max(measure, 0.0):.2g} m^3 there")
        room = np.minimum(q - kinematics.lower, kinematics.upper - q)
        joint = list(arm_model(kinematics.workcell.robots[kinematics.arm]).names)[1:][
            int(np.argmin(room))
        ]
        return f"{joint} is at its limit there"

    def _resolved(self, targets: Array, q: Array) -> tuple[NDArray[np.intp], Array, Array]:
        """Move the arm from n postures along given poses of its last joint; redundant joints are
        chosen anew at every pose.

        Limits of joints and manipulability count at the last pose only, because the planned path
        may differ from these paths.

        Args:
            targets: (m, n, 4, 4) poses of the last joint in the world, m for each posture.
            q: (n, joints) postures at the first pose [rad or m].

        Returns:
            - Indices of the postures that reach the last pose.
            - Joint paths (m, n, joints) of all postures [rad or m].
            - Scores (n,) of all paths by `path_score`, larger is better.
        """
        kinematics, ends = self.kinematics, None
        if self.query.common is not None:
            ends = q[:, list(kinematics.redundant)]
            self._place_common(ends)
        path, kept, measure = kinematics.follow(q, targets, ends, resolved=True)
        room = limit_room(kinematics, path)
        fine = (room[-1] >= LIMIT_MARGIN) & (measure[-1] >= kinematics.least)
        self._note(np.where(fine, kept, np.minimum(kept, len(path) - 1)), kept, path, measure)
        arrived = np.flatnonzero((kept == len(targets)) & fine)
        return arrived, path, path_score(kinematics, path, room, measure)

    def _place_common(self, ends: Array) -> None:
        """Set the redundant joints that also move the other arm to the positions that the query
        prescribes. Without prescribed positions nothing changes.

        Args:
            ends: (n, redundant) positions of the redundant joints at the goal [rad or m], changed
                in place.
        """
        if self.query.common is not None:
            columns = [self.kinematics.redundant.index(k) for k in self.kinematics.common]
            ends[:, columns] = self.query.common


def limit_room(kinematics: ArmKinematics, path: Array) -> Array:
    """Compute the distance (m, n) of each posture from its nearest joint limit [rad or m]; negative
    beyond a limit.

    Args:
        kinematics: the arm.
        path: (m, n, joints) n joint paths of m postures each [rad or m].
    """
    return np.asarray(np.minimum(path - kinematics.lower, kinematics.upper - path).min(axis=2))


def path_score(kinematics: ArmKinematics, path: Array, room: Array, measure: Array) -> Array:
    """Score n joint paths. Paths far from joint limits and singular postures, with ends near each
    other, score better.

    Args:
        kinematics: the arm.
        path: (m, n, joints) joint paths [rad or m].
        room: (m, n) distance from the nearest joint limit [rad or m].
        measure: (m, n) manipulability [m^3].

    Returns:
        (n,) scores; larger is better.
    """
    comfort = np.clip(room.min(axis=0), 0.0, 0.6) / 0.6
    away = np.minimum(measure.min(axis=0) / (4.0 * kinematics.least), 1.0)
    apart = np.linalg.norm(path[-1] - path[0], axis=1)
    return np.asarray(comfort + away - LENGTH_COST * apart)


def manipulability_hint(kinematics: ArmKinematics, found: str) -> str:
    """Return a sentence which states that a manipulability is too small, the smallest allowed one,
    and its key in the workcell file.

    Args:
        kinematics: the arm.
        found: part of the sentence on the manipulability found, such as 'is 0.01 m^3 there'.
    """
    robot = kinematics.workcell.robots[kinematics.arm]
    return (
        f"abs(det J) {found}, too near a singular posture; allowed is {MANIPULABILITY_MARGIN:g} "
        f"times robots[{kinematics.arm}].min_manipulability = {robot.min_manipulability:g} m^3"
    )


def _diverse(holds: Sequence[Hold], compared: int) -> list[Hold]:
    """Sort holds such that clearly different ones come first, and remove near duplicates.

    Holds are compared by their start postures. A hold that differs by more than four times
    `SAME_REDUNDANT` from all earlier ones goes to the first group; one that differs by no more than
    `SAME_POSTURE` from an earlier one is removed; all others follow in a second group. Each group
    keeps the given order.

    Args:
        holds: the holds, best first.
        compared: number of joints, counted from the base, by which start postures are compared.

    Returns:
        The remaining holds.
    """
    first: list[Hold] = []
    later: list[Hold] = []
    for hold in holds:
        apart = [
            float(np.abs((other.q_start - hold.q_start)[:compared]).max())
            for other in (*first, *later)
        ]
        nearest = min(apart, default=np.inf)
        if nearest > 4 * SAME_REDUNDANT:
            first.append(hold)
        elif nearest > SAME_POSTURE:
            later.append(hold)
    return first + later
