"""The rack cell is worth optimising: promises that its tuning has to keep."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.evaluations import REASONS
from tests.hybrid_opt.cells import shipped


@pytest.fixture(scope="module")
def evaluator() -> CandidateEvaluator:
    return shipped("rack").evaluator


def test_the_hand_made_trajectory_is_feasible(evaluator: CandidateEvaluator) -> None:
    verdict = evaluator.evaluate(evaluator.workcell.task.initial.reshape(1, -1))
    assert verdict.feasible.all()
    # 2.9 % above the static hold, the figure of a trial by another program.
    static = evaluator.workcell.payload.mass * 9.81 / 2.0
    excess = verdict.objectives[0] * evaluator.workcell.task.reference_force / static - 1.0
    np.testing.assert_allclose(excess, 0.029, atol=5e-4)


def test_the_straight_line_collides(evaluator: CandidateEvaluator) -> None:
    task = evaluator.workcell.task
    share = np.linspace(0.0, 1.0, len(task.waypoints))[1:-1, None]
    start, goal = task.waypoints[0].lower, task.waypoints[-1].lower
    verdict = evaluator.evaluate(((1.0 - share) * start + share * goal).reshape(1, -1))
    assert REASONS[verdict.reason[0]] == "collision"


def test_few_random_candidates_are_feasible_and_for_several_reasons(
    evaluator: CandidateEvaluator,
) -> None:
    """20,000 uniform candidates: 2.01 % feasible with this seed when the bounds were chosen."""
    rng = np.random.default_rng(0)
    verdict = evaluator.evaluate(
        rng.uniform(evaluator.lower, evaluator.upper, (20000, evaluator.n_var))
    )
    assert 0.02 <= verdict.feasible.mean() <= 0.20
    violated = {REASONS[k] for k in np.flatnonzero((verdict.violation > 0.0).any(axis=0))}
    assert {"collision", "reach_1", "reach_2", "joint_limits_1", "pressure_1"} <= violated
