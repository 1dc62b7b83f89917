"""Robust forces along a path: the same as those of its motion, slopes against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.robust.force import BoxMotion
from hybrid_opt.robust.path_force import RobustPath
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.workcell.records import Uncertainty
from tests.hybrid_opt.robust.test_force import SAMPLES, cell, model, motion
from tests.symbolic.cells import hand_cell

STEP = 1e-4


@pytest.mark.parametrize("leader", [0, 1])
def test_forces_and_slopes_are_those_of_the_motion(leader: int) -> None:
    rng = np.random.default_rng(7)
    first, second = rng.normal(scale=0.5, size=(2, SAMPLES, 6))
    a, w = rng.normal(size=SAMPLES), rng.uniform(0.1, 1.0, SAMPLES)
    pose = motion().pose

    def forces(a: Array, w: Array) -> Array:
        moving = BoxMotion(pose, first * np.sqrt(w)[:, None], np.outer(a, np.ones(6)) * first)
        moving.second_rate[:] += second * w[:, None]
        found = model().robust_force(moving, leader=leader)
        both = [found.leading, found.commanded]
        return np.stack(both if leader == 0 else both[::-1], axis=1)

    value, slope = RobustPath(cell()).at((pose, first, second), a, w, leader)
    np.testing.assert_allclose(value, forces(a, w), rtol=1e-7)
    by_a = (forces(a + STEP, w) - forces(a - STEP, w)) / (2.0 * STEP)
    by_w = (forces(a, w + STEP) - forces(a, w - STEP)) / (2.0 * STEP)
    np.testing.assert_allclose(slope[..., 0], by_a, atol=1e-3)
    np.testing.assert_allclose(slope[..., 1], by_w, atol=1e-3)


def test_they_are_convex_and_have_slopes_at_rest() -> None:
    """Between two places no higher than the line, and never below a tangent."""
    rng = np.random.default_rng(8)
    first, second = rng.normal(scale=0.5, size=(2, SAMPLES, 6))
    path = (motion().pose, first, second)
    forces = RobustPath(cell())
    still = np.zeros(SAMPLES)
    a, w = rng.normal(size=SAMPLES), rng.uniform(0.0, 1.0, SAMPLES)
    begin, slope = forces.at(path, still, still)
    end, _ = forces.at(path, a, w)
    middle, _ = forces.at(path, a / 2.0, w / 2.0)
    assert np.isfinite(slope).all()
    assert (middle <= (begin + end) / 2.0 + 1e-5).all()
    tangent = begin + slope[..., 0] * a[:, None] + slope[..., 1] * w[:, None]
    assert (end >= tangent - 1e-5).all()


def test_a_set_that_nothing_holds_is_refused() -> None:
    lost = replace(hand_cell(), uncertainty=Uncertainty(friction=1.0))
    with pytest.raises(SettingsError, match="no friction"):
        RobustPath(lost)
