"""Runs the job: python3 run_job.py [--check], beside the launched controllers.

Both arms get the whole job at once. While they drive it, this program looks at them a hundred times
a second. Ctrl-C, an arm that is silent, late or off its path, a force out of its band: both arms
stop along the path and keep the squeeze. Then tell it on the topic /carry/command (std_msgs/String)
how to set the box down: 'continue' or 'back'; 'leave' ends the program, the arms hold on.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from geometry_msgs.msg import WrenchStamped
from rclpy.action import ActionClient
from rclpy.signals import SignalHandlerOptions
from rosidl_runtime_py import set_message_fields
from rosidl_runtime_py.utilities import get_service
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from hybrid_opt.bundles.programs.carry_job import Job, Machine, Moment, Refused, Seen

BUNDLE = Path(__file__).resolve().parent

PERIOD = 0.01
"""Between two looks at the arms [s]."""

LEAD = 0.5
"""From sending a goal to its start, where goals bear a start [s]."""

PATIENCE = 10.0
"""Longest wait for something of the controllers [s]."""

LEAD_OF_STOP = 0.04
"""From the decision to stop to when the arms leave their course [s]: time for the message."""

SETTLE = 0.5
"""To hear from both arms, before the first look [s]."""

CTRL_C = "Ctrl-C"

TRIGGER = "std_srvs/srv/Trigger"

WINDOW = 8
"""Steps ahead within two periods of references, the largest force of which is sent."""

SLOWEST = 0.01
"""Fraction of a speed slider that is nearly none."""


class Run:
    """A run of the job by both arms' controllers, as config/cell.json describes them."""

    def __init__(self, node: Any, job: Job, config: dict[str, Any]) -> None:
        """Subscribe to both arms, with nothing sent."""
        self.node, self.job, self.config = node, job, config
        self._stamped = config["stamped"]
        how: dict[str, Any] = {"lead": LEAD_OF_STOP} if self._stamped else {"waits": True}
        self.machine = Machine(job, config["lag"], **how)
        self.fault, self.command, self.lost = "", "", False
        self._pressed, self._began, self._last = -math.inf, 0.0, 0.0
        self._presses = False
        self._q: list[dict[str, float]] = [{}, {}]
        self._news = [-math.inf, -math.inf]
        self._force: list[float | None] = [None, None]
        self._handles: list[Any] = []
        self._goals = 0
        self._calls: list[tuple[str, Any]] = []
        self._clients: dict[str, Any] = {}
        for topic in config["joint_states"]:
            node.create_subscription(JointState, topic, self._joints, 10)
        for arm, source in enumerate(config["wrench"]):
            if source is not None:
                self._listen(arm, source)
        node.create_subscription(String, "/carry/command", self._commanded, 10)
        self._actions = [
            ActionClient(node, FollowJointTrajectory, group["action"]) for group in config["groups"]
        ]

    def _joints(self, message: Any) -> None:
        for arm, robot in enumerate(self.job.robots):
            known = dict(zip(message.name, message.position, strict=False))
            if all(name in known for name in robot["ros_joints"]):
                self._q[arm] = known
                self._news[arm] = self.now()

    def _listen(self, arm: int, source: dict[str, Any]) -> None:
        axis = source["axis"]

        def heard(message: Any) -> None:
            force = message.wrench.force
            along = axis[0] * force.x + axis[1] * force.y + axis[2] * force.z
            self._force[arm] = abs(along)

        self.node.create_subscription(WrenchStamped, source["topic"], heard, 10)

    def _commanded(self, message: Any) -> None:
        self.command = message.data.strip()

    def now(self) -> float:
        """Time of the node's clock [s]."""
        return float(self.node.get_clock().now().nanoseconds) * 1e-9

    def seen(self) -> Seen:
        """What is known of the arms now."""
        for name, future in [call for call in self._calls if call[1].done()]:
            if future.result() is None or not getattr(future.result(), "success", True):
                self.fault = self.fault or f"{name} was refused"
        self._calls = [call for call in self._calls if not call[1].done()]
        now = self.now()
        return Seen(
            q=[
                [known[name] for name in robot["ros_joints"]] if known else None
                for known, robot in zip(self._q, self.job.robots, strict=True)
            ],
            force=list(self._force),
            silence=[now - then for then in self._news],
            fault=self.fault,
            lost=self.lost,
        )

    def spin(self, until: float) -> None:
        """Handle what comes in until a time."""
        while (left := until - self.now()) > 0.0:
            rclpy.spin_once(self.node, timeout_sec=left)

    def wait(self, futures: Sequence[Any], what: str) -> list[Any]:
        """The results of futures.

        Raises:
            Refused: they take too long.
        """
        begin = self.now()
        while not all(future.done() for future in futures):
            if self.now() - begin > PATIENCE:
                raise Refused(f"{what} does not answer")
            rclpy.spin_once(self.node, timeout_sec=PERIOD)
        return [future.result() for future in futures]

    def call(self, name: str, kind: str, request: dict[str, Any]) -> Any:
        """Call a service; a refusal becomes a fault when it arrives."""
        message = get_service(kind).Request()
        set_message_fields(message, request)
        future = self._clients[name].call_async(message)
        self._calls.append((name, future))
        return future

    def _find(self, name: str, kind: str) -> None:
        """Find a service before anything moves."""
        self._clients[name] = self.node.create_client(get_service(kind), name)
        if not self._clients[name].wait_for_service(timeout_sec=PATIENCE):
            raise Refused(f"{name} is not there; are the controllers launched?")

    def prepare(self) -> None:
        """Whatever the arms need before they move, one after the other.

        Raises:
            Refused: something is not there, or says no.
        """
        for group, client in zip(self.config["groups"], self._actions, strict=True):
            if not client.wait_for_server(timeout_sec=PATIENCE):
                raise Refused(f"{group['action']} is not there; are the controllers launched?")
        for call in self.config["prepare"]:
            self._find(call["name"], call["kind"])
        for each in (*self.config["force"], *self.config["payload"], *self.config["sliders"]):
            self._find(each["name"], each["type"])
        for force in self.config["force"]:
            self._find(force["end"], TRIGGER)
        for call in self.config["prepare"]:
            self.wait([self.call(**call)], call["name"])
            if self.seen().fault:
                raise Refused(self.fault)

    def send(self, moments: Sequence[Moment], begin: float) -> None:
        """Send every group its part of the path, and hear whether it is accepted.

        Args:
            begin: when the first moment is [s].

        Raises:
            Refused: a controller does not take it.
        """
        sent = []
        for group, client in zip(self.config["groups"], self._actions, strict=True):
            goal = FollowJointTrajectory.Goal()
            set_message_fields(goal, self._goal(group["arms"], moments))
            if self.config["stamped"]:
                goal.trajectory.header.stamp.sec = int(begin)
                goal.trajectory.header.stamp.nanosec = int((begin - int(begin)) * 1e9)
            sent.append(client.send_goal_async(goal))
        self._goals += 1
        handles = self.wait(sent, "a controller")
        if not all(handle.accepted for handle in handles):
            for handle in handles:
                if handle.accepted:
                    handle.cancel_goal_async()
            refusing = [
                g["action"]
                for g, h in zip(self.config["groups"], handles, strict=True)
                if not h.accepted
            ]
            raise Refused(f"{refusing[0]} does not take its goal; nothing moves on")
        self._handles = handles
        for group, handle in zip(self.config["groups"], handles, strict=True):
            handle.get_result_async().add_done_callback(self._ended(group["action"], self._goals))

    def _ended(self, action: str, number: int) -> Any:
        def ended(future: Any) -> None:
            done = future.result()
            if number == self._goals and done.status != GoalStatus.STATUS_SUCCEEDED:
                told = done.result.error_string or f"status {done.status}"
                self.fault = self.fault or f"{action} ended: {told}"
                self.lost = True

        return ended

    def _goal(self, arms: Sequence[int], moments: Sequence[Moment]) -> dict[str, Any]:
        names = self._joined(arms, [self.job.robots[arm]["ros_joints"] for arm in arms])
        erased = [{"name": name, "position": -1.0} for name in names]
        return {
            "trajectory": {
                "joint_names": names,
                "points": [self._point(arms, moment) for moment in moments],
            },
            # A controller that gives up by itself drops the squeeze: this program looks after both.
            "path_tolerance": erased,
            "goal_tolerance": erased,
        }

    def _joined(self, arms: Sequence[int], rows: Sequence[Sequence[Any]]) -> list[Any]:
        """What arms' joints have, side by side; of a joint that moves both arms the first's."""
        found: dict[str, Any] = {}
        for arm, row in zip(arms, rows, strict=True):
            for name, value in zip(self.job.robots[arm]["ros_joints"], row, strict=True):
                found.setdefault(name, value)
        return list(found.values())

    def _point(self, arms: Sequence[int], at: Moment) -> dict[str, Any]:
        job, r = self.job, at.rate
        rates = [job.linear(arm, "velocity", at.s) for arm in arms]
        seconds = [job.linear(arm, "acceleration", at.s) for arm in arms]
        nanoseconds = round(at.time * 1e9)
        point = {
            "positions": self._joined(arms, [job.position(arm, at.s) for arm in arms]),
            "velocities": [r * v for v in self._joined(arms, rates)],
            "accelerations": [
                r * r * a + at.change * v
                for v, a in zip(self._joined(arms, rates), self._joined(arms, seconds), strict=True)
            ],
            "time_from_start": {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9},
        }
        if self.config["effort"]:
            gravity = self.config["effort"]
            efforts = [job.effort(arm, gravity, at.s, r) for arm in arms]
            point["effort"] = self._joined(arms, efforts)
        return point

    def press(self, s: float, rate: float) -> None:
        """Tell force controllers what to press from a coordinate on, at a rate."""
        for force in self.config["force"]:
            arm, every = force["arm"], force["every"]
            ahead = (s + rate * 2.0 * every * k / WINDOW for k in range(WINDOW))
            newton = max(self.job.force(arm, each) for each in ahead)
            request = json.loads(json.dumps(force["request"]))
            request["wrench"] = {"force": {"z": newton}}
            self.call(force["name"], force["type"], request)

    def bear(self, s: float) -> None:
        """Tell the arms what they carry, as the pads take the box over."""
        for load in self.config["payload"]:
            arm = load["arm"]
            peak = self.job.force(arm, self.job.pressed)
            share = min(1.0, self.job.force(arm, s) / peak) if peak > 0.0 else 0.0
            first, second = load["empty"], load["loaded"]
            mass = (1.0 - share) * first["mass"] + share * second["mass"]
            moment = [
                (1.0 - share) * first["mass"] * a + share * second["mass"] * b
                for a, b in zip(first["centre"], second["centre"], strict=True)
            ]
            centre = [m / mass if mass else 0.0 for m in moment]
            request = {"mass": mass, "center_of_gravity": dict(zip("xyz", centre, strict=True))}
            self.call(load["name"], load["type"], request)

    def start(self) -> None:
        """Send the whole job and begin.

        Raises:
            Refused: the arms are not ready for it.
        """
        self.machine.start(self.seen())
        self._begin(1.0)

    def _begin(self, rate: float) -> None:
        moments = list(self.machine.clock.ahead(rate, self.config["step"]))
        self._began = self.now() + (LEAD if self._stamped else 0.0)
        self.send(moments, self._began)
        self.spin(self._began)
        self._last = self._began

    def tick(self) -> None:
        """Look at the arms and do what has to be done."""
        machine = self.machine
        before, now = machine.state, self.now()
        machine.tick(now - self._last, self.seen())
        self._last = now
        if before == "running" and machine.state in ("stopping", "held"):
            self._stop()
        if before != machine.state:
            self.node.get_logger().info(machine.told())
        self._press()
        if machine.state == "held" and self.command in ("continue", "back"):
            self._resume(1.0 if self.command == "continue" else -1.0)

    def stop(self, reason: str) -> None:
        """Stop for a reason of one's own."""
        if self.machine.state == "running":
            self.machine.stop(reason)
            self._stop()

    def _stop(self) -> None:
        if not self._stamped:
            # Goals that cannot be replaced: slow on the path for a time, then whole.
            self._goals += 1
            self._slide(SLOWEST)
            self.spin(self.now() + self.machine.stop_time)
            for handle in self._handles:
                handle.cancel_goal_async()
            return
        if self.machine.state == "held":
            # At its end: the controllers hold what they reached.
            return
        # With the start of what is driven now: the new points are a continuation of the old ones,
        # the first of which is over when they arrive, so that nothing is made up in between.
        gone = self.now() - self._began
        ahead = self.machine.clock.ahead(0.0, self.config["step"])
        moments = [Moment(gone + m.time, m.s, m.rate, m.change) for m in ahead]
        try:
            self.send(moments, self._began)
        except Refused as error:
            self.node.get_logger().error(f"{error}; the job goes on to its end as planned")

    def _slide(self, fraction: float) -> list[Any]:
        """Set the speed sliders."""
        request = {"speed_slider_fraction": fraction}
        return [self.call(each["name"], each["type"], request) for each in self.config["sliders"]]

    def _press(self) -> None:
        s, now = self.machine.clock.s, self.now()
        touching = self.job.begin("press") < s < self.job.begin("retreat")
        for force in self.config["force"]:
            if touching and now - self._pressed >= force["every"]:
                self._pressed, self._presses = now, True
                self.press(s, self.machine.clock.rate)
                self.bear(s)
        if self._presses and not touching:
            # The pads are off the box.
            self._presses = False
            for force in self.config["force"]:
                self.call(force["end"], TRIGGER, {})

    def _resume(self, direction: float) -> None:
        self.command, self.fault, self.lost = "", "", False
        try:
            self.machine.resume(direction, self.seen())
            self.wait(self._slide(1.0), "a speed slider")
            self._begin(direction)
        except Refused as error:
            self.machine.hold(str(error))
            self.node.get_logger().error(self.machine.told())

    def interrupt(self, *_: object) -> None:
        """Ctrl-C stops the job; while it is held, for whatever reason, ends the program."""
        if self.machine.state == "held":
            self.command = "leave"
        self.fault = self.fault or CTRL_C

    def look_after(self) -> int:
        """Look after a run that has begun, to its end; returns the exit code."""
        machine = self.machine
        try:
            while machine.state != "done":
                self.spin(self.now() + PERIOD)
                self.tick()
                if machine.state == "held" and self.command == "leave":
                    self.node.get_logger().error(f"left while {machine.told()}")
                    return 1
        except BaseException:
            self.stop("run_job.py has failed")
            raise
        return 0 if machine.clock.s > 0.0 else 3


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the job; returns the exit code: 0 when it is done."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="look at both arms and move nothing")
    options = parser.parse_args(arguments)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("run_job")
    try:
        job = Job.read(BUNDLE / "job.json")
        config = json.loads((BUNDLE / "config/cell.json").read_text("utf-8"))
        run = Run(node, job, config)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, run.interrupt)
        run.prepare()
        run.spin(run.now() + SETTLE)
        if options.check:
            run.machine.start(run.seen())
            node.get_logger().info("both arms are at their first places")
            return 0
        run.start()
        return run.look_after()
    except Refused as error:
        node.get_logger().error(str(error))
        return 2
    finally:
        rclpy.shutdown()


if __name__ == "__main__":
    sys.exit(main())
