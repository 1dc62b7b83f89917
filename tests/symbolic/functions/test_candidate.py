"""The whole candidate: against the plain reference, its own differences and physical laws."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from codegen.build import compile_function
from studies.research.plain.candidate import PlainCandidate, PlainEvaluator
from symbolic.array import Array
from symbolic.functions import CONSTRAINTS, candidate_function
from symbolic.records import Robot, Waypoint, Workcell
from symbolic.records.task import initial_decision
from tests.symbolic.cells import (
    SEEDS,
    Evaluator,
    fixed,
    hand_cell,
    hand_model,
    interpreted,
    rack_model,
    random_candidates,
    with_contacts,
    with_payload,
    with_task,
)

AGREEMENT = 1e-8
"""Largest difference to the plain reference, absolute or relative, whichever is larger."""

HALF_TURN = np.array([-1.0, -1.0, 1.0, -1.0, -1.0, 1.0])
"""Pose components under half a turn about z of a cell that this turns onto itself."""


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


@pytest.mark.parametrize("half", [12, pytest.param(100, marks=pytest.mark.slow)])
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


@pytest.mark.parametrize("radius", [0.02, 0.03])
def test_a_patch_carries_an_offset_mass_if_it_is_large_enough(radius: float) -> None:
    """A weight 25 mm off the pads' line needs shifts of about 25 mm."""
    cell = with_payload(hand_cell(), centre_of_mass=np.array([0.0, 0.0, 0.0]))
    cell = with_payload(cell, centre_of_mass=np.array([0.025, 0.0, 0.0]))
    cell = with_contacts(cell, patch_radius=(radius, radius))
    # Slow enough to be nearly static.
    cell = with_task(cell, reference_speed=0.02, time_law="ramped")
    outputs = interpreted(hand_model(cell))(cell.task.initial.reshape(-1))
    np.testing.assert_allclose(outputs["pressure_shift"], 0.025, atol=5e-4)
    violated, _ = verdict(outputs)
    assert violated == (("pressure_1", "pressure_2") if radius < 0.025 else ())


@pytest.mark.parametrize("law", ["constant", "ramped"])
def test_balance_and_cones_hold_along_every_candidate(law: str) -> None:
    cell = with_task(odd_cell(), time_law=law)
    evaluate = interpreted(hand_model(cell))
    payload = cell.payload
    for x in random_candidates(cell.task, 10, np.random.default_rng(1)):
        out = evaluate(x)
        R = Rotation.from_euler("xyz", out["pose"][:, 3:]).as_matrix()
        c = R @ payload.centre_of_mass
        omega, alpha = out["angular_velocity"], out["angular_acceleration"]
        a = out["second_rate"][:, :3] + np.cross(alpha, c) + np.cross(omega, np.cross(omega, c))
        forces = out["contact_force"].reshape(-1, 2, 3)
        needed = payload.mass * (a + np.array([0.0, 0.0, 9.81]))
        assert np.abs(forces.sum(axis=1) - needed).max() < 1e-9
        for i, contact in enumerate(cell.contacts):
            normal = R @ contact.T_box_pad[:3, 2]
            along = np.sum(forces[:, i] * normal, axis=1)
            across = np.linalg.norm(forces[:, i] - along[:, None] * normal, axis=1)
            np.testing.assert_allclose(along, out["normal_force"][:, i], atol=1e-9)
            assert np.all(across <= contact.friction * along + 1e-8)


def turned_about_vertical(cell: Workcell, angle: float) -> Workcell:
    """Bases and fixed poses turned about the world's z axis."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
    first, second = (replace(r, T_world_base=T @ r.T_world_base) for r in cell.robots)
    waypoints = tuple(
        replace(w, lower=turned_pose(w.lower, angle), upper=turned_pose(w.upper, angle))
        if w.is_fixed
        else w
        for w in cell.task.waypoints
    )
    return with_task(replace(cell, robots=(first, second)), waypoints=waypoints)


def turned_pose(pose: Array, angle: float) -> Array:
    R = Rotation.from_euler("z", angle).as_matrix()
    return np.concatenate([R @ pose[:3], pose[3:] + angle * np.eye(3)[2]])


def test_turning_the_whole_cell_about_the_vertical_changes_no_force_and_no_joint() -> None:
    cell, angle = odd_cell(), 0.9
    turned = turned_about_vertical(cell, angle)
    here, there = interpreted(hand_model(cell)), interpreted(hand_model(turned))
    for x in random_candidates(cell.task, 5, np.random.default_rng(2)):
        x_turned = np.concatenate([turned_pose(pose, angle) for pose in x.reshape(-1, 6)])
        expected, actual = here(x), there(x_turned)
        for name in expected:
            if name.startswith(("normal", "tangential", "pressure", "q_", "joint", "violation")):
                np.testing.assert_allclose(actual[name], expected[name], atol=1e-8, err_msg=name)


def test_half_a_turn_of_the_carry_exchanges_both_robots_entirely() -> None:
    """The hand cell turns onto itself: forces, joints and torques change places."""
    cell = hand_cell()
    # Both start postures from one, so that joint 1 is not half a turn apart.
    evaluate = interpreted(hand_model(cell))
    turned_cell = with_task(
        cell,
        waypoints=tuple(
            replace(w, lower=HALF_TURN * w.lower, upper=HALF_TURN * w.upper) if w.is_fixed else w
            for w in cell.task.waypoints
        ),
    )
    turned = interpreted(hand_model(turned_cell))
    full_turn = 2 * np.pi * np.round((SEEDS[0][0] - SEEDS[1][0]) / (2 * np.pi))
    for x in random_candidates(cell.task, 5, np.random.default_rng(3)):
        here, there = evaluate(x), turned((x.reshape(-1, 6) * HALF_TURN).reshape(-1))
        for name in ("normal_force", "tangential_force", "pressure_shift"):
            np.testing.assert_allclose(there[name], here[name][:, ::-1], atol=1e-8)
        for name in ("joint_torque", "ik_residual", "manipulability"):
            np.testing.assert_allclose(there[f"{name}_2"], here[f"{name}_1"], atol=1e-7)
        joints = there["q_2"] + full_turn * np.eye(6)[0]
        np.testing.assert_allclose(joints, here["q_1"], atol=1e-8)


def test_mirroring_the_carry_exchanges_the_forces() -> None:
    """Reflection at y = 0; the arms themselves are handed, so their joints are not compared."""
    mirror = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    cell = hand_cell()
    evaluate = interpreted(hand_model(cell))
    for x in random_candidates(cell.task, 5, np.random.default_rng(4)):
        here, there = evaluate(x), evaluate((x.reshape(-1, 6) * mirror).reshape(-1))
        for name in ("normal_force", "tangential_force", "pressure_shift"):
            np.testing.assert_allclose(there[name], here[name][:, ::-1], atol=1e-8)


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


def test_more_samples_converge_to_the_same_carry() -> None:
    """Peak forces of the ramped law settle as the samples are refined."""
    peaks = []
    for samples in (50, 100, 200, 400):
        cell = with_task(hand_cell(), time_law="ramped", samples=samples)
        evaluate: Evaluator = interpreted(hand_model(cell))
        peaks.append(evaluate(cell.task.initial.reshape(-1))["normal_force"].max(axis=0))
    changes = np.abs(np.diff(peaks, axis=0)).max(axis=1)
    assert changes[2] < 0.1
    assert changes[2] < changes[0]
