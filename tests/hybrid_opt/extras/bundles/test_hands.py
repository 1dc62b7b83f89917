"""Jobs of hands that hold by themselves: when programs switch them, wait for them, and never drop
the box."""

from __future__ import annotations

import ast
import csv
import io
import json
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from hybrid_opt.cell import Cell
from hybrid_opt.compiled_cell import InterpretedCell
from hybrid_opt.extras.bundles import TARGETS, BundleOptions, export
from hybrid_opt.extras.bundles.bundle import prepared
from hybrid_opt.extras.bundles.job_file import Contents, Export
from hybrid_opt.extras.bundles.programs import carry_job as programs
from hybrid_opt.extras.bundles.programs import filled
from hybrid_opt.extras.bundles.programs.carry_job import Refused
from hybrid_opt.extras.bundles.programs.carry_machine import Machine, Seen
from hybrid_opt.extras.bundles.targets import TORQUE_DRIVERS, missing_for
from hybrid_opt.extras.bundles.urscript import urscript_files
from hybrid_opt.job.plan import JobModel
from hybrid_opt.job.records import SWITCHES, Job
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Driver
from tests.hybrid_opt.cells import shipped
from tests.hybrid_opt.extras.bundles.bundles import DRIVER, driven
from tests.hybrid_opt.extras.bundles.controlled import VALVE
from tests.hybrid_opt.extras.bundles.mock_ros import World, run
from tests.hybrid_opt.extras.bundles.test_urscript import CYCLE, Pair, as_python

PERIOD, LOOK = 0.01, 0.02
"""Between two looks of programs, and of the many faults [s]."""

FORCE = 200.0
"""With which either arm's cup holds [N]."""

NAMES = {
    "simulation": ("/valve", "/vacuum"),
    "ur": ("2", "5"),
}
"""Outputs and inputs by the driver of the target torque."""


@cache
def planned() -> tuple[Job, TimingModel]:
    """The rack's job with a cup in place of either pad."""
    pads = shipped("rack").workcell
    first, second = (replace(pad, kind="cup", holding_force=FORCE) for pad in pads.contacts)
    task = replace(pads.task, allocation="holding-hands", reference_force=np.full(2, FORCE))
    workcell = replace(pads, contacts=(first, second), task=task)
    compiled = InterpretedCell(workcell)
    cell = Cell(workcell, compiled=compiled)
    model = cell.timing_model
    timing = time_path(model, cell.initial, TimingLimits(reference_speed=True))
    return JobModel(compiled, model).plan(timing), model


def with_lines(output: str, source: str, driver: Driver = DRIVER) -> Job:
    """The job with these names of outputs and inputs, those of ROS in the arm's namespace."""
    job = driven(planned()[0], driver)
    robots = []
    for robot in job.workcell.robots:
        names = [
            f"/{robot.name}{name}" if name.startswith("/") else name for name in (output, source)
        ]
        own = replace(robot.driver, grip_output=names[0], grip_input=names[1])
        robots.append(replace(robot, driver=own))
    return replace(job, workcell=replace(job.workcell, robots=(robots[0], robots[1])))


@contextmanager
def planned_model() -> Iterator[None]:
    """Use the timing model of the planned carry, which needs no compiler."""
    rooms, model = ("bundle", "job_file"), planned()[1]
    with ExitStack() as stack:
        for room in rooms:
            name = f"hybrid_opt.extras.bundles.{room}.timing_model"
            stack.enter_context(patch(name, return_value=model))
        yield


def sheet(target: str, job: Job, step: float = 0.05) -> Export:
    with planned_model():
        found = prepared(job, target, BundleOptions(step=step, any_arm=True))
        assert found.holding.shape == found.sampled.q.shape
        return found


@cache
def torque(driver: str) -> Contents:
    """The files of the target torque."""
    with (
        patch("hybrid_opt.extras.bundles.targets.driver_of", return_value=driver),
        patch("hybrid_opt.extras.bundles.torque.driver_of", return_value=driver),
    ):
        return TORQUE_DRIVERS[driver].files(sheet("torque", with_lines(*NAMES[driver])))


@cache
def read_job() -> programs.Job:
    return programs.Job(json.loads(torque("simulation")["job.json"]))


