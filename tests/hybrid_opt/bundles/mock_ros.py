"""A stand-in for ROS 2 in which `run_job.py` runs as it is: controllers in simulated time.

Rules after their sources: joint_trajectory_controller of ros2_controllers jazzy
(joint_trajectory_controller.cpp: goals of an inactive controller are rejected, :1401; what is
validated, :1740; a hold has no effort, :2083; trajectory.cpp: efforts are linear between points,
:296), libfranka (a load is set only while no motion runs), rosidl_runtime_py (set_message.py:
messages take the place of a list's dictionaries in the list itself). Arms follow their commands at
once; their sensors feel what the job's nearest sample presses.
"""

from __future__ import annotations

import heapq
import importlib.util
import json
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from rosbags.typesys import Stores, get_typestore
from scipy.interpolate import BPoly

from hybrid_opt.bundles.bundle import write_bundle
from hybrid_opt.bundles.job_file import Contents
from symbolic.array import Array

STEP = 0.005
"""Of the simulated world [s]."""

LONGEST = 200.0
"""A program that is not done by then, of a world that begins at 100 s, waits for ever [s]."""

JOINTS_EVERY = 0.01
"""Between two joint states [s]."""

SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
"""Of action_msgs/msg/GoalStatus."""

FLOAT_EPSILON = 1.1920929e-07

SERVICES: dict[str, set[str]] = {
    "std_srvs/srv/Trigger": set(),
    "controller_manager_msgs/srv/SwitchController": {
        "activate_controllers",
        "deactivate_controllers",
        "strictness",
        "activate_asap",
        "timeout",
    },
    # ur_msgs as driver 3.8 has it; that of 7.0 has a geometry_msgs/Inertia in place of the fields.
    "ur_msgs/srv/SetPayload": {
        "mass",
        "center_of_gravity",
        *(f"i{a}" for a in ("xx", "yy", "zz", "xy", "xz", "yz")),
        "transition_time",
    },
    "franka_msgs/srv/SetLoad": {"mass", "center_of_mass", "load_inertia"},
    "franka_msgs/srv/SetFullCollisionBehavior": {
        f"{end}_{what}_thresholds_{when}"
        for end in ("lower", "upper")
        for what in ("torque", "force")
        for when in ("acceleration", "nominal")
    },
}
"""Fields of the requests that a program may make."""

STORE = get_typestore(Stores.ROS2_JAZZY)


class Message(dict[str, Any]):
    """A message or a request by its fields; those that nobody set are empty messages."""

    def __getattr__(self, name: str) -> Any:
        return self.setdefault(name, Message())

    def __setattr__(self, name: str, value: Any) -> None:
        self[name] = value


