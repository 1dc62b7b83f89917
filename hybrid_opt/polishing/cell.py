"""A cell of a polish: points of the path and scaled variables, which all of its programs share, and
candidates evaluated on the task's samples and at the points between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import ROBUST_OBJECTIVES
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.robust import RobustSamples
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.path.spline import extended_waypoints, path_basis, place_redundant
from symbolic.records.task import POSE_SIZE, Task
from symbolic.robot.arm import REACH_TOLERANCE
from symbolic.smooth.passage import GAPS
from symbolic.smooth.path_points import (
    ManipulabilityLimit,
)
from symbolic.smooth.samples import (
    sample_blocks,
)

POINT_SPACING = 0.0025
"""Approximate distance of neighbouring points in the path parameter. The clearance covers minima
between two points, and the final certification checks them."""

SEPARATING_AXES_BELOW = 0.1
"""Lower bounds of the payload's distances that are smaller than this are improved by the gaps along
separating axes [m]."""

MINIMA_BELOW = 0.1
"""Minima between points are interpolated only for pairs that come closer than this [m]."""

DISTANCE_BATCH = 8
"""Number of distances that are measured together in the search for the first violation."""

Stretch = tuple[slice, int]
"""A range of points of the path, as a slice with a start, and the index of a pair."""


class Grid:
    """Points along a task's path: the task's samples, and equally many points between neighbours.

    Attributes:
        per_sample: number of points per interval between samples.
        parameter: (m,) path parameter of all points, in [0, 1].
        sample_parameter: (n,) path parameter of the samples.
        basis: (m, n_waypoints) matrix B: the poses at the points are B W for waypoints W, both box
            poses with redundant joints.
        rate_basis: (m, n_waypoints) like B, for the poses' first derivatives by the path parameter.
    """

    def __init__(self, task: Task) -> None:
        intervals = task.samples - 1
        self.per_sample = max(1, round(1.0 / (intervals * POINT_SPACING)))
        self.sample_parameter = np.linspace(0.0, 1.0, task.samples)
        self.parameter = np.linspace(0.0, 1.0, intervals * self.per_sample + 1)
        along = path_basis(len(task.waypoints), self.parameter)
        self.basis, self.rate_basis = along.position, along.first

    def points(self, width: float) -> int:
        """Convert a width in the path parameter to a number of intervals between points, at least
        one.
        """
        return max(1, round(width * (len(self.parameter) - 1)))

    def samples(self, width: float) -> int:
        """Convert a width in the path parameter to a number of intervals between samples, at least
        one.
        """
        return max(1, round(width * (len(self.sample_parameter) - 1)))

    def between(self, values: Array) -> Array:
        """Interpolate values at the n samples linearly to all m points.

        Args:
            values: (n, k) k values at each sample.

        Returns:
            (m, k) values at the points.
        """
        return np.column_stack(
            [np.interp(self.parameter, self.sample_parameter, column) for column in values.T]
        )

    def movable(self, point: int) -> bool:
        """Return True if a point, given by its index, is neither the first nor the last of the
        path, which are fixed.
        """
        return 0 < point < len(self.parameter) - 1


class SmoothCell:
    """Data that all programs of a cell's polish share.

    Attributes:
        evaluator: evaluator of candidates by the full model.
        functions: compiled functions of the polish.
        workcell, task: the evaluator's workcell and its task.
        grid: points along the task's path.
        clearance: distance that bodies keep beyond the collision tolerance [m].
        robust: computes robust forces at samples if these are minimised; None for planned forces.
        centre, half: (n_var,) middle and half range of each decision variable [m, rad, N]. Scaled
            variables xi in [-1, 1] follow from x = centre + half * xi; half is 1 for a fixed
            variable.
        free: row and column indices of the decision variables among the waypoints (n_waypoints, 6 +
            m), box poses with m redundant joints.
        blocks: groups of samples that one compiled function evaluates.
        coefficients: (2, branches, 2) coefficients of the linear functions of both
            `force_quantities` whose maximum is the normal force of each contact.
        has_pressure_limit: whether the contact model limits the shift of the pressure.
    """

    def __init__(
        self, evaluator: CandidateEvaluator, functions: PolishFunctions, clearance: float
    ) -> None:
        """Derive from a cell's task the half ranges and centre of the variables, the grid of points
        along the path and the blocks of samples that one function call serves.

        Args:
            evaluator: evaluator of candidates by the full model.
            functions: compiled functions of the polish.
            clearance: distance that bodies keep beyond the collision tolerance [m].

        Raises:
            SettingsError: the objectives are robust normal forces, which hold the box in every case
                of the uncertainty, but the cell's pads or uncertainty do not admit them.
        """
        self.evaluator, self.functions, self.clearance = evaluator, functions, clearance
        self.workcell, self.task = evaluator.workcell, evaluator.workcell.task
        is_robust = evaluator.objective_names == ROBUST_OBJECTIVES
        self.robust = RobustSamples(self.workcell) if is_robust else None
        self.grid = Grid(self.task)
        half = (self.task.upper - self.task.lower) / 2.0
        self.centre = (self.task.upper + self.task.lower) / 2.0
        self.half = np.where(half > 0.0, half, 1.0)
        self.blocks = sample_blocks(self.task)
        model = contact_model(self.workcell)
        self.coefficients = model.force_branches
        self.has_pressure_limit = model.has_pressure_limit
        self.free = self.task.free_entries
        self._n_path, self._fixed = self.task.n_path, self.task.fixed_waypoints

    def scaled(self, x: Array) -> Array:
        """Scale a decision vector x (n_var,) to variables xi (n_var,), in [-1, 1] within the
        bounds."""
        return (x - self.centre) / self.half

    def unscaled(self, xi: Array) -> Array:
        """Return the decision vector x (n_var,) of scaled variables xi (n_var,)."""
        return self.centre + self.half * xi

    def step(self, start: Array, end: Array) -> float:
        """Return the largest change of any scaled variable between two decision vectors.

        Args:
            start: (n_var,) decision vector.
            end: (n_var,) another decision vector.
        """
        return float(np.max(np.abs(end - start) / self.half))

    def waypoints(self, x: Array) -> Array:
        """Return the waypoints of a decision vector.

        The result is that of `extended_waypoints`. It is computed faster here unless an angle
        changes by more than pi between two waypoints.

        Args:
            x: (n_var,) decision vector.

        Returns:
            (n_waypoints, 6 + m) box poses [m, rad] followed by m redundant joints [rad or m].
        """
        points = self._fixed.copy()
        points[self.free] = x[: self._n_path]
        turns = points[1:, 3:POSE_SIZE] - points[:-1, 3:POSE_SIZE]
        return extended_waypoints(self.task, x) if np.abs(turns).max() > np.pi else points


# --- candidates at the points of the path ---


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
            Undefined if the pads do not face each other, and in drivable cells, whose carries are
            timed from rest to rest within all limits.
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
        stride: None to find only the lowest values. A number k to find also every k-th value before
            and after the lowest one, up to the ends of its stretch.

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
            Distances (n,) at all points [m] by index of the pair, for each pair whose lower bound
            is below its limit at some point. At points with a bound below the limit the distances
            are measured; at the other points they may be lower bounds.
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
        """Return the least distance [m] in each of several stretches of the path, with as few
        measurements as possible.

        In a stretch the distance with the lowest bound is measured first, then the next one, until
        a measured distance is below all remaining bounds. If all bounds of a stretch reach `below`,
        nothing is measured and the least bound is returned.

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
        gaps = lru_cache(maxsize=None)(partial(self._gaps, held[0]))
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

    def _gaps(self, pose: Array, pair: int) -> Array:
        """Compute the gaps between the payload and an obstacle box along several directions.

        A gap is the distance between the projections of both bodies onto the direction, negative if
        the projections overlap. The largest gap is a lower bound of the distance of the bodies.

        Args:
            pose: (n, 6) box poses [m, rad].
            pair: index of the pair of payload and obstacle, one of `PolishFunctions.separable`.

        Returns:
            (n, SEPARATING_DIRECTIONS) gaps [m].
        """
        functions = self._cell.functions
        return functions.built[GAPS].batch(pose, functions.obstacle(pair))["gaps"]
