"""What all programs read and decide: the path's clock, the job's file, when a job stops."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from hybrid_opt.extras.bundles.job_file import pad_places
from hybrid_opt.extras.bundles.programs.carry_job import Job, Refused
from hybrid_opt.extras.bundles.programs.carry_machine import Clock, Machine, Seen
from tests.hybrid_opt.extras.bundles.bundles import exported
from tests.hybrid_opt.extras.bundles.bundles import read_job as job

PERIOD = 0.01


def posture(s: float) -> list[list[float] | None]:
    return [job().position(arm, s) for arm in (0, 1)]


def running(s: float) -> Machine:
    """A machine that runs at a coordinate."""
    machine = Machine(job(), 0.0)
    machine.start(Seen(posture(0.0)))
    machine.clock = Clock(job().end, job().limits.stop_time, s, 1.0)
    return machine


def ticks(machine: Machine, seen: Callable[[float], Seen]) -> int:
    """How often it looks at what is seen at its coordinate until it is held, at most for three
    seconds."""
    count = 0
    while machine.state != "held" and count < 300:
        machine.tick(PERIOD, seen(machine.clock.s))
        count += 1
    return count


def test_a_job_is_between_its_samples() -> None:
    sampled = exported("data").sampled
    spline = CubicHermiteSpline(sampled.time, sampled.q, sampled.q_rate)
    for s in np.random.default_rng(1).uniform(0.0, job().end, 50):
        q = np.concatenate([job().position(arm, float(s)) for arm in (0, 1)])
        np.testing.assert_allclose(q, spline(s), atol=1e-12)
        force = np.interp(s, sampled.time, sampled.normal_force[:, 1])
        assert job().force(1, float(s)) == pytest.approx(force, abs=1e-9)
    for phase in sampled.job.phases:
        assert job().begin(phase.name) == pytest.approx(phase.begin, abs=1e-9)
        assert job().phase(phase.begin + 1e-3) == phase.name


def test_what_moves_goes_with_the_square_of_the_rate() -> None:
    s = job().begin("carry") + 1.0
    still, whole = (np.array(job().effort(0, "with_gravity", s, r)) for r in (0.0, 1.0))
    np.testing.assert_allclose(job().effort(0, "with_gravity", s, -1.0), whole)
    half = job().effort(0, "with_gravity", s, 0.5)
    np.testing.assert_allclose(half, still + (whole - still) / 4.0, atol=1e-9)


@pytest.mark.parametrize(("first", "last"), [(1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (0.4, -1.0)])
def test_the_clock_turns_smoothly(first: float, last: float) -> None:
    clock = Clock(100.0, 0.8, 50.0, first)
    clock.turn(last, after=0.04)
    found = [(clock.rate, clock.change)]
    while clock.turning:
        clock.advance(1e-3)
        found.append((clock.rate, clock.change))
    rate, change = np.array(found).T
    assert rate[-1] == last
    assert len(rate) == pytest.approx((0.04 + 0.8 * abs(last - first)) * 1e3, abs=3)
    np.testing.assert_allclose(np.diff(rate)[45:-5] / 1e-3, change[45:-6], atol=0.02)
    assert np.abs(change[[0, 30, -1]]).max() < 1e-9
    assert clock.s == pytest.approx(50.0 + np.trapezoid(rate, dx=1e-3), abs=1e-6)


def test_what_is_ahead_is_what_happens() -> None:
    clock = Clock(10.0, 0.5, 9.0, 1.0)
    clock.turn(0.0, after=0.02)
    clock.advance(0.1)
    ahead = list(clock.ahead(0.0, 0.05))
    for moment in ahead[1:]:
        clock.advance(0.05)
        assert (moment.s, moment.rate) == pytest.approx((clock.s, clock.rate), abs=1e-12)
    assert ahead[-1].rate == 0.0
    assert list(Clock(1.0, 0.5, 0.0, 1.0).ahead(1.0, 0.3))[-1].s == 1.0


@pytest.mark.parametrize("step", [0.004, 0.05, 0.13])
def test_a_stop_ends_at_one_place_however_often_the_clock_is_looked_at(step: float) -> None:
    """Over a turn from rate 1 to 0 in 0.1 s the smooth profile covers half of it, after 0.04 s."""
    clock = Clock(10.0, 0.5, 1.0, 1.0)
    clock.turn(0.0, 0.04, 0.1)
    while clock.turning:
        clock.advance(step)
    assert clock.s == pytest.approx(1.0 + 0.04 + 0.05, abs=1e-4)


def moved(q: list[float] | None, by: float) -> list[float]:
    assert q is not None
    return [value + by for value in q]


WRONG: dict[str, tuple[Callable[[float], Seen], str]] = {
    "off its path": (lambda s: Seen([moved(posture(s)[0], 0.05), posture(s)[1]]), "^left .* mm"),
    "late": (lambda s: Seen([posture(s - 0.08)[0], posture(s - 0.08)[1]]), "^left .* ms"),
    "apart": (lambda s: Seen([posture(s)[0], posture(s - 0.08)[1]]), " ms"),
    "silent": (lambda s: Seen(posture(s), age=[0.0, 0.3]), r" right .* 0\.30 s"),
    "weak": (lambda s: Seen(posture(s), force=[None, 10.0]), r"^right .* 10\.0 N"),
    "told": (lambda s: Seen(posture(s), fault="door"), "door"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_stops_the_job_on_its_path(name: str) -> None:
    seen, told = WRONG[name]
    machine = running(job().begin("carry") + 2.0)
    # Three looks, and the stop.
    assert ticks(machine, seen) * PERIOD <= job().limits.stop_time + 5.0 * PERIOD
    assert machine.state == "held"
    assert re.search(told, machine.reason), machine.reason
    assert machine.clock.rate == 0.0
    stood = machine.clock.s
    machine.tick(1.0, Seen())
    assert machine.clock.s == stood
    with pytest.raises(Refused, match="news"):
        machine.resume(1.0, Seen())
    with pytest.raises(Refused, match=rf" {1e3 * job().limits.path:.1f} mm"):
        machine.resume(1.0, Seen([moved(q, 0.1) for q in posture(stood)]))
    machine.resume(-1.0, Seen(posture(stood)))
    while machine.state == "running":
        machine.tick(0.05, Seen(posture(machine.clock.s)))
    assert (machine.state, machine.clock.s) == ("done", 0.0)


def off(s: float, way: float) -> Seen:
    """The first arm's pad about so far off its place [m]."""
    reach = max(job().robots[0]["reach"])
    q = posture(s)
    assert q[0] is not None
    q[0][job().robots[0]["reach"].index(reach)] += way / reach
    return Seen(q)


