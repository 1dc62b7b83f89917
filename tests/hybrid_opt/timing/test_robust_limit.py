"""A force limit that holds in every case of the workcell's uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.robust.force import RobustModel
from hybrid_opt.timing import TimingLimits, TimingModel, TimingStatus, time_path
from hybrid_opt.timing.limits import limit_ratios, limit_use
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty
from tests.hybrid_opt.timing.cells import initial, timing_of
from tests.symbolic.cells import hand_cell

SET = Uncertainty(0.1, 0.05, np.array([0.005, 0.005, 0.0]), 0.003, np.array([0.0, 0.2, 0.2]))
INTERVALS = 50


def unsure() -> TimingModel:
    return timing_of(replace(hand_cell(), uncertainty=SET), INTERVALS)


def test_the_robust_forces_use_the_limit_up_and_keep_it() -> None:
    model = unsure()
    plain = time_path(model, initial(), TimingLimits(force=60.0))
    assert plain.carry is not None
    forces = RobustModel(model.workcell)
    needed = float(forces.robust_force(plain.carry).peak.max())
    assert needed > 62.0
    timing = time_path(model, initial(), TimingLimits(force=needed, robust=True))
    assert timing.status is TimingStatus.OK
    assert timing.carry is not None
    peak = float(forces.robust_force(timing.carry).peak.max())
    assert peak == pytest.approx(needed, rel=2e-3)
    # The plan's own timing keeps this limit, so that the fastest is no slower.
    assert timing.duration <= plain.duration * (1.0 + 1e-3)
    only_plan = time_path(model, initial(), TimingLimits(force=needed))
    assert only_plan.duration < timing.duration


def test_a_limit_below_what_holds_still_in_every_case_is_told() -> None:
    model = unsure()
    timing = time_path(model, initial(), TimingLimits(force=53.0, robust=True))
    assert timing.status is TimingStatus.INFEASIBLE_AT_REST
    assert timing.place is not None
    assert timing.place.constraint == "normal force"
    assert time_path(model, initial(), TimingLimits(force=53.0)).ok


def test_robust_forces_need_a_limit() -> None:
    with pytest.raises(SettingsError, match="give one"):
        TimingLimits(robust=True)


@pytest.mark.parametrize("share", [0.9, 1.0, 1.1, 1.5])
def test_the_use_of_the_limit_is_that_of_all_cases(share: float) -> None:
    """Cases far below the limit are left out, where others are near it."""
    model = unsure()
    plain = time_path(model, initial(), TimingLimits(force=60.0)).carry
    assert plain is not None
    held = RobustModel(model.workcell).robust_force(plain)
    limit = share * float(held.peak.max())
    limits = TimingLimits(force=limit, robust=True)
    use = limit_use(plain, model.workcell, limits, model.joint_names)["normal force"]
    assert use.ratio == pytest.approx(held.peak.max() / limit, rel=1e-6)
    every = limit_ratios(plain, model.workcell, limits)["normal force"].max(axis=1)
    needed = np.maximum(held.commanded, held.leading) / limit
    near = needed > 0.985
    np.testing.assert_allclose(every[near], needed[near], rtol=1e-6)
    assert (every < needed * (1.0 + 1e-6)).all()
