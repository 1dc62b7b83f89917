"""Candidates of the time law 'optimal' against `time_path`, and what no timing can drive."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from codegen.build import build
from hybrid_opt import metaheuristics
from hybrid_opt.carry import DRIVE_CONSTRAINTS
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import REASONS, CandidateEvaluator
from hybrid_opt.evaluate.objectives import (
    DRIVABLE_OBJECTIVES,
    ROBUST_DRIVABLE_OBJECTIVES,
    non_dominated,
)
from hybrid_opt.metaheuristics.run import CarryProblem
from hybrid_opt.robust.force import robust_model
from hybrid_opt.timing.analysis import drivable_timing
from hybrid_opt.timing.candidates import CandidateDriver
from hybrid_opt.timing.records import TimingLimits, TimingStatus
from hybrid_opt.timing.solve import PATH_INTERVALS, PathTimer
from symbolic.array import Array
from symbolic.functions import candidate_function
from symbolic.geometry.clearance import screening_functions
from symbolic.path.spline import waypoints_of
from symbolic.records import Uncertainty, Workcell
from symbolic.records.task import initial_decision
from symbolic.robot.arm import posture_function
from tests.hybrid_opt.timing.cells import by_toppra, hand_timing, near_initial, timing_of
from tests.symbolic.cells import hand_cell, hand_model, with_task

STATIC = 98.1 / 2.0

AGREEMENT = 5e-3
"""Largest relative difference of the durations of a timing and of the independent one."""


def drivable_cell() -> Workcell:
    cell = with_task(hand_cell(), time_law="optimal", force_limit=(1.01 * STATIC, 60.0))
    return replace(cell, uncertainty=Uncertainty(friction=0.1))


@cache
def evaluator(objectives: tuple[str, ...] = DRIVABLE_OBJECTIVES) -> CandidateEvaluator:
    """The drivable hand cell, its functions compiled as a file's would be."""
    cell = drivable_cell()
    model = hand_model(cell)
    placements = (model.robots[0].joint_placements, model.robots[1].joint_placements)
    made = {
        "candidate": candidate_function(model),
        "posture": posture_function(cell.robots, model.robots, cell.contacts),
        **screening_functions(model.geometry, placements),
    } | {
        f"inverse_dynamics_{i + 1}": robot.inverse_dynamics for i, robot in enumerate(model.robots)
    }
    functions = build(made).functions
    timer = PathTimer(CompiledCell(cell, model=model), lanes=1)
    driver = CandidateDriver(timer, robust="robust_force" in objectives)
    return CandidateEvaluator(cell, objectives, functions=functions, driver=driver)


def candidates(count: int) -> Array:
    rng = np.random.default_rng(4)
    force = rng.uniform(1.05 * STATIC, 60.0, count)
    return np.column_stack([near_initial(rng, count, size=0.5), force])


def test_the_decision_vector_ends_with_the_force_limit() -> None:
    task = drivable_cell().task
    assert task.n_var == task.n_path + 1 == 19
    assert task.lower[-1] == 1.01 * STATIC
    assert task.upper[-1] == 60.0
    x = initial_decision(task)
    assert x[-1] == 60.0
    np.testing.assert_array_equal(waypoints_of(task, x)[1:-1], task.initial)


def test_objectives_are_those_of_time_path_at_the_candidates_force() -> None:
    x = candidates(2)
    found = evaluator().evaluate(x)
    outputs = evaluator().outputs(x)
    for k, row in enumerate(x):
        timing = by_toppra(hand_timing(100), row[:-1], TimingLimits(force=float(row[-1])))
        assert timing.ok, timing.reason
        assert outputs["time"][k, -1] == pytest.approx(timing.duration, rel=2e-3)
        peak = timing.driven.peak_normal_force.max() / 117.68
        assert found.objectives[k, 1] == pytest.approx(peak, rel=2e-3)
        # The samples lie on the timing: their time and forces are those of the recomputed carry.
        u = np.linspace(0.0, 1.0, 60)
        time = np.interp(u, timing.driven.parameter, timing.driven.time)
        np.testing.assert_allclose(outputs["time"][k], time, atol=0.01 * timing.duration)
        pose, rate = outputs["pose"][k], outputs["rate"][k]
        np.testing.assert_allclose(rate[[0, -1]], 0.0, atol=1e-9)
        steps = np.diff(outputs["time"][k])[:, None]
        path_length = np.cumsum(steps * (rate[1:] + rate[:-1]) / 2.0, axis=0)
        np.testing.assert_allclose(path_length, pose[1:] - pose[0], atol=6e-3)
        assert outputs["normal_force"][k].max() <= row[-1] * 1.005


