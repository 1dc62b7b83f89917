"""The box path: a natural quintic spline through waypoints, linear in the waypoints.

Paper Eqs. 13-20. The paper leaves the joining of the segments open; here the spline is C4 at
the inner waypoints with third and fourth derivatives zero at both ends (the natural quintic
spline, the curve of least integrated squared jerk through the waypoints). Knots are uniform in
the path parameter u in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.expression import Expression, as_mx, number, sx_parameters
from symbolic.records import Task


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
    """Build three functions of n values of u in [0, 1]: natural quintic splines, their first and
    their second derivatives by u.

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


MXGroups = Mapping[str, ca.MX]
NO_GROUPS: MXGroups = MappingProxyType({})
"""Empty mapping: the cell's numbers are constants, not inputs
(`symbolic.expression.mx_parameters`)."""


def _fixed(task: Task, value: Any, x: Expression, groups: MXGroups) -> Expression:
    """Return a parameter of the task as an expression of the type of the decision vector, SX or MX.

    Args:
        task: the task.
        value: number or symbolic expression of the parameter.
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


def _read_only(parameter: Array, position: Array, first: Array, second: Array) -> PathBasis:
    arrays = [np.ascontiguousarray(a, dtype=float) for a in (parameter, position, first, second)]
    for array in arrays:
        array.setflags(write=False)
    return PathBasis(*arrays)
