"""Runs the job: python3 run_job.py [--check|--in-air|--bring-up], beside the launched controllers.

Both arms get the whole job at once. While they drive it, this program looks at them a hundred times
a second. Ctrl-C, an arm that is silent, late or off its path, a force out of its band: both arms
stop along the path and keep the squeeze. Then tell it on the topic /carry/command (std_msgs/String)
how to set the box down: 'continue' or 'back'; 'leave' ends the program, the arms hold on.

Hands that hold by themselves are switched where config/cell.json says, and waited for; a stop, an
end of this program or its failure switch nothing.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
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

from hybrid_opt.extras.bundles.programs.bring_up import Looks, Measured
from hybrid_opt.extras.bundles.programs.carry_job import Job, Refused
from hybrid_opt.extras.bundles.programs.carry_machine import Machine, Moment, Seen
from hybrid_opt.extras.bundles.programs.carry_program import JobRun, options_of, run

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

NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Quality of service for measurements: accepts reliable and best-effort publishers, and keeps no
queue."""


def parts(time: float) -> dict[str, int]:
    """Split a time [s] into the fields of a ROS time or duration: whole seconds and nanoseconds."""
    return dict(zip(("sec", "nanosec"), divmod(round(time * 1e9), 10**9), strict=True))


def type_of(kind: str) -> Any:
    """Return the Python class of a ROS message PACKAGE/msg/NAME or service PACKAGE/srv/NAME."""
    package, what, name = kind.split("/")
    return getattr(import_module(f"{package}.{what}"), name)


def fill(message: Any, values: dict[str, Any]) -> None:
    """Set the fields of a ROS message.

    Args:
        message: the message, changed in place.
        values: values by name of the field; a dictionary for a field that is itself a message.

    Raises:
        AttributeError: the message has no such field.
    """
    for name, value in values.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        else:
            setattr(message, name, value)


