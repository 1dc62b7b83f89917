"""Measures what a job depends on, before its first box, and keeps it in measured.toml.

In the air both arms drive the whole job and back, with no force and nothing between the pads. Then
they press a block as wide as the box, at its start, slowly; a job of hands or without sensors needs
none. The job refuses to run without these numbers, or where one is farther from its plan than the
tolerances below. `export --driver measured.toml` plans with them.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from math import isnan, nan
from pathlib import Path
from statistics import linear_regression, median
from typing import Any

from hybrid_opt.extras.bundles.programs.carry_job import Job, Refused
from hybrid_opt.extras.bundles.programs.carry_machine import UNLOADED, Machine, Seen

FILE = "measured.toml"

BACK = 3
"""Exit code of a job that returned to its beginning."""

LAG, STIFFNESS, SPEED = 0.01, 0.25, 0.95
"""Tolerances: of the lag [s], of the stiffness relative to the planned one, and least speed over
the planned one."""

EVERY, WINDOW = 0.02, 5
"""Time between two measurements of moving arms [s], and how many give a speed."""

AHEAD, BEHIND = 0.05, 0.3
"""A measured posture is searched for on the path within these times around its command [s]."""

IN_AIR = {"behind": 0.15, "skew": 0.1}
"""Limits on the delay of arms while nothing is between the pads [s]."""

FAST = 0.5
"""Share of an arm's largest speed above which its postures are used to measure its delay."""

SLOWER = 5.0
"""Factor by which a block is pressed more slowly than the box."""

LEAST_FORCE, LEAST_SHARE = 5.0, 0.05
"""Least force that counts as contact [N], and the same as a share of the largest commanded
force."""

FITTED, FULL = 0.3, 0.95
"""Shares of the largest measured force above which the stiffness is fitted, and of the largest
commanded one above which both are compared."""

AIR = "in the air: nothing stands between the pads"

BLOCK = "put a block as wide as the box where the box stands at the start; then say 'press'"


@dataclass(frozen=True)
class Measured:
    """Measured properties of an arm; NaN for those on which the job does not depend.

    Attributes:
        lag: delay of the arm behind its commands [s].
        late: part of this delay that remains although commands are sent ahead [s]; it has to be
            equal for both arms.
        speed: largest measured speed of the pad over the largest planned speed.
        offset: reading of the force sensor while nothing touches the arm [N].
        sign: sign of the sensor's reading when the pad presses, 1 or -1.
        stiffness: stiffness of each arm at its pad, with both arms in series [N/m].
        press: measured force over commanded force.
    """

    lag: float
    late: float
    speed: float
    offset: float = nan
    sign: float = nan
    stiffness: float = nan
    press: float = nan


def unloaded(job: Job) -> Job:
    """Return a copy of a job for a run without a box: the arms exert no contact forces, hands stay
    off, and the limits on delays are wider."""
    robots = []
    for robot in job.robots:
        contact = robot["hold_effort_without_gravity"]
        efforts = {
            name: [
                [a - b for a, b in zip(row, own, strict=True)]
                for row, own in zip(rows, contact, strict=True)
            ]
            for name, rows in robot.items()
            if "effort" in name
        }
        robots.append(robot | efforts | {"normal_force": [0.0] * len(job.time)})
    phases = [{k: v for k, v in each.items() if k != "grip"} for each in job.document["phases"]]
    machine = {"limits": job.document["machine"]["limits"] | IN_AIR}
    return Job(job.document | {"robots": robots, "phases": phases, "machine": machine})


