"""What stiffness makes of positions and delays, against hand calculations."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.errors import JobError
from hybrid_opt.job.compliance import (
    LARGEST_SKEW,
    force_margin,
    largest_skew,
    position_control,
    require_skew,
    skewed,
)
from studies.research.plain.motion import angular_rates
from symbolic.errors import SettingsError
from symbolic.records.poses import pose_matrix
from tests.hybrid_opt.job.jobs import rack_job


def test_penetration_and_force_error_are_springs() -> None:
    found = position_control(rack_job(), 5e4)
    np.testing.assert_allclose(found.penetration, rack_job().peak_normal_force / 5e4)
    # Two springs in series, each end off by 0.1 mm.
    assert found.force_error == pytest.approx(2e-4 / (1 / 5e4 + 1 / 5e4))
    assert position_control(rack_job(), 1e4).verdict == "yes"
    assert "reference" in found.verdict
    assert position_control(rack_job(), 1e6).verdict == "no"


def test_a_late_arm_lags_by_the_way_of_that_time() -> None:
    job = rack_job()
    carry = job.phase("carry").motion
    speed = np.linalg.norm(carry.rate[:, :3], axis=1).max()
    late = skewed(job, 0.01, 1e4)
    assert late.displacement == pytest.approx(0.01 * speed, rel=0.02)
    assert skewed(job, 0.0, 1e4).margin == pytest.approx(force_margin(job))
    margins = [skewed(job, delay, 1e4).margin for delay in (0.0, 0.005, 0.01, 0.02)]
    assert margins == sorted(margins, reverse=True)
    assert not skewed(job, 0.01, 1e5).survived


def test_the_worse_of_both_arms_counts() -> None:
    """By hand, where the box moves fastest along the pads' common line."""
    job, delay, stiffness = rack_job(), 0.005, 1e4
    motion, force = job.phase("carry").motion, job.phase("carry").force
    worst = np.inf
    for late, contact in enumerate(job.workcell.contacts):
        for k in range(0, len(motion.time), 20):
            T = pose_matrix(motion.pose[k, :3], motion.pose[k, 3:])
            rotation = T[:3, :3]
            # The pad's point moves like the box; it lags by its velocity times the delay.
            velocity = motion.rate[k, :3]
            spin, _ = angular_rates(motion.pose[k, 3:], motion.rate[k, 3:], np.zeros(3))
            lag = -delay * (velocity + np.cross(spin, rotation @ contact.T_box_pad[:3, 3]))
            normal = rotation @ contact.T_box_pad[:3, 2]
            along = float(lag @ normal)
            across = float(np.linalg.norm(lag - along * normal))
            shear = stiffness / 2.0 * across / min(c.friction for c in job.workcell.contacts)
            left = force.normal[k] + stiffness / 2.0 * along - force.least[k] - shear
            if left.min() < worst:
                worst, index = float(left.min()), late
    found = skewed(job, delay, stiffness)
    assert found.late == index
    assert found.margin == pytest.approx(worst, abs=0.3)


def test_a_skew_that_breaks_the_squeeze_is_refused_with_a_figure() -> None:
    job, stiffness = rack_job(), 5e4
    most = largest_skew(job, stiffness)
    assert 0.0 < most < LARGEST_SKEW
    assert skewed(job, most, stiffness).survived
    assert not skewed(job, 1.01 * most, stiffness).survived
    require_skew(job, most, stiffness)
    missing = -skewed(job, 0.02, stiffness).margin
    with pytest.raises(JobError, match=rf"20 ms .*{missing:.1f} N .*with {1e3 * most:.1f} ms they"):
        require_skew(job, 0.02, stiffness)
    assert largest_skew(job, 1.0) == LARGEST_SKEW
    for delay in (-1e-3, 1.0, float("nan")):
        with pytest.raises(SettingsError, match="skew"):
            skewed(job, delay, stiffness)
    for stiffness in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(SettingsError, match="stiffness"):
            position_control(job, stiffness)
        with pytest.raises(SettingsError, match="stiffness"):
            skewed(job, 0.01, stiffness)
