"""The box path: a natural quintic spline through waypoints, linear in the waypoints; the waypoints
of a decision vector, and their refinement.

Paper Eqs. 13-20. The paper leaves the joining of the segments open; here the spline is C4 at
the inner waypoints with third and fourth derivatives zero at both ends (the natural quintic
spline, the curve of least integrated squared jerk through the waypoints). Knots are uniform in
the path parameter u in [0, 1].

A piece is the path between two stated waypoints, those of the file. Free waypoints cut each piece
into `Task.pieces` equal parts. Neither the knots' spacing nor the end conditions depend on them, so
every path through the stated waypoints is also a path of the refined task. Searches draw the stated
waypoints; a polish moves all waypoints.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.expression import Expression, as_mx, number, sx_parameters
from symbolic.records.task import POSE_SIZE, RedundantJoint, Task, Waypoint


@dataclass(frozen=True)
class PathBasis:
    """Constant matrices of the spline from waypoints to n samples: a row per sample, a column per
    waypoint. A product with waypoint poses (n_waypoints, 6) gives poses (n, 6).

    Attributes:
        parameter: (n,) path parameter u of every sample.
        position: (n, n_waypoints) matrix to the values of the spline.
        first, second: (n, n_waypoints) matrices to the first and second derivatives of the spline
            by u.
    """

    parameter: Array
    position: Array
    first: Array
    second: Array


def path_basis(n_waypoints: int, parameter: Array) -> PathBasis:
    """Compute the matrices from waypoints to the natural quintic spline and its derivatives at n
    values of u.

    Args:
        n_waypoints: number of waypoints, at least 2; two make a straight line.
        parameter: (n,) values of u in [0, 1].
    """
    if n_waypoints == 2:
        # Two points do not determine a natural quintic spline: the straight line has least jerk.
        position = np.column_stack([1.0 - parameter, parameter])
        slope = np.tile([-1.0, 1.0], (len(parameter), 1))
        return _read_only(parameter, position, slope, np.zeros_like(slope))
    return _read_only(parameter, *(spline(parameter) for spline in _natural_splines(n_waypoints)))


def path_position(n_waypoints: int, parameter: Array) -> Array:
    """Compute the matrix (n, n_waypoints) that maps waypoints to points of the spline at n values
    of u.

    Args:
        n_waypoints: number of waypoints, at least 2.
        parameter: (n,) values of u in [0, 1].
    """
    if n_waypoints == 2:
        return path_basis(n_waypoints, parameter).position
    return np.ascontiguousarray(_natural_splines(n_waypoints)[0](parameter), dtype=float)


@cache
def _natural_splines(n_waypoints: int) -> tuple[Callable[[Array], Array], ...]:
    """Build the natural quintic splines through unit values at the waypoints: functions of n values
    of u in [0, 1] for the splines, their first and their second derivatives by u.

    Each function returns a matrix (n, n_waypoints). Column k belongs to the spline that is 1 at
    waypoint k and 0 at all others.
    """
    # Not imported at the top: SciPy takes long to start, and compiled functions need no basis.
    from scipy.interpolate import make_interp_spline

    knots = np.linspace(0.0, 1.0, n_waypoints)
    natural = [(3, np.zeros(n_waypoints)), (4, np.zeros(n_waypoints))]
    spline = make_interp_spline(knots, np.eye(n_waypoints), k=5, bc_type=(natural, natural))
    return spline, spline.derivative(1), spline.derivative(2)


def sample_basis(task: Task) -> PathBasis:
    """Compute the spline's basis matrices at the samples of a task, which are uniform in u."""
    return path_basis(len(task.waypoints), np.linspace(0.0, 1.0, task.samples))


def _read_only(parameter: Array, position: Array, first: Array, second: Array) -> PathBasis:
    arrays = [np.ascontiguousarray(a, dtype=float) for a in (parameter, position, first, second)]
    for array in arrays:
        array.setflags(write=False)
    return PathBasis(*arrays)


# --- the waypoints of a decision vector ---


def waypoints_of(task: Task, x: Array) -> Array:
    """Return the box poses at all waypoints of decision vectors, with unwrapped angles.

    Args:
        task: task with n_waypoints waypoints, fixed and free.
        x: (..., n_var) decision vectors.

    Returns:
        (..., n_waypoints, 6) poses [m, rad].
    """
    return extended_waypoints(task, x)[..., :POSE_SIZE]


def extended_waypoints(task: Task, x: Array) -> Array:
    """Return the box poses and redundant joints at all waypoints of decision vectors, with
    unwrapped angles.

    Args:
        task: task with n_waypoints waypoints and m redundant joints.
        x: (..., n_var) decision vectors.

    Returns:
        (..., n_waypoints, 6 + m) poses [m, rad], then redundant joints [rad or m].
    """
    points = np.empty((*x.shape[:-1], *task.fixed_waypoints.shape))
    points[...] = task.fixed_waypoints
    rows, columns = task.free_entries
    points[..., rows, columns] = x[..., : task.n_path]
    points[..., 3:POSE_SIZE] = task.orientation.unwrapped(points[..., 3:POSE_SIZE])
    return points


