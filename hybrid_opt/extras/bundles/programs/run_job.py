"""Runs the job: python3 run_job.py [--check|--in-air|--bring-up], beside the launched controllers.

Both arms get the whole job at once. While they drive it, this program looks at them a hundred times
a second. Ctrl-C, an arm that is silent, late or off its path, a force out of its band: both arms
stop along the path and keep the squeeze. Then tell it on the topic /carry/command (std_msgs/String)
how to set the box down: 'continue' or 'back'; 'leave' ends the program, the arms hold on.

Hands that hold by themselves are switched where config/cell.json says, and waited for; a stop, an
end of this program or its failure switch nothing.
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration, Time
from control_msgs.action import FollowJointTrajectory
from geometry_msgs.msg import WrenchStamped
from rclpy.action import ActionClient
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from hybrid_opt.extras.bundles.programs.bring_up import (
    AIR,
    BACK,
    BLOCK,
    Looks,
    Measured,
    add_options,
    bring_up,
    require,
    unloaded,
)
from hybrid_opt.extras.bundles.programs.carry_job import Job, Refused
from hybrid_opt.extras.bundles.programs.carry_machine import Machine, Moment, Seen

BUNDLE = Path(__file__).resolve().parent

PERIOD = 0.01
"""Time between two checks of the arms [s]."""

LEAD = 0.5
"""Time from the construction of the goals to their common start [s]."""

PATIENCE = 10.0
"""Longest wait for an answer of the controllers [s]."""

LEAD_OF_STOP = 0.04
"""Time from the decision to stop until the arms leave their course [s], which the message needs."""

SETTLE = 0.5
"""Time to receive messages of both arms before the first check [s]."""

CTRL_C = "Ctrl-C"

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Quality of service for measurements: accepts reliable and best-effort publishers, and keeps no
queue."""


def parts(time: float) -> tuple[int, int]:
    """Split a time [s] into whole seconds and nanoseconds."""
    return divmod(round(time * 1e9), 10**9)


def type_of(kind: str) -> Any:
    """Return the Python class of a ROS message or service.

    Args:
        kind: its name, PACKAGE/msg/NAME or PACKAGE/srv/NAME.
    """
    package, what, name = kind.split("/")
    return getattr(import_module(f"{package}.{what}"), name)


def fill(message: Any, values: dict[str, Any]) -> None:
    """Set the fields of a ROS message from a dictionary.

    Args:
        message: the message, which is changed in place.
        values: value of each field by its name. For a field that is itself a message, the value is
            such a dictionary.

    Raises:
        AttributeError: the message has no such field.
    """
    for name, value in values.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        else:
            setattr(message, name, value)


