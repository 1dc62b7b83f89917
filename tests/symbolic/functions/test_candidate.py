"""The whole candidate, also of redundant joints and turned boxes: against the plain reference."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from codegen.build import compile_function
from studies.research.plain.candidate import PlainCandidate, PlainEvaluator, evaluate
from symbolic.array import Array
from symbolic.cell_model import CellModel, build_cell_model
from symbolic.functions import CONSTRAINTS, candidate_function
from symbolic.path_motion import path_motion_function
from symbolic.records import Robot, Waypoint, Workcell
from symbolic.records.task import initial_decision
from tests.odd_cells import (
    free_pandas,
    locked_pandas,
    machine_on_lift,
    rack_on_rail,
    random_x,
    turned_cell,
)
from tests.symbolic.cells import (
    call,
    fixed,
    hand_cell,
    hand_model,
    interpreted,
    rack_model,
    random_candidates,
    start_posture,
    with_contacts,
    with_payload,
    with_task,
)

AGREEMENT = 1e-8
"""Largest difference to the plain reference, absolute or relative, whichever is larger."""


def verdict(outputs: dict[str, Array]) -> tuple[tuple[str, ...], str]:
    """Names of the violated constraints, and the one violated first along the path."""
    violated = tuple(np.array(CONSTRAINTS)[outputs["violation"] > 0.0].tolist())
    rows = np.argwhere(outputs["constraint"] > 0.0)
    return violated, CONSTRAINTS[rows[0][1]] if len(rows) else ""


def assert_agree(outputs: dict[str, Array], expected: PlainCandidate) -> None:
    assert set(outputs) == set(expected.outputs)
    for name, value in expected.outputs.items():
        np.testing.assert_allclose(
            outputs[name], value, atol=AGREEMENT, rtol=AGREEMENT, err_msg=name
        )
    assert verdict(outputs) == (expected.violated, expected.reason)


def odd_cell() -> Workcell:
    """Unequal friction and patches, an off-centre payload with products of inertia, two fixed
    inner poses, tilted bases."""
    cell = hand_cell()
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_euler("xyz", [0.05, -0.04, 0.1]).as_matrix()
    bases = [robot.T_world_base @ tilt for robot in cell.robots]
    robots: tuple[Robot, Robot] = (
        replace(cell.robots[0], T_world_base=bases[0]),
        replace(cell.robots[1], T_world_base=bases[1]),
    )
    cell = replace(cell, robots=robots)
    inertia = cell.payload.inertia + 0.02 * (np.ones((3, 3)) - np.eye(3))
    cell = with_payload(
        cell, mass=7.5, centre_of_mass=np.array([0.012, -0.02, 0.03]), inertia=inertia
    )
    cell = with_contacts(cell, friction=(0.6, 0.9), patch_radius=(0.02, 0.05))
    start, first, middle, last, goal = cell.task.waypoints
    waypoints: tuple[Waypoint, ...] = (
        start,
        fixed([-0.2, 0.0, 0.76, 0.0, 0.05, 0.0]),
        first,
        middle,
        fixed([-0.5, 0.02, 1.05, 0.05, 0.0, 0.1]),
        last,
        goal,
    )
    return with_task(cell, waypoints=waypoints, samples=50)


# --- against the plain reference ---


@pytest.mark.parametrize("half", [3, pytest.param(100, marks=pytest.mark.slow)])
def test_candidates_of_the_rack_compiled_interpreted_and_plain(half: int) -> None:
    """The hand-made one, half of the others within the bounds, half within twice their width."""
    model = rack_model()
    task, rng = model.workcell.task, np.random.default_rng(2024)
    plain = PlainEvaluator(model.workcell, model.start)
    symbolic = interpreted(model)
    compiled = compile_function(candidate_function(model))
    near, far = (random_candidates(task, half, rng, widen) for widen in (1.0, 2.0))
    candidates = np.vstack([initial_decision(task), near, far])
    reasons: set[str] = set()
    for x in candidates:
        expected = plain(x)
        assert_agree(compiled(x), expected)
        assert_agree(symbolic(x), expected)
        reasons.add(expected.reason)
    assert "" in reasons, "none was feasible"
    assert len(reasons) >= 3, reasons


@pytest.mark.parametrize("law", ["constant", "ramped"])
def test_odd_cells_agree_with_the_plain_reference(law: str) -> None:
    model = hand_model(with_task(odd_cell(), time_law=law))
    symbolic, plain = interpreted(model), PlainEvaluator(model.workcell, model.start)
    for x in random_candidates(model.workcell.task, 15, np.random.default_rng(5), 1.0):
        assert_agree(symbolic(x), plain(x))


def tight_cells() -> list[tuple[str, Workcell]]:
    """Cells in which the initial trajectory breaks a constraint, with that constraint's name."""
    cell = hand_cell()
    first, second = cell.robots

    def with_second(**changes: Any) -> Workcell:
        return replace(cell, robots=(first, replace(second, **changes)))

    narrow = first.position_upper.copy()
    narrow[1] = -1.5
    far = [[-1.2, 0.0, 0.8, 0, 0, 0], [-1.4, 0.0, 1.0, 0, 0, 0], [-1.2, 0.0, 1.2, 0, 0, 0]]
    return [
        ("reach_1", with_task(cell, initial=np.array(far, dtype=float))),
        ("joint_limits_1", replace(cell, robots=(replace(first, position_upper=narrow), second))),
        ("singularity_2", with_second(min_manipulability=1.0)),
        ("pressure_2", with_contacts(cell, patch_radius=(0.0315, 1e-5))),
    ]


