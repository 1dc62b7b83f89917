"""What a cell's numbers do: derivatives, sweeps over them, and better places of pads."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.extras import sweeping
from hybrid_opt.extras.gripping import _changes
from hybrid_opt.front import Front
from hybrid_opt.robust.cases import LEADER, worst_cases
from hybrid_opt.robust.force import robust_model
from hybrid_opt.sensitivity import Sensitivity
from hybrid_opt.timing.solve import drive_path
from symbolic import safe_io
from symbolic.array import Array
from symbolic.contact.registry import command_model
from symbolic.contact.worst_cases import case_gradient_function, case_squeeze_function
from symbolic.errors import SettingsError, WorkcellError
from tests.hybrid_opt.cells import drivable, shipped
from tests.refusals import refused

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
    force = robust_model(workcell).commanded(carry, workcell.uncertainty, LEADER)
    return float(force.max()), carry.duration


def stated(cell: ho.Cell, path: str) -> Any:
    """What the file states, or else the record."""
    table: Any = safe_io.toml_tables(Path(cell.workcell.source).read_bytes())
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


@cache
def of_carry(name: str) -> ho.Sensitivities:
    """Of a cell's hand-made carry under its own time law."""
    cell, steps = shipped(name), list[tuple[int, int]]()
    found = ho.sensitivities(
        cell.carry(cell.initial), progress=lambda done, total: steps.append((done, total))
    )
    assert steps[-1][0] == steps[-1][1] >= len(found.rows)
    return found


@pytest.mark.parametrize(
    ("name", "first"),
    [
        ("rack", 0),
        pytest.param("rack", 3, marks=pytest.mark.slow),
        *(pytest.param("pandas", first, marks=pytest.mark.slow) for first in (1, 4)),
        *(pytest.param("transfer", first, marks=pytest.mark.slow) for first in (2, 5)),
    ],
)
def test_numbers_do_what_changed_cells_say(name: str, first: int) -> None:
    """Every sixth number from one on, other ones in every cell."""
    cell, found = shipped(name), of_carry(name)
    here = in_changed(cell, "payload.mass", cell.workcell.payload.mass)
    assert here == pytest.approx((found.force, found.duration), rel=1e-9)
    told = {row.key for row in found.rows}
    assert {"payload.mass", "contacts[1].friction", "contacts[0].patch_radius"} <= told
    assert {"payload.centre_of_mass[0]", "task.reference_speed", "uncertainty.tilt"} <= told
    for row in found.rows[first::6]:
        assert_derivatives(cell, row, here)


@pytest.mark.slow
def test_where_several_cases_rule_lowering_is_another_matter() -> None:
    """The pandas' path asks for as much at two samples, and both frictions are alike."""
    found = of_carry("pandas")
    aside = found["payload.centre_of_mass[0]"]
    assert aside.force > 0.0
    assert aside.lowered_force > 0.0
    assert "(lowered +" in repr(found)


def test_what_is_not_told_says_why_and_what_does_nothing_is_left_out() -> None:
    found = of_carry("rack")
    assert " face" in found.missing["contacts[0].xyz[1]"]
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
    "robots[1].base.xyz[2]": 1e-3,
    "task.goal[3]": 2e-3,
}
"""How far numbers are changed where paths are timed anew."""


@pytest.mark.parametrize(
    ("name", "force"), [("rack", 60.0), pytest.param("pandas", None, marks=pytest.mark.slow)]
)
def test_the_fastest_duration_is_that_of_paths_timed_anew(name: str, force: float | None) -> None:
    """Both arms are at their limits together: most numbers cost more one way than the other. The
    force is that of the same motion."""
    cell, limits = shipped(name), ho.TimingLimits(force=force)
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
    carry = timing.carry
    assert carry is not None
    for key in ("payload.mass", "uncertainty.tilt"):
        row = rows[key]
        ends = []
        for sign in (-1.0, 1.0):
            workcell = changed_cell(cell, key, row.value + sign * 1e-4).workcell
            model = robust_model(workcell)
            ends.append(model.commanded(carry, workcell.uncertainty, LEADER).max())
        assert row.force == pytest.approx((ends[1] - ends[0]) / 2e-4, rel=1e-4)


