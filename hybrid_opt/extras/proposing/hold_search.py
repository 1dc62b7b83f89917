"""Search for postures of both arms that hold the box, at many box poses at once.

Postures come from a library of random ones: those whose pads are nearest to the wanted pose are
moved there by Newton's method.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from hybrid_opt.extras.proposing.holding import (
    SEARCH_DAMPING,
    enters_payload,
    limit_room,
    path_score,
    possible_spins,
)
from hybrid_opt.extras.proposing.kinematics import LIMIT_MARGIN, REACHED, ArmKinematics
from hybrid_opt.extras.proposing.problem import Problem
from hybrid_opt.extras.proposing.redundancy import redundancy
from hybrid_opt.extras.proposing.trial import judge_of
from hybrid_opt.static_hold import require_hold
from symbolic.array import Array
from symbolic.cell_model import CellBodies, build_cell_bodies
from symbolic.errors import DualArmError
from symbolic.read.cell import stretched_length
from symbolic.read.editing import merged
from symbolic.records.poses import Orientation, box_placement, transform

MOST_WAYS = 6
"""Largest number of ways to hold the box that are tried, the most promising: for pads all pairs of
faces, with both assignments of the arms."""

LIBRARY = 40_000
"""Number of random postures of each arm in its library."""

NEAR_POSTURES = 8
"""Number of postures of the library from which a pad's pose is searched."""

FARTHEST = 0.25
"""Largest distance of such a posture from the wanted pad pose [m], with `NORMAL_LEVER`."""

NORMAL_LEVER = 0.3
"""Length that a unit of difference between pad normals counts in this distance [m]."""

FIRST_STEPS, LAST_STEPS = 5, 7
"""Numbers of Newton steps before and after starts that do not converge are given up."""

CONVERGING = 0.2
"""Largest pose residual after the first steps of a start that is continued [m, rad]."""

MOST_POSTURES = 6
"""Largest number of postures of an arm at a box pose, the best, whose collisions are checked."""

COMPARED_PAIRS = 12
"""Largest number of pairs of both arms' postures that are checked at a box pose, the best."""


class PoseState(IntEnum):
    """Whether both arms can hold the box at a pose; if not, the obstacle.

    OUT_OF_REACH: an arm reaches its contact in no posture within its limits. COLLIDES: both arms
    reach, but collide. MEETS_SCENE: the box itself collides.
    """

    OUT_OF_REACH = 0
    COLLIDES = 1
    HOLDS = 2
    MEETS_SCENE = 3


class WayToHold:
    """A way to hold the box, which arm presses on which face, prepared for many box poses.

    Attributes:
        contacts: tables of both contacts as they stand in a file.
        bodies: arms and bodies of the cell with these contacts.
        judge: checker of collisions.
        arms: kinematics of both arms.
        spins: for each arm the rotations of its pad about its normal that are tried, in addition to
            the file's [rad].
    """

    def __init__(self, contacts: list[dict[str, Any]], bodies: CellBodies, spins: Array) -> None:
        """Prepare both arms, and keep the rotations of each pad with which its tool does not enter
        the payload.

        Args:
            contacts: tables of both contacts as they stand in a file.
            bodies: arms and bodies of the cell with these contacts.
            spins: (n,) rotations of a pad about its normal to choose from [rad].
        """
        self.contacts, self.bodies, self.judge = contacts, bodies, judge_of(bodies)
        workcell, geometry = bodies.geometry.workcell, bodies.geometry
        self.arms = [ArmKinematics(workcell, arm, geometry.arms[arm]) for arm in (0, 1)]
        self.spins = []
        for arm, contact in zip(self.arms, workcell.contacts, strict=True):
            possible = possible_spins(contact, spins)
            clear = [not enters_payload(geometry, arm, float(spin)) for spin in possible]
            self.spins.append(possible[clear])

    @property
    def bounds(self) -> list[tuple[Array, float, Array]]:
        """For each arm the position (3,) of its first joint in the world [m], an upper bound of the
        distance of its pad from there [m], and the position (3,) of its pad in the box frame
        [m]."""
        found = []
        for arm in self.arms:
            robot, contact = arm.workcell.robots[arm.arm], arm.workcell.contacts[arm.arm]
            shoulder, length = stretched_length(robot)
            tool = float(np.linalg.norm(robot.T_flange_pad[:3, 3]))
            found.append((shoulder, length + tool, contact.T_box_pad[:3, 3]))
        return found

    def within_lengths(self, T_world_box: Array) -> NDArray[np.bool_]:
        """Find box poses at which neither contact is farther from its arm's first joint than the
        arm is long.

        Args:
            T_world_box: (n, 4, 4) box poses.

        Returns:
            (n,) True for these poses.
        """
        near = np.ones(len(T_world_box), dtype=bool)
        for shoulder, length, point in self.bounds:
            contact = transform(np.eye(3), point)
            apart = (T_world_box @ contact)[:, :3, 3] - shoulder
            near &= np.linalg.norm(apart, axis=1) <= length
        return near