@pytest.mark.parametrize(("constraint", "cell"), tight_cells(), ids=[c[0] for c in tight_cells()])
def test_a_broken_constraint_is_named(constraint: str, cell: Workcell) -> None:
    model = hand_model(cell)
    x = cell.task.initial.reshape(-1)
    # A slight tilt, so that the centres of pressure have something to do.
    x = x + np.tile([0.0, 0.0, 0.0, 0.02, 0.02, 0.0], 3)
    outputs = interpreted(model)(x)
    violated, _ = verdict(outputs)
    assert constraint in violated
    column = CONSTRAINTS.index(constraint)
    assert 0.0 < outputs["violation_time"][column] <= 1.0 + 1e-12
    assert outputs["violation"][column] == outputs["constraint"][:, column].max()
    assert_agree(outputs, PlainEvaluator(cell, model.start)(x))


# --- physics of a whole carry ---


# --- derivatives ---

SMOOTH = ("time", "normal_force", "pressure_shift", "q_1", "q_2", "joint_torque_1", "constraint")


@pytest.mark.parametrize("law", ["constant", "ramped"])
def test_derivatives_agree_with_finite_differences(law: str) -> None:
    """Central differences of the interpreted function, at candidates away from its kinks."""
    model = hand_model(with_task(odd_cell(), time_law=law, samples=25))
    function = candidate_function(model)
    x = ca.MX.sym("x", model.workcell.task.n_var)
    named = dict(zip(function.name_out(), function.call([x]), strict=True))
    stacked = ca.vertcat(*[ca.vec(named[name]) for name in SMOOTH])
    value = ca.Function("value", [x], [stacked])
    jacobian = ca.Function("jacobian", [x], [ca.jacobian(stacked, x)])
    step = 1e-6
    for candidate in random_candidates(model.workcell.task, 2, np.random.default_rng(9), 0.5):
        exact = jacobian(candidate).full()
        assert np.all(np.isfinite(exact))
        columns = [
            (value(candidate + step * e) - value(candidate - step * e)).full()[:, 0] / (2 * step)
            for e in np.eye(len(candidate))
        ]
        differences = np.column_stack(columns)
        scale = np.maximum(1.0, np.abs(exact).max(axis=1, keepdims=True))
        assert np.abs((differences - exact) / scale).max() < 1e-5


def test_derivatives_are_finite_at_the_level_initial_trajectory() -> None:
    """It has no rotation at all: lengths and angles vanish where roots are taken."""
    for law in ("constant", "ramped"):
        cell = with_task(hand_cell(), time_law=law, samples=20)
        function = candidate_function(hand_model(cell))
        x = ca.MX.sym("x", cell.task.n_var)
        jacobians = [ca.jacobian(ca.vec(value), x) for value in function.call([x])]
        jacobian = ca.Function("jacobian", [x], jacobians)
        for value in jacobian.call([ca.DM(cell.task.initial.reshape(-1))]):
            assert np.all(np.isfinite(value.full()))


