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

import argparse
import json
import math
import select
import signal
import socket
import struct
import sys
import time
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
from hybrid_opt.extras.bundles.programs.carry_machine import Machine, Seen

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

CTRL_C = "Ctrl-C"


class Press:
    """Controller of the pressing pad's position along its normal that adjusts the normal force.

    Attributes:
        way: distance beyond the planned position, into the box [m].
    """

    def __init__(self, config: dict[str, Any]) -> None:
        """Start with a pad at its planned position, without displacement.

        Args:
            config: settings of the bundle, of which `gain`, `most`, `speed` and `compliance` are
                read.
        """
        self.way = 0.0
        self._missing = 0.0
        self._gain, self._most = config["gain"], config["most"]
        self._speed, self._compliance = config["speed"], config["compliance"]

    def tick(self, dt: float, wanted: float, soon: float, felt: float | None) -> None:
        """Move the pad for one time step so that the normal force approaches the commanded one.

        The attribute `way`, the distance of the pad beyond its planned position, is changed. It
        approaches the depth at which the arms' compliance gives the force, corrected by the
        integral of the measured error. Its speed and depth are bounded.

        Args:
            dt: time step [s].
            wanted: commanded normal force now [N].
            soon: commanded normal force one delay of the arm later [N].
            felt: measured normal force [N]; None before the first measurement.
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
        """Move the pad for one time step at a constant low speed, in the direction that reduces the
        error of the force, to measure an unknown stiffness.

        Args:
            dt: time step [s].
            wanted: commanded normal force [N].
            felt: measured normal force [N].
        """
        self._move(self._most if felt < wanted else 0.0, CREEP * dt)

    def _move(self, target: float, step: float) -> None:
        self.way += min(max(target - self.way, -step), step)


class Stream:
    """The control of both arms by EGM: it answers each message of a controller with a commanded
    position."""

    def __init__(self, job: Job, config: dict[str, Any], known: Sequence[Measured] | Looks) -> None:
        """Prepare to wait for both controllers.

        Args:
            job: the job.
            config: settings of the bundle.
            known: measured properties of both arms; or a store of measurements, if the arms are to
                be measured.
        """
        self.job, self.config = job, config
        self.looks = known if isinstance(known, Looks) else None
        self._signs = None if isinstance(known, Looks) else [each.sign for each in known]
        sensors = config["sensors"] if self._signs else (False, False)
        self.machine = Machine(job, 0.0, sensors=sensors)
        self.press = Press(config["press"])
        self.fault, self.command = "", ""
        self._arm: int = config["press"]["arm"]
        self._q: list[list[float] | None] = [None, None]
        self._first: list[list[float] | None] = [None, None]
        self._follows = [False, False]
        self._force: list[float | None] = [None, None]
        self._news = [-math.inf, -math.inf]
        self._last: float | None = None
        self._ways = deque[tuple[float, float]](maxlen=KEPT)
        # A name that is no address is looked up once, before the stream.
        self._hosts = [socket.gethostbyname(host) for host in config["addresses"]]
        self.dropped = 0

    def seen(self, now: float) -> Seen:
        """Return the measured state of the arms.

        Args:
            now: time [s].
        """
        age = [now - then for then in self._news]
        q = list(self._q)
        pressing = q[self._arm]
        if pressing is not None:
            # Where it would be without what it had been moved into the box when it was measured.
            inward = self._inward(self.machine.clock.s)
            then = self._news[self._arm] - self.config["lags"][self._arm]
            way = next((way for time, way in reversed(self._ways) if time <= then), 0.0)
            q[self._arm] = [a - way * slope for a, slope in zip(pressing, inward, strict=True)]
        lost = self.fault not in ("", CTRL_C)
        force: list[float | None] = [None, None]
        if self._signs:
            both = zip(self._signs, self._force, strict=True)
            force = [None if raw is None else sign * raw for sign, raw in both]
        return Seen(q=q, force=force, age=age, fault=self.fault, lost=lost)

    def hear(self, arm: int, message: FromRobot, now: float) -> None:
        """Store the measured state in a message from an arm's controller.

        Args:
            arm: index of the arm.
            message: the message.
            now: time of its arrival [s].
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
            self.fault = self.fault or self._not_following(arm)

    def _not_following(self, arm: int) -> str:
        return f"the controller of {self.job.robots[arm]['name']} does not follow"

    @property
    def missing(self) -> str:
        """Reason why the job cannot begin yet, '' if it can."""
        if None in self._q:
            return "a controller is silent"
        return "" if all(self._follows) else self._not_following(self._follows.index(False))

    def read(self, arm: int, data: bytes, host: str) -> FromRobot | None:
        """Decode a packet from an arm's controller. Return None, and count the packet, if it is
        damaged or comes from another host.

        Args:
            arm: index of the arm.
            data: content of the packet.
            host: address of the sender.
        """
        if host == self._hosts[arm]:
            with suppress(ValueError, struct.error):
                return read_robot(data)
        self.dropped += 1
        return None

    def status(self) -> str:
        """Return a text that says in which state the job is."""
        strange = f" {self.dropped} packets were dropped, from other hosts or damaged."
        return self.machine.status() + (strange if self.dropped else "")

    def tick(self, now: float) -> None:
        """Advance the job to the time `now` [s]."""
        dt = 0.0 if self._last is None else min(now - self._last, LONGEST_TICK)
        self._last = now
        before = self.machine.state
        if before == "ready":
            return
        seen = self.seen(now)
        self.machine.tick(dt, seen)
        clock = self.machine.clock
        soon = clock.s + clock.rate * self.config["lags"][self._arm]
        wanted, later = (self.job.force(self._arm, s) for s in (clock.s, soon))
        if self.looks is None:
            own, other = seen.force[self._arm], seen.force[1 - self._arm]
            # A job that stops may do so because a sensor is wrong: what was integrated stays.
            felt = None
            if self.machine.state == "running":
                felt = own if own is not None else other
            self.press.tick(dt, wanted, later, felt)
            spare = self.job.limits.force * self.job.force(self._arm, self.job.pressed)
            if felt is not None and clock.s < self.job.pressed and felt > later + spare:
                # The band begins when the pads hold; arms stiffer than measured show before.
                name = self.job.robots[self._arm]["name"]
                self.fault = self.fault or f"{name} presses {felt:.1f} N instead of {wanted:.1f} N"
        elif self.machine.state == "running":
            raw = self._force[self._arm]
            if raw is not None:
                self.press.creep(dt, wanted, abs(raw - self.looks.offset(self._arm)))
            self.looks.note(now, self.machine, seen, list(self._force), self.press.way)
        self._ways.append((now, self.press.way))
        if self.machine.state == "held" and self.command in ("continue", "back"):
            direction = 1.0 if self.command == "continue" else -1.0
            self.command = self.fault = ""
            try:
                self.machine.resume(direction, self.seen(now))
            except Refused as error:
                self.machine.hold(str(error))
                print(self.status(), file=sys.stderr)
        if before != self.machine.state:
            print(self.status(), file=sys.stderr)

    def answer(self, arm: int, number: int, now: float) -> bytes:
        """Encode the message that commands an arm's joint positions.

        The positions are those that the path reaches one delay of the arm later.

        Args:
            arm: index of the arm.
            number: number of the message.
            now: time [s].
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
        joints, further = self._as_abb(arm, [math.degrees(value) for value in q])
        return to_robot(number, now, joints, further)

    def _inward(self, s: float) -> list[float]:
        """Compute how far each joint of the pressing arm turns per metre by which its pad moves
        into the box, along the contact normal.

        Args:
            s: planned time [s] since the beginning of the job.

        Returns:
            One value for each joint [rad/m], interpolated linearly between the samples of the job.
        """
        rows, time = self.config["inward"], self.job.time
        k = min(max(bisect_left(time, s) - 1, 0), len(rows) - 2)
        share = min(max((s - time[k]) / (time[k + 1] - time[k]), 0.0), 1.0)
        return [a + share * (b - a) for a, b in zip(rows[k], rows[k + 1], strict=True)]

    def _in_chain(
        self, arm: int, joints: Sequence[float], further: Sequence[float]
    ) -> list[float] | None:
        """Return an arm's joint positions in the order of its joints, base first [degrees]; None if
        their number is wrong. ABB counts the third of seven joints as an external axis.

        Args:
            arm: index of the arm.
            joints: positions of the robot's axes in a message [degrees].
            further: positions of the external axes in the message [degrees].
        """
        count = len(self.job.robots[arm]["joints"])
        if len(joints) < 6 or (count == 7 and not further):
            return None
        found = list(joints[:6])
        return found if count == 6 else [*found[:2], further[0], *found[2:]]

    def _as_abb(self, arm: int, degrees: list[float]) -> tuple[list[float], list[float]]:
        count = len(self.job.robots[arm]["joints"])
        if count == 6:
            return degrees, []
        return degrees[:2] + degrees[3:], [degrees[2]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Stream the job to both arms. Return the exit code, 0 when the job is done.

    Args:
        arguments: arguments of the command line; None for those of this process.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    add_options(parser)
    options = parser.parse_args(arguments)
    try:
        job = Job.read(BUNDLE / "job.json")
        config = json.loads((BUNDLE / "config/egm.json").read_text("utf-8"))
        sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in config["ports"]]
        for each, port in zip(sockets, config["ports"], strict=True):
            each.bind(("", port))

        def drive(part: Job, word: str) -> bool:
            stream = Stream(part, config, looks)
            print(BLOCK if word else AIR, file=sys.stderr)
            if streamed(stream, sockets, word=word):
                return False
            stream.machine.hold("it goes back")
            stream.command = "back"
            return streamed(stream, sockets) == BACK

        looks = Looks()
        if options.check or options.in_air:
            return streamed(Stream(unloaded(job), config, looks), sockets, options.check)
        if options.bring_up:
            return bring_up(BUNDLE, job, config["plan"], drive, looks)
        return streamed(Stream(job, config, require(BUNDLE, job, config["plan"])), sockets)
    except (OSError, Refused) as error:
        print(error, file=sys.stderr)
        return 2


def streamed(
    stream: Stream, sockets: Sequence[socket.socket], check: bool = False, word: str = ""
) -> int:
    """Answer both controllers until the job is done. Return the exit code.

    Args:
        stream: the control of both arms.
        sockets: UDP socket for each controller.
        check: True to check both arms without moving them.
        word: word that somebody has to type before the job begins.

    Raises:
        Refused: a controller does not begin, or an arm is not at its first position.
    """

    def interrupted(*_: object) -> None:
        if stream.machine.state == "held":
            stream.command = "leave"
        stream.fault = stream.fault or CTRL_C

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupted)
    begin = time.monotonic()
    waiting: list[Any] = [*sockets, sys.stdin]
    while stream.machine.state != "done":
        ready, _, _ = select.select(waiting, [], [], 0.01)
        now = time.monotonic()
        heard: dict[int, tuple[FromRobot, Any]] = {}
        for arm, source in enumerate(sockets):
            # What came while this computer was busy is old: the newest message counts.
            for data, address in received(source):
                message = stream.read(arm, data, address[0])
                if message is not None:
                    stream.hear(arm, message, now)
                    heard[arm] = message, address
        stream.tick(now)
        for arm, (message, address) in heard.items():
            sockets[arm].sendto(stream.answer(arm, message.number, now), address)
        if sys.stdin in ready:
            line = sys.stdin.readline()
            stream.command = line.strip()
            if not line:
                waiting.remove(sys.stdin)
        if stream.machine.state == "ready" and not stream.missing and stream.command == word:
            stream.machine.start(stream.seen(now))
            if check:
                print("both arms are at their first places", file=sys.stderr)
                return 0
        if stream.machine.state == "ready" and not word and now - begin > PATIENCE:
            raise Refused(f"{stream.missing}: is CarryEgm running in both tasks?")
        if stream.machine.state == "held" and stream.command == "leave":
            print(f"left while {stream.status()}", file=sys.stderr)
            return 1
    return 0 if stream.machine.clock.s > 0.0 else BACK


def received(source: socket.socket) -> Iterator[tuple[bytes, Any]]:
    """Yield each packet that waits in a socket: its content, and the sender's address as Python's
    `socket` gives it.

    Args:
        source: the socket.
    """
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

    Args:
        data: content of the packet.

    Raises:
        ValueError: the bytes are not such a message.
    """
    number, running = 0, False
    joints: tuple[float, ...] = ()
    further: tuple[float, ...] = ()
    force: tuple[float, ...] = ()
    for field, value in _fields(data):
        if isinstance(value, int):
            continue
        inner = list(_fields(value))
        if field == 1:
            number = next((v for f, v in inner if f == 1 and isinstance(v, int)), 0)
        elif field == 2:
            parts = {f: v for f, v in inner if isinstance(v, bytes)}
            joints = _doubles(parts.get(1, b""), (1,))
            further = _doubles(parts.get(3, b""), (1,))
        elif field == 5:
            running = any(f == 1 and v == RUNNING for f, v in inner)
        elif field == 9:
            # Newer controllers tell first whether force control is active.
            force = _doubles(value, (1, 2))
    return FromRobot(number, joints, further, force, running)


