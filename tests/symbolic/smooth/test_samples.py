"""Forces of the smooth problem against the candidate evaluator, derivatives against differences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from symbolic.array import Array
from symbolic.functions import candidate_function
from symbolic.records.cell import Workcell
from symbolic.records.task import Allocation, TimeLaw
from symbolic.smooth.samples import (
    Quantity,
    branch_coefficients,
    sample_blocks,
    sample_functions,
    sample_name,
)
from tests.symbolic.cells import hand_cell, hand_model


def cell_with(time_law: TimeLaw, samples: int = 12, allocation: Allocation = "paper") -> Workcell:
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
    time_law: TimeLaw, samples: int, allocation: Allocation
) -> None:
    cell = cell_with(time_law, samples, allocation)
    evaluate = candidate_function(hand_model(cell))
    coefficients, functions = branch_coefficients(cell), sample_functions(cell, "force")
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
    [("force", "paper"), ("pressure", "paper"), ("load", "joint"), ("force", "soft-finger")],
)
@pytest.mark.parametrize("time_law", ["constant", "ramped"])
def test_derivatives_are_those_of_the_values(
    time_law: TimeLaw, quantity: Quantity, allocation: Allocation, rounding: float
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
            np.hstack([second(x, basis, rounding, weight, along) for along in np.eye(len(x))]),
            rtol=1e-5,
            atol=1e-3,
        )


def test_every_sample_is_served_once() -> None:
    for samples in (5, 6, 7, 100):
        blocks = sample_blocks(cell_with("constant", samples).task)
        served = np.concatenate([block.samples.ravel() for block in blocks])
        assert sorted(served.tolist()) == list(range(samples))