def test_what_has_no_sensitivities_is_refused() -> None:
    cell = shipped("rack")
    timing = ho.time_path(cell, cell.initial)
    assert timing.carry is not None
    with refused(SettingsError, "timing"):
        ho.sensitivities(timing.carry)
    robust = replace(timing, limits=ho.TimingLimits(force=150.0, robust=True))
    with refused(SettingsError, "robust-timing"):
        ho.sensitivities(robust)
    slower = drive_path(cell.timing_model, cell.initial, 0.9 * timing.grid_speed, timing.limits)
    with refused(SettingsError, "not-fastest"):
        ho.sensitivities(slower)


def test_slopes_of_what_pads_anywhere_need() -> None:
    """By motion and case: against differences of the force itself."""
    workcell = robust_model(shipped("fork").workcell).workcell
    least = case_squeeze_function(workcell, 1)
    at = np.random.default_rng(1).normal(scale=0.1, size=18)
    at[2] += 0.8
    case = worst_cases(command_model(workcell), workcell.uncertainty)[7]
    case[1] *= 0.9  # of equal frictions both decide

    def force(values: Array) -> Array:
        return np.array(least(*np.split(values, (6, 12, 18)))).ravel()

    point = np.concatenate([at, case])
    function = case_gradient_function(workcell, 1, numbers=True)
    slopes = function(*np.split(point, (6, 12, 18)))[1]
    for k in (4, 9, 13, 18, 19, 22, 24, 27, 29, 34, 35):
        step = np.zeros(len(point))
        step[k] = 1e-5
        by = (force(point + step) - force(point - step)) / 2e-5
        np.testing.assert_allclose(np.array(slopes)[k], by, rtol=1e-3, atol=1e-2)


@pytest.mark.slow
def test_pads_anywhere() -> None:
    cell, found = shipped("fork"), of_carry("fork")
    here = in_changed(cell, "payload.mass", 8.0)
    for key in ("payload.mass", "uncertainty.disturbance[0]", "contacts[1].xyz[0]"):
        assert_derivatives(cell, found[key], here)


OVER = {"payload.mass": [8.0, 10.0], "contacts.friction": [0.3, 1.0]}


@pytest.fixture(scope="module")
def cell() -> ho.Cell:
    return drivable("rack")


