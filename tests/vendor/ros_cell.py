"""Both arms' controllers over ROS 2: PYTHON -m tests.vendor.ros_cell FOLDER SPEED [FAULT WHEN ARM]

Plays the drivers of the bundle in FOLDER: real actions, services, messages and quality of service
over FastDDS, around the rules of `controlled.py`. A fault happens WHEN seconds after the first
goal's start; negative, from the beginning. SIGUSR1 ends it, SIGUSR2 says 'back'. FOLDER/clock gets
the time since this start [s]. On SIGTERM, FOLDER/cell.npz gets what happened. Time is that of
/clock and runs at SPEED times this machine's, which is loaded by more than one cell.
"""

from __future__ import annotations

import json
import math
import random
import signal
import sys
from collections import deque
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from control_msgs.action import FollowJointTrajectory
from geometry_msgs.msg import WrenchStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from tests.hybrid_opt.extras.bundles.controlled import (
    SUCCEEDED,
    ControlledCell,
    Controller,
    seconds,
)

CYCLE = 0.01
"""Of controllers and topics [s]; those of robots are shorter."""

LATE = 0.08
"""Longest time that news take on a loaded machine [s]."""

LINES = 18
"""Digital inputs of a UR."""

CATCH_UP = 0.03
"""Largest motion of a joint in a cycle, by which an arm that stood comes back [rad]."""


def type_of(kind: str) -> Any:
    """The type of a message or service PACKAGE/KIND/NAME."""
    package, folder, name = kind.split("/")
    return getattr(import_module(f"{package}.{folder}"), name)


