"""Streams the job to both arms of an ABB cell: python3 run_egm.py [--check|--in-air|--bring-up]

Start CarryEgm in both tasks first. One clock drives both arms: each message of a controller is
answered with the arm's commanded position, its lag ahead. The arm that presses is moved along its
pad's normal until its sensor measures the force of the job. Ctrl-C, an arm that is silent, late or
off its path, or a force out of its band stops the clock; both arms hold their places and keep
pressing. Then type 'continue' or 'back' to set the box down; 'leave' ends the stream, and the
controllers hold the arms.

Messages are protocol buffers of version 2, numbers of fields after egm.proto of RobotWare: EgmRobot
header 1 (seqno 1), feedBack 2 (joints 1: joints 1; externalJoints 3: joints 1), mciState 5,
measuredForce 9; EgmSensor header 1 (seqno 1, tm 2, mtype 3), planned 2 (joints 1, externalJoints
3). Joints are in degrees.
"""

from __future__ import annotations

import json
import logging
import math
import select
import socket
import struct
import sys
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from hybrid_opt.extras.bundles.programs.bring_up import Looks, Measured
from hybrid_opt.extras.bundles.programs.carry_job import Job, Refused
from hybrid_opt.extras.bundles.programs.carry_machine import Machine, Seen
from hybrid_opt.extras.bundles.programs.carry_program import JobRun, options_of, run

BUNDLE = Path(__file__).resolve().parent

PATIENCE = 30.0
"""Longest wait for both controllers [s]."""

LONGEST_TICK = 0.02
"""Largest time by which the job advances between two messages [s], so that a pause of this computer
does not make the arms jump."""

KEPT = 250
"""Number of stored positions of the pressing pad; they cover more than an arm's lag and the largest
silence."""

MOST_PRESSED = 1.2
"""Ratio of measured to commanded force above which the pad moves no farther into the box."""

CREEP = 0.002
"""Speed of the pressing pad while its stiffness is measured [m/s]."""


class Press:
    """Controller of the pressing pad's position along its normal that adjusts the normal force.

    Attributes:
        way: distance beyond the planned position, into the box [m].
    """

    def __init__(self, config: dict[str, Any]) -> None:
        """Start with the pad at its planned position.

        Args:
            config: settings `press` of the bundle: gain of the integral, largest depth [m] and
                speed [m/s], and compliance of both arms [m/N].
        """
        self.way = 0.0
        self._missing = 0.0
        self._gain, self._most = config["gain"], config["most"]
        self._speed, self._compliance = config["speed"], config["compliance"]

    def tick(self, dt: float, wanted: float, soon: float, felt: float | None) -> None:
        """Move the pad for one time step so that the normal force approaches the commanded one.

        The attribute `way` approaches the depth at which the arms' compliance gives the force,
        corrected by the integral of the measured error. Its speed and magnitude are bounded.

        Args:
            dt: time since the last call [s].
            wanted: commanded normal force now [N].
            soon: commanded normal force one delay of the arm later [N].
            felt: measured normal force [N]; None if there is none or the integral is to stay.
        """
        if wanted <= 0.0:
            self._missing = 0.0
        elif felt is not None:
            self._missing += self._gain * (wanted - felt) * dt
        target = self._compliance * max(soon, 0.0) + self._missing
        target = min(max(target, -self._most), self._most)
        if felt is not None and felt > MOST_PRESSED * max(wanted, soon):
            # Stiffer than measured, or not where it should be: no farther into it.
            target = min(target, self.way)
        self._move(target, self._speed * dt)

    def creep(self, dt: float, wanted: float, felt: float) -> None:
        """Move the pad for one time step at a constant low speed, to measure an unknown stiffness.

        It moves into the block while the measured force is too small, otherwise back.

        Args:
            dt: time since the last call [s].
            wanted: commanded normal force [N].
            felt: measured normal force [N].
        """
        self._move(self._most if felt < wanted else 0.0, CREEP * dt)

    def _move(self, target: float, step: float) -> None:
        self.way += min(max(target - self.way, -step), step)


