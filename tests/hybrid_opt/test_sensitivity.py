"""Derivatives by a cell's numbers: against the force and duration of carries in changed cells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.recommending.choice import LEADER
from hybrid_opt.robust.cases import worst_cases
from hybrid_opt.robust.force import pressing_model
from hybrid_opt.sensitivity import Sensitivity
from symbolic import outside
from symbolic.array import Array
from symbolic.contact.worst_cases import case_grasp_function, case_grasp_gradient_function
from symbolic.errors import SettingsError
from tests.symbolic.cells import RACK

CELLS = RACK.parent

H = 1e-4
"""Share of a usual change by which numbers are changed."""


def in_changed(cell: ho.Cell, key: str, value: float) -> tuple[float, float]:
    """Force and duration where a number of the file has another value, from the beginning."""
    path, _, index = key.removesuffix("]").rpartition("[") if key.endswith("]") else (key, "", "")
    whole: Any = value
    if index:
        whole = np.array(stated(cell, path), dtype=float)
        whole[int(index)] = value
    new = cell.changed({path: whole})
    carry, workcell = new.carry(cell.initial), new.workcell
    force = pressing_model(workcell).commanded(carry, workcell.uncertainty, LEADER)
    return float(force.max()), carry.duration


def stated(cell: ho.Cell, path: str) -> Any:
    """What the file states, or else the record."""
    table: Any = outside.toml_tables(Path(cell.workcell.source).read_bytes())
    for part in path.replace("[", ".").replace("]", "").split("."):
        table = table[int(part)] if part.isdigit() else table.get(part)
    return cell.workcell.payload.centre_of_mass if table is None else table


def assert_derivatives(cell: ho.Cell, row: Sensitivity, here: tuple[float, float]) -> None:
    """Both ways, by differences of second order on either side."""
    step = H * row.change
    for sign, slope in ((1.0, row.force), (-1.0, row.lowered)):
        near, far = (in_changed(cell, row.key, row.value + sign * k * step) for k in (1, 2))
        force, duration = (
            (4.0 * b - c - 3.0 * a) / (2.0 * step) for a, b, c in zip(here, near, far, strict=True)
        )
        scale = 1e-4 * here[0] / row.change  # a usual change that moves the force by that share
        assert slope == pytest.approx(force, rel=1e-3, abs=1e-2 * scale), row.key
        assert sign * row.duration == pytest.approx(duration, rel=1e-4, abs=1e-6), row.key


@pytest.mark.parametrize(("name", "first"), [("rack", 0), ("pandas", 1), ("transfer", 2)])
def test_numbers_do_what_changed_cells_say(name: str, first: int) -> None:
    """Another third of the numbers in every cell."""
    cell = ho.Cell.load(CELLS / f"{name}.toml")
    found = ho.sensitivities(cell.carry(cell.initial))
    here = in_changed(cell, "payload.mass", cell.workcell.payload.mass)
    assert here == pytest.approx((found.force, found.duration), rel=1e-9)
    told = {row.key for row in found.rows}
    assert {"payload.mass", "contacts[1].friction", "contacts[0].patch_radius"} <= told
    assert {"payload.centre_of_mass[0]", "task.reference_speed", "uncertainty.tilt"} <= told
    for row in found.rows[first::3]:
        assert_derivatives(cell, row, here)


def test_where_several_cases_rule_lowering_is_another_matter() -> None:
    """The pandas' path asks for as much at two samples, and both frictions are alike."""
    cell = ho.Cell.load(CELLS / "pandas.toml")
    found = ho.sensitivities(cell.carry(cell.initial))
    aside = found["payload.centre_of_mass[0]"]
    assert aside.force > 0.0
    assert aside.lowered > 0.0
    assert "lowered +" in repr(found)


def test_what_is_not_told_says_why_and_what_does_nothing_is_left_out() -> None:
    cell = ho.Cell.load(RACK)
    found = ho.sensitivities(cell.carry(cell.initial))
    assert "on a face" in found.missing["contacts[0].xyz[1]"]
    assert "zero" in found.missing["uncertainty.stiffness"]
    timed = ho.time_path(cell, cell.initial).carry
    assert timed is not None
    with pytest.raises(SettingsError, match="'constant' or 'ramped'"):
        ho.sensitivities(timed)
    with pytest.raises(KeyError):
        found["task.reference_angular_speed"]
    told = [row for row in found.rows if row.key in found.missing]
    assert not told
    assert np.isfinite([(row.force, row.lowered, row.duration) for row in found.rows]).all()
    assert "payload.mass = 10 kg" in found._repr_html_()


def test_slopes_of_what_pads_anywhere_need() -> None:
    """By motion and case: against differences of the force itself."""
    workcell = pressing_model(ho.Cell.load(CELLS / "fork.toml").workcell).workcell
    least = case_grasp_function(workcell, 1)
    at = np.random.default_rng(1).normal(scale=0.1, size=18)
    at[2] += 0.8
    case = worst_cases(workcell, workcell.uncertainty)[7]
    case[1] *= 0.9  # of equal frictions both decide

    def force(values: Array) -> Array:
        return np.array(least(*np.split(values, (6, 12, 18)))).ravel()

    point = np.concatenate([at, case])
    slopes = case_grasp_gradient_function(workcell, 1)(*np.split(point, (6, 12, 18)))[1]
    for k in (4, 9, 13, 18, 19, 22, 24, 27, 29, 34, 35):
        step = np.zeros(len(point))
        step[k] = 1e-5
        by = (force(point + step) - force(point - step)) / 2e-5
        np.testing.assert_allclose(np.array(slopes)[k], by, rtol=1e-3, atol=1e-2)


@pytest.mark.slow
def test_pads_anywhere() -> None:
    cell = ho.Cell.load(CELLS / "fork.toml")
    found = ho.sensitivities(cell.carry(cell.initial))
    here = in_changed(cell, "payload.mass", 8.0)
    for key in ("payload.mass", "uncertainty.disturbance[0]", "contacts[1].xyz[0]"):
        assert_derivatives(cell, found[key], here)
