"""Indicators of fronts and of all points that a search evaluated.

All objectives are minimised. A front is an (n, n_obj) array of objectives. Hypervolume, IGD and
spacing compare objectives of different units, so normalise first, and with the same bounds for
everything that is compared.

An optimum on a bound of a decision variable may be an effect of this bound: wider bounds might
allow better carries. A bound that no optimum lies on only limited the region of the search.

moocore and SciPy are imported in the functions that use them: both take long to start, and a carry
needs neither.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from symbolic.array import Array, Count
from symbolic.records import Task
from symbolic.records.task import variable_names

REFERENCE_POINT = (1.1, 1.1)
"""Reference point of the hypervolume, in normalised objectives (the paper's)."""

ON_BOUND = 1e-3
"""A variable counts as on its bound if it is nearer than this share of its range: an interior-point
method stops a little inside."""


def normalise(objectives: ArrayLike, ideal: ArrayLike, nadir: ArrayLike) -> Array:
    """Map `ideal` to 0 and `nadir` to 1 in each objective linearly, without clipping.

    Args:
        objectives: (n, n_obj) points.
        ideal, nadir: (n_obj,) bounds of each objective, such as the best and worst values of a
            front.

    Returns:
        (n, n_obj) normalised points.

    Raises:
        ValueError: nadir does not exceed ideal in every objective.
    """
    low, high = np.asarray(ideal, dtype=np.float64), np.asarray(nadir, dtype=np.float64)
    if not (high > low).all():
        raise ValueError(f"nadir {high} must exceed ideal {low} in every objective")
    return np.asarray((np.asarray(objectives, dtype=np.float64) - low) / (high - low))


def reference_point(n_obj: int) -> tuple[float, ...]:
    """Return the paper's reference point of the hypervolume for `n_obj` objectives."""
    return (REFERENCE_POINT[0],) * n_obj


def hypervolume(front: ArrayLike, reference: ArrayLike = REFERENCE_POINT) -> float:
    """Compute the volume of objective space that a front dominates up to a reference point.

    Source: Zitzler and Thiele 1999; computed by moocore (Fonseca et al. 2006).

    Args:
        front: (n, n_obj) objectives; the volume is 0 for n = 0.
        reference: (n_obj,) reference point.
    """
    import moocore

    points = np.asarray(front, dtype=np.float64)
    if len(points) == 0:
        return 0.0
    return float(moocore.hypervolume(points, ref=np.asarray(reference, dtype=np.float64)))


def igd(front: ArrayLike, reference_front: ArrayLike) -> float:
    """Compute the inverted generational distance (IGD) of a front.

    It is the mean Euclidean distance from each point of a reference front to the nearest point of
    the front; infinite for an empty front. Source: Coello Coello and Reyes Sierra 2004, with the
    mean of distances (not the root of their squared sum).

    Args:
        front: (n, n_obj) objectives.
        reference_front: (k, n_obj) objectives of the best known front.
    """
    return _mean_distance("igd", front, reference_front)


def igd_plus(front: ArrayLike, reference_front: ArrayLike) -> float:
    """Compute IGD+ of a front: like IGD, but distances count only the objectives in which the point
    of the front is worse than the point of the reference front.

    It is weakly Pareto compliant; infinite for an empty front. Source: Ishibuchi, Masuda, Tanigaki
    and Nojima 2015.

    Args:
        front: (n, n_obj) objectives.
        reference_front: (k, n_obj) objectives of the best known front.
    """
    return _mean_distance("igd_plus", front, reference_front)


def _mean_distance(of_moocore: str, front: ArrayLike, reference_front: ArrayLike) -> float:
    import moocore

    points, reference = (np.asarray(each, dtype=float) for each in (front, reference_front))
    if len(points) == 0:
        return float("inf")
    return float(getattr(moocore, of_moocore)(points, ref=reference))


def spacing(front: ArrayLike) -> float:
    """Compute the standard deviation of each point's L1 distance to its nearest neighbour on a
    front.

    The divisor is n - 1; 0 means even spacing. NaN for fewer than three points: one point has no
    neighbour, and two are always evenly spaced. Spacing says nothing about convergence or extent,
    so do not use it alone. Source: Schott 1995.

    Args:
        front: (n, n_obj) objectives.
    """
    from scipy.spatial import cKDTree

    points = np.asarray(front, dtype=np.float64)
    if len(points) < 3:
        return float("nan")
    distances = cKDTree(points).query(points, k=2, p=1)[0][:, 1]
    return float(np.std(distances, ddof=1))


def feasible_count(feasible: ArrayLike) -> int:
    """Count the feasible points."""
    return int(np.count_nonzero(np.asarray(feasible, dtype=bool)))


def feasible_share(feasible: ArrayLike) -> float:
    """Compute the share of feasible points among all, in [0, 1]; NaN if there are no points."""
    mask = np.asarray(feasible, dtype=bool)
    return feasible_count(mask) / len(mask) if len(mask) > 0 else float("nan")


def best_so_far(objectives: ArrayLike, feasible: ArrayLike) -> Array:
    """Compute the least value of each objective over the feasible points up to each evaluation.

    Minima of different objectives may belong to different points.

    Args:
        objectives: (n, n_obj) points in the order of evaluation.
        feasible: (n,) True for feasible points.

    Returns:
        (n, n_obj) least values; NaN before the first feasible point.
    """
    values = np.asarray(objectives, dtype=np.float64)
    usable = np.asarray(feasible, dtype=bool) & np.isfinite(values).all(axis=1)
    history = np.minimum.accumulate(np.where(usable[:, None], values, np.inf), axis=0)
    return np.asarray(np.where(np.isinf(history), np.nan, history))


def excess_above_static(objectives: ArrayLike, static: ArrayLike) -> Array:
    """Compute by how many percent peak normal forces exceed the normal forces at rest.

    Args:
        objectives: (..., n_obj) peak normal forces over the reference forces.
        static: (n_obj,) or scalar, normal forces at rest over the reference forces, positive.

    Returns:
        (..., n_obj) excess [%].
    """
    ratio = np.asarray(objectives, dtype=np.float64) / np.asarray(static, dtype=np.float64)
    return np.asarray(100.0 * (ratio - 1.0))


@dataclass(frozen=True)
class BindingBound:
    """A bound of a decision variable that solutions lie on.

    Attributes:
        variable: name of the variable, such as 'waypoint 2, yaw' or 'force limit'.
        side: lower or upper bound.
        value: value of the bound [m, rad, N].
        solutions: number of solutions on the bound.
    """

    variable: str
    side: Literal["lower", "upper"]
    value: float
    solutions: Count

    def __str__(self) -> str:
        return f"{self.side} bound of {self.variable}, {self.value:g}"


def binding_bounds(task: Task, x: Array) -> tuple[BindingBound, ...]:
    """Find the bounds of decision variables that solutions lie on.

    Variables with equal bounds are left out, since they have no range. The bounds of the force
    limit are left out too: a front naturally ends at the force at rest and at the robots' limit.

    Args:
        task: task that defines the variables and their bounds.
        x: (k, n_var) decision vectors of the solutions.

    Returns:
        The bounds with at least one solution, in the order of the variables.
    """
    x = np.asarray(x, dtype=float).reshape(-1, task.n_var)
    width = task.upper - task.lower
    found = []
    for k, name in enumerate(variable_names(task)[: task.n_path]):
        if width[k] == 0.0:
            continue
        near = ON_BOUND * width[k]
        lower = int((x[:, k] <= task.lower[k] + near).sum())
        upper = int((x[:, k] >= task.upper[k] - near).sum())
        if lower:
            found.append(BindingBound(name, "lower", float(task.lower[k]), lower))
        if upper:
            found.append(BindingBound(name, "upper", float(task.upper[k]), upper))
    return tuple(found)
