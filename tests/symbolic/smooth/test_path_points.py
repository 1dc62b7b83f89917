"""Rows at points and samples of the polish's program against the functions they come from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.functions import candidate_function
from symbolic.geometry.clearance import screening_functions
from symbolic.geometry.separation import coal_distance
from symbolic.path.rotation import rotation_matrix
from symbolic.records.cell import PAYLOAD_NAME, Workcell
from symbolic.records.poses import Orientation
from symbolic.records.shapes import Box
from symbolic.robot.arm import flange_target, manipulability, pose_error
from symbolic.smooth.passage import (
    PARALLEL_GAP,
    PARALLEL_SINE,
    SEPARATING_DIRECTIONS,
    AxisSwitchGap,
    SeparatingAxisGap,
    gap_function,
)
from symbolic.smooth.path_points import (
    PARALLEL_WIDTH,
    Clearance,
    JointLimit,
    ManipulabilityLimit,
    PathConstraint,
    PathPointSymbols,
    closure_functions,
    closure_name,
    row_function,
)
from symbolic.smooth.samples import (
    Quantity,
    sample_blocks,
    sample_functions,
    sample_name,
)
from tests.symbolic.cells import hand_cell, hand_model, rack_model

STILL = np.zeros(6)
"""The rate of rows that do not depend on it."""


@cache
def point() -> PathPointSymbols:
    return PathPointSymbols(rack_model())


def value_of(constraint: PathConstraint, *at: Array) -> float:
    """A row's value at pose, rate and joints."""
    numbers = [constraint.numbers(point())] if constraint.count(point()) else []
    return float(row_function(point(), constraint, "first")(*at, *numbers)[0])


@cache
def gaps_of_poses() -> ca.Function:
    return gap_function(point())


def gaps_at(index: int, pose: Array) -> Array:
    return np.array(gaps_of_poses()(pose, point().obstacle(index))).ravel()


def pose_near_start(seed: int) -> Array:
    start = rack_model().workcell.task.waypoints[0].lower
    away = np.array([-0.15, 0.0, 0.03, 0.0, 0.0, 0.0])
    spread = np.array([0.1, 0.04, 0.03, 0.1, 0.1, 0.1])
    return np.asarray(start + away + spread * np.random.default_rng(seed).uniform(-1, 1, 6))


@cache
def closure(arm: int) -> ca.Function:
    return closure_functions(rack_model(), arm)[closure_name(arm, "first")]


def joints_at(pose: Array) -> tuple[Array, Array]:
    first, second = (
        np.array(closure(arm)(pose, rack_model().start[arm])[0]).ravel() for arm in (0, 1)
    )
    return first, second


@given(st.integers(0, 10_000))
def test_solved_joints_hold_the_box(seed: int) -> None:
    pose = pose_near_start(seed)
    for arm, q in enumerate(joints_at(pose)):
        cell = rack_model().workcell
        target = flange_target(
            cell.robots[arm], cell.contacts[arm], pose[:3], rotation_matrix(Orientation(), pose[3:])
        )
        residual = pose_error(*target, *rack_model().robots[arm].placement(q))[1]
        assert float(residual) < 1e-8


def test_clearances_lie_about_the_sharp_bound() -> None:
    """Smooth ones below, the largest gaps above."""
    placements = (rack_model().robots[0].joint_placements, rack_model().robots[1].joint_placements)
    sharp = screening_functions(rack_model().geometry, placements)["clearance"]
    names, columns = rack_model().geometry.pair_names, rack_model().geometry.columns
    assert {"top board", "pallet in front"} <= {names[index][1] for index in point().separable()}
    for seed in range(3):
        pose = pose_near_start(seed)
        q = joints_at(pose)
        bounds = np.array(sharp(pose, *q)).ravel()
        for index in range(0, len(bounds), 7):
            smooth = value_of(Clearance(0, index), pose, STILL, *q)
            assert bounds[index] - 0.1 <= smooth <= bounds[index] + 1e-12
        for index in point().separable():
            gaps = gaps_at(index, pose)
            assert len(gaps) == SEPARATING_DIRECTIONS
            assert bounds[columns[index]] <= gaps.max() + 1e-12