PER_JOINT = ("q_1", "q_2", "joint_torque_1", "joint_torque_2")


def nearest(model: CellModel, arm: int, posture: Array) -> int:
    """The branch of an arm that starts nearest a posture."""
    return int(np.argmin([np.abs(b.q - posture).max() for b in model.branches[arm]]))


@pytest.fixture(scope="module")
def pandas(tmp_path_factory: pytest.TempPathFactory) -> CellModel:
    return build_cell_model(free_pandas(tmp_path_factory.mktemp("pandas"), "initial = 0.1"))


def test_redundant_candidates_are_those_of_the_plain_reference(pandas: CellModel) -> None:
    task, rng = pandas.workcell.task, np.random.default_rng(1)
    assert task.n_var == 6 + 2 * 3
    for spread in (0.0, 0.3, 0.6):
        x = initial_decision(task)
        x[task.n_box :] += rng.uniform(-spread, spread, task.n_var - task.n_box)
        found = interpreted(pandas)(x)
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
    own = interpreted(free)(initial_decision(free.workcell.task))
    other = interpreted(locked)(initial_decision(locked.workcell.task))
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
    own, other = interpreted(moved)(x), interpreted(standing)(x)
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
    own = interpreted(free)(initial_decision(free.workcell.task))
    other = interpreted(locked)(initial_decision(locked.workcell.task))
    for name in ("q_1", "q_2", "joint_torque_1", "joint_torque_2"):
        np.testing.assert_allclose(own[name][:, 1:], other[name], atol=1e-9, err_msg=name)
    for name in ("manipulability_1", "manipulability_2", "lost_1", "lost_2"):
        np.testing.assert_allclose(own[name], other[name], atol=1e-9, err_msg=name)


def test_a_moving_lift_moves_both_arms_alike(tmp_path: Path) -> None:
    model = build_cell_model(machine_on_lift(tmp_path, 0.1, free=True))
    x = initial_decision(model.workcell.task)
    x[6:] = [0.1, 0.12, 0.08]
    found = interpreted(model)(x)
    np.testing.assert_array_equal(found["q_1"][:, 0], found["q_2"][:, 0])
    assert found["q_1"][-1, 0] == pytest.approx(0.08, abs=1e-12)
    assert found["lost_1"].max() == found["lost_2"].max() == 0.0
    expected = evaluate(model.workcell, model.start, x).outputs
    for name in ("q_1", "q_2", "joint_torque_1"):
        np.testing.assert_allclose(found[name], expected[name], atol=1e-8, err_msg=name)


@pytest.mark.parametrize("time_law", ["constant", "ramped"])
def test_turned_candidates_are_those_of_the_plain_reference(time_law: str) -> None:
    cell = turned_cell(time_law)
    plain = PlainEvaluator(cell, start_posture(cell))
    for seed in (1, 2):
        x = random_x(cell, seed)
        found, expected = interpreted(hand_model(cell))(x), plain(x).outputs
        assert not expected["violation"].any(), "the arms follow the box to its end"
        for name, values in expected.items():
            np.testing.assert_allclose(
                np.squeeze(found[name]), np.squeeze(values), rtol=1e-8, atol=1e-8, err_msg=name
            )


def test_derivatives_along_the_path_are_those_of_differences() -> None:
    cell, n = turned_cell(), 401
    motion = call(path_motion_function(hand_model(cell), n), random_x(cell, 3))
    u = np.linspace(0.0, 1.0, n)
    turned = motion["rotation"].reshape(n, 3, 3)
    steps = Rotation.from_matrix(turned[2:] @ np.swapaxes(turned[:-2], 1, 2)).as_rotvec()
    np.testing.assert_allclose(steps * (n - 1) / 2.0, motion["angular_first"][1:-1], atol=2e-3)
    inner = slice(2, -2)
    for first, second in (("angular_first", "angular_second"), ("q_first_1", "q_second_1")):
        slopes = np.gradient(motion[first], u, axis=0, edge_order=2)
        np.testing.assert_allclose(motion[second][inner], slopes[inner], atol=0.02)
    slopes = np.gradient(motion["q_2"], u, axis=0, edge_order=2)
    np.testing.assert_allclose(motion["q_first_2"][inner], slopes[inner], atol=6e-3)