def place_redundant(task: Task, extended: Array, joints: Sequence[Array]) -> None:
    """Copy the redundant joints of n extended poses into the joint positions of both arms, in
    place.

    Args:
        task: task with m redundant joints.
        extended: (n, 6 + m) box poses, then redundant joints.
        joints: for each arm its joint positions (n, joints), which are changed.
    """
    for arm, q in enumerate(joints):
        for joint, entry in task.redundant_entries[arm]:
            q[:, joint] = extended[:, entry]


MXGroups = Mapping[str, ca.MX]
NO_GROUPS: MXGroups = MappingProxyType({})
"""Empty mapping: the cell's numbers are constants, not inputs
(`symbolic.expression.mx_parameters`)."""


def _fixed(task: Task, value: Any, x: Expression, groups: MXGroups) -> Expression:
    """Return a value that the task fixes as an expression of the same CasADi type as the decision
    vector, SX or MX.

    Args:
        task: the task.
        value: number or symbolic expression.
        x: decision vector, whose type the result has.
        groups: MX vectors of the task's parameters, by name of the parameter group; empty for plain
            numbers.
    """
    if isinstance(x, ca.MX) and isinstance(value, ca.SX):
        return as_mx(value, sx_parameters(task), groups)
    return type(x)(number(value))


def waypoint_matrix(task: Task, x: Expression, groups: MXGroups = NO_GROUPS) -> Expression:
    """Compute the box poses at all waypoints from the decision vector, with unwrapped angles (paper
    Eq. 17).

    Args:
        task: task that states the fixed waypoints.
        x: (n_var,) decision vector; it starts with the poses of the free waypoints in path order.
        groups: MX vectors of the task's parameters, by name of the parameter group; empty for plain
            numbers.

    Returns:
        (6, n_waypoints) box poses: positions [m], orientations [rad].
    """
    columns = []
    taken = 0
    for waypoint in task.waypoints:
        if waypoint.is_fixed:
            columns.append(_fixed(task, waypoint.lower, x, groups))
        else:
            columns.append(x[6 * taken : 6 * taken + 6])
            taken += 1
    pairs = [] if task.orientation.is_vector else pairwise(range(len(columns)))
    for previous, current in pairs:
        columns[current] = ca.vertcat(
            columns[current][:3], _unwrap(columns[previous][3:], columns[current][3:])
        )
    return ca.horzcat(*columns)


def extended_matrix(
    task: Task, x: Expression, waypoints: Expression, groups: MXGroups = NO_GROUPS
) -> Expression:
    """Compute the box poses at all waypoints, with the positions of the redundant joints below
    them.

    Args:
        task: task with m redundant joints.
        x: (n_var,) decision vector.
        waypoints: (6, n_waypoints) box poses from `waypoint_matrix`.
        groups: MX vectors of the task's parameters, by name of the parameter group; empty for plain
            numbers.

    Returns:
        (6 + m, n_waypoints) box poses [m, rad] and redundant joint positions [rad or m].
    """
    if not task.redundant:
        return waypoints
    at, rows = task.n_box, []
    for joint in task.redundant:
        row = []
        for k, moves in enumerate(joint.moving.tolist()):
            row.append(x[at] if moves else _fixed(task, joint.lower[k], x, groups))
            at += int(moves)
        rows.append(row)
    # Column by column, a form that code for lanes knows.
    return ca.horzcat(
        *[
            ca.vertcat(waypoints[:, k], *[row[k] for row in rows])
            for k in range(len(task.waypoints))
        ]
    )


def _unwrap(reference: Expression, angles: Expression) -> Expression:
    """Return angles moved by full turns to within half a turn of the angles `reference` [rad].

    A difference of exactly half a turn keeps its sign (as in NumPy's `unwrap`).
    """
    difference = angles - reference
    turns = ca.sign(difference) * ca.ceil(ca.fabs(difference) / (2.0 * np.pi) - 0.5)
    return angles - 2.0 * np.pi * turns


# --- refinement: waypoints between those of the file ---


CACHED_TASKS = 16
"""Number of tasks whose coarse task is cached."""

_BOUNDS = ("lower", "upper")


def refined_task(task: Task) -> Task:
    """Return the task with `task.pieces` - 1 free waypoints added between any two neighbouring
    waypoints of its file.

    The bounds of the added waypoints admit every path that the bounds in the file admit.
    """
    n = len(task.waypoints)
    by = _through(n, (n - 1) * task.pieces + 1)

    def bounds(lower: Array, upper: Array) -> tuple[Array, Array]:
        middle, half = by @ ((lower + upper) / 2.0), np.abs(by) @ ((upper - lower) / 2.0)
        least, most = middle - half, middle + half
        least[:: task.pieces], most[:: task.pieces] = lower, upper
        return least, most

    lower, upper = bounds(*(np.array([getattr(w, k) for w in task.waypoints]) for k in _BOUNDS))
    hand_made = np.array([waypoint.lower for waypoint in task.waypoints])
    hand_made[list(task.free_indices)] = task.initial
    hand_made[:, 3:] = task.orientation.unwrapped(hand_made[:, 3:])
    hand_made = np.clip(by @ hand_made, lower, upper)
    redundant = []
    for joint in task.redundant:
        least, most = bounds(joint.lower, joint.upper)
        initial = np.clip(by @ joint.initial, least, most)
        redundant.append(replace(joint, lower=least, upper=most, initial=initial))
    return _with_waypoints(task, lower, upper, hand_made, redundant)


