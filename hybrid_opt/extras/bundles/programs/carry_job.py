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
"""Distance between places of the path that are compared with a measured posture [s]."""

NEAR = 0.002
"""Largest distance of a pad from a place at which it counts as being there [m]."""

PRESSED = 0.98
"""Share of the force with which the box is lifted above which the pads have to press."""

TOUCH = 0.005
"""Largest height above its planned place at which a box that is set down may already stand [m]."""


class Refused(Exception):
    """The job cannot begin or continue; the message says why."""


@dataclass(frozen=True)
class Limits:
    """Deviations from the plan at which a program stops the job, as in the job's file;
    `job.schema.json` says what each one limits, in which unit."""

    stop_time: float
    quick_stop: float
    start: float
    path: float
    behind: float
    skew: float
    force: float
    silence: float
    grip: float
    partner_stop_time: float


@dataclass(frozen=True)
class Switch:
    """A phase of a job in which hands (cups, magnets, grippers) are switched, with the planned
    times of its begin and end [s]; `on` is True if they are switched on when the job runs forward.
    """

    begin: float
    end: float
    on: bool


class Job:
    """A job read from its file. A point on its path is given by its planned time s [s].

    Attributes:
        document: content of the file as JSON values.
        time: planned time of each sample [s].
        robots: part of the document for each arm.
        limits: limits at which the job is stopped.
    """

    def __init__(self, document: dict[str, Any]) -> None:
        """Store a document and check its format.

        Raises:
            Refused: the document is not a job, or has another version.
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
        """Read the job from a file.

        Raises:
            Refused: the file cannot be read.
        """
        try:
            return cls(json.loads(path.read_text("utf-8")))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise Refused(f"{path}: no job can be read ({error})") from error

    @cached_property
    def fastest(self) -> float:
        """Upper bound of the first arm's pad speed over the whole path [m/s]."""
        return max(self.speed(0, s) for s in self.time)

    @property
    def end(self) -> float:
        """Planned time of the last sample [s]."""
        return self.time[-1]

    def phase(self, s: float) -> str:
        """Return the name of the phase at a planned time s [s]."""
        return next((name for last, name in self._phases if s <= last), self._phases[-1][1])

    def begin(self, name: str) -> float:
        """Return the planned time at which a phase begins [s]; the end of the job if it has no such
        phase."""
        firsts = zip([0.0, *(last for last, _ in self._phases)], self._phases, strict=False)
        return next((first for first, (_, phase) in firsts if phase == name), self.end)

    def is_touching(self, s: float) -> bool:
        """Return True if the box may already stand on its support at a planned time s [s] within
        the set-down: its planned position is at most `TOUCH` from the one at the end of the
        set-down."""
        if self.phase(s) != "set_down" or self.is_standing:
            return False
        places, (k, x, _) = self.document["box"]["pose"], self._place(s)
        last = places[bisect_right(self.time, self.begin("release")) - 1][:3]
        here = ((1.0 - x) * a + x * b for a, b in zip(places[k], places[k + 1], strict=True))
        return math.dist(last, list(here)[:3]) <= TOUCH

    def stand(self, s: float, q: Sequence[Sequence[float] | None]) -> None:
        """Skip the rest of the set-down, because the box already stands on its support.

        From the release on, planned positions are shifted by the motion that is left out. While the
        commanded forces decrease, the commanded positions move to the measured ones. Otherwise
        compliant arms, which the box holds away from their commanded positions, would go on
        pressing it.

        Args:
            s: planned time, within the set-down, at which the box stands [s].
            q: measured joint positions of each arm [rad or m]; None if unknown.
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
        """True if `stand` was called: the box stood before the end of its set-down."""
        return self._early is not None

    @cached_property
    def pressed(self) -> float:
        """Planned time from which the pads or hands alone hold the box [s]."""
        return min(self.begin(name) for name in HELD)

    def is_gripped(self, s: float) -> bool:
        """Return True if the pads touch the box at a planned time s [s] but the box is not lifted
        yet."""
        return self._phases[0][0] < s <= self.pressed

    def grips(self, s: float, direction: float) -> bool:
        """Return True if hands are commanded to hold at a point of the path.

        Hands are switched at the beginning of a phase. On the way back a switch is reversed at the
        end of its phase.

        Args:
            s: planned time of the point [s].
            direction: 1 if the job runs forward, -1 if it runs back.
        """
        passed = [
            switch.on
            for switch in self.switches
            if (s >= switch.begin if direction > 0.0 else s > switch.end)
        ]
        return passed[-1] if passed else False

    def holds(self, s: float) -> bool:
        """Return True if hands are commanded to hold at a planned time s [s] in both directions of
        the job. Only there they have to report that they hold."""
        return self.grips(s, 1.0) and self.grips(s, -1.0)

    def _place(self, s: float) -> tuple[int, float, float]:
        """Return the index of the sample before a planned time s [s], the passed share of the
        interval to the next sample, in [0, 1], and the length of this interval [s]."""
        k = min(max(bisect_right(self.time, s) - 1, 0), len(self.time) - 2)
        step = self.time[k + 1] - self.time[k]
        return k, min(max((s - self.time[k]) / step, 0.0), 1.0), step

    def position(self, arm: int, s: float) -> list[float]:
        """Interpolate the planned joint positions of an arm at a planned time s [s] by cubic
        polynomials [rad, or m for sliding joints]."""
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
        """Interpolate values of an arm linearly between samples.

        Args:
            arm: index of the arm.
            name: key of the values in the arm's part of the document, which also decides their
                unit.
            s: planned time [s].
        """
        k, x, _ = self._place(s)
        rows = self.robots[arm][name]
        return [(1.0 - x) * a + x * b for a, b in zip(rows[k], rows[k + 1], strict=True)]

    def force(self, arm: int, s: float) -> float:
        """Return the commanded normal force [N] of an arm at a planned time s [s]."""
        k, x, _ = self._place(s)
        rows = self.robots[arm]["normal_force"]
        return float((1.0 - x) * rows[k] + x * rows[k + 1])

    def effort(self, arm: int, gravity: str, s: float, rate: float) -> list[float]:
        """Return the planned joint torques of an arm, adapted to the rate at which the job runs [N
        m, for sliding joints N].

        Args:
            arm: index of the arm.
            gravity: 'with_gravity' or 'without_gravity': whether the torques include the arm's
                weight.
            s: planned time [s].
            rate: derivative of the planned time with respect to time; 1 at the planned speed, 0 at
                rest.
        """
        moving = self.linear(arm, f"effort_{gravity}", s)
        holding = self.linear(arm, f"hold_effort_{gravity}", s)
        return [b + (a - b) * rate * rate for a, b in zip(moving, holding, strict=True)]

    def distance(self, arm: int, q: Sequence[float], s: float) -> float:
        """Return an upper bound of the distance [m] of an arm's pad at joint positions q from its
        planned position at the planned time s.
        """
        reach = self.robots[arm]["reach"]
        planned = self.position(arm, s)
        return float(sum(r * abs(a - b) for r, a, b in zip(reach, q, planned, strict=True)))

    def speed(self, arm: int, s: float) -> float:
        """Return an upper bound of the planned speed [m/s] of an arm's pad at a planned time s
        [s]."""
        rates = self.linear(arm, "velocity", s)
        reach = self.robots[arm]["reach"]
        return float(sum(r * abs(v) for r, v in zip(reach, rates, strict=True)))

    def _project(self, arm: int, q: Sequence[float], s: float) -> float:
        """Estimate the planned time [s] at which an arm's planned posture is nearest to a measured
        posture q, by one Gauss-Newton step from the planned time s."""
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
        """Find the planned time [s] at which an arm's planned posture is nearest to a measured one.

        Of equally near times the one nearest to `s` is returned.

        Args:
            arm: index of the arm.
            q: measured joint positions [rad or m].
            s: planned time around which to search [s].
            window: range of the search, as the least and the largest value of result minus `s` [s].
            near: distance [m]. If the pad is at most this far from its planned position at `s`, the
                result is `s` itself.
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
