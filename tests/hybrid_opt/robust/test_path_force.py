"""Robust forces along a path: the same as those of its motion, slopes against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.robust.force import BoxMotion
from hybrid_opt.robust.path_force import BY_TIMING, PathPoints, RobustPath
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty
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

    robust = RobustPath(cell(), leader=leader)
    points = PathPoints(pose, first, second, a, w)
    value, whole = robust.at(points)
    slope = whole[:, :, BY_TIMING]
    np.testing.assert_allclose(value, forces(a, w), rtol=1e-7)
    by_a = (forces(a + STEP, w) - forces(a - STEP, w)) / (2.0 * STEP)
    by_w = (forces(a, w + STEP) - forces(a, w - STEP)) / (2.0 * STEP)
    np.testing.assert_allclose(slope[..., 0], by_a, atol=1e-3)
    np.testing.assert_allclose(slope[..., 1], by_w, atol=1e-3)
    for k, entry in ((0, 0), (1, 4), (2, 2)):
        ends = []
        for sign in (1.0, -1.0):
            moved = [pose.copy(), first.copy(), second.copy()]
            moved[k][:, entry] += sign * STEP
            ends.append(robust.at(PathPoints(moved[0], moved[1], moved[2], a, w))[0])
        difference = (ends[0] - ends[1]) / (2.0 * STEP)
        np.testing.assert_allclose(whole[:, :, 6 * k + entry], difference, atol=2e-3)
    # Where a force is above a level, the same; nowhere else.
    level = np.full(SAMPLES, float(np.median(value.max(axis=1))))
    rows, force, beyond = robust.beyond(points, level)
    np.testing.assert_array_equal(rows, np.flatnonzero(value.max(axis=1) > level))
    assert 0 < len(rows) < SAMPLES
    np.testing.assert_allclose(force, value[rows], rtol=1e-9)
    np.testing.assert_allclose(beyond, whole[rows], rtol=1e-6, atol=1e-6)


def test_they_are_convex_and_have_slopes_at_rest() -> None:
    """Between two places no higher than the line, and never below a tangent."""
    rng = np.random.default_rng(8)
    first, second = rng.normal(scale=0.5, size=(2, SAMPLES, 6))
    forces, pose = RobustPath(cell()), motion().pose
    still = np.zeros(SAMPLES)
    a, w = rng.normal(size=SAMPLES), rng.uniform(0.0, 1.0, SAMPLES)
    begin, whole = forces.at(PathPoints(pose, first, second, still, still))
    slope = whole[:, :, BY_TIMING]
    end, _ = forces.at(PathPoints(pose, first, second, a, w))
    middle, _ = forces.at(PathPoints(pose, first, second, a / 2.0, w / 2.0))
    assert np.isfinite(slope).all()
    assert (middle <= (begin + end) / 2.0 + 1e-5).all()
    tangent = begin + slope[..., 0] * a[:, None] + slope[..., 1] * w[:, None]
    assert (end >= tangent - 1e-5).all()


def test_a_set_that_nothing_holds_is_refused() -> None:
    lost = replace(hand_cell(), uncertainty=Uncertainty(friction=1.0))
    with pytest.raises(SettingsError, match="no friction"):
        RobustPath(lost)