def height() -> tuple[Array, Array]:
    """Times of the samples, and how far the box is off both places where it stands [m]."""
    pose = np.array(read_job().document["box"]["pose"])[:, :3]
    off = [np.linalg.norm(pose - pose[k], axis=1) for k in (0, -1)]
    return np.array(read_job().time), np.minimum(*off)


# --- the plan ---


def test_hands_take_hold_before_they_bear_anything() -> None:
    job = planned()[0]
    names = [phase.name for phase in job.phases]
    assert names == [
        *("approach", "grip_on", "load", "lift", "carry", "set_down", "unload", "grip_off"),
        "retreat",
    ]
    for phase in job.phases:
        still = phase.name in ("grip_on", "load", "unload", "grip_off")
        assert (np.ptp(phase.motion.q, axis=0).max() == 0.0) == still
        assert (phase.force.normal.max() > 0.0) == (phase in job.held or "load" in phase.name)
        assert phase.certificate.is_free
    assert job.phase("grip_on").duration == pytest.approx(0.504)
    assert job.follower is None


def test_arms_exert_what_the_box_needs_and_no_squeeze() -> None:
    """Newton's law at rest: both wrenches bear the weight."""
    job = planned()[0]
    mass = job.workcell.payload.mass
    for name in ("lift", "set_down"):
        force = job.phase(name).force.wrench[[0, -1], :, :3].sum(axis=1)
        np.testing.assert_allclose(force, np.tile([0.0, 0.0, 9.81 * mass], (2, 1)), atol=1e-6)
    apart = job.phase("carry").force.wrench[:, 0, :3] - job.phase("carry").force.wrench[:, 1, :3]
    normal = job.workcell.contacts[0].T_box_pad[:3, 2]
    assert np.abs(apart[0] @ normal) < 1.0


def test_hands_use_no_more_than_their_force() -> None:
    job, _ = planned()
    most = float(job.peak_normal_force.max())
    assert max(phase.use.get("holding force", 0.0) for phase in job.phases) == pytest.approx(
        most / FORCE
    )


# --- when programs switch ---


class Valves:
    """Outputs and inputs of both arms' hands, which take hold some time after they are switched."""

    def __init__(self, delay: float) -> None:
        self.on, self.delay, self.age = False, delay, 9.0
        self.leaks, self.silent = [False, False], [False, False]

    def set(self, on: bool, dt: float) -> None:
        self.age = 0.0 if on != self.on else self.age + dt
        self.on = on

    @property
    def inputs(self) -> list[bool | None]:
        held = self.on if self.age >= self.delay else not self.on
        return [
            None if silent else held and not leaks
            for silent, leaks in zip(self.silent, self.leaks, strict=True)
        ]


def posture(s: float) -> list[list[float] | None]:
    return [read_job().position(arm, s) for arm in (0, 1)]


def begun(inputs: tuple[bool, bool] = (True, True)) -> Machine:
    machine = Machine(read_job(), inputs=inputs)
    machine.start(Seen(posture(0.0), grip=[False, False]))
    return machine


def test_outputs_are_on_until_the_box_stands_after_any_fault() -> None:
    """Random faults and commands at random moments: while the box is off its places hands are
    switched on, and while they are, no arm leaves the box."""
    rng, (time, off) = np.random.default_rng(3), height()
    job, holds = read_job(), 0
    leaves = job.begin("grip_on") - 0.01, job.begin("retreat") + 0.01
    for number in range(25):
        machine, valves = begun(), Valves(float(rng.uniform(0.0, 1.0)))
        faults = np.sort(rng.uniform(0.0, 25.0, 2))
        words = rng.choice([-1.0, 1.0], 2)
        kind, arm, now, fault = number % 5, int(rng.integers(2)), 0.0, ""
        while machine.state != "done" and now < 70.0:
            now += LOOK
            if len(faults) and now > faults[0]:
                faults = faults[1:]
                fault = "Ctrl-C" if kind in (0, 1) else ""
                valves.leaks[arm], valves.silent[arm] = kind == 2, kind == 3
            seen = Seen(grip=valves.inputs, fault=fault)
            machine.tick(LOOK, seen)
            valves.set(machine.grip, LOOK)
            lifted = float(np.interp(machine.clock.s, time, off)) > 1e-4
            status = f"{number}: {machine.status()}"
            assert machine.grip or not lifted, status
            if not leaves[0] < machine.clock.s < leaves[1]:
                assert not machine.grip, status
            if lifted and machine.state == "running":
                assert all(valves.inputs) or kind in (2, 3), status
            if machine.state == "held" and len(words):
                fault, valves.leaks, valves.silent = "", [False, False], [False, False]
                machine.resume(words[0], Seen(posture(machine.clock.s), grip=valves.inputs))
                words, holds = words[1:], holds + 1
            elif machine.state == "held":
                break
    assert holds > 25


