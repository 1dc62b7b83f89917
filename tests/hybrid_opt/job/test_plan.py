"""A job is continuous, at rest between its phases, within limits, and free of collisions: of the
rack, over a wall, and of two Pandas with redundant elbows; what stiffness makes of it.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pinocchio as pin
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
from hybrid_opt.job.motions import straight, time_line
from hybrid_opt.job.plan import JobModel
from hybrid_opt.job.records import PHASES, Job, Phase, sample_job
from hybrid_opt.robust.squeeze import SqueezeSettings
from hybrid_opt.timing.jerk import time_with_jerk
from hybrid_opt.timing.records import JerkLimits, TimingLimits
from hybrid_opt.timing.solve import time_path
from studies.research.plain.motion import angular_rates
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.arms import arm_model, link_frame
from symbolic.records import Handling, Uncertainty
from symbolic.records.poses import pose_matrix
from symbolic.robot.model import gravity_in_root
from tests.hybrid_opt.job.jobs import planned, rack, rack_job, rack_jobs, rack_timing
from tests.refusals import refused


def pads(q: Array) -> list[Array]:
    """Poses (4, 4) of both pads in the world, by Pinocchio alone."""
    found = []
    for arm, robot in enumerate(rack().workcell.robots):
        model = arm_model(robot)
        data = model.createData()
        pin.framesForwardKinematics(model, data, q[6 * arm : 6 * arm + 6])
        flange = data.oMf[link_frame(model, robot.flange)].homogeneous
        found.append(robot.T_world_base @ flange @ robot.T_flange_pad)
    return found


def gap(phase: Phase, sample: int, arm: int) -> float:
    """Distance of a pad from its place on the box, along its normal, other errors being small."""
    contact = rack().workcell.contacts[arm]
    pose = phase.motion.pose[sample]
    target = pose_matrix(pose[:3], pose[3:]) @ contact.T_box_pad
    pad = pads(phase.motion.q[sample])[arm]
    np.testing.assert_allclose(pad[:3, :3], target[:3, :3], atol=1e-6)
    away = target[:3, 3] - pad[:3, 3]
    distance = float(away @ target[:3, 2])
    np.testing.assert_allclose(away, distance * target[:3, 2], atol=2e-6)
    return distance


STANDS = {
    "rack": (("middle board",), ("liner, top board",)),
    "transfer": (("pick conveyor",), ("place conveyor",)),
    "pandas": ((), ()),
}
"""What boxes stand on before and after: those of the transfer are carried by its conveyors at both
ends, that of the Pandas is handed over."""

UNLIFTED = ("approach", "press", "carry", "release", "retreat")


@pytest.mark.parametrize("name", STANDS)
def test_phases_follow_one_another_at_rest_within_limits_and_free(name: str) -> None:
    job = planned(name)
    assert tuple(phase.name for phase in job.phases) == (PHASES if name == "rack" else UNLIFTED)
    assert job.stands_on == STANDS[name]
    end = 0.0
    for phase in job.phases:
        motion = phase.motion
        assert phase.begin == pytest.approx(end)
        assert motion.time[0] == 0.0
        assert phase.duration / 0.008 == pytest.approx(round(phase.duration / 0.008), abs=1e-6)
        end = phase.begin + phase.duration
        for rate in (motion.q_rate, motion.rate, motion.q_second, motion.second_rate):
            np.testing.assert_allclose(rate[[0, -1]], 0.0, atol=1e-9)
        assert phase.certificate.is_free
        assert max(phase.use.values()) <= 1.005
    assert job.duration == pytest.approx(end)
    for one, other in pairwise(job.phases):
        np.testing.assert_allclose(one.motion.q[-1], other.motion.q[0], atol=1e-6)
        np.testing.assert_allclose(one.motion.pose[-1], other.motion.pose[0], atol=1e-9)
        np.testing.assert_allclose(one.force.normal[-1], other.force.normal[0], atol=1e-9)
        np.testing.assert_allclose(one.effort[-1], other.effort[0], atol=1e-3)


def test_pads_come_from_the_stand_off_and_go_back_there() -> None:
    job = rack_job()
    for name, ends in (("approach", (0.05, 0.0)), ("press", (0.0, 0.0)), ("retreat", (0.0, 0.05))):
        for arm in (0, 1):
            for sample, expected in zip((0, -1), ends, strict=True):
                assert gap(job.phase(name), sample, arm) == pytest.approx(expected, abs=2e-6)
    for name in ("lift", "set_down"):
        for sample in (0, 200, -1):
            assert gap(job.phase(name), sample, 0) == pytest.approx(0.0, abs=2e-6)


def test_the_box_is_lifted_from_where_it_stands() -> None:
    job = rack_job()
    half = rack().workcell.payload.size[2] / 2.0
    assert job.phase("press").motion.pose[0, 2] - half == pytest.approx(0.60, abs=2e-5)
    assert job.phase("release").motion.pose[0, 2] - half == pytest.approx(1.012, abs=2e-5)
    for name in ("approach", "press", "release", "retreat"):
        assert np.ptp(job.phase(name).motion.pose, axis=0).max() == 0.0


def test_forces_rise_and_fall_no_faster_than_asked() -> None:
    job = rack_job()
    for name in ("press", "release"):
        phase = job.phase(name)
        rate = np.gradient(phase.force.normal, phase.motion.time, axis=0)
        assert 80.0 < abs(rate).max() <= 100.5
    np.testing.assert_array_equal(job.phase("approach").force.normal, 0.0)
    np.testing.assert_array_equal(job.phase("retreat").force.normal, 0.0)


def test_commanded_wrenches_carry_the_box() -> None:
    """Newton and Euler about the box's centre, from the wrenches alone."""
    cell = rack().workcell
    phase = rack_job().phase("lift")
    for k in (0, 100, 200, 300):
        pose = phase.motion.pose[k]
        T = pose_matrix(pose[:3], pose[3:])
        force = phase.force.wrench[k, :, :3].sum(axis=0)
        needed = cell.payload.mass * (phase.motion.second_rate[k, :3] + [0.0, 0.0, 9.81])
        np.testing.assert_allclose(force, needed, atol=1e-6)
        moment = np.zeros(3)
        for arm, contact in enumerate(cell.contacts):
            lever = T[:3, :3] @ contact.T_box_pad[:3, 3]
            wrench = phase.force.wrench[k, arm]
            moment += wrench[3:] + np.cross(lever, wrench[:3])
            inward = T[:3, :3] @ contact.T_box_pad[:3, 2]
            assert wrench[:3] @ inward == pytest.approx(phase.force.normal[k, arm], abs=1e-6)
        np.testing.assert_allclose(moment, 0.0, atol=1e-5)


