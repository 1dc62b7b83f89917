"""The EGM modules and the program that streams both arms, against controllers that follow late."""

from __future__ import annotations

import json
import logging
import math
import re
import struct
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from rapidchecker.check import check_format

from hybrid_opt.extras.bundles import BundleOptions
from hybrid_opt.extras.bundles.arms import ABB, UR, require_arms
from hybrid_opt.extras.bundles.bundle import prepared
from hybrid_opt.extras.bundles.egm import egm_files
from hybrid_opt.extras.bundles.job_file import Contents
from hybrid_opt.extras.bundles.programs.bring_up import FILE, Looks, Measured, bring_up, require
from hybrid_opt.extras.bundles.programs.carry_job import Job, Refused
from hybrid_opt.extras.bundles.programs.run_egm import FromRobot, Stream, read_robot, to_robot
from hybrid_opt.job.records import HELD_PHASES, PHASES
from studies.programs.trajectory import driver_changes
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.robot.model import build_robot_model
from tests.hybrid_opt.extras.bundles.bundles import driven, exported, rack_driven, text_of
from tests.hybrid_opt.job.jobs import rack, rack_job
from tests.refusals import refused
from tests.symbolic.cells import GOFA

EGM = ("T_ROB1/CarryEgm1.mod", "T_ROB2/CarryEgm2.mod")


def test_others_read_the_modules() -> None:
    """rapidchecker, which refuses broken ones."""
    texts = [text_of("abb-egm", name).replace("\r\n", "\n") for name in EGM]
    for text in texts:
        assert not problems(text), problems(text)
    for part, other in (("ENDPROC", ""), (":=", "="), (";", ""), ("[", "")):
        assert problems(texts[-1].replace(part, other, 1))


def problems(text: str) -> list[str]:
    """What rapidchecker says against a module, its indentation aside."""
    try:
        found = check_format(text)
    except Exception as error:
        return [str(error)]
    return [str(each) for each in found if "indent" not in str(each).lower()]


def test_the_make_of_every_arm_counts(tmp_path: Path) -> None:
    """It is in the robot's name where nothing else tells it, as of a xacro file that was expanded
    to be stored."""
    path = tmp_path / "arm.urdf"
    text = GOFA.read_text("utf-8")
    path.write_text(re.sub(r'<robot name="[^"]*"', '<robot name="ur10e"', text, count=1), "utf-8")
    cell = rack().workcell
    ur = tuple(replace(robot, urdf=path) for robot in cell.robots)
    for robots, sound in ((cell.robots, ABB), (ur, UR), ((ur[0], cell.robots[1]), "")):
        for maker in (ABB, UR):
            with (
                nullcontext() if maker == sound else refused(SettingsError, "another-maker", maker)
            ):
                there = replace(cell, robots=(robots[0], robots[1]))
                require_arms(there, "a target", maker, (6,), any_arm=False)


def test_names_cannot_leave_a_comment() -> None:
    job = rack_job()
    robot, other = job.workcell.robots
    robots = (replace(robot, name="räbot \n"), other)
    evil = replace(job.workcell, name="x\r\n  EXIT;\n", robots=robots)
    sheet = prepared(driven(replace(job, workcell=evil)), "abb-egm", BundleOptions())
    text = egm_files(sheet)[EGM[0]]
    assert isinstance(text, str)
    assert text.count("EXIT;") == text_of("abb-egm", EGM[0]).count("EXIT;") + 1
    assert "! x??  EXIT;?" in text


def test_the_tool_and_the_largest_speed_are_those_of_the_job() -> None:
    job = exported("abb-egm").sampled
    for arm, name in enumerate(EGM):
        text = text_of("abb-egm", name)
        assert "carryPad := [TRUE,[[0.000000,0.000000,190.000000],[1.000000," in text
        (deviation,) = re.findall(r"MaxSpeedDeviation:=(\d+);", text)
        fastest = np.rad2deg(np.abs(job.arm(arm, job.q_rate)).max())
        assert 1.1 * fastest < float(deviation) < 1.2 * fastest + 1.0


