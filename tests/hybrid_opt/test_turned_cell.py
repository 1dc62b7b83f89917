"""A box that is turned over, through the library: compiled, certified, polished, timed, shown."""

from __future__ import annotations

import json
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.cell import Cell
from hybrid_opt.display.scene import frame_placements, scene_data
from symbolic.functions import candidate_function
from symbolic.geometry.bodies import Frame
from symbolic.records.poses import box_rotation
from symbolic.records.task import variable_names
from tests.turned_cells import turned_transfer


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    return Cell(turned_transfer(tmp_path_factory.mktemp("turned")))


def test_compiled_outputs_are_the_interpreted_ones(cell: Cell) -> None:
    function = candidate_function(cell.compiled.model)
    x = cell.random(1, np.random.default_rng(1))
    found = cell.evaluator.outputs(x)
    for name, value in zip(function.name_out(), function(ca.DM(x[0])), strict=True):
        expected = np.squeeze(np.array(value).T)
        np.testing.assert_allclose(
            np.squeeze(found[name][0]), expected, rtol=1e-9, atol=1e-9, err_msg=name
        )


def test_most_carries_are_feasible_and_certified(cell: Cell) -> None:
    found = cell.evaluate(cell.random(40, np.random.default_rng(2)))
    assert found.feasible.mean() > 0.5
    initial = cell.evaluate(cell.initial)
    assert cell.evaluator.certified(initial).feasible.all()
    assert variable_names(cell.workcell.task)[3] == "waypoint 1, rotation x"


@pytest.mark.slow
def test_the_polish_lowers_the_forces(cell: Cell) -> None:
    front = ho.search(cell, "nsga2", evaluations=60, rng=np.random.default_rng(3))
    settings = ho.PolishSettings(attempts=3, rounds=4)
    polished = ho.polish(front, rng=np.random.default_rng(3), settings=settings)
    assert polished.objectives.sum(axis=1).min() < front.objectives.sum(axis=1).min()


def test_a_timed_carry_turns_as_its_rates_say(cell: Cell, tmp_path: Path) -> None:
    timing = ho.time_path(cell, cell.initial, ho.TimingLimits())
    assert timing.ok
    carry = timing.carry
    assert carry is not None
    turned = box_rotation(cell.workcell.task.orientation, carry.pose)
    np.testing.assert_allclose(turned[-1], np.diag([-1.0, 1.0, -1.0]), atol=1e-9)
    # The turn about y in all, by the integral of the angular velocity.
    whole = np.trapezoid(carry.angular_velocity[:, 1], carry.time)
    assert whole == pytest.approx(np.pi, abs=0.02)
    ho.export(timing, "json", tmp_path)
    (path,) = (p for p in tmp_path.rglob("*.json") if "box" in json.loads(p.read_text()))
    box = json.loads(path.read_text())["box"]
    assert (box["rotation"], box["reference"]) == ("quaternion", np.eye(3).tolist())


def test_pictures_show_the_box_as_it_is_turned(cell: Cell) -> None:
    carry = cell.carry(cell.initial)
    placed = frame_placements(cell.geometry, carry.pose, carry.q)[Frame("box")]
    np.testing.assert_array_equal(
        placed[:, :3, :3], box_rotation(cell.workcell.task.orientation, carry.pose)
    )
    told = scene_data(cell.geometry, carry)["orientation"]
    assert told == {"vector": True, "reference": [0.0, 0.0, 0.0, 1.0]}