def test_a_fixed_path_is_what_it_is_in_each_cell(
    cell: ho.Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "sweep.json"
    found = ho.sweep(cell, cell.initial, OVER, fixed=True, file=file)
    assert [row.values for row in found.rows] == [(8, 0.3), (8, 1), (10, 0.3), (10, 1)]
    none, light, _, heavy = found.rows
    assert np.isnan(none.duration)
    assert "friction" in none.remark
    assert light.force < heavy.force
    one = cell.changed({"payload.mass": 8.0, "contacts.friction": 1.0})
    x = np.append(one.initial[:-1], one.workcell.task.force_limit[1])
    own = ho.recommend(Front.of_search(one, "given", one.evaluator.certified(one.evaluate(x))))
    # Around the least product both are exchanged at hardly any cost.
    least = own.duration * own.force
    assert light.duration * light.force == pytest.approx(least, rel=1e-2)
    np.testing.assert_array_equal(light.x[:-1], cell.initial[:-1])

    def again(*_: object) -> None:
        raise AssertionError("what is stored was computed again")

    with monkeypatch.context() as patched:
        patched.setattr(sweeping, "_row", again)
        same = ho.sweep(cell, cell.initial, OVER, fixed=True, file=file)
    assert repr(same) == repr(found)
    with refused(SettingsError, "another-sweep"):
        ho.sweep(cell, cell.initial, OVER, file=file)


@pytest.mark.slow
def test_a_polished_path_is_better_than_the_fixed_one(cell: ho.Cell) -> None:
    over = {"payload.mass": [9.0]}
    fixed = ho.sweep(cell, cell.initial, over, fixed=True).rows[0]
    free = ho.sweep(cell, cell.initial, over).rows[0]
    assert free.duration * free.force < 0.95 * fixed.duration * fixed.force
    assert not np.array_equal(free.x[:-1], cell.initial[:-1])


def test_wrong_sweeps_are_refused(cell: ho.Cell) -> None:
    with refused(SettingsError, "no-values"):
        ho.sweep(cell, cell.initial, {})
    with refused(SettingsError, "not-drivable"):
        ho.sweep(shipped("rack"), cell.initial[:-1], OVER)
    with pytest.raises(WorkcellError, match=r"payload\.weight"):
        ho.sweep(cell, cell.initial, {"payload.weight": [1.0]})


LOWEST, HIGHEST = -0.03, 0.006


@pytest.fixture(scope="module")
def grip() -> ho.Grip:
    told = list[int]()
    found = ho.propose_grip(
        shipped("rack"),
        (LOWEST, HIGHEST),
        (0.0, 0.0),
        trials=10,
        progress=lambda done, total: told.append(done),
    )
    assert told == list(range(1, len(told) + 1))
    assert len(told) >= 8
    return found


def product(up: float) -> float:
    """Of duration and force to command, of the rack's hand-made path with its pads higher up;
    infinite where it touches something."""
    places = {f"contacts[{k}].xyz": [0.0, y, 0.055 + up] for k, y in enumerate((0.2, -0.2))}
    cell = shipped("rack").changed(places).drivable()
    x = cell.initial[None]
    front = Front.of_search(cell, "given", cell.evaluator.certified(cell.evaluate(x)))
    if not len(front):
        return np.inf
    found = ho.recommend(front, alone=True)
    return found.duration * found.force


def test_no_place_of_a_grid_is_better(grip: ho.Grip) -> None:
    """But for what limits on jerk and whole ticks of a job change."""
    best = product(grip.up)
    assert np.isfinite(best)
    assert best < 0.995 * product(0.0)
    assert best < 1.02 * min(product(up) for up in (-0.03, -0.015))
    assert grip.duration * grip.force < grip.before


def test_the_cell_is_certified_and_differs_in_its_pads_alone(grip: ho.Grip) -> None:
    cell, given = grip.cell, shipped("rack")
    assert cell.certify(cell.initial).is_free
    assert LOWEST <= grip.up <= HIGHEST
    assert grip.along == 0.0
    for own, other in zip(cell.workcell.contacts, given.workcell.contacts, strict=True):
        moved = own.T_box_pad[:3, 3] - other.T_box_pad[:3, 3]
        np.testing.assert_allclose(moved, [0.0, 0.0, grip.up], atol=1e-9)
    np.testing.assert_array_equal(cell.initial, given.initial)


def test_all_pads_of_an_arm_move_together() -> None:
    cell, ways = shipped("fork"), np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    moved = cell.changed(_changes(cell.workcell, ways, (0.01, 0.005)))
    for own, other in zip(cell.workcell.pads, moved.workcell.pads, strict=True):
        shift = other.T_box_pad[:3, 3] - own.T_box_pad[:3, 3]
        np.testing.assert_allclose(shift, [0.005, 0.0, 0.01], atol=1e-9)


def test_what_cannot_be_compared_is_told() -> None:
    with refused(SettingsError, "no-closed-form"):
        ho.propose_grip(shipped("fork"), (0.0, 0.01), (0.0, 0.0))
    with refused(SettingsError, "range", "0.02", "0.01"):
        ho.propose_grip(shipped("rack"), (0.02, 0.01), (0.0, 0.0))
    with refused(SettingsError, "no-place"):
        ho.propose_grip(shipped("rack"), (0.2, 0.2), (0.0, 0.0))
