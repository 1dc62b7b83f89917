"""The profile is smooth, monotone, and at rest at both ends up to its third derivative."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.job.motions import PEAK_RATE, at_even_steps, rest_to_rest_profile, unit_squeeze
from hybrid_opt.timing.jerk import (
    has_rest_at_ends,
    time_with_jerk,
)
from hybrid_opt.timing.records import JerkLimits, TimingLimits
from symbolic.contact.registry import command_model
from symbolic.read.cell import load
from symbolic.records.poses import box_rotation
from tests.hybrid_opt.job.jobs import rack, rack_jobs, rack_timing
from tests.symbolic.cells import RACK


def test_the_profile_goes_from_rest_to_rest() -> None:
    found = rest_to_rest_profile(2.0, 4001)
    assert found.value[0] == 0.0
    assert found.value[-1] == pytest.approx(1.0, abs=1e-12)
    assert (np.diff(found.value) >= 0.0).all()
    for derivative in (found.rate, found.second, found.third):
        np.testing.assert_allclose(derivative[[0, -1]], 0.0)
        np.testing.assert_allclose(derivative[[1, -2]], 0.0, atol=0.1)
    assert found.rate.max() == pytest.approx(PEAK_RATE / 2.0)
    for values, derivative in (
        (found.value, found.rate),
        (found.rate, found.second),
        (found.second, found.third),
    ):
        slope = np.gradient(values, found.time)
        np.testing.assert_allclose(slope[1:-1], derivative[1:-1], atol=2e-4 * abs(derivative).max())


@pytest.mark.parametrize(("duration", "whole"), [(0.8, 0.8), (0.801, 0.808), (1e-9, 0.008)])
def test_durations_are_whole_steps(duration: float, whole: float) -> None:
    assert at_even_steps(duration, 0.008) == pytest.approx(whole, abs=1e-12)


@pytest.mark.parametrize("name", ["drum", "fork", "corner"])
def test_more_squeeze_balances_itself_within_all_cones(name: str) -> None:
    """Of pads that press evenly, at any pose."""
    found = load(RACK.with_name(f"{name}.toml"))
    cell = replace(found, task=replace(found.task, allocation="soft-finger"))
    pose = np.array([[0.1, -0.2, 0.3, 0.2, -0.1, 0.4]])
    turned = box_rotation(cell.task.orientation, pose)[0]
    for leader in (0, 1):
        wrenches = unit_squeeze(cell, pose, leader)[0]
        total = wrenches.sum(axis=0)
        for contact, wrench in zip(cell.contacts, wrenches, strict=True):
            total[3:] += np.cross(turned @ contact.T_box_pad[:3, 3], wrench[:3])
        np.testing.assert_allclose(total, 0.0, atol=1e-9)
        together = command_model(cell).internal_force_ratio(leader)
        assert together[1 - leader] == 1.0
        for contact, wrench, share in zip(cell.contacts, wrenches, together, strict=True):
            pushed = (turned @ contact.T_box_pad[:3, :3]).T @ wrench[:3]
            assert pushed[2] == pytest.approx(share, rel=1e-9)
            assert np.linalg.norm(pushed[:2]) <= contact.friction * pushed[2]


def test_a_timing_at_rest_stays_as_it_is() -> None:
    limits = JerkLimits.from_workcell(rack().workcell)
    assert limits is not None
    memoise = time_with_jerk(
        rack().timing_model, rack().initial, TimingLimits(reference_speed=True), limits
    ).timing
    assert has_rest_at_ends(memoise)
    assert rack_jobs().plan(memoise).timing is memoise
    assert rack_jobs().plan(rack_timing(), smoothing=0.0).timing is rack_timing()
