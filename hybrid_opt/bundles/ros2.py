"""Jobs for ROS 2: one controller for both arms of any cell, and the drivers of Franka and UR;
and as an MCAP recording with its messages, for Foxglove, rviz and rosbag2.

Facts about controllers and drivers are those of their sources: joint_trajectory_controller of
ros2_controllers, franka_ros2, ur_robot_driver and its ur_controllers. docs/export.md lists them.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles.arms import (
    WORLD,
    described,
    description,
    pad_frame,
    prefixes,
    ros_joints,
)
from hybrid_opt.bundles.job_file import Export, job_text
from hybrid_opt.bundles.programs import filled, program
from hybrid_opt.errors import ResultsError
from hybrid_opt.job.records import Job, SampledJob
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.arms import arm_model, link_frame
from symbolic.records.poses import box_placement, box_rotation

UPDATE_RATE = 1000
"""Rate of a controller manager [Hz], unless the driver says otherwise."""

GAIN, DAMPING = 7.0, 0.7
"""Gains of Franka's joints: stiffness over largest torque [1/rad], and damping over the root of the
stiffness; about those of the maker's own examples."""

TORQUE_RATE = 1000.0
"""Fastest change of a torque that libfranka takes [N m/s] (kMaxTorqueRate)."""

CONTACT, SPARE_FORCE, SPARE_TORQUE = 1.5, 20.0, 5.0
"""A collision exceeds this multiple of the planned contact by this force [N] or torque [N m]."""

UR_RATE = 500
"""Rate of an e-series controller [Hz]."""

FORCE_EVERY = 0.1
"""Time between two force references of a UR [s]: each is a call of a service."""

UR_LAG = 0.05
"""Delay of a UR behind what its driver reports, where the workcell does not say [s]."""


def control_files(export: Export) -> dict[str, str | bytes]:
    """One joint trajectory controller for all joints, with mock hardware in the description."""
    rates = [r.driver.rate for r in export.workcell.robots if r.driver.rate is not None]
    controllers, driven = "config/controllers.yaml", "carry_controller"
    config = {
        "effort": "with_gravity",
        "groups": [{"action": f"/{driven}/follow_joint_trajectory", "arms": [0, 1]}],
        "joint_states": ["/joint_states"],
        "wrench": [None, None],
        "launch": [
            {
                "namespace": "",
                "parameters": [controllers],
                "controllers": ["joint_state_broadcaster", driven],
            }
        ],
    }
    return {
        **_programs(export, config, "control"),
        "description/cell.urdf": description(export.workcell, export.sampled.q[0]),
        controllers: filled(
            "controllers_control.yaml",
            rate=round(min(rates, default=UPDATE_RATE)),
            joints=json.dumps(list(ros_joints(export.workcell))),
        ),
    }


def require_franka(job: Job) -> None:
    """Refuse joints that franka_ros2 does not know."""
    for robot, joints in zip(job.workcell.robots, job.joint_names, strict=True):
        if not _franka_type(joints):
            raise SettingsError(
                f"the joints of {robot.name!r} are called {joints[0]!r} ... {joints[-1]!r}; "
                "franka_ros2 knows TYPE_joint1 to TYPE_joint7"
            )


def franka_files(export: Export) -> dict[str, str | bytes]:
    """Per arm a joint trajectory controller that commands torques without gravity.

    Raises:
        SettingsError: a torque changes faster than libfranka takes.
    """
    rate = np.abs(np.diff(export.sampled.effort - export.gravity, axis=0))
    rate /= np.diff(export.sampled.time)[:, None]
    if rate.max() > TORQUE_RATE:
        raise SettingsError(
            f"a joint torque changes by {rate.max():.0f} N m/s; libfranka takes "
            f"{TORQUE_RATE:.0f}: limit the jerk (jerk_max), or choose a slower timing"
        )
    values = []
    for arm, robot in enumerate(export.workcell.robots):
        load = robot.tool_load
        inertia = np.zeros((3, 3)) if load is None else load.inertia
        torque, (force, moment) = _contact(export.job, arm)
        forces = [CONTACT * force + SPARE_FORCE] * 3 + [CONTACT * moment + SPARE_TORQUE] * 3
        gains = zip(export.ros_joints(arm), (GAIN * robot.torque_max).tolist(), strict=True)
        values.append(
            {
                "kind": _franka_type(export.job.joint_names[arm]),
                "inertia": inertia.T.ravel().tolist(),
                "torques": (CONTACT * torque + SPARE_TORQUE).tolist(),
                "forces": forces,
                "gains": json.dumps({j: {"p": p, "d": DAMPING * p**0.5} for j, p in gains}),
            }
        )
    return _driver_files(export, "franka", "without_gravity", values)