@given(
    st.integers(0, 10**6),
    arrays(float, 3, elements=st.floats(-0.3, 0.3)),
    arrays(float, 3, elements=st.floats(-1.2, 1.2)),
)
def test_one_direction_separates_boxes_that_are_apart(
    chosen: int, away: Array, turn: Array
) -> None:
    """Against Coal, near an edge of an obstacle: the largest gap is positive where they are apart,
    and never more than their distance then."""
    index = point().separable()[chosen % len(point().separable())]
    obstacle = rack_model().geometry.bodies[rack_model().geometry.active[index].second].pieces[0]
    assert isinstance(obstacle.shape, Box)
    half = np.asarray(obstacle.shape.size) / 2.0
    edge = half * np.where(np.arange(3) == chosen % 3, 0.0, 1.0 - 2.0 * (chosen // 3 % 2))
    pose = np.concatenate([obstacle.pose[:3, :3] @ edge + obstacle.pose[:3, 3] + away, turn])
    rotation = rotation_matrix(rack_model().workcell.task.orientation, turn)
    payload = rack_model().geometry.bodies[rack_model().geometry.index(PAYLOAD_NAME)].pieces[0]
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = np.array(ca.DM(rotation)), pose[:3]
    edges = np.array(ca.DM(rotation)), obstacle.pose[:3, :3]
    assume(np.abs(edges[1].T @ edges[0]).max() < (1.0 - PARALLEL_SINE**2) ** 0.5 - 1e-6)
    distance = coal_distance((replace(payload, pose=placed @ payload.pose),), (obstacle,))
    assume(abs(distance) > 1e-6)
    largest = gaps_at(index, pose).max()
    assert (largest > 0.0) == (distance > 0.0)
    assert largest <= max(distance, 0.0) + 1e-5


def test_a_row_of_a_gap_falls_short_of_it_by_what_its_kinks_are_rounded() -> None:
    workcell = rack_model().workcell
    sizes = {b.name: b.shape.size for b in workcell.environment if isinstance(b.shape, Box)}
    pose = pose_near_start(1)
    for index in point().separable():
        size = sizes[rack_model().geometry.pair_names[index][1]]
        # Each rounded kink of a rotation's entry takes TURN of half an edge at most.
        rounded = PARALLEL_WIDTH * (workcell.payload.size.sum() + size.sum()) / 2.0
        gaps = gaps_at(index, pose)
        assert (gaps > PARALLEL_GAP).sum() >= 12
        for direction in np.flatnonzero(gaps > PARALLEL_GAP).tolist():
            value = value_of(SeparatingAxisGap(index, direction), pose, STILL, STILL, STILL)
            assert gaps[direction] - rounded <= value <= gaps[direction] + 1e-12


def test_a_passing_row_is_the_height_at_which_the_gaps_meet() -> None:
    index = next(
        k for k in point().separable() if rack_model().geometry.pair_names[k][1] == "top board"
    )
    pose = np.array([-0.34, 0.01, 0.86, 0.01, 0.05, 0.02])
    rate = np.array([-2e-3, 1e-4, 2e-3, 1e-4, -2e-4, 1e-4])
    apart = np.flatnonzero(gaps_at(index, pose) > PARALLEL_GAP)

    def along(steps: float) -> Array:
        at = pose + steps * rate, STILL, STILL, STILL
        return np.array([value_of(SeparatingAxisGap(index, int(k)), *at) for k in apart])

    slopes = (along(1e-4) - along(-1e-4)) / 2e-4
    before, after = int(np.argmin(slopes)), int(np.argmax(slopes))
    meeting = (along(0.0)[before] - along(0.0)[after]) / (slopes[after] - slopes[before])
    row = AxisSwitchGap(index, int(apart[before]), int(apart[after]))
    height = value_of(row, pose, rate, STILL, STILL)
    assert height == pytest.approx(along(0.0)[before] + meeting * slopes[before], abs=1e-7)


@pytest.mark.parametrize("arm", [0, 1])
def test_joint_rows_are_their_definitions(arm: int) -> None:
    pose = pose_near_start(1)
    q = joints_at(pose)
    robot = rack_model().workcell.robots[arm]
    for joint in range(6):
        lower = value_of(JointLimit(arm, joint, "lower"), pose, STILL, *q)
        upper = value_of(JointLimit(arm, joint, "upper"), pose, STILL, *q)
        assert lower == pytest.approx(q[arm][joint] - robot.position_lower[joint])
        assert upper == pytest.approx(robot.position_upper[joint] - q[arm][joint])
    jacobian = np.array(rack_model().robots[arm].jacobian(q[arm]))
    share = abs(np.linalg.det(jacobian)) / robot.min_manipulability
    value = value_of(ManipulabilityLimit(arm), pose, STILL, *q)
    assert value == pytest.approx(share**2 - 1.0, rel=1e-9)
    assert float(manipulability(jacobian)) == pytest.approx(abs(np.linalg.det(jacobian)))


def cell_with(time_law: str, samples: int = 12, allocation: str = "paper") -> Workcell:
    cell = hand_cell()
    task = replace(cell.task, time_law=time_law, samples=samples, allocation=allocation)
    return replace(cell, task=task)


def random_x(cell: Workcell, seed: int) -> Array:
    return np.random.default_rng(seed).uniform(cell.task.lower, cell.task.upper)


def split_of(
    cell: Workcell, functions: Mapping[str, ca.Function], x: Array, rounding: float = 0.0
) -> Array:
    """(samples, 2) from the blocks, put in the samples' order."""
    split = np.full((cell.task.samples, 2), np.nan)
    for block in sample_blocks(cell.task):
        values = functions[sample_name("force", block.block, "first")]
        for samples, basis in zip(block.samples, block.basis, strict=True):
            split[samples] = np.array(values(x, basis.T, rounding)[0]).reshape(-1, 2)
    return split


@pytest.mark.parametrize("time_law", ["constant", "ramped"])
@pytest.mark.parametrize(
    ("samples", "allocation"), [(5, "paper"), (6, "paper"), (12, "paper"), (12, "soft-finger")]
)
def test_the_largest_branch_is_the_evaluators_normal_force(
    time_law: str, samples: int, allocation: str
) -> None:
    cell = cell_with(time_law, samples, allocation)
    evaluate = candidate_function(hand_model(cell))
    coefficients, functions = contact_model(cell).force_branches, sample_functions(cell, "force")
    for seed in range(5):
        x = random_x(cell, seed)
        outputs = dict(zip(evaluate.name_out(), evaluate(x), strict=True))
        expected = np.array(outputs["normal_force"]).T
        forces = np.einsum("rbk,nk->nrb", coefficients, split_of(cell, functions, x)).max(axis=2)
        np.testing.assert_allclose(forces, expected, rtol=1e-10, atol=1e-9)


def test_a_rounded_time_law_is_near_the_sharp_one_and_nearer_the_less_it_is_rounded() -> None:
    cell = cell_with("constant")
    functions, x = sample_functions(cell, "force"), random_x(cell, 0)
    sharp = split_of(cell, functions, x)
    errors = [
        np.abs(split_of(cell, functions, x, rounding) - sharp).max()
        for rounding in (1e-2, 1e-3, 1e-4)
    ]
    assert 0.0 < errors[2] < errors[1] < errors[0] < 0.05 * np.abs(sharp).max()


@pytest.mark.parametrize("rounding", [0.0, 0.02])
@pytest.mark.parametrize(
    ("quantity", "allocation"),
    [("force", "paper"), ("pressure", "paper"), ("load", "paper"), ("force", "soft-finger")],
)
@pytest.mark.parametrize("time_law", ["constant", "ramped"])
def test_derivatives_are_those_of_the_values(
    time_law: str, quantity: Quantity, allocation: str, rounding: float
) -> None:
    cell = cell_with(time_law, allocation=allocation)
    functions = sample_functions(cell, quantity)
    rng = np.random.default_rng(3)
    step = 1e-6
    for block in sample_blocks(cell.task):
        first, second = (
            functions[sample_name(quantity, block.block, order)] for order in ("first", "second")
        )
        x, basis = random_x(cell, 1), block.basis[len(block.basis) // 2].T
        weight = rng.normal(size=first.size1_out(0))
        slopes, curvature = [], []
        for direction in np.eye(cell.task.n_var):
            moves = step * direction, -step * direction
            ahead, behind = (first(x + move, basis, rounding) for move in moves)
            slopes.append((np.array(ahead[0]) - np.array(behind[0]))[:, 0])
            curvature.append((np.array(ahead[1]) - np.array(behind[1])) @ weight)
        exact = np.array(first(x, basis, rounding)[1])
        np.testing.assert_allclose(np.array(slopes) / (2 * step), exact, rtol=1e-5, atol=1e-4)
        np.testing.assert_allclose(
            np.array(curvature) / (2 * step),
            np.hstack(
                [ca.DM(second(x, basis, rounding, weight, e)).full() for e in np.eye(len(x))]
            ),
            rtol=1e-5,
            atol=1e-3,
        )


def test_every_sample_is_served_once() -> None:
    for samples in (5, 6, 7, 100):
        blocks = sample_blocks(cell_with("constant", samples).task)
        served = np.concatenate([block.samples.ravel() for block in blocks])
        assert sorted(served.tolist()) == list(range(samples))
