"""Both time laws: NumPy's gradient, finite differences and closed forms."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from studies.research.plain.motion import angular_rates
from symbolic.array import Array
from symbolic.path.spline import path_basis, sample_basis, waypoint_matrix
from symbolic.path.time_law import STEP_TIME_FLOOR, timed_path
from symbolic.records import Task, Waypoint
from tests.symbolic.cells import call, fixed, hand_cell, with_task


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


def test_constant_law_moves_every_step_at_the_reference_speed() -> None:
    task = task_through([0, 0, 0, 0, 0, 0], [0.3, 0.1, 0.2, 0, 0, 0], [0.5, -0.2, 0.4, 0, 0, 0])
    result = timed(task)
    lengths = np.linalg.norm(np.diff(result["pose"][:, :3], axis=0), axis=1)
    np.testing.assert_allclose(lengths / np.diff(result["time"]), task.reference_speed, rtol=1e-12)
    assert result["time"][0] == 0.0


def test_constant_law_gives_a_pure_rotation_the_time_it_needs() -> None:
    task = task_through([0, 0, 1, 0, 0, 0], [0, 0, 1, 0, 0, 1.2])
    result = timed(task)
    assert result["time"][-1] == pytest.approx(1.2 / task.reference_angular_speed, rel=1e-9)
    np.testing.assert_allclose(result["rate"][:, 5], task.reference_angular_speed, rtol=1e-8)


def test_constant_law_takes_the_slower_of_moving_and_turning() -> None:
    moving, turning = [1.0, 0, 0, 0, 0, 0.1], [0.1, 0, 0, 0, 0, 1.0]
    for target, seconds in ((moving, 1.0 / 0.25), (turning, 1.0 / 0.5)):
        result = timed(task_through(np.zeros(6), target))
        assert result["time"][-1] == pytest.approx(seconds, rel=1e-9)


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


@given(seed=st.integers(0, 2**31))
def test_ramped_law_starts_and_ends_at_rest(seed: int) -> None:
    result = timed(random_task(seed, time_law="ramped"))
    for end in (0, -1):
        np.testing.assert_allclose(result["rate"][end], 0.0, atol=1e-12)
        np.testing.assert_allclose(result["second_rate"][end], 0.0, atol=1e-7)
    assert np.all(np.diff(result["time"]) > 0.0)


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


def test_a_short_path_never_reaches_the_cruise_speed() -> None:
    """Two ramps back to back: twice the ramp time, peak speed length over ramp time."""
    length = 0.05
    task = task_through(np.zeros(6), [length, 0, 0, 0, 0, 0], time_law="ramped", samples=201)
    assert length / task.ramp_time < task.reference_speed
    result = timed(task)
    assert result["time"][-1] == pytest.approx(2 * task.ramp_time, rel=1e-9)
    assert result["rate"][:, 0].max() == pytest.approx(length / task.ramp_time, rel=1e-9)


def test_ramped_pure_rotation_turns_at_the_reference_angular_speed() -> None:
    task = task_through([0, 0, 1, 0, 0, 0], [0, 0, 1, 0, 0, 1.5], time_law="ramped", samples=200)
    result = timed(task)
    expected = task.ramp_time + 1.5 / task.reference_angular_speed
    assert result["time"][-1] == pytest.approx(expected, rel=1e-8)
    assert result["rate"][:, 5].max() == pytest.approx(task.reference_angular_speed, rel=1e-8)
    np.testing.assert_allclose(result["rate"][:, :5], 0.0, atol=1e-12)
