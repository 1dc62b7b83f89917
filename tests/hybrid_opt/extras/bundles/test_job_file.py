"""CSV and JSON read back, by others too, and the samples that they hold."""

from __future__ import annotations

import copy
import csv
import io
import json
import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import jsonschema
import numpy as np
import pinocchio as pin
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from hybrid_opt.errors import JobError
from hybrid_opt.extras.bundles import TARGETS
from hybrid_opt.extras.bundles.job_file import (
    Export,
    Interpolation,
    chosen_step,
    gap_of,
    pad_errors,
    timing_model,
)
from hybrid_opt.extras.bundles.stopping import stop_of
from hybrid_opt.job.compliance import TRACKED
from hybrid_opt.job.records import SampledJob, sample_job
from symbolic.errors import SettingsError
from symbolic.read.arms import arm_model
from tests.hybrid_opt.cells import shipped
from tests.hybrid_opt.extras.bundles.bundles import contents, exported, text_of
from tests.hybrid_opt.job.jobs import rack, rack_job
from tests.refusals import refused


def sampled() -> SampledJob:
    return exported("data").sampled


def test_samples_lie_on_the_job() -> None:
    found = sampled()
    assert found.time[0] == 0.0
    assert found.time[-1] == pytest.approx(rack_job().duration)
    assert (np.diff(found.time) > 0.0).all()
    assert np.diff(found.time).max() <= 0.05 + 1e-12
    for index, phase in enumerate(rack_job().phases):
        span = found.span(index)
        ends = [span.start, span.stop - 1]
        np.testing.assert_allclose(found.time[ends], [phase.begin, phase.begin + phase.duration])
        np.testing.assert_allclose(found.q_rate[ends], 0.0, atol=1e-9)
        np.testing.assert_allclose(found.q_second[ends[1]], 0.0, atol=1e-9)
        for k in range(span.start, span.stop, 7):
            near = int(np.argmin(np.abs(phase.motion.time + phase.begin - found.time[k])))
            offset = found.time[k] - phase.begin - phase.motion.time[near]
            expected = phase.motion.q[near] + offset * phase.motion.q_rate[near]
            np.testing.assert_allclose(found.q[k], expected, atol=5e-5)
            np.testing.assert_allclose(found.effort[k], phase.effort[near], atol=1.0)


def test_a_joint_that_moves_both_arms_bears_the_contact_of_both() -> None:
    """The TIAGo's lift, first of each arm's eight joints; without such a joint nothing is added."""
    cell = shipped("tiago").workcell
    names = tuple(tuple(arm_model(robot).names)[1:] for robot in cell.robots)
    contact = np.random.default_rng(2).normal(size=(3, 16))
    knows: Any = SimpleNamespace(workcell=cell, job=SimpleNamespace(joint_names=names))
    found = Export._of_other(knows, contact)
    expected = np.zeros((3, 16))
    expected[:, 0], expected[:, 8] = contact[:, 8], contact[:, 0]
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(exported("data").effort, exported("data").sampled.effort)


def test_samples_are_consistent_with_their_derivatives() -> None:
    fine = sample_job(rack_job(), 0.002)
    slope = (fine.q[2:] - fine.q[:-2]) / (fine.time[2:] - fine.time[:-2])[:, None]
    np.testing.assert_allclose(slope, fine.q_rate[1:-1], atol=5e-4)


def test_csv_read_back() -> None:
    rows = list(csv.DictReader(io.StringIO(text_of("data", "job.csv"))))
    job = sampled()
    assert [row["phase"] for row in rows] == list(job.phase_names)
    assert len(rows[0]) == 2 + 6 + 60 + 2 + 12
    less = job.effort[:, 1] - exported("data").gravity[:, 1]
    for name, values in (
        ("time [s]", job.time),
        ("right/joint_4 position [rad]", job.q[:, 9]),
        ("left/joint_1 velocity [rad/s]", job.q_rate[:, 0]),
        ("right/joint_6 acceleration [rad/s^2]", job.q_second[:, 11]),
        ("left/joint_2 effort with gravity [N m]", job.effort[:, 1]),
        ("left/joint_2 effort without gravity [N m]", less),
        ("box z [m]", job.pose[:, 2]),
        ("left normal force [N]", job.normal_force[:, 0]),
        ("right wrench fy [N]", job.wrench[:, 1, 1]),
    ):
        np.testing.assert_array_equal([float(row[name]) for row in rows], values, name)