@pytest.mark.parametrize("name", ["approach", "press", "lift", "carry", "set_down"])
def test_efforts_are_those_of_newton_and_euler(name: str) -> None:
    phase = rack_job().phase(name)
    k = 150
    for arm, robot in enumerate(rack().workcell.robots):
        model = arm_model(robot)
        model.gravity.linear = gravity_in_root(robot.T_world_base)
        data = model.createData()
        columns = slice(6 * arm, 6 * arm + 6)
        motion = phase.motion
        q, rate, second = (v[k, columns] for v in (motion.q, motion.q_rate, motion.q_second))
        torque = np.array(pin.rnea(model, data, q, rate, second))
        # The wrench at the contact point, taken to the last joint's axes by statics.
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        frame = link_frame(model, robot.flange)
        J = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        R = robot.T_world_base[:3, :3].T
        contact = rack().workcell.contacts[arm]
        T = pose_matrix(motion.pose[k, :3], motion.pose[k, 3:])
        flange = robot.T_world_base @ data.oMf[frame].homogeneous
        lever = (T @ contact.T_box_pad)[:3, 3] - flange[:3, 3]
        force, moment = phase.force.wrench[k, arm, :3], phase.force.wrench[k, arm, 3:]
        at_flange = np.concatenate([R @ force, R @ (moment + np.cross(lever, force))])
        np.testing.assert_allclose(phase.effort[k, columns], torque + J.T @ at_flange, atol=1e-6)


def test_no_limit_is_exceeded_on_a_grid_ten_times_as_fine() -> None:
    """From the positions alone: differences of a grid ten times as fine as a bundle's."""
    cell = rack().workcell
    sampled = sample_job(rack_job(), 0.002)
    for index, phase in enumerate(rack_job().phases):
        span = sampled.span(index)
        q, step = sampled.q[span], float(np.diff(sampled.time[span])[0])
        rate = np.diff(q, axis=0) / step
        second = np.diff(rate, axis=0) / step
        for values, name in ((rate, "velocity_max"), (second, "acceleration_max")):
            limit = np.concatenate([getattr(robot, name) for robot in cell.robots])
            assert (np.abs(values) / limit).max() <= 1.005, (phase.name, name)
        torque = np.concatenate([robot.torque_max for robot in cell.robots])
        assert (np.abs(sampled.effort[span]) / torque).max() <= 1.005
        third = np.diff(second, axis=0) / step
        assert np.abs(third).max() < 500.0, phase.name


def changed(**handling: float) -> Job:
    """The rack's job with another handling."""
    return rack_jobs().plan(rack_timing(), handling=Handling(**handling))


@pytest.mark.parametrize(
    ("handling", "message"),
    [
        (
            {"set_down_height": 0.02},
            "set down: .*payload .*liner, top board",
        ),
        ({"lift_height": 0.03}, "middle board"),
        ({"stand_off": 1.2}, "approach"),
        ({"lift_height": 0.5}, "lift"),
    ],
)
def test_what_cannot_be_done_is_told(handling: dict[str, float], message: str) -> None:
    with pytest.raises(JobError, match=message):
        changed(**handling)


