"""Whole jobs of the other cells that ship: over a wall, two Pandas with redundant elbows, and
pads of every kind."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml

from hybrid_opt.bundles import TARGETS, BundleOptions, export
from hybrid_opt.bundles.bundle import prepared
from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.job.plan import JobModel
from hybrid_opt.job.records import Job
from hybrid_opt.job.smooth import driven_timing
from hybrid_opt.robust.force import thinned
from hybrid_opt.robust.squeeze import largest_commanded
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.timing.solve import time_path
from symbolic.errors import SettingsError
from tests.hybrid_opt.bundles.bundles import driven
from tests.hybrid_opt.bundles.mock_rapid import parse
from tests.hybrid_opt.cells import shipped
from tests.symbolic.cells import RACK

CELLS = ["transfer", "pandas"]
QUICK = ("fork",)
"""Of `SHIPPED` what the default run looks at; others compile for minutes. The rack has tests of its
own."""
SHIPPED = [
    pytest.param(path.stem, marks=() if path.stem in QUICK else pytest.mark.slow)
    for path in sorted(RACK.parent.glob("*.toml"))
]
FREE = ("csv", "json", "ros2-control", "mcap")
"""Targets that are nobody's own."""


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


@pytest.mark.parametrize("name", SHIPPED)
def test_every_cell_that_ships_has_a_job(name: str) -> None:
    """With the forces that a recommendation knows sooner."""
    cell = shipped(name).drivable()
    timing = driven_timing(cell.timing_model, cell.initial)
    job = JobModel(cell.compiled, cell.timing_model).plan(timing)
    assert all(phase.certificate.is_free for phase in job.phases)
    carry, doubt = timing.carry, cell.workcell.uncertainty
    assert carry is not None
    rows, motion = thinned(carry)
    sooner = largest_commanded(cell.workcell, motion, carry.normal_force[rows], doubt, 0)
    forces = job.phase("carry").force.normal.max(axis=0)
    np.testing.assert_allclose(sooner, forces, rtol=0.01)


def test_pads_that_do_not_face_one_another_keep_limits_on_jerk() -> None:
    shipping = shipped("fork").drivable()
    first, second = (
        replace(robot, jerk_max=np.full(6, 50.0)) for robot in shipping.workcell.robots
    )
    cell = Cell(replace(shipping.workcell, robots=(first, second)), DRIVABLE_OBJECTIVES)
    timing = driven_timing(cell.timing_model, cell.initial)
    assert timing.carry is not None
    jerk = np.diff(timing.carry.side_by_side("q_second"), axis=0)
    jerk /= np.diff(timing.carry.time)[:, None]
    assert 45.0 < np.abs(jerk).max() <= 50.0 * 1.005
    job = JobModel(cell.compiled, cell.timing_model).plan(timing)
    assert job.timing is timing


@pytest.mark.parametrize("name", CELLS)
def test_bundles_hold_every_joint(name: str, tmp_path: Path) -> None:
    job = planned(name)
    joints = sum(map(len, job.joint_names))
    for target in FREE:
        assert export(job, target, tmp_path, options=BundleOptions(step=0.1))[0].exists()
    document = prepared(job, TARGETS["json"], BundleOptions(step=0.1)).document
    assert len({n for robot in document["robots"] for n in robot["ros_joints"]}) == joints
    for robot in document["robots"]:
        for name in ("position", "velocity", "effort_with_gravity", "hold_effort_with_gravity"):
            assert {len(row) for row in robot[name]} == {joints // 2}


def test_a_seventh_axis_is_an_external_one_to_rapid() -> None:
    """ABB counts the axes of a YuMi 1, 2, 7, 3, 4, 5, 6 along its chain."""
    job, target = driven(planned("pandas")), TARGETS["abb-rapid"]
    with pytest.raises(SettingsError, match=r"panda.urdf, which does not look like an arm of ABB"):
        target.refuse(job, "abb-rapid", any_arm=False)
    options = BundleOptions(step=0.1, any_arm=True)
    target.refuse(job, "abb-rapid", any_arm=True)
    sheet = prepared(job, target, options)
    files = target.files(sheet)
    assert set(files) == {"T_ROB_L/Carry1.mod", "T_ROB_R/Carry2.mod"}
    for arm, text in enumerate(files.values()):
        assert isinstance(text, str)
        module = parse(text)
        degrees = np.rad2deg(sheet.sampled.arm(arm, sheet.sampled.q))
        robot, external = (np.array(each) for each in module.declared["carryFirst"][2])
        np.testing.assert_allclose(robot, degrees[0, [0, 1, 3, 4, 5, 6]], atol=1e-6)
        np.testing.assert_allclose(external, [degrees[0, 2], *[9e9] * 5], atol=1e-6)
        assert module.procedures["CarryCheckStart"].count("EXIT()") == 7
        assert "here.extax.eax_a" in text
    with pytest.raises(SettingsError, match="7 joints; targets of ur-script hold 6"):
        TARGETS["ur-script"].refuse(job, "ur-script", any_arm=True)


def test_franka_takes_the_pandas() -> None:
    job, target = driven(planned("pandas")), TARGETS["franka-ros2"]
    target.refuse(job, "franka-ros2", any_arm=False)
    with pytest.raises(SettingsError, match=r"has to know where the controller of 'north' is"):
        target.refuse(planned("pandas"), "franka-ros2", any_arm=False)
    sheet = prepared(job, target, BundleOptions(step=0.05))
    files = target.files(sheet)
    config = json.loads(files["config/cell.json"])
    assert [each["arguments"]["robot_type"] for each in config["launch"]] == ["panda", "panda"]
    assert config["effort"] == "without_gravity"
    for arm in (0, 1):
        controllers = yaml.safe_load(files[f"config/controllers_{arm + 1}.yaml"])["/**"]
        parameters = controllers["carry_controller"]["ros__parameters"]
        assert parameters["command_interfaces"] == ["effort"]
        assert list(parameters["gains"]) == parameters["joints"] == sheet.ros_joints(arm)
