"""A cell with redundant joints through the library: evaluation, certificate, timing."""

from __future__ import annotations

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.bundles.arms import require_axes
from hybrid_opt.cell import Cell
from hybrid_opt.collision.certify import SampledPath, configurations
from hybrid_opt.evaluate.evaluation import REASONS, LockedEvaluator
from hybrid_opt.evaluate.kernel import one_by_one
from studies.research.plain.candidate import PlainJudge
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records.task import extended_waypoints
from tests.redundant_cells import free_pandas


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    return Cell(free_pandas(tmp_path_factory.mktemp("pandas"), "initial = 0.1"))


def varied(cell: Cell, count: int, spread: float) -> Array:
    """The hand-made trajectory with its redundant joints elsewhere [rad]."""
    rng = np.random.default_rng(3)
    x = np.tile(cell.initial, (count, 1))
    x[:, cell.workcell.task.n_box :] += rng.uniform(-spread, spread, (count, 6))
    return x


def test_lanes_give_the_bits_of_one_by_one(cell: Cell) -> None:
    x = varied(cell, 30, 0.8)
    found = cell.evaluator.sampled(x)
    expected = one_by_one(cell.evaluator.outputs(x), cell.evaluator.checker)
    np.testing.assert_array_equal(found.outputs["violation"], expected.outputs["violation"])
    np.testing.assert_array_equal(found.colliding, expected.colliding)
    np.testing.assert_array_equal(found.first_reason, expected.first_reason)


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
        require_axes(cell.workcell, "RAPID", (6,))


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
    with pytest.raises(SettingsError, match="3 positions; needed are 2"):
        LockedEvaluator(cell.evaluator, np.zeros(3))
