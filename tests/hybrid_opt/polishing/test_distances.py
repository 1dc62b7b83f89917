"""Distances that are measured only where they decide: as if all had been measured."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hybrid_opt.polishing.constraints.active import ActiveSet
from hybrid_opt.polishing.constraints.kind import Surroundings
from hybrid_opt.polishing.functions import polish_functions
from hybrid_opt.polishing.grid import Grid
from hybrid_opt.polishing.placed_carry import CarryReader, Distances
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.smooth_cell import SmoothCell
from symbolic.array import Array
from symbolic.records.task import initial_decision
from tests.hybrid_opt.polishing.test_front import evaluator

PLACES, PAIRS, LIMIT = 60, 4, 0.02


@dataclass
class Measured:
    """Bounds and the distances that a judge finds, and how many it was asked for."""

    seed: int
    bounds: Array = field(init=False)
    truth: Array = field(init=False)
    asked: int = 0

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        wave = np.sin(np.linspace(0.0, 9.0, PLACES))[:, None] * rng.uniform(0.0, 0.03, PAIRS)
        self.bounds = 0.02 + wave + rng.uniform(-2e-3, 2e-3, (PLACES, PAIRS))
        self.truth = self.bounds + rng.uniform(0.0, 0.01, (PLACES, PAIRS))

    def measure(self, rows: NDArray[np.intp], raised: Array, wanted: NDArray[np.bool_]) -> None:
        self.asked += int(wanted.sum())
        raised[wanted] = self.truth[rows][wanted]

    def distances(self) -> Distances:
        return Distances(lambda: self.bounds, self.measure)


@given(seed=st.integers(0, 1000))
def test_the_least_of_a_stretch_is_that_of_all_its_distances(seed: int) -> None:
    judge, lazy = Measured(seed), Measured(seed)
    rng = np.random.default_rng(seed)
    drawn = rng.integers(0, (PLACES - 9, PAIRS), (6, 2)).tolist()
    stretches = [(slice(first, first + 9), pair) for first, pair in drawn]
    low = np.zeros((PLACES, PAIRS), dtype=np.bool_)
    for where in stretches:
        low[where] = judge.bounds[where] < LIMIT
    every = judge.distances().at(low)
    assert lazy.distances().least(stretches, LIMIT) == [every[where].min() for where in stretches]
    assert lazy.asked <= judge.asked


@given(seed=st.integers(0, 1000), limit=st.floats(-0.02, 0.03))
def test_limits_are_kept_as_all_distances_say(seed: int, limit: float) -> None:
    judge, lazy = Measured(seed), Measured(seed)
    limits = np.full(PAIRS, limit)
    distances = judge.distances()
    close = distances.lowered < limits
    kept = not (distances.at(close)[close] < limit).any()
    assert lazy.distances().keep(limits) == kept
    assert lazy.asked <= judge.asked


@pytest.mark.parametrize("spread", [0.01, 0.05, 0.2])
def test_a_step_violates_something_where_violated_rows_say_so(spread: float) -> None:
    judge, settings = evaluator(), PolishSettings()
    task, grid = judge.workcell.task, Grid(judge.workcell.task)
    cell = SmoothCell(judge.workcell, polish_functions(judge.compiled), grid)
    active = ActiveSet(Surroundings(judge, cell, settings))
    reader = CarryReader(judge, grid, cell.functions.rows)
    known, rng = reader.read(initial_decision(task)), np.random.default_rng(7)
    verdicts = set()
    for _ in range(12):
        away = rng.uniform(-spread, spread, task.n_var) * (task.upper - task.lower)
        x = np.clip(initial_decision(task) + away, task.lower, task.upper)
        step = reader.read(x)
        if step.is_followed:
            violates = active.violates(step, known, ())
            assert violates == bool(active.violated(reader.read(x), known, ()))
            verdicts.add(violates)
    assert verdicts