def ways_to_hold(problem: Problem, spins: Array) -> Iterator[WayToHold]:
    """Yield the ways that `propose` tries to hold the box, the most promising first.

    Ways in which the payload cannot be held at rest, or in which a tool enters it, are left out.

    Args:
        problem: the problem, with bases.
        spins: (n,) rotations of the pads about their normals that are tried [rad].

    Raises:
        DualArmError: the file is wrong, or the payload cannot be held at rest in any way; the
            message is the one for the first way.
    """
    known: CellBodies | None = None
    refused: DualArmError | None = None
    for contacts in [problem.contacts, *problem.other_contacts()][:MOST_WAYS]:
        given = {"contacts": contacts}
        try:
            workcell = problem.workcell(merged(given, redundancy(problem, problem.workcell(given))))
            require_hold(workcell)
            bodies = build_cell_bodies(workcell, known)
        except DualArmError as error:
            refused = refused or error
            continue
        known = known or bodies
        way = WayToHold(contacts, bodies, spins)
        if all(map(len, way.spins)):
            yield way
    if known is None and refused is not None:
        raise refused


class PostureLibrary:
    """Random usable postures of one arm, to be found by the pose of its pad."""

    def __init__(self, arm: ArmKinematics, q: Array) -> None:
        """Store those of the given postures that are within joint limits and not close to singular
        ones.

        Args:
            arm: the arm.
            q: (n, joints) postures [rad or m].
        """
        T, jacobian = arm.pose_and_jacobian(q)
        measure = np.abs(np.linalg.det(jacobian[:, :, arm.following]))
        fine = (measure >= arm.least) & _inside(arm, q)
        contact = arm.workcell.contacts[arm.arm]
        self.q = q[fine]
        self.T_world_pad = T[fine] @ (arm.geometry.T_joint_box @ contact.T_box_pad)
        self._tree = KDTree(_features(self.T_world_pad)) if fine.any() else None

    def nearest(self, T_world_pad: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Find stored postures whose pad poses are near wanted ones. Rotations of the pad about its
        normal do not count.

        Args:
            T_world_pad: (n, 4, 4) wanted poses of the pad.

        Returns:
            m pairs: index (m,) of a wanted pose, and index (m,) of a posture near it.
        """
        if self._tree is None or not len(T_world_pad):
            return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
        ranks = np.arange(1, min(NEAR_POSTURES, len(self.q)) + 1)
        wanted = _features(T_world_pad)
        away, found = self._tree.query(wanted, k=ranks, distance_upper_bound=FARTHEST)
        near = np.isfinite(away)
        return np.nonzero(near)[0], np.asarray(found[near], dtype=np.intp)


def _features(T_world_pad: Array) -> Array:
    """Compute coordinates (n, 6) [m] of pad poses T_world_pad (n, 4, 4): position, and normal times
    a lever. The Euclidean distance of two such vectors measures how different the poses are, except
    for the rotation about the normal.
    """
    return np.hstack([T_world_pad[:, :3, 3], NORMAL_LEVER * T_world_pad[:, :3, 2]])


def _inside(arm: ArmKinematics, q: Array) -> NDArray[np.bool_]:
    inside = (q >= arm.lower + LIMIT_MARGIN) & (q <= arm.upper - LIMIT_MARGIN)
    return np.asarray(inside.all(axis=1))


@dataclass(frozen=True, eq=False)
class ReachedPoses:
    """Usable postures of one arm at some box poses, sorted by pose, the best first at each.

    Attributes:
        row: (n,) index of the box pose of each posture.
        q: (n, joints) postures [rad or m].
        spin: (n,) rotation of the pad about its normal, in addition to the file's [rad].
        comfort: (n,) distance from joint limits and singular postures, 0 to 2 (`path_score`).
    """

    row: NDArray[np.intp]
    q: Array
    spin: Array
    comfort: Array

    def only(self, kept: NDArray[Any]) -> ReachedPoses:
        """Return the postures that a mask or an array of indices selects."""
        return ReachedPoses(self.row[kept], self.q[kept], self.spin[kept], self.comfort[kept])


def reached_poses(
    arm: ArmKinematics, library: PostureLibrary, spins: Array, T_world_box: Array
) -> ReachedPoses:
    """Find postures with which an arm reaches its contact, at n box poses. Collisions are not
    checked.

    Newton's method starts at stored postures whose pad poses are near. The found postures keep the
    joint limits and the least manipulability; the best few of each box pose are returned.

    Args:
        arm: the arm.
        library: its random postures.
        spins: (s,) rotations of the pad about its normal that are tried [rad].
        T_world_box: (n, 4, 4) box poses.
    """
    T_world_pad = T_world_box @ arm.workcell.contacts[arm.arm].T_box_pad
    row, seed = library.nearest(T_world_pad)
    # Of the allowed rotations the one nearest to the posture's own.
    x = np.einsum("nji,nj->ni", T_world_pad[row, :3, :3], library.T_world_pad[seed, :3, 0])
    own = np.arctan2(x[:, 1], x[:, 0])
    which = np.argmax(np.cos(own[:, None] - spins), axis=1)
    target = T_world_box[row] @ np.array([arm.held(float(spin)) for spin in spins])[which]
    begun = arm.solve(library.q[seed], target, FIRST_STEPS, SEARCH_DAMPING)
    on = begun.residual <= CONVERGING
    row, which = row[on], which[on]
    there = arm.solve(begun.q[on], target[on], LAST_STEPS, SEARCH_DAMPING)
    q = there.q + arm.central(there.q[None]) if len(row) else there.q
    fine = (there.residual <= REACHED) & (there.manipulability >= arm.least) & _inside(arm, q)
    q, row, which, measure = q[fine], row[fine], which[fine], there.manipulability[fine]
    comfort = path_score(arm, q[None], limit_room(arm, q[None]), measure[None])
    found = ReachedPoses(row, q, spins[which], comfort)
    found = found.only(np.lexsort((-found.comfort, found.row)))
    return found.only(_rank(found.row) < MOST_POSTURES)


def _rank(row: NDArray[np.intp]) -> NDArray[np.intp]:
    """Count for each entry of a sorted array (n,) the equal entries before it."""
    return np.arange(len(row)) - np.searchsorted(row, row)


class PoseSearch:
    """Search for a way to hold the box at each of n box poses.

    Attributes:
        poses: (n, 6) box poses [m, rad].
        state: (n,) values of `PoseState`, so far.
        way: (n,) index of the way that holds, -1 for none.
        spins: (n, 2) rotation of each pad about its normal, in addition to the file's [rad]; NaN
            where nothing holds.
        q: joint positions (n, joints) of each arm [rad or m]; NaN where nothing holds.
        comfort: (n,) of the less comfortable arm, 0 to 1; NaN where nothing holds.
    """

    def __init__(self, orientation: Orientation, ways: Sequence[WayToHold], poses: Array) -> None:
        """Begin a search at n box poses, and mark those at which the box itself collides with the
        environment.

        Args:
            orientation: convention of the last three numbers of a pose.
            ways: ways to hold the box.
            poses: (n, 6) box poses [m, rad].
        """
        self._ways, self.poses, n = ways, poses, len(poses)
        self._T_world_box = box_placement(orientation, poses)
        self.state = np.full(n, PoseState.OUT_OF_REACH, dtype=np.int8)
        self.state[ways[0].judge.payload_colliding(poses)] = PoseState.MEETS_SCENE
        self.way = np.full(n, -1, dtype=np.int8)
        self.spins, self.comfort = np.full((n, 2), np.nan), np.full(n, np.nan)
        self.q = [np.full((n, arm.geometry.joints), np.nan) for arm in ways[0].arms]

    def attempt(
        self, number: int, libraries: Sequence[PostureLibrary], rows: NDArray[np.intp]
    ) -> None:
        """Try one way to hold the box at several poses, and store the results in this search.

        Poses at which an earlier way holds the box are skipped.

        Args:
            number: index of the way.
            libraries: random postures of both arms.
            rows: (k,) indices of the poses.
        """
        way = self._ways[number]
        rows = rows[self.state[rows] < PoseState.HOLDS]
        rows = rows[way.within_lengths(self._T_world_box[rows])]
        found: list[ReachedPoses] = []
        for arm, library, spins in zip(way.arms, libraries, way.spins, strict=True):
            there = reached_poses(arm, library, spins, self._T_world_box[rows])
            found.append(replace(there, row=rows[there.row]))
            rows = np.unique(found[-1].row)
        self.state[rows] = PoseState.COLLIDES
        for k in (0, 1):
            there = found[k].only(np.isin(found[k].row, rows))
            hit = way.judge.arm_colliding(k, self.poses[there.row], there.q)
            found[k] = there.only(~hit)
            rows = np.intersect1d(rows, found[k].row)
        self._pair(number, found, rows)

    def _pair(self, number: int, free: Sequence[ReachedPoses], rows: NDArray[np.intp]) -> None:
        """Find at each box pose a pair of both arms' postures without collision, and store it in
        this search.

        Pairs are tried in the order of comfort, up to `COMPARED_PAIRS` per pose; the first free one
        is taken.

        Args:
            number: index of the way.
            free: postures of both arms, each without collisions of its own.
            rows: (k,) indices of the box poses at which both arms have some.
        """
        ranges = [
            np.column_stack([np.searchsorted(there.row, rows, side) for side in ("left", "right")])
            for there in free
        ]
        pairs: list[tuple[int, NDArray[np.intp]]] = []
        for row, (a, a_end), (b, b_end) in zip(rows.tolist(), *ranges, strict=True):
            both = np.minimum.outer(free[0].comfort[a:a_end], free[1].comfort[b:b_end])
            order = np.argsort(-both, axis=None, kind="stable")[:COMPARED_PAIRS]
            ranked = np.transpose(np.unravel_index(order, both.shape))
            pairs.append((row, ranked + np.array([a, b])))
        for rank in range(COMPARED_PAIRS):
            pairs = [
                (row, both)
                for row, both in pairs
                if len(both) > rank and self.state[row] != PoseState.HOLDS
            ]
            if not pairs:
                return
            at = np.array([row for row, _ in pairs])
            index = np.array([both[rank] for _, both in pairs])
            q = [there.q[column] for there, column in zip(free, index.T, strict=True)]
            hit = self._ways[number].judge.colliding(self.poses[at], *q)
            at, index = at[~hit], index[~hit]
            self.state[at], self.way[at] = PoseState.HOLDS, number
            for arm, there in enumerate(free):
                self.q[arm][at] = there.q[index[:, arm]]
                self.spins[at, arm] = there.spin[index[:, arm]]
            reached = [there.comfort[column] for there, column in zip(free, index.T, strict=True)]
            self.comfort[at] = np.minimum(*reached) / 2.0