def _franka_type(joints: Sequence[str]) -> str:
    """The TYPE of joints TYPE_joint1 ...; '' where they are called otherwise."""
    found = {re.sub(r"_joint[1-7]$", "", name) for name in joints}
    (kind,) = found if len(found) == 1 else ("",)
    return kind if list(joints) == [f"{kind}_joint{k}" for k in range(1, 8)] else ""


def _contact(job: Job, arm: int) -> tuple[Array, tuple[float, float]]:
    """The most of contact: of each joint (n_joints,) [N m], force [N] and moment [N m]."""
    first = len(job.joint_names[0])
    span = slice(0, first) if arm == 0 else slice(first, None)
    torque = [np.abs(p.motion.contact_effort(p.force.wrench)[:, span]).max(0) for p in job.phases]
    wrench = np.concatenate([phase.force.wrench[:, arm] for phase in job.phases])
    size = [float(np.linalg.norm(part, axis=1).max()) for part in (wrench[:, :3], wrench[:, 3:])]
    return np.max(torque, axis=0), (size[0], size[1])


def ur_files(export: Export) -> dict[str, str | bytes]:
    """Per arm the whole path passed through to the controller; the follower in force mode."""
    values = []
    for arm, robot in enumerate(export.workcell.robots):
        found = re.search(r"(?<![a-z0-9])ur\d+e?(?![a-z0-9])", described(robot))
        mass, centre = export.carried(arm, loaded=True)
        # Force mode is compliant along z of the pad, into the box, alone.
        turn = Rotation.from_matrix(robot.T_flange_pad[:3, :3]).as_quat().tolist()
        place = dict(zip("xyz", robot.T_flange_pad[:3, 3].tolist(), strict=True))
        values.append(
            {
                "kind": found.group() if found else "ur10e",
                "flange": robot.flange,
                "loaded_mass": mass,
                "loaded_centre": centre.tolist(),
                "position": json.dumps(place),
                "orientation": json.dumps(dict(zip("xyzw", turn, strict=True))),
                "force_every": FORCE_EVERY,
                "rate": round(robot.driver.rate or UR_RATE),
            }
        )
    lag = max(robot.driver.lag or UR_LAG for robot in export.workcell.robots)
    return _driver_files(export, "ur", "", values, lag=lag)


def _driver_files(
    export: Export, driver: str, effort: str, values: Sequence[dict[str, Any]], **more: Any
) -> dict[str, str | bytes]:
    """The files for a driver per arm: its part of `config/cell.json`, and its controllers.

    Args:
        effort: which efforts go with the positions; see `run_job.py`.
        values: by arm those of the driver's templates that no other driver has.
        more: settings of `config/cell.json`.
    """
    cell, joined, files = export.workcell, prefixes(export.workcell), dict[str, str | bytes]()
    spaces = [prefix.rstrip("_") for prefix in joined]
    if not all(spaces) or spaces[0] == spaces[1]:
        spaces = ["arm_1", "arm_2"]
    config: dict[str, Any] = {"effort": effort}
    for arm, robot in enumerate(cell.robots):
        mass, centre = export.carried(arm, loaded=False)
        known = values[arm] | {
            "arm": arm,
            "number": arm + 1,
            "space": spaces[arm],
            "prefix": joined[arm],
            "address": json.dumps(robot.driver.address),
            "axis": robot.T_flange_pad[:3, 2].tolist(),
            "mass": mass,
            "centre": centre.tolist(),
            "centre_of_gravity": json.dumps(dict(zip("xyz", centre.tolist(), strict=True))),
            "joints": json.dumps(export.ros_joints(arm)),
        }
        for name, entries in json.loads(filled(f"cell_{driver}.json", **known)).items():
            if name != "force" or arm == export.follower:
                config[name] = config.get(name, []) + entries
        files[f"config/controllers_{arm + 1}.yaml"] = filled(f"controllers_{driver}.yaml", **known)
    return _programs(export, config | more, driver) | files


def _programs(export: Export, config: dict[str, Any], launch: str) -> dict[str, str | bytes]:
    """The job, the programs that run it, and `config/cell.json`, which they read."""
    nothing: dict[str, Any] = {"prepare": [], "force": [], "payload": [], "sliders": []}
    usual = {"stamped": bool(config["effort"]), "lag": export.lag, "step": export.step, **nothing}
    return {
        "job.json": job_text(export),
        "config/cell.json": json.dumps(usual | config, indent=1, allow_nan=False) + "\n",
        "run_job.py": program("run_job.py"),
        "carry_job.py": program("carry_job.py"),
        f"launch/{launch}.launch.py": program("cell.launch.py"),
    }


