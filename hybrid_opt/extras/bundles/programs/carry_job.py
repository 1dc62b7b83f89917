"""A job as programs run it: what the arms do at each place of its path, and when they have to stop.

The job is a path that both arms follow together; its coordinate is the planned time s [s]. A clock
drives s: at rate 1 the job runs as planned, at rate 0 both arms hold their places and press, at
rate -1 the job runs backwards, which takes the same forces. Whatever goes wrong, the clock stops
smoothly: both arms come to rest at the same coordinate and keep the squeeze that belongs to it.

Hands that hold by themselves are switched on and off while the arms stand still, and the clock
waits there until their inputs say the same. Nothing else switches them: after any fault they hold.

Positions are cubic between samples, forces linear. Standard library only, Python 3.10 or newer.
"""

from __future__ import annotations

import json
import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

FORMAT, VERSION = "dual-arm-carry job", 2
"""Format of the file that holds a job."""

HELD = ("lift", "carry", "set_down")
"""Phases in which pads alone hold the box."""

STILL = 1e-9
"""Rates below this are none."""

SEARCH_STEP = 0.004
"""Between places that are compared with a measured posture [s]."""

FINE = 0.002
"""Longest step over which a changing rate is integrated [s]."""

NEAR = 0.002
"""A pad so near to its place is there [m]."""

SLOW = 0.25
"""Share of the fastest speed below which a posture says too little of the coordinate to call an arm
late."""

PRESSED = 0.98
"""Share of the force with which the box is lifted from which on the pads have to press."""

UNLOADED = 0.07
"""Largest force before the first contact, over the largest commanded one: an offset of the sensor
becomes an error of the squeeze."""

TOUCH = 0.005
"""A box that is set down may stand so far above its planned place [m]."""

STRIKES = 3
"""Consecutive checks with the same fault before a stop; a requested stop acts at once."""


class Refused(Exception):
    """The job cannot begin or go on; the message says why."""


@dataclass(frozen=True)
class Limits:
    """When a job stops, from its file.

    Attributes:
        stop_time: from the planned speed to rest along the path [s].
        quick_stop: the same for an arm that does not follow its commands [s].
        start: largest distance of a pad from its first place [m].
        path: largest distance of a pad from its path [m].
        behind: how far an arm may lag behind its reference [s].
        skew: how far both arms may be apart along the path [s].
        force: share by which a measured force may miss its reference while the box is held.
        silence: largest age of a measurement [s].
        grip: longest wait for the inputs of hands [s].
    """

    stop_time: float
    quick_stop: float
    start: float
    path: float
    behind: float
    skew: float
    force: float
    silence: float
    grip: float


@dataclass(frozen=True)
class Switch:
    """A phase in which hands are switched.

    Attributes:
        begin, end: its coordinates [s].
        on: what they are switched to on the way forward.
    """

    begin: float
    end: float
    on: bool


