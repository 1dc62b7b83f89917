"""Proofs that paths are free of collisions everywhere, not only at their samples.

A search checks candidates at the task's samples only. The carries that it returns (fronts, selected
and polished trajectories) are certified along the continuous path. `certify_all` makes the proof
for any continuous paths. `configurations` computes box pose and joints anywhere on a path by
Newton's method, and `certificates` certifies carries.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction
from hybrid_opt.collision.between import (
    MotionVerdict,
    Rows,
    SampledMotions,
    check_all_between,
    of_rows,
)
from hybrid_opt.collision.checker import CollidingPair, CollisionChecker
from symbolic.array import Array
from symbolic.errors import DualArmError, SettingsError
from symbolic.path.spline import path_position, place_redundant
from symbolic.records import POSE_SIZE, Task
from symbolic.robot.arm import REACH_TOLERANCE

Configuration = Callable[[Array], tuple[Array, Array, Array]]
"""Function from path parameters (n,) to box poses (n, 6) and joint positions q_1, q_2 (n,
joints)."""

Configurations = Callable[[NDArray[np.intp], Array], Array]
"""Function from indices of paths (n,) and path parameters (n,) to configurations (n, 6 + all
joints): box pose, q_1, q_2. Rows are NaN where an arm loses the path."""

STRAIGHTNESS = 1e-4
"""Largest accepted distance of two bodies together from straight motion between grid points [m]."""

MOST_ROUNDS = 14
"""Number of halvings of the grid after which a path counts as not smooth."""

CACHED_ROWS = 128
"""Number of configurations whose pairs are computed together, so that they stay in the cache."""

TOGETHER = 8
"""Number of carries certified together: enough to save calls, few enough for their bounds to stay
in the cache."""


@dataclass(frozen=True, repr=False)
class Certificate:
    """The result of a certification.

    Attributes:
        is_free: whether the path is proven free of collisions, under the assumption of
            `certify_all`.
        at_sample: a collision at a grid point, or None.
        at_parameter: path parameter of the earliest collision or undecided place, or where an arm
            loses the path; NaN if free.
        motion: the verdict between the grid points; None if a grid point collides or is lost.
        grid_points: number of grid points.
        deviation: largest measured deviation of a pair from straight motion between grid points
            [m].
        lost: whether an arm does not reach its contact at `at_parameter`.
    """

    is_free: bool
    at_sample: CollidingPair | None
    at_parameter: float
    motion: MotionVerdict | None
    grid_points: int
    deviation: float
    lost: bool = False

    def __repr__(self) -> str:
        if self.is_free:
            return f"Certificate: free of collisions along the path ({self.grid_points} places)"
        return f"Certificate: {self.problem} at u = {self.at_parameter:.4f}"

    @property
    def problem(self) -> str:
        """The reason why the path is not certified, in words; '' if it is free."""
        if self.is_free:
            return ""
        if self.lost:
            return "an arm does not follow the path"
        touch = self.at_sample if self.motion is None else self.motion.touch
        assert touch is not None, "a path that is refused is refused for something"
        if self.motion is None or self.motion.status == "collision":
            return str(touch)
        return f"{touch.first} comes too near to {touch.second} to prove that they do not meet"


def certify(
    checker: CollisionChecker,
    configuration: Configuration,
    parameters: Array,
) -> Certificate:
    """Prove that one continuous path is free of collisions, or find where it is not
    (`certify_all`).

    Args:
        checker: collision checker of the workcell.
        configuration: function from path parameters (n,) to box poses (n, 6) and joint positions
            (n, joints) of each arm.
        parameters: (n,) increasing path parameters at which the refinement begins.

    Raises:
        SettingsError: the path jumps, so that no refinement makes its intervals nearly straight.
    """

    def one(_: NDArray[np.intp], u: Array) -> Array:
        return np.hstack(configuration(u))

    return certify_all(checker, one, [parameters])[0]


def certify_all(
    checker: CollisionChecker,
    configurations: Configurations,
    parameters: Sequence[Array],
) -> list[Certificate]:
    """Prove that continuous paths are free of collisions, or find where they are not.

    The grid of each path is refined until, in the middle of every interval, each pair of bodies is
    within `STRAIGHTNESS` of straight motion (linear in joints and box pose). Adaptive subdivision
    then checks the straight motion with a margin of twice the largest deviation. The proof assumes
    that the largest deviation inside an interval is at most twice the deviation in its middle. A
    path that is smooth on the grid satisfies this.

    Args:
        checker: collision checker of the workcell.
        configurations: function from path indices (n,) and path parameters (n,) to configurations
            (n, 6 + all joints).
        parameters: for every path the increasing path parameters (n,) of its first grid.

    Raises:
        SettingsError: a path jumps, so that no refinement makes its intervals nearly straight.
    """
    grid = _straight_grid(checker, configurations, parameters)
    clearance = checker.bounds(*checker.split(grid.configuration))
    found: list[Certificate | None] = [None] * len(parameters)
    for path in range(len(parameters)):
        found[path] = _failed_on_grid(checker, grid, path, clearance)
    left = [path for path, certificate in enumerate(found) if certificate is None]
    if left:
        every = len(left) == len(parameters)
        rows = slice(None) if every else np.isin(grid.owner, left)
        lengths = np.bincount(grid.owner, minlength=len(parameters))[left]
        margin = 2.0 * grid.deviation[left]
        motions = SampledMotions(
            grid.configuration[rows], clearance[rows], lengths.tolist(), margin
        )
        for path, motion in zip(left, check_all_between(checker, motions), strict=True):
            found[path] = _certificate_of(motion, grid.u[grid.owner == path], grid.deviation[path])
    return [certificate for certificate in found if certificate is not None]


@dataclass(frozen=True)
class _Grid:
    """Grid points of several paths, fine enough for straight motion between them.

    Attributes:
        owner: (n,) index of the path of each point, increasing.
        u: (n,) path parameter of each point, increasing along each path.
        configuration: (n, 6 + all joints) box pose and joints of both arms at each point.
        deviation: (n_paths,) largest measured deviation from straight motion [m].
    """

    owner: NDArray[np.intp]
    u: Array
    configuration: Array
    deviation: Array


@dataclass(frozen=True)
class _Stretches(Rows):
    """Intervals of paths with the configurations at both ends.

    Attributes:
        owner: (m,) index of the path of each interval.
        u_a, u_b: (m,) path parameters at start and end.
        a, b: (m, 6 + all joints) configurations at start and end.
    """

    owner: NDArray[np.intp]
    u_a: Array
    u_b: Array
    a: Array
    b: Array


def _straight_grid(
    checker: CollisionChecker,
    configurations: Configurations,
    parameters: Sequence[Array],
) -> _Grid:
    """Refine the grids of all paths as `certify_all` describes.

    An interval is not refined if an arm cannot follow the path in its middle.

    Args:
        checker: collision checker of the workcell.
        configurations: function from path indices (n,) and path parameters (n,) to configurations
            (n, 6 + all joints).
        parameters: for every path the increasing path parameters (n,) of its first grid.
    """
    owner = np.repeat(np.arange(len(parameters)), [len(u) for u in parameters])
    u = np.concatenate([np.asarray(grid, dtype=float) for grid in parameters])
    placed = configurations(owner, u)
    places = [(owner, u, placed)]
    inside = owner[1:] == owner[:-1]
    work = _Stretches(owner[:-1], u[:-1], u[1:], placed[:-1], placed[1:])[inside]
    deviation = np.zeros(len(parameters))
    for _ in range(MOST_ROUNDS):
        between = (work.u_a + work.u_b) / 2.0
        middle = configurations(work.owner, between)
        straight = (work.a + work.b) / 2.0
        off = _farthest(checker, middle, straight)
        bent, lost = off > STRAIGHTNESS, ~np.isfinite(middle).all(axis=1)
        straight_enough = off <= STRAIGHTNESS  # not where an end is lost: nothing is known of it
        np.maximum.at(deviation, work.owner[straight_enough], off[straight_enough])
        new = bent | lost
        places.append((work.owner[new], between[new], middle[new]))
        if not bent.any():
            break
        work, between, middle = work[bent], between[bent], middle[bent]
        halves = replace(work, u_b=between, b=middle), replace(work, u_a=between, a=middle)
        work = of_rows(np.concatenate, halves)
    else:
        raise SettingsError(
            f"the path is still {np.max(off):g} m off straight motion in an interval of length "
            f"{float(np.min(work.u_b - work.u_a)):g}: it jumps; give a continuous one",
            code="jumps",
        )
    owner, u, placed = (np.concatenate(arrays) for arrays in zip(*places, strict=True))
    order = np.lexsort((u, owner))
    return _Grid(owner[order], u[order], placed[order], deviation)


def _farthest(checker: CollisionChecker, configuration: Array, other: Array) -> Array:
    """Bound, for n motions from one configuration to another, how far the bodies of any pair move
    relative to each other.

    Args:
        checker: collision checker of the workcell.
        configuration: (n, 6 + all joints) first configuration of each motion.
        other: (n, 6 + all joints) last configuration of each motion.

    Returns:
        (n,) the largest bound of all pairs [m].
    """
    off = np.empty(len(configuration))
    for start in range(0, len(off), CACHED_ROWS):
        some = slice(start, start + CACHED_ROWS)
        ends = checker.split(configuration[some]), checker.split(other[some])
        off[some] = np.max(checker.motion(*ends)[0], axis=1, initial=0.0)
    return off


def _failed_on_grid(
    checker: CollisionChecker, grid: _Grid, path: int, clearance: Array
) -> Certificate | None:
    """Return the certificate of a path that fails at a grid point; None for other paths.

    A path fails where an arm does not reach its contact or bodies collide.

    Args:
        checker: collision checker of the workcell.
        grid: grid points of all paths.
        path: index of the path.
        clearance: (n, n_pairs) lower bounds of distances at all grid points [m].
    """
    # In order of their owners: a slice, of which nothing is copied.
    rows = slice(*np.searchsorted(grid.owner, [path, path + 1]).tolist())
    u, placed = grid.u[rows], grid.configuration[rows]
    deviation = float(grid.deviation[path])
    lost = ~np.isfinite(placed).all(axis=1)
    if lost.any():
        place = float(u[int(np.argmax(lost))])
        return Certificate(False, None, place, None, len(u), deviation, lost=True)
    hit = checker.check(*checker.split(placed), clearance[rows]).first_touch
    if hit is None:
        return None
    return Certificate(False, hit, float(u[hit.sample]), None, len(u), deviation)


def _certificate_of(motion: MotionVerdict, u: Array, deviation: float) -> Certificate:
    where = float("nan")
    if motion.touch is not None:
        k = motion.touch.sample
        where = float(u[k] + motion.touch.fraction * (u[k + 1] - u[k]))
    return Certificate(motion.status == "free", None, where, motion, len(u), float(deviation))


class LostPathError(DualArmError):
    """An arm cannot follow the path, on its samples or between them."""


@dataclass(frozen=True)
class SampledPath:
    """The samples of a carry's path, from which Newton's method computes the path between them.

    Attributes:
        task: the task of the carry.
        waypoints: (n_waypoints, 6 + m) waypoints of the box and of m redundant joints, angles
            unwrapped.
        q_1, q_2: (n, joints) joint positions on samples uniform in the path parameter [rad].
    """

    task: Task
    waypoints: Array
    q_1: Array
    q_2: Array


def configurations(
    paths: Sequence[SampledPath], posture: NumericFunction, owner: NDArray[np.intp], u: Array
) -> Array:
    """Compute box poses and joint positions at n path parameters of sampled paths.

    Args:
        paths: sampled paths of one task.
        posture: compiled `symbolic.robot.arm.posture_function`, which finds both arms' joint
            positions at a box pose from nearby ones.
        owner: (n,) index in `paths` of the path to which each path parameter belongs.
        u: (n,) path parameters in [0, 1].

    Returns:
        (n, 6 + all joints) box pose [m, rad] and joints of both arms [rad or m]. The joints are NaN
        where Newton's method, started between the neighbouring samples, does not reach the box
        pose.
    """
    basis = path_position(len(paths[0].waypoints), u)
    waypoints = np.array([path.waypoints for path in paths])
    # Summed one by one: the same bits for any number of places.
    extended = basis[:, :1] * waypoints[owner, 0]
    for k in range(1, waypoints.shape[1]):
        extended += basis[:, k : k + 1] * waypoints[owner, k]
    poses = np.ascontiguousarray(extended[:, :POSE_SIZE])
    place = u * (len(paths[0].q_1) - 1)
    before = np.clip(place.astype(int), 0, len(paths[0].q_1) - 2)
    share = (place - before)[:, None]
    sampled = (np.array([path.q_1 for path in paths]), np.array([path.q_2 for path in paths]))
    guesses = [(1.0 - share) * q[owner, before] + share * q[owner, before + 1] for q in sampled]
    place_redundant(paths[0].task, extended, guesses)
    found = posture.batch(poses, *guesses)
    placed = np.hstack([poses, found["q_1"], found["q_2"]])
    reached = np.maximum(found["residual_1"], found["residual_2"]) <= REACH_TOLERANCE
    placed[~np.ravel(reached), poses.shape[1] :] = np.nan
    return placed


def certificates(
    checker: CollisionChecker, posture: NumericFunction, paths: Sequence[SampledPath]
) -> list[Certificate]:
    """Certify carries of one task whose samples are free of collisions.

    Args:
        checker: collision checker of the workcell.
        posture: compiled `symbolic.robot.arm.posture_function`, which finds both arms' joint
            positions at a box pose from nearby ones.
        paths: the sampled path of each carry.
    """
    found: list[Certificate] = []
    for first in range(0, len(paths), TOGETHER):
        some = paths[first : first + TOGETHER]
        samples = [np.linspace(0.0, 1.0, len(path.q_1)) for path in some]
        found += certify_all(checker, partial(configurations, some, posture), samples)
    return found
