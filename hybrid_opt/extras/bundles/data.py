"""The data target: a job as a table (CSV), as JSON with its schema, and as a recording (MCAP).

The recording contains messages of ROS 2, for Foxglove, rviz and rosbag2.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from importlib.resources import files
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from hybrid_opt.extras.bundles.arms import WORLD, description, pad_frame, prefixes, ros_joints
from hybrid_opt.extras.bundles.job_file import Export, job_text
from hybrid_opt.job.records import SWITCHES, SampledJob
from hybrid_opt.store.files import csv_text
from symbolic.array import Array
from symbolic.read.arms import arm_model, link_frame, turning_joints
from symbolic.records.poses import box_placement, box_rotation

SCHEMA = "job.schema.json"


def data_files(export: Export) -> dict[str, str | bytes]:
    """Return the data files of a job by path: a table, a JSON file with its schema, and a recording
    for ROS 2."""
    schema = (files("hybrid_opt.extras.bundles") / SCHEMA).read_text("utf-8")
    tables = {"job.csv": job_table(export), "job.json": job_text(export), SCHEMA: schema}
    return tables | recording(export)


_POSE_UNITS = ("m",) * 3 + ("rad",) * 3
_WRENCH = ("fx [N]", "fy [N]", "fz [N]", "mx [N m]", "my [N m]", "mz [N m]")
_JOINT_UNITS = (("rad", "m"), ("rad/s", "m/s"), ("rad/s^2", "m/s^2"), ("N m", "N"), ("N m", "N"))
"""Units of `Export.joint_columns`, for joints that turn and for joints that slide."""


def job_table(export: Export) -> str:
    """Return the job as a CSV table with one row per time step, and one column per quantity with
    its unit."""
    job, sampled = export.job, export.sampled
    robots = [robot.name for robot in job.workcell.robots]
    pose = zip(job.workcell.task.pose_names, _POSE_UNITS, strict=True)
    header = ["time [s]", "phase", *(f"box {name} [{unit}]" for name, unit in pose)]
    columns = [sampled.pose]
    known = zip(export.joint_columns.items(), _JOINT_UNITS, strict=True)
    for (name, values), (unit, sliding) in known:
        word = name.replace("_", " ")
        for robot, joints in zip(job.workcell.robots, job.joint_names, strict=True):
            header += [
                f"{robot.name}/{joint} {word} [{unit if turns else sliding}]"
                for joint, turns in zip(joints, turning_joints(arm_model(robot)), strict=True)
            ]
        columns.append(values)
    header += [f"{robot} normal force [N]" for robot in robots]
    header += [f"{robot} wrench {name}" for robot in robots for name in _WRENCH]
    columns += [sampled.normal_force, sampled.wrench.reshape(len(sampled.time), -1)]
    if job.follower is None:
        header += [f"{robot} grip output [0 or 1]" for robot in robots]
        columns += [export.gripped[:, None]] * 2
    table = np.concatenate(columns, axis=1).tolist()
    rows = zip(sampled.time.tolist(), sampled.phase_names, table, strict=True)
    return csv_text(header, ([time, phase, *row] for time, phase, row in rows))


RECORDED = (
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/WrenchStamped",
    "tf2_msgs/msg/TFMessage",
    "std_msgs/msg/String",
    "std_msgs/msg/Bool",
)
"""Message types in a recording."""


def recording(export: Export) -> dict[str, str | bytes]:
    """Return the files of a ROS 2 recording of a job by path. Its time stamps begin at zero.

    If the optional packages `ros` of this project are not installed, the result is only a note on
    how to install them.
    """
    try:
        from mcap.writer import Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        return {"no-recording.txt": "job.mcap needs: pip install 'dual-arm-carry[ros]'\n"}
    store, file = get_typestore(Stores.ROS2_JAZZY), io.BytesIO()
    writer: Any = Writer(file)
    writer.start(profile="ros2", library="dual-arm-carry")
    schemas = {
        name: writer.register_schema(
            name, "ros2msg", store.generate_msgdef(name, ros_version=2)[0].encode()
        )
        for name in RECORDED
    }
    channels: dict[str, int] = {}
    for stamp, topic, message in _messages(export, store.types):
        kind = message.__msgtype__
        if topic not in channels:
            channels[topic] = writer.register_channel(topic, "cdr", schemas[kind])
        content = bytes(store.serialize_cdr(message, kind))
        writer.add_message(channels[topic], stamp, content, stamp)
    writer.finish()
    return {"job.mcap": file.getvalue()}


def _messages(export: Export, types: Mapping[str, Any]) -> Iterator[tuple[int, str, Any]]:
    """Yield time [ns], topic and message of every sample. `types` has the ROS message classes by
    name.
    """
    sampled, cell, joined = export.sampled, export.workcell, prefixes(export.workcell)
    joints = ros_joints(cell)
    places = list(joints.values())
    wrenches = [pad_wrench(sampled, arm) for arm in (0, 1)]
    begins = {sampled.span(k).start: phase.name for k, phase in enumerate(sampled.job.phases)}
    models = [arm_model(robot) for robot in cell.robots]
    data = [model.createData() for model in models]
    boxes = box_placement(cell.task.orientation, sampled.pose)

    def of(kind: str, *values: Any) -> Any:
        """Build a ROS message of the type `kind` from its fields, in order."""
        package, name = kind.split("/")
        return types[f"{package}/msg/{name}"](*values)

    def frames(k: int) -> Iterator[tuple[str, Array]]:
        """Yield the name of each frame and its pose (4, 4) in the world at sample k: the box, every
        link of both arms, and both pads."""
        yield "box", boxes[k]
        for arm, robot in enumerate(cell.robots):
            model, found, prefix = models[arm], data[arm], joined[arm]
            pin.framesForwardKinematics(model, found, sampled.arm(arm, sampled.q)[k])
            for frame, pose in zip(model.frames, found.oMf, strict=True):
                if frame.type == pin.FrameType.BODY and not (arm and not prefix):
                    yield f"{prefix}{frame.name}", robot.T_world_base @ pose.homogeneous
            flange = found.oMf[link_frame(model, robot.flange)].homogeneous
            yield pad_frame(prefix, arm), robot.T_world_base @ flange @ robot.T_flange_pad

    names = [name for name, _ in frames(0)]
    T = np.array([[pose for _, pose in frames(k)] for k in range(len(sampled.time))])
    # All at once: SciPy takes a hundred times as long for the same matrices one by one.
    turns = Rotation.from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat()
    poses = np.concatenate([T[..., :3, 3], turns.reshape(*T.shape[:2], 4)], axis=2).tolist()

    def placed(kind: str, pose: list[float]) -> tuple[Any, Any]:
        """Convert a pose, position [m] and quaternion x, y, z, w, to two ROS messages; `kind` is
        the position's type in `geometry_msgs`."""
        turn = of("geometry_msgs/Quaternion", *pose[3:])
        return of(f"geometry_msgs/{kind}", *pose[:3]), turn

    for k, seconds in enumerate(sampled.time.tolist()):
        stamp = round(seconds * 1e9)
        if k == 0:
            yield (
                stamp,
                "/robot_description",
                of("std_msgs/String", description(cell, sampled.q[0])),
            )
        if k in begins:
            yield stamp, "/phase", of("std_msgs/String", begins[k])
        if begins.get(k) in SWITCHES:
            for arm, prefix in enumerate(joined):
                topic = f"/{pad_frame(prefix, arm)}/grip_output"
                yield stamp, topic, of("std_msgs/Bool", SWITCHES[begins[k]])
        time = of("builtin_interfaces/Time", *divmod(stamp, 10**9))
        world = of("std_msgs/Header", time, WORLD)
        rows = (each[k, places] for each in (sampled.q, sampled.q_rate, export.effort))
        yield stamp, "/joint_states", of("sensor_msgs/JointState", world, list(joints), *rows)
        box = of("geometry_msgs/Pose", *placed("Point", poses[k][0]))
        yield stamp, "/box_pose", of("geometry_msgs/PoseStamped", world, box)
        for arm, prefix in enumerate(joined):
            frame = pad_frame(prefix, arm)
            parts = np.split(wrenches[arm][k], 2)
            vectors = [of("geometry_msgs/Vector3", *part.tolist()) for part in parts]
            header = of("std_msgs/Header", time, frame)
            wrench = of("geometry_msgs/WrenchStamped", header, of("geometry_msgs/Wrench", *vectors))
            yield stamp, f"/{frame}/wrench_reference", wrench
        transforms = []
        for name, pose in zip(names, poses[k], strict=True):
            moved = of("geometry_msgs/Transform", *placed("Vector3", pose))
            transforms.append(of("geometry_msgs/TransformStamped", world, name, moved))
        yield stamp, "/tf", of("tf2_msgs/TFMessage", transforms)


def pad_wrench(sampled: SampledJob, arm: int) -> Array:
    """Compute the force and moment (n, 6) [N, N m] that a robot's pad exerts on the box, about the
    pad's centre along the pad's axes."""
    T_box_pad = sampled.job.workcell.contacts[arm].T_box_pad
    turned = box_rotation(sampled.job.workcell.task.orientation, sampled.pose)
    R_world_pad = turned @ T_box_pad[:3, :3]
    both = sampled.wrench[:, arm].reshape(-1, 2, 3)
    return np.asarray(np.einsum("nji,nkj->nki", R_world_pad, both).reshape(-1, 6))