class Controller:
    """A joint trajectory controller that commands efforts."""

    def __init__(self, world: World, joints: list[str], q: Array) -> None:
        self.world, self.joints = world, joints
        self.q, self.effort = q.copy(), np.zeros(len(q))
        self.is_active = self.refuses = False
        self.aborts_at: float | None = None
        self.stands = np.zeros(len(q), dtype=bool)
        self._spline: BPoly | None = None
        self._times = np.zeros(1)
        self._rows: Array | None = None
        self._start = 0.0
        self._handle: SimpleNamespace | None = None

    def take(self, goal: Any) -> SimpleNamespace:
        """Accept or refuse a goal."""
        handle = SimpleNamespace(accepted=self.is_active and not self.refuses and self._takes(goal))
        if not handle.accepted:
            return handle
        if self._handle is not None:
            self._end(CANCELED, "Current goal cancelled due to new incoming action.")
        handle.result = Future[Any]()
        handle.get_result_async = lambda: handle.result
        handle.cancel_goal_async = lambda: self.cancel(handle)
        points, stamp = goal.trajectory.points, goal.trajectory.header.stamp
        order = [goal.trajectory.joint_names.index(name) for name in self.joints]

        def column(name: str) -> Array:
            return np.array([point[name] for point in points], dtype=float)[:, order]

        self._start, times = seconds(stamp) or self.world.now, times_of(points)
        known = np.stack([column(n) for n in ("positions", "velocities", "accelerations")], axis=1)
        rows = column("effort")
        if len(times) == 1:
            # From where it is to a single point.
            here = np.stack([self.q, *np.zeros((2, len(self.q)))])
            times = np.array([self.world.now - self._start, *times])
            known, rows = np.stack([here, *known]), np.stack([self.effort, *rows])
        self._times, self._rows = times, rows
        self._spline = BPoly.from_derivatives(times, known)
        self._handle = handle
        return handle

    def _takes(self, goal: Any) -> bool:
        """`validate_trajectory_msg`."""
        points = goal.trajectory.points
        known = ("positions", "velocities", "accelerations", "effort")
        return (
            sorted(goal.trajectory.joint_names) == sorted(self.joints)
            and bool((np.diff(times_of(points)) > 0.0).all())
            and max(abs(v) for v in points[-1]["velocities"]) <= FLOAT_EPSILON
            and {len(point[k]) for point in points for k in known} == {len(self.joints)}
        )

    def cancel(self, handle: SimpleNamespace) -> None:
        if self._handle is handle:
            self._end(CANCELED, "")
            self._hold()

    def _hold(self) -> None:
        """`set_hold_position`: where it is, without effort."""
        self._spline, self.effort = None, np.zeros(len(self.q))

    def _end(self, status: int, told: str) -> None:
        handle, self._handle = self._handle, None
        assert handle is not None
        result = SimpleNamespace(error_code=0, error_string=told)
        handle.result.set_result(SimpleNamespace(status=status, result=result))

    def step(self) -> None:
        if self._spline is None or self.world.now < self._start + self._times[0]:
            return
        if self.aborts_at is not None and self.world.now >= self.aborts_at:
            self.aborts_at = None
            self._end(ABORTED, "Aborted due to hardware")
            self._hold()
            return
        time = self.world.now - self._start
        place = float(np.clip(time, self._times[0], self._times[-1]))
        wanted = np.asarray(self._spline(place))
        self.q = np.where(self.stands, self.q, wanted)
        if self._rows is not None:
            self.effort = np.array([np.interp(place, self._times, c) for c in self._rows.T])
        if time >= self._times[-1] and self._handle is not None:
            self._end(SUCCEEDED, "Goal successfully reached!")


def seconds(stamp: Mapping[str, int]) -> float:
    return stamp.get("sec", 0) + 1e-9 * stamp.get("nanosec", 0)


def times_of(points: list[dict[str, Any]]) -> Array:
    return np.array([seconds(point["time_from_start"]) for point in points])