def test_json_read_back() -> None:
    document, job = json.loads(text_of("data", "job.json")), sampled()
    assert document["format"] == "dual-arm-carry job"
    np.testing.assert_array_equal(document["time"], job.time)
    np.testing.assert_array_equal(document["box"]["pose"], job.pose)
    for phase, planned in zip(document["phases"], rack_job().phases, strict=True):
        assert phase["name"] == planned.name
        assert job.time[phase["first"]] == pytest.approx(planned.begin)
    for i, robot in enumerate(document["robots"]):
        assert robot["name"] == rack_job().workcell.robots[i].name
        assert robot["joints"] == [f"joint_{k}" for k in range(1, 7)]
        for name, values in (
            ("position", job.q),
            ("velocity", job.q_rate),
            ("acceleration", job.q_second),
            ("effort_with_gravity", job.effort),
        ):
            np.testing.assert_array_equal(robot[name], values[:, 6 * i : 6 * i + 6], name)
        np.testing.assert_array_equal(robot["normal_force"], job.normal_force[:, i])


def short(value: Any) -> Any:
    """A document whose outer lists end after eight entries."""
    if isinstance(value, dict):
        return {key: short(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [short(each) if isinstance(each, dict) else each for each in value[:8]]
    return value


def test_the_schema_describes_the_file() -> None:
    schema = json.loads(text_of("data", "job.schema.json"))
    jsonschema.Draft202012Validator.check_schema(schema)
    judge = jsonschema.Draft202012Validator(schema)
    document = json.loads(text_of("data", "job.json"))
    assert judge.is_valid(document)
    assert judge.is_valid(short(document))
    broken: list[Callable[[Any], object]] = [
        lambda d: d.update(version=1),
        lambda d: d.pop("machine"),
        lambda d: d["robots"].pop(),
        lambda d: d["robots"][0].pop("effort_without_gravity"),
        lambda d: d["robots"][0].update(effort=[[0.0]]),
        lambda d: d["robots"][1]["normal_force"].__setitem__(0, -1.0),
        lambda d: d["phases"][0].update(name="lunch"),
        lambda d: d["machine"]["limits"].update(stop_time=0.0),
        lambda d: d["box"]["pose"][3].pop(),
        lambda d: d["time"].__setitem__(0, "0"),
    ]
    for each in broken:
        damaged = copy.deepcopy(short(document))
        each(damaged)
        assert not judge.is_valid(damaged)


@pytest.mark.parametrize("step", [0.0, -1.0, math.nan, math.inf, 2.0])
def test_time_steps_are_checked(step: float) -> None:
    with pytest.raises(SettingsError, match="time step"):
        sample_job(rack_job(), step)


def described() -> tuple[Any, Any]:
    model = pin.buildModelFromXML(text_of("torque", "description/cell.urdf"))
    return model, model.createData()


def test_gravity_is_that_of_the_description() -> None:
    """The bundle's own URDF, read by Pinocchio."""
    (model, data), found = described(), exported("torque")
    for k in range(0, len(found.sampled.time), 20):
        gravity = pin.computeGeneralizedGravity(model, data, found.sampled.q[k])
        np.testing.assert_allclose(found.gravity[k], gravity, atol=1e-2)


def test_holding_bears_half_of_the_box_each_and_presses() -> None:
    """Virtual work: what holding efforts beside gravity do along each joint is what the pad's
    wrench does along the pad's way; both wrenches together bear the box."""
    found = exported("torque")
    sampled, cell = found.sampled, rack().workcell
    load = found.holding - found.gravity
    model, data = described()
    span = sampled.span(3)
    for k in range(span.start, span.stop, 15):
        total = np.zeros(3)
        for arm, name in enumerate(("left_contact_pad", "right_contact_pad")):
            frame = model.getFrameId(name)
            J = pin.computeFrameJacobian(model, data, sampled.q[k], frame, pin.LOCAL_WORLD_ALIGNED)
            pin.framesForwardKinematics(model, data, sampled.q[k])
            part = slice(6 * arm, 6 * arm + 6)
            wrench = np.linalg.solve(J[:, part].T, load[k, part])
            normal = data.oMf[frame].rotation[:, 2]
            assert wrench[:3] @ normal == pytest.approx(sampled.normal_force[k, arm], rel=0.02)
            total += wrench[:3]
        np.testing.assert_allclose(total, [0.0, 0.0, 9.81 * cell.payload.mass], atol=0.2)
    rests = np.array(sampled.last)
    np.testing.assert_allclose(sampled.effort[rests], found.holding[rests], atol=1e-6)


def test_a_stop_keeps_the_squeeze() -> None:
    """And needs the force of its deceleration: the worst of the job by hand, F = m (a - g), least
    forces with a Coulomb cone."""
    job, cell = rack_job(), rack().workcell
    stop, worst = stop_of(job, timing_model(job.workcell)), 0.0
    for phase in job.held:
        # A bound: full speed and the largest slope of the rate at once, whole planned acceleration.
        slowed = 1.875 / stop.time * np.abs(phase.motion.rate[:, :3])
        size = np.linalg.norm(np.abs(phase.motion.second_rate[:, :3]) + slowed, axis=1) + 9.81
        worst = max(worst, cell.payload.mass * float(size.max()))
    worst /= 2.0 * min(contact.friction for contact in cell.contacts)
    commanded = min(float(p.force.normal.min()) for p in job.held)
    # Soft fingers and moments ask for more than the cone alone.
    assert stop.force_use <= min(1.0, 1.6 * worst / commanded)
    weak = [replace(p, force=replace(p.force, normal=0.4 * p.force.normal)) for p in job.phases]
    with pytest.raises(JobError, match=" % "):
        stop_of(replace(job, phases=tuple(weak)), timing_model(job.workcell))


def independent_gap(sampled: SampledJob, kind: str) -> float:
    """Largest change of the gap [m] while the box is held, at quarters of each step, by
    polynomials of our own: the inverse of what a polynomial's coefficients do to its ends."""
    job, n = sampled.job, {"linear": 1, "cubic": 2, "quintic": 3}[kind]
    ends = [
        [math.perm(c, d) * (x ** (c - d) if c >= d else 0.0) for c in range(2 * n)]
        for x in (0.0, 1.0)
        for d in range(n)
    ]
    coefficients = np.linalg.inv(np.array(ends))
    spans = [sampled.span(job.phases.index(phase)) for phase in job.held]
    starts = np.concatenate([np.arange(span.start, span.stop - 1) for span in spans])
    h = np.diff(sampled.time)[starts][:, None]
    known = [
        values[starts + end] * h**d
        for end in (0, 1)
        for d, values in enumerate((sampled.q, sampled.q_rate, sampled.q_second)[:n])
    ]
    c = np.einsum("ce,enj->cnj", coefficients, np.array(known))
    rows = [sum(c[k] * x**k for k in range(2 * n)) for x in (0.25, 0.5, 0.75)]
    return float(np.abs(pad_errors(job.workcell, np.concatenate(rows))[0]).max())


@pytest.mark.parametrize("kind", ["linear", "cubic", "quintic"])
def test_the_gap_is_that_of_an_independent_interpolation(kind: Interpolation) -> None:
    sampled = sample_job(rack_job(), 0.2)
    found = gap_of(sampled, kind, 1e4)
    assert found.along == pytest.approx(independent_gap(sampled, kind), rel=1e-6)
    assert found.force == pytest.approx(1e4 / 2.0 * found.along)


@pytest.mark.parametrize(
    ("steps", "interpolation"), sorted({(t.steps, t.interpolation) for t in TARGETS.values()})
)
def test_every_target_keeps_the_gap(steps: tuple[float, ...], interpolation: Interpolation) -> None:
    """At the step that it chooses by itself. Of many steps only some are looked at."""
    found = sample_job(rack_job(), chosen_step(rack_job(), steps, interpolation, 1e4))
    gap = independent_gap(found, interpolation)
    held = [phase.force.normal.min() for phase in rack_job().held]
    assert 1e4 / 2.0 * gap <= TRACKED * min(held)
    assert 0.98 * gap <= gap_of(found, interpolation, 1e4).along <= 1.000001 * gap


def test_the_step_follows_from_the_stiffness() -> None:
    steps = (0.2, 0.1, 0.05, 0.02)
    soft = chosen_step(rack_job(), steps, "linear", 2e3)
    stiff = chosen_step(rack_job(), steps, "linear", 1e5)
    assert soft > stiff
    assert gap_of(sample_job(rack_job(), stiff), "linear", 1e5).share <= TRACKED
    longer = steps[steps.index(stiff) - 1]
    assert gap_of(sample_job(rack_job(), longer), "linear", 1e5).share > TRACKED
    with refused(SettingsError, "gap-between-samples"):
        chosen_step(rack_job(), (0.2,), "linear", 1e6)


TYPES = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/box_pose": "geometry_msgs/msg/PoseStamped",
    "/left_contact_pad/wrench_reference": "geometry_msgs/msg/WrenchStamped",
    "/right_contact_pad/wrench_reference": "geometry_msgs/msg/WrenchStamped",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/phase": "std_msgs/msg/String",
    "/robot_description": "std_msgs/msg/String",
}


@cache
def decoded() -> dict[str, list[tuple[int, Any]]]:
    """Messages by topic with their times, by mcap's own decoder; ROS 2's own types decode all."""
    content, store = contents("data")["job.mcap"], get_typestore(Stores.ROS2_JAZZY)
    assert isinstance(content, bytes)
    reader = make_reader(io.BytesIO(content), decoder_factories=[DecoderFactory()])
    assert reader.get_header().profile == "ros2"
    found: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    for schema, channel, message, value in reader.iter_decoded_messages():
        assert schema is not None
        assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
        assert schema.name == TYPES[channel.topic]
        other: Any = store.deserialize_cdr(message.data, schema.name)
        if channel.topic == "/joint_states":
            np.testing.assert_array_equal(other.position, sampled().q[len(found[channel.topic])])
        found[channel.topic].append((message.log_time, value))
    return found


def test_the_job_is_read_back() -> None:
    found, job = decoded(), sampled()
    assert set(found) == set(TYPES)
    assert [message.data for _, message in found["/phase"]] == [p.name for p in rack_job().phases]
    ((_, described),) = found["/robot_description"]
    assert described.data == text_of("torque", "description/cell.urdf")
    assert len(found["/joint_states"]) == len(job.time)
    for k, (stamp, state) in enumerate(found["/joint_states"]):
        assert stamp == pytest.approx(1e9 * job.time[k], abs=1.0)
        assert list(state.name[:2]) == ["left_joint_1", "left_joint_2"]
        np.testing.assert_array_equal(state.velocity, job.q_rate[k])
        np.testing.assert_array_equal(state.effort, job.effort[k])
    for k, (_, pose) in enumerate(found["/box_pose"]):
        at, turn = pose.pose.position, pose.pose.orientation
        np.testing.assert_array_equal([at.x, at.y, at.z], job.pose[k, :3])
        expected = Rotation.from_euler("xyz", job.pose[k, 3:])
        read = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
        assert (read * expected.inv()).magnitude() < 1e-9
    wrenches = found["/right_contact_pad/wrench_reference"]
    forces = [message.wrench.force.z for _, message in wrenches]
    np.testing.assert_allclose(forces, job.normal_force[:, 1], atol=1e-9)


def test_frames_hang_together() -> None:
    """In the middle of the carry both pads' frames lie on the box."""
    job = sampled()
    k = job.span(3).start + 20
    _, message = decoded()["/tf"][k]
    frames = {each.child_frame_id: each.transform for each in message.transforms}
    assert all(each.header.frame_id == "world" for each in message.transforms)
    box, pad = frames["box"].translation, frames["left_contact_pad"].translation
    distance = np.linalg.norm([box.x - pad.x, box.y - pad.y, box.z - pad.z])
    assert distance == pytest.approx(np.hypot(0.2, 0.055), abs=1e-5)
    assert {"left_base_link", "right_link_6"} <= set(frames)