def to_robot(number: int, time: float, joints: Sequence[float], further: Sequence[float]) -> bytes:
    """Encode a message that commands the axes of a controller.

    Args:
        number: number of the message.
        time: time of the message [s].
        joints, further: positions of the robot's axes and of the external axes [degrees].
    """
    header = _number(1, number) + _number(2, round(1e3 * time) % 2**32) + _number(3, CORRECTION)
    planned = _bytes(1, _packed(joints))
    if further:
        planned += _bytes(3, _packed(further))
    return _bytes(1, header) + _bytes(2, planned)


def _packed(values: Sequence[float]) -> bytes:
    # Repeated doubles of version 2 are written one by one.
    return b"".join(_raw(1 << 3 | 1) + struct.pack("<d", value) for value in values)


def _doubles(data: bytes, numbers: tuple[int, ...]) -> tuple[float, ...]:
    found: list[float] = []
    for field, value in _fields(data):
        if field in numbers and isinstance(value, bytes) and len(value) % 8 == 0:
            found += struct.unpack(f"<{len(value) // 8}d", value)
    return tuple(found)


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yield number and value of each field of a protobuf message. Values of varints are integers,
    all others bytes.

    Args:
        data: the encoded message.

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
    for k in range(10):
        if place + k >= len(data):
            break
        value |= (data[place + k] & 0x7F) << (7 * k)
        if data[place + k] < 0x80:
            return value, place + k + 1
    raise ValueError("this is no message of EGM")


def _raw(value: int) -> bytes:
    found = b""
    while value >= 0x80:
        found += bytes([value & 0x7F | 0x80])
        value >>= 7
    return found + bytes([value])


def _number(field: int, value: int) -> bytes:
    return _raw(field << 3) + _raw(value)


def _bytes(field: int, value: bytes) -> bytes:
    return _raw(field << 3 | 2) + _raw(len(value)) + value


if __name__ == "__main__":
    sys.exit(main())