def ticked(machine: Machine, valves: Valves, most: float) -> float:
    """Run until it is held or done, at most so long; returns how long [s]."""
    now = 0.0
    while machine.state not in ("held", "done") and now < most:
        machine.tick(PERIOD, Seen(posture(machine.clock.s), grip=valves.inputs))
        valves.set(machine.grip, PERIOD)
        now += PERIOD
    return now


def test_the_clock_waits_for_the_hands_of_both() -> None:
    quick, slow = (ticked(begun(), Valves(delay), 60.0) for delay in (0.0, 1.5))
    assert quick == pytest.approx(read_job().end, abs=0.1)
    # Taking hold and letting go each take a second more than the phase.
    assert slow == pytest.approx(quick + 2.0 * (1.5 - 0.504), abs=0.1)


def test_hands_that_never_hold_lift_nothing() -> None:
    machine, valves = begun(), Valves(0.0)
    valves.leaks[1] = True
    ticked(machine, valves, 60.0)
    assert machine.state == "held"
    assert re.search("right .* 3 s", machine.reason)
    assert machine.clock.s == read_job().begin("load")
    assert machine.grip
    # Back to where it stood: the hands let go before the arms leave.
    machine.resume(-1.0, Seen(posture(machine.clock.s), grip=[True, False]))
    ticked(machine, valves, 60.0)
    assert (machine.state, machine.clock.s) == ("done", 0.0)


def test_hands_that_hold_before_they_are_at_the_box_are_refused() -> None:
    for told, said in ((True, "hands of left hold before"), (None, "nothing is heard of the")):
        with pytest.raises(Refused, match=said):
            Machine(read_job(), inputs=(True, False)).start(Seen(posture(0.0), grip=[told, None]))


def test_without_inputs_nothing_is_waited_for() -> None:
    machine, valves = begun((False, False)), Valves(9.0)
    assert ticked(machine, valves, 60.0) == pytest.approx(read_job().end, abs=0.1)


# --- run_job.py ---


def lifted(world: World) -> Array:
    """Of every record, whether the box is off both places where it stands."""
    rows, (_, off) = np.array([row[1] for row in world.record]), height()
    q = np.concatenate([np.array(robot["position"]) for robot in world.robots], axis=1)
    nearest = [int(np.abs(q - row).max(axis=1).argmin()) for row in rows[::20]]
    return np.asarray(off[nearest] > 1e-3)


def on(world: World) -> Array:
    """Of every record, whether the outputs of both arms are on."""
    time = np.array([row[0] for row in world.record])[::20]
    both = []
    for arm in (0, 1):
        known = [(then, level) for then, a, level in world.switched if a == arm]
        times = [then for then, _ in known]
        levels = np.array([False, *(level for _, level in known)])
        both.append(levels[np.searchsorted(times, time)])
    return np.asarray(np.logical_and(*both))


@pytest.mark.parametrize("driver", ["simulation", "ur"])
def test_the_job_is_done(driver: str, tmp_path: Path) -> None:
    code, world = run(torque(driver), tmp_path)
    assert code == 0, world.log
    for arm in (0, 1):
        assert [level for _, a, level in world.switched if a == arm] == [False, True, False]
    assert lifted(world).sum() > 50
    assert on(world)[lifted(world)].all()
    np.testing.assert_allclose(
        world.record[-1][1],
        np.concatenate([read_job().position(arm, read_job().end) for arm in (0, 1)]),
        atol=1e-6,
    )


FAULTS = ("Ctrl-C", "leak", "silent", "abort")


def go_wrong(world: World, name: str) -> None:
    if name == "Ctrl-C":
        world.interrupt()
    elif name == "leak":
        world.leaks[0] = True
    elif name == "silent":
        world.silent[1] = True
    else:
        world.of(0)[0].aborts_at = world.now


