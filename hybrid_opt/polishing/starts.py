"""Starts far from the known front, whose ends and middle may lie in several basins of attraction.

Many candidates cost less than one attempt, so many are drawn: random changes of a few variables of
a known carry (`perturb_start`), or of all (`random_starts`). Short solves continue from the better
half each time (successive halving, Jamieson and Talwalkar 2016). In a cell that is symmetric about
the plane between both bases, the mirror image of a carry has exchanged objectives; the full
evaluator checks every image. In the polish of drivable carries the box is rotated about one axis at
all waypoints, by a share of the rotation that the bounds allow. Such a path may collide; the first
step of a polish corrects this.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from symbolic.array import Array
from symbolic.records.cell import Workcell
from symbolic.records.task import POSE_SIZE, Task

COLLISION_BATCH = 16
"""Number of candidates checked for collisions together: two batches of the widest lanes."""

RANDOM_CANDIDATES = 1000
"""Number of random candidates per call."""

PERTURBED_SHARE = 0.15
"""Probability that a perturbation draws a decision variable anew."""

LEAST_CHANGE = 0.3
"""The variable that a perturbation changes most has to change by at least this share of its
range."""

SIGNS = {
    0: np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0]),
    1: np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0]),
}
"""Factors (6,) of a pose's entries in a reflection, by the axis of the plane's normal, 0 for x and
1 for y. The angle about the normal keeps its sign, the other two change sign."""

MIRROR_TOLERANCE = 1e-6
"""Smaller differences count as rounding [m, rad]."""

ROTATION_SHARES = (0.8, 0.6, 0.4)
"""Shares of the rotation that the bounds allow, in the order of trial. The first drivable one is
taken. Less rotated paths return to their origin."""

LEAST_ROTATION = 0.1
"""A path stays in its basin if its waypoints are rotated by less than this on average [rad]."""


def first_feasible(
    evaluator: CandidateEvaluator, x: Array, count: int, objective: int | None = None
) -> tuple[NDArray[np.intp], Array]:
    """Find the first feasible candidates in a sequence.

    Args:
        evaluator: evaluator of the candidates.
        x: (n, n_var) candidates.
        count: largest number of candidates to find.
        objective: index of the objective by which the candidates are sorted first, lowest first;
            None to take them in the given order.

    Returns:
        Indices (k,) into x and objectives (k, n_obj) of the feasible candidates.
    """
    but_collisions = evaluator.evaluate(x, with_collisions=False)
    rows = np.flatnonzero(but_collisions.feasible)
    if objective is not None:
        rows = rows[np.argsort(but_collisions.objectives[rows, objective], kind="stable")]
    found = np.empty(0, dtype=np.intp)
    for first in range(0, len(rows), COLLISION_BATCH):
        some = rows[first : first + COLLISION_BATCH]
        found = np.concatenate([found, some[evaluator.evaluate(x[some]).feasible]])[:count]
        if len(found) == count:
            break
    return found, but_collisions.objectives[found]


def perturb_start(
    evaluator: CandidateEvaluator,
    x: Array,
    objective: int,
    rng: np.random.Generator,
    *,
    candidates: int = RANDOM_CANDIDATES,
    share: float = PERTURBED_SHARE,
    away: float = LEAST_CHANGE,
) -> tuple[Array, Array] | None:
    """Draw candidates that differ from x in a few variables, and return the best feasible one.

    Args:
        evaluator: evaluator of the candidates.
        x: (n_var,) decision vector.
        objective: index of the objective that decides which candidate is best.
        rng: generator of the candidates.
        candidates: number of candidates to draw.
        share: probability that a variable is drawn anew.
        away: least change of a candidate's most changed variable, as a share of the variable's
            range; candidates with smaller changes are left out.

    Returns:
        Decision vector (n_var,) and objectives (2,) of the best candidate; None if no candidate is
        feasible.
    """
    low, high = evaluator.lower, evaluator.upper
    shape = candidates, len(x)
    fresh = rng.uniform(low, high, shape)
    drawn = np.where(rng.random(shape) < share, fresh, x)
    far = (np.abs(drawn - x) / (high - low)).max(axis=1) > away
    if not far.any():
        return None
    rows, objectives = first_feasible(evaluator, drawn[far], 1, objective)
    return (drawn[far][rows[0]], objectives[0]) if len(rows) else None


@dataclass(frozen=True)
class Start:
    """A start of a short solve.

    Attributes:
        x: (n_var,) feasible decision vector.
        objectives: (2,) objectives of x.
        is_exhausted: True if a solve from this start gained nothing; a further solve would not
            either.
    """

    x: Array
    objectives: Array
    is_exhausted: bool = False

    def value(self, objective: int | None) -> float:
        """Return one objective of the start, or the sum of both.

        Args:
            objective: index of the objective; None for the sum.
        """
        return float(self.objectives.sum() if objective is None else self.objectives[objective])


def random_starts(
    evaluator: CandidateEvaluator, count: int, rng: np.random.Generator
) -> list[Start]:
    """Draw `RANDOM_CANDIDATES` uniform candidates within the bounds, and return the first feasible
    ones.

    Args:
        evaluator: evaluator of the candidates.
        count: largest number of candidates to return.
        rng: generator of the candidates.

    Returns:
        Feasible candidates, at most `count`.
    """
    shape = RANDOM_CANDIDATES, evaluator.n_var
    candidates = rng.uniform(evaluator.lower, evaluator.upper, shape)
    rows, objectives = first_feasible(evaluator, candidates, count)
    return list(map(Start, candidates[rows], objectives))


@dataclass(frozen=True)
class Mirror:
    """Reflection of a cell's decision vectors that exchanges both arms.

    Attributes:
        task: task of the cell.
        sign, shift: (n_var,) coefficients: the image of x is sign * x + shift.
    """

    task: Task
    sign: Array
    shift: Array

    def image(self, x: Array) -> Array | None:
        """Return the mirror image (n_var,) of a decision vector; None if it violates a bound.

        Args:
            x: (n_var,) decision vector.
        """
        low, high, image = self.task.lower, self.task.upper, self.sign * x + self.shift
        inside = (image >= low - MIRROR_TOLERANCE) & (image <= high + MIRROR_TOLERANCE)
        return np.clip(image, low, high) if inside.all() else None


def mirror_of(workcell: Workcell) -> Mirror | None:
    """Return the reflection of the cell that exchanges both arms: about the vertical plane midway
    between their bases.

    None is returned in three cases: the line between the bases is not parallel to a horizontal
    world axis, the arms have redundant joints, or the reflection moves a fixed waypoint of the box.
    """
    task = workcell.task
    first, second = (robot.T_world_base[:3, 3] for robot in workcell.robots)
    across = np.flatnonzero(np.abs(first - second) > MIRROR_TOLERANCE).tolist()
    if len(across) != 1 or across[0] not in SIGNS or task.redundant:
        return None
    sign, shift = SIGNS[across[0]], (first + second) * np.eye(3)[across[0]]
    shift = np.append(shift, np.zeros(3))
    fixed = [waypoint.lower for waypoint in task.waypoints if waypoint.is_fixed]
    if any(np.abs(sign * pose + shift - pose).max() > MIRROR_TOLERANCE for pose in fixed):
        return None
    count = len(task.free_indices)
    return Mirror(task, np.tile(sign, count), np.tile(shift, count))


def rotated_starts(task: Task, path: Array, durations: Callable[[Array], Array]) -> list[Array]:
    """Rotate the box about one axis at all waypoints of a path, and return paths that have a
    timing.

    For each axis and direction several rotations are tried, by shares of what the bounds allow, and
    the first one with a timing is kept.

    Args:
        task: task of the path.
        path: (n_path,) free waypoints.
        durations: function from paths (n, n_path) to durations (n,) [s], infinite for a path
            without a timing.

    Returns:
        Rotated paths (n_path,), at most one per axis and direction.
    """
    found = []
    columns = task.free_entries[1]
    for axis in range(3, POSE_SIZE):
        own = np.flatnonzero(columns == axis)
        for bound in (task.lower[own], task.upper[own]):
            by = bound - path[own]
            if not len(own) or np.abs(by).mean() < LEAST_ROTATION:
                continue
            candidates = np.repeat(path[None], len(ROTATION_SHARES), axis=0)
            candidates[:, own] += np.outer(ROTATION_SHARES, by)
            driven = np.isfinite(durations(candidates))
            if driven.any():
                found.append(candidates[int(np.argmax(driven))])
    return found
