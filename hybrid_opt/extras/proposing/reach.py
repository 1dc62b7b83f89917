"""Paths of both arms from any joint positions to the beginning of a job, or from its end back,
while the box does not move.

An arm cannot change its branch while it holds the box. If a job begins in another branch than the
arm's present one, the arm changes it on this path. Both arms move at the same time along straight
lines of their joints from corner to corner. Trees of such lines (`trees.py`) find the corners,
shortcuts remove needless ones, and every line is proven free of collisions.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.carry import joints_of
from hybrid_opt.collision.certify import certify
from hybrid_opt.collision.checker import CollisionChecker
from hybrid_opt.compiled_cell import CACHED_WORKCELLS, CompiledCell
from hybrid_opt.errors import JobError
from hybrid_opt.extras.proposing.trees import connect, inner_points
from hybrid_opt.job.plan import JobCollisions, SupportedPose
from hybrid_opt.job.records import Job
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell

JOINT_STEP = 0.04
"""Largest change of a joint between configurations that are checked on a line [rad or m]."""

RANGE = 1.5
"""Longest line by which the trees grow [rad]."""

MOST_LOOKED = 400_000
"""Largest number of configurations that one attempt may check."""

ATTEMPTS = 8
"""Largest number of attempts. A new one follows if a line cannot be proven free."""

PROOF_POINTS = 17
"""Number of grid points at which the proof of a line starts."""

_CLOSER = "choose joint positions nearer to the job's"


@lru_cache(maxsize=CACHED_WORKCELLS)
def _collisions(workcell: Workcell) -> JobCollisions:
    return JobCollisions(CompiledCell.of(workcell), everywhere=True)


def plan_reach(job: Job, q: Array, *, rng: np.random.Generator, after: bool = False) -> Array:
    """Plan a collision-free path of both arms from given joint positions to the first position of a
    job, or from the last position of a job to them.

    Args:
        job: the job.
        q: (joints,) the given joint positions of both arms, side by side [rad, or m for a sliding
            joint].
        rng: generator of all random numbers.
        after: False for the path to the job's first position, True for the path from its last
            position.

    Returns:
        (n, joints) corners of the path in order of time, both ends included. Between corners both
        arms move along straight lines of their joints, in the same time.

    Raises:
        SettingsError: q does not fit the cell or exceeds a joint's limits.
        JobError: the arms collide at an end of the path, or no path was found.
    """
    cell, end = job.workcell, job.phases[-1 if after else 0].motion.q[-1 if after else 0]
    q = np.asarray(q, dtype=float)
    bounds = cell.stack_joint_limits("position_lower"), cell.stack_joint_limits("position_upper")
    if q.shape != end.shape or not bool(np.all((q >= bounds[0]) & (q <= bounds[1]))):
        raise SettingsError(
            f"q has shape {q.shape}; needs {len(end)} joint positions within their limits"
        )
    lines = _Lines(job, after)
    touch = lines.touched(q)
    if touch:
        raise JobError(f"at these joint positions {touch}; choose others")
    for _ in range(ATTEMPTS):
        corners = [q, end]
        if not lines.proven(q, end):
            corners = _connected(lines, q, end, bounds, rng)
            corners = _shortened(lines, corners)
        if all(lines.proven(a, b) for a, b in pairwise(corners)):
            return np.array(corners[::-1] if after else corners)
    raise JobError(f"no way of the arms that is free of collisions was found; {_CLOSER}")


class _Lines:
    """Collision checker of straight motions in the joint space of both arms, with the box at its
    place before or after a job."""

    def __init__(self, job: Job, after: bool) -> None:
        end = -1 if after else 0
        stands, carried = job.phases[end].motion.pose[end], job.phase("carry").motion.pose[end]
        place = SupportedPose(stands, float(carried[2] - stands[2]), job.stands_on[end])
        self._checker: CollisionChecker = _collisions(job.workcell).checker([place])
        self._cell, self._pose = job.workcell, stands
        self.looked = 0

    def _placed(self, q: Array) -> tuple[Array, Array, Array]:
        first, second = map(np.ascontiguousarray, joints_of(self._cell, q))
        return np.tile(self._pose, (len(q), 1)), first, second

    def touched(self, q: Array) -> str:
        """Return a text on the collision at one position of both arms; '' for none.

        Args:
            q: (joints,) joint positions of both arms, side by side [rad or m].
        """
        touch = self._checker.check(*self._placed(q[None])).first_touch
        return "" if touch is None else str(touch)

    def free(self, first: Array, second: Array) -> NDArray[np.bool_]:
        """Find straight lines in joint space on which no sampled position collides. Their first
        ends are not checked.

        Args:
            first: (k, joints) joint positions of both arms at the beginnings [rad or m].
            second: (k, joints) joint positions at the ends [rad or m].

        Returns:
            (k,) True for such lines.
        """
        found = ~self._colliding(second)
        counts = np.ceil(np.abs(second - first).max(axis=1) / JOINT_STEP).astype(np.intp) + 1
        for which, share in inner_points(counts):
            asked = found[which]
            which, u = which[asked], share[asked, None]
            found[which[self._colliding(first[which] + u * (second[which] - first[which]))]] = False
        return found

    def _colliding(self, q: Array) -> NDArray[np.bool_]:
        self.looked += len(q)
        return self._checker.check(*self._placed(q)).colliding

    def proven(self, first: Array, second: Array) -> bool:
        """Return True if a whole straight line in joint space is proven free of collisions.

        Args:
            first: (joints,) joint positions of both arms at the beginning of the line [rad or m].
            second: (joints,) joint positions at its end [rad or m].
        """

        def at(u: Array) -> tuple[Array, Array, Array]:
            return self._placed(first + u[:, None] * (second - first))

        grid = np.linspace(0.0, 1.0, PROOF_POINTS)
        free = bool(self.free(first[None], second[None])[0])
        return free and certify(self._checker, at, grid).is_free


def _connected(
    lines: _Lines,
    q: Array,
    end: Array,
    bounds: tuple[Array, Array],
    rng: np.random.Generator,
) -> list[Array]:
    """Find a path of both arms by RRT-Connect; only its sampled positions are free of collisions.

    Args:
        lines: collision checker of straight motions.
        q: (joints,) joint positions at the beginning [rad or m].
        end: (joints,) joint positions at the end [rad or m].
        bounds: lower and upper joint limits (joints,) [rad or m].
        rng: generator of random positions.

    Returns:
        Corners (joints,) of the path, both ends included.

    Raises:
        JobError: no path is found.
    """

    def join(begins: Sequence[Array], points: Array) -> list[Array | None]:
        free: NDArray[np.bool_] = lines.free(np.array(begins), points)
        return [point if fine else None for point, fine in zip(points, free, strict=True)]

    last = lines.looked + MOST_LOOKED
    path = connect(
        ((q[None], [q]), (end[None], [end])),
        RANGE,
        lambda count: rng.uniform(*bounds, (count, len(q))),
        join,
        lambda one, other: True,
        lambda: lines.looked >= last,
    )
    if path is None:
        raise JobError(
            f"no way of the arms was found among {MOST_LOOKED} configurations; {_CLOSER}"
        )
    return path


def _shortened(lines: _Lines, corners: list[Array]) -> list[Array]:
    """Shorten a path in joint space by leaving out corners.

    Beginning at the first corner, the path jumps to the last corner to which a straight line is
    proven free of collisions, and goes on from there. If there is no such line, it goes to the next
    corner, on a line that is not proven here.

    Args:
        lines: collision checker of straight motions.
        corners: joint positions (joints,) of both arms at each corner [rad or m].

    Returns:
        The remaining corners, both ends included.
    """
    found, at = [corners[0]], 0
    while at < len(corners) - 1:
        ahead = range(len(corners) - 1, at + 1, -1)
        at = next((k for k in ahead if lines.proven(corners[at], corners[k])), at + 1)
        found.append(corners[at])
    return found