def pressing(job: Job) -> Job:
    """Return the part of a job up to the end of the phase `press`, `SLOWER` times slower."""
    count = 1 + next(i for i, each in enumerate(job.document["phases"]) if each["name"] == "press")
    phases = job.document["phases"][:count]
    end = phases[-1]["last"] + 1
    robots = []
    for robot in job.robots:
        rows = {k: v[:end] if len(v) == len(job.time) else v for k, v in _lists(robot)}
        rows["velocity"] = [[v / SLOWER for v in row] for row in rows["velocity"]]
        rows["acceleration"] = [[a / SLOWER**2 for a in row] for row in rows["acceleration"]]
        for name in ("effort_with_gravity", "effort_without_gravity"):
            both = zip(rows[name], rows[f"hold_{name}"], strict=True)
            rows[name] = [
                [b + (a - b) / SLOWER**2 for a, b in zip(*pair, strict=True)] for pair in both
            ]
        robots.append(robot | rows)
    time = [SLOWER * t for t in job.time[:end]]
    return Job(job.document | {"time": time, "phases": phases, "robots": robots})


def _lists(robot: dict[str, Any]) -> Iterator[tuple[str, list[Any]]]:
    return ((name, values) for name, values in robot.items() if isinstance(values, list))


@dataclass(frozen=True)
class Look:
    """One measurement of both moving arms.

    Attributes:
        time: time of the measurement [s].
        s: commanded point on the path, as its planned time [s].
        direction: rate of the planned time, 1 forward or -1 back.
        age: time since each arm's posture was measured [s].
        q: joint positions of each arm [rad or m].
    """

    time: float
    s: float
    direction: float
    age: list[float]
    q: list[list[float]]


