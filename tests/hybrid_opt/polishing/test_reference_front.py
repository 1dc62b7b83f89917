"""The stored reference front of the rack is what the evaluator says it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybrid_opt.indicators.metrics import front_of
from studies.research.best_front import read_reference_front
from tests.hybrid_opt.cells import shipped

FRONT = Path(__file__).with_name("rack_reference_front.csv")


def test_every_point_is_feasible_certified_and_of_the_stored_value() -> None:
    front = read_reference_front(FRONT)
    evaluator = shipped("rack").evaluator
    assert front.digest == evaluator.workcell.digest
    found = evaluator.certified(evaluator.evaluate(front.x))
    assert found.feasible.all()
    np.testing.assert_allclose(found.objectives, front.objectives, rtol=1e-9)
    assert len(front_of(front.objectives)) == len(front.objectives)
