"""A stand-in for ROS 2 in which `run_job.py` runs as it is: controllers in simulated time.

Controllers after their sources and pages: joint_trajectory_controller of ros2_controllers
(`validate_trajectory_msg`, `Trajectory::sample`, `set_success_trajectory_point`,
`set_hold_position`), the passthrough trajectory and force mode controllers of ur_controllers
("Action interface", "Service interface"). Arms follow their commands at once.
"""

from __future__ import annotations

import heapq
import importlib.util
import itertools
import json
import sys
import types
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore
from scipy.interpolate import BPoly

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


class Future:
    """What is answered later."""

    def __init__(self) -> None:
        self._value: Any = None
        self._is_done = False
        self._told: list[Callable[[Future], None]] = []

    def set(self, value: Any) -> None:
        self._value, self._is_done = value, True
        for each in self._told:
            each(self)

    def done(self) -> bool:
        return self._is_done

    def result(self) -> Any:
        return self._value

    def add_done_callback(self, told: Callable[[Future], None]) -> None:
        self._told.append(told)
        if self._is_done:
            told(self)


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
        handle = SimpleNamespace(accepted=not self.refuses and not self._problem(goal))
        if self.passes and self._handle is not None:
            handle.accepted = False
        if not handle.accepted:
            return handle
        if self._handle is not None:
            self._end(ABORTED, "Current goal preempted by new incoming action.")
        handle.result = Future()
        handle.get_result_async = lambda: handle.result
        handle.cancel_goal_async = lambda: self.cancel(handle)
        points = goal["trajectory"]["points"]
        order = [goal["trajectory"]["joint_names"].index(name) for name in self.joints]

        def column(name: str) -> Array:
            return np.array([point[name] for point in points], dtype=float)[:, order]

        stamp = goal["trajectory"].get("header", {}).get("stamp", {"sec": 0, "nanosec": 0})
        begin = stamp["sec"] + 1e-9 * stamp["nanosec"]
        self._times = np.array(
            [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in points]
        )
        known = np.stack([column(n) for n in ("positions", "velocities", "accelerations")], axis=1)
        self._spline = BPoly.from_derivatives(self._times, known)
        self._rows = column("effort") if self.has_effort else None
        self._start = begin if begin else self.world.now
        if self.passes:
            assert not begin, "the passthrough controller knows no start"
            # One point per two cycles of 500 Hz.
            self._start, self._passed = self.world.now + 0.004 * len(points), 0.0
        self._handle = handle
        return handle

    def _problem(self, goal: Any) -> str:
        """Why a goal is rejected: `validate_trajectory_msg`."""
        trajectory = goal["trajectory"]
        if sorted(trajectory["joint_names"]) != sorted(self.joints):
            return "joints"
        points = trajectory["points"]
        times = [
            p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in points
        ]
        if not points or any(b <= a for a, b in itertools.pairwise(times)):
            return "times"
        if max(abs(v) for v in points[-1]["velocities"]) > FLOAT_EPSILON:
            return "ends with a velocity"
        count = len(trajectory["joint_names"])
        for point in points:
            if point.get("effort") and not self.has_effort:
                return "effort without its interface"
            if {len(point[k]) for k in ("positions", "velocities", "accelerations")} != {count}:
                return "sizes"
        return ""

    def cancel(self, handle: SimpleNamespace) -> Future:
        done = Future()
        if self._handle is handle:
            self._end(CANCELED, "")
            self._hold()
        done.set(None)
        return done

    def _hold(self) -> None:
        """`set_hold_position`: where it is, with the efforts of the last success, or none."""
        self._spline, self.effort = None, self.held_effort.copy()

    def _end(self, status: int, told: str) -> None:
        handle, self._handle = self._handle, None
        assert handle is not None
        result = SimpleNamespace(error_code=0, error_string=told)
        handle.result.set(SimpleNamespace(status=status, result=result))

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
        self.silent, self.pause = [False, False], 0.0
        self.offset, self.force = [0.0, 0.0], [0.0, 0.0]
        self.signals: dict[int, Callable[..., None]] = {}
        self._config, self._robots = config, job["robots"]
        self._next_joints = self.now
        self.controllers: dict[str, Controller] = {}
        for group in config["groups"]:
            first: dict[str, float] = {}
            for arm in group["arms"]:
                robot = self._robots[arm]
                first |= dict(zip(robot["ros_joints"], robot["position"][0], strict=True))
            passes = "passthrough" in group["action"]
            effort = bool(config["effort"])
            self.controllers[group["action"]] = Controller(
                self, list(first), np.array(list(first.values())), effort, passes
            )

    def later(self, after: float, what: Callable[[], None]) -> None:
        """Let something happen some time after now [s]."""
        heapq.heappush(self.at, (self.now + after, len(self.at), what))

    def of(self, arm: int) -> tuple[Controller, list[int]]:
        """An arm's controller, and the places of the arm's joints among its own."""
        for group in self._config["groups"]:
            if arm in group["arms"]:
                found = self.controllers[group["action"]]
                return found, [found.joints.index(n) for n in self._robots[arm]["ros_joints"]]
        raise LookupError(arm)

    def q(self, arm: int) -> Array:
        controller, part = self.of(arm)
        return controller.q[part]

    def effort(self, arm: int) -> Array:
        controller, part = self.of(arm)
        return controller.effort[part]

    def run(self, until: float) -> None:
        """Let time pass."""
        if self.pause:
            until, self.pause = until + self.pause, 0.0
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
                message = SimpleNamespace(
                    name=robot["ros_joints"], position=(self.q(arm) + self.offset[arm]).tolist()
                )
                topics = self._config["joint_states"]
                for heard in self.subscriptions[topics[arm if len(topics) > 1 else 0]]:
                    heard(message)

    def feel(self, arm: int, newton: float) -> None:
        """What a wrist sensor tells of a force along its pad."""
        source = self._config["wrench"][arm]
        x, y, z = (newton * value for value in source["axis"])
        force = SimpleNamespace(x=x, y=y, z=z)
        for heard in self.subscriptions[source["topic"]]:
            heard(SimpleNamespace(wrench=SimpleNamespace(force=force)))

    def command(self, word: str) -> None:
        for heard in self.subscriptions["/carry/command"]:
            heard(SimpleNamespace(data=word))

    def interrupt(self) -> None:
        """Ctrl-C."""
        import signal

        self.signals[signal.SIGINT](signal.SIGINT, None)

    def serve(self, name: str, kind: str, request: dict[str, Any]) -> bool:
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
        return True