class Run(JobRun):
    """A run of the job by the controllers of both arms, with ROS names and settings from
    config/cell.json."""

    def __init__(
        self,
        job: Job,
        config: dict[str, Any],
        known: Sequence[Measured] | Looks,
        log: Any,
        node: Any,
    ) -> None:
        """Subscribe to the state of both arms; nothing is sent yet.

        Args:
            job: the job to run.
            config: content of config/cell.json.
            known: measured properties of both arms; or a store of measurements if they are to be
                measured.
            log: logger with the methods `info` and `error`.
            node: ROS node of the program.
        """
        super().__init__(known, log)
        self.node, self.config = node, config
        self._grips: list[dict[str, Any] | None] = config.get("grip", [None, None])
        self.take(job)
        self._began, self._last = 0.0, 0.0
        self._q: list[dict[str, float]] = [{}, {}]
        self._force: list[float | None] = [None, None]
        self._holds: list[bool | None] = [None, None]
        # Times of the last postures, forces and inputs of hands.
        self._measured, self._felt, self._told = ([-math.inf, -math.inf] for _ in range(3))
        self._switched: bool | None = None
        self._goals = 0
        self._calls: list[tuple[str, Any]] = []
        self._clients: dict[str, Any] = {}
        for topic in config["joint_states"]:
            node.create_subscription(JointState, topic, self._joints, NEWEST)
        for arm in (0, 1):
            wrench, grip = config["wrench"][arm], self._grips[arm]
            if wrench is not None:
                heard = partial(self._feel, arm, wrench["axis"])
                node.create_subscription(WrenchStamped, wrench["topic"], heard, NEWEST)
            if grip and grip["input"]:
                heard, source = partial(self._hear, arm, grip["input"]["pin"]), grip["input"]
                node.create_subscription(type_of(source["kind"]), source["topic"], heard, NEWEST)
        node.create_subscription(String, "/carry/command", self._commanded, 10)
        self._actions = {
            group["action"]: ActionClient(node, FollowJointTrajectory, group["action"])
            for group in config["groups"]
        }

    def take(self, job: Job) -> None:
        """Store the job that is to run next, and begin at its start."""
        sensors = [source is not None and self.looks is None for source in self.config["wrench"]]
        inputs = [bool(grip and grip["input"]) for grip in self._grips]
        self.job = job
        self.machine = Machine(job, self.config["lag"], LEAD_OF_STOP, sensors, inputs)

    def _joints(self, message: Any) -> None:
        known = dict(zip(message.name, message.position, strict=False))
        for arm, robot in enumerate(self.job.robots):
            if all(name in known for name in robot["ros_joints"]):
                self._q[arm], self._measured[arm] = known, self._stamp(message)

    def _stamp(self, message: Any) -> float:
        """Return the time stamp of a message [s], or the present time if it has none."""
        stamp = message.header.stamp
        return stamp.sec + 1e-9 * stamp.nanosec or self.now()

    def _feel(self, arm: int, axis: Sequence[float], message: Any) -> None:
        force = message.wrench.force
        self._force[arm] = axis[0] * force.x + axis[1] * force.y + axis[2] * force.z
        self._felt[arm] = self._stamp(message)

    def _hear(self, arm: int, pin: int | None, message: Any) -> None:
        if pin is None:
            self._holds[arm] = bool(message.data)
        else:
            lines = {line.pin: bool(line.state) for line in message.digital_in_states}
            self._holds[arm] = lines.get(pin)
        self._told[arm] = self.now()

    def _commanded(self, message: Any) -> None:
        self.command = message.data.strip()

    def _switch(self) -> None:
        """Call the services that switch the hands, if their commanded state has changed."""
        if self.machine.grip == self._switched:
            return
        self._switched = self.machine.grip
        level = "on" if self._switched else "off"
        calls = [(grip["name"], grip["kind"], [grip[level]]) for grip in filter(None, self._grips)]
        for k, call in enumerate(calls):
            # One valve may serve both arms.
            if call not in calls[:k]:
                self.call(*call)

    def now(self) -> float:
        """Return the time of the node's clock [s]."""
        return float(self.node.get_clock().now().nanoseconds) * 1e-9

    def seen(self) -> Seen:
        """Return the measured state of the arms now. If a service has refused a call, the state has
        this as its fault."""
        for name, future in [call for call in self._calls if call[1].done()]:
            answer = future.result()
            if not getattr(answer, "ok", getattr(answer, "success", answer is not None)):
                reason = getattr(answer, "error", getattr(answer, "message", ""))
                self.fail(f"{name} was refused: {reason or 'without a reason'}")
        self._calls = [call for call in self._calls if not call[1].done()]
        now, silence = self.now(), self.job.limits.silence
        force: list[float | None] = [None, None]
        if self.signs is not None:
            both = zip(self.signs, self._raw(now), strict=True)
            force = [None if raw is None else sign * raw for sign, raw in both]
        holds = zip(self._holds, self._told, strict=True)
        return Seen(
            q=[
                [known[name] for name in robot["ros_joints"]] if known else None
                for known, robot in zip(self._q, self.job.robots, strict=True)
            ],
            force=force,
            age=[max(0.0, now - then) for then in self._measured],
            grip=[on if now - then <= silence else None for on, then in holds],
            fault=self.fault,
            lost=self.lost,
        )

    def _raw(self, now: float) -> list[float | None]:
        """Return the reading of each arm's force sensor at the time `now` [s], in newtons; None if
        the last one is too old."""
        both, silence = zip(self._force, self._felt, strict=True), self.job.limits.silence
        return [force if now - then <= silence else None for force, then in both]

    def spin(self, until: float) -> None:
        """Handle ROS messages until the node's clock shows the time `until` [s]."""
        while (left := until - self.now()) > 0.0:
            rclpy.spin_once(self.node, timeout_sec=left)

    def wait(self, futures: Sequence[Any], what: str) -> list[Any]:
        """Wait for ROS futures and return their results.

        Args:
            futures: the futures.
            what: name of what has to answer, for messages.

        Raises:
            Refused: it takes longer than `PATIENCE`.
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
            name, kind: name and type of the service.
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
            future = self._clients[name].call_async(message)
            self._calls.append((name, future))
            return future
        raise Refused(f"{name}: this driver defines another {kind}")

    def prepare(self) -> None:
        """Check the arms, then call the services that config/cell.json lists under `prepare`, in
        the order of the list. Missing servers are noticed before anything moves.

        Raises:
            Refused: a server is missing or refuses, or an arm is not at its first position.
        """
        calls = [*self.config["prepare"], *filter(None, self._grips)]
        self._clients = {
            call["name"]: self.node.create_client(type_of(call["kind"]), call["name"])
            for call in calls
        }
        waits = {name: client.wait_for_server for name, client in self._actions.items()}
        waits |= {name: client.wait_for_service for name, client in self._clients.items()}
        for name, wait in waits.items():
            if not wait(timeout_sec=PATIENCE):
                raise Refused(f"{name} is not there; are the controllers launched?")
        self.check()
        for call in self.config["prepare"]:
            self.wait([self.call(**call)], call["name"])
            if self.seen().fault:
                raise Refused(self.fault)

    def check(self) -> None:
        """Listen to both arms, and raise a `Refused` if one is not ready for the job."""
        while self.now() == 0.0:
            # A simulator's clock is not there yet.
            rclpy.spin_once(self.node, timeout_sec=PERIOD)
        self.spin(self.now() + SETTLE)
        super().check()

    def send(self, moments: Sequence[Moment], begin: float) -> None:
        """Send the coming motion to the controllers, and wait until all accept it.

        Args:
            moments: future states of the job on its path.
            begin: time of the first state, on the clock of the node [s].

        Raises:
            Refused: a controller does not accept its part, or does not answer.
        """
        goals = [self._goal(group["arms"], moments, begin) for group in self.config["groups"]]
        # Large goals take long to build: none is sent before all are there.
        both = zip(self._actions.values(), goals, strict=True)
        sent = [client.send_goal_async(goal) for client, goal in both]
        self._goals += 1
        taken = dict(zip(self._actions, self.wait(sent, "a controller"), strict=True))
        refusing = [action for action, handle in taken.items() if not handle.accepted]
        if refusing:
            raise Refused(f"{' and '.join(refusing)} does not take its goal")
        for action, handle in taken.items():
            ended = partial(self._ended, action, self._goals)
            handle.get_result_async().add_done_callback(ended)

    def _ended(self, action: str, number: int, future: Any) -> None:
        done = future.result()
        if number == self._goals and done.status != GoalStatus.STATUS_SUCCEEDED:
            reason = done.result.error_string or f"status {done.status}"
            self.fail(f"{action} ended: {reason}", lost=True)

    def _goal(self, arms: Sequence[int], moments: Sequence[Moment], begin: float) -> Any:
        # Without tolerances: a controller that gives up by itself drops the squeeze.
        trajectory = JointTrajectory(
            header=Header(stamp=Time(**parts(begin))),
            joint_names=self._joined(arms, [self.job.robots[arm]["ros_joints"] for arm in arms]),
            points=[self._point(arms, moment) for moment in moments],
        )
        return FollowJointTrajectory.Goal(trajectory=trajectory)

    def _joined(self, arms: Sequence[int], rows: Sequence[Sequence[Any]]) -> list[Any]:
        """Join values of the joints of several arms to one list. A joint that moves both arms is
        listed once, with its value of the first arm.

        Args:
            arms: indices of the arms.
            rows: for each of these arms one value per joint.
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
        efforts = [job.effort(arm, "without_gravity", at.s, r) for arm in arms]
        return JointTrajectoryPoint(
            positions=self._joined(arms, [job.position(arm, at.s) for arm in arms]),
            velocities=[r * v for v in rates],
            accelerations=[r * r * a + at.change * v for v, a in zip(rates, seconds, strict=True)],
            effort=self._joined(arms, efforts),
            time_from_start=Duration(**parts(at.time)),
        )

    def start(self) -> None:
        """Send the whole job and start it, or raise a `Refused` if the arms are not ready."""
        super().start()
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

    def go_on(self, direction: float) -> None:
        """Send the motion of a job that continues, and start it.

        Args:
            direction: 1 forward, -1 back.
        """
        try:
            self._begin(direction)
        except Refused as error:
            self.hold(error)

    def cycle(self) -> None:
        """Handle messages for `PERIOD`; check the arms and stop or advance a job that has begun."""
        self.spin(self.now() + PERIOD)
        machine, before = self.machine, self.machine.state
        if before == "ready":
            return
        now, seen = self.now(), self.seen()
        machine.tick(now - self._last, seen)
        self._last = now
        if self.looks is not None:
            self.looks.note(now, machine, seen, self._raw(now))
        if machine.opened:
            self.go_on(machine.clock.rate)
        self._switch()
        if before == "running" and machine.state in ("stopping", "landing", "held"):
            self._stop()
        if before == "landing" and machine.state == "running":
            self.go_on(1.0)
        if before != machine.state:
            self.log.info(self.status())
        self.obey()

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
            self.log.error(f"{error}; its arm goes on as it was last told")

    def look_after(self) -> int:
        """Supervise the started job until it ends; stop both arms if this program fails. Return the
        exit code, as in `JobRun.look_after`."""
        try:
            return super().look_after()
        except BaseException:
            if self.machine.state == "running":
                self.machine.stop("run_job.py has failed")
                self._stop()
            raise


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the bundle's program for ROS 2.

    Args:
        arguments: arguments of the command line; None for those of this process.

    Returns:
        Exit code, as in `run`.
    """
    options = options_of(__doc__, arguments)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    config = json.loads((BUNDLE / "config/cell.json").read_text("utf-8"))
    clock = Parameter("use_sim_time", value=config["simulated"])
    node = rclpy.create_node("run_job", parameter_overrides=[clock])
    try:
        return run(options, BUNDLE, config, partial(Run, node=node), node.get_logger())
    finally:
        rclpy.shutdown()


if __name__ == "__main__":
    sys.exit(main())
