"""What is recommended to press with against what the planned job commands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.recommending.squeeze import commanded
from symbolic.records import Uncertainty


@pytest.mark.parametrize("uncertainty", [Uncertainty(), Uncertainty(friction=0.1, mass=0.03)])
def test_the_job_presses_as_hard_as_recommended(
    drivable: ho.Cell, uncertainty: Uncertainty
) -> None:
    cell = ho.Cell(replace(drivable.workcell, uncertainty=uncertainty))
    timing = ho.time_path(cell, cell.initial)
    assert timing.carry is not None
    told = commanded(timing.carry)
    assert (told.squeeze.uncertainty is None) == uncertainty.is_empty
    (carry,) = (phase for phase in ho.plan_job(timing).phases if phase.name == "carry")
    # The job's window of smoothing reaches into what it does before and after.
    np.testing.assert_allclose(carry.force.normal.max(axis=0), told.peak, rtol=0.02)
