"""Verdicts without a compiler, by shortcuts; the oracle is the evaluation of all samples."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from hybrid_opt.proposing.trial import Trial
from symbolic.cell_model import build_cell_model
from symbolic.functions import CONSTRAINTS, candidate_function, motion_function
from symbolic.read.cell import load
from tests.symbolic.read.samples import RACK


@pytest.mark.parametrize("name", ["drum", "transfer"])
def test_motion_alone_is_that_of_the_candidate(name: str) -> None:
    workcell = load(RACK.with_name(f"{name}.toml"))
    model = build_cell_model(workcell)
    whole, alone = candidate_function(model), motion_function(model)
    x = np.random.default_rng(3).uniform(workcell.task.lower, workcell.task.upper)
    wanted = dict(zip(whole.name_out(), whole(ca.DM(x)), strict=True))
    found = dict(zip(alone.name_out(), alone(ca.DM(x)), strict=True))
    for key in ("time", "pose", "q_1", "q_2"):
        np.testing.assert_array_equal(np.array(found[key]), np.array(wanted[key]))
    arms = [k for k, name in enumerate(CONSTRAINTS) if name.startswith(("reach", "joint", "sing"))]
    violation = np.array(found["violation"]).ravel()
    np.testing.assert_array_equal(violation[arms], np.array(wanted["violation"]).ravel()[arms])
    assert not np.delete(violation, arms).any()


@pytest.mark.parametrize("name", ["drum", "rack"])
def test_verdicts_are_those_of_the_whole_evaluation(name: str) -> None:
    workcell = load(RACK.with_name(f"{name}.toml"))
    first, second = (np.array(q) for q in build_cell_model(workcell).start)
    trial = Trial(workcell, (first, second))
    task = workcell.task
    x = np.random.default_rng(4).uniform(task.lower, task.upper, (24, task.n_var))
    x[12:] = trial.initial + 0.3 * (x[12:] - trial.initial)
    expected = trial.evaluator.evaluate(x).feasible
    assert 0 < expected.sum() < len(x)
    np.testing.assert_array_equal(trial.feasible(x), expected)
