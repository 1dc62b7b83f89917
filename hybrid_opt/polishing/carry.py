"""Evaluation of a candidate for the polish: on the task's samples and at points between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.cell import SmoothCell
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.path.spline import place_redundant
from symbolic.records.task import POSE_SIZE
from symbolic.robot.arm import REACH_TOLERANCE
from symbolic.smooth.path_points import ManipulabilityLimit

SEPARATING_AXES_BELOW = 0.1
"""Lower bounds of the payload's distances that are smaller than this are improved by the gaps along
separating axes [m]."""

MINIMA_BELOW = 0.1
"""Minima between points are interpolated only for pairs that come closer than this [m]."""

DISTANCE_BATCH = 8
"""Number of distances that are measured together in the search for the first violation."""

Stretch = tuple[slice, int]
"""A range of points of the path, as a slice with a start, and the index of a pair."""


@dataclass(frozen=True)
class PlacedCarry:
    """A candidate evaluated at m points along the path, and at the task's n samples.

    Attributes:
        waypoints: (n_waypoints, 6 + k) box poses of the waypoints, each followed by k redundant
            joints [m, rad].
        pose, rate: (m, 6) box poses [m, rad] and their first derivatives by the path parameter.
        q: (m, joints) joint positions of each arm [rad]; undefined from point `reached` on.
        reached: number of points before the first one out of an arm's reach.
        unreachable_arms: indices of the arms that do not reach all points.
        manipulability: (reached, 2) absolute determinant of each arm's Jacobian over its least
            allowed value.
        split: (n, 2) two quantities [N] from which the normal forces follow: for soft fingers both
            normal forces, else normal component and tangential magnitude of the required force.
            Undefined in drivable cells and if the pads do not face each other.
        force: (n, 2) normal forces that are minimised, planned or robust [N].
        peak: (2,) largest of these forces of each robot over its reference force.
        shift: (n, 2) shifts of the centres of pressure over the patch radii.
        distances: distances of all checked pairs of bodies at the points within reach.
        gaps: function from the index of a pair of the payload and a single obstacle box to its gaps
            along several directions (reached, SEPARATING_DIRECTIONS) [m].
    """

    waypoints: Array
    pose: Array
    rate: Array
    q: tuple[Array, Array]
    reached: int
    unreachable_arms: tuple[int, ...]
    manipulability: Array
    split: Array
    force: Array
    peak: Array
    shift: Array
    distances: Distances = field(repr=False)
    gaps: Callable[[int], Array] = field(repr=False)

    @property
    def is_reachable(self) -> bool:
        """True if both arms reach all points."""
        return self.reached == len(self.pose)


def local_minima_below(values: Array, limit: float, stride: int | None = None) -> list[int]:
    """Find the lowest value in every stretch of a curve below a limit.

    A stretch is a longest possible run of successive values below the limit.

    Args:
        values: (n,) values along the path.
        limit: the limit, in the unit of the values.
        stride: distance, as a number of values, at which further points of each stretch are
            returned on both sides of the lowest value; None for the lowest values alone.

    Returns:
        Indices of the values found.
    """
    below = values < limit
    if not below.any():
        return []
    edges = np.diff(np.concatenate([[0], below.astype(np.int8), [0]]))
    points: list[int] = []
    for start, stop in zip(
        np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True
    ):
        least = start + int(np.argmin(values[start:stop]))
        if stride is None:
            points.append(least)
        else:
            points += range(least - (least - start) // stride * stride, stop, stride)
    return points


def interpolate_minima(clearance: Array) -> Array:
    """Estimate the minima of clearances between sampled points, and lower the samples beside them
    to these minima.

    While a body passes an edge, its clearance falls linearly to a kink and then rises linearly. The
    minimum is the intersection of two lines: one through the last two samples before the kink, one
    through the first two samples after it.

    Args:
        clearance: (n, k) clearances [m] of k pairs of bodies at n successive points.

    Returns:
        (n, k) clearances [m]. Where there is a kink between two samples, both are lowered to the
        estimated minimum.
    """
    low = clearance.copy()
    if len(clearance) < 4:
        return low
    before, left, right, after = (clearance[i : len(clearance) - 3 + i] for i in range(4))
    falling, rising = before - left, after - right
    both = (falling > 0.0) & (rising > 0.0)
    slopes = np.where(both, falling + rising, 1.0)
    share = np.where(both, (left - right + rising) / slopes, 0.0)
    kink = np.where((share > 0.0) & (share < 1.0), left - falling * share, np.inf)
    low[1:-2] = np.minimum(low[1:-2], kink)
    low[2:-1] = np.minimum(low[2:-1], kink)
    return low


class Distances:
    """Distances between the pairs of bodies of one candidate at n points of its path.

    A distance is measured when it is first needed, and stored.

    Attributes:
        bounds: (n, n_pairs) lower bounds of the distances [m].
        interpolated_clearance: (n, n_pairs) these bounds, lowered to their minima between points
            [m].
    """

    def __init__(
        self, bounds: Array, measure: Callable[..., object], configuration: Sequence[NDArray[Any]]
    ) -> None:
        """Estimate the distance of each pair of bodies at n points from lower bounds; nothing is
        measured yet.

        Bounds of close pairs are lowered by `interpolate_minima`.

        Args:
            bounds: (n, n_pairs) lower bounds of the distances [m].
            measure: `CollisionChecker.measure`, which raises chosen bounds to measured distances in
                place.
            configuration: the first three arguments of `measure`: box poses, and joint positions of
                the first and of the second arm, at the n points.
        """
        near = bounds.min(axis=0, initial=np.inf) < MINIMA_BELOW
        self.bounds, self.interpolated_clearance = bounds, bounds.copy()
        self.interpolated_clearance[:, near] = interpolate_minima(bounds[:, near])
        self._measure, self._configuration = measure, configuration
        self._values = self.interpolated_clearance.copy()
        self._unmeasured = np.ones(bounds.shape, dtype=np.bool_)

    def closer_than(self, limits: Array) -> dict[int, Array]:
        """Find the pairs of bodies that may be closer than their limits, and measure their
        distances.

        Args:
            limits: (n_pairs,) limit of each pair [m].

        Returns:
            By index of the pair, distances (n,) at all points [m], for each pair whose lower bound
            is below its limit at some point. Distances are measured at these points; elsewhere a
            lower bound may take the place of the distance.
        """
        close = self.interpolated_clearance < limits
        self._measure_pairs(*(close & self._unmeasured).nonzero())
        pairs = np.flatnonzero(close.any(axis=0)).tolist()
        return {pair: self._values[:, pair].copy() for pair in pairs}

    def _measure_pairs(self, points: NDArray[np.intp], pairs: NDArray[np.intp]) -> None:
        if not len(points):
            return
        rows, local = np.unique(points, return_inverse=True)
        wanted = np.zeros((len(rows), self.bounds.shape[1]), dtype=np.bool_)
        wanted[local, pairs] = True
        raised = self.bounds[rows]
        self._measure(*(part[rows] for part in self._configuration), raised, wanted)
        self._values[points, pairs] += raised[local, pairs] - self.bounds[points, pairs]
        self._unmeasured[points, pairs] = False

    def least(self, stretches: Sequence[Stretch], below: float) -> list[float]:
        """Return the least distance [m] in each of several stretches of the path.

        In a stretch the distance with the lowest bound is measured first, then the next one, until
        a measured distance is below all remaining bounds. If all bounds of a stretch reach `below`,
        the least bound is returned.

        Args:
            stretches: for each stretch, the slice of its successive points and the index of the
                pair of bodies.
            below: only distances with lower bounds below this one are measured [m].
        """
        open_, found = list(range(len(stretches))), [np.inf] * len(stretches)
        while open_:
            lowest = dict[int, tuple[int, int]]()
            for k in open_:
                where, pair = stretches[k]
                point = where.start + int(self._values[where, pair].argmin())
                found[k] = float(self._values[point, pair])
                if self._unmeasured[point, pair] and self.bounds[point, pair] < below:
                    lowest[k] = point, pair
            chosen = np.array(sorted(set(lowest.values())), dtype=np.intp).reshape(-1, 2)
            self._measure_pairs(chosen[:, 0], chosen[:, 1])
            open_ = list(lowest)
        return found

    def exceed(self, limits: Array) -> bool:
        """Return True if no pair of bodies is closer than its limit at any point.

        Distances are measured in order of their lower bounds, the least first. A distance below its
        limit ends the search.

        Args:
            limits: (n_pairs,) least allowed distance of each pair [m].
        """
        points, pairs = (self.interpolated_clearance < limits).nonzero()
        order = np.argsort(self.interpolated_clearance[points, pairs], kind="stable")
        for first in range(0, len(order), DISTANCE_BATCH):
            some = order[first : first + DISTANCE_BATCH]
            fresh = some[self._unmeasured[points[some], pairs[some]]]
            self._measure_pairs(points[fresh], pairs[fresh])
            if (self._values[points[some], pairs[some]] < limits[pairs[some]]).any():
                return False
        return True


class CarryReader:
    """Evaluates candidates of one cell at points along the path."""

    def __init__(self, cell: SmoothCell) -> None:
        self._cell = cell
        self._manipulability = [
            cell.functions.row(ManipulabilityLimit(arm), "first") for arm in (0, 1)
        ]
        self._radii = [contact.patch_radius for contact in cell.workcell.contacts]
        # Drivable carries have no rows of forces at samples.
        self._split_of = (
            None if cell.task.law.is_drivable else contact_model(cell.workcell).planned_quantities
        )

    def read(self, x: Array) -> PlacedCarry:
        """Evaluate a candidate at all points of the path.

        Args:
            x: (n_var,) decision vector.
        """
        cell, evaluator, grid = self._cell, self._cell.evaluator, self._cell.grid
        found = {name: value[0] for name, value in evaluator.outputs(x[None]).items()}
        waypoints = cell.waypoints(x)
        extended = grid.basis @ waypoints
        pose = np.ascontiguousarray(extended[:, :POSE_SIZE])
        guesses = [grid.between(found[f"q_{arm}"]) for arm in (1, 2)]
        if cell.task.redundant:
            place_redundant(cell.task, extended, guesses)
        posture = evaluator.functions["posture"].batch(pose, *guesses)
        followed = np.column_stack(
            [
                (posture[f"residual_{arm}"].reshape(-1) <= REACH_TOLERANCE)
                & (grid.between(found[f"lost_{arm}"].reshape(-1, 1))[:, 0] == 0.0)
                for arm in (1, 2)
            ]
        )
        lost = np.flatnonzero(~followed.all(axis=1))
        reached = int(lost[0]) if len(lost) else len(followed)
        q_1, q_2 = posture["q_1"], posture["q_2"]
        rate = np.ascontiguousarray((grid.rate_basis @ waypoints)[:, :POSE_SIZE])
        squares = [
            1.0 + function.batch(pose, rate, q_1, q_2)["value"] for function in self._manipulability
        ]
        force = found["normal_force"]
        minimised = force if cell.robust is None else cell.robust.forces(found)
        held = pose[:reached], q_1[:reached], q_2[:reached]
        gaps = lru_cache(maxsize=None)(partial(cell.functions.gaps, pose=held[0]))
        bounds = evaluator.checker.bounds(*held)
        # Those of the payload from a box are raised to the largest gap.
        near = bounds.min(axis=0, initial=np.inf) < SEPARATING_AXES_BELOW
        for pair in cell.functions.separable.intersection(np.flatnonzero(near).tolist()):
            np.maximum(bounds[:, pair], gaps(pair).max(axis=1), out=bounds[:, pair])
        return PlacedCarry(
            waypoints=waypoints,
            pose=pose,
            rate=rate,
            q=(q_1, q_2),
            reached=reached,
            unreachable_arms=tuple(np.flatnonzero(~followed.all(axis=0)).tolist()),
            manipulability=np.sqrt(np.maximum(np.column_stack(squares), 0.0))[:reached],
            split=force if self._split_of is None else self._split_of(found),
            force=minimised,
            peak=minimised.max(axis=0) / cell.task.reference_force,
            shift=found["pressure_shift"] / self._radii,
            distances=Distances(bounds, evaluator.checker.measure, held),
            gaps=gaps,
        )