@pytest.mark.parametrize(
    ("name", "phase", "word"),
    [
        pytest.param(
            name, phase, word, marks=() if (name, phase, word) in QUICK else pytest.mark.slow
        )
        for QUICK in [(("leak", "carry", "back"), ("Ctrl-C", "load", "leave"))]
        for name in FAULTS
        for phase in ("approach", "grip_on", "load", "lift", "carry", "set_down", "unload")
        for word in ("back", "continue", "leave")
    ],
)
def test_no_fault_drops_the_box(name: str, phase: str, word: str, tmp_path: Path) -> None:
    planned_phase = planned()[0].phase(phase)
    when = 1.6 + planned_phase.begin + 0.5 * planned_phase.duration
    when += 0.6 if phase not in ("approach", "grip_on") else 0.0

    def mend(world: World) -> None:
        world.leaks, world.silent = [False, False], [False, False]

    def prepare(world: World) -> None:
        world.later(when, lambda: go_wrong(world, name))
        world.later(when + 5.0, lambda: mend(world))
        world.later(when + 6.0, lambda: world.command(word))
        for k in range(4):
            world.later(when + 45.0 + k, world.interrupt)

    code, world = run(torque("simulation"), tmp_path, prepare)
    assert on(world)[lifted(world)].all(), world.log
    held = any("held in" in line for line in world.log)
    if name != "leak" or phase in ("carry", "lift"):
        assert held, world.log
    if held:
        assert code == {"leave": 1, "back": 3, "continue": 0}[word], world.log


# --- URScript ---


OUTPUT, INPUT, STEP = 2, 5, 0.008

POINTS = 60
"""Of each phase of a small job."""

LIFTED = 0.1
"""Joint position beyond which the box of the small job is off its places [rad]."""


def small_programs() -> list[ast.Module]:
    """Both arms' programs of a job that turns every joint by 0.5 rad and back."""
    ways = {"lift": (0.0, 0.5), "set_down": (0.5, 0.0)}
    lines, calls = list[str](), list[str]()
    for name in ("grip_on", "lift", "set_down", "grip_off"):
        rows = np.linspace(*ways.get(name, (0.0, 0.0)), POINTS)
        on = SWITCHES.get(name)
        lines += [f"  def {name}():", *([] if on is None else [f"    grip({on})"])]
        lines += [f"    go({[float(value)] * 6}, 0.0)" for value in rows]
        lines += [*([] if on is None else [f"    wait_for_hands({on})"]), "  end"]
        calls.append(f"  {name}()")
    hands = filled("hands.script", output=OUTPUT, input=INPUT, hears=True, most=500)
    text = filled(
        "carry.script",
        title="small",
        first=[0.0] * 6,
        tcp="p[0.0, 0.0, 0.0, 0.0, 0.0, 0.0]",
        payload="0.0, [0.0, 0.0, 0.0]",
        away="    away = norm(here[0] - target[0])",
        start=0.005,
        change=f"{STEP / 0.2:.7f}",
        step=STEP,
        presses=False,
        followed=0.05,
        every=1,
        band=0.1,
        hands=hands,
        phases="\n".join(lines),
        calls="\n".join(["  gripping = run watch_hands()", *calls, "  kill gripping"]),
    )
    return [as_python(text), as_python(text)]


class Gripping(Pair):
    """Both programs with valves: an input follows its output after `VALVE`, unless it leaks."""

    def __init__(self, leaks: dict[int, float], most: float = 60.0) -> None:
        super().__init__([np.zeros(6), np.zeros(6)], {}, small_programs())
        self.most, self.leaks, self.age = most, leaks, [9.0, 9.0]
        self.run()

    def cycled(self) -> None:
        for k, arm in enumerate(self.arms):
            self.age[k] = 0.0 if arm.outs[OUTPUT] != arm.shown[OUTPUT] else self.age[k] + CYCLE
            if self.age[k] >= VALVE:
                arm.buttons[INPUT] = arm.outs[OUTPUT] and self.time < self.leaks.get(k, np.inf)
            assert arm.outs[OUTPUT] or arm.q.max() < LIFTED, "the box falls"

    def told(self, text: str) -> bool:
        return any(f"textmsg {text}" in arm.log for arm in self.arms)


