"""What a redundant joint costs and changes: two Pandas, compiled, their third joints free and
locked."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.cell import Cell
from studies.research.turns import interleaved
from symbolic.array import Array
from symbolic.records import Workcell
from tests.redundant_cells import free_pandas, locked_pandas
from tests.symbolic.cells import with_task

pytestmark = pytest.mark.slow  # both cells are compiled for so many samples

ANGLE = 0.1
SAMPLES = 100
MOST_COST = 1.35
"""Of a seven-joint candidate, in one of six joints."""

DRAWN, BATCH = 2000, 64


@pytest.fixture(scope="module")
def pandas(tmp_path_factory: pytest.TempPathFactory) -> tuple[Cell, Cell]:
    """With seven joints per arm, and with six."""

    def cell(workcell: Workcell) -> Cell:
        return Cell(with_task(workcell, samples=SAMPLES))

    free = free_pandas(tmp_path_factory.mktemp("free"), f"initial = {ANGLE}")
    return cell(free), cell(locked_pandas(tmp_path_factory.mktemp("locked"), ANGLE))


def carries(pandas: tuple[Cell, Cell], spread: float) -> tuple[Array, Array]:
    """Candidates that are feasible in both, the same box paths: every sample of them counts.
    Redundant joints stray by so much [rad]."""
    free, locked = pandas
    rng = np.random.default_rng(2)
    box = locked.random(DRAWN, rng)
    more = ANGLE + rng.uniform(-spread, spread, (DRAWN, len(free.initial) - box.shape[1]))
    whole = np.hstack([box, more])
    fine = np.flatnonzero(free.evaluate(whole).feasible & locked.evaluate(box).feasible)[:BATCH]
    assert len(fine) == BATCH
    return whole[fine], box[fine]


def test_held_at_one_position_it_changes_nothing(pandas: tuple[Cell, Cell]) -> None:
    free, locked = pandas
    box = locked.random(DRAWN, np.random.default_rng(1))
    held = np.full((DRAWN, len(free.initial) - box.shape[1]), ANGLE)
    seven, six = free.evaluate(np.hstack([box, held])), locked.evaluate(box)
    assert 0.05 < six.feasible.mean() < 0.95
    np.testing.assert_array_equal(seven.feasible, six.feasible)
    np.testing.assert_allclose(seven.objectives, six.objectives, atol=1e-9)
    np.testing.assert_allclose(seven.penalised, six.penalised, atol=1e-9)


def test_it_costs_little(pandas: tuple[Cell, Cell]) -> None:
    x = carries(pandas, 0.05)
    times = interleaved(
        {"seven": pandas[0].evaluate, "six": pandas[1].evaluate},
        {"seven": x[0][None], "six": x[1][None]},
        30,
    )
    cost = float(np.median(times["seven"] / times["six"]))
    assert cost <= MOST_COST, f"a seven-joint candidate costs {cost:.2f} times one of six joints"