@dataclass
class Looks:
    """All measurements of both arms.

    Attributes:
        moving: measurements while the arms move without touching anything.
        forces: raw readings of each arm's force sensor while nothing touches it [N].
        pressed: one entry per measurement while a block is pressed: time [s], distance of the
            pressing pad beyond its planned position [m], commanded force [N], and raw reading of
            each sensor [N].
    """

    moving: list[Look] = field(default_factory=list)
    forces: tuple[list[float], list[float]] = field(default_factory=lambda: ([], []))
    pressed: list[tuple[float, float, float, list[float | None]]] = field(default_factory=list)

    def note(
        self, now: float, machine: Machine, seen: Seen, raw: list[float | None], way: float = nan
    ) -> None:
        """Store the measurements of one time. Nothing is stored unless the job runs at a constant
        rate.

        Args:
            now: time of the measurements, on the clock of the program [s].
            machine: state machine of the job, with the commanded point on the path.
            seen: measured state of both arms.
            raw: reading of each arm's force sensor [N]; None without a sensor.
            way: distance of the pressing pad beyond its planned position [m]; NaN if unknown.
        """
        clock, job = machine.clock, machine.job
        if machine.state != "running" or clock.turning:
            return
        if max(job.robots[0]["normal_force"]) > 0.0:
            wanted = min(job.force(arm, clock.s) for arm in (0, 1))
            if clock.rate > 0.0 and wanted > 0.0:
                self.pressed.append((now, way, wanted, raw))
            return
        for own, value in zip(self.forces, raw, strict=True):
            own += [] if value is None else [value]
        if not self.moving or now - self.moving[-1].time >= EVERY:
            q = [list(each) for each in seen.q if each is not None]
            self.moving.append(Look(now, clock.s, clock.rate, seen.age, q))

    def offset(self, arm: int) -> float:
        """Return the median reading of an arm's force sensor while nothing touches the arm [N]; NaN
        without readings."""
        return median(self.forces[arm]) if self.forces[arm] else nan

    def speed(self, job: Job, arm: int) -> float:
        """Return the largest measured speed of an arm's pad, divided by the largest planned speed
        of this pad in the job."""
        reach, found = job.robots[arm]["reach"], [0.0]
        for one, other in zip(self.moving, self.moving[WINDOW:], strict=False):
            passed = other.time - other.age[arm] - one.time + one.age[arm]
            if one.direction == other.direction and passed > EVERY:
                moved = zip(reach, one.q[arm], other.q[arm], strict=True)
                found.append(sum(r * abs(b - a) for r, a, b in moved) / passed)
        window = WINDOW * EVERY
        planned = [job.distance(arm, job.position(arm, s), s + window) / window for s in job.time]
        return max(found) / max(planned)

    def late(self, job: Job, arm: int) -> float:
        """Return the median time [s] by which an arm's measured posture is behind the commanded
        point on the path; NaN without measurements. Only measurements in fast motion count."""
        fastest, found = max(job.speed(arm, s) for s in job.time), []
        for look in self.moving:
            forward = look.direction
            expected = min(max(look.s - forward * look.age[arm], 0.0), job.end)
            if job.speed(arm, expected) > FAST * fastest:
                low, high = sorted((-forward * BEHIND, forward * AHEAD))
                at = job.coordinate(arm, look.q[arm], expected, (low, high), 0.0)
                found.append(forward * (expected - at))
        return median(found) if found else nan

    def contact(self, arm: int, lag: float) -> dict[str, float]:
        """Evaluate the readings of an arm's force sensor while a block was pressed.

        Args:
            arm: index of the arm.
            lag: delay of the arm behind its commands [s].

        Returns:
            Values of `Measured` by name: `sign`, the sign of the sensor's reading; and `stiffness`
            of the arm if the displacement of the pad is known, else `press`, the ratio of measured
            to commanded force.

        Raises:
            Refused: no force was measured.
        """
        readings = [(t, way, wanted, raw[arm]) for t, way, wanted, raw in self.pressed]
        known = [(*rest, raw - self.offset(arm)) for *rest, raw in readings if raw is not None]
        most = max((row[2] for row in known), default=0.0)
        sign = 1.0 if sum(row[3] for row in known) > 0.0 else -1.0
        largest = max((sign * row[3] for row in known), default=0.0)
        if largest < max(LEAST_FORCE, LEAST_SHARE * most):
            raise Refused(f"nothing presses back, {largest:.1f} N are measured: {BLOCK}")
        if isnan(known[0][1]):
            full = [sign * row[3] / row[2] for row in known if row[2] >= FULL * most]
            return {"sign": sign, "press": median(full)}
        times = [row[0] for row in known]
        fitted = [
            (known[min(bisect_left(times, t - lag), len(known) - 1)][1], sign * force)
            for t, _, _, force in known
            if sign * force > FITTED * largest
        ]
        # Both arms in series have half the stiffness of each.
        slope = linear_regression(*zip(*fitted, strict=True)).slope
        return {"sign": sign, "stiffness": 2.0 * slope}

    def measured(self, job: Job, arm: int, lead: float) -> Measured:
        """Return the measured properties of an arm.

        Args:
            job: the job.
            arm: index of the arm.
            lead: time by which the program sends the arm's commands ahead, to compensate its delay
                [s].
        """
        late = self.late(job, arm)
        found = Measured(lead + late, late, self.speed(job, arm))
        if not self.forces[arm] or not self.pressed:
            return found
        contact = self.contact(arm, found.lag)
        return Measured(found.lag, late, found.speed, self.offset(arm), **contact)


