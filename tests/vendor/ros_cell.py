"""Both arms' controllers over ROS 2: PYTHON -m tests.vendor.ros_cell FOLDER [FAULT WHEN ARM]

Plays the drivers of the bundle in FOLDER: real actions, services, messages and quality of service
over FastDDS, around the rules of `controlled.py`. A fault happens WHEN seconds after the first
goal's start; negative, from the beginning. FOLDER/clock gets the time since this start [s]. On
SIGTERM, FOLDER/cell.npz gets what happened. Time is that of /clock and slower than this machine's,
which is loaded by more than one cell.
"""

from __future__ import annotations

import json
import math
import signal
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from control_msgs.action import FollowJointTrajectory
from geometry_msgs.msg import WrenchStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from tests.hybrid_opt.extras.bundles.controlled import SUCCEEDED, ControlledCell

CYCLE = 0.01
"""Of controllers and topics [s]; those of robots are shorter."""

SPEED = 0.3
"""Of the cell's time over this machine's."""


class RosCell(ControlledCell):
    """A cell whose programs come over ROS 2.

    Attributes:
        starts: start of each accepted goal [s], with the arms that it drives.
    """

    def __init__(self, node: Any, folder: Path) -> None:
        """Offer what the drivers of `config/cell.json` do."""
        self.node = node
        job = json.loads((folder / "job.json").read_text("utf-8"))
        super().__init__(job, json.loads((folder / "config/cell.json").read_text("utf-8")))
        self.starts: list[float] = []
        self._servers = [self._server(action) for action in self.controllers]
        for call in self.config["prepare"]:
            package, _, name = call["kind"].split("/")
            kind = getattr(import_module(f"{package}.srv"), name)
            node.create_service(kind, call["name"], self._service(call["name"], call["kind"]))
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
        node.create_timer(CYCLE / SPEED, self._cycle)

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
            stamp = handle.request.trajectory.header.stamp
            self.starts.append(stamp.sec + 1e-9 * stamp.nanosec)
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
        if len(self.starts) >= len(self.controllers):
            (self._folder / "new").write_text(str(self._now - self.starts[0]), "utf-8")
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
                states.publish(message)
        for arm in (0, 1):
            felt, publisher = self.felt[arm], self._wrenches[arm]
            if publisher and felt is not None:
                wrench = WrenchStamped()
                wrench.header.stamp = stamp
                axis, newton = self.config["wrench"][arm]["axis"], self.pressed(arm) + felt
                force = wrench.wrench.force
                force.x, force.y, force.z = (newton * value for value in axis)
                publisher.publish(wrench)

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
        elif name == "aborts":
            controller.aborts_at = self.time()
        else:
            raise ValueError(name)


def main() -> None:
    """Play the drivers until SIGTERM."""
    folder = Path(sys.argv[1])
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("cell")
    cell = RosCell(node, folder)
    ends: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: ends.append(number))
    pending = []
    if len(sys.argv) > 2:
        name, when, arm = sys.argv[2], float(sys.argv[3]), int(sys.argv[4])
        if when < 0.0:
            cell.fault(name, arm)
        else:
            pending.append((when, name, arm))
    print("ready", flush=True)
    while not ends:
        rclpy.spin_once(node, timeout_sec=0.1)
        if pending and cell.starts and cell.time() >= cell.starts[0] + pending[0][0]:
            cell.fault(*pending.pop()[1:])
    time, q, effort = (np.array(column) for column in zip(*cell.record, strict=True))
    np.savez(folder / "cell.npz", time=time, q=q, effort=effort, starts=cell.starts)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
