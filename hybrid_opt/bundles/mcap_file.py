"""A job as an MCAP recording with ROS 2 messages, for Foxglove, rviz and rosbag2."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from types import ModuleType
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles.arms import WORLD, description, pad_frame, prefixes
from hybrid_opt.bundles.job_file import Export
from hybrid_opt.errors import ResultsError
from hybrid_opt.job.records import SampledJob
from symbolic.array import Array
from symbolic.read.arms import arm_model, link_frame
from symbolic.records.poses import box_placement, box_rotation

TYPES = (
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/WrenchStamped",
    "tf2_msgs/msg/TFMessage",
    "std_msgs/msg/String",
)

Message = tuple[str, str, dict[str, Any]]
"""Topic, type and content."""


def mcap_files(export: Export) -> dict[str, str | bytes]:
    """One recording; times count from zero.

    Raises:
        ResultsError: the packages that write it are not installed.
    """
    writing, store = _packages()
    file = io.BytesIO()
    writer = writing.Writer(file)
    writer.start(profile="ros2", library="dual-arm-carry")
    schemas = {
        name: writer.register_schema(
            name, "ros2msg", store.generate_msgdef(name, ros_version=2)[0].encode()
        )
        for name in TYPES
    }
    channels: dict[str, int] = {}
    recording = _Recording(export)
    for k, time in enumerate(export.sampled.time.tolist()):
        stamp = round(time * 1e9)
        for topic, kind, content in recording.messages(k, duration(time)):
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schemas[kind])
            data = bytes(store.serialize_cdr(message_of(store, content, kind), kind))
            writer.add_message(channels[topic], stamp, data, stamp)
    writer.finish()
    return {"job.mcap": file.getvalue()}


def message_of(store: Any, content: Mapping[str, Any], kind: str) -> Any:
    """A message of a type store from plain values; unknown and missing fields are errors."""
    fields = store.get_msgdef(kind).fields
    values = {name: _field(store, content[name], node) for name, node in fields}
    return store.types[kind](**values)


def _field(store: Any, value: Any, node: Any) -> Any:
    sort, described = node
    if sort.name == "NAME":
        return message_of(store, value, described)
    if sort.name == "BASE":
        return value
    (inner, name), _ = described
    if inner.name == "NAME":
        return [message_of(store, each, name) for each in value]
    return list(value) if name[0] == "string" else np.array(value, dtype=name[0])


class _Recording:
    """The messages of each sample."""

    def __init__(self, export: Export) -> None:
        self._sampled = sampled = export.sampled
        self._joints = [*export.ros_joints(0), *export.ros_joints(1)]
        self._cell = sampled.job.workcell
        self._prefixes = prefixes(self._cell)
        self._wrenches = [pad_wrench(sampled, arm) for arm in (0, 1)]
        phases = enumerate(sampled.job.phases)
        self._begins = {sampled.span(index).start: phase.name for index, phase in phases}
        self._models = [arm_model(robot) for robot in self._cell.robots]
        self._data = [model.createData() for model in self._models]
        self._boxes = box_placement(self._cell.task.orientation, sampled.pose)

    def messages(self, k: int, stamp: dict[str, int]) -> Iterator[Message]:
        """Messages of sample k."""
        sampled = self._sampled
        if k == 0:
            text = description(self._cell, sampled.q[0])
            yield "/robot_description", "std_msgs/msg/String", {"data": text}
        if k in self._begins:
            yield "/phase", "std_msgs/msg/String", {"data": self._begins[k]}
        world = {"stamp": stamp, "frame_id": WORLD}
        joints = {
            "header": world,
            "name": self._joints,
            "position": sampled.q[k].tolist(),
            "velocity": sampled.q_rate[k].tolist(),
            "effort": sampled.effort[k].tolist(),
        }
        yield "/joint_states", "sensor_msgs/msg/JointState", joints
        box = self._boxes[k]
        yield "/box_pose", "geometry_msgs/msg/PoseStamped", {"header": world, "pose": _pose(box)}
        for arm, prefix in enumerate(self._prefixes):
            frame = pad_frame(prefix, arm)
            header = {"stamp": stamp, "frame_id": frame}
            wrench = zip(("force", "torque"), np.split(self._wrenches[arm][k], 2), strict=True)
            axes = {name: dict(zip("xyz", part.tolist(), strict=True)) for name, part in wrench}
            message = {"header": header, "wrench": axes}
            yield f"/{frame}/wrench_reference", "geometry_msgs/msg/WrenchStamped", message
        frames = [("box", box), *self._frames(k)]
        transforms = [_transform(world, name, pose) for name, pose in frames]
        yield "/tf", "tf2_msgs/msg/TFMessage", {"transforms": transforms}

    def _frames(self, k: int) -> Iterator[tuple[str, Array]]:
        """Every link of both arms with its pose (4, 4) in the world, and both pads."""
        for arm, robot in enumerate(self._cell.robots):
            model, data, prefix = self._models[arm], self._data[arm], self._prefixes[arm]
            pin.framesForwardKinematics(model, data, self._sampled.arm(arm, self._sampled.q)[k])
            for frame, placed in zip(model.frames, data.oMf, strict=True):
                if frame.type == pin.FrameType.BODY and not (arm and not prefix):
                    yield f"{prefix}{frame.name}", robot.T_world_base @ placed.homogeneous
            flange = data.oMf[link_frame(model, robot.flange)].homogeneous
            T_world_pad = robot.T_world_base @ flange @ robot.T_flange_pad
            yield pad_frame(prefix, arm), T_world_pad


def _transform(header: dict[str, Any], child: str, pose: Array) -> dict[str, Any]:
    at = _pose(pose)
    transform = {"translation": at["position"], "rotation": at["orientation"]}
    return {"header": header, "child_frame_id": child, "transform": transform}


def _pose(T: Array) -> dict[str, Any]:
    """A geometry_msgs/Pose of a transform (4, 4)."""
    turn = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return {
        "position": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "orientation": dict(zip("xyzw", turn, strict=True)),
    }


def duration(seconds: float) -> dict[str, int]:
    """A builtin_interfaces/msg/Duration, or Time."""
    nanoseconds = round(seconds * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def pad_wrench(sampled: SampledJob, arm: int) -> Array:
    """(n, 6) force and moment that a pad exerts on the box, along the pad's axes [N, N m]."""
    T_box_pad = sampled.job.workcell.contacts[arm].T_box_pad
    turned = box_rotation(sampled.job.workcell.task.orientation, sampled.pose)
    R_world_pad = turned @ T_box_pad[:3, :3]
    both = sampled.wrench[:, arm].reshape(-1, 2, 3)
    return np.asarray(np.einsum("nji,nkj->nki", R_world_pad, both).reshape(-1, 6))


def _packages() -> tuple[ModuleType, Any]:
    """What writes recordings, and ROS 2's message types."""
    try:
        import mcap.writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ResultsError(
            "the packages mcap and rosbags are not installed; install the extra: "
            "pip install -e '.[ros]'"
        ) from error
    module: ModuleType = mcap.writer
    return module, get_typestore(Stores.ROS2_JAZZY)