@pytest.mark.parametrize(
    ("phase", "after", "state"),
    [("press", 0.2, "held"), ("carry", 1.0, "running"), ("retreat", 0.2, "held")],
)
def test_places_are_kept_where_they_count(phase: str, after: float, state: str) -> None:
    """12 mm are allowed on the way, not where the box is gripped, nor at the end: an arm that
    stands elsewhere has not done the job."""
    machine = running(job().begin(phase) + after if phase != "retreat" else job().end - 0.5)
    ticks(machine, lambda s: off(s, 0.012))
    assert machine.state == state
    assert bool(re.match("left .* mm", machine.reason)) == (state == "held")


def test_pads_have_to_press_before_the_box_is_lifted() -> None:
    weak = running(job().begin("press") + 0.2)
    ticks(weak, lambda s: Seen(posture(s), force=[None, 0.5 * job().force(1, s)]))
    assert "presses" in weak.reason
    z = [row[2] for row in job().document["box"]["pose"]]
    risen = np.interp([weak.clock.s, job().pressed], job().time, z)
    assert risen[0] - risen[1] < 1e-4, "nothing is lifted"


def _seen_late(shift: float, age: float, s: float) -> Seen:
    return Seen(posture(s - shift), age=[age, age])


@pytest.mark.parametrize("age", [0.0, 0.03, 0.09])
def test_postures_are_compared_when_they_were_measured(age: float) -> None:
    """A late message of an arm in its place stops nothing; one of an arm that is late does."""
    s = job().begin("carry") + 2.0
    for late, state in ((0.0, "running"), (0.08, "held")):
        machine, shift = running(s), age + late
        ticks(machine, partial(_seen_late, shift, age))
        assert machine.state == state, machine.status()


