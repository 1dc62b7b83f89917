"""A job as programs read it: what the arms do at each place of its path.

The job is a path that both arms follow together; its coordinate is the planned time s [s].
Positions are cubic between samples, forces linear. Standard library only, Python 3.11 or newer.
"""

from __future__ import annotations

import json
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

FORMAT, VERSION = "dual-arm-carry job", 2
"""Format of the file that holds a job."""

HELD = ("lift", "carry", "set_down")
"""Phases in which pads alone hold the box."""

SEARCH_STEP = 0.004
"""Between places that are compared with a measured posture [s]."""

NEAR = 0.002
"""A pad so near to its place is there [m]."""

PRESSED = 0.98
"""Share of the force with which the box is lifted from which on the pads have to press."""

TOUCH = 0.005
"""A box that is set down may stand so far above its planned place [m]."""


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

    def _project(self, arm: int, q: Sequence[float], s: float) -> float:
        """Fit the coordinate of an arm that is on its path by one step of Gauss and Newton [s]."""
        planned, rates = self.position(arm, s), self.linear(arm, "velocity", s)
        rows = zip(self.robots[arm]["reach"], q, planned, rates, strict=True)
        fit = [(r * r * (a - b) * v, r * r * v * v) for r, a, b, v in rows]
        speed = sum(square for _, square in fit)
        if speed == 0.0:
            return s
        return float(min(max(s + sum(along for along, _ in fit) / speed, 0.0), self.end))

    def coordinate(
        self,
        arm: int,
        q: Sequence[float],
        s: float,
        window: tuple[float, float],
        near: float = NEAR,
    ) -> float:
        """Find the coordinate that fits a posture best, among equals the nearest to s [s].

        Args:
            window: how far from s it may be, before and behind [s].
            near: a pad so near to its place at s is there [m].
        """
        if self.distance(arm, q, s) <= near:
            return s
        close = self._project(arm, q, s)
        if window[0] <= close - s <= window[1] and self.distance(arm, q, close) <= NEAR:
            return self._project(arm, q, close)
        best, low, high = s, *window
        for step in (4.0 * SEARCH_STEP, SEARCH_STEP, SEARCH_STEP / 8.0, SEARCH_STEP / 64.0):
            numbers = sorted(range(round(low / step), round(high / step) + 1), key=abs)
            places = [min(max(best + k * step, 0.0), self.end) for k in numbers]
            best = min(places, key=lambda place: round(self.distance(arm, q, place), 7))
            low, high = -step, step
        return best
