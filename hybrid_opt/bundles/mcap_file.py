"""A job as an MCAP recording with ROS 2 messages, for Foxglove, rviz and rosbag2."""

from __future__ import annotations

import io
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import pinocchio as pin
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles.arms import WORLD, description, prefixes
from hybrid_opt.bundles.manifest import BundleOptions
from hybrid_opt.bundles.ros2 import (
    duration,
    job_joints,
    pad_frame,
    pad_wrench,
    wrench_message,
)
from hybrid_opt.errors import ResultsError
from hybrid_opt.job.records import SampledJob
from symbolic.array import Array
from symbolic.read.arms import arm_model, link_frame
from symbolic.records.poses import box_placement

_TIME = "builtin_interfaces/Time"
_DEFINITIONS = {
    _TIME: "int32 sec\nuint32 nanosec",
    "std_msgs/Header": f"{_TIME} stamp\nstring frame_id",
    "std_msgs/String": "string data",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque",
    "geometry_msgs/WrenchStamped": "std_msgs/Header header\ngeometry_msgs/Wrench wrench",
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
        "float64[] effort"
    ),
}
"""Fields of ROS 2's messages."""

Message = tuple[str, str, dict[str, Any]]
"""Topic, type and content."""


def mcap_files(sampled: SampledJob, options: BundleOptions) -> dict[str, str | bytes]:
    """One recording; times count from zero.

    Raises:
        ResultsError: the package that writes it is not installed.
    """
    writing = _writer_module()
    file = io.BytesIO()
    writer = writing.Writer(file)
    schemas = {
        name: writer.register_msgdef(_long_name(name), _definition(name))
        for name in (
            "sensor_msgs/JointState",
            "geometry_msgs/PoseStamped",
            "geometry_msgs/WrenchStamped",
            "tf2_msgs/TFMessage",
            "std_msgs/String",
        )
    }
    recording = _Recording(sampled)
    for k, time in enumerate(sampled.time.tolist()):
        stamp = round(time * 1e9)
        for topic, kind, message in recording.messages(k, duration(time)):
            writer.write_message(topic, schemas[kind], message, stamp, stamp)
    writer.finish()
    return {"job.mcap": file.getvalue()}


class _Recording:
    """The messages of each sample."""

    def __init__(self, sampled: SampledJob) -> None:
        self._sampled = sampled
        self._cell = sampled.job.workcell
        self._prefixes = prefixes(self._cell)
        self._wrenches = [pad_wrench(sampled, arm).tolist() for arm in (0, 1)]
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
            yield "/robot_description", "std_msgs/String", {"data": text}
        if k in self._begins:
            yield "/phase", "std_msgs/String", {"data": self._begins[k]}
        world = {"stamp": stamp, "frame_id": WORLD}
        joints = {
            "header": world,
            "name": list(job_joints(sampled.job)),
            "position": sampled.q[k].tolist(),
            "velocity": sampled.q_rate[k].tolist(),
            "effort": sampled.effort[k].tolist(),
        }
        yield "/joint_states", "sensor_msgs/JointState", joints
        box = self._boxes[k]
        yield "/box_pose", "geometry_msgs/PoseStamped", {"header": world, "pose": _pose(box)}
        for arm, prefix in enumerate(self._prefixes):
            frame = pad_frame(prefix, arm)
            header = {"stamp": stamp, "frame_id": frame}
            message = {"header": header, "wrench": wrench_message(self._wrenches[arm][k])}
            yield f"/{frame}/wrench_reference", "geometry_msgs/WrenchStamped", message
        frames = [("box", box), *self._frames(k)]
        transforms = [_transform(world, name, pose) for name, pose in frames]
        yield "/tf", "tf2_msgs/TFMessage", {"transforms": transforms}

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


def _definition(name: str) -> str:
    """A message's definition with those of all messages in it, as recordings hold it."""
    found = [name]
    for each in found:
        for line in _DEFINITIONS[each].splitlines():
            kind = line.split()[0].removesuffix("[]")
            if kind in _DEFINITIONS and kind not in found:
                found.append(kind)
    parts = [_DEFINITIONS[name]]
    parts += [f"{'=' * 80}\nMSG: {each}\n{_DEFINITIONS[each]}" for each in found[1:]]
    return "\n".join(parts) + "\n"


def _long_name(name: str) -> str:
    package, kind = name.split("/")
    return f"{package}/msg/{kind}"


def _writer_module() -> ModuleType:
    try:
        import mcap_ros2.writer
    except ImportError as error:
        raise ResultsError(
            "the package mcap-ros2-support is not installed; install the extra: "
            "pip install -e '.[ros]'"
        ) from error
    module: ModuleType = mcap_ros2.writer
    return module