def test_both_arms_are_compared_at_one_time() -> None:
    machine = running(job().begin("carry") + 2.0)
    first, second = 0.0, 0.08
    ticks(
        machine,
        lambda s: Seen([posture(s - first)[0], posture(s - second)[1]], age=[first, second]),
    )
    assert machine.state == "running", machine.status()


@pytest.mark.parametrize(("silent", "state"), [(1, "done"), (2, "done"), (10, "held")])
def test_late_news_at_the_end_do_not_hold_the_job(silent: int, state: str) -> None:
    machine = running(job().end - 2.5 * PERIOD)
    ages = [0.0] * 2 + [0.3] * silent + [0.0] * 10
    for age in ages:
        machine.tick(PERIOD, Seen(posture(machine.clock.s), age=[age, 0.0]))
    assert machine.state == state, machine.status()


@pytest.mark.parametrize(("age", "silent"), [(0.0, "right is "), (0.3, "left and right are ")])
def test_nothing_is_said_of_arms_that_are_silent(age: float, silent: str) -> None:
    machine = running(job().begin("carry") + 2.0)
    ticks(machine, lambda s: Seen(posture(s), age=[age, 0.3]))
    assert f" {silent}silent" in machine.status()


@pytest.mark.parametrize("stopped", [(True, False), (False, True), (True, True)])
def test_arms_that_stopped_by_themselves_go_on_from_there(stopped: tuple[bool, bool]) -> None:
    """They are behind by what the stop of the others took. One that is farther away has to be
    moved first."""
    s, way = job().begin("carry") + 2.0, job().limits.partner_stop_time

    def seen(behind: float) -> Seen:
        at = [s - behind if each else s for each in stopped]
        return Seen([job().position(arm, each) for arm, each in enumerate(at)])

    arm, machine = stopped.index(True), running(s)
    machine.hold("asked")
    q = seen(0.95 * way).q[arm]
    assert q is not None
    assert job().distance(arm, q, s) > 2.0 * job().limits.path
    with pytest.raises(Refused, match=" mm"):
        machine.resume(-1.0, seen(1.5 * way))
    machine.resume(-1.0, seen(0.95 * way))
    assert machine.state == "running"


def test_one_strange_look_stops_nothing() -> None:
    machine = running(job().begin("carry") + 2.0)
    machine.tick(PERIOD, Seen(posture(0.0)))
    machine.tick(PERIOD, Seen(posture(0.0)))
    machine.tick(PERIOD, Seen(posture(machine.clock.s + PERIOD)))
    machine.tick(PERIOD, Seen(posture(0.0)))
    assert machine.state == "running"


def height(s: float) -> float:
    """Of the box above where it is set down [m]."""
    places = np.array(job().document["box"]["pose"])[:, 2]
    return float(np.interp(s, job().time, places) - places[-1])


@pytest.mark.parametrize(("above", "state"), [(0.003, "done"), (0.008, "held")])
def test_a_box_that_stands_early_is_let_go_there(above: float, state: str) -> None:
    """Soft arms stay where it stands, and press half as much again until their efforts fall."""
    own = Job(job().document)
    release = own.begin("release")
    touch = max(s for s in np.arange(release - 2.0, release, 1e-3) if height(s) >= above)
    machine = Machine(own, 0.0)
    machine.start(Seen(posture(0.0)))
    machine.clock = Clock(own.end, own.limits.stop_time, touch - 0.1, 1.0)
    stands, told, count = posture(touch), [posture(touch - 0.1)], 0
    while machine.state not in ("held", "done") and count < 3000:
        s = machine.clock.s
        seen = Seen(told[-1], [own.force(arm, s) for arm in (0, 1)])
        if s >= touch:
            seen = Seen(stands, [1.5 * force for force in seen.force if force is not None])
        if own.phase(s) == "retreat":
            seen.q = told[-1]
        machine.tick(PERIOD / 2.0, seen)
        told.append([own.position(arm, machine.clock.s) for arm in (0, 1)])
        count += 1
    assert machine.state == state, machine.status()
    assert own.is_standing == (state == "done")
    steps = np.abs(np.diff(np.array(told, dtype=float), axis=0)).max(axis=(0, 2))
    assert steps.max() < 0.01, "no reference jumps"
    if state == "done":
        end = own.begin("retreat")
        reached = [own.position(arm, end) for arm in (0, 1)]
        np.testing.assert_allclose(reached, np.array(stands, dtype=float), atol=1e-9)
        machine.hold("asked")
        with pytest.raises(Refused, match="'continue'"):
            machine.resume(-1.0, Seen(told[-1]))


