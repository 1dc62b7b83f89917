"""What stiffness makes of positions and delays, against hand calculations."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.job.compliance import force_margin, position_control, skewed
from hybrid_opt.job.text import job_text, position_text, skew_text
from symbolic.errors import SettingsError
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
    assert late.survived
    assert skewed(job, 0.0, 1e4).margin == pytest.approx(force_margin(job))
    margins = [skewed(job, delay, 1e4).margin for delay in (0.0, 0.005, 0.01, 0.02)]
    assert margins == sorted(margins, reverse=True)
    assert not skewed(job, 0.01, 1e5).survived


def test_a_stiffness_is_positive() -> None:
    for stiffness in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(SettingsError, match="stiffness"):
            position_control(rack_job(), stiffness)
        with pytest.raises(SettingsError, match="stiffness"):
            skewed(rack_job(), 0.01, stiffness)


def test_a_job_shows_itself() -> None:
    job = rack_job()
    text = job_text(job)
    assert repr(job) == text
    for name in ("approach", "press", "lift", "carry", "set down", "release", "retreat"):
        assert name in text
    assert "no" in position_text([position_control(job, 1e6)])
    assert "SLIPS" in skew_text([skewed(job, 0.05, 1e5)])
