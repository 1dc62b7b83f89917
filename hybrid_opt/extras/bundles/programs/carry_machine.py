"""When the arms of a job have to stop, and how.

A clock drives the coordinate s: at rate 1 the job runs as planned, at rate 0 both arms hold their
places and press, at rate -1 the job runs backwards, which takes the same forces. Whatever goes
wrong, the clock stops smoothly: both arms come to rest at the same coordinate and keep the squeeze
that belongs to it.

Hands that hold by themselves are switched on and off while the arms stand still, and the clock
waits there until their inputs say the same. Nothing else switches them: after any fault they hold.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field

from hybrid_opt.extras.bundles.programs.carry_job import HELD, PRESSED, Job, Refused

STILL = 1e-9
"""Rates below this count as zero."""

FINE = 0.002
"""Longest step over which a changing rate is integrated [s]."""

SLOW = 0.25
"""Share of the fastest speed below which a posture determines the coordinate too inaccurately to
detect a late arm."""

SLOWEST = 0.1
"""Least duration of a stop of slow arms, as a share of the quick stop's duration."""

UNLOADED = 0.07
"""Largest measured force before the first contact, over the largest commanded force. A larger one
is an offset of the sensor, which would become an error of the squeeze."""

STRIKES = 3
"""Number of successive checks with the same fault before a stop. A requested stop acts at once."""


@dataclass(frozen=True)
class Moment:
    """Future state of a job on its path.

    Attributes:
        time: time from now [s].
        s: planned time of the point on the path [s].
        rate: derivative of s with respect to time.
        change: derivative of the rate with respect to time [1/s].
    """

    time: float
    s: float
    rate: float
    change: float


class Clock:
    """The commanded point on the path of a job, given by its planned time s, and how fast it moves.

    Attributes:
        s: planned time of the point on the path [s].
        rate: derivative of s with respect to time: 1 at the planned speed, 0 at rest, -1 backwards.
    """

    def __init__(self, end: float, stop_time: float, s: float = 0.0, rate: float = 0.0) -> None:
        """Start the clock at the planned time s of a path that ends at the planned time `end` [s].
        `stop_time` is the duration in which the rate changes by 1 [s].
        """
        self.s, self.rate, self._stop_time = s, rate, stop_time
        self._low, self._high, self._takes = 0.0, end, stop_time
        self._from, self._to, self._since = rate, rate, 0.0

    def keep(self, low: float, high: float) -> None:
        """Let the commanded point stop at the planned times `low` and `high` [s] and not pass
        them."""
        self._low, self._high = low, high

    @property
    def turning(self) -> bool:
        """True while the rate changes; the rate is the derivative of the planned time with respect
        to time.
        """
        return self._from != self._to

    def turn(self, rate: float, after: float = 0.0, takes: float | None = None) -> None:
        """Start a smooth change of the rate, the derivative of the planned time with respect to
        time.

        Args:
            rate: rate after the change: 1 for the planned speed, 0 for rest, -1 for backwards.
            after: time until the change begins [s].
            takes: duration of a change of the rate by 1 [s]; None for the stop time of the clock.
        """
        if rate != self._to:
            self._from, self._to, self._since = self.rate, rate, -after
            self._takes = self._stop_time if takes is None else takes

    def advance(self, dt: float) -> None:
        """Move the commanded point on by a time step dt [s]. Several calls with parts of the step
        give the same result."""
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
        """Finished share of the present change of the rate, in [0, 1]."""
        return min(max(self._since / (self._takes * abs(self._to - self._from)), 0.0), 1.0)

    @property
    def change(self) -> float:
        """Derivative of the rate with respect to time [1/s]."""
        if not self.turning:
            return 0.0
        x = self._share
        sign = 1.0 if self._to > self._from else -1.0
        return sign * 30.0 * x * x * (1.0 - x) ** 2 / self._takes

    def ahead(self, rate: float, step: float) -> Iterator[Moment]:
        """Yield the future states of the path if the rate begins to change now, until the commanded
        point comes to rest.

        Args:
            rate: rate after the change: 1 for the planned speed, 0 for rest, -1 for backwards.
            step: time between two states [s].
        """
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
    """Measured state of both arms at one time.

    Attributes:
        q: joint positions of each arm [rad or m]; None if unknown.
        force: normal force of each arm's pad [N]; None if not measured.
        age: time since each arm's posture was measured [s].
        grip: for each arm, True if an input reports that its hands hold; None if unknown.
        fault: reason why the job has to stop, '' for none.
        lost: True if an arm does not follow its commands.
    """

    q: list[list[float] | None] = field(default_factory=lambda: [None, None])
    force: list[float | None] = field(default_factory=lambda: [None, None])
    age: list[float] = field(default_factory=lambda: [0.0, 0.0])
    grip: list[bool | None] = field(default_factory=lambda: [None, None])
    fault: str = ""
    lost: bool = False