CYCLE = 0.004
"""Of EGM [s]."""

STIFFNESS = 1e4
"""Of each arm at its pad [N/m]."""

LONGEST = 40.0
"""A stream that does not come that far waits for ever [s]."""


def field(number: int, kind: int, data: bytes) -> bytes:
    """A field of protocol buffers by hand: bytes of one length prefix, or as they are."""
    return bytes([number << 3 | kind]) + (bytes([len(data)]) if kind == 2 else b"") + data


def doubles(values: Any, number: int = 1) -> bytes:
    return b"".join(field(number, 1, struct.pack("<d", value)) for value in values)


def from_robot(number: int, degrees: Any, force: Any, newer: bool) -> bytes:
    """EgmRobot by hand."""
    header = field(1, 2, field(1, 0, bytes([number % 128])) + field(3, 0, b"\x02"))
    feedback = field(2, 2, field(1, 2, doubles(degrees)))
    state = field(5, 2, field(1, 0, b"\x03"))
    active = field(1, 0, b"\x01") if newer else b""
    sensor = field(9, 2, active + doubles(force, 2 if newer else 1))
    return header + feedback + state + sensor


@pytest.mark.parametrize("newer", [False, True])
def test_messages_of_a_controller_are_read(newer: bool) -> None:
    joints, force = [1.5, -20.0, 30.0, 0.0, 1e-3, 179.0], [1.0, 2.0, -66.5, 0.1, 0.2, 0.3]
    found = read_robot(from_robot(7, joints, force, newer))
    assert found == FromRobot(7, tuple(joints), (), tuple(force), True)


def test_messages_to_a_controller_are_those_of_the_definition() -> None:
    values = [float(k) for k in range(6)]
    data = to_robot(3, 1.25, values, [9.0])
    header = field(1, 0, b"\x03") + field(2, 0, b"\xe2\x09") + field(3, 0, b"\x03")
    planned = field(1, 2, doubles(values)) + field(3, 2, doubles([9.0]))
    assert data == field(1, 2, header) + field(2, 2, planned)


@pytest.mark.parametrize(
    "data", [b"\xff" * 12, b"\x0a\x50\x01", b"\x12\x05\x0a\x03\x09\x01", b"\x0b"]
)
def test_what_is_no_message_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="EGM"):
        read_robot(data)


@cache
def models() -> list[tuple[Any, Any]]:
    found = [build_robot_model(robot) for robot in rack().workcell.robots]
    return [(each, each.model.createData()) for each in found]


def gap(q: Array) -> float:
    """The distance between the pads along the first one's normal less the box between them [m]."""
    cell, places = rack().workcell, []
    for robot, (arm, data), own in zip(cell.robots, models(), np.split(q, 2), strict=True):
        pin.framesForwardKinematics(arm.model, data, own)
        flange = data.oMf[arm.flange_id].homogeneous
        places.append(robot.T_world_base @ flange @ robot.T_flange_pad)
    one, other = (contact.T_box_pad[:3, 3] for contact in cell.contacts)
    return float(places[0][:3, 2] @ (places[1] - places[0])[:3, 3] - np.linalg.norm(other - one))


@cache
def files_for(stiffness: float) -> Contents:
    options = BundleOptions(stiffness=stiffness)
    return egm_files(prepared(rack_driven(), "abb-egm", options))


MEASURED = [Measured(0.03, 0.0, 1.0, 0.0, -1.0, STIFFNESS)] * 2
"""Of arms that are what they were planned to be."""


LOG = logging.getLogger(__name__)