class Job:
    """A job from its file.

    Attributes:
        document: as it was read.
        time: planned time of each sample [s].
        robots: both arms' parts of the document.
        limits: when to stop.
    """

    def __init__(self, document: dict[str, Any]) -> None:
        """Take a document of this format.

        Raises:
            Refused: it is none, or of another version.
        """
        if document.get("format") != FORMAT or document.get("version") != VERSION:
            raise Refused(f"this is no job of version {VERSION}")
        self.document = document
        self.time: list[float] = document["time"]
        self.robots: list[dict[str, Any]] = document["robots"]
        self.limits = Limits(**document["machine"]["limits"])
        self._phases: list[tuple[float, str]] = [
            (self.time[phase["last"]], phase["name"]) for phase in document["phases"]
        ]
        self._early: list[tuple[list[float], list[float]]] | None = None
        self.switches = [
            Switch(self.time[phase["first"]], self.time[phase["last"]], phase["grip"])
            for phase in document["phases"]
            if "grip" in phase
        ]

    @classmethod
    def read(cls, path: Path) -> Job:
        """Read the job in a file.

        Raises:
            Refused: it cannot be read.
        """
        try:
            return cls(json.loads(path.read_text("utf-8")))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise Refused(f"{path}: no job can be read ({error})") from error

    @cached_property
    def fastest(self) -> float:
        """Largest speed of the first arm's pad [m/s]."""
        return max(self.speed(0, s) for s in self.time)

    @property
    def end(self) -> float:
        """The last coordinate [s]."""
        return self.time[-1]

    def phase(self, s: float) -> str:
        """Return the phase at a coordinate."""
        return next((name for last, name in self._phases if s <= last), self._phases[-1][1])

    def begin(self, name: str) -> float:
        """Return the coordinate at which a phase begins; the last one if there is none."""
        first = 0.0
        for last, phase in self._phases:
            if phase == name:
                return first
            first = last
        return self.end

    def is_touching(self, s: float) -> bool:
        """Return True if the box is so low in its set-down that it may stand."""
        if self.phase(s) != "set_down" or self.is_standing:
            return False
        places, (k, x, _) = self.document["box"]["pose"], self._place(s)
        last = places[bisect_right(self.time, self.begin("release")) - 1][:3]
        here = ((1.0 - x) * a + x * b for a, b in zip(places[k], places[k + 1], strict=True))
        return math.dist(last, list(here)[:3]) <= TOUCH

    def stand(self, s: float, q: Sequence[Sequence[float] | None]) -> None:
        """Move the release and what follows to a coordinate of the set-down, because the box stands
        there.

        As the commanded forces fall, the arms' references move to where the arms are, so that those
        which are soft let go as well.

        Args:
            q: measured joint positions of each arm; None where there are none [rad, m].
        """
        end, self._early = self.begin("release"), None
        ways = []
        for arm, known in enumerate(q):
            here, planned = self.position(arm, s), self.position(arm, end)
            up = [a - b for a, b in zip(here, planned, strict=True)]
            ways.append((up, [a - b for a, b in zip(known or here, here, strict=True)]))
        self._early = ways

    @property
    def is_standing(self) -> bool:
        """True if the box stood before the end of its set-down."""
        return self._early is not None

    @cached_property
    def pressed(self) -> float:
        """Coordinate from which the pads or hands alone hold the box."""
        return min(self.begin(name) for name in HELD)

    def is_gripped(self, s: float) -> bool:
        """Return True if the pads touch the box before it is lifted."""
        return self._phases[0][0] < s <= self.pressed

    def grips(self, s: float, direction: float) -> bool:
        """Return True if hands are switched on at a coordinate, on the way forward or back."""
        passed = [
            switch.on
            for switch in self.switches
            if (s >= switch.begin if direction > 0.0 else s > switch.end)
        ]
        return passed[-1] if passed else False

    def holds(self, s: float) -> bool:
        """Return True if hands have to hold at a coordinate in either direction."""
        return self.grips(s, 1.0) and self.grips(s, -1.0)

    def _place(self, s: float) -> tuple[int, float, float]:
        """Return the sample before s, the share of its interval and the interval's length [s]."""
        k = min(max(bisect_right(self.time, s) - 1, 0), len(self.time) - 2)
        step = self.time[k + 1] - self.time[k]
        return k, min(max((s - self.time[k]) / step, 0.0), 1.0), step

    def position(self, arm: int, s: float) -> list[float]:
        """Compute the joint positions of an arm at a coordinate [rad, m]."""
        k, x, step = self._place(s)
        q, v = self.robots[arm]["position"], self.robots[arm]["velocity"]
        a, b = (1.0 + 2.0 * x) * (1.0 - x) ** 2, x * (1.0 - x) ** 2 * step
        c, d = x * x * (3.0 - 2.0 * x), x * x * (x - 1.0) * step
        found = [
            a * q0 + b * v0 + c * q1 + d * v1
            for q0, v0, q1, v1 in zip(q[k], v[k], q[k + 1], v[k + 1], strict=True)
        ]
        release = self.begin("release") if self._early else math.inf
        if self._early and s >= release:
            free = 1.0 - self.force(arm, s) / self.force(arm, release)
            ways = zip(found, *self._early[arm], strict=True)
            return [own + up + free * off for own, up, off in ways]
        return found

    def linear(self, arm: int, name: str, s: float) -> list[float]:
        """Interpolate a list per sample of an arm linearly between samples."""
        k, x, _ = self._place(s)
        rows = self.robots[arm][name]
        return [(1.0 - x) * a + x * b for a, b in zip(rows[k], rows[k + 1], strict=True)]

    def force(self, arm: int, s: float) -> float:
        """Compute the commanded normal force of an arm [N]."""
        k, x, _ = self._place(s)
        rows = self.robots[arm]["normal_force"]
        return float((1.0 - x) * rows[k] + x * rows[k + 1])

    def effort(self, arm: int, gravity: str, s: float, rate: float) -> list[float]:
        """Compute the joint torques of an arm at a coordinate and rate [N m, N].

        Efforts of the motion scale with the square of the rate, those that hold and press do not.

        Args:
            gravity: 'with_gravity' or 'without_gravity'.
        """
        moving = self.linear(arm, f"effort_{gravity}", s)
        holding = self.linear(arm, f"hold_effort_{gravity}", s)
        return [b + (a - b) * rate * rate for a, b in zip(moving, holding, strict=True)]

    def distance(self, arm: int, q: Sequence[float], s: float) -> float:
        """Bound the distance of a posture's pad from its place at a coordinate [m]."""
        reach = self.robots[arm]["reach"]
        planned = self.position(arm, s)
        return float(sum(r * abs(a - b) for r, a, b in zip(reach, q, planned, strict=True)))

    def speed(self, arm: int, s: float) -> float:
        """Bound the speed of the pad at a coordinate [m/s]."""
        rates = self.linear(arm, "velocity", s)
        reach = self.robots[arm]["reach"]
        return float(sum(r * abs(v) for r, v in zip(reach, rates, strict=True)))

    def coordinate(
        self, arm: int, q: Sequence[float], s: float, window: tuple[float, float]
    ) -> float:
        """Find the coordinate that fits a posture best, among equals the nearest to s [s].

        Args:
            window: how far from s it may be, before and behind [s].
        """
        if self.distance(arm, q, s) <= NEAR:
            return s
        best, low, high = s, *window
        for step in (4.0 * SEARCH_STEP, SEARCH_STEP, SEARCH_STEP / 8.0, SEARCH_STEP / 64.0):
            numbers = sorted(range(round(low / step), round(high / step) + 1), key=abs)
            places = [min(max(best + k * step, 0.0), self.end) for k in numbers]
            best = min(places, key=lambda place: round(self.distance(arm, q, place), 7))
            low, high = -step, step
        return best