class Machine:
    """State machine of a job, with the states `ready`, `running`, `stopping`, `landing`, `held` and
    `done`.

    In the state `landing` the arms stop where the box stands before the planned end of its
    set-down. The release then begins there.

    Attributes:
        state: the present state.
        reason: reason of the last stop.
        clock: commanded point on the path.
        stop_time: duration of the present stop, or of the last one [s].
        opened: True if the last check found all hands as commanded, so that a waiting clock may
            continue.
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
            job: the job.
            lag: delay of both arms behind their commands [s].
            lead: time between the decision to stop and the first command that is changed by it [s].
            sensors: for each arm, True if the job needs the reading of its force sensor.
            inputs: for each arm, True if an input must report whether its hands hold.
        """
        self.job, self.lag, self.lead, self._sensors = job, lag, lead, sensors
        self.state, self.reason = "ready", ""
        self.clock, self.stop_time = self._clock(0.0), job.limits.stop_time
        self._strikes, self._silent = 0, list[str]()
        self._inputs, self._gates, self._waited = inputs, list[float](), 0.0
        self._direction, self.opened = 1.0, False

    def start(self, seen: Seen) -> None:
        """Begin the job.

        Args:
            seen: measured state of both arms.

        Raises:
            Refused: the arms are not ready, as `check` finds.
        """
        self.check(seen)
        self.state = "running"
        self.clock = self._clock(0.0, 1.0)
        self._aim(1.0)

    def check(self, seen: Seen) -> None:
        """Check that both arms are ready for the job.

        Raises:
            Refused: a stop is requested, an arm is silent or not at its first position, a required
                sensor gives no reading, an input does not report open hands, or a sensor already
                shows a force.
        """
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

    def _clock(self, s: float, rate: float = 0.0) -> Clock:
        return Clock(self.job.end, self.job.limits.stop_time, s, rate)

    def hold(self, reason: str) -> None:
        """Hold the posture that is commanded now.

        Args:
            reason: reason why the job cannot continue, for messages.
        """
        self.clock = self._clock(self.clock.s)
        self.state, self.reason = "held", reason

    def resume(self, direction: float, seen: Seen) -> None:
        """Continue a job that is held.

        Args:
            direction: 1 forward to its end, -1 back to its beginning.
            seen: measured state of both arms.

        Raises:
            Refused: the job is not held, it is to go back although the box already stands on its
                support, a stop is requested, or an arm is silent or not where it is held.
        """
        if self.state != "held":
            raise Refused(f"the job is {self.state}; it goes on only from where it is held")
        if direction < 0.0 and self.job.is_standing:
            raise Refused("the box stands: 'continue' lets go of it")
        if seen.fault:
            raise Refused(seen.fault)
        # An arm that has stopped by itself is behind by what the other one took to stop.
        self._require_places(seen, self.job.limits.path, self.job.limits.partner_stop_time)
        self.state, self._strikes = "running", 0
        self._aim(direction)
        self.clock.turn(direction)

    @property
    def grip(self) -> bool:
        """True if hands are commanded to hold at the present point of the job."""
        return self.job.grips(self.clock.s, self._direction)

    def _aim(self, direction: float) -> None:
        """List the points of the path ahead at which hands are switched, and let the clock run to
        the first of them. There it waits until inputs report the new state; cells without such
        inputs have no such points.

        Args:
            direction: 1 if the job runs forward, -1 if it runs back.
        """
        self._direction, s, found = direction, self.clock.s, self.job.switches
        gates = [switch.end for switch in found if switch.end >= s]
        if direction < 0.0:
            gates = [switch.begin for switch in reversed(found) if switch.begin <= s]
        self._gates = gates if any(self._inputs) else []
        self._next_gate()

    def _next_gate(self) -> None:
        """Let the clock run to the next point at which it has to wait until hands are switched;
        without one, to the end of the path."""
        self._waited = 0.0
        low, high = 0.0, self.job.end
        if self._gates and self._direction > 0.0:
            high = self._gates[0]
        elif self._gates:
            low = self._gates[0]
        self.clock.keep(low, high)

    def _wait(self, dt: float, seen: Seen) -> None:
        """Wait at a point of the path where hands are switched.

        The clock stands at this point. The job continues when all inputs report the commanded state
        of the hands, and is held if they do not within the time limit.

        Args:
            dt: time since the last call [s].
            seen: measured state of both arms.
        """
        if self.clock.turning or self._gates[:1] != [self.clock.s]:
            return
        self._waited += dt
        both = zip(self._inputs, seen.grip, strict=True)
        late = [arm for arm, (has, on) in enumerate(both) if has and on is not self.grip]
        if not late:
            self._gates.pop(0)
            self._next_gate()
            self.opened = True
        elif self._waited > self.job.limits.grip:
            self.hold(f"{self._grip(late[0], seen)} after {self.job.limits.grip:g} s")

    def tick(self, dt: float, seen: Seen) -> None:
        """Advance the job by one time step. Stop or hold it if the measured state of the arms
        requires it.

        Args:
            dt: time since the last call [s].
            seen: measured state of both arms.
        """
        self.clock.advance(dt)
        self.opened = False
        limit = self.job.limits.silence
        self._silent = [self._name(arm) for arm, age in enumerate(seen.age) if age > limit]
        if self.state == "running":
            wrong, force = self._wrong(seen), self._wrong_force(seen)
            self._strikes = self._strikes + 1 if wrong or force else 0
            if not self.clock.turning and (
                (self.clock.rate > 0.0 and self.clock.s >= self.job.end)
                or (self.clock.rate < 0.0 and self.clock.s <= 0.0)
            ):
                if self._strikes >= STRIKES:
                    self.hold(wrong or force)
                elif not self._strikes:
                    self.state = "done"
                return
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
            self.clock = self._clock(self.job.begin("release"))
            self.state = "held"
            try:
                self.resume(1.0, seen)
            except Refused as error:
                self.hold(str(error))

    def _lands(self, force: str) -> bool:
        """Interpret a wrong force near the end of the set-down as contact of the box with its
        support.

        The arms then begin to stop, and the release begins where they come to rest. They continue
        as planned if the planned release comes first.

        Args:
            force: description of the wrong force, the reason of the stop.

        Returns:
            True if the box may stand, whether or not a stop begins.
        """
        if not self.job.is_touching(self.clock.s):
            return False
        # Slow arms can stop sooner, and press less until then.
        share = self.job.speed(0, self.clock.s) / self.job.fastest
        takes = max(share, SLOWEST) * self.job.limits.quick_stop
        if self.clock.s + self.lead + takes / 2.0 < self.job.begin("release"):
            self.state, self.reason, self.stop_time = "landing", force, takes
            self.clock.turn(0.0, self.lead, takes)
        return True

    def stop(self, reason: str, quick: bool = False) -> None:
        """Stop along the path and hold the posture there.

        Args:
            reason: reason of the stop.
            quick: True to stop in the shorter of the two stop times of the job.
        """
        if self.state == "running":
            self.state, self.reason = "stopping", reason
            limits = self.job.limits
            self.stop_time = limits.quick_stop if quick else limits.stop_time
            self.clock.turn(0.0, self.lead, self.stop_time)

    def status(self) -> str:
        """Return a text that says in which state the job is, and how to continue."""
        where = f"{self.job.phase(self.clock.s)}, {self.clock.s:.3f} s"
        if self.state == "landing":
            return f"the box stands in {where}: {self.reason}. Both arms let go of it there"
        if self.state in ("stopping", "held"):
            known = f"Both arms report and are commanded to hold their places and {self._keeps}"
            if self._silent:
                look = "are silent: look whether they still hold"
                if len(self._silent) == 1:
                    look = "is silent: look whether it still holds"
                known = f"{' and '.join(self._silent)} {look}"
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
        """Return a text that says what the input of an arm's hands reports."""
        if seen.grip[arm] is None:
            return f"nothing is heard of the input of {self._name(arm)}'s hands"
        return f"the hands of {self._name(arm)} {'hold' if seen.grip[arm] else 'do not hold'}"

    def _name(self, arm: int) -> str:
        return str(self.job.robots[arm]["name"])

    def _require_places(self, seen: Seen, most: float, slack: float = 0.0) -> None:
        """Check that both arms report their state, and that they are at the present point of the
        path.

        Args:
            most: largest distance of a pad from its path [m].
            slack: planned time by which an arm may be ahead or behind on its path [s].

        Raises:
            Refused: an arm is silent or elsewhere.
        """
        s = self.clock.s
        for arm, q in enumerate(seen.q):
            if q is None or seen.age[arm] > self.job.limits.silence:
                raise Refused(self._no_news(arm, seen))
            at = self.job.coordinate(arm, q, s, (-slack, slack)) if slack else s
            away = self.job.distance(arm, q, at)
            if away > most:
                raise Refused(
                    f"the pad of {self._name(arm)} is up to {1e3 * away:.1f} mm from its place, "
                    f"allowed are {1e3 * most:.1f} mm: move it there first"
                )

    def _wrong(self, seen: Seen) -> str:
        """Return the reason why the measured state does not allow the job to continue; '' if it
        does.

        Postures, their age, missing forces and inputs of hands are checked here, the values of
        forces in `_wrong_force`.
        """
        limits, s = self.job.limits, self.clock.s
        # Nothing is lifted or let go, and no job done, by an arm that stands elsewhere.
        releases = self.job.phase(s) == "release" and not self.job.is_standing
        stands = self.job.is_gripped(s) or releases or s in (0.0, self.job.end)
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
            expected = s - direction * self.lag - since
            # Twice as far behind as is allowed, and a little ahead. A slow arm that is late counts
            # as off its path: the slower it is, the less of its delay is searched.
            share = self.job.speed(arm, s) / (SLOW * self.job.fastest)
            behind = limits.behind * (2.0 if share > 1.0 else share)
            far, near = -direction * behind, direction * limits.behind / 2.0
            at = self.job.coordinate(arm, q, expected, (min(far, near), max(far, near)))
            away = self.job.distance(arm, q, at)
            if away > most:
                return f"{self._name(arm)} has left its path by up to {1e3 * away:.1f} mm"
            if share > 1.0:
                if direction * (expected - at) > limits.behind:
                    late = 1e3 * direction * (expected - at)
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
        """Return a text on the first arm whose measured normal force differs too much from the
        commanded one; '' if there is none."""
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