class Cell:
    """Two controllers that follow late, and a box between two springs.

    Attributes:
        part: of the job that is driven.
        is_empty: nothing stands between the pads.
        sign: of the force that the sensors read.
        force: of the pads on the box [N].
        record: per cycle time, coordinate of the stream, force, its reference, both arms' joints.
    """

    def __init__(self, planned: float = STIFFNESS, real: float = STIFFNESS) -> None:
        """Arms of a real stiffness, in a bundle for a planned one [N/m]."""
        files, self.stiffness = files_for(planned), real
        self.job = self.part = Job(json.loads(files["job.json"]))
        self.config = config = json.loads(files["config/egm.json"])
        self.stream = Stream(self.job, config, MEASURED, LOG)
        self.is_empty, self.sign = False, -1.0
        self.now, self.force = 50.0, 0.0
        self.offset, self.silent = 0.0, [False, False]
        self.stands = [False, False]
        self.record: list[tuple[float, float, float, float, Array]] = []
        self._q = [self.job.position(arm, 0.0) for arm in (0, 1)]
        self.follow(config["lags"])

    def follow(self, lags: Any) -> None:
        """Let both arms follow with lags [s]."""
        late = [round(lag / CYCLE) for lag in lags]
        both = zip(self._q, late, strict=True)
        self._told = [deque([q] * cycles, maxlen=cycles) for q, cycles in both]

    def drive(self, part: Job, word: str) -> bool:
        """Drive a part of the job to its end and back, as the program does."""
        looks = self.stream.looks or Looks()
        self.part, self.is_empty = part, not word
        self.stream = Stream(part, self.config, looks, LOG)
        assert self.run("done", "held") == "done", self.stream.machine.status()
        self.stream.machine.hold("it goes back")
        self.stream.command = "back"
        self.cycle()
        return self.run("done", "held") == "done"

    def cycle(self) -> None:
        """One cycle of both controllers."""
        self.now += CYCLE
        stream = self.stream
        stream.tick(self.now)
        for arm in (0, 1):
            if not self.stands[arm]:
                self._q[arm] = list(self._told[arm][0])
        q = np.concatenate(self._q)
        along = gap(q)
        s = stream.machine.clock.s
        touches = self.part.begin("press") < s < self.part.begin("retreat") and not self.is_empty
        self.force = max(0.0, -self.stiffness / 2.0 * along) if touches else 0.0
        for arm in (0, 1):
            if self.silent[arm]:
                continue
            degrees = [math.degrees(value) for value in self._q[arm]]
            # Of the pressing arm's sensor: what it feels is made right, and the other's is wrong.
            offset = self.offset if arm == stream._arm else 0.0
            felt = [0.0, 0.0, self.sign * (self.force + offset), 0.0, 0.0, 0.0]
            message = read_robot(from_robot(1, degrees, felt, True))
            stream.hear(arm, message, self.now)
            # EgmSensor's planned has the number of EgmRobot's feedBack.
            answer = read_robot(stream.answer(arm, 1, self.now)).joints
            self._told[arm].append([math.radians(value) for value in answer])
        if stream.machine.state == "ready":
            stream.machine.start(stream.seen())
        wanted = self.part.force(stream._arm, s)
        self.record.append((self.now, s, self.force, wanted, q))

    def run(self, *states: str, middle: float = np.inf) -> str:
        """Until it is in one of the states, or beyond a coordinate; the state."""
        machine, begin = self.stream.machine, self.now
        while machine.state not in states and machine.clock.s <= middle:
            self.cycle()
            assert self.now - begin < LONGEST, machine.status()
        return machine.state


def test_the_job_is_done_and_presses() -> None:
    cell = Cell()
    cell.run("done")
    time, s, force, wanted = (np.array([row[k] for row in cell.record]) for k in range(4))
    job = cell.job
    held = (s > job.begin("carry")) & (s < job.begin("set_down"))
    assert np.abs(force[held] / wanted[held] - 1.0).max() < 0.05
    assert time[-1] - time[0] == pytest.approx(job.end, abs=0.2)
    # What the lag costs is made up for: the arms are where the clock is.
    for k in np.flatnonzero(held)[::100]:
        leader = cell.record[k][4][:6]
        speed = job.speed(0, float(s[k]))
        away = job.distance(0, leader.tolist(), float(s[k]))
        assert away < 2.0 * CYCLE * speed + 1e-5


