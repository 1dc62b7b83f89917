"""The recording, read back by mcap's own reader and by rosbags' message definitions."""

from __future__ import annotations

import io
from collections import defaultdict
from typing import Any

import numpy as np
import pytest
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles.mcap_file import message_of
from hybrid_opt.job.records import SampledJob
from tests.hybrid_opt.bundles.bundles import contents, exported, text_of
from tests.hybrid_opt.job.jobs import rack_job


def sampled() -> SampledJob:
    return exported("mcap").sampled


def recording() -> io.BytesIO:
    content = contents("mcap")["job.mcap"]
    assert isinstance(content, bytes)
    return io.BytesIO(content)


def decoded() -> dict[str, list[tuple[int, Any]]]:
    """Messages by topic with their times, by mcap's own decoder."""
    found = defaultdict(list)
    reader = make_reader(recording(), decoder_factories=[DecoderFactory()])
    for _, channel, message, content in reader.iter_decoded_messages():
        found[channel.topic].append((message.log_time, content))
    return found


def test_every_message_is_one_of_ros2() -> None:
    """Both readers agree on every message, whose types are ROS 2's own."""
    store = get_typestore(Stores.ROS2_JAZZY)
    reader = make_reader(recording())
    assert reader.get_header().profile == "ros2"
    counts: dict[str, int] = defaultdict(int)
    for schema, channel, message in reader.iter_messages():
        assert schema is not None
        assert schema.encoding == "ros2msg"
        found: Any = store.deserialize_cdr(message.data, schema.name)
        assert channel.message_encoding == "cdr"
        counts[schema.name] += 1
        if schema.name == "sensor_msgs/msg/JointState":
            k = counts[schema.name] - 1
            np.testing.assert_array_equal(found.position, sampled().q[k])
    assert set(counts) == {
        "sensor_msgs/msg/JointState",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/WrenchStamped",
        "tf2_msgs/msg/TFMessage",
        "std_msgs/msg/String",
    }


def test_the_job_is_read_back() -> None:
    found, job = decoded(), sampled()
    assert [message.data for _, message in found["/phase"]] == [p.name for p in rack_job().phases]
    assert found["/robot_description"][0][1].data == text_of(
        "ros2-control", "description/cell.urdf"
    )
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


def test_a_damaged_recording_is_refused() -> None:
    content = recording().getvalue()
    for damaged in (content[:-40], b"x" + content, content[:200] + b"damage" + content[206:]):
        with pytest.raises((McapError, EndOfFile, ValueError)):
            list(make_reader(io.BytesIO(damaged), validate_crcs=True).iter_messages())


def test_messages_have_all_fields() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    with pytest.raises(KeyError):
        message_of(store, {"force": {"x": 0.0, "y": 0.0}}, "geometry_msgs/msg/Wrench")