@lru_cache(maxsize=CACHED_TASKS)
def coarse_task(task: Task) -> Task:
    """Return the task without the waypoints that `refined_task` added, with `pieces` 1."""
    if task.pieces == 1:
        return task
    every = slice(None, None, task.pieces)
    lower, upper = (np.array([getattr(w, k) for w in task.waypoints[every]]) for k in _BOUNDS)
    hand_made = np.array([waypoint.lower for waypoint in task.waypoints])
    hand_made[list(task.free_indices)] = task.initial
    redundant = [
        replace(j, lower=j.lower[every], upper=j.upper[every], initial=j.initial[every])
        for j in task.redundant
    ]
    return replace(_with_waypoints(task, lower, upper, hand_made[every], redundant), pieces=1)


def _with_waypoints(
    task: Task, lower: Array, upper: Array, hand_made: Array, redundant: list[RedundantJoint]
) -> Task:
    waypoints = tuple(map(Waypoint, lower, upper))
    found = replace(task, waypoints=waypoints, redundant=tuple(redundant))
    return replace(found, initial=hand_made[list(found.free_indices)])


def coarse_entries(task: Task) -> NDArray[np.intp]:
    """Return the indices of those path variables of a refined task that belong to waypoints of the
    file.

    Returns:
        (coarse n_path,) integers, in the order of the path variables.
    """
    return np.flatnonzero(task.free_entries[0] % task.pieces == 0)


def hierarchical_basis(task: Task) -> tuple[Array, Array]:
    """Compute a basis in which an optimiser changes a refined path: its coarse variables move the
    path smoothly over long distances, its fine variables locally.

    The grid of the file's waypoints is refined in steps, by halves as long as that is possible.
    Each waypoint belongs to the coarsest grid that contains it. A move of a waypoint also moves the
    waypoints of all finer grids, so that they stay on the spline through the waypoint's grid.

    Returns:
        (n_path, n_path) matrix whose column j is the change of all path variables for a unit move
        of variable j; and (n_path,) squared grid spacing of each variable, relative to the spacing
        of the file's waypoints. Equal moves cause accelerations inversely proportional to the
        squared spacing.
    """
    (rows, columns), m = task.free_entries, len(task.waypoints)
    by, square = np.zeros((task.n_path, task.n_path)), np.zeros(task.n_path)
    together = columns[:, None] == columns
    for step in _steps(task.pieces):
        own = (rows % step == 0) & (square == 0.0)
        through = _through((m - 1) // step + 1, m)[np.ix_(rows, rows[own] // step)]
        by[:, own] = np.where(together[:, own], through, 0.0)
        square[own] = (step / task.pieces) ** 2
    return by, square


def _steps(pieces: int) -> list[int]:
    """Return the spacing of the waypoints in each grid, from the coarsest grid to 1.

    The spacing is counted in waypoints of the refined task.

    Args:
        pieces: number of pieces between two waypoints of the file in the refined task.
    """
    steps = [pieces]
    while steps[-1] > 1:
        steps.append(steps[-1] // 2 if steps[-1] % 2 == 0 else 1)
    return steps


def resample_decisions(x: Array, source: Task, target: Task) -> Array:
    """Convert decision vectors of one task to the waypoints of another task.

    The paths stay the same if the target has all waypoints of the source. Otherwise the new paths
    pass through the common waypoints. Path variables are clipped to the bounds of the target.

    Args:
        x: (n, source.n_path or more) decision vectors; entries after the path variables are kept.
        source: task of x.
        target: task of the result.

    Returns:
        (n, target.n_path or more) decision vectors.
    """
    x = np.atleast_2d(x)
    if len(source.waypoints) == len(target.waypoints):
        return x
    by, n = _through(len(source.waypoints), len(target.waypoints)), target.n_path
    rows, columns = target.free_entries
    paths = (by @ extended_waypoints(source, x))[:, rows, columns]
    within = np.clip(paths, target.lower[:n], target.upper[:n])
    return np.hstack([within, x[:, source.n_path :]])


@cache
def _through(n: int, m: int) -> Array:
    """Compute the matrix (m, n) that maps n waypoints to m points of the natural quintic spline
    through them, evenly spaced in u."""
    u = np.linspace(0.0, 1.0, m)
    by = path_position(n, u).copy()
    known, where = np.divmod(np.arange(m) * (n - 1), m - 1)
    by[where == 0] = np.eye(n)[known[where == 0]]
    by.flags.writeable = False
    return by
