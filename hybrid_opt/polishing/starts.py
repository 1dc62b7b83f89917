"""Starts far from what is known: a front's ends and its middle lie in several basins.

From the end of a front that a local solver reached, a better one may be a tilt of the box away.
Thousands of candidates cost less than one attempt, so many are drawn: random changes of a few
variables of a known carry (`kicked`), or all of them (`random_starts`), of which short solves go on
from the better half each time (successive halving, Jamieson and Talwalkar 2016). In a cell that is
symmetric about the plane between both bases, the mirror image of a carry is as good with its
objectives exchanged; nothing is taken for granted, the full evaluator judges every image. In the
polish of drivable carries the box is turned about one axis at every waypoint, by a share of what
the bounds leave: such a path may touch something, and the first step of a polish puts that right.
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

TOGETHER = 16
"""Candidates whose collisions are judged together: two batches of the widest lanes."""

CANDIDATES = 1000
"""Random ones that are drawn."""

KICKED = 0.15
"""Share of the decision variables that a kick draws anew."""

AWAY = 0.3
"""Least change of the one that it changes most, as a share of its range."""

SIGNS = {
    0: np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0]),
    1: np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0]),
}
"""By the plane's normal, x or y: what a pose's entries (6,) are multiplied by. The angle about the
normal stays, the other two change their signs."""

SAME = 1e-6
"""Differences below this are rounding [m, rad]."""

TURNED = (0.8, 0.6, 0.4)
"""Shares of the turn that the bounds leave; the first with which the path can be driven is taken.
Less turned paths fall back to where they came from."""

LEAST_TURN = 0.1
"""Turns below this, in the mean of the waypoints, lead nowhere else [rad]."""


def first_feasible(
    evaluator: CandidateEvaluator, x: Array, count: int, objective: int | None = None
) -> tuple[NDArray[np.intp], Array]:
    """The first feasible ones of candidates: their rows (k,) and objectives (k, m).

    Args:
        x: (n, n_var) candidates.
        count: how many at most.
        objective: the one they are ordered by, lowest first; None for their own order.
    """
    but_collisions = evaluator.evaluate(x, with_collisions=False)
    rows = np.flatnonzero(but_collisions.feasible)
    if objective is not None:
        rows = rows[np.argsort(but_collisions.objectives[rows, objective], kind="stable")]
    found = np.empty(0, dtype=np.intp)
    for first in range(0, len(rows), TOGETHER):
        some = rows[first : first + TOGETHER]
        found = np.concatenate([found, some[evaluator.evaluate(x[some]).feasible]])[:count]
        if len(found) == count:
            break
    return found, but_collisions.objectives[found]


def kicked(
    evaluator: CandidateEvaluator,
    x: Array,
    objective: int,
    rng: np.random.Generator,
    *,
    candidates: int = CANDIDATES,
    share: float = KICKED,
    away: float = AWAY,
) -> tuple[Array, Array] | None:
    """The best feasible candidate that differs from another in a few variables, and its objectives.

    Args:
        x: (n_var,) where it starts from.
        objective: the one that is to be low.
        rng: draws the candidates.
        candidates, share, away: see `CANDIDATES`, `KICKED` and `AWAY`.

    Returns:
        The candidate (n_var,) and its objectives (2,); None where no other one is feasible.
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
    """A feasible decision vector (n_var,) and its objectives (2,); spent where a solve from it came
    no further, as would every other."""

    x: Array
    objectives: Array
    spent: bool = False

    def value(self, objective: int | None) -> float:
        """The objective that is aimed at, or the sum of both."""
        return float(self.objectives.sum() if objective is None else self.objectives[objective])


def random_starts(
    evaluator: CandidateEvaluator, count: int, rng: np.random.Generator
) -> list[Start]:
    """At most `count` feasible ones among random candidates."""
    shape = CANDIDATES, evaluator.n_var
    candidates = rng.uniform(evaluator.lower, evaluator.upper, shape)
    rows, objectives = first_feasible(evaluator, candidates, count)
    return list(map(Start, candidates[rows], objectives))


@dataclass(frozen=True)
class Mirror:
    """The reflection of one cell's decision vectors, each arm taking the other's part.

    Attributes:
        task: the cell's.
        sign, shift: (n_var,) an image is sign * x + shift.
    """

    task: Task
    sign: Array
    shift: Array

    def image(self, x: Array) -> Array | None:
        """(n_var,) the image of a decision vector; None where it is out of the bounds."""
        low, high, image = self.task.lower, self.task.upper, self.sign * x + self.shift
        inside = (image >= low - SAME) & (image <= high + SAME)
        return np.clip(image, low, high) if inside.all() else None


def mirror_of(workcell: Workcell) -> Mirror | None:
    """The reflection about the plane between both bases, where it is upright along an axis of the
    world and leaves the ends of the path where they are; otherwise None."""
    task = workcell.task
    first, second = (robot.T_world_base[:3, 3] for robot in workcell.robots)
    across = np.flatnonzero(np.abs(first - second) > SAME).tolist()
    if len(across) != 1 or across[0] not in SIGNS or task.redundant:
        return None
    sign, shift = SIGNS[across[0]], (first + second) * np.eye(3)[across[0]]
    shift = np.append(shift, np.zeros(3))
    fixed = [waypoint.lower for waypoint in task.waypoints if waypoint.is_fixed]
    if any(np.abs(sign * pose + shift - pose).max() > SAME for pose in fixed):
        return None
    count = len(task.free_indices)
    return Mirror(task, np.tile(sign, count), np.tile(shift, count))


def turned(task: Task, path: Array, durations: Callable[[Array], Array]) -> list[Array]:
    """Turned paths (n_path,) that can be driven, at most one per axis and sense.

    Args:
        path: (n_path,) that is turned.
        durations: of paths (n, n_path), infinite where there is none.
    """
    found = []
    columns = task.free_entries[1]
    for axis in range(3, POSE_SIZE):
        own = np.flatnonzero(columns == axis)
        for bound in (task.lower[own], task.upper[own]):
            by = bound - path[own]
            if not len(own) or np.abs(by).mean() < LEAST_TURN:
                continue
            candidates = np.repeat(path[None], len(TURNED), axis=0)
            candidates[:, own] += np.outer(TURNED, by)
            driven = np.isfinite(durations(candidates))
            if driven.any():
                found.append(candidates[int(np.argmax(driven))])
    return found