@dataclass(frozen=True)
class Moment:
    """The path at a time from now [s]: its coordinate, its rate, and the derivative of the rate."""

    time: float
    s: float
    rate: float
    change: float


class Clock:
    """The coordinate of the path and its rate.

    Attributes:
        s: commanded coordinate of both arms [s].
        rate: of s over time.
    """

    def __init__(self, end: float, stop_time: float, s: float = 0.0, rate: float = 0.0) -> None:
        """Stand at a coordinate, or run through it."""
        self.s, self.rate, self._stop_time = s, rate, stop_time
        self._low, self._high = 0.0, end
        self._takes = stop_time
        self._from, self._to, self._since = rate, rate, 0.0

    def keep(self, low: float, high: float) -> None:
        """Keep the coordinate between two from now on [s]."""
        self._low, self._high = low, high

    @property
    def turning(self) -> bool:
        """True if the rate changes."""
        return self._from != self._to

    def turn(self, rate: float, after: float = 0.0, takes: float | None = None) -> None:
        """Change the rate smoothly.

        Args:
            after: when it begins, from now [s].
            takes: time of a change by one; the stop time by default [s].
        """
        if rate != self._to:
            self._from, self._to, self._since = self.rate, rate, -after
            self._takes = self._stop_time if takes is None else takes

    def advance(self, dt: float) -> None:
        """Advance time [s]; the coordinate does not depend on the number of calls."""
        count = max(1, math.ceil(dt / FINE)) if self.turning else 1
        for _ in range(count):
            self._step(dt / count)

    def _step(self, dt: float) -> None:
        before = self.rate
        if self.turning:
            self._since += dt
            x = self._share
            smooth = x * x * x * (10.0 + x * (6.0 * x - 15.0))
            self.rate = self._from + (self._to - self._from) * smooth
            if x >= 1.0:
                self.rate = self._from = self._to
        self.s = min(max(self.s + dt * (before + self.rate) / 2.0, self._low), self._high)

    @property
    def _share(self) -> float:
        """Share of the change of the rate that is over."""
        return min(max(self._since / (self._takes * abs(self._to - self._from)), 0.0), 1.0)

    @property
    def change(self) -> float:
        """Derivative of the rate by time [1/s]."""
        if not self.turning:
            return 0.0
        x = self._share
        sign = 1.0 if self._to > self._from else -1.0
        return sign * 30.0 * x * x * (1.0 - x) ** 2 / self._takes

    def ahead(self, rate: float, step: float) -> Iterator[Moment]:
        """Yield each step from now on, turning to a rate, until it stands or has to."""
        clock = copy(self)
        clock.turn(rate)
        yield Moment(0.0, clock.s, clock.rate, clock.change)
        last = self._high if rate > 0.0 else self._low
        count = 0
        while clock.turning or (abs(clock.rate) > STILL and clock.s != last):
            clock.advance(step)
            count += 1
            yield Moment(count * step, clock.s, clock.rate, clock.change)