class Stream(JobRun):
    """The control of both arms by EGM: it answers each message of a controller with a commanded
    position."""

    def __init__(
        self,
        job: Job,
        config: dict[str, Any],
        known: Sequence[Measured] | Looks,
        log: Any,
        sockets: Sequence[socket.socket] = (),
    ) -> None:
        """Prepare to answer both controllers. Nothing is sent before they begin.

        Args:
            job: the job to run.
            config: content of config/egm.json.
            known: measured properties of both arms; or a store of measurements if they are to be
                measured.
            log: logger with the methods `info` and `error`.
            sockets: bound UDP socket for each arm's controller.
        """
        super().__init__(known, log)
        self.config = config
        self._arm: int = config["press"]["arm"]
        self._q: list[list[float] | None] = [None, None]
        self._follows = [False, False]
        self._force: list[float | None] = [None, None]
        self._news = [-math.inf, -math.inf]
        self._sockets, self._waiting = sockets, [*sockets, sys.stdin]
        # A name that is no address is looked up once, before the stream.
        self._hosts = [socket.gethostbyname(host) for host in config["addresses"]]
        self.dropped = 0
        self.take(job)

    def take(self, job: Job) -> None:
        """Store the job that is to run next, and begin at its start."""
        self.job = job
        sensors = self.config["sensors"] if self.signs else (False, False)
        self.machine = Machine(job, 0.0, sensors=sensors)
        self.press = Press(self.config["press"])
        self._first: list[list[float] | None] = [None, None]
        self._now: float | None = None
        self._ways = deque[tuple[float, float]](maxlen=KEPT)

    def seen(self) -> Seen:
        """Return the measured state of the arms at the time of the last tick."""
        now, q = self._now or 0.0, list(self._q)
        pressing = q[self._arm]
        if pressing is not None:
            # Where it would be without what it had been moved into the box when it was measured.
            inward = self._inward(self.machine.clock.s)
            then = self._news[self._arm] - self.config["lags"][self._arm]
            way = next((way for time, way in reversed(self._ways) if time <= then), 0.0)
            q[self._arm] = [a - way * slope for a, slope in zip(pressing, inward, strict=True)]
        force: list[float | None] = [None, None]
        if self.signs:
            both = zip(self.signs, self._force, strict=True)
            force = [None if raw is None else sign * raw for sign, raw in both]
        age = [now - then for then in self._news]
        return Seen(q=q, force=force, age=age, fault=self.fault, lost=self.lost)

    def hear(self, arm: int, message: FromRobot, now: float) -> None:
        """Store the measured state that a message of an arm's controller contains.

        Args:
            arm: index of the arm.
            message: the decoded message.
            now: time of its arrival, on this computer's clock [s].
        """
        degrees = self._in_chain(arm, message.joints, message.further)
        if degrees is None:
            return
        self._q[arm] = [math.radians(value) for value in degrees]
        self._first[arm] = self._first[arm] or self._q[arm]
        self._news[arm] = now
        if self.config["sensors"][arm]:
            # About carryPad, whose z axis is the pad's normal.
            self._force[arm] = message.force[2] if len(message.force) >= 3 else None
        self._follows[arm] = message.running
        if self.machine.state == "running" and not message.running:
            self.fail(self._not_following(arm), lost=True)

    def _not_following(self, arm: int) -> str:
        return f"the controller of {self.job.robots[arm]['name']} does not follow"

    @property
    def missing(self) -> str:
        """Reason why the job cannot begin yet, '' if it can."""
        if None in self._first:
            return "a controller is silent"
        return "" if all(self._follows) else self._not_following(self._follows.index(False))

    def check(self) -> None:
        """Wait for both controllers, and raise a `Refused` if one does not begin or an arm is not
        ready for the job."""
        begin = time.monotonic()
        while self.missing and not self.fault:
            self.cycle()
            if time.monotonic() - begin > PATIENCE:
                raise Refused(f"{self.missing}: is CarryEgm running in both tasks?")
        super().check()

    def prepare(self) -> None:
        """Do nothing: the programs in the robots prepare their controllers."""

    def go_on(self, direction: float) -> None:
        """Do nothing: every cycle sends the next command, in either direction of the job."""

    def read(self, arm: int, data: bytes, host: str) -> FromRobot | None:
        """Decode a packet that arrived at an arm's socket.

        Args:
            arm: index of the arm.
            data: content of the packet.
            host: IP address of its sender.

        Returns:
            The message; None if the packet is damaged or not from the arm's controller. Such
            packets are counted in `dropped`.
        """
        if host == self._hosts[arm]:
            with suppress(ValueError):
                return read_robot(data)
        self.dropped += 1
        return None

    def status(self) -> str:
        """Return a text that says in which state the job is."""
        strange = f" {self.dropped} packets were dropped, from other hosts or damaged."
        return super().status() + (strange if self.dropped else "")

    def cycle(self) -> None:
        """Handle both controllers' messages for a short time: store the measured states, advance
        the job, and answer with commands. Read a word of the operator from the terminal."""
        ready, _, _ = select.select(self._waiting, [], [], 0.01)
        now = time.monotonic()
        heard: dict[int, tuple[FromRobot, Any]] = {}
        for arm, source in enumerate(self._sockets):
            # What came while this computer was busy is old: the newest message counts.
            for data, address in received(source):
                message = self.read(arm, data, address[0])
                if message is not None:
                    self.hear(arm, message, now)
                    heard[arm] = message, address
        self.tick(now)
        for arm, (message, address) in heard.items():
            self._sockets[arm].sendto(self.answer(arm, message.number, now), address)
        if sys.stdin in ready:
            line = sys.stdin.readline()
            self.command = line.strip()
            if not line:
                self._waiting.remove(sys.stdin)

    def tick(self, now: float) -> None:
        """Advance a job that has begun to the time `now` [s]."""
        dt = 0.0 if self._now is None else min(now - self._now, LONGEST_TICK)
        self._now, before = now, self.machine.state
        if before == "ready":
            return
        seen = self.seen()
        self.machine.tick(dt, seen)
        self._press(dt, seen)
        self._ways.append((now, self.press.way))
        self.obey()
        if before != self.machine.state:
            self.log.info(self.status())

    def _press(self, dt: float, seen: Seen) -> None:
        """Move the pressing pad for one time step of dt [s].

        Usually the measured force controls the motion; while the arms are measured, the pad creeps
        instead and the readings are stored.
        """
        clock, is_running = self.machine.clock, self.machine.state == "running"
        soon = clock.s + clock.rate * self.config["lags"][self._arm]
        wanted, later = (self.job.force(self._arm, s) for s in (clock.s, soon))
        if self.looks is not None:
            raw = self._force[self._arm]
            if is_running:
                if raw is not None:
                    self.press.creep(dt, wanted, abs(raw - self.looks.offset(self._arm)))
                assert self._now is not None, "a tick has a time"
                self.looks.note(self._now, self.machine, seen, list(self._force), self.press.way)
            return
        own, other = seen.force[self._arm], seen.force[1 - self._arm]
        # A job that stops may do so because a sensor is wrong: what was integrated stays.
        felt = (other if own is None else own) if is_running else None
        self.press.tick(dt, wanted, later, felt)
        spare = self.job.limits.force * self.job.force(self._arm, self.job.pressed)
        if felt is not None and clock.s < self.job.pressed and felt > later + spare:
            # The band begins when the pads hold; arms stiffer than measured show before.
            name = self.job.robots[self._arm]["name"]
            self.fail(f"{name} presses {felt:.1f} N instead of {wanted:.1f} N", lost=True)

    def answer(self, arm: int, number: int, now: float) -> bytes:
        """Encode the message that commands an arm's joint positions.

        To compensate the delay of the arm, it commands the positions that the path reaches one
        delay later.

        Args:
            arm: index of the arm.
            number: number of the message.
            now: time of the message [s].
        """
        clock, first = self.machine.clock, self._first[arm]
        if self.machine.state == "ready" and first is not None:
            q = first
        else:
            ahead = clock.s + clock.rate * self.config["lags"][arm]
            q = self.job.position(arm, ahead)
            if arm == self._arm:
                inward = self._inward(clock.s)
                q = [value + self.press.way * slope for value, slope in zip(q, inward, strict=True)]
        return to_robot(number, now, *self._as_abb(arm, [math.degrees(value) for value in q]))

    def _inward(self, s: float) -> list[float]:
        """Compute how far each joint of the pressing arm turns per metre by which its pad moves
        into the box along the contact normal [rad/m].

        Values at the planned time s [s] are interpolated linearly between the samples of the job.
        """
        rows, time = self.config["inward"], self.job.time
        k = min(max(bisect_left(time, s) - 1, 0), len(rows) - 2)
        share = min(max((s - time[k]) / (time[k + 1] - time[k]), 0.0), 1.0)
        return [a + share * (b - a) for a, b in zip(rows[k], rows[k + 1], strict=True)]

    def _in_chain(
        self, arm: int, joints: Sequence[float], further: Sequence[float]
    ) -> list[float] | None:
        """Convert an arm's joint positions from ABB's order to the order of its joints, base first.

        ABB counts the third of seven joints as an external axis.

        Args:
            arm: index of the arm.
            joints: positions of the robot's axes [degrees].
            further: positions of the external axes [degrees].

        Returns:
            Joint positions [degrees]; None if their number is wrong.
        """
        count = len(self.job.robots[arm]["joints"])
        if len(joints) < 6 or (count == 7 and not further):
            return None
        found = list(joints[:6])
        return found if count == 6 else [*found[:2], further[0], *found[2:]]

    def _as_abb(self, arm: int, degrees: list[float]) -> tuple[list[float], list[float]]:
        if len(self.job.robots[arm]["joints"]) == 6:
            return degrees, []
        return degrees[:2] + degrees[3:], [degrees[2]]


