"""Jobs for ROS 2: one controller for both arms of any cell, and the drivers of Franka and UR;
and as an MCAP recording with its messages, for Foxglove, rviz and rosbag2.

Facts about controllers and drivers are those of their sources: joint_trajectory_controller of
ros2_controllers, franka_ros2, ur_robot_driver and its ur_controllers. docs/export.md lists them.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterator, Sequence
from string import Template
from types import ModuleType
from typing import Any

import numpy as np
import pinocchio as pin
import yaml
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles.arms import COMMANDS, WORLD, described, description, pad_frame, prefixes
from hybrid_opt.bundles.job_file import Export, job_text
from hybrid_opt.bundles.programs import program
from hybrid_opt.errors import ResultsError
from hybrid_opt.job.records import Job, SampledJob
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.arms import arm_model, link_frame
from symbolic.records import Workcell
from symbolic.records.poses import box_placement, box_rotation

CONTROLLER = "carry_controller"
TRAJECTORY_CONTROLLER = "joint_trajectory_controller/JointTrajectoryController"
BROADCASTER = "joint_state_broadcaster"
FRANKA_STATE = "franka_robot_state_broadcaster"
ACTION = "follow_joint_trajectory"

UPDATE_RATE = 1000
"""Rate of a controller manager [Hz], unless the driver says otherwise."""

MONITOR_RATE = 100.0
"""Rate at which a controller checks whether its goal has ended [Hz]."""

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

FORCE_DAMPING, FORCE_GAIN = 0.1, 0.5
"""Parameters of UR's force mode: more damping than its default of 0.025, the default gain."""

FORCE_SPEED, DEVIATION = 0.05, 0.02
"""Largest speed along the normal [m/s], largest deviation across it [m], [rad]."""

UR_LAG = 0.05
"""Delay of a UR behind what its driver reports, where the workcell does not say [s]."""


# --- one controller for both arms ---


def control_files(export: Export) -> dict[str, str | bytes]:
    """One joint trajectory controller for all joints, with mock hardware in the description."""
    joints = [*export.ros_joints(0), *export.ros_joints(1)]
    rates = [r.driver.rate for r in export.workcell.robots if r.driver.rate is not None]
    config = _config(export, "with_gravity", stamped=True) | {
        "groups": [{"action": f"/{CONTROLLER}/{ACTION}", "arms": [0, 1]}],
        "joint_states": ["/joint_states"],
    }
    controllers = {
        "controller_manager": _manager(round(min(rates, default=UPDATE_RATE))),
        CONTROLLER: _trajectory_controller(joints, COMMANDS),
    }
    return {
        **_programs(export, config, "control.launch.py"),
        "description/cell.urdf": description(export.workcell, export.sampled.q[0]),
        "config/controllers.yaml": _yaml(controllers),
    }


def _manager(rate: int, **further: str) -> dict[str, Any]:
    kinds = {
        BROADCASTER: f"{BROADCASTER}/JointStateBroadcaster",
        CONTROLLER: TRAJECTORY_CONTROLLER,
        **further,
    }
    return {
        "ros__parameters": {
            "update_rate": rate,
            **{name: {"type": kind} for name, kind in kinds.items()},
        }
    }


def _trajectory_controller(
    joints: Sequence[str], commands: Sequence[str], gains: Sequence[float] = ()
) -> dict[str, Any]:
    """Parameters of a joint trajectory controller that never gives up by itself: what it holds then
    has the efforts of another place, or none. `run_job.py` looks after the arms."""
    parameters: dict[str, Any] = {
        "joints": list(joints),
        "command_interfaces": list(commands),
        "state_interfaces": ["position", "velocity"],
        "interpolate_from_desired_state": True,
        "allow_nonzero_velocity_at_trajectory_end": False,
        "action_monitor_rate": MONITOR_RATE,
        "constraints": {"stopped_velocity_tolerance": 0.0, "goal_time": 0.0},
    }
    if len(gains):
        parameters["gains"] = {
            joint: {"p": float(gain), "d": float(DAMPING * gain**0.5)}
            for joint, gain in zip(joints, gains, strict=True)
        }
    return {"ros__parameters": parameters}