def fill(message: Any, values: Mapping[str, Any]) -> None:
    """`set_message_fields`, with plain values in place of messages."""
    for name, value in values.items():
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


class _Goal(dict[str, Any]):
    """A goal whose start is written as in a message."""

    @property
    def trajectory(self) -> Any:
        stamp = (
            self["trajectory"]
            .setdefault("header", {})
            .setdefault("stamp", {"sec": 0, "nanosec": 0})
        )

        class Stamp:
            def __setattr__(self, name: str, value: int) -> None:
                stamp[name] = value

        return SimpleNamespace(header=SimpleNamespace(stamp=Stamp()))


def _modules(world: World) -> dict[str, types.ModuleType]:
    """What `run_job.py` imports of ROS 2."""

    class Client:
        def __init__(self, kind: str, name: str) -> None:
            self.kind, self.name = kind, name

        def wait_for_service(self, timeout_sec: float) -> bool:
            return True

        def call_async(self, request: dict[str, Any]) -> Future:
            future = Future()
            success = world.serve(self.name, self.kind, dict(request))
            world.later(0.01, lambda: future.set(SimpleNamespace(success=success)))
            return future

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

        def send_goal_async(self, goal: Any) -> Future:
            future = Future()
            world.later(0.01, lambda: future.set(self._controller.take(goal)))
            return future

    def spin_once(node: Any, timeout_sec: float) -> None:
        # Time passes in any case.
        world.run(world.now + min(max(timeout_sec, STEP), 0.01))

    def module(name: str, **content: Any) -> types.ModuleType:
        made = types.ModuleType(name)
        vars(made).update(content)
        return made

    def service(kind: str) -> Any:
        assert kind in SERVICES, kind
        return SimpleNamespace(Request=dict, kind=kind)

    goal_status = SimpleNamespace(STATUS_SUCCEEDED=SUCCEEDED)
    return {
        each.__name__: each
        for each in (
            module(
                "rclpy",
                init=lambda **_: None,
                shutdown=lambda: None,
                create_node=lambda name: Node(),
                spin_once=spin_once,
            ),
            module("rclpy.action", ActionClient=ActionClient),
            module("rclpy.signals", SignalHandlerOptions=SimpleNamespace(NO=0)),
            module("rosidl_runtime_py", set_message_fields=fill),
            module("rosidl_runtime_py.utilities", get_service=service),
            module("action_msgs"),
            module("action_msgs.msg", GoalStatus=goal_status),
            module("control_msgs"),
            module("control_msgs.action", FollowJointTrajectory=SimpleNamespace(Goal=_Goal)),
            module("geometry_msgs"),
            module("geometry_msgs.msg", WrenchStamped=object),
            module("sensor_msgs"),
            module("sensor_msgs.msg", JointState=object),
            module("std_msgs"),
            module("std_msgs.msg", String=object),
        )
    }


def run(
    files: Contents, folder: Path, prepare: Callable[[World], None], arguments: list[str]
) -> tuple[int, World]:
    """Run a bundle's `run_job.py`, unedited, from its folder; its exit code and its world.

    Args:
        prepare: what is to happen in the world.
    """
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    world = World(files, json.loads(files["config/cell.json"]))
    modules = _modules(world)
    kept = {name: sys.modules.get(name) for name in (*modules, "carry_job")}
    sys.modules.update(modules)
    sys.path.insert(0, str(folder))
    try:
        spec = importlib.util.spec_from_file_location("run_job_of_bundle", folder / "run_job.py")
        assert spec is not None
        assert spec.loader is not None
        program = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(program)
        signals = SimpleNamespace(
            SIGINT=2, SIGTERM=15, signal=lambda number, what: world.signals.update({number: what})
        )
        vars(program)["signal"] = signals
        prepare(world)
        return program.main(arguments), world
    finally:
        sys.path.remove(str(folder))
        for name, before in kept.items():
            if before is None:
                sys.modules.pop(name, None)
            else:
                sys.modules[name] = before
