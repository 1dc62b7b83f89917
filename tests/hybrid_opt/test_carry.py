"""The one record of a carry, and carries under the task's own time law."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.evaluation import REASONS
from hybrid_opt.timing.analysis import check_search_timing
from hybrid_opt.timing.candidates import search_carry
from hybrid_opt.timing.records import TimingStatus
from symbolic.array import Array
from symbolic.read.cell import load
from tests.hybrid_opt.campaign.fake import RACK
from tests.hybrid_opt.cells import shipped


def cell() -> Cell:
    return shipped("rack")


@cache
def held() -> Carry:
    return cell().carry(cell().initial)


def test_it_holds_what_the_compiled_function_returned() -> None:
    carry, outputs = held(), cell().evaluator.outputs(cell().initial)
    assert len(carry) == cell().workcell.task.samples
    for name in ("pose", "rate", "second_rate", "normal_force", "pressure_shift"):
        np.testing.assert_array_equal(getattr(carry, name), outputs[name][0])
    for i, arm in enumerate(carry.arms):
        np.testing.assert_array_equal(arm.q, outputs[f"q_{i + 1}"][0])
        np.testing.assert_array_equal(arm.contact_torque, outputs[f"joint_torque_{i + 1}"][0])
        np.testing.assert_array_equal(arm.torque, arm.contact_torque + arm.own_torque)
    np.testing.assert_array_equal(carry.contact_force.reshape(-1, 6), outputs["contact_force"][0])


def test_its_own_torques_hold_the_arms_up() -> None:
    """Against Pinocchio's inverse dynamics, joint by joint along the carry."""
    import pinocchio as pin

    models = cell().compiled.model.robots
    for arm, robot in zip(held().arms, models, strict=True):
        data = robot.model.createData()
        for k in (0, 37, len(held()) - 1):
            torque = pin.rnea(robot.model, data, arm.q[k], arm.q_rate[k], arm.q_second[k])
            np.testing.assert_allclose(arm.own_torque[k], torque, atol=1e-8)


def test_figures_have_closed_forms() -> None:
    carry, task = held(), cell().workcell.task
    still = 9.81 * cell().workcell.payload.mass / (2.0 * cell().workcell.contacts[0].friction)
    np.testing.assert_allclose(
        carry.excess_above_static, 100.0 * (carry.normal_force.max(axis=0) / still - 1.0)
    )
    assert carry.mean_excess_above_static == pytest.approx(carry.excess_above_static.mean())
    np.testing.assert_allclose(
        carry.force_ratio, list(cell().evaluate(cell().initial).objectives[0])
    )
    whole = np.sqrt((carry.contact_force**2).sum(axis=2)).max(axis=0)
    assert carry.payload_limit == pytest.approx(10.0 * min(task.reference_force / whole))
    assert carry.friction_margin.min() > -1e-6
    even = replace(carry, time=np.linspace(0.0, 1.0, len(carry)))
    inner = carry.normal_force[1:-1].sum(axis=0) + carry.normal_force[[0, -1]].sum(axis=0) / 2.0
    np.testing.assert_allclose(even.mean_normal_force, inner / (len(carry) - 1))


def test_a_carry_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        held().pose[0, 0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        held().arms[0].q[0, 0] = 1.0


def test_the_verdict_is_that_of_the_evaluation() -> None:
    rng = np.random.default_rng(3)
    x = rng.uniform(cell().lower, cell().upper, (40, cell().n_var))
    found = cell().evaluate(x)
    assert 0 < found.feasible.sum() < len(x)
    for row in range(len(x)):
        judgement = cell().carry(x[row]).judgement
        assert judgement is not None
        assert judgement.feasible == found.feasible[row]
        assert list(judgement.objectives.values()) == found.objectives[row].tolist()
        if not judgement.feasible:
            assert judgement.reason == REASONS[found.reason[row]]
            assert judgement.position == found.position[row]
            assert judgement.reason.replace("_", " ") in repr(cell().carry(x[row]))


def test_it_prints_its_figures() -> None:
    text = repr(held())
    assert "feasible" in text
    assert f"{held().payload_limit:.3f} kg" in text
    page = held()._repr_html_()
    assert "<svg" in page
    assert "payload limit" in page


def test_names_cannot_become_markup() -> None:
    evil = replace(load(RACK), name="<script>alert(1)</script>")
    carry = replace(held(), workcell=evil)
    assert "<script" not in carry._repr_html_()


def test_joint_rates_are_those_of_the_exact_derivatives() -> None:
    """Of the path's derivatives that the timing model compiles, driven with the box's speed."""
    model, x = shipped("transfer").timing_model, shipped("transfer").initial
    carry, motion = search_carry(model, x), model.path_motion(x)

    def at_samples(values: Array) -> Array:
        columns = [np.interp(carry.parameter, motion.parameter, column) for column in values.T]
        return np.transpose(columns)

    first, second = at_samples(motion.pose_first), at_samples(motion.pose_second)
    q_first, q_second = at_samples(motion.q_first), at_samples(motion.q_second)
    length = (first**2).sum(axis=1)
    speed = ((carry.rate * first).sum(axis=1) / length)[:, None]
    bend = carry.second_rate - second * speed**2
    push = ((bend * first).sum(axis=1) / length)[:, None]
    np.testing.assert_allclose(carry.stack_arms("q_rate"), q_first * speed, atol=1e-3)
    inside = slice(3, -3)
    expected = (q_second * speed**2 + q_first * push)[inside]
    np.testing.assert_allclose(carry.stack_arms("q_second")[inside], expected, atol=5e-3)


def test_a_ramped_carry_rests_at_its_ends() -> None:
    """And is not told that its robots would have to be at speed there."""
    cell = shipped("transfer")
    model, rng = cell.timing_model, np.random.default_rng(4)
    near = cell.initial + 0.1 * (cell.upper - cell.lower) * rng.uniform(-1.0, 1.0, cell.n_var)
    for x in (cell.initial, np.clip(near, cell.lower, cell.upper)):
        for arm in search_carry(model, x).arms:
            np.testing.assert_allclose(arm.q_rate[[0, -1]], 0.0, atol=1e-6)
        judged = check_search_timing(model, x)
        assert judged.place is None or judged.place.constraint != "start from rest"
    assert check_search_timing(model, cell.initial).status is TimingStatus.OK
