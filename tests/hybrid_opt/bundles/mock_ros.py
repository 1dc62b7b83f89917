"""A stand-in for ROS 2 in which `run_job.py` runs as it is: controllers in simulated time.

Controllers after their sources and pages: joint_trajectory_controller of ros2_controllers
(`validate_trajectory_msg`, `Trajectory::sample`, `set_success_trajectory_point`,
`set_hold_position`), the passthrough trajectory and force mode controllers of ur_controllers
("Action interface", "Service interface"). Arms follow their commands at once.
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

SERVICES: Mapping[str, set[str]] = {
    "std_srvs/srv/Trigger": set(),
    "ur_msgs/srv/SetPayload": {
        "mass",
        "center_of_gravity",
        *(f"i{a}" for a in ("xx", "yy", "zz", "xy", "xz", "yz")),
        "transition_time",
    },
    "ur_msgs/srv/SetSpeedSliderFraction": {"speed_slider_fraction"},
    "ur_msgs/srv/SetForceMode": {
        "task_frame",
        *(f"selection_vector_{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz")),
        "wrench",
        "type",
        "speed_limits",
        "deviation_limits",
        "damping_factor",
        "gain_scaling",
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
    """A joint trajectory controller; `passes` for one that passes its goal through to a UR."""

    def __init__(
        self, world: World, joints: list[str], q: Array, effort: bool, passes: bool
    ) -> None:
        self.world, self.joints, self.passes = world, joints, passes
        self.has_effort = effort
        self.q, self.effort = q.copy(), np.zeros(len(q))
        self.held_effort = np.zeros(len(q))
        self.refuses = False
        self.aborts_at: float | None = None
        self.stands = np.zeros(len(q), dtype=bool)
        self._spline: BPoly | None = None
        self._times = np.zeros(1)
        self._rows: Array | None = None
        self._start = 0.0
        self._handle: SimpleNamespace | None = None
        self._passed, self.slider = 0.0, 1.0
        self._scale = 1.0

    def take(self, goal: Any) -> SimpleNamespace:
        """Accept or refuse a goal."""
        is_busy = self.passes and self._handle is not None
        handle = SimpleNamespace(accepted=not (self.refuses or is_busy) and self._takes(goal))
        if not handle.accepted:
            return handle
        if self._handle is not None:
            self._end(ABORTED, "Current goal preempted by new incoming action.")
        handle.result = Future[Any]()
        handle.get_result_async = lambda: handle.result
        handle.cancel_goal_async = lambda: self.cancel(handle)
        points, stamp = goal.trajectory.points, goal.trajectory.header.stamp
        order = [goal.trajectory.joint_names.index(name) for name in self.joints]

        def column(name: str) -> Array:
            return np.array([point[name] for point in points], dtype=float)[:, order]

        begin, self._times = seconds(stamp), times_of(points)
        known = np.stack([column(n) for n in ("positions", "velocities", "accelerations")], axis=1)
        self._spline = BPoly.from_derivatives(self._times, known)
        self._rows = column("effort") if self.has_effort else None
        self._start = begin or self.world.now
        if self.passes:
            assert not begin, "the passthrough controller knows no start"
            # One point per two cycles of 500 Hz.
            self._start, self._passed = self.world.now + 0.004 * len(points), 0.0
        self._handle = handle
        return handle

    def _takes(self, goal: Any) -> bool:
        """`validate_trajectory_msg`."""
        points = goal.trajectory.points
        known = ("positions", "velocities", "accelerations")
        return (
            sorted(goal.trajectory.joint_names) == sorted(self.joints)
            and bool((np.diff(times_of(points)) > 0.0).all())
            and max(abs(v) for v in points[-1]["velocities"]) <= FLOAT_EPSILON
            and all(self.has_effort or not point.get("effort") for point in points)
            and {len(point[k]) for point in points for k in known} == {len(self.joints)}
        )

    def cancel(self, handle: SimpleNamespace) -> None:
        if self._handle is handle:
            self._end(CANCELED, "")
            self._hold()

    def _hold(self) -> None:
        """`set_hold_position`: where it is, with the efforts of the last success, or none."""
        self._spline, self.effort = None, self.held_effort.copy()

    def _end(self, status: int, told: str) -> None:
        handle, self._handle = self._handle, None
        assert handle is not None
        result = SimpleNamespace(error_code=0, error_string=told)
        handle.result.set_result(SimpleNamespace(status=status, result=result))

    def step(self) -> None:
        if self._spline is None or self.world.now < self._start:
            return
        if self.aborts_at is not None and self.world.now >= self.aborts_at:
            self.aborts_at = None
            self._end(ABORTED, "Aborted due to hardware")
            self._hold()
            return
        time = self.world.now - self._start
        if self.passes:
            self._scale += np.clip(self.slider - self._scale, -STEP / 0.2, STEP / 0.2)
            self._passed += STEP * self._scale
            time = self._passed
        place = float(np.clip(time, self._times[0], self._times[-1]))
        wanted = np.asarray(self._spline(place))
        self.q = np.where(self.stands, self.q, wanted)
        if self._rows is not None:
            self.effort = np.array([np.interp(place, self._times, c) for c in self._rows.T])
        if time >= self._times[-1] and self._handle is not None:
            self.held_effort = self.effort.copy()
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
        record: per step the time and both arms' positions, efforts and force mode references.
    """

    def __init__(self, files: Contents, config: dict[str, Any]) -> None:
        job = json.loads(files["job.json"])
        self.now, self.log, self.record = 100.0, list[str](), list[tuple[Any, ...]]()
        self.at: list[tuple[float, int, Callable[[], None]]] = []
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.subscriptions: dict[str, list[Callable[[Any], None]]] = {}
        self.silent, self.offset, self.force = [False, False], [0.0, 0.0], [0.0, 0.0]
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
            passes, effort = "passthrough" in group["action"], bool(config["effort"])
            made = Controller(self, list(first), np.array(list(first.values())), effort, passes)
            self.controllers[group["action"]] = made
            for arm, robot in robots.items():
                self._arms[arm] = made, [made.joints.index(name) for name in robot["ros_joints"]]

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
            self.record.append((self.now, *both, list(self.force)))
            if self.now >= self._next_joints:
                self._next_joints += JOINTS_EVERY
                self._tell()

    def _tell(self) -> None:
        for arm, robot in enumerate(self._robots):
            if not self.silent[arm]:
                q = (self.q(arm) + self.offset[arm]).tolist()
                message = Message(name=robot["ros_joints"], position=q)
                topics = self._config["joint_states"]
                for heard in self.subscriptions[topics[arm if len(topics) > 1 else 0]]:
                    heard(message)

    def feel(self, arm: int, newton: float) -> None:
        """What a wrist sensor tells of a force along its pad."""
        source = self._config["wrench"][arm]
        force = Message(zip("xyz", (newton * value for value in source["axis"]), strict=True))
        for heard in self.subscriptions[source["topic"]]:
            heard(Message(wrench=Message(force=force)))

    def command(self, word: str) -> None:
        for heard in self.subscriptions["/carry/command"]:
            heard(Message(data=word))

    def interrupt(self) -> None:
        """Ctrl-C."""
        self.signals[signal.SIGINT](signal.SIGINT, None)

    def serve(self, name: str, kind: str, request: dict[str, Any]) -> None:
        """Answer a call; unknown fields are errors."""
        assert set(request) <= SERVICES[kind], (kind, set(request) - SERVICES[kind])
        self.calls.append((name, request))
        if kind.endswith("SetForceMode"):
            arm = self._config["force"][0]["arm"]
            self.force[arm] = request["wrench"]["force"]["z"]
        if name.endswith("stop_force_mode"):
            self.force = [0.0, 0.0]
        if kind.endswith("SliderFraction"):
            space = name.split("/")[1]
            self.controllers[
                f"/{space}/passthrough_trajectory_controller/follow_joint_trajectory"
            ].slider = request["speed_slider_fraction"]


def fill(message: Message, values: Mapping[str, Any]) -> None:
    """`set_message_fields`, with plain values in place of deeper messages."""
    for name, value in values.items():
        message[name] = Message(value) if isinstance(value, dict) else value
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
            world.serve(self.name, self.kind, request)
            return answered(lambda: SimpleNamespace(success=True))

    class Node:
        def create_subscription(self, kind: Any, topic: str, heard: Any, depth: int) -> None:
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
        return SimpleNamespace(Request=Message, kind=kind)

    contents: dict[str, dict[str, Any]] = {
        "rclpy": {
            "init": lambda **_: None,
            "shutdown": lambda: None,
            "create_node": lambda name: Node(),
            "spin_once": spin_once,
        },
        "rclpy.action": {"ActionClient": ActionClient},
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