FAULTS: dict[str, tuple[Callable[[Cell], None], str]] = {
    "silent": (lambda cell: cell.silent.__setitem__(0, True), "left| ms"),
    "stands": (lambda cell: cell.stands.__setitem__(1, True), " ms| mm"),
    "sensor": (lambda cell: setattr(cell, "offset", 45.0), " N "),
    "Ctrl-C": (lambda cell: setattr(cell.stream, "fault", "Ctrl-C"), "Ctrl-C"),
}


@pytest.mark.parametrize(
    ("name", "phase"),
    [
        pytest.param(name, phase, marks=() if phase == "carry" else pytest.mark.slow)
        for name in FAULTS
        for phase in PHASES
    ],
)
def test_faults_hold_both_arms(name: str, phase: str) -> None:
    fault, told = FAULTS[name]
    cell = Cell()
    planned = rack_job().phase(phase)
    cell.run(middle=planned.begin + 0.4 * planned.duration)
    fault(cell)
    machine = cell.stream.machine
    if cell.run("held", "done") == "done":
        # It shows only where arms move, or where pads have to press.
        assert name in ("stands", "sensor")
        assert phase in ("release", "retreat")
        return
    assert any(part in machine.reason for part in told.split("|"))
    for _ in range(100):
        cell.cycle()
    q = np.array([row[4] for row in cell.record[-20:]])
    assert np.ptp(q, axis=0).max() < 1e-4
    if name == "sensor" and phase not in HELD_PHASES:
        assert machine.clock.s < cell.job.pressed + 0.1, "nothing is lifted"
    if name in ("silent", "Ctrl-C"):
        assert cell.force == pytest.approx(cell.record[-1][3], rel=0.05, abs=1.0)
    if name == "Ctrl-C":
        cell.stream.command = "back"
        cell.run("done")
        assert cell.stream.machine.clock.s == 0.0


@pytest.mark.parametrize(
    "stiffness", [1e4, *(pytest.param(k, marks=pytest.mark.slow) for k in (3e4, 1e5)), 3e5]
)
def test_arms_as_stiff_as_measured_keep_their_force(stiffness: float) -> None:
    cell = Cell(stiffness, stiffness)
    assert cell.run("done", "held") == "done", cell.stream.machine.status()
    s, force, wanted = (np.array([row[k] for row in cell.record]) for k in (1, 2, 3))
    held = (s > cell.job.pressed) & (s < cell.job.begin("release"))
    ratio, most = force[held] / wanted[held], force.max() / wanted.max()
    print(
        f"{stiffness:g} N/m: {ratio.min():.3f} to {ratio.max():.3f} of the command while the box "
        f"is held, at most {most:.3f} of the largest one"
    )
    assert np.abs(ratio - 1.0).max() < cell.job.limits.force
    assert most < 1.5


@pytest.mark.parametrize(
    "real", [*(pytest.param(k, marks=pytest.mark.slow) for k in (3e4, 1e5)), 3e5]
)
def test_arms_stiffer_than_measured_do_not_press_beyond_bounds(real: float) -> None:
    cell = Cell(STIFFNESS, real)
    cell.run("done", "held")
    for _ in range(500):
        cell.cycle()
    force = np.array([row[2] for row in cell.record])
    assert force.max() < 1.5 * max(cell.job.robots[cell.stream._arm]["normal_force"])


LAGS = (0.028, 0.032)
"""With which the arms follow that are measured [s]; both are planned with 0.03."""


