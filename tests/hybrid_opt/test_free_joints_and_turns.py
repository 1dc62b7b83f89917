"""Redundant joints, and boxes that are turned over, through the library."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.cell import Cell
from hybrid_opt.collision.certify import SampledPath, configurations
from hybrid_opt.compiled_cell import InterpretedCell
from hybrid_opt.display.scene import scene_data
from hybrid_opt.display.solids import frame_placements
from hybrid_opt.evaluate.evaluation import REASONS, LockedEvaluator
from hybrid_opt.extras.bundles.arms import ABB, require_arms
from studies.research.plain.candidate import PlainJudge
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.geometry.bodies import Frame
from symbolic.path.spline import extended_waypoints
from symbolic.records.poses import box_rotation
from symbolic.records.task import variable_names
from tests.odd_cells import free_pandas, turned_transfer


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    workcell = free_pandas(tmp_path_factory.mktemp("pandas"), "initial = 0.1")
    return Cell(workcell, compiled=InterpretedCell(workcell))


def varied(cell: Cell, count: int, spread: float) -> Array:
    """The hand-made trajectory with its redundant joints elsewhere [rad]."""
    rng = np.random.default_rng(3)
    x = np.tile(cell.initial, (count, 1))
    x[:, cell.workcell.task.n_box :] += rng.uniform(-spread, spread, (count, 6))
    return x


def test_verdicts_are_those_of_the_plain_reference(cell: Cell) -> None:
    x = varied(cell, 5, 0.8)
    judge = PlainJudge(cell.workcell, cell.compiled.model.start)
    judged = cell.evaluate(x)
    for row, values in enumerate(x):
        expected = judge(values)
        assert bool(judged.feasible[row]) == expected.feasible
        if not expected.feasible:
            assert REASONS[int(judged.reason[row])] == expected.reason


def test_between_samples_redundant_joints_are_on_their_spline(cell: Cell) -> None:
    (x,) = varied(cell, 1, 0.5)
    outputs = cell.evaluator.outputs(x[None])
    task = cell.workcell.task
    path = SampledPath(task, extended_waypoints(task, x), outputs["q_1"][0], outputs["q_2"][0])
    posture = cell.evaluator.functions["posture"]
    found = configurations([path], posture, np.zeros(1, dtype=np.intp), np.array([0.5]))
    poses, q_1, q_2 = cell.evaluator.checker.split(found)
    assert q_1[0, 2] == pytest.approx(x[task.n_box + 1], abs=1e-12)
    assert q_2[0, 2] == pytest.approx(x[task.n_box + 4], abs=1e-12)
    assert poses.shape == (1, 6)


def test_a_carry_is_timed_and_exported_with_all_joints(cell: Cell) -> None:
    (x,) = varied(cell, 1, 0.3)
    timing = ho.time_path(cell, x, ho.TimingLimits())
    assert timing.ok
    carry = timing.carry
    assert carry is not None
    for arm, robot in zip(carry.arms, cell.workcell.robots, strict=True):
        assert arm.q.shape[1] == 7
        assert np.all(np.abs(arm.q_rate) <= robot.velocity_max * 1.01)
        # Speeds are those of the positions.
        steps = np.diff(carry.time)
        moving = steps > 1e-9
        mean = (arm.q_rate[1:] + arm.q_rate[:-1])[moving] / 2.0
        slope = np.diff(arm.q, axis=0)[moving] / steps[moving, None]
        np.testing.assert_allclose(slope, mean, atol=0.02 * np.abs(arm.q_rate).max())
    with pytest.raises(SettingsError, match="7 joints"):
        require_arms(cell.workcell, "abb-egm", ABB, (6,), any_arm=True)


def test_locking_is_a_constant_path(cell: Cell) -> None:
    task = cell.workcell.task
    locked = LockedEvaluator(cell.evaluator, np.array([0.1, -0.2]))
    assert locked.n_var == len(locked.lower) == task.n_box
    x = np.random.default_rng(4).uniform(locked.lower, locked.upper, (20, locked.n_var))
    whole = np.hstack([x, np.tile([0.1] * 3 + [-0.2] * 3, (20, 1))])
    found, expected = locked.evaluate(x), cell.evaluate(whole)
    np.testing.assert_array_equal(found.penalised, expected.penalised)
    np.testing.assert_array_equal(found.x, x)
    np.testing.assert_array_equal(
        locked.certified(found).feasible, cell.evaluator.certified(expected).feasible
    )
    with pytest.raises(SettingsError, match=r"3 .* 2"):
        LockedEvaluator(cell.evaluator, np.zeros(3))


@pytest.fixture(scope="module")
def turned(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    workcell = turned_transfer(tmp_path_factory.mktemp("turned"))
    return Cell(workcell, compiled=InterpretedCell(workcell))


def test_most_carries_are_feasible_and_certified(turned: Cell) -> None:
    found = turned.evaluate(turned.random(40, np.random.default_rng(2)))
    assert found.feasible.mean() > 0.5
    initial = turned.evaluate(turned.initial)
    assert turned.evaluator.certified(initial).feasible.all()
    assert variable_names(turned.workcell.task)[3] == "waypoint 1, rotation x"


@pytest.mark.slow
def test_the_polish_lowers_the_forces(turned: Cell) -> None:
    front = ho.search(turned, "nsga2", evaluations=60, rng=np.random.default_rng(3))
    settings = ho.PolishSettings(attempts=3, rounds=4)
    polished = ho.polish(front, rng=np.random.default_rng(3), settings=settings)
    assert polished.objectives.sum(axis=1).min() < front.objectives.sum(axis=1).min()


def test_a_timed_carry_turns_as_its_rates_say(turned: Cell) -> None:
    timing = ho.time_path(turned, turned.initial, ho.TimingLimits())
    assert timing.ok
    carry = timing.carry
    assert carry is not None
    rotation = box_rotation(turned.workcell.task.orientation, carry.pose)
    np.testing.assert_allclose(rotation[-1], np.diag([-1.0, 1.0, -1.0]), atol=1e-9)
    # The turn about y in all, by the integral of the angular velocity.
    whole = np.trapezoid(carry.angular_velocity[:, 1], carry.time)
    assert whole == pytest.approx(np.pi, abs=0.02)


@pytest.mark.slow
def test_its_job_says_how_the_box_is_turned(turned: Cell, tmp_path: Path) -> None:
    timing = ho.time_path(turned, turned.initial, ho.TimingLimits())
    ho.export(timing, "data", tmp_path)
    (path,) = (p for p in tmp_path.rglob("job.json") if "box" in json.loads(p.read_text()))
    box = json.loads(path.read_text())["box"]
    assert (box["rotation"], box["reference"]) == ("quaternion", np.eye(3).tolist())


def test_pictures_show_the_box_as_it_is_turned(turned: Cell) -> None:
    carry = turned.carry(turned.initial)
    placed = frame_placements(turned.geometry, carry.pose, carry.q)[Frame("box")]
    np.testing.assert_array_equal(
        placed[:, :3, :3], box_rotation(turned.workcell.task.orientation, carry.pose)
    )
    told = scene_data(turned.geometry, carry)["orientation"]
    assert told == {"vector": True, "reference": [0.0, 0.0, 0.0, 1.0]}
