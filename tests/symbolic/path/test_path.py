"""The box's path: splines, pieces of them, rotations and time laws, by independent formulas."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from studies.research.plain.motion import (
    angular_rates,
    evaluate_spline,
    natural_quintic,
    vector_rates,
    waypoints,
)
from symbolic.array import Array
from symbolic.errors import WorkcellError
from symbolic.path.rotation import (
    angular_acceleration,
    angular_velocity,
    rotation_matrix,
)
from symbolic.path.spline import (
    coarse_entries,
    coarse_task,
    extended_waypoints,
    hierarchical_basis,
    path_basis,
    path_position,
    refined_task,
    resample_decisions,
    sample_basis,
    waypoint_matrix,
)
from symbolic.path.time_law import STEP_TIME_FLOOR, timed_path
from symbolic.read.cell import load
from symbolic.records import Task, Waypoint
from symbolic.records.poses import Orientation, box_placement, box_rotation, rotation_from_rpy
from symbolic.records.task import initial_decision
from tests.symbolic.cells import call, fixed, free, hand_cell, with_task
from tests.symbolic.read.samples import RACK

PARAMETER = np.linspace(0.0, 1.0, 41)


def task_with(*points: Waypoint) -> Task:
    return with_task(hand_cell(), waypoints=points).task


def waypoint_values(task: Task, x: Array) -> Array:
    symbol = ca.MX.sym("x", task.n_var)
    function = ca.Function("waypoints", [symbol], [waypoint_matrix(task, symbol)])
    return np.array(function(x)).T


def random_points(count: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 6))


@pytest.mark.parametrize("count", range(2, 11))
def test_agrees_with_the_conditions_solved_one_by_one(count: int) -> None:
    points = random_points(count)
    basis = path_basis(count, PARAMETER)
    spline = natural_quintic(points)
    for order, matrix in enumerate((basis.position, basis.first, basis.second)):
        expected = [evaluate_spline(spline, u, order) for u in PARAMETER]
        np.testing.assert_allclose(matrix @ points, expected, rtol=1e-9, atol=1e-9)


@given(
    angles=st.lists(st.tuples(*[st.floats(-12.0, 12.0) for _ in range(3)]), min_size=2, max_size=6)
)
def test_angles_are_unwrapped_as_numpy_does(angles: list[tuple[float, ...]]) -> None:
    poses = [np.concatenate([np.zeros(3), value]) for value in angles]
    task = task_with(
        fixed(np.zeros(6)), *(free(p, np.full(6, 20.0)) for p in poses[:-1]), fixed(poses[-1])
    )
    x = np.concatenate(poses[:-1])
    np.testing.assert_allclose(waypoint_values(task, x), waypoints(task, x), atol=1e-12)


@pytest.mark.parametrize("turn", [np.pi, -np.pi])
def test_half_a_turn_keeps_the_direction_that_was_written(turn: float) -> None:
    task = task_with(fixed(np.zeros(6)), fixed([0.0, 0.0, 0.0, 0.0, 0.0, turn]))
    assert waypoint_values(task, np.zeros(0))[1, 5] == turn


PIECES = 3


@cache
def both(name: str) -> tuple[Task, Task]:
    """A shipped task as it is stated under the time law 'optimal', and in pieces."""
    task = replace(load(RACK.with_name(f"{name}.toml")).task, time_law="optimal", pieces=1)
    return task, refined_task(replace(task, pieces=PIECES))


def drawn(task: Task, count: int = 4) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    high = np.where(np.isfinite(task.upper), task.upper, 1e3)
    return np.random.default_rng(1).uniform(task.lower, high, (count, task.n_var))


@pytest.mark.parametrize("name", ["rack", "pandas", "transfer"])
def test_paths_through_stated_waypoints_are_paths_through_all(name: str) -> None:
    coarse, fine = both(name)
    x = drawn(coarse)
    same = resample_decisions(x, coarse, fine)
    assert same.shape == (len(x), fine.n_var)
    assert ((same >= fine.lower) & (same <= fine.upper)).all()
    np.testing.assert_array_equal(same[:, -1], x[:, -1])
    u = np.random.default_rng(2).uniform(size=30)
    at = [path_position(len(task.waypoints), u) for task in (coarse, fine)]
    for one, other in zip(x, same, strict=True):
        expected = at[0] @ extended_waypoints(coarse, one)
        np.testing.assert_allclose(at[1] @ extended_waypoints(fine, other), expected, atol=1e-12)
    np.testing.assert_array_equal(resample_decisions(same, fine, coarse), x)


@pytest.mark.parametrize("name", ["rack", "pandas", "transfer"])
def test_the_stated_task_comes_back(name: str) -> None:
    coarse, fine = both(name)
    again = coarse_task(fine)
    assert coarse_task(coarse) is coarse
    assert len(fine.waypoints) == PIECES * (len(coarse.waypoints) - 1) + 1
    for field in ("lower", "upper", "initial"):
        np.testing.assert_array_equal(getattr(again, field), getattr(coarse, field))
    hand_made = resample_decisions(initial_decision(coarse), coarse, fine)[0]
    np.testing.assert_allclose(initial_decision(fine), hand_made, atol=1e-12)
    for one, other in zip(again.redundant, coarse.redundant, strict=True):
        np.testing.assert_array_equal(one.initial, other.initial)
        np.testing.assert_array_equal(one.moving, other.moving)


@pytest.mark.parametrize("name", ["rack", "pandas"])
def test_moves_of_stated_waypoints_are_followed_by_the_others(name: str) -> None:
    coarse, fine = both(name)
    x, n, m = drawn(coarse, 1)[0], coarse.n_path, fine.n_path
    levels, square = hierarchical_basis(fine)
    assert levels.shape == (m, m)
    assert np.linalg.matrix_rank(levels) == m
    own = coarse_entries(fine)
    by, others = levels[:, own], np.setdiff1d(np.arange(m), own)
    np.testing.assert_array_equal(levels[np.ix_(own, others)], 0.0)
    np.testing.assert_array_equal(square[own], 1.0)
    np.testing.assert_allclose(square[others], 1.0 / PIECES**2)
    np.testing.assert_array_equal(by[coarse_entries(fine)], np.eye(n))
    step = 1e-3 * np.random.default_rng(3).normal(size=n)
    inside = np.clip(x[:n] + step, coarse.lower[:n], coarse.upper[:n])
    moved = resample_decisions(inside, coarse, fine)[0] - resample_decisions(x[:n], coarse, fine)[0]
    np.testing.assert_allclose(by @ (inside - x[:n]), moved, atol=1e-12)


def with_pieces(count: int) -> str:
    lines = RACK.read_text("utf-8").splitlines()
    lines = [line for line in lines if not line.startswith("drivable_pieces")]
    return "\n".join(lines).replace("[task]", f"[task]\ndrivable_pieces = {count}", 1)


def test_only_what_robots_drive_is_cut_into_pieces() -> None:
    text = with_pieces(2)
    usual = load(RACK, text=text.encode())
    assert len(usual.task.waypoints) == 5
    law = 'time_law = "constant"'
    driven = load(RACK, text=text.replace(law, 'time_law = "optimal"').encode())
    assert len(driven.task.waypoints) == 9
    assert driven.task.pieces == 2
    with pytest.raises(WorkcellError, match=r"task\.drivable_pieces: .*0"):
        load(RACK, text=with_pieces(0).encode())


ANGLES = Orientation()
REFERENCE = rotation_from_rpy([0.4, -1.1, 2.0])
VECTORS = Orientation("quaternion", REFERENCE)
PLAIN_VECTORS = Orientation("quaternion")

TINY = float(np.finfo(float).tiny)
"""Below it numbers lose their digits."""

angle = st.floats(-7.0, 7.0)
angles = st.tuples(angle, angle, angle).map(np.array)

component = st.floats(-3.6, 3.6)
vectors = st.tuples(component, component, component).map(np.array)
"""Rotation vectors up to about a full turn."""


def rates_function(orientation: Orientation) -> ca.Function:
    numbers, rate, second = (ca.SX.sym(name, 3) for name in ("numbers", "rate", "second"))
    results = [
        rotation_matrix(orientation, numbers),
        angular_velocity(orientation, numbers, rate),
        angular_acceleration(orientation, numbers, rate, second),
    ]
    return ca.Function("rates", [numbers, rate, second], results)


RATES = {chart: rates_function(each) for chart, each in enumerate((ANGLES, VECTORS, PLAIN_VECTORS))}
OF_ANGLES, OF_VECTORS, OF_PLAIN_VECTORS = RATES


def rates(
    rpy: Array, rate: Array, second: Array, chart: int = OF_ANGLES
) -> tuple[Array, Array, Array]:
    rotation, velocity, acceleration = (np.array(v) for v in RATES[chart](rpy, rate, second))
    return rotation, velocity[:, 0], acceleration[:, 0]


@given(rpy=angles)
def test_rotation_is_yaw_pitch_roll_about_moving_axes(rpy: Array) -> None:
    expected = Rotation.from_euler("ZYX", rpy[::-1]).as_matrix()
    np.testing.assert_allclose(rates(rpy, rpy, rpy)[0], expected, atol=1e-14)
    np.testing.assert_allclose(rotation_from_rpy(rpy), expected, atol=1e-14)


@given(rpy=angles, rate=angles, second=angles)
def test_rates_agree_with_axes_carried_round(rpy: Array, rate: Array, second: Array) -> None:
    _, velocity, acceleration = rates(rpy, rate, second)
    expected_velocity, expected_acceleration = angular_rates(rpy, rate, second)
    np.testing.assert_allclose(velocity, expected_velocity, atol=1e-12)
    np.testing.assert_allclose(acceleration, expected_acceleration, atol=1e-11)


@given(vector=vectors)
def test_a_rotation_vector_turns_the_reference(vector: Array) -> None:
    expected = Rotation.from_rotvec(vector).as_matrix() @ REFERENCE
    np.testing.assert_allclose(rates(vector, vector, vector, OF_VECTORS)[0], expected, atol=3e-14)
    np.testing.assert_allclose(box_rotation(VECTORS, [0, 0, 0, *vector]), expected, atol=3e-14)


@given(vector=vectors, rate=angles, second=angles)
def test_rates_of_a_rotation_vector_agree_with_quadrature(
    vector: Array, rate: Array, second: Array
) -> None:
    _, velocity, acceleration = rates(vector, rate, second, OF_VECTORS)
    expected_velocity, expected_acceleration = vector_rates(vector, rate, second)
    np.testing.assert_allclose(velocity, expected_velocity, atol=1e-12)
    np.testing.assert_allclose(acceleration, expected_acceleration, atol=1e-11)


@given(vector=vectors, rate=vectors)
def test_the_derivatives_of_a_rotation_vector_hold_at_and_near_zero(
    vector: Array, rate: Array
) -> None:
    for size in (0.0, 1e-160, 1e-9, 1e-5):
        rotation, velocity, _ = rates(size * vector, rate, rate, OF_PLAIN_VECTORS)
        np.testing.assert_allclose(rotation, np.eye(3), atol=8 * size)
        np.testing.assert_allclose(velocity, rate, atol=50 * size + TINY)


@given(rpy=angles, xyz=angles)
def test_placements_of_many_poses_are_those_of_each(rpy: Array, xyz: Array) -> None:
    poses = np.array([[*xyz, *rpy], [*rpy, *xyz / 2.0]])
    for orientation in (ANGLES, VECTORS):
        placed = box_placement(orientation, poses)
        for T, pose in zip(placed, poses, strict=True):
            np.testing.assert_allclose(T, box_placement(orientation, pose), atol=1e-15)
            np.testing.assert_array_equal(T[:3, 3], pose[:3])
            np.testing.assert_array_equal(T[3], [0.0, 0.0, 0.0, 1.0])


def timed(task: Task, x: Array | None = None) -> dict[str, Array]:
    """Time, pose, rate and second_rate with samples in rows."""
    return call(timed_function(task), np.zeros(0) if x is None else x)


def timed_function(task: Task) -> ca.Function:
    symbol = ca.MX.sym("x", task.n_var)
    path = timed_path(task, sample_basis(task), waypoint_matrix(task, symbol))
    outputs = {name: getattr(path, name) for name in ("time", "pose", "rate", "second_rate")}
    return ca.Function("timed", [symbol], list(outputs.values()), ["x"], list(outputs))


def task_through(*poses: Array | list[float], **changes: object) -> Task:
    waypoints: tuple[Waypoint, ...] = tuple(fixed(pose) for pose in poses)
    return with_task(hand_cell(), waypoints=waypoints, **changes).task


def random_task(seed: int, **changes: object) -> Task:
    rng = np.random.default_rng(seed)
    poses = rng.uniform(-0.4, 0.4, (int(rng.integers(3, 7)), 6))
    return task_through(*poses, **changes)


# --- the paper's constant law ---


@given(seed=st.integers(0, 2**31), samples=st.integers(3, 80))
def test_constant_law_differentiates_as_numpy_does(seed: int, samples: int) -> None:
    result = timed(random_task(seed, samples=samples))
    rate = np.gradient(result["pose"], result["time"], axis=0, edge_order=2)
    second = np.gradient(rate, result["time"], axis=0, edge_order=2)
    np.testing.assert_allclose(result["rate"], rate, atol=1e-10 * np.abs(rate).max())
    np.testing.assert_allclose(result["second_rate"], second, atol=1e-9 * np.abs(second).max())


def test_a_rounded_step_takes_longer_by_at_most_the_rounding() -> None:
    """The hyperbola exceeds the longer of both times by that share where they agree."""
    task, rounding = random_task(7, samples=40), 0.05
    path = timed_path(
        task, sample_basis(task), waypoint_matrix(task, ca.MX.sym("x", 0)), ca.MX(rounding)
    )
    rounded = np.diff(np.array(ca.evalf(path.time)).ravel())
    sharp = np.diff(timed(task)["time"])
    assert (rounded > sharp).all()
    assert (rounded <= sharp * (1.0 + rounding) * (1.0 + 1e-12)).all()


@pytest.mark.parametrize("law", ["constant", "ramped"])
def test_a_path_that_stands_still_stays_finite(law: str) -> None:
    pose = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    result = timed(task_through(pose, pose, pose, samples=12, time_law=law))
    assert all(np.all(np.isfinite(value)) for value in result.values())
    assert np.all(np.diff(result["time"]) > 0.0)
    np.testing.assert_allclose(result["rate"], 0.0, atol=1e-6)
    if law == "constant":
        np.testing.assert_allclose(np.diff(result["time"]), STEP_TIME_FLOOR, rtol=1e-6)


@pytest.mark.parametrize("law", ["constant", "ramped"])
def test_derivatives_stay_finite_without_rotation_and_without_translation(law: str) -> None:
    start = [0.0, 0.0, 0.7, 0.0, 0.0, 0.0]
    for target in ([0.3, 0.0, 0.7, 0.0, 0.0, 0.0], [0.0, 0.0, 0.7, 0.0, 0.0, 0.8]):
        middle = np.add(start, target) / 2.0
        free = Waypoint(middle - 0.1, middle + 0.1)
        task = with_task(
            hand_cell(), waypoints=(fixed(start), free, fixed(target)), samples=20, time_law=law
        ).task
        function = timed_function(task)
        x = ca.MX.sym("x", 6)
        named = dict(zip(function.name_out(), function.call([x]), strict=True))
        jacobian = ca.Function("jacobian", [x], [ca.jacobian(ca.vec(v), x) for v in named.values()])
        for value in jacobian.call([ca.DM(middle)]):
            assert np.all(np.isfinite(value.full()))


# --- our ramped law ---


def length_rate(task: Task, u: float) -> float:
    """Arc length per unit of u, rotation counted at the ratio of the reference speeds."""
    basis = path_basis(len(task.waypoints), np.array([u]))
    points = np.array([w.lower for w in task.waypoints])
    pose, first = (basis.position @ points)[0], (basis.first @ points)[0]
    omega, _ = angular_rates(pose[3:], first[3:], np.zeros(3))
    lever = task.reference_speed / task.reference_angular_speed
    return float(max(np.linalg.norm(first[:3]), lever * np.linalg.norm(omega)))


CURVE = (
    [0.0, 0.0, 0.7, 0.0, 0.0, 0.0],
    [-0.4, 0.05, 0.8, 0.1, -0.1, 0.1],
    [-0.5, 0.0, 1.0, 0.0, 0.1, 0.0],
    [0.0, 0.0, 1.1, 0.0, 0.0, 0.0],
)


def test_ramped_derivatives_are_those_of_the_sampled_motion() -> None:
    """Finite differences on a fine grid; the path turns little, so translation sets the pace."""
    result = timed(task_through(*CURVE, time_law="ramped", samples=4001))
    time = result["time"]
    # Samples uniform in the path are sparse in time near rest: judge where they are dense.
    inside = (time > 0.15) & (time < time[-1] - 0.15)
    assert inside.sum() > 3900
    rate = np.gradient(result["pose"], time, axis=0, edge_order=2)
    second = np.gradient(result["rate"], time, axis=0, edge_order=2)
    np.testing.assert_allclose(result["rate"][inside], rate[inside], atol=1e-4)
    np.testing.assert_allclose(result["second_rate"][inside], second[inside], atol=1e-2)


def test_ramped_law_lasts_as_long_as_its_formula_says() -> None:
    """Ramp time plus arc length over cruise speed, the arc length from adaptive quadrature."""
    task = task_through(*CURVE, time_law="ramped", samples=400)
    knots = np.linspace(0.0, 1.0, len(CURVE))
    arc = quad(
        lambda u: length_rate(task, u), 0.0, 1.0, points=knots[1:-1], epsabs=1e-12, limit=200
    )[0]
    expected = task.ramp_time + arc / task.reference_speed
    assert timed(task)["time"][-1] == pytest.approx(expected, rel=1e-7)


def test_ramped_law_cruises_at_the_reference_speed_and_never_exceeds_it() -> None:
    task = task_through(*CURVE, time_law="ramped", samples=300)
    result = timed(task)
    speed = np.linalg.norm(result["rate"][:, :3], axis=1)
    cruising = (result["time"] > task.ramp_time) & (
        result["time"] < result["time"][-1] - task.ramp_time
    )
    assert cruising.sum() > 100
    np.testing.assert_allclose(speed[cruising], task.reference_speed, rtol=1e-9)
    assert speed.max() <= task.reference_speed * (1 + 1e-9)