# --- Franka ---


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
    _require_torque_rate(export)
    spaces = _namespaces(export.workcell)
    config = _config(export, "without_gravity", stamped=True) | {
        "groups": [
            {"action": f"/{space}/{CONTROLLER}/{ACTION}", "arms": [arm]}
            for arm, space in enumerate(spaces)
        ],
        "joint_states": [f"/{space}/franka/joint_states" for space in spaces],
        "wrench": [
            {
                "topic": f"/{space}/{FRANKA_STATE}/external_wrench_in_stiffness_frame",
                "axis": export.workcell.robots[arm].T_flange_pad[:3, 2].tolist(),
            }
            for arm, space in enumerate(spaces)
        ],
        "prepare": [
            call for arm, space in enumerate(spaces) for call in _franka(export, arm, space)
        ],
    }
    for driver, joints in zip(config["drivers"], export.job.joint_names, strict=True):
        driver["type"] = _franka_type(joints)
    files = dict(_programs(export, config, "franka.launch.py"))
    for arm, robot in enumerate(export.workcell.robots):
        state = {FRANKA_STATE: f"{FRANKA_STATE}/FrankaRobotStateBroadcaster"}
        gains = (GAIN * robot.torque_max).tolist()
        controllers = {
            "/**": {
                "controller_manager": _manager(UPDATE_RATE, **state),
                CONTROLLER: _trajectory_controller(export.ros_joints(arm), ["effort"], gains),
            }
        }
        files[f"config/controllers_{arm + 1}.yaml"] = _yaml(controllers)
    return files


def _franka_type(joints: Sequence[str]) -> str:
    """The TYPE of joints TYPE_joint1 ...; '' where they are called otherwise."""
    found = {re.sub(r"_joint[1-7]$", "", name) for name in joints}
    (kind,) = found if len(found) == 1 else ("",)
    return kind if list(joints) == [f"{kind}_joint{k}" for k in range(1, 8)] else ""


def _require_torque_rate(export: Export) -> None:
    torque = export.sampled.effort - export.gravity
    rate = np.abs(np.diff(torque, axis=0)) / np.diff(export.sampled.time)[:, None]
    if rate.max() > TORQUE_RATE:
        raise SettingsError(
            f"a joint torque changes by {rate.max():.0f} N m/s; libfranka takes "
            f"{TORQUE_RATE:.0f}: limit the jerk (jerk_max), or choose a slower timing"
        )


def _franka(export: Export, arm: int, space: str) -> list[dict[str, Any]]:
    """Settings of a Franka before it moves: its tool, and what is no collision."""
    mass, centre = export.carried(arm, loaded=False)
    load = export.workcell.robots[arm].tool_load
    inertia = np.zeros((3, 3)) if load is None else load.inertia
    torque, wrench = _contact(export.job, arm)
    torques = (CONTACT * torque + SPARE_TORQUE).tolist()
    forces = [float(CONTACT * wrench[0] + SPARE_FORCE)] * 3
    forces += [float(CONTACT * wrench[1] + SPARE_TORQUE)] * 3
    thresholds = {
        f"{end}_{what}_thresholds_{when}": values
        for what, values in (("torque", torques), ("force", forces))
        for when in ("acceleration", "nominal")
        for end in ("lower", "upper")
    }
    server = f"/{space}/service_server"
    return [
        {
            "name": f"{server}/set_load",
            "kind": "franka_msgs/srv/SetLoad",
            "request": {
                "mass": mass,
                "center_of_mass": centre.tolist(),
                "load_inertia": inertia.T.ravel().tolist(),
            },
        },
        {
            "name": f"{server}/set_full_collision_behavior",
            "kind": "franka_msgs/srv/SetFullCollisionBehavior",
            "request": thresholds,
        },
    ]


def _contact(job: Job, arm: int) -> tuple[Array, tuple[float, float]]:
    """The most of contact: of each joint (n_joints,) [N m], force [N] and moment [N m]."""
    first = len(job.joint_names[0])
    span = slice(0, first) if arm == 0 else slice(first, None)
    torque = [np.abs(p.motion.contact_effort(p.force.wrench)[:, span]).max(0) for p in job.phases]
    wrench = np.concatenate([phase.force.wrench[:, arm] for phase in job.phases])
    size = [float(np.linalg.norm(part, axis=1).max()) for part in (wrench[:, :3], wrench[:, 3:])]
    return np.max(torque, axis=0), (size[0], size[1])


# --- UR ---