def test_force_limits_hold_in_every_case_where_robust_forces_are_minimised() -> None:
    """Friction a tenth less at most: nearly a tenth more force."""
    x, robust = candidates(2), evaluator(ROBUST_DRIVABLE_OBJECTIVES)
    unsure = replace(hand_cell(), uncertainty=drivable_cell().uncertainty)
    x[:, -1] = 59.0
    found, planned = robust.evaluate(x), evaluator().evaluate(x)
    for k, row in enumerate(x):
        assert found.feasible[k] == planned.feasible[k]
        limits = TimingLimits(force=59.0, robust=True)
        timing = by_toppra(timing_of(unsure, 100), row[:-1], limits)
        assert timing.ok, timing.reason
        peak = robust_model(unsure).robust_force(timing.driven).peak.max()
        assert found.objectives[k, 1] == pytest.approx(peak / 117.68, rel=2e-3)
        outputs = robust.outputs(row)
        assert outputs["time"][0, -1] == pytest.approx(timing.duration, rel=2e-3)
        assert outputs["peak_force"].max() < 0.95 * peak
    x[:, -1] = 52.0
    names = [REASONS[code] for code in robust.evaluate(x).reason]
    assert names == ["force_limit"] * 2


def test_paths_that_cannot_be_driven_say_why_and_where() -> None:
    x = candidates(3)
    x[0, -1] = 0.9 * STATIC
    x[1, 0] -= 2.0
    found = evaluator().evaluate(x)
    names = ["" if code < 0 else REASONS[code] for code in found.reason]
    assert names[0] == "force_limit"
    assert names[1].startswith("reach")
    assert not found.feasible[:2].any()
    assert (found.penalised[:2] > 1.0).all()
    assert 0.0 <= found.position[0] <= 1.0
    column = REASONS.index("force_limit")
    driver = evaluator().driver
    assert driver is not None
    still = driver.timer.time(x[0, :-1], TimingLimits(force=1.0)).peak_force.max()
    assert found.violation[0, column] == pytest.approx(still / x[0, -1] - 1.0, rel=1e-9)
    assert found.violation[2, -len(DRIVE_CONSTRAINTS) :].max() == 0.0


def test_a_search_finds_a_front_that_time_path_confirms() -> None:
    problem = CarryProblem(evaluator(), "penalty")
    algorithm = metaheuristics.make("nsga2", {"population": 20}, candidates(4))
    metaheuristics.search(problem, algorithm, 60, np.random.default_rng(2))
    found = problem.evaluations
    rows = np.flatnonzero(non_dominated(found.objectives, found.feasible))
    assert len(rows) > 0
    best = found[rows[[int(np.argmin(found.objectives[rows, 0]))]]]
    timing = by_toppra(hand_timing(100), best.x[0, :-1], TimingLimits(force=float(best.x[0, -1])))
    assert timing.ok, timing.reason
    slowest = evaluator().outputs(best.x)["time"][0, -1]
    assert slowest == pytest.approx(timing.duration, rel=2e-3)


def test_less_force_violates_more_and_costs_more() -> None:
    x = np.repeat(candidates(1), 5, axis=0)
    x[:, -1] = np.linspace(20.0, 45.0, 5)
    found = evaluator().evaluate(x)
    assert (np.diff(found.penalised[:, 0]) < 0.0).all()


def test_a_drivable_carry_is_timed_as_the_search_found_it() -> None:
    """On a grid twice as fine, and within the force limit between its points, too."""
    model = timing_of(drivable_cell(), 2 * PATH_INTERVALS)
    driver = evaluator().driver
    assert driver is not None
    for x in candidates(3):
        timing, found = drivable_timing(model, x), driver.time_candidate(x).timing
        assert timing.ok
        assert timing.duration == pytest.approx(found.duration, rel=1e-9)
        assert timing.driven.normal_force.max() <= 1.005 * x[-1]
        assert timing.iterations == 0, "time_path was asked"
        other = by_toppra(model, x, TimingLimits(force=float(x[-1])))
        assert timing.duration == pytest.approx(other.duration, rel=AGREEMENT)
    # What the search cannot drive is told by `time_path`.
    x = np.append(x[:-1], 0.9 * STATIC)
    assert drivable_timing(model, x).status is TimingStatus.INFEASIBLE_AT_REST