def received(source: socket.socket) -> Iterator[tuple[bytes, Any]]:
    """Yield content and sender's address of each packet that waits in a socket."""
    with suppress(BlockingIOError):
        while True:
            yield source.recvfrom(4096, socket.MSG_DONTWAIT)


CORRECTION = 3
"""Type of a message to the controller."""

RUNNING = 3
"""State of EGM in which the controller follows commands."""


@dataclass(frozen=True)
class FromRobot:
    """A message from a controller.

    Attributes:
        number: number of the message.
        joints, further: positions of the robot's axes and of the external axes [degrees].
        force: measured force (3) [N] and moment (3) [N m]; empty without a sensor.
        running: True if the controller follows commands.
    """

    number: int
    joints: tuple[float, ...]
    further: tuple[float, ...]
    force: tuple[float, ...]
    running: bool


def read_robot(data: bytes) -> FromRobot:
    """Decode a message from a controller.

    Raises:
        ValueError: the bytes are not such a message.
    """
    numbers = _integers(_inside(data, 1), 1)
    return FromRobot(
        numbers[0] if numbers else 0,
        _doubles(_inside(data, 2, 1, 1)),
        _doubles(_inside(data, 2, 3, 1)),
        # Newer controllers tell first whether force control is active.
        _doubles(_inside(data, 9, 1) or _inside(data, 9, 2)),
        RUNNING in _integers(_inside(data, 5), 1),
    )