class World:
    """Controllers, services and topics in simulated time.

    Attributes:
        now: [s].
        log: what the program told.
        at: what happens at which time: functions by time.
        record: per step the time and both arms' positions and efforts.
    """

    def __init__(self, files: Contents, config: dict[str, Any]) -> None:
        job = json.loads(files["job.json"])
        self.now, self.log, self.record = 100.0, list[str](), list[tuple[Any, ...]]()
        self.at: list[tuple[float, int, Callable[[], None]]] = []
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.subscriptions: dict[str, list[Callable[[Any], None]]] = {}
        self.silent, self.offset = [False, False], [0.0, 0.0]
        self.felt: list[float | None] = [0.0, 0.0]
        """Offset of each sensor [N]; None for one that is silent."""
        self.lateness = 0.0
        """Time between a measurement and its arrival [s]."""
        self.signals: dict[int, Callable[..., None]] = {}
        self._config, self._robots = config, job["robots"]
        self._next_joints = self.now
        self.controllers: dict[str, Controller] = {}
        self._arms: dict[int, tuple[Controller, list[int]]] = {}
        for group in config["groups"]:
            robots = {arm: self._robots[arm] for arm in group["arms"]}
            first: dict[str, float] = {}
            for robot in robots.values():
                first |= dict(zip(robot["ros_joints"], robot["position"][0], strict=True))
            made = Controller(self, list(first), np.array(list(first.values())))
            self.controllers[group["action"]] = made
            for arm, robot in robots.items():
                self._arms[arm] = made, [made.joints.index(name) for name in robot["ros_joints"]]
        self._samples = [
            (np.array(robot["position"]), np.array(robot["hold_effort_without_gravity"]))
            for robot in self._robots
        ]

    def later(self, after: float, what: Callable[[], None]) -> None:
        """Let something happen some time after now [s]."""
        heapq.heappush(self.at, (self.now + after, len(self.at), what))

    def of(self, arm: int) -> tuple[Controller, list[int]]:
        """An arm's controller, and the places of the arm's joints among its own."""
        return self._arms[arm]

    def q(self, arm: int) -> Array:
        controller, part = self.of(arm)
        return controller.q[part]

    def effort(self, arm: int) -> Array:
        controller, part = self.of(arm)
        return controller.effort[part]

    def run(self, until: float) -> None:
        """Let time pass."""
        while self.now < until - 1e-9:
            assert self.now < LONGEST, f"not done after {LONGEST:g} s: {self.log}"
            self.now += STEP
            while self.at and self.at[0][0] <= self.now:
                heapq.heappop(self.at)[2]()
            for controller in self.controllers.values():
                controller.step()
            both = [np.concatenate([each(0), each(1)]) for each in (self.q, self.effort)]
            self.record.append((self.now, *both))
            if self.now >= self._next_joints:
                self._next_joints += JOINTS_EVERY
                self._tell()

    def _tell(self) -> None:
        nanoseconds = round(self.now * 1e9)
        stamp = Message(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        told = list[tuple[str, Message]]()
        for arm, robot in enumerate(self._robots):
            header = Message(stamp=stamp)
            topics, source = self._config["joint_states"], self._config["wrench"][arm]
            if not self.silent[arm]:
                q = (self.q(arm) + self.offset[arm]).tolist()
                message = Message(header=header, name=robot["ros_joints"], position=q)
                told.append((topics[arm if len(topics) > 1 else 0], message))
            offset = self.felt[arm]
            if source is not None and offset is not None:
                newton = self.pressed(arm) + offset
                xyz = zip("xyz", (newton * value for value in source["axis"]), strict=True)
                wrench = Message(force=Message(xyz))
                told.append((source["topic"], Message(header=header, wrench=wrench)))

        def arrive() -> None:
            for topic, message in told:
                for heard in self.subscriptions.get(topic, []):
                    heard(message)

        self.later(self.lateness, arrive)

    def pressed(self, arm: int) -> float:
        """Normal force [N] of the job's sample whose posture and effort are the nearest."""
        q, effort = self._samples[arm]
        far = np.abs(q - self.q(arm)).max(axis=1) * 1e3
        far += np.abs(effort - self.effort(arm)).max(axis=1)
        return float(self._robots[arm]["normal_force"][int(np.argmin(far))])

    def command(self, word: str) -> None:
        for heard in self.subscriptions["/carry/command"]:
            heard(Message(data=word))

    def interrupt(self) -> None:
        """Ctrl-C."""
        self.signals[signal.SIGINT](signal.SIGINT, None)

    def serve(self, name: str, kind: str, request: dict[str, Any]) -> SimpleNamespace:
        """Answer a call; unknown fields are errors."""
        assert set(request) <= SERVICES[kind], (kind, set(request) - SERVICES[kind])
        self.calls.append((name, request))
        space = name.split("/")[1]
        own = [c for action, c in self.controllers.items() if action.startswith(f"/{space}/")]
        own = own or list(self.controllers.values())
        if kind.endswith("SwitchController"):
            for controller in own:
                controller.is_active = bool(request.get("activate_controllers"))
            return SimpleNamespace(ok=True)
        if kind.endswith("SetLoad") and any(controller.is_active for controller in own):
            return SimpleNamespace(success=False, error="command rejected: motion running")
        return SimpleNamespace(success=True)


def fill(message: Message, values: dict[str, Any]) -> None:
    """`set_message_fields`: messages take the place of a list's dictionaries in the list itself."""
    known = SERVICES.get(getattr(message, "kind", "")) if "kind" in message else None
    for name, value in values.items():
        if known is not None and name not in known:
            raise AttributeError(name)
        if isinstance(value, Message):
            raise TypeError(f"{name} is a message already: it was filled from these values before")
        if isinstance(value, list):
            for k, each in enumerate(value):
                if isinstance(each, Message):
                    raise TypeError(f"{name}[{k}] was filled from these values before")
                if isinstance(each, dict):
                    value[k] = Message()
                    fill(value[k], each)
            message[name] = value
        elif isinstance(value, dict):
            message[name] = Message()
            fill(message[name], value)
        else:
            message[name] = value
    if "trajectory" in values:
        checked(values["trajectory"], "trajectory_msgs/msg/JointTrajectory")


def checked(value: Mapping[str, Any], kind: str) -> None:
    """Refuse fields that ROS 2's own definition of a message does not have."""
    fields: dict[str, Any] = dict(STORE.get_msgdef(kind).fields)
    for name, inner in value.items():
        assert name in fields, f"{kind} has no {name}"
        sort, described = fields[name]
        if sort.name == "NAME":
            checked(inner, described)
        elif isinstance(inner, list) and inner and isinstance(inner[0], dict):
            for each in inner:
                checked(each, described[0][1])


def _modules(world: World) -> dict[str, ModuleType]:
    """What `run_job.py` imports of ROS 2."""

    def answered(answer: Callable[[], Any]) -> Future[Any]:
        future = Future[Any]()
        world.later(0.01, lambda: future.set_result(answer()))
        return future

    class Client:
        def __init__(self, kind: str, name: str) -> None:
            self.kind, self.name = kind, name

        def wait_for_service(self, timeout_sec: float) -> bool:
            return True

        def call_async(self, request: dict[str, Any]) -> Future[Any]:
            kind = request.pop("kind")
            return answered(lambda: world.serve(self.name, kind, request))

    class Node:
        def create_subscription(self, kind: Any, topic: str, heard: Any, quality: Any) -> None:
            world.subscriptions.setdefault(topic, []).append(heard)

        def create_client(self, service: Any, name: str) -> Client:
            return Client(service.kind, name)

        def get_clock(self) -> Any:
            nanoseconds = round(world.now * 1e9)
            return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=nanoseconds))

        def get_logger(self) -> Any:
            return SimpleNamespace(info=world.log.append, error=world.log.append)

    class ActionClient:
        def __init__(self, node: Any, kind: Any, name: str) -> None:
            self._controller = world.controllers[name]

        def wait_for_server(self, timeout_sec: float) -> bool:
            return True

        def send_goal_async(self, goal: Any) -> Future[Any]:
            return answered(lambda: self._controller.take(goal))

    def spin_once(node: Any, timeout_sec: float) -> None:
        # Time passes in any case.
        world.run(world.now + min(max(timeout_sec, STEP), 0.01))

    def service(kind: str) -> Any:
        assert kind in SERVICES, kind
        return SimpleNamespace(Request=lambda: Message(kind=kind), kind=kind)

    contents: dict[str, dict[str, Any]] = {
        "rclpy": {
            "init": lambda **_: None,
            "shutdown": lambda: None,
            "create_node": lambda name, parameter_overrides: Node(),
            "spin_once": spin_once,
        },
        "rclpy.action": {"ActionClient": ActionClient},
        "rclpy.parameter": {"Parameter": lambda name, value: (name, value)},
        "rclpy.qos": {
            "QoSProfile": SimpleNamespace,
            "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT="best effort"),
        },
        "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO=0)},
        "rosidl_runtime_py": {"set_message_fields": fill},
        "rosidl_runtime_py.utilities": {"get_service": service},
        "action_msgs.msg": {"GoalStatus": SimpleNamespace(STATUS_SUCCEEDED=SUCCEEDED)},
        "control_msgs.action": {"FollowJointTrajectory": SimpleNamespace(Goal=Message)},
        "geometry_msgs.msg": {"WrenchStamped": object},
        "sensor_msgs.msg": {"JointState": object},
        "std_msgs.msg": {"String": object},
    }
    packages = {name.partition(".")[0] for name in contents}
    found = {name: ModuleType(name) for name in (*packages, *contents)}
    for name, content in contents.items():
        vars(found[name]).update(content)
    return found


def run(
    files: Contents,
    folder: Path,
    prepare: Callable[[World], object] = lambda world: None,
    arguments: Sequence[str] = (),
) -> tuple[int, World]:
    """Run a bundle's `run_job.py`, unedited, from its folder; its exit code and its world.

    Args:
        prepare: what is to happen in the world.
    """
    write_bundle(folder, files, {})
    world = World(files, json.loads(files["config/cell.json"]))
    signals = SimpleNamespace(
        SIGINT=signal.SIGINT, SIGTERM=signal.SIGTERM, signal=world.signals.__setitem__
    )
    spec = importlib.util.spec_from_file_location("run_job_of_bundle", folder / "run_job.py")
    assert spec is not None
    assert spec.loader is not None
    program = importlib.util.module_from_spec(spec)
    with (
        patch.dict(sys.modules, _modules(world)),
        patch.object(sys, "path", [str(folder), *sys.path]),
    ):
        sys.modules.pop("carry_job", None)
        spec.loader.exec_module(program)
        vars(program)["signal"] = signals
        prepare(world)
        return program.main(arguments), world