def bring_up(
    folder: Path, job: Job, plan: dict[str, Any], drive: Callable[[Job, str], bool], looks: Looks
) -> int:
    """Measure both arms and write the results into a bundle's folder. Return the exit code.

    Args:
        folder: folder of the bundle.
        job: the job.
        plan: planned values, as `plan` in the bundle's configuration.
        drive: function of a job and a word. It waits until the operator enters the word (without
            waiting for ''), runs the job to its end and back, and stores measurements in `looks`.
            It returns True if the run was completed.
        looks: store of the measurements.

    Raises:
        Refused: a measurement fails.
    """
    parts = [(unloaded(job), "")]
    parts += [(pressing(job), "press")] if plan["presses"] else []
    for part, word in parts:
        if not drive(part, word):
            fast = [f"{looks.speed(job, arm):.2f}" for arm in (0, 1)]
            raise Refused(f"bring-up has not ended; speed over the planned one: {', '.join(fast)}")
    found = [looks.measured(job, arm, plan["leads"][arm]) for arm in (0, 1)]
    # Only one of two sensors may be there.
    stiffness = max((each.stiffness for each in found if not isnan(each.stiffness)), default=nan)
    lines = [f"# Measured by {plan['program']} --bring-up.", f'job = "{_digest(folder)}"']
    for robot, driver, own in zip(job.robots, plan["drivers"], found, strict=True):
        stated = driver | {"lag": round(max(own.lag, 0.0), 4)}
        stated |= {} if isnan(stiffness) else {"stiffness": round(stiffness, 1)}
        lines += ["", "[[robots]]", f"name = {json.dumps(robot['name'])}", "[robots.driver]"]
        lines += [f"{name} = {json.dumps(value)}" for name, value in stated.items()]
        lines += ["[robots.measured]", *(f"{k} = {v:.6g}" for k, v in asdict(own).items())]
    (folder / FILE).write_text("\n".join([*lines, ""]), "utf-8")
    print("\n".join(lines))
    require(folder, job, plan)
    return 0


def require(folder: Path, job: Job, plan: dict[str, Any]) -> list[Measured]:
    """Read the measured properties of both arms from a bundle's folder, and compare them with the
    plan.

    Args:
        folder: folder of the bundle.
        job: the job.
        plan: planned values, as `plan` in the bundle's configuration.

    Raises:
        Refused: nothing was measured, the measurements are of another job, or a value differs too
            much from the plan.
    """
    first = f"python3 {plan['program']} --bring-up first; --in-air drives the job without a box"
    try:
        document = tomllib.loads((folder / FILE).read_text("utf-8"))
        found = [Measured(**robot["measured"]) for robot in document["robots"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Refused(f"nothing was measured of these arms ({error}): {first}") from error
    if document.get("job") != _digest(folder) or len(found) != len(job.robots):
        raise Refused(f"{FILE} is of another job: {first}")
    problems = list(_problems(job, plan, found))
    if problems:
        raise Refused(
            f"{'; '.join(problems)}. To plan with what was measured: dual-arm-carry export "
            f"TRAJECTORY --target {plan['target']} --driver {folder / FILE}"
        )
    return found


def _problems(job: Job, plan: dict[str, Any], found: Sequence[Measured]) -> Iterator[str]:
    apart = abs(found[0].late - found[1].late)
    if not apart <= job.limits.skew:
        yield (
            f"the arms are {1e3 * apart:.1f} ms apart, the job bears {1e3 * job.limits.skew:.1f} "
            f"(--skew {apart:.3f}, a slower timing)"
        )
    for robot, own, driver in zip(job.robots, found, plan["drivers"], strict=True):
        name, planned, most = robot["name"], plan["stiffness"], max(robot["normal_force"])
        if not abs(own.lag - driver["lag"]) <= LAG:
            yield f"{name} lags by {1e3 * own.lag:.0f} ms, planned are {1e3 * driver['lag']:.0f}"
        if not own.speed >= SPEED:
            yield (
                f"{name} reaches {100.0 * own.speed:.0f} % of the planned speed: let its "
                "controller drive it, or time the carry with a lower velocity_max of the robot"
            )
        if abs(own.offset) > UNLOADED * most:
            yield f"the sensor of {name} feels {own.offset:.1f} N in the air: zero it"
        if planned and abs(own.stiffness - planned) > STIFFNESS * planned:
            yield f"{name} has {own.stiffness:.0f} N/m at its pad, planned are {planned:.0f}"
        if not planned and abs(own.press - 1.0) > job.limits.force:
            yield f"{name} presses {100.0 * own.press:.0f} % of the command: state its tool_load"


def _digest(folder: Path) -> str:
    return hashlib.sha256((folder / "job.json").read_bytes()).hexdigest()
