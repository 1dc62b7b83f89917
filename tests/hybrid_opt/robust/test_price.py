"""The price of robustness of a carry: consistent with the forces it is made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.robust.force import SAMPLES, RobustModel, RobustPrice, robust_price, thinned
from symbolic.errors import SettingsError
from symbolic.records import USUAL, Uncertainty
from tests.hybrid_opt.job.jobs import rack_job

CASES = 2000
SET = Uncertainty(friction=0.15, centre_of_mass=np.array([0.0, 0.004, 0.0]))


def priced(uncertainty: Uncertainty) -> RobustPrice:
    carry = rack_job().timing.carry
    assert carry is not None
    carry = replace(carry, workcell=replace(carry.workcell, uncertainty=uncertainty))
    return robust_price(RobustModel(carry.workcell), carry, np.random.default_rng(1), cases=CASES)


def test_a_carry_is_priced_under_its_cells_own_set() -> None:
    found = priced(SET)
    assert found.uncertainty is SET
    at_one = found.peak[found.factors == 1.0][0]
    np.testing.assert_allclose(found.commanded, at_one)
    assert (np.diff(found.peak, axis=0) > 0.0).all()
    assert found.check.cases == CASES
    assert found.check.holds
    assert 0.97 <= found.check.closest <= 1.0
    # Both sides of the largest set, by the curve: forces grow with the factor.
    below = found.factors <= found.largest_factor
    assert (found.peak[below] <= found.limit).all()
    assert not (found.peak[~below] <= found.limit).all(axis=1).any()


def test_a_cell_that_states_nothing_is_priced_under_a_usual_set() -> None:
    carry = rack_job().timing.carry
    assert carry is not None
    model = RobustModel(replace(carry.workcell, uncertainty=USUAL))
    found = robust_price(model, carry, np.random.default_rng(1), cases=CASES)
    assert not found.uncertainty.stated
    assert found.check.holds


def test_the_largest_forces_are_among_the_thinned_samples() -> None:
    carry = rack_job().timing.carry
    assert carry is not None
    _, motion = thinned(carry)
    assert SAMPLES <= len(motion.pose) <= SAMPLES + 2
    for row in carry.normal_force.argmax(axis=0):
        assert (motion.pose == carry.pose[row]).all(axis=1).any()


def test_a_set_that_leaves_no_friction_is_told() -> None:
    with pytest.raises(SettingsError, match="no friction"):
        priced(Uncertainty(friction=1.0))