@dataclass
class Seen:
    """Measured state of the arms at a moment.

    Attributes:
        q: measured joint positions of each arm; None if unknown [rad, m].
        force: measured normal force of each pad; None if not measured [N].
        age: time since each arm's posture was measured [s].
        grip: input of each arm's hands: they hold; None if unknown.
        fault: reason to stop; '' for none.
        lost: the reason is an arm that does not follow its commands.
    """

    q: list[list[float] | None] = field(default_factory=lambda: [None, None])
    force: list[float | None] = field(default_factory=lambda: [None, None])
    age: list[float] = field(default_factory=lambda: [0.0, 0.0])
    grip: list[bool | None] = field(default_factory=lambda: [None, None])
    fault: str = ""
    lost: bool = False


class Machine:
    """Runs a job: `ready`, `running`, `stopping`, `held`, `done`; `landing` stops where the box
    stands before the end of its set-down, and goes on with the release there.

    Attributes:
        state: one of these.
        reason: why it stopped last.
        clock: of the path.
        stop_time: of the stop that runs, or of the last one [s].
        opened: the last look found that hands do what they were told, so that the clock goes on.
    """

    def __init__(
        self,
        job: Job,
        lag: float = 0.0,
        lead: float = 0.0,
        sensors: Sequence[bool] = (False, False),
        inputs: Sequence[bool] = (False, False),
    ) -> None:
        """Begin at the start of the job, at rest.

        Args:
            lag: delay of the arms behind their commands [s].
            lead: time from the decision to stop to its effect on the commands [s].
            sensors: per arm, True if its force has to be measured.
            inputs: per arm, True if something has to tell whether its hands hold.
        """
        self.job, self.lag, self.lead, self._sensors = job, lag, lead, sensors
        self.state, self.reason = "ready", ""
        self.clock, self.stop_time = Clock(job.end, job.limits.stop_time), job.limits.stop_time
        self._strikes, self._silent = 0, list[str]()
        self._inputs, self._gates, self._waited = inputs, list[float](), 0.0
        self._direction, self.opened = 1.0, False

    def start(self, seen: Seen) -> None:
        """Begin the job.

        Raises:
            Refused: a stop is requested, an arm is silent or not at its first place, a sensor gives
                no reading, or a pad is pressed.
        """
        self.check(seen)
        self.state = "running"
        self.clock = Clock(self.job.end, self.job.limits.stop_time, 0.0, 1.0)
        self._aim(1.0)

    def check(self, seen: Seen) -> None:
        """Refuse arms that are not ready for the job; see `start`."""
        if seen.fault:
            raise Refused(seen.fault)
        self._require_places(seen, self.job.limits.start)
        for arm, force in enumerate(seen.force):
            if self._sensors[arm] and force is None:
                raise Refused(self._no_force(arm))
            if self._inputs[arm] and seen.grip[arm] is not False:
                raise Refused(f"{self._grip(arm, seen)} before they are at the box")
            most = UNLOADED * max(self.job.robots[arm]["normal_force"])
            if force is not None and abs(force) > most:
                raise Refused(
                    f"{self._name(arm)} feels {force:.1f} N before it touches the box: zero its "
                    f"sensor and state its tool_load; allowed are {most:.1f} N"
                )

    def hold(self, reason: str) -> None:
        """Hold the present commanded posture, because the arms cannot go on."""
        self.clock = Clock(self.job.end, self.job.limits.stop_time, self.clock.s)
        self.state, self.reason = "held", reason

    def resume(self, direction: float, seen: Seen) -> None:
        """Resume from a hold: 1 to the end of the job, -1 back to its beginning.

        Raises:
            Refused: it is not held, an arm is silent or not where it is held.
        """
        if self.state != "held":
            raise Refused(f"the job is {self.state}; it goes on only from where it is held")
        if direction < 0.0 and self.job.is_standing:
            raise Refused("the box stands: 'continue' lets go of it")
        if seen.fault:
            raise Refused(seen.fault)
        self._require_places(seen, self.job.limits.path)
        self.state, self._strikes = "running", 0
        self._aim(direction)
        self.clock.turn(direction)

    @property
    def grip(self) -> bool:
        """True if the outputs of hands have to be on, once the job has begun."""
        return self.job.grips(self.clock.s, self._direction)

    def _aim(self, direction: float) -> None:
        """Set the places ahead at which the clock has to wait for the inputs of hands."""
        self._direction, s, found = direction, self.clock.s, self.job.switches
        gates = [switch.end for switch in found if switch.end >= s]
        if direction < 0.0:
            gates = [switch.begin for switch in reversed(found) if switch.begin <= s]
        self._gates = gates if any(self._inputs) else []
        self._next_gate()

    def _next_gate(self) -> None:
        """Let the clock go as far as the next of these places."""
        self._waited = 0.0
        low, high = 0.0, self.job.end
        if self._gates and self._direction > 0.0:
            high = self._gates[0]
        elif self._gates:
            low = self._gates[0]
        self.clock.keep(low, high)

    def _wait(self, dt: float, seen: Seen) -> None:
        """Wait for hands where the clock has to; go on when all that tell anything agree."""
        if self.clock.turning or self._gates[:1] != [self.clock.s]:
            return
        self._waited += dt
        told = zip(self._inputs, seen.grip, strict=True)
        late = [arm for arm, (told_of, on) in enumerate(told) if told_of and on is not self.grip]
        if not late:
            self._gates.pop(0)
            self._next_gate()
            self.opened = True
        elif self._waited > self.job.limits.grip:
            self.hold(f"{self._grip(late[0], seen)} after {self.job.limits.grip:g} s")

    def tick(self, dt: float, seen: Seen) -> None:
        """Advance the time and check the arms."""
        self.clock.advance(dt)
        self.opened = False
        limit = self.job.limits.silence
        self._silent = [self._name(arm) for arm, age in enumerate(seen.age) if age > limit]
        if self.state == "running":
            if not self.clock.turning and (
                (self.clock.rate > 0.0 and self.clock.s >= self.job.end)
                or (self.clock.rate < 0.0 and self.clock.s <= 0.0)
            ):
                wrong = self._wrong(seen) or self._wrong_force(seen)
                if wrong:
                    self.hold(wrong)
                else:
                    self.state = "done"
                return
            wrong, force = self._wrong(seen), self._wrong_force(seen)
            self._strikes = self._strikes + 1 if wrong or force else 0
            if seen.fault or self._strikes >= STRIKES:
                if not (seen.fault or wrong) and self.clock.rate > 0.0 and self._lands(force):
                    return
                self.stop(seen.fault or wrong or force, quick=seen.lost or not seen.fault)
            else:
                self._wait(dt, seen)
        elif self.state == "stopping" and not self.clock.turning:
            self.state = "held"
        elif self.state == "landing" and not self.clock.turning:
            self.job.stand(self.clock.s, seen.q)
            self.clock = Clock(self.job.end, self.job.limits.stop_time, self.job.begin("release"))
            self.state = "held"
            try:
                self.resume(1.0, seen)
            except Refused as error:
                self.hold(str(error))

    def _lands(self, force: str) -> bool:
        """Return True if a wrong force in the last part of the set-down means that the box stands;
        stop there, unless the release begins sooner."""
        if not self.job.is_touching(self.clock.s):
            return False
        takes = self.job.limits.quick_stop
        if self.clock.s + self.lead + takes / 2.0 < self.job.begin("release"):
            self.state, self.reason, self.stop_time = "landing", force, takes
            self.clock.turn(0.0, self.lead, takes)
        return True

    def stop(self, reason: str, quick: bool = False) -> None:
        """Stop along the path and hold; quickly if an arm does not follow its commands."""
        if self.state == "running":
            self.state, self.reason = "stopping", reason
            limits = self.job.limits
            self.stop_time = limits.quick_stop if quick else limits.stop_time
            self.clock.turn(0.0, self.lead, self.stop_time)

    def told(self) -> str:
        """Describe the state, and how to go on."""
        where = f"{self.job.phase(self.clock.s)}, {self.clock.s:.3f} s"
        if self.state == "landing":
            return f"the box stands in {where}: {self.reason}. Both arms let go of it there"
        if self.state in ("stopping", "held"):
            known = (
                f"{' and '.join(self._silent)} is silent: look whether it still holds"
                if self._silent
                else f"Both arms report and are commanded to hold their places and {self._keeps}"
            )
            return (
                f"{self.state} in {where}: {self.reason}. {known}. To set the box down: 'continue' "
                "to the end of the job, or 'back' to where the box stood"
            )
        return f"{self.state} ({where})"

    @property
    def _keeps(self) -> str:
        if not self.job.switches:
            return "press"
        return f"keep their hands switched {'on' if self.grip else 'off'}"

    def _grip(self, arm: int, seen: Seen) -> str:
        """Tell what the input of an arm's hands says."""
        if seen.grip[arm] is None:
            return f"nothing is heard of the input of {self._name(arm)}'s hands"
        return f"the hands of {self._name(arm)} {'hold' if seen.grip[arm] else 'do not hold'}"

    def _name(self, arm: int) -> str:
        return str(self.job.robots[arm]["name"])

    def _require_places(self, seen: Seen, most: float) -> None:
        for arm, q in enumerate(seen.q):
            if q is None or seen.age[arm] > self.job.limits.silence:
                raise Refused(self._no_news(arm, seen))
            away = self.job.distance(arm, q, self.clock.s)
            if away > most:
                raise Refused(
                    f"the pad of {self._name(arm)} is up to {1e3 * away:.1f} mm from its place, "
                    f"allowed are {1e3 * most:.1f} mm: move it there first"
                )

    def _wrong(self, seen: Seen) -> str:
        """Return the reason not to go on, or ''."""
        limits, s = self.job.limits, self.clock.s
        # Nothing is lifted, and no job done, by an arm that stands elsewhere.
        stands = self.job.is_gripped(s) or s in (0.0, self.job.end)
        most = limits.path / 2.0 if stands else limits.path
        coordinates = []
        direction = 1.0 if self.clock.rate >= 0.0 else -1.0
        for arm, q in enumerate(seen.q):
            if seen.age[arm] > limits.silence:
                return self._no_news(arm, seen)
            if q is None:
                continue
            # Where the arm had to be when its posture was measured.
            since = self.clock.rate * seen.age[arm]
            told = s - direction * self.lag - since
            # Twice as far behind as is allowed, and a little ahead.
            far, near = -2.0 * direction * limits.behind, direction * limits.behind / 2.0
            at = self.job.coordinate(arm, q, told, (min(far, near), max(far, near)))
            away = self.job.distance(arm, q, at)
            if away > most:
                return f"{self._name(arm)} has left its path by up to {1e3 * away:.1f} mm"
            if self.job.speed(arm, s) > SLOW * self.job.fastest:
                if direction * (told - at) > limits.behind:
                    late = 1e3 * direction * (told - at)
                    return f"{self._name(arm)} is {late:.0f} ms behind its reference"
                coordinates.append(at + since)
        if len(coordinates) == 2:
            # What counts is how far the pads are apart: at low speed, time says little.
            apart = abs(coordinates[0] - coordinates[1])
            if apart * self.job.speed(0, s) > limits.skew * self.job.fastest:
                return f"the arms are {1e3 * apart:.0f} ms apart along the path"
        silent = [a for a in (0, 1) if self._sensors[a] and seen.force[a] is None]
        return self._no_force(silent[0]) if silent else self._wrong_grip(seen)

    def _wrong_grip(self, seen: Seen) -> str:
        for arm, on in enumerate(seen.grip):
            if self._inputs[arm] and (on is None or (self.job.holds(self.clock.s) and not on)):
                return self._grip(arm, seen)
        return ""

    def _wrong_force(self, seen: Seen) -> str:
        """Return what the measured forces say against going on, or ''."""
        s, lift = self.clock.s, self.job.pressed
        for arm, measured in enumerate(seen.force):
            wanted = self.job.force(arm, s)
            # Before the box is lifted the pads have to press.
            pressed = s <= lift and wanted >= PRESSED * self.job.force(arm, lift)
            if not pressed and self.job.phase(s) not in HELD:
                continue
            if measured is not None and abs(measured - wanted) > self.job.limits.force * wanted:
                return f"{self._name(arm)} presses {measured:.1f} N instead of {wanted:.1f} N"
        return ""

    def _no_news(self, arm: int, seen: Seen) -> str:
        if seen.q[arm] is None:
            return f"no news from {self._name(arm)}: is its controller launched?"
        return (
            f"no news from {self._name(arm)} for {seen.age[arm]:.2f} s, by the stamps of its joint "
            "states"
        )

    def _no_force(self, arm: int) -> str:
        return f"no force is measured at the pad of {self._name(arm)}: is its sensor published?"