def measured(cell: Cell, folder: Path) -> tuple[list[Measured], str]:
    """What the bring-up of a cell finds, and what the program says against the job then."""
    (folder / "job.json").write_text(str(files_for(STIFFNESS)["job.json"]), "utf-8")
    looks, plan, refusal = Looks(), cell.config["plan"], ""
    cell.stream = Stream(cell.job, cell.config, looks, LOG)
    try:
        bring_up(folder, cell.job, plan, cell.drive, looks)
        assert require(folder, cell.job, plan)[0].stiffness > 0.0
    except Refused as error:
        refusal = str(error)
    return [looks.measured(cell.job, arm, plan["leads"][arm]) for arm in (0, 1)], refusal


@pytest.mark.parametrize(
    ("stiffness", "sign"),
    [
        (1e5, -1.0),
        pytest.param(1e4, 1.0, marks=pytest.mark.slow),
        pytest.param(3e4, 1.0, marks=pytest.mark.slow),
        pytest.param(3e5, -1.0, marks=pytest.mark.slow),
    ],
)
def test_bring_up_measures_what_the_arms_are(stiffness: float, sign: float, tmp_path: Path) -> None:
    """Arms of a known stiffness, lag, offset and sign; all were planned with 10 kN/m."""
    cell = Cell(STIFFNESS, stiffness)
    cell.sign, cell.offset = sign, 1.0
    cell.follow(LAGS)
    found, refusal = measured(cell, tmp_path)
    pressing_arm = found[cell.stream._arm]
    assert pressing_arm.stiffness == pytest.approx(stiffness, rel=0.05)
    assert pressing_arm.sign == sign
    assert pressing_arm.offset == pytest.approx(sign, abs=1e-6)
    for own, lag in zip(found, LAGS, strict=True):
        assert own.lag == pytest.approx(lag, abs=CYCLE)
        assert own.speed == pytest.approx(1.0, abs=0.03)
    assert max(row[2] for row in cell.record) < 1.5 * cell.job.force(0, cell.job.begin("lift"))
    assert (f" {STIFFNESS:.0f}" in refusal) == (stiffness != STIFFNESS)
    # An export with this file plans with what was measured.
    changes = driver_changes(tmp_path / FILE, rack_driven().workcell)
    for arm, own in enumerate(found):
        driver = changes[f"robots[{arm}].driver"]
        assert driver["stiffness"] == pytest.approx(pressing_arm.stiffness, rel=0.01)
        assert driver["lag"] == pytest.approx(own.lag, abs=1e-4)
        assert driver["address"] == "192.168.0.10"


def test_packets_of_others_and_broken_ones_are_dropped_and_counted() -> None:
    stream = Cell().stream
    host = json.loads(text_of("abb-egm", "config/egm.json"))["addresses"][0]
    sound = from_robot(1, [0.0] * 6, [0.0] * 6, True)
    assert stream.read(0, sound, host) is not None
    assert stream.read(0, sound, "192.168.0.99") is None
    for data in (b"\xff" * 8, b"\x0b", sound[:-3], b"\x12\x05\x0a\x03\x09\x01"):
        assert stream.read(0, data, host) is None
    assert stream.dropped == 5
    assert " 5 packets " in stream.status()


def test_ctrl_c_ends_the_wait_for_controllers() -> None:
    stream = Cell().stream
    assert stream.missing
    stream.interrupt()
    with pytest.raises(Refused, match=r"Ctrl-C"):
        stream.check()


def test_a_pause_of_the_computer_makes_no_arm_jump() -> None:
    cell = Cell()
    cell.run(middle=cell.job.begin("carry") + 2.0)
    cell.now += 0.05
    for _ in range(25):
        cell.cycle()
    q = np.array([row[4] for row in cell.record[-40:]])
    assert np.abs(np.diff(q, axis=0)).max() < 0.01
    assert cell.stream.machine.state == "running"


def test_both_tasks_start_egm() -> None:
    for name in EGM:
        text = text_of("abb-egm", name)
        for word in ("EGMSetupUC", "EGMActJoint", "EGMRunJoint", "EGM_STOP_HOLD", "EXIT;"):
            assert word in text
        assert " Stop;" not in text