def test_without_a_height_nothing_is_lifted() -> None:
    job = changed(lift_height=0.0, set_down_height=0.0)
    assert tuple(phase.name for phase in job.phases) == UNLIFTED
    assert job.stands_on == ((), ())


def test_a_box_may_stand_where_pads_may_be_displaced() -> None:
    """All else is kept farther from it by the displacement."""
    cell = replace(rack().workcell, uncertainty=Uncertainty(pad_position=0.003))
    timing = rack_timing()
    job = JobModel(cell).plan(replace(timing, carry=replace(timing.driven, workcell=cell)))
    assert tuple(phase.name for phase in job.phases) == PHASES
    assert job.stands_on == rack_job().stands_on


def test_what_has_no_job_is_refused() -> None:
    with refused(JobError, "beyond-a-limit", "joint torque"):
        rack_jobs().plan(rack_timing(), SqueezeSettings(factor=8.0))
    failed = time_path(rack().timing_model, rack().initial, TimingLimits(force=30.0))
    with refused(SettingsError, "no-timing"):
        rack_jobs().plan(failed)


def largest_jerk(phase: Phase) -> tuple[float, float]:
    """Of joints [rad/s^3] and box [m/s^3], by differences of the accelerations."""
    motion = phase.motion
    moments = np.concatenate([[True], np.diff(motion.time) > 1e-9])
    steps = np.diff(motion.time[moments])[:, None]
    joints = np.diff(motion.q_second[moments], axis=0) / steps
    box = np.diff(motion.second_rate[moments, :3], axis=0) / steps
    return float(np.abs(joints).max()), float(np.linalg.norm(box, axis=1).max())


def test_jerk_is_bounded_in_every_phase() -> None:
    """Also around a carry whose timing switches accelerations in no time."""
    timing = time_path(rack().timing_model, rack().initial, TimingLimits(force=55.0))
    job = rack_jobs().plan(timing)
    assert timing.duration < job.timing.duration < 1.06 * timing.duration
    for phase in job.phases:
        joints, box = largest_jerk(phase)
        assert joints <= 50.0 * 1.01
        assert box <= 50.0 * 1.01
        assert phase.use["joint jerk"] == pytest.approx(joints / 50.0, rel=1e-6, abs=1e-9)
    carry = job.phase("carry")
    assert carry.use["joint jerk"] > 0.95
    assert carry.use["normal force"] == pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(carry.motion.q_second[[0, -1]], 0.0, atol=1e-9)


def test_straight_phases_take_the_time_that_jerk_asks_for() -> None:
    job, model = rack_job(), copy(rack().timing_model)
    first, second = model.workcell.robots
    tight = replace(first, jerk_max=np.full(6, 0.5))
    model.workcell = replace(model.workcell, robots=(tight, second))
    old = job.phase("lift")
    line = straight(model.workcell, "lift", old.motion.pose[[0, -1]], (0.0, 0.0), 0.1)
    motion = time_line(model, line, old.motion.q)
    assert motion.duration > old.duration
    joints = np.diff(motion.q_second[:, :6], axis=0) / np.diff(motion.time)[:, None]
    # Whole ticks round the duration up.
    assert 0.9 * 0.5 < np.abs(joints).max() <= 0.5 * 1.005


def test_a_carry_of_too_much_jerk_is_refused() -> None:
    model = rack().timing_model
    sharp = JerkLimits(np.full(12, 500.0), 500.0)
    found = time_with_jerk(model, rack().initial, TimingLimits(force=55.0), sharp)
    with refused(JobError, "beyond-a-limit", "joint jerk"):
        rack_jobs().plan(found.timing)


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
    assert not skewed(job, 0.01, 1e5).is_held


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
    assert skewed(job, most, stiffness).is_held
    assert not skewed(job, 1.01 * most, stiffness).is_held
    require_skew(job, most, stiffness)
    missing = -skewed(job, 0.02, stiffness).margin
    with refused(JobError, "skew-too-long", "20 ms", f"{missing:.1f} N", f"{1e3 * most:.1f} ms"):
        require_skew(job, 0.02, stiffness)
    assert largest_skew(job, 1.0) == LARGEST_SKEW
    for delay in (-1e-3, 1.0, float("nan")):
        with refused(SettingsError, "skew"):
            skewed(job, delay, stiffness)
    for stiffness in (0.0, -1.0, float("nan"), float("inf")):
        with refused(SettingsError, "stiffness"):
            position_control(job, stiffness)
        with refused(SettingsError, "stiffness"):
            skewed(job, 0.01, stiffness)
