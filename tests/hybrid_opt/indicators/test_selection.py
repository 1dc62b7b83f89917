"""The balanced solution, the static hold and the payload that a carry could bear."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.campaign.results import Replica
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.front import balanced, knee, peak_normal_forces, select, selected_row
from hybrid_opt.static_hold import payload_limit, static_hold
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.cell import load
from symbolic.records import Workcell
from symbolic.records.task import initial_decision
from tests.hybrid_opt.campaign.fake import RACK
from tests.hybrid_opt.cells import drivable, shipped
from tests.refusals import refused


@pytest.fixture(scope="module")
def evaluator() -> CandidateEvaluator:
    return shipped("transfer").evaluator


def replica_of(evaluator: CandidateEvaluator, count: int) -> Replica:
    x = np.random.default_rng(8).uniform(evaluator.lower, evaluator.upper, (count, evaluator.n_var))
    found = evaluator.evaluate(x)
    return Replica("random", 0, found, 0.0)


def test_balanced_is_the_least_mean() -> None:
    assert balanced(np.array([[50.0, 70.0], [59.0, 60.0], [80.0, 30.0], [55.0, 55.0]])) == 3
    assert balanced(np.array([[50.0, 60.0], [55.0, 55.0]])) == 1
    assert balanced(np.array([[50.0, 60.0], [55.02, 55.02]])) == 0
    assert balanced(np.array([[50.0, 60.0], [55.01, 55.01]])) == 1


def test_selected_is_the_least_mean_of_the_front(evaluator: CandidateEvaluator) -> None:
    static = static_hold(evaluator.workcell)
    replica = replica_of(evaluator, 300)
    assert len(replica.front_rows) > 1
    selected = select(evaluator, replica.front_x, replica.front_rows)
    assert selected is not None
    reference = evaluator.workcell.task.reference_force
    means = (replica.front * reference).mean(axis=1)
    assert selected.row == replica.front_rows[np.argmin(means)]
    np.testing.assert_allclose(selected.carry.peak_normal_force, selected.objectives * reference)
    outputs = evaluator.outputs(selected.carry.x[None])
    normal = outputs["normal_force"][0]
    np.testing.assert_array_equal(selected.carry.normal_force.min(axis=0), normal.min(axis=0))
    excess = 100.0 * (selected.carry.peak_normal_force / static.normal_force - 1.0)
    np.testing.assert_allclose(selected.carry.excess_above_static, excess)
    assert excess.min() <= selected.carry.mean_excess_above_static <= excess.max()
    whole = np.linalg.norm(outputs["contact_force"][0].reshape(-1, 2, 3), axis=2).max(axis=0)
    expected = payload_limit(evaluator.workcell, whole)
    assert selected.carry.figures["payload_limit"] == pytest.approx(expected, rel=1e-12)


def test_peaks_do_not_depend_on_how_many_are_asked_for(evaluator: CandidateEvaluator) -> None:
    x = np.random.default_rng(2).uniform(evaluator.lower, evaluator.upper, (300, evaluator.n_var))
    together = peak_normal_forces(evaluator, x)
    assert together.shape == (300, 2)
    np.testing.assert_array_equal(peak_normal_forces(evaluator, x[280:]), together[280:])


def test_the_knee_stands_for_drivable_carries() -> None:
    cell = drivable("rack")
    path = initial_decision(cell.workcell.task)[: cell.workcell.task.n_path]
    x = np.array([np.append(path, force) for force in (49.2, 50.0, 52.0, 55.0, 70.0)])
    row = selected_row(cell.evaluator, x)
    assert row == knee(cell.evaluate(x).objectives)
    # The gentlest one has the least mean of both forces, and hardly moves.
    assert balanced(peak_normal_forces(cell.evaluator, x)) == 0 != row


def test_an_empty_front_selects_nothing(evaluator: CandidateEvaluator) -> None:
    assert select(evaluator, np.empty((0, evaluator.n_var))) is None


def with_friction(cell: Workcell, friction: float, mass: float) -> Workcell:
    first, second = (replace(contact, friction=friction) for contact in cell.contacts)
    return replace(cell, contacts=(first, second), payload=replace(cell.payload, mass=mass))


@given(st.floats(0.2, 1.5), st.floats(1.0, 30.0))
def test_static_hold_in_closed_form(friction: float, mass: float) -> None:
    cell = with_friction(load(RACK), friction, mass)
    hold = static_hold(cell)
    assert static_hold(cell) is hold, "worked out once"
    weight = 9.81 * mass
    np.testing.assert_allclose(hold.normal_force, weight / (2.0 * friction), rtol=1e-9)
    whole = 0.5 * weight * np.sqrt(1.0 + 1.0 / friction**2)
    np.testing.assert_allclose(hold.contact_force, whole, rtol=1e-9)


def test_static_payload_of_the_paper() -> None:
    # 2 * 117.68 N / (9.81 m/s^2 * sqrt 2)
    hold = static_hold(with_friction(load(RACK), 1.0, 10.0))
    assert hold.payload_limit == pytest.approx(16.965, abs=5e-4)


def front(n: int, still: float = 49.0) -> Array:
    """Durations and forces: nearer to the force at rest a carry takes ever longer."""
    force = still * (1.0 + np.linspace(0.004, 0.5, n))
    return np.column_stack([2.0 + np.sqrt(0.05 * still / (force - still)), force])


def test_beside_it_a_per_cent_buys_no_more_than_a_per_cent() -> None:
    points = np.log(front(400))
    at = knee(front(400))
    assert 0 < at < len(points) - 1
    duration, force = (points - points[at]).T
    assert (duration + force >= 0.0).all()
    # It is where the slope in logarithms passes through one.
    slopes = -np.diff(points[:, 0]) / np.diff(points[:, 1])
    assert slopes[at - 1] >= 1.0 >= slopes[at]


@given(st.integers(3, 40), st.tuples(st.floats(0.01, 100.0), st.floats(0.01, 100.0)))
def test_units_do_not_matter(n: int, scale: tuple[float, float]) -> None:
    points = front(n)
    product = points.prod(axis=1)
    found = knee(points * np.array(scale))
    assert product[found] == pytest.approx(product.min(), rel=1e-12)


@given(st.integers(10, 60), st.integers(0, 3), st.integers(0, 3))
def test_how_far_the_ends_were_explored_does_not_matter(n: int, low: int, high: int) -> None:
    points = front(n)
    at = knee(points)
    low, high = min(low, at), min(high, n - 1 - at)
    assert knee(points[low : n - high]) == at - low


def test_small_fronts() -> None:
    assert knee(np.array([[2.0, 5.0]])) == 0
    assert knee(np.array([[2.0, 5.0], [2.0, 4.0]])) == 1
    with refused(SettingsError, "empty-front"):
        knee(np.zeros((0, 2)))
    with refused(SettingsError, "not-positive"):
        knee(np.array([[1.0, 0.0]]))