def to_robot(number: int, time: float, joints: Sequence[float], further: Sequence[float]) -> bytes:
    """Encode a message that commands the axes of a controller.

    Args:
        number: number of the message.
        time: time of the message [s].
        joints, further: positions of the robot's axes and of the external axes [degrees].
    """
    header = _field(1, number) + _field(2, round(1e3 * time) % 2**32) + _field(3, CORRECTION)
    planned = _field(1, _repeated(joints)) + (_field(3, _repeated(further)) if further else b"")
    return _field(1, header) + _field(2, planned)


def _inside(data: bytes, *path: int) -> bytes:
    """Return the content of a field of a protobuf message that lies at a path of field numbers.
    Several values of the field are joined, since protobuf merges messages in this way.
    """
    for number in path:
        parts = (value for field, value in _fields(data) if field == number)
        data = b"".join(value for value in parts if isinstance(value, bytes))
    return data


def _integers(data: bytes, number: int) -> list[int]:
    return [v for field, v in _fields(data) if field == number and isinstance(v, int)]


def _doubles(data: bytes) -> tuple[float, ...]:
    if len(data) % 8:
        raise ValueError("this is no message of EGM")
    return struct.unpack(f"<{len(data) // 8}d", data)


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yield number and value of each field of a protobuf message. Values of varints are integers,
    all others bytes.

    Raises:
        ValueError: the bytes are not a message.
    """
    place = 0
    while place < len(data):
        key, place = _varint(data, place)
        kind = key & 7
        if kind == 0:
            value, place = _varint(data, place)
            yield key >> 3, value
            continue
        size = {1: 8, 5: 4}.get(kind)
        if kind == 2:
            size, place = _varint(data, place)
        if size is None or place + size > len(data):
            raise ValueError("this is no message of EGM")
        yield key >> 3, data[place : place + size]
        place += size


def _varint(data: bytes, place: int) -> tuple[int, int]:
    value = 0
    for k, byte in enumerate(data[place : place + 10]):
        value |= (byte & 0x7F) << (7 * k)
        if byte < 0x80:
            return value, place + k + 1
    raise ValueError("this is no message of EGM")


def _field(number: int, value: int | bytes) -> bytes:
    if isinstance(value, int):
        return _as_varint(number << 3) + _as_varint(value)
    return _as_varint(number << 3 | 2) + _as_varint(len(value)) + value


def _repeated(values: Sequence[float]) -> bytes:
    # Repeated doubles of version 2 are written one by one.
    return b"".join(_as_varint(1 << 3 | 1) + struct.pack("<d", value) for value in values)


def _as_varint(value: int) -> bytes:
    found = b""
    while value >= 0x80:
        found += bytes([value & 0x7F | 0x80])
        value >>= 7
    return found + bytes([value])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the bundle's program for EGM.

    Args:
        arguments: arguments of the command line; None for those of this process.

    Returns:
        Exit code, as in `run`.
    """
    options = options_of(__doc__, arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    log = logging.getLogger()
    try:
        config = json.loads((BUNDLE / "config/egm.json").read_text("utf-8"))
        sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in config["ports"]]
        for each, port in zip(sockets, config["ports"], strict=True):
            each.bind(("", port))
    except OSError as error:
        log.error(error)
        return 2
    return run(options, BUNDLE, config, partial(Stream, sockets=sockets), log)


if __name__ == "__main__":
    sys.exit(main())