def ur_files(export: Export) -> dict[str, str | bytes]:
    """Per arm the whole path passed through to the controller; the follower in force mode."""
    spaces, cell = _namespaces(export.workcell), export.workcell
    config = _config(export, "", stamped=False)
    lags = [robot.driver.lag or UR_LAG for robot in cell.robots]
    follower, space = export.follower, spaces[export.follower]
    config |= {
        "lag": max(lags),
        "groups": [
            {"action": f"/{each}/passthrough_trajectory_controller/{ACTION}", "arms": [arm]}
            for arm, each in enumerate(spaces)
        ],
        "joint_states": [f"/{each}/joint_states" for each in spaces],
        "wrench": [
            {
                "topic": f"/{each}/force_torque_sensor_broadcaster/ft_data",
                "axis": cell.robots[arm].T_flange_pad[:3, 2].tolist(),
            }
            for arm, each in enumerate(spaces)
        ],
        "prepare": [
            call
            for arm, each in enumerate(spaces)
            for call in (
                _payload_call(export, arm, each),
                {
                    "name": f"/{each}/io_and_status_controller/zero_ftsensor",
                    "kind": "std_srvs/srv/Trigger",
                    "request": {},
                },
            )
        ],
        "force": [
            {
                "arm": follower,
                "every": FORCE_EVERY,
                "name": f"/{space}/force_mode_controller/start_force_mode",
                "end": f"/{space}/force_mode_controller/stop_force_mode",
                "type": "ur_msgs/srv/SetForceMode",
                "request": _force_mode(export, follower),
            }
        ],
        "payload": [
            {
                "arm": arm,
                "name": f"/{each}/io_and_status_controller/set_payload",
                "type": "ur_msgs/srv/SetPayload",
                "empty": _carried(export, arm, loaded=False),
                "loaded": _carried(export, arm, loaded=True),
            }
            for arm, each in enumerate(spaces)
        ],
        "sliders": [
            {
                "name": f"/{each}/io_and_status_controller/set_speed_slider",
                "type": "ur_msgs/srv/SetSpeedSliderFraction",
            }
            for each in spaces
        ],
    }
    for driver, robot in zip(config["drivers"], cell.robots, strict=True):
        found = re.search(r"(?<![a-z0-9])ur\d+e?(?![a-z0-9])", described(robot))
        driver["type"] = found.group() if found else "ur10e"
    files = dict(_programs(export, config, "ur.launch.py"))
    for arm, each in enumerate(spaces):
        files[f"config/controllers_{arm + 1}.yaml"] = _ur_controllers(export, arm, each)
    return files


def _ur_controllers(export: Export, arm: int, space: str) -> str:
    return Template(program("controllers_ur.yaml")).substitute(
        space=space,
        prefix=prefixes(export.workcell)[arm],
        rate=round(export.workcell.robots[arm].driver.rate or UR_RATE),
        joints=json.dumps(export.ros_joints(arm)),
    )


def _force_mode(export: Export, arm: int) -> dict[str, Any]:
    """A ur_msgs/srv/SetForceMode request: compliant along z of the pad, into the box, alone."""
    robot = export.workcell.robots[arm]
    prefix = prefixes(export.workcell)[arm]
    turn = Rotation.from_matrix(robot.T_flange_pad[:3, :3]).as_quat().tolist()
    axes = ("x", "y", "z", "rx", "ry", "rz")
    return {
        "task_frame": {
            "header": {"frame_id": f"{prefix}{robot.flange}"},
            "pose": {
                "position": dict(zip("xyz", robot.T_flange_pad[:3, 3].tolist(), strict=True)),
                "orientation": dict(zip("xyzw", turn, strict=True)),
            },
        },
        **{f"selection_vector_{axis}": axis == "z" for axis in axes},
        "type": 2,
        "speed_limits": {"linear": {"z": FORCE_SPEED}},
        "deviation_limits": [DEVIATION] * 6,
        "damping_factor": FORCE_DAMPING,
        "gain_scaling": FORCE_GAIN,
    }


def _payload_call(export: Export, arm: int, space: str) -> dict[str, Any]:
    mass, centre = export.carried(arm, loaded=False)
    request = {"mass": mass, "center_of_gravity": dict(zip("xyz", centre.tolist(), strict=True))}
    name = f"/{space}/io_and_status_controller/set_payload"
    return {"name": name, "kind": "ur_msgs/srv/SetPayload", "request": request}


# --- what all have ---


def _config(export: Export, effort: str, stamped: bool) -> dict[str, Any]:
    """What `run_job.py` reads beside the job; see there."""
    cell = export.workcell
    return {
        "effort": effort,
        "stamped": stamped,
        "lag": export.lag,
        "step": export.step,
        "wrench": [None, None],
        "prepare": [],
        "force": [],
        "payload": [],
        "sliders": [],
        "drivers": [
            {
                "robot": robot.name,
                "address": robot.driver.address,
                "namespace": space,
                "prefix": prefix,
            }
            for robot, space, prefix in zip(
                cell.robots, _namespaces(cell), prefixes(cell), strict=True
            )
        ],
    }


def _programs(export: Export, config: dict[str, Any], launch: str) -> dict[str, str | bytes]:
    return {
        "job.json": job_text(export),
        "config/cell.json": json.dumps(config, indent=1, allow_nan=False) + "\n",
        "run_job.py": program("run_job.py"),
        "carry_job.py": program("carry_job.py"),
        f"launch/{launch}": program(launch),
    }