class Run:
    """A run of the job by the controllers of both arms, with ROS names and settings from
    config/cell.json."""

    def __init__(
        self, node: Any, job: Job, config: dict[str, Any], known: Sequence[Measured] | Looks
    ) -> None:
        """Subscribe to both arms; nothing is sent yet.

        Args:
            node: ROS node.
            job: the job.
            config: content of config/cell.json.
            known: measured properties of both arms; or a store of measurements, if the arms are to
                be measured.
        """
        self.node, self.config = node, config
        self.looks = known if isinstance(known, Looks) else None
        self._signs = None if isinstance(known, Looks) else [each.sign for each in known]
        self._grips: list[dict[str, Any] | None] = config.get("grip", [None, None])
        self.take(job)
        self.fault, self.command, self.lost = "", "", False
        self._began, self._last = 0.0, 0.0
        self._q: list[dict[str, float]] = [{}, {}]
        self._measured = [-math.inf, -math.inf]
        self._force: list[float | None] = [None, None]
        self._felt = [-math.inf, -math.inf]
        self._holds: list[bool | None] = [None, None]
        self._told = [-math.inf, -math.inf]
        self._switched: bool | None = None
        self._goals = 0
        self._calls: list[tuple[str, Any]] = []
        self._clients: dict[str, Any] = {}
        for topic in config["joint_states"]:
            node.create_subscription(JointState, topic, self._joints, NEWEST)
        for arm, source in enumerate(config["wrench"]):
            if source is not None:
                self._listen(arm, source)
        for arm, grip in enumerate(self._grips):
            if grip and grip["input"]:
                self._listen_to_hands(arm, grip["input"])
        node.create_subscription(String, "/carry/command", self._commanded, 10)
        self._actions = [
            ActionClient(node, FollowJointTrajectory, group["action"]) for group in config["groups"]
        ]

    def take(self, job: Job) -> None:
        """Store a job to be run next."""
        sensors = [source is not None and self.looks is None for source in self.config["wrench"]]
        inputs = [bool(grip and grip["input"]) for grip in self._grips]
        self.job = job
        self.machine = Machine(job, self.config["lag"], LEAD_OF_STOP, sensors, inputs)

    def _joints(self, message: Any) -> None:
        for arm, robot in enumerate(self.job.robots):
            known = dict(zip(message.name, message.position, strict=False))
            if all(name in known for name in robot["ros_joints"]):
                self._q[arm] = known
                self._measured[arm] = self._stamp(message)

    def _stamp(self, message: Any) -> float:
        """Return the time stamp of a message [s], or the present time if it has none."""
        stamp = message.header.stamp
        return stamp.sec + 1e-9 * stamp.nanosec or self.now()

    def _listen(self, arm: int, source: dict[str, Any]) -> None:
        axis = source["axis"]

        def heard(message: Any) -> None:
            force = message.wrench.force
            along = axis[0] * force.x + axis[1] * force.y + axis[2] * force.z
            self._force[arm], self._felt[arm] = along, self._stamp(message)

        self.node.create_subscription(WrenchStamped, source["topic"], heard, NEWEST)

    def _listen_to_hands(self, arm: int, source: dict[str, Any]) -> None:
        pin = source["pin"]

        def heard(message: Any) -> None:
            if pin is None:
                self._holds[arm] = bool(message.data)
            else:
                lines = message.digital_in_states
                self._holds[arm] = next(
                    (bool(line.state) for line in lines if line.pin == pin), None
                )
            self._told[arm] = self.now()

        self.node.create_subscription(type_of(source["kind"]), source["topic"], heard, NEWEST)

    def _switch(self) -> None:
        """Call the ROS services that switch the hands, if their commanded state has changed. If a
        service refuses, this is reported as a fault when its answer arrives."""
        if self.machine.grip == self._switched:
            return
        self._switched = self.machine.grip
        level = "on" if self._switched else "off"
        calls = [(grip["name"], grip["kind"], [grip[level]]) for grip in filter(None, self._grips)]
        for k, call in enumerate(calls):
            # One valve may serve both arms.
            if call not in calls[:k]:
                self.call(*call)

    def _commanded(self, message: Any) -> None:
        self.command = message.data.strip()

    def now(self) -> float:
        """Return the time of the node's clock [s]."""
        return float(self.node.get_clock().now().nanoseconds) * 1e-9

    def seen(self) -> Seen:
        """Return the measured state of the arms now."""
        for name, future in [call for call in self._calls if call[1].done()]:
            answer = future.result()
            if not getattr(answer, "ok", getattr(answer, "success", answer is not None)):
                reason = getattr(answer, "error", getattr(answer, "message", ""))
                self.fault = self.fault or f"{name} was refused: {reason or 'without a reason'}"
        self._calls = [call for call in self._calls if not call[1].done()]
        now, silence = self.now(), self.job.limits.silence
        holds = zip(self._holds, self._told, strict=True)
        return Seen(
            q=[
                [known[name] for name in robot["ros_joints"]] if known else None
                for known, robot in zip(self._q, self.job.robots, strict=True)
            ],
            force=[self._normal_force(arm, now) for arm in (0, 1)],
            age=[max(0.0, now - then) for then in self._measured],
            grip=[on if now - then <= silence else None for on, then in holds],
            fault=self.fault,
            lost=self.lost,
        )

    def _normal_force(self, arm: int, now: float) -> float | None:
        """Return the measured normal force of an arm's pad [N]; None without a recent reading, or
        while the arms are being measured.

        Args:
            arm: index of the arm.
            now: time [s].
        """
        raw = self._raw(arm, now)
        return None if raw is None or self._signs is None else self._signs[arm] * raw

    def _raw(self, arm: int, now: float) -> float | None:
        return self._force[arm] if now - self._felt[arm] <= self.job.limits.silence else None

    def spin(self, until: float) -> None:
        """Handle messages until a time [s]."""
        while (left := until - self.now()) > 0.0:
            rclpy.spin_once(self.node, timeout_sec=left)

    def wait(self, futures: Sequence[Any], what: str) -> list[Any]:
        """Wait for ROS futures and return their results, in the same order.

        Args:
            futures: the futures.
            what: text for the error message that names what is awaited.

        Raises:
            Refused: the results take longer than `PATIENCE`.
        """
        begin = self.now()
        while not all(future.done() for future in futures):
            if self.now() - begin > PATIENCE:
                raise Refused(f"{what} does not answer")
            rclpy.spin_once(self.node, timeout_sec=PERIOD)
        return [future.result() for future in futures]

    def call(self, name: str, kind: str, requests: Sequence[dict[str, Any]]) -> Any:
        """Call a ROS service, without waiting for its answer. A refusal is reported as a fault when
        it arrives.

        Args:
            name: name of the service.
            kind: type of the service.
            requests: alternative requests for different versions of the driver, each as values of
                its fields by name. The first that fits the service's type is sent.

        Raises:
            Refused: none of the requests fits.
        """
        for request in requests:
            message = type_of(kind).Request()
            try:
                fill(message, request)
            except AttributeError:
                continue
            break
        else:
            raise Refused(f"{name}: this driver defines another {kind}")
        future = self._clients[name].call_async(message)
        self._calls.append((name, future))
        return future

    def _find(self, name: str, kind: str) -> None:
        """Find a service, so that a missing one is noticed before anything moves.

        Args:
            name: name of the service.
            kind: type of the service.

        Raises:
            Refused: there is no such service.
        """
        self._clients[name] = self.node.create_client(type_of(kind), name)
        if not self._clients[name].wait_for_service(timeout_sec=PATIENCE):
            raise Refused(f"{name} is not there; are the controllers launched?")

    def prepare(self) -> None:
        """Check the arms, then call the services that config/cell.json lists under `prepare`, in
        the order of the list.

        Raises:
            Refused: a service is missing or refuses, or an arm is not at its first position.
        """
        for group, client in zip(self.config["groups"], self._actions, strict=True):
            if not client.wait_for_server(timeout_sec=PATIENCE):
                raise Refused(f"{group['action']} is not there; are the controllers launched?")
        for call in (*self.config["prepare"], *filter(None, self._grips)):
            self._find(call["name"], call["kind"])
        self.check()
        for call in self.config["prepare"]:
            self.wait([self.call(**call)], call["name"])
            if self.seen().fault:
                raise Refused(self.fault)

    def check(self) -> None:
        """Check that both arms are ready for the job.

        Raises:
            Refused: an arm is not ready.
        """
        while self.now() == 0.0:
            # A simulator's clock is not there yet.
            rclpy.spin_once(self.node, timeout_sec=PERIOD)
        self.spin(self.now() + SETTLE)
        self.machine.check(self.seen())

    def send(self, moments: Sequence[Moment], begin: float) -> None:
        """Send each controller its part of the path, and wait until it is accepted.

        Args:
            moments: future states of the job on its path.
            begin: time at which the first state is to be reached [s].

        Raises:
            Refused: a controller rejects it.
        """
        goals = [self._goal(group["arms"], moments, begin) for group in self.config["groups"]]
        # Large goals take long to build: none is sent before all are there.
        both = zip(self._actions, goals, strict=True)
        sent = [client.send_goal_async(goal) for client, goal in both]
        self._goals += 1
        handles = self.wait(sent, "a controller")
        taken = dict(zip((g["action"] for g in self.config["groups"]), handles, strict=True))
        refusing = [action for action, handle in taken.items() if not handle.accepted]
        if refusing:
            raise Refused(f"{' and '.join(refusing)} does not take its goal")
        for group, handle in zip(self.config["groups"], handles, strict=True):
            handle.get_result_async().add_done_callback(self._ended(group["action"], self._goals))

    def _ended(self, action: str, number: int) -> Any:
        def ended(future: Any) -> None:
            done = future.result()
            if number == self._goals and done.status != GoalStatus.STATUS_SUCCEEDED:
                reason = done.result.error_string or f"status {done.status}"
                self.fault = self.fault or f"{action} ended: {reason}"
                self.lost = True

        return ended

    def _goal(self, arms: Sequence[int], moments: Sequence[Moment], begin: float) -> Any:
        # Without tolerances: a controller that gives up by itself drops the squeeze.
        sec, nanosec = parts(begin)
        trajectory = JointTrajectory(
            header=Header(stamp=Time(sec=sec, nanosec=nanosec)),
            joint_names=self._joined(arms, [self.job.robots[arm]["ros_joints"] for arm in arms]),
            points=[self._point(arms, moment) for moment in moments],
        )
        return FollowJointTrajectory.Goal(trajectory=trajectory)

    def _joined(self, arms: Sequence[int], rows: Sequence[Sequence[Any]]) -> list[Any]:
        """Join the values of several arms' joints to one list. A joint that moves both arms is
        listed once, with its value of the first arm.

        Args:
            arms: indices of the arms.
            rows: for each arm the values of its joints.

        Returns:
            One value for each joint, in the order of the arms.
        """
        found: dict[str, Any] = {}
        for arm, row in zip(arms, rows, strict=True):
            for name, value in zip(self.job.robots[arm]["ros_joints"], row, strict=True):
                found.setdefault(name, value)
        return list(found.values())

    def _point(self, arms: Sequence[int], at: Moment) -> Any:
        job, r = self.job, at.rate
        rates = self._joined(arms, [job.linear(arm, "velocity", at.s) for arm in arms])
        seconds = self._joined(arms, [job.linear(arm, "acceleration", at.s) for arm in arms])
        sec, nanosec = parts(at.time)
        efforts = [job.effort(arm, "without_gravity", at.s, r) for arm in arms]
        return JointTrajectoryPoint(
            positions=self._joined(arms, [job.position(arm, at.s) for arm in arms]),
            velocities=[r * v for v in rates],
            accelerations=[r * r * a + at.change * v for v, a in zip(rates, seconds, strict=True)],
            effort=self._joined(arms, efforts),
            time_from_start=Duration(sec=sec, nanosec=nanosec),
        )

    def start(self) -> None:
        """Send the whole job and start it.

        Raises:
            Refused: the arms are not ready.
        """
        self.machine.start(self.seen())
        self._begin(1.0)

    def _begin(self, rate: float) -> None:
        moments = list(self.machine.clock.ahead(rate, self.config["step"]))
        self._began = self.now() + LEAD
        try:
            self.send(moments, self._began)
        except Refused as error:
            # A controller that has taken its goal does not begin alone: it holds what it holds.
            self.machine.hold(str(error))
            with suppress(Refused):
                self.send([Moment(0.0, self.machine.clock.s, 0.0, 0.0)], self._began)
            raise
        self.spin(self._began)
        self._last = self._began

    def tick(self) -> None:
        """Check the arms, and stop them or advance the job."""
        machine = self.machine
        before, now, seen = machine.state, self.now(), self.seen()
        machine.tick(now - self._last, seen)
        self._last = now
        if self.looks is not None:
            self.looks.note(now, machine, seen, [self._raw(arm, now) for arm in (0, 1)])
        if machine.opened:
            self._go_on(machine.clock.rate)
        self._switch()
        if before == "running" and machine.state in ("stopping", "landing", "held"):
            self._stop()
        if before == "landing" and machine.state == "running":
            self._go_on(1.0)
        if before != machine.state:
            self.node.get_logger().info(machine.status())
        if machine.state == "held" and self.command in ("continue", "back"):
            self._resume(1.0 if self.command == "continue" else -1.0)

    def stop(self, reason: str) -> None:
        """Stop both arms along the path.

        Args:
            reason: reason of the stop, for messages.
        """
        if self.machine.state == "running":
            self.machine.stop(reason)
            self._stop()

    def _stop(self) -> None:
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
            self.node.get_logger().error(f"{error}; its arm goes on as it was last told")

    def drive(self, part: Job, word: str) -> bool:
        """Run a part of the job to its end and back, after somebody has typed a word.

        Args:
            part: the part of the job.
            word: word that has to be typed at the terminal.

        Returns:
            True if this run was completed.
        """
        self.take(part)
        self.node.get_logger().info(BLOCK if word else AIR)
        while self.command != word and not self.fault:
            self.spin(self.now() + PERIOD)
        self.check()
        self.start()
        if self.look_after():
            return False
        self.machine.hold("it goes back")
        self._resume(-1.0)
        return self.look_after() == BACK

    def _resume(self, direction: float) -> None:
        self.command, self.fault, self.lost = "", "", False
        try:
            self.machine.resume(direction, self.seen())
        except Refused as error:
            self.machine.hold(str(error))
            self.node.get_logger().error(self.machine.status())
        else:
            self._go_on(direction)

    def _go_on(self, direction: float) -> None:
        try:
            self._begin(direction)
        except Refused as error:
            self.machine.hold(str(error))
            self.node.get_logger().error(self.machine.status())

    def interrupt(self, *_: object) -> None:
        """Stop the job on Ctrl-C; if the job already holds, end the program."""
        if self.machine.state == "held":
            self.command = "leave"
        self.fault = self.fault or CTRL_C

    def look_after(self) -> int:
        """Supervise the started job until it ends. Return the exit code."""
        machine = self.machine
        try:
            while machine.state != "done":
                self.spin(self.now() + PERIOD)
                self.tick()
                if machine.state == "held" and self.command == "leave":
                    self.node.get_logger().error(f"left while {machine.status()}")
                    return 1
        except BaseException:
            self.stop("run_job.py has failed")
            raise
        return 0 if machine.clock.s > 0.0 else BACK


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the job. Return the exit code, 0 when the job is done.

    Args:
        arguments: arguments of the command line; None for those of this process.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    add_options(parser)
    options = parser.parse_args(arguments)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    config = json.loads((BUNDLE / "config/cell.json").read_text("utf-8"))
    clock = Parameter("use_sim_time", value=config["simulated"])
    node = rclpy.create_node("run_job", parameter_overrides=[clock])
    try:
        job, plan = Job.read(BUNDLE / "job.json"), config["plan"]
        is_free = options.check or options.in_air or options.bring_up
        looks = Looks()
        run = Run(node, job, config, looks if is_free else require(BUNDLE, job, plan))
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, run.interrupt)
        if options.check:
            run.check()
            node.get_logger().info("both arms are at their first places")
            return 0
        run.prepare()
        if options.bring_up:
            return bring_up(BUNDLE, job, plan, run.drive, looks)
        if options.in_air:
            run.take(unloaded(job))
        run.check()
        run.start()
        return run.look_after()
    except Refused as error:
        node.get_logger().error(str(error))
        return 2
    finally:
        rclpy.shutdown()


if __name__ == "__main__":
    sys.exit(main())
