"""Rows at places as C puts them together, against the expressions that they are made of."""

from __future__ import annotations

import casadi as ca
import numpy as np

from hybrid_opt.polishing.carry import CarryReader
from hybrid_opt.polishing.rows import Layout, PlaceRow, Row, Rows
from symbolic.array import Array
from symbolic.records.task import initial_decision
from symbolic.smooth.passage import Passing, Separation
from symbolic.smooth.places import (
    Clearance,
    JointLimit,
    PlaceConstraint,
    PlaceSymbols,
    Reach,
    closure_functions,
    closure_name,
    row_function,
)
from tests.hybrid_opt.polishing.cells import smooth_cell
from tests.hybrid_opt.polishing.test_force import evaluator
from tests.symbolic.read.samples import RACK


def written(constraint: PlaceConstraint, place: int, x: Array, near: tuple[Array, Array]) -> Array:
    """A row's value, then its gradient by the decision vector: CasADi's functions one by one,
    joints following the box by the implicit function.

    Args:
        near: both arms' joints near those that hold the box there.
    """
    cell, model = smooth_cell(evaluator(RACK)), evaluator(RACK).compiled.model
    points, symbols = cell.waypoints(x), PlaceSymbols(model)
    pose, rate = (basis[place] @ points for basis in (cell.grid.basis, cell.grid.rate_basis))
    joints, follow = [], []
    for arm in (0, 1):
        closure = closure_functions(model, arm)[closure_name(arm, "first")]
        q, by_pose, _ = (np.array(out) for out in closure(pose, near[arm]))
        joints.append(q.ravel())
        follow.append(by_pose)
    numbers = [constraint.numbers(symbols)] if constraint.count(symbols) else []
    value, gradient = row_function(symbols, constraint, "first")(pose, rate, *joints, *numbers)
    slope = np.array(gradient).ravel()
    by_pose, at = slope[:6].copy(), 6
    by_rate = np.zeros(6)
    if constraint.moving:
        by_rate, at = slope[6:12], 12
    for arm in constraint.arms(model):
        by_pose += follow[arm].T @ slope[at : at + 6]
        at += 6
    rows, columns = cell.free
    by_x = cell.grid.basis[place][rows] * by_pose[columns]
    by_x += cell.grid.rate_basis[place][rows] * by_rate[columns]
    return np.append(float(ca.DM(value)), by_x) / constraint.scale


def test_values_and_slopes_are_those_of_the_expressions() -> None:
    cell = smooth_cell(evaluator(RACK))
    x = initial_decision(cell.task)
    carry = CarryReader(cell).read(x)
    box, *_ = sorted(cell.functions.separable)
    arm = next(k for k in range(99) if k not in cell.functions.separable)
    column = int(cell.evaluator.checker.geometry.columns[arm])
    kinds: list[PlaceConstraint] = [Clearance(arm, column), Reach(1), JointLimit(0, 2, "lower")]
    kinds += [JointLimit(1, 4, "upper"), Separation(box, 3), Passing(box, 5, 0)]
    listed: list[Row] = [PlaceRow(kind, place) for kind in kinds for place in (60, 150)]
    layout = Layout(listed)
    rows = Rows(cell, layout, carry.q)
    x = x + np.random.default_rng(0).uniform(-0.02, 0.02, len(x))
    values, slopes = rows.values(x), rows.slopes()
    for k, row in enumerate(layout.place_rows):
        near = carry.q[0][row.place], carry.q[1][row.place]
        wanted = written(row.constraint, row.place, x, near)
        found = np.append(values[k], slopes[k])
        np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-8)