def _namespaces(workcell: Workcell) -> list[str]:
    """A namespace per arm."""
    names = [prefix.rstrip("_") for prefix in prefixes(workcell)]
    return names if all(names) and names[0] != names[1] else ["arm_1", "arm_2"]


def _carried(export: Export, arm: int, loaded: bool) -> dict[str, Any]:
    mass, centre = export.carried(arm, loaded)
    return {"mass": mass, "centre": centre.tolist()}


def _yaml(document: Any) -> str:
    text: str = yaml.safe_dump(document, sort_keys=False, width=10_000)
    return text


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
        for name in RECORDED
    }
    channels: dict[str, int] = {}
    recording = _Recording(export, store)
    for k, time in enumerate(export.sampled.time.tolist()):
        stamp = round(time * 1e9)
        for topic, message in recording.messages(k, stamp):
            kind = message.__msgtype__
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schemas[kind])
            writer.add_message(
                channels[topic], stamp, bytes(store.serialize_cdr(message, kind)), stamp
            )
    writer.finish()
    return {"job.mcap": file.getvalue()}


RECORDED = (
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/WrenchStamped",
    "tf2_msgs/msg/TFMessage",
    "std_msgs/msg/String",
)
"""Types of the messages."""

Message = tuple[str, Any]
"""A message and its topic."""


class _Recording:
    """The messages of each sample, of a type store."""

    def __init__(self, export: Export, store: Any) -> None:
        self._types = store.types
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

    def _of(self, kind: str, *values: Any) -> Any:
        """A message, of its fields in order."""
        package, name = kind.split("/")
        return self._types[f"{package}/msg/{name}"](*values)

    def messages(self, k: int, stamp: int) -> Iterator[Message]:
        """Messages of sample k, at a time [ns]."""
        sampled, of = self._sampled, self._of
        if k == 0:
            yield "/robot_description", of("std_msgs/String", description(self._cell, sampled.q[0]))
        if k in self._begins:
            yield "/phase", of("std_msgs/String", self._begins[k])
        time = of("builtin_interfaces/Time", *divmod(stamp, 10**9))
        world = of("std_msgs/Header", time, WORLD)
        rows = (sampled.q[k], sampled.q_rate[k], sampled.effort[k])
        yield "/joint_states", of("sensor_msgs/JointState", world, self._joints, *rows)
        box = of("geometry_msgs/Pose", *self._placed("Point", self._boxes[k]))
        yield "/box_pose", of("geometry_msgs/PoseStamped", world, box)
        for arm, prefix in enumerate(self._prefixes):
            frame = pad_frame(prefix, arm)
            parts = np.split(self._wrenches[arm][k], 2)
            vectors = [of("geometry_msgs/Vector3", *part.tolist()) for part in parts]
            header, wrench = (
                of("std_msgs/Header", time, frame),
                of("geometry_msgs/Wrench", *vectors),
            )
            stamped = of("geometry_msgs/WrenchStamped", header, wrench)
            yield f"/{frame}/wrench_reference", stamped
        transforms = [
            of(
                "geometry_msgs/TransformStamped",
                world,
                name,
                of("geometry_msgs/Transform", *self._placed("Vector3", pose)),
            )
            for name, pose in (("box", self._boxes[k]), *self._frames(k))
        ]
        yield "/tf", of("tf2_msgs/TFMessage", transforms)

    def _placed(self, kind: str, T: Array) -> tuple[Any, Any]:
        """Position, as a message of a kind, and quaternion of a pose (4, 4)."""
        turn = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        position = self._of(f"geometry_msgs/{kind}", *T[:3, 3].tolist())
        return position, self._of("geometry_msgs/Quaternion", *turn)

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


def pad_wrench(sampled: SampledJob, arm: int) -> Array:
    """(n, 6) force and moment that a pad exerts on the box, along the pad's axes [N, N m]."""
    T_box_pad = sampled.job.workcell.contacts[arm].T_box_pad
    turned = box_rotation(sampled.job.workcell.task.orientation, sampled.pose)
    R_world_pad = turned @ T_box_pad[:3, :3]
    both = sampled.wrench[:, arm].reshape(-1, 2, 3)
    return np.asarray(np.einsum("nji,nkj->nki", R_world_pad, both).reshape(-1, 6))


def _packages() -> tuple[ModuleType, Any]:
    """Writer of recordings, and ROS 2's message types."""
    try:
        import mcap.writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ResultsError(
            "the packages mcap and rosbags are not installed: pip install 'dual-arm-carry[ros]'"
        ) from error
    module: ModuleType = mcap.writer
    return module, get_typestore(Stores.ROS2_JAZZY)