RECORDED = (
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/WrenchStamped",
    "tf2_msgs/msg/TFMessage",
    "std_msgs/msg/String",
)
"""Types of the messages of a recording."""


def mcap_files(export: Export) -> dict[str, str | bytes]:
    """One recording; times count from zero.

    Raises:
        ResultsError: the packages that write it are not installed.
    """
    try:
        from mcap.writer import Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ResultsError(
            "the packages mcap and rosbags are not installed: pip install 'dual-arm-carry[ros]'"
        ) from error
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
    """Every sample's messages, of these types, with their times [ns] and topics."""
    sampled, cell, joined = export.sampled, export.workcell, prefixes(export.workcell)
    joints = ros_joints(cell)
    places = list(joints.values())
    wrenches = [pad_wrench(sampled, arm) for arm in (0, 1)]
    begins = {sampled.span(k).start: phase.name for k, phase in enumerate(sampled.job.phases)}
    models = [arm_model(robot) for robot in cell.robots]
    data = [model.createData() for model in models]
    boxes = box_placement(cell.task.orientation, sampled.pose)

    def of(kind: str, *values: Any) -> Any:
        """A message, of its fields in order."""
        package, name = kind.split("/")
        return types[f"{package}/msg/{name}"](*values)

    def placed(kind: str, T: Array) -> tuple[Any, Any]:
        """Position, as a message of a kind, and quaternion of a pose (4, 4)."""
        turn = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        position = of(f"geometry_msgs/{kind}", *T[:3, 3].tolist())
        return position, of("geometry_msgs/Quaternion", *turn)

    def frames(k: int) -> Iterator[tuple[str, Array]]:
        """The box, every link of both arms and both pads with their poses (4, 4) in the world."""
        yield "box", boxes[k]
        for arm, robot in enumerate(cell.robots):
            model, found, prefix = models[arm], data[arm], joined[arm]
            pin.framesForwardKinematics(model, found, sampled.arm(arm, sampled.q)[k])
            for frame, pose in zip(model.frames, found.oMf, strict=True):
                if frame.type == pin.FrameType.BODY and not (arm and not prefix):
                    yield f"{prefix}{frame.name}", robot.T_world_base @ pose.homogeneous
            flange = found.oMf[link_frame(model, robot.flange)].homogeneous
            yield pad_frame(prefix, arm), robot.T_world_base @ flange @ robot.T_flange_pad

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
        time = of("builtin_interfaces/Time", *divmod(stamp, 10**9))
        world = of("std_msgs/Header", time, WORLD)
        rows = (each[k, places] for each in (sampled.q, sampled.q_rate, export.effort))
        yield stamp, "/joint_states", of("sensor_msgs/JointState", world, list(joints), *rows)
        box = of("geometry_msgs/Pose", *placed("Point", boxes[k]))
        yield stamp, "/box_pose", of("geometry_msgs/PoseStamped", world, box)
        for arm, prefix in enumerate(joined):
            frame = pad_frame(prefix, arm)
            parts = np.split(wrenches[arm][k], 2)
            vectors = [of("geometry_msgs/Vector3", *part.tolist()) for part in parts]
            header = of("std_msgs/Header", time, frame)
            wrench = of("geometry_msgs/WrenchStamped", header, of("geometry_msgs/Wrench", *vectors))
            yield stamp, f"/{frame}/wrench_reference", wrench
        transforms = []
        for name, pose in frames(k):
            moved = of("geometry_msgs/Transform", *placed("Vector3", pose))
            transforms.append(of("geometry_msgs/TransformStamped", world, name, moved))
        yield stamp, "/tf", of("tf2_msgs/TFMessage", transforms)


def pad_wrench(sampled: SampledJob, arm: int) -> Array:
    """(n, 6) force and moment that a pad exerts on the box, along the pad's axes [N, N m]."""
    T_box_pad = sampled.job.workcell.contacts[arm].T_box_pad
    turned = box_rotation(sampled.job.workcell.task.orientation, sampled.pose)
    R_world_pad = turned @ T_box_pad[:3, :3]
    both = sampled.wrench[:, arm].reshape(-1, 2, 3)
    return np.asarray(np.einsum("nji,nkj->nki", R_world_pad, both).reshape(-1, 6))