def test_both_programs_switch_and_wait_for_hands() -> None:
    found = Gripping({})
    for arm in found.arms:
        assert arm.log[-1] == "ended", arm.log
        assert max(row[1].max() for row in arm.record) == pytest.approx(0.5)
        assert not arm.outs[OUTPUT]
        assert not arm.pressed
    apart = [np.array([row[1] for row in arm.record[:1200]]) for arm in found.arms]
    count = min(map(len, apart))
    # Both lift in the same cycle, or the next one.
    assert np.abs(apart[0][:count] - apart[1][:count]).max() <= 2.0 * 0.5 / POINTS / 4.0 + 1e-9


@pytest.mark.parametrize("arm", [0, 1])
def test_a_leak_stops_both_programs_with_hands_on(arm: int) -> None:
    lifts = 0.06 + POINTS * STEP + 0.1
    found = Gripping({arm: lifts + 0.3}, 4.0)
    assert found.told("the hands do not hold")
    for each in found.arms:
        assert np.ptp([row[1] for row in each.record[-200:]], axis=0).max() < 1e-9
        assert each.outs[OUTPUT]
        assert each.q.max() > LIFTED


def test_programs_of_hands_that_never_hold_lift_nothing() -> None:
    found = Gripping({1: 0.0}, 4.0)
    assert found.told("the hands do not do what they are told")
    assert max(row[1].max() for arm in found.arms for row in arm.record) == 0.0
    assert all(arm.outs[OUTPUT] for arm in found.arms)


def test_programs_of_a_job_switch_hands_in_their_phases() -> None:
    found = sheet("ur-script", with_lines(str(OUTPUT), str(INPUT)), STEP)
    texts = [str(text) for text in urscript_files(found).values()]
    assert len(texts) == 2
    for text in texts:
        as_python(text)
        for name, on in SWITCHES.items():
            body = text.split(f"  def {name}():")[1].split("\n  end\n")[0].strip()
            assert body.startswith(f"grip({on})")
            assert body.endswith(f"wait_for_hands({on})")
        calls = text.split("gripping = run watch_hands()")[1].split("kill gripping")[0]
        assert [line.strip("() ") for line in calls.split()] == [p.name for p in found.job.phases]
        assert f"set_standard_digital_out({OUTPUT}, level)" in text
        assert "    feel(" not in text.split("def approach")[1]


# --- other targets ---


def test_tables_say_when_hands_are_on() -> None:
    found = sheet("data", with_lines("", ""), 0.05)
    rows = list(csv.DictReader(io.StringIO(str(TARGETS["data"].files(found)["job.csv"]))))
    both = np.array(
        [[float(row[f"{name} grip output [0 or 1]"]) for name in ("left", "right")] for row in rows]
    )
    held = np.array([row["phase"] in ("load", "lift", "carry", "set_down") for row in rows])
    assert (both[held] == 1.0).all()
    assert (np.abs(np.diff(both, axis=0)).sum(axis=0) == 2.0).all()
    gripping = [phase.get("grip") for phase in found.document["phases"]]
    assert gripping == [None, True, *[None] * 5, False, None]


REFUSED: dict[str, tuple[str, str, str, str]] = {
    "no output": ("torque", "", "", "std_srvs/srv/SetBool.*grip_output is ''"),
    "a number": ("torque", "3", "", "grip_output is '3'"),
    "a taken line": ("ur-script", "1", "4", " 2 to 7 .* 4 to 7"),
    "a taken input": ("ur-script", "2", "1", "grip_input is '1'"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_target_says_by_what_it_reaches_hands(name: str, tmp_path: Path) -> None:
    target, output, source, told = REFUSED[name]
    job = with_lines(output, source, replace(DRIVER, address="" if target == "torque" else "ur"))
    with pytest.raises(SettingsError, match=told):
        export(job, target, tmp_path, options=BundleOptions(any_arm=True))
    assert any("grip_" in problem for problem in missing_for(target, job.workcell))


def test_a_job_without_inputs_warns(tmp_path: Path) -> None:
    job = with_lines("", "")
    with planned_model():
        paths = export(job, "data", tmp_path, options=BundleOptions(step=0.1))
    document: Any = json.loads(paths[0].read_text("utf-8"))
    assert document["position_control"] == []
    assert sum("grip_input" in warning for warning in document["warnings"]) == 2
