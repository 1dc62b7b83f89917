"""The ways in which an arm can hold the box: spins of its pad, postures, and where they lead."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.proposing.judge import PoseJudge
from hybrid_opt.proposing.kinematics import (
    REACHED,
    ArmKinematics,
    box_to_last_joint,
    guide,
    possible_spins,
    spun,
)
from symbolic.array import Array
from symbolic.records import Workcell
from symbolic.records.poses import box_placement

STARTS = 768
"""Random starts of the search for postures."""

SEARCH_STEPS = 50
"""Newton steps of it."""

SEARCH_DAMPING = 1e-3
"""Of these steps."""

GUIDES = np.array(
    [[0, 0, 0], [0, 0, 0.2], [0, 0, 0.4], [0.25, 0, 0], [-0.25, 0, 0], [0, 0.25, 0], [0, -0.25, 0]]
)
"""How far guides bow out from the straight line at its middle [m]; collisions do not count."""

SAME_POSTURE = 0.05
"""Postures nearer than this in every joint are one [rad], of an arm of six joints."""

SAME_REDUNDANT = 0.3
"""The same of an arm with redundant joints."""

SPIN_OF_FILE = 0.1
"""What it is worth to keep the spin of the file."""

LENGTH_COST = 0.3
"""What the way of the joints between start and goal costs, in a straight line [1/rad]."""

ENOUGH_HOLDS = 96
"""Ways to hold of one arm after which no further guide is tried: the first are the straightest."""

MOST_HOLDS = 24
"""Ways to hold of one arm that are kept, the best first."""

LIMIT_MARGIN = 0.02
"""Distance to joint limits of a first path [rad]."""

MANIPULABILITY_MARGIN = 1.1
"""Its least manipulability, in that of the cell."""


@dataclass(frozen=True, eq=False)
class Hold:
    """One way for one arm to hold the box.

    Attributes:
        spin: beside that of the file [rad].
        q_start, q_goal: (joints,) postures at both ends of the carry, joined by a guide.
        score: larger is better.
    """

    spin: float
    q_start: Array
    q_goal: Array
    score: float


@dataclass
class HoldSearch:
    """What came of looking for ways to hold with one arm.

    Attributes:
        holds: the best first.
        reached: postures that reach the contact at the start.
        within: of these within limits and away from singularities.
        free: of these free of collisions.
        led: of these that a guide leads to the goal.
        joints: how often each joint was beyond its limits, by index.
        pairs: pairs in the way at the start, or where `led` is 0 at the goal.
        kept: largest share of the straight line that a free posture follows.
    """

    holds: list[Hold] = field(default_factory=list)
    reached: int = 0
    within: int = 0
    free: int = 0
    led: int = 0
    joints: Counter[int] = field(default_factory=Counter)
    pairs: Counter[tuple[str, str]] = field(default_factory=Counter)
    kept: float = 0.0


@dataclass(frozen=True)
class HoldQuery:
    """What an arm has to hold.

    Attributes:
        workcell: the cell.
        start, goal: (6,) box poses.
        spins: of the pad beside that of the file [rad].
        judge: of collisions; None: they do not count.
        starts: random starts of the search for postures.
        guides: of `GUIDES`, so many are tried.
    """

    workcell: Workcell
    start: Array
    goal: Array
    spins: Array
    judge: PoseJudge | None
    starts: int = STARTS
    guides: int = len(GUIDES)


def find_holds(
    query: HoldQuery, arm: int, kinematics: ArmKinematics, rng: np.random.Generator
) -> HoldSearch:
    """The ways in which an arm can hold the box from start to goal, the other arm left out."""
    finder = _Finder(query, arm, kinematics, rng)
    found, contact = finder.found, query.workcell.contacts[arm]
    spins = possible_spins(contact, query.spins)
    T_box_joint = [
        box_to_last_joint(query.workcell, kinematics.geometry, spun(contact, spin), arm)
        for spin in spins
    ]
    q, which = finder.start_postures(T_box_joint)
    if not len(q):
        return found
    hit = finder.colliding(query.start, q)
    q, which = q[~hit], which[~hit]
    found.free = len(q)
    finder.lead(spins[which], np.array(T_box_joint)[which], q)
    found.holds.sort(key=lambda hold: -hold.score)
    compared = kinematics.geometry.joints - spins_the_pad(query.workcell, arm, kinematics)
    found.holds = _diverse(found.holds, compared)[:MOST_HOLDS]
    return found


class _Finder:
    """The search for one arm's ways to hold.

    Attributes:
        found: what came of it so far.
    """

    def __init__(
        self, query: HoldQuery, arm: int, kinematics: ArmKinematics, rng: np.random.Generator
    ) -> None:
        self.query, self.arm, self.kinematics, self.rng = query, arm, kinematics, rng
        self.found = HoldSearch()
        self._least = query.workcell.robots[arm].min_manipulability * MANIPULABILITY_MARGIN

    def start_postures(self, T_box_joint: Sequence[Array]) -> tuple[Array, NDArray[np.intp]]:
        """Distinct postures at the start and the index of each one's spin."""
        kinematics, found, start = self.kinematics, self.found, self.query.start
        T_world_box = box_placement(self.query.workcell.task.orientation, start)
        which = np.arange(self.query.starts) % len(T_box_joint)
        targets = np.array([T_world_box @ T for T in T_box_joint])[which]
        centre = (kinematics.lower + kinematics.upper) / 2.0
        half = (kinematics.upper - kinematics.lower) / 2.0
        half = np.where(kinematics.geometry.turning, np.minimum(half, np.pi), half)
        q = centre + half * self.rng.uniform(-1.0, 1.0, (self.query.starts, len(half)))
        solved = kinematics.solve(q, targets, SEARCH_STEPS, SEARCH_DAMPING)
        good = solved.residual <= REACHED
        q, which, measure = solved.q[good], which[good], solved.manipulability[good]
        if not len(q):
            return q, which
        q = q + np.vstack([kinematics.central(row[None, None])[0] for row in q])
        found.reached = len(q)
        beyond = (q < kinematics.lower + LIMIT_MARGIN) | (q > kinematics.upper - LIMIT_MARGIN)
        for joint in np.flatnonzero(beyond.any(axis=0)).tolist():
            found.joints[joint] = int(beyond[:, joint].sum())
        fine = ~beyond.any(axis=1) & (measure >= self._least)
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
        """(n,) of postures (n, joints) that hold the box at a pose; counts what they meet."""
        judge, arm = self.query.judge, self.arm
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

    def lead(self, spin: Array, T_box_joint: Array, q: Array) -> None:
        """Follow postures (n, joints) along guides to the goal, until enough arrive; add those.

        Args:
            spin: (n,) of each [rad].
            T_box_joint: (n, 4, 4) of each.
        """
        start, goal = self.query.start, self.query.goal
        waiting = np.arange(len(q))
        for bow in GUIDES[: self.query.guides]:
            if not len(waiting) or len(self.found.holds) >= ENOUGH_HOLDS:
                return
            orientation = self.query.workcell.task.orientation
            T_world_box = box_placement(orientation, guide(start, goal, bow))
            targets = T_world_box[:, None] @ T_box_joint[waiting]
            arrived, path, score = self._followed(targets, q[waiting])
            left = np.setdiff1d(np.arange(len(waiting)), arrived)
            if self.kinematics.redundant and len(left):
                also, path[:, left], score[left] = self._resolved(
                    targets[:, left], q[waiting[left]]
                )
                arrived = np.union1d(arrived, left[also])
            hit = self.colliding(goal, path[-1, arrived])
            for at in arrived[~hit].tolist():
                row = waiting[at]
                value = float(score[at] + SPIN_OF_FILE * (spin[row] == 0.0))
                hold = Hold(float(spin[row]), path[0, at], path[-1, at], value)
                self.found.holds.append(hold)
            self.found.led += int((~hit).sum())
            waiting = np.delete(waiting, arrived)

    def _followed(self, targets: Array, q: Array) -> tuple[NDArray[np.intp], Array, Array]:
        """Rows that arrive, joint paths (m, n, joints) and scores (n,)."""
        kinematics, redundant = self.kinematics, list(self.kinematics.redundant)
        ends = None
        if redundant:  # half of them keep their redundant joints, half move them elsewhere
            ends = q[:, redundant].copy()
            low, high = kinematics.lower[redundant], kinematics.upper[redundant]
            moving = self.rng.random(len(q)) < 0.5
            drawn = self.rng.uniform(low + LIMIT_MARGIN, high - LIMIT_MARGIN, ends.shape)
            ends[moving] = np.clip(drawn, ends - 2.0, ends + 2.0)[moving]
        path, kept, measure = kinematics.follow(q, targets, ends)
        path = path + kinematics.central(path)
        room = self._room(path)
        fine = (room >= LIMIT_MARGIN) & (measure >= self._least)
        until = np.where(fine.all(axis=0), len(targets), np.argmin(fine, axis=0))
        share = np.minimum(kept, until)
        self.found.kept = max(self.found.kept, float(share.max(initial=0)) / len(targets))
        arrived = np.flatnonzero(share == len(targets))
        return arrived, path, self._score(path, room, measure)

    def _resolved(self, targets: Array, q: Array) -> tuple[NDArray[np.intp], Array, Array]:
        """As `_followed`, the redundant joints where the others are best off; only the ends count,
        because what is planned between them need not follow the same path."""
        path, kept, measure = self.kinematics.follow(q, targets, resolved=True)
        room = self._room(path)
        self.found.kept = max(self.found.kept, float(kept.max(initial=0)) / len(targets))
        fine = (room[-1] >= LIMIT_MARGIN) & (measure[-1] >= self._least)
        arrived = np.flatnonzero((kept == len(targets)) & fine)
        return arrived, path, self._score(path, room, measure)

    def _room(self, path: Array) -> Array:
        """(m, n) least distance to a joint limit of joint paths (m, n, joints)."""
        beyond = np.minimum(path - self.kinematics.lower, self.kinematics.upper - path)
        return np.asarray(beyond.min(axis=2))

    def _score(self, path: Array, room: Array, measure: Array) -> Array:
        """(n,) how far from limits and singular postures, and how short between the ends."""
        comfort = np.clip(room.min(axis=0), 0.0, 0.6) / 0.6
        away = np.minimum(measure.min(axis=0) / (4.0 * self._least), 1.0)
        apart = np.linalg.norm(path[-1] - path[0], axis=1)
        return np.asarray(comfort + away - LENGTH_COST * apart)


def _diverse(holds: Sequence[Hold], compared: int) -> list[Hold]:
    """Of ways that differ in the spin and a joint about the same axis alone the best, then those
    unlike all before them first.

    Args:
        compared: joints that make a difference, from the first.
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


def spins_the_pad(workcell: Workcell, arm: int, kinematics: ArmKinematics) -> bool:
    """Whether the arm's last joint turns the pad about its normal, as a spin does."""
    geometry = kinematics.geometry
    T_joint_pad = geometry.T_joint_box @ workcell.contacts[arm].T_box_pad
    axis = geometry.axes[-1]
    aside = T_joint_pad[:3, 3] - (T_joint_pad[:3, 3] @ axis) * axis
    parallel = abs(float(T_joint_pad[:3, 2] @ axis)) > 1.0 - 1e-6
    last_follows = geometry.joints - 1 not in kinematics.redundant
    return bool(geometry.turning[-1] and last_follows and parallel and np.linalg.norm(aside) < 1e-4)
