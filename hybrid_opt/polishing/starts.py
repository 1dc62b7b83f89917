"""Starts far from the known front: its ends and its middle lie in several basins of attraction.

Many candidates cost less than one attempt, so many are drawn: random changes of a few variables of
a known carry (`perturb_start`), or of all (`random_starts`). Short solves continue from the better
half each time (successive halving, Jamieson and Talwalkar 2016). In a cell that is symmetric about
the plane between both bases, the mirror image of a carry has exchanged objectives; the full
evaluator checks every image. In the polish of drivable carries the box is rotated about one axis at
all waypoints, by a share of the rotation that the bounds allow: such a path may collide, which the
first step of a polish corrects.
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
"""Candidates that are checked for collisions together: two batches of the widest lanes."""

RANDOM_CANDIDATES = 1000
"""Random candidates per call."""

PERTURBED_SHARE = 0.15
"""Probability that a perturbation draws a decision variable anew."""

LEAST_CHANGE = 0.3
"""Least change of the variable that changes most, as a share of its range."""

SIGNS = {
    0: np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0]),
    1: np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0]),
}
"""Factors (6,) of a pose's entries in the reflection, by the plane's normal, x or y. The angle
about the normal stays, the other two change sign."""

MIRROR_TOLERANCE = 1e-6
"""Differences below this are rounding [m, rad]."""

ROTATION_SHARES = (0.8, 0.6, 0.4)
"""Shares of the rotation that the bounds allow, in the order of trial: the first drivable one is
taken. Less rotated paths return to their origin."""

LEAST_ROTATION = 0.1
"""Mean rotation of the waypoints below which a path stays in its basin [rad]."""


def first_feasible(
    evaluator: CandidateEvaluator, x: Array, count: int, objective: int | None = None
) -> tuple[NDArray[np.intp], Array]:
    """Return the first feasible candidates: their rows (k,) and objectives (k, m).

    Args:
        x: (n, n_var) candidates.
        count: at most so many.
        objective: sort by this objective, lowest first; None keeps their order.
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
        x: (n_var,) decision vector.
        objective: to be low.
        rng: draws the candidates.
        candidates, share, away: see `RANDOM_CANDIDATES`, `PERTURBED_SHARE` and `LEAST_CHANGE`.

    Returns:
        The candidate (n_var,) and its objectives (2,); None if no other one is feasible.
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
        objectives: (2,).
        is_exhausted: a solve from it gained nothing, so every other would, too.
    """

    x: Array
    objectives: Array
    is_exhausted: bool = False

    def value(self, objective: int | None) -> float:
        """Return an objective, or the sum of both for None."""
        return float(self.objectives.sum() if objective is None else self.objectives[objective])


def random_starts(
    evaluator: CandidateEvaluator, count: int, rng: np.random.Generator
) -> list[Start]:
    """Draw random candidates and return at most `count` feasible ones."""
    shape = RANDOM_CANDIDATES, evaluator.n_var
    candidates = rng.uniform(evaluator.lower, evaluator.upper, shape)
    rows, objectives = first_feasible(evaluator, candidates, count)
    return list(map(Start, candidates[rows], objectives))


@dataclass(frozen=True)
class Mirror:
    """Reflection of one cell's decision vectors, with exchanged arms.

    Attributes:
        task: the cell's.
        sign, shift: (n_var,) image = sign * x + shift.
    """

    task: Task
    sign: Array
    shift: Array

    def image(self, x: Array) -> Array | None:
        """Reflect a decision vector (n_var,); None if the image is outside the bounds."""
        low, high, image = self.task.lower, self.task.upper, self.sign * x + self.shift
        inside = (image >= low - MIRROR_TOLERANCE) & (image <= high + MIRROR_TOLERANCE)
        return np.clip(image, low, high) if inside.all() else None


def mirror_of(workcell: Workcell) -> Mirror | None:
    """Return the reflection about the plane between both bases if that is upright along a world
    axis and maps the ends of the path onto themselves; otherwise None."""
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
    """Rotate the box at all waypoints and return drivable paths (n_path,), at most one per axis and
    direction.

    Args:
        path: (n_path,) original path.
        durations: function of paths (n, n_path) to durations (n,), infinite without a timing.
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
