"""Derivatives by a cell's numbers: against the force and duration of carries in changed cells."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.recommending.choice import LEADER
from hybrid_opt.robust.cases import worst_cases
from hybrid_opt.robust.force import pressing_model
from hybrid_opt.sensitivity import Sensitivity
from hybrid_opt.timing.given import drive_path
from symbolic import outside
from symbolic.array import Array
from symbolic.contact.worst_cases import case_grasp_function, case_grasp_gradient_function
from symbolic.errors import SettingsError
from tests.symbolic.cells import RACK

CELLS = RACK.parent

H = 1e-4
"""Share of a usual change by which numbers are changed."""


def changed_cell(cell: ho.Cell, key: str, value: float) -> ho.Cell:
    """The cell where a number of the file has another value."""
    path, _, index = key.removesuffix("]").rpartition("[") if key.endswith("]") else (key, "", "")
    whole: Any = value
    if index:
        whole = np.array(stated(cell, path), dtype=float)
        whole[int(index)] = value
    return cell.changed({path: whole})


def in_changed(cell: ho.Cell, key: str, value: float) -> tuple[float, float]:
    """Force and duration where a number of the file has another value, from the beginning."""
    new = changed_cell(cell, key, value)
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
    for sign, slope in ((1.0, row.force), (-1.0, row.lowered_force)):
        near, far = (in_changed(cell, row.key, row.value + sign * k * step) for k in (1, 2))
        force, duration = (
            (4.0 * b - c - 3.0 * a) / (2.0 * step) for a, b, c in zip(here, near, far, strict=True)
        )
        assert row.duration is not None
        scale = 1e-4 * here[0] / row.change  # a usual change that moves the force by that share
        assert slope == pytest.approx(force, rel=1e-3, abs=1e-2 * scale), row.key
        assert sign * row.duration == pytest.approx(duration, rel=1e-4, abs=1e-6), row.key


@pytest.mark.parametrize(
    ("name", "first"),
    [
        ("rack", 0),
        pytest.param("pandas", 1, marks=pytest.mark.slow),
        pytest.param("transfer", 2, marks=pytest.mark.slow),
    ],
)
def test_numbers_do_what_changed_cells_say(name: str, first: int) -> None:
    """Another third of the numbers in every cell."""
    cell = ho.Cell.load(CELLS / f"{name}.toml")
    steps: list[tuple[int, int]] = []
    found = ho.sensitivities(
        cell.carry(cell.initial), progress=lambda done, total: steps.append((done, total))
    )
    assert steps[-1][0] == steps[-1][1] >= len(found.rows)
    here = in_changed(cell, "payload.mass", cell.workcell.payload.mass)
    assert here == pytest.approx((found.force, found.duration), rel=1e-9)
    told = {row.key for row in found.rows}
    assert {"payload.mass", "contacts[1].friction", "contacts[0].patch_radius"} <= told
    assert {"payload.centre_of_mass[0]", "task.reference_speed", "uncertainty.tilt"} <= told
    for row in found.rows[first::3]:
        assert_derivatives(cell, row, here)


@pytest.mark.slow
def test_where_several_cases_rule_lowering_is_another_matter() -> None:
    """The pandas' path asks for as much at two samples, and both frictions are alike."""
    cell = ho.Cell.load(CELLS / "pandas.toml")
    found = ho.sensitivities(cell.carry(cell.initial))
    aside = found["payload.centre_of_mass[0]"]
    assert aside.force > 0.0
    assert aside.lowered_force > 0.0
    assert "(lowered +" in repr(found)


def test_what_is_not_told_says_why_and_what_does_nothing_is_left_out() -> None:
    cell = ho.Cell.load(RACK)
    found = ho.sensitivities(cell.carry(cell.initial))
    assert "on a face" in found.missing["contacts[0].xyz[1]"]
    assert "zero" in found.missing["uncertainty.stiffness"]
    with pytest.raises(KeyError):
        found["task.reference_angular_speed"]
    told = [row for row in found.rows if row.key in found.missing]
    assert not told
    assert np.isfinite([(row.force, row.lowered_force) for row in found.rows]).all()
    assert "payload.mass = 10 kg" in found._repr_html_()


TIMED = {
    "payload.mass": 0.004,
    "contacts[0].friction": 0.004,
    "robots[0].acceleration_max": 0.05,
    "robots[0].base.xyz[0]": 1e-3,
    "robots[1].base.xyz[2]": 1e-3,
    "task.goal[2]": 2e-3,
    "task.goal[3]": 2e-3,
}
"""How far numbers are changed where paths are timed anew."""


@pytest.mark.parametrize(
    ("name", "force"), [("rack", 60.0), pytest.param("pandas", None, marks=pytest.mark.slow)]
)
def test_the_fastest_duration_is_that_of_paths_timed_anew(name: str, force: float | None) -> None:
    """Both arms are at their limits together: most numbers cost more one way than the other."""
    cell, limits = ho.Cell.load(CELLS / f"{name}.toml"), ho.TimingLimits(force=force)
    timing = ho.time_path(cell, cell.initial, limits)
    found = ho.sensitivities(timing)
    assert found.duration == timing.duration
    rows = {row.key: row for row in found.rows}
    assert (rows["payload.mass"].duration == 0.0) == (force is None)
    for key, step in TIMED.items():
        row = rows[key]
        for sign, slope in ((1.0, row.duration), (-1.0, row.lowered_duration)):
            new = changed_cell(cell, key, row.value + sign * step)
            longer = ho.time_path(new, cell.initial, limits).duration - timing.duration
            assert slope is not None
            # Timings are exact to their limits' tolerance, which hardly differs between cells.
            assert slope * step == pytest.approx(longer, rel=0.06, abs=2e-5), key
    both = rows["robots[0].acceleration_max"]
    assert both.duration == pytest.approx(0.0, abs=1e-9)
    assert both.lowered_duration is not None
    assert both.lowered_duration > 0.01
    assert "structure" in found.missing["robots[0].base.rpy[0]"]


def test_the_force_of_a_timing_is_that_of_its_motion() -> None:
    cell = ho.Cell.load(RACK)
    timing = ho.time_path(cell, cell.initial)
    found = ho.sensitivities(timing)
    carry = timing.carry
    assert carry is not None
    for key in ("payload.mass", "uncertainty.tilt"):
        row = found[key]
        ends = []
        for sign in (-1.0, 1.0):
            workcell = changed_cell(cell, key, row.value + sign * 1e-4).workcell
            model = pressing_model(workcell)
            ends.append(model.commanded(carry, workcell.uncertainty, LEADER).max())
        assert row.force == pytest.approx((ends[1] - ends[0]) / 2e-4, rel=1e-4)


def test_what_has_no_sensitivities_is_refused() -> None:
    cell = ho.Cell.load(RACK)
    timing = ho.time_path(cell, cell.initial)
    assert timing.carry is not None
    with pytest.raises(SettingsError, match="give the timing itself"):
        ho.sensitivities(timing.carry)
    robust = replace(timing, limits=ho.TimingLimits(force=150.0, robust=True))
    with pytest.raises(SettingsError, match="robust forces"):
        ho.sensitivities(robust)
    assert timing.grid_speed is not None
    slower = drive_path(cell.timing_model, cell.initial, 0.9 * timing.grid_speed, timing.limits)
    with pytest.raises(SettingsError, match="not the fastest"):
        ho.sensitivities(slower)


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
