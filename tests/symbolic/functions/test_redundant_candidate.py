"""Candidates of cells with redundant joints: against the plain reference, and against cells in
which these joints are locked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from studies.research.plain.candidate import evaluate
from symbolic.array import Array
from symbolic.cell_model import CellModel, build_cell_model
from symbolic.functions import candidate_function
from symbolic.records.task import initial_decision
from tests.redundant_cells import free_pandas, locked_pandas, machine_on_lift, rack_on_rail
from tests.symbolic.cells import rack_model

PER_JOINT = ("q_1", "q_2", "joint_torque_1", "joint_torque_2")


def outputs(model: CellModel, x: Array) -> dict[str, Array]:
    function = candidate_function(model)
    return {
        name: np.array(value).T
        for name, value in zip(function.name_out(), function(ca.DM(x)), strict=True)
    }


def nearest(model: CellModel, arm: int, posture: Array) -> int:
    """The branch of an arm that starts nearest a posture."""
    return int(np.argmin([np.abs(b.q - posture).max() for b in model.branches[arm]]))


@pytest.fixture(scope="module")
def pandas(tmp_path_factory: pytest.TempPathFactory) -> CellModel:
    return build_cell_model(free_pandas(tmp_path_factory.mktemp("pandas"), "initial = 0.1"))


def test_candidates_are_those_of_the_plain_reference(pandas: CellModel) -> None:
    task, rng = pandas.workcell.task, np.random.default_rng(1)
    assert task.n_var == 6 + 2 * 3
    for spread in (0.0, 0.3, 0.6):
        x = initial_decision(task)
        x[task.n_box :] += rng.uniform(-spread, spread, task.n_var - task.n_box)
        found = outputs(pandas, x)
        expected = evaluate(pandas.workcell, pandas.start, x).outputs
        for name, values in expected.items():
            np.testing.assert_allclose(
                np.squeeze(found[name]), np.squeeze(values), atol=1e-9, err_msg=name
            )


@pytest.mark.parametrize("angle", [0.1, -0.35])
def test_a_constant_redundant_joint_is_a_locked_one(tmp_path: Path, angle: float) -> None:
    free = build_cell_model(free_pandas(tmp_path, f"initial = {angle}"))
    locked = build_cell_model(locked_pandas(tmp_path, angle))
    following = [k for k in range(7) if k != 2]
    for arm in (0, 1):
        found = [branch.q[following] for branch in free.branches[arm]]
        expected = [branch.q for branch in locked.branches[arm]]
        np.testing.assert_allclose(found, expected, atol=1e-9)
    own = outputs(free, initial_decision(free.workcell.task))
    other = outputs(locked, initial_decision(locked.workcell.task))
    for name, values in other.items():
        here = own[name][:, following] if name in PER_JOINT else own[name]
        np.testing.assert_allclose(here, values, atol=1e-9, err_msg=name)


def test_an_arm_on_a_slide_is_one_whose_base_stands_there(tmp_path: Path) -> None:
    moved = build_cell_model(rack_on_rail(tmp_path, 0.3))
    standing = rack_model()
    chosen = nearest(moved, 0, np.concatenate([[0.3], standing.start[0]]))
    assert chosen == 0
    x = initial_decision(moved.workcell.task)
    np.testing.assert_array_equal(x, initial_decision(standing.workcell.task))
    own, other = outputs(moved, x), outputs(standing, x)
    np.testing.assert_allclose(own["q_1"][:, 0], 0.3)
    for name, values in other.items():
        here = own[name][:, 1:] if name in ("q_1", "joint_torque_1") else own[name]
        np.testing.assert_allclose(here, values, atol=1e-9, err_msg=name)
    names = {(a.split("/")[-1], b.split("/")[-1]) for a, b in standing.geometry.pair_names}
    assert names <= {(a.split("/")[-1], b.split("/")[-1]) for a, b in moved.geometry.pair_names}


def test_a_lift_of_both_arms_is_one_joint(tmp_path: Path) -> None:
    free = build_cell_model(machine_on_lift(tmp_path / "free", 0.1, free=True))
    locked = build_cell_model(machine_on_lift(tmp_path / "locked", 0.1, free=False))
    (lift,) = free.workcell.task.redundant
    assert lift.name == "left/torso_lift_joint"
    assert lift.drives == (0, 0)
    assert len(initial_decision(free.workcell.task)) == 6 + 3
    names = {body.name for body in free.geometry.bodies}
    assert {name.split("/")[-1] for name in names} == {
        body.name.split("/")[-1] for body in locked.geometry.bodies
    }
    assert len(names) == len(locked.geometry.bodies)
    same = [
        free.branches[arm][nearest(free, arm, np.concatenate([[0.1], locked.start[arm]]))].q
        for arm in (0, 1)
    ]
    free = replace(free, start=(same[0], same[1]))
    own = outputs(free, initial_decision(free.workcell.task))
    other = outputs(locked, initial_decision(locked.workcell.task))
    for name in ("q_1", "q_2", "joint_torque_1", "joint_torque_2"):
        np.testing.assert_allclose(own[name][:, 1:], other[name], atol=1e-9, err_msg=name)
    for name in ("manipulability_1", "manipulability_2", "lost_1", "lost_2"):
        np.testing.assert_allclose(own[name], other[name], atol=1e-9, err_msg=name)


def test_a_moving_lift_moves_both_arms_alike(tmp_path: Path) -> None:
    model = build_cell_model(machine_on_lift(tmp_path, 0.1, free=True))
    x = initial_decision(model.workcell.task)
    x[6:] = [0.1, 0.12, 0.08]
    found = outputs(model, x)
    np.testing.assert_array_equal(found["q_1"][:, 0], found["q_2"][:, 0])
    assert found["q_1"][-1, 0] == pytest.approx(0.08, abs=1e-12)
    assert found["lost_1"].max() == found["lost_2"].max() == 0.0
    expected = evaluate(model.workcell, model.start, x).outputs
    for name in ("q_1", "q_2", "joint_torque_1"):
        np.testing.assert_allclose(found[name], expected[name], atol=1e-8, err_msg=name)