class RosCell(ControlledCell):
    """A cell whose programs come over ROS 2.

    Attributes:
        starts: when each controller began with its first goal [s], by its action.
    """

    def __init__(self, node: Any, folder: Path, speed: float) -> None:
        """Offer what the drivers of `config/cell.json` do."""
        self.node, self._late = node, random.Random(0)
        self._longest, self._news = 0.0, deque[tuple[float, Any, Any]]()
        job = json.loads((folder / "job.json").read_text("utf-8"))
        super().__init__(job, json.loads((folder / "config/cell.json").read_text("utf-8")))
        self.starts: dict[str, float] = {}
        self._servers = [self._server(action) for action in self.controllers]
        for name, kind in {
            c["name"]: c["kind"] for c in (*self.config["prepare"], *self.grips)
        }.items():
            node.create_service(type_of(kind), name, self._service(name, kind))
        inputs = [grip["input"] for grip in self.grips]
        self._inputs = [
            source and node.create_publisher(type_of(source["kind"]), source["topic"], 1)
            for source in inputs
        ]
        topics = self.config["joint_states"]
        self._states = [node.create_publisher(JointState, topic, 10) for topic in topics]
        # franka_robot_state_broadcaster.cpp:125, force_torque_sensor_broadcaster.cpp:120.
        policy = ReliabilityPolicy.RELIABLE
        if any("franka" in call["kind"] for call in self.config["prepare"]):
            policy = ReliabilityPolicy.BEST_EFFORT
        quality = QoSProfile(depth=1, reliability=policy)
        self._wrenches = [
            source and node.create_publisher(WrenchStamped, source["topic"], quality)
            for source in self.config["wrench"]
        ]
        self._folder, self._now = folder, 100.0
        self._clock = node.create_publisher(Clock, "/clock", 1)
        self._commands = node.create_publisher(String, "/carry/command", 10)
        node.create_timer(CYCLE / speed, self._cycle)

    def time(self) -> float:
        """Time of /clock [s]."""
        return self._now

    def _service(self, name: str, kind: str) -> Any:
        def answer(request: Any, response: Any) -> Any:
            for field, value in self.serve(name, kind, request).items():
                setattr(response, field, value)
            return response

        return answer

    def _server(self, action: str) -> Any:
        controller, results = self.controllers[action], dict[bytes, Future]()

        def receive(goal: Any) -> Any:
            accepted = controller.accepts(goal.trajectory)
            return GoalResponse.ACCEPT if accepted else GoalResponse.REJECT

        def take(handle: Any) -> None:
            done = results[bytes(handle.goal_id.uuid)] = Future()
            # A goal that comes late begins late.
            begin = max(seconds(handle.request.trajectory.header.stamp), self._now)
            self.starts.setdefault(action, begin)
            controller.take(handle.request.trajectory, lambda *end: done.set_result(end))
            handle.execute()

        async def execute(handle: Any) -> Any:
            status, text = await results.pop(bytes(handle.goal_id.uuid))
            (handle.succeed if status == SUCCEEDED else handle.abort)()
            return FollowJointTrajectory.Result(error_string=text)

        return ActionServer(
            self.node,
            FollowJointTrajectory,
            action,
            execute_callback=execute,
            goal_callback=receive,
            handle_accepted_callback=take,
            cancel_callback=lambda _: CancelResponse.REJECT,
        )

    def _cycle(self) -> None:
        self._now += CYCLE
        self.drive()
        sec, nanosec = divmod(round(self._now * 1e9), 10**9)
        stamp = Time(sec=sec, nanosec=nanosec)
        if len(self.starts) == len(self.controllers):
            since = self._now - min(self.starts.values())
            (self._folder / "new").write_text(str(since), "utf-8")
            (self._folder / "new").replace(self._folder / "clock")
        self._clock.publish(Clock(clock=stamp))
        for place, states in enumerate(self._states):
            # One message of all joints, as joint_state_broadcaster publishes it.
            arms = [a for a in (0, 1) if a % len(self._states) == place and not self.silent[a]]
            message = JointState()
            message.header.stamp = stamp
            message.name = [name for arm in arms for name in self.robots[arm]["ros_joints"]]
            message.position = [q for arm in arms for q in self.q(arm) + self.offset[arm]]
            if arms:
                self._publish(states, message)
        for arm in (0, 1):
            felt, publisher = self.felt[arm], self._wrenches[arm]
            if publisher and felt is not None:
                wrench = WrenchStamped()
                wrench.header.stamp = stamp
                axis, newton = self.config["wrench"][arm]["axis"], self.pressed(arm) + felt
                force = wrench.wrench.force
                force.x, force.y, force.z = (newton * value for value in axis)
                self._publish(publisher, wrench)
        for arm, publisher in enumerate(self._inputs):
            if publisher and not self.silent[arm]:
                self._publish(publisher, self._input(arm))
        while self._news and self._news[0][0] <= self._now:
            _, source, message = self._news.popleft()
            source.publish(message)

    def _input(self, arm: int) -> Any:
        """What tells that the hands of an arm hold, among all lines of a UR (gpio_controller.cpp
        :300 of 696e1a7)."""
        source = self.grips[arm]["input"]
        message = type_of(source["kind"])()
        if source["pin"] is None:
            message.data = self.holds(arm)
        else:
            digital = type_of("ur_msgs/msg/Digital")
            lines = [digital(pin=pin, state=pin != source["pin"]) for pin in range(LINES)]
            lines[source["pin"]].state = self.holds(arm)
            message.digital_in_states = lines
        return message

    def _publish(self, publisher: Any, message: Any) -> None:
        """Publish a message, not before those that were to be published sooner."""
        due = self._now + self._late.uniform(0.0, self._longest)
        self._news.append((max(due, self._news[-1][0] if self._news else 0.0), publisher, message))

    def move(self) -> None:
        """Let all arms follow; one that stood comes back to its reference."""
        before = [(controller, controller.q.copy()) for controller in self.controllers.values()]
        super().move()
        for controller, q in before:
            controller.q = q + np.clip(controller.q - q, -CATCH_UP, CATCH_UP)

    def arms_of(self, controller: Controller) -> list[int]:
        """Arms that a controller drives."""
        return [arm for arm in (0, 1) if self.of(arm)[0] is controller]

    def command(self, word: str) -> None:
        """Say something to the program, as `ros2 topic pub` does."""
        self._commands.publish(String(data=word))

    def heal(self) -> None:
        """End every fault. An arm that stood holds where it is: its driver activates its controller
        anew, as UR's does (ur_robot_driver, controller_stopper.cpp, `startControllers`)."""
        self.silent, self.felt, self._longest = [False, False], [0.0, 0.0], 0.0
        self.leaks = [False, False]
        for controller in self.controllers.values():
            stood = bool(controller.stands.any())
            controller.stands[:] = controller.refuses = False
            if stood or not controller.is_active:
                controller.switch(True)

    def fault(self, name: str, arm: int) -> None:
        """Let something go wrong."""
        controller, part = self.of(arm)
        if name == "stands":
            controller.stands[part] = True
        elif name == "silent":
            self.silent[arm] = True
        elif name == "deaf":
            self.felt[arm] = None
        elif name == "offset":
            self.felt[arm] = 10.0
        elif name == "elsewhere":
            controller.q[part] += math.radians(3.0)
        elif name == "rejects":
            controller.refuses = True
        elif name == "lost":
            # The driver has lost its robot, which stops: the hardware's controllers are inactive.
            controller.switch(False)
            for own in self.arms_of(controller):
                self.silent[own], self.felt[own] = True, None
        elif name == "leaks":
            self.leaks[arm] = True
        elif name == "late":
            self._longest = LATE
        elif name == "aborts":
            controller.aborts_at = self.time()
        else:
            raise ValueError(name)


def main() -> None:
    """Play the drivers until SIGTERM."""
    folder = Path(sys.argv[1])
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("cell")
    cell = RosCell(node, folder, float(sys.argv[2]))
    ends: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: ends.append(number))
    signal.signal(signal.SIGUSR1, lambda *_: cell.heal())
    signal.signal(signal.SIGUSR2, lambda *_: cell.command("back"))
    pending = []
    if len(sys.argv) > 3:
        name, when, arm = sys.argv[3], float(sys.argv[4]), int(sys.argv[5])
        if when < 0.0:
            cell.fault(name, arm)
        else:
            pending.append((when, name, arm))
    print("ready", flush=True)
    executor = EventsExecutor()
    executor.add_node(node)
    while not ends:
        executor.spin_once(timeout_sec=0.1)
        if pending and cell.starts and cell.time() >= min(cell.starts.values()) + pending[0][0]:
            cell.fault(*pending.pop()[1:])
    time, q, effort = (np.array(column) for column in zip(*cell.record, strict=True))
    np.savez(
        folder / "cell.npz",
        time=time,
        q=q,
        effort=effort,
        starts=list(cell.starts.values()),
        switched=cell.switched,
    )
    rclpy.shutdown()


if __name__ == "__main__":
    main()
