"""A stand-in for rclpy in which `run_job.py` runs as it is, in simulated time.

Controllers and arms are those of `controlled.py`. `tests/vendor` runs the same over ROS 2 itself.
"""

from __future__ import annotations

import heapq
import importlib.util
import json
import signal
import sys
from collections.abc import Callable, Container, Sequence
from concurrent.futures import Future
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import patch

from rosbags.typesys import Stores, get_typestore

from hybrid_opt.extras.bundles.job_file import Contents
from hybrid_opt.extras.bundles.programs import SHARED
from hybrid_opt.store.bundle_file import write_bundle
from tests.hybrid_opt.extras.bundles.bundles import as_planned
from tests.hybrid_opt.extras.bundles.controlled import SUCCEEDED, ControlledCell

STEP = 0.005
"""Of the simulated world [s]."""

LONGEST = 200.0
"""A program that is not done by then, of a world that begins at 100 s, waits for ever [s]."""

JOINTS_EVERY = 0.01
"""Between two joint states [s]."""

SERVICES: dict[str, set[str]] = {
    "std_srvs/srv/Trigger": set(),
    "std_srvs/srv/SetBool": {"data"},
    "ur_msgs/srv/SetIO": {"fun", "pin", "state"},
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

MESSAGES = (
    ("builtin_interfaces", "Duration", "Time"),
    ("geometry_msgs", "WrenchStamped"),
    ("sensor_msgs", "JointState"),
    ("std_msgs", "Bool", "Header", "String"),
    ("trajectory_msgs", "JointTrajectory", "JointTrajectoryPoint"),
)
"""Packages and the messages that a program may use."""

STORE = get_typestore(Stores.ROS2_JAZZY)


class Message(dict[str, Any]):
    """A message or a request by its fields; those that nobody set are empty messages."""

    known: Container[str] | None = None
    """Its fields, where they are stated."""

    def __getattr__(self, name: str) -> Any:
        self._require(name)
        return self.setdefault(name, Message())

    def __setattr__(self, name: str, value: Any) -> None:
        self._require(name)
        self[name] = value

    def _require(self, name: str) -> None:
        if self.known is not None and name not in self.known:
            raise AttributeError(name)


def message_of(kind: str) -> Callable[..., Message]:
    """The constructor of a message with the fields of ROS 2's own definition."""
    fields = {name for name, _ in STORE.get_msgdef(kind).fields}

    def construct(**values: Any) -> Message:
        assert fields.issuperset(values), f"{kind} has no {set(values) - fields}"
        return Message(values)

    return construct


class World(ControlledCell):
    """Controllers, services and topics in simulated time.

    Attributes:
        now: [s].
        log: what the program told.
        at: what happens at which time: functions by time.
        step: of the simulated time [s].
    """

    step = STEP

    def __init__(self, files: Contents, config: dict[str, Any]) -> None:
        super().__init__(json.loads(files["job.json"]), config)
        self.now, self.log = 100.0, list[str]()
        self.at: list[tuple[float, int, Callable[[], None]]] = []
        self.subscriptions: dict[str, list[Callable[[Any], None]]] = {}
        self.lateness = 0.0
        """Time between a measurement and its arrival [s]."""
        self.signals: dict[int, Callable[..., None]] = {}
        self._next_joints = self.now

    def time(self) -> float:
        """Simulated time [s]."""
        return self.now

    def later(self, after: float, what: Callable[[], None]) -> None:
        """Let something happen some time after now [s]."""
        heapq.heappush(self.at, (self.now + after, len(self.at), what))

    def run(self, until: float) -> None:
        """Let time pass."""
        while self.now < until - 1e-9:
            assert self.now < LONGEST, f"not done after {LONGEST:g} s: {self.log}"
            self.now += self.step
            while self.at and self.at[0][0] <= self.now:
                heapq.heappop(self.at)[2]()
            self.drive()
            if self.now >= self._next_joints:
                self._next_joints += JOINTS_EVERY
                self._tell()

    def _tell(self) -> None:
        nanoseconds = round(self.now * 1e9)
        stamp = Message(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        told = list[tuple[str, Message]]()
        for arm, robot in enumerate(self.robots):
            header = Message(stamp=stamp)
            topics, source = self.config["joint_states"], self.config["wrench"][arm]
            if not self.silent[arm]:
                q = (self.q(arm) + self.offset[arm]).tolist()
                message = Message(header=header, name=robot["ros_joints"], position=q)
                told.append((topics[arm if len(topics) > 1 else 0], message))
            offset = self.felt[arm]
            if source is not None and offset is not None:
                newton = self.sign * (self.pressed(arm) + offset)
                xyz = zip("xyz", (newton * value for value in source["axis"]), strict=True)
                wrench = Message(force=Message(xyz))
                told.append((source["topic"], Message(header=header, wrench=wrench)))

        for arm, grip in enumerate(self.grips):
            source = grip["input"]
            if source and not self.silent[arm]:
                line = Message(pin=source["pin"], state=self.holds(arm))
                lines = Message(digital_in_states=[Message(pin=17, state=True), line])
                told.append((source["topic"], lines if source["pin"] else Message(data=line.state)))

        def arrive() -> None:
            for topic, message in told:
                for heard in self.subscriptions.get(topic, []):
                    heard(message)

        self.later(self.lateness, arrive)

    def command(self, word: str) -> None:
        for heard in self.subscriptions["/carry/command"]:
            heard(Message(data=word))

    def interrupt(self) -> None:
        """Ctrl-C."""
        self.signals[signal.SIGINT](signal.SIGINT, None)


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
            def answer() -> Any:
                answer = world.serve(self.name, self.kind, request)
                return SimpleNamespace(**answer)

            return answered(answer)

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
            return answered(lambda: self._take(goal))

        def _take(self, goal: Any) -> SimpleNamespace:
            handle = SimpleNamespace(accepted=self._controller.accepts(goal.trajectory))
            if handle.accepted:
                result = Future[Any]()

                def ended(status: int, text: str) -> None:
                    done = SimpleNamespace(error_code=0, error_string=text)
                    result.set_result(SimpleNamespace(status=status, result=done))

                self._controller.take(goal.trajectory, ended)
                handle.get_result_async = lambda: result
            return handle

    def spin_once(node: Any, timeout_sec: float) -> None:
        # Time passes in any case.
        world.run(world.now + min(max(timeout_sec, world.step), 0.01))

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
        "action_msgs.msg": {"GoalStatus": SimpleNamespace(STATUS_SUCCEEDED=SUCCEEDED)},
        "ur_msgs.msg": {"IOStates": Message},
        "control_msgs.action": {"FollowJointTrajectory": SimpleNamespace(Goal=Message)},
    }
    for package, *names in MESSAGES:
        kinds = {name: f"{package}/msg/{name}" for name in names}
        contents[f"{package}.msg"] = {name: message_of(kind) for name, kind in kinds.items()}
    for kind, known in SERVICES.items():
        package, _, name = kind.split("/")
        request = type(name, (Message,), {"known": known})
        contents.setdefault(f"{package}.srv", {})[name] = SimpleNamespace(
            Request=request, kind=kind
        )
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
    make: Callable[[Contents, dict[str, Any]], World] = World,
) -> tuple[int, World]:
    """Run a bundle's `run_job.py`, unedited, from its folder; its exit code and its world.

    Args:
        prepare: what is to happen in the world.
        make: the world from the bundle's files and configuration.
    """
    write_bundle(folder, files if "--bring-up" in arguments else as_planned(files), {})
    world = make(files, json.loads(files["config/cell.json"]))
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
        for name in SHARED:
            sys.modules.pop(Path(name).stem, None)
        spec.loader.exec_module(program)
        vars(sys.modules["carry_program"])["signal"] = signals
        prepare(world)
        return program.main(arguments), world