def test_a_job_begins_only_in_its_first_places() -> None:
    with pytest.raises(Refused, match=r" left .* mm"):
        Machine(job(), 0.0).start(Seen([moved(posture(0.0)[0], 0.02), posture(0.0)[1]]))
    for force in (0.1 * max(job().robots[1]["normal_force"]), 50.0):
        with pytest.raises(Refused, match=rf"right .* {force:.1f} N"):
            Machine(job(), 0.0).start(Seen(posture(0.0), force=[0.0, force]))
    with pytest.raises(Refused, match=r"right.*sensor"):
        Machine(job(), 0.0, sensors=(False, True)).start(Seen(posture(0.0)))
    for document in ({}, {"format": "dual-arm-carry job", "version": 1}):
        with pytest.raises(Refused, match="version 2"):
            Job(document)


def test_distances_are_bounds() -> None:
    """Of a pad's way between two postures, by Pinocchio's kinematics."""
    found, rng = exported("data"), np.random.default_rng(2)
    for arm in (0, 1):
        q = found.sampled.arm(arm, found.sampled.q)
        for k in range(0, len(q), 200):
            other = q[k] + rng.normal(0.0, 1e-3, q.shape[1])
            places = pad_places(found.workcell, arm, np.array([q[k], other]))[:, :3, 3]
            way = float(np.linalg.norm(places[1] - places[0]))
            s = float(found.sampled.time[k])
            assert way <= job().distance(arm, other.tolist(), s) + 1e-6


KINDS: dict[str, Callable[[Seen, int, float, float], object]] = {
    "freeze": lambda seen, arm, s, when: seen.q.__setitem__(arm, posture(when)[arm]),
    "late": lambda seen, arm, s, when: seen.q.__setitem__(arm, posture(max(s - 0.15, 0.0))[arm]),
    "silent": lambda seen, arm, s, when: seen.age.__setitem__(arm, 0.2),
    "sensor": lambda seen, arm, s, when: seen.force.__setitem__(arm, job().force(arm, s) + 60.0),
    "encoder": lambda seen, arm, s, when: seen.q.__setitem__(arm, moved(seen.q[arm], 0.1)),
    "asked": lambda seen, arm, s, when: setattr(seen, "fault", "Ctrl-C"),
    "pause": lambda seen, arm, s, when: None,
}


def test_many_faults_in_all_phases() -> None:
    """Both arms follow, then something happens at a random moment: the job ends held, on its path,
    within the stop that it states, pressing what belongs there. A pause of 50 ms stops nothing."""
    rng = np.random.default_rng(7)
    for number in range(70):
        kind, arm = list(KINDS)[number % len(KINDS)], int(rng.integers(2))
        when = float(rng.uniform(0.3, job().end - 2.0))
        machine = running(when - 0.05)
        for tick in range(400):
            s, pause = machine.clock.s, 0.05 if kind == "pause" and tick == 6 else 0.0
            seen = Seen(posture(s), [job().force(a, s) for a in (0, 1)])
            if s >= when:
                KINDS[kind](seen, arm, s, when)
            machine.tick(PERIOD + pause, seen)
            # Nothing that is told moves faster than the job would.
            assert abs(machine.clock.rate) <= 1.0
            if machine.state in ("held", "done"):
                break
        told = f"{kind} at {when:.2f} s in {job().phase(when)}: {machine.status()}"
        stops = kind in ("silent", "encoder", "asked")
        held_box = job().begin("lift") < when < job().begin("release") - 0.3
        moves = min(job().speed(a, when + d) for a in (0, 1) for d in (0.1, 0.4)) > 0.5 * (
            job().fastest
        )
        if stops or (kind == "sensor" and held_box) or (kind in ("freeze", "late") and moves):
            assert machine.state == "held", told
            limits = job().limits
            # To see it: 20 mm of path at most, three looks; then the stop.
            noticed = 20.0 * PERIOD + limits.behind
            assert machine.clock.s <= when + noticed + limits.stop_time / 2.0 + PERIOD, told
            assert machine.clock.rate == 0.0
        elif kind == "pause":
            assert machine.state in ("running", "done"), told
