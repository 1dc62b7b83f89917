"""Rows at places of a cell with a redundant joint: derivatives by all of its variables."""

from __future__ import annotations

import numpy as np
import pytest

from codegen.interpreted import InterpretedFunction
from hybrid_opt.polishing.functions import RowFunctions
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.place_values import Places, PlaceValues
from symbolic.array import Array
from symbolic.cell_model import CellModel, build_cell_model
from symbolic.path.spline import path_basis
from symbolic.records.task import extended_waypoints, initial_decision
from symbolic.smooth.closure import closure_functions
from symbolic.smooth.joint_limit import JointLimit
from symbolic.smooth.passage import gap_function
from symbolic.smooth.place import Place
from symbolic.smooth.reach import Reach
from tests.redundant_cells import rack_on_rail

AT = np.array([30, 60])
"""Samples of the path at which rows are."""


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> CellModel:
    return build_cell_model(rack_on_rail(tmp_path_factory.mktemp("rail"), 0.3, 0.1))


@pytest.fixture(scope="module")
def rows(model: CellModel) -> PlaceValues:
    task = model.workcell.task
    u = np.linspace(0.0, 1.0, task.samples)[AT]
    basis = path_basis(len(task.waypoints), u)
    closures = {
        key: InterpretedFunction(function)
        for arm in (0, 1)
        for key, function in closure_functions(model, arm).items()
    }
    kinds = (Reach(0), Reach(1), JointLimit(0, 0, "upper"), JointLimit(0, 3, "lower"))
    placed = tuple(PlaceRow(kind, place) for kind in kinds for place in (0, 1))
    q = (model.branches[0][0].path[AT], model.branches[1][0].path[AT])
    places = Places(basis.position, basis.first, task.free_entries, q)
    gaps = InterpretedFunction(gap_function(Place(model)))
    return PlaceValues(placed, places, closures, RowFunctions(model, {}, gaps))


def first(rows: PlaceValues, model: CellModel, x: Array) -> tuple[Array, Array]:
    return rows.first(extended_waypoints(model.workcell.task, x))


def start(model: CellModel) -> Array:
    x = initial_decision(model.workcell.task)
    assert len(x) == 18 + 5
    return x + np.random.default_rng(1).uniform(-0.02, 0.02, len(x))


def test_gradients_are_those_of_differences(rows: PlaceValues, model: CellModel) -> None:
    x, step = start(model), 1e-6
    _, exact = first(rows, model, x)
    measured = [
        (first(rows, model, x + step * d)[0] - first(rows, model, x - step * d)[0]) / (2 * step)
        for d in np.eye(len(x))
    ]
    np.testing.assert_allclose(exact, np.array(measured).T, rtol=1e-5, atol=1e-6)
    assert np.abs(exact[:, 18:]).max() > 0.01


def test_curvature_is_that_of_the_gradients(rows: PlaceValues, model: CellModel) -> None:
    x, step = start(model), 1e-6
    weight = np.random.default_rng(2).normal(size=8)

    def slope(at: Array) -> Array:
        return weight @ first(rows, model, at)[1]

    measured = [(slope(x + step * d) - slope(x - step * d)) / (2 * step) for d in np.eye(len(x))]
    first(rows, model, x)
    np.testing.assert_allclose(rows.second(weight), np.array(measured), rtol=1e-4, atol=1e-4)
