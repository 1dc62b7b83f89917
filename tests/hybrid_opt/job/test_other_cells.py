"""Whole jobs of the other cells that ship: over a wall, and two Pandas with redundant elbows."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml

from hybrid_opt.bundles import FORMATS, BundleOptions, export
from hybrid_opt.bundles.rapid import rapid_files
from hybrid_opt.job.plan import JobModel
from hybrid_opt.job.records import Job, sample_job
from hybrid_opt.timing import TimingLimits, time_path
from symbolic.errors import SettingsError
from tests.hybrid_opt.bundles.rapid_parser import parse
from tests.hybrid_opt.cells import shipped

CELLS = ["transfer", "pandas"]
FREE = ("csv", "json", "ros2", "mcap")
"""Forms that are nobody's own."""


@cache
def planned(name: str) -> Job:
    cell = shipped(name)
    timing = time_path(cell.timing_model, cell.initial, TimingLimits(reference_speed=True))
    return JobModel(cell.compiled, cell.timing_model).plan(timing)


@pytest.mark.parametrize("name", CELLS)
def test_the_job_is_whole(name: str) -> None:
    job = planned(name)
    names = [phase.name for phase in job.phases]
    # The transfer's conveyors carry the box at its start and goal; the Pandas' box is handed over.
    assert names == ["approach", "press", "carry", "release", "retreat"]
    stands = {"transfer": (("pick conveyor",), ("place conveyor",)), "pandas": ((), ())}
    assert job.stands_on == stands[name]
    for one, other in zip(job.phases[:-1], job.phases[1:], strict=True):
        np.testing.assert_allclose(one.motion.q[-1], other.motion.q[0], atol=1e-6)
        np.testing.assert_allclose(one.force.normal[-1], other.force.normal[0], atol=1e-9)
        np.testing.assert_allclose(one.effort[-1], other.effort[0], atol=1e-3)
    for phase in job.phases:
        assert phase.certificate.is_free
        assert max(phase.use.values()) <= 1.005
        np.testing.assert_allclose(phase.motion.q_rate[[0, -1]], 0.0, atol=1e-9)
        np.testing.assert_allclose(phase.motion.q_second[[0, -1]], 0.0, atol=1e-9)


@pytest.mark.parametrize("name", CELLS)
def test_bundles_hold_every_joint(name: str, tmp_path: Path) -> None:
    job = planned(name)
    joints = sum(map(len, job.joint_names))
    for form in FREE:
        assert export(job, form, tmp_path, options=BundleOptions(step=0.1))[0].exists()
    text = FORMATS["ros2"].files(sample_job(job, 0.1), BundleOptions())
    message = yaml.load(text["dual_arm_joint_trajectory.yaml"], Loader=yaml.CSafeLoader)
    assert len(set(message["joint_names"])) == joints
    for point in message["points"]:
        assert {len(point[key]) for key in ("positions", "velocities", "effort")} == {joints}


def test_a_seventh_axis_is_an_external_one_to_rapid() -> None:
    """ABB counts the axes of a YuMi 1, 2, 7, 3, 4, 5, 6 along its chain."""
    sampled = sample_job(planned("pandas"), 0.1)
    with pytest.raises(SettingsError, match=r"panda.urdf, which does not look like an arm of ABB"):
        rapid_files(sampled, BundleOptions())
    files = rapid_files(sampled, BundleOptions(any_arm=True))
    assert set(files) == {"T_ROB_L/Carry1.mod", "T_ROB_R/Carry2.mod"}
    for arm, text in enumerate(files.values()):
        assert isinstance(text, str)
        module = parse(text)
        degrees = np.rad2deg(sampled.arm(arm, sampled.q))
        (first,) = (value for _, _, name, value in module.declarations if name == "carryFirst")
        assert isinstance(first, list)
        robot, external = (np.array(each, dtype=float) for each in first)
        np.testing.assert_allclose(robot, degrees[0, [0, 1, 3, 4, 5, 6]], atol=1e-6)
        np.testing.assert_allclose(external, [degrees[0, 2], *[9e9] * 5], atol=1e-6)
        check = module.procedures["CarryCheckStart"]
        assert [call.name for call in check].count("Stop") == 7
        assert "here.extax.eax_a" in text
    with pytest.raises(SettingsError, match="7 joints; targets of URScript hold 6"):
        FORMATS["urscript"].files(sample_job(planned("pandas"), 0.008), BundleOptions(any_arm=True))
