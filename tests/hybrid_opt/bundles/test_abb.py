"""The RAPID modules, read by a parser that knows nothing of what writes them."""

from __future__ import annotations

import json
import math
import re
import struct
from collections import Counter, deque
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

from hybrid_opt.bundles import TARGETS, BundleOptions
from hybrid_opt.bundles.arms import ABB, UR, require_arms
from hybrid_opt.bundles.bundle import prepared
from hybrid_opt.bundles.languages import rapid_files, require_rapid
from hybrid_opt.bundles.programs.run_egm import FromRobot, Stream, read_robot, to_robot
from hybrid_opt.job.records import HELD, PHASES
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.robot.model import build_robot_model
from tests.hybrid_opt.bundles.bundles import driven, exported, rack_driven, read_job, text_of
from tests.hybrid_opt.bundles.mock_rapid import Controller, Module, parse
from tests.hybrid_opt.job.jobs import rack, rack_job
from tests.symbolic.cells import GOFA

EGM = ("T_ROB1/CarryEgm1.mod", "T_ROB2/CarryEgm2.mod")
NAMES = ("T_ROB1/Carry1.mod", "T_ROB2/Carry2.mod")


def modules() -> list[Module]:
    return [parse(text_of("abb-rapid", name).encode("ascii").decode("ascii")) for name in NAMES]


def test_others_read_the_modules() -> None:
    """rapidchecker, which refuses broken ones."""
    texts = [
        shortened(text_of(target, name).replace("\r\n", "\n"))
        for target, names in (("abb-rapid", NAMES), ("abb-egm", EGM))
        for name in names
    ]
    for text in texts:
        assert not problems(text), problems(text)
    for part, other in (("ENDPROC", ""), (":=", "="), (";", ""), ("[", "")):
        assert problems(texts[-1].replace(part, other, 1))


def shortened(text: str) -> str:
    """Two moves of each kind, because rapidchecker takes a minute for hundreds."""
    lines, seen = [], Counter[str]()
    for line in text.splitlines():
        name = line.split(maxsplit=1)[0] if line.strip() else ""
        seen[name] += name.startswith(("MoveAbsJ", "FCPressL"))
        if seen[name] <= 2:
            lines.append(line)
    return "\n".join(lines) + "\n"


def problems(text: str) -> list[str]:
    """What rapidchecker says against a module, its indentation aside."""
    try:
        found = check_format(text)
    except Exception as error:
        return [str(error)]
    return [str(each) for each in found if "indent" not in str(each).lower()]


def test_tool_and_load_are_declared() -> None:
    cell = rack().workcell
    for module in modules():
        _, kind, (held, place, load) = module.declared["carryPad"]
        assert (kind, held) == ("tooldata", True)
        assert place == [[0.0, 0.0, 190.0], [1.0, 0.0, 0.0, 0.0]]
        assert len(load) == 6
        _, kind, box = module.declared["carryHalfBox"]
        assert (kind, box[0]) == ("loaddata", cell.payload.mass / 2.0)
        # The box's centre lies half its width behind the pad and 55 mm below.
        np.testing.assert_allclose(np.abs(box[1]), [55.0, 0.0, 200.0])


def test_the_make_of_every_arm_counts(tmp_path: Path) -> None:
    """It is in the robot's name where nothing else tells it, as of a xacro file that was expanded
    to be stored."""
    path = tmp_path / "arm.urdf"
    text = GOFA.read_text("utf-8")
    path.write_text(re.sub(r'<robot name="[^"]*"', '<robot name="ur10e"', text, count=1), "utf-8")
    cell = rack().workcell
    ur = tuple(replace(robot, urdf=path) for robot in cell.robots)
    refused = r"(gofa12|arm)\.urdf, which does not look like an arm of (ABB|UR e-series)"
    for robots, sound in ((cell.robots, ABB), (ur, UR), ((ur[0], cell.robots[1]), "")):
        for maker in (ABB, UR):
            with nullcontext() if maker == sound else pytest.raises(SettingsError, match=refused):
                there = replace(cell, robots=(robots[0], robots[1]))
                require_arms(there, "a target", maker, (6,), any_arm=False)


def test_names_cannot_leave_a_comment() -> None:
    job = rack_job()
    robot, other = job.workcell.robots
    robots = (replace(robot, name="räbot \n"), other)
    evil = replace(job.workcell, name="x\r\n  EXIT;\n", robots=robots)
    sheet = prepared(
        driven(replace(job, workcell=evil)), TARGETS["abb-rapid"], BundleOptions(step=0.1)
    )
    text = rapid_files(sheet)[NAMES[0]]
    assert isinstance(text, str)
    assert "x" not in parse(text.encode("ascii").decode("ascii")).procedures
    assert text.count("EXIT;") == text_of("abb-rapid", NAMES[0]).count("EXIT;") + 1
    assert "! x??  EXIT;?" in text


def test_steps_that_no_controller_plans_are_refused() -> None:
    with pytest.raises(SettingsError, match="RAPID"):
        rapid_files(prepared(rack_driven(), TARGETS["abb-rapid"], BundleOptions(step=0.004)))


def test_a_box_that_turns_is_refused() -> None:
    """The force keeps its direction in the room."""
    carry = rack_job().phase("carry")
    pose = carry.motion.pose.copy()
    pose[:, 5] += np.linspace(0.0, 0.5, len(pose))
    turned = replace(carry, motion=replace(carry.motion, pose=pose))
    phases = tuple(turned if p.name == "carry" else p for p in rack_job().phases)
    with pytest.raises(SettingsError, match="the box turns by 29 degrees"):
        require_rapid(replace(rack_driven(), phases=phases))


def controller(sign: float = 1.0, away: float = 0.0, acts: int = 1) -> Controller:
    """Both tasks; `sign` as someone wrote it down, `acts` as the robot takes it."""
    sheet = exported("abb-rapid")
    q = sheet.sampled.q[0].copy()
    q[0] += away
    found = Controller(sheet.workcell, [text_of("abb-rapid", name) for name in NAMES], q, acts)
    found.tasks[1].set("carrySign", sign)
    return found


def test_both_tasks_carry_out_the_job() -> None:
    """Both robots are where the job has them, the leader by its own clock, the other by speeds; the
    pad presses no less than the job asks for."""
    found, sheet = controller().run(), exported("abb-rapid")
    assert [task.log for task in found.tasks] == [["done"], ["done"]]
    job = sheet.sampled
    time, q, force = (np.array(column) for column in zip(*found.record, strict=True))
    np.testing.assert_allclose(q[-1], job.q[-1], atol=2e-5)
    carry = job.span(3)
    middle = int(np.abs(q - job.q[carry.start + 20]).max(axis=1).argmin())
    for k in range(carry.start + 5, carry.stop - 5):
        at = middle + round((job.time[k] - job.time[carry.start + 20]) / CYCLE)
        # In step to three cycles, although nothing but the phase's beginning is common.
        near = 3.0 * CYCLE * np.abs(job.q_rate[k]) + 1e-4
        assert (np.abs(q[at] - job.q[k]) <= near).all(), k
        assert force[at] >= job.normal_force[k - 1 : k + 2, 1].min() - 1.0
    assert force[-1] == 0.0
    assert time[-1] == pytest.approx(job.time[-1], abs=1.0)


def test_a_sign_that_nobody_found_out_moves_nothing() -> None:
    for sign, acts, told in ((0.0, 1, "carrySign first"), (1.0, -1, "PosSupvDist")):
        found = controller(sign, acts=acts).run()
        assert any(told in line for line in found.tasks[1].log)
        assert any("did not come" in line for line in found.tasks[0].log), "and the other gives up"
        q = np.array([row[1] for row in found.record])
        job = exported("abb-rapid").sampled
        most = np.abs(job.q[: job.span(1).stop] - job.q[0]).max()
        assert np.abs(q - q[0]).max() <= (most + 1e-6 if sign else 0.0), "nothing is lifted"
    found = controller(away=0.05).run()
    assert any("jog the robot" in line for line in found.tasks[0].log)
    assert np.ptp(np.array([row[1] for row in found.record]), axis=0).max() == 0.0


@pytest.mark.parametrize("gone", [0, 1])
@pytest.mark.parametrize("phase", PHASES)
def test_a_task_that_does_not_come_is_not_waited_for(phase: str, gone: int) -> None:
    """It ends in a phase: the other ends before the next, keeps its place and its force."""
    whole = sound()
    begin = whole.begins[f"Carry_{phase}"]

    def end(cell: Controller) -> None:
        cell.tasks[gone].runs = False

    found = controller().run({begin + 0.2: end})
    left = found.tasks[1 - gone]
    assert any("did not come" in line for line in left.log), left.log
    pressed = found.record[-1][2]
    if phase in ("lift", "carry", "set_down"):
        assert pressed > 90.0
    q = np.array([row[1] for row in found.record[-1000:]])
    assert np.ptp(q, axis=0).max() < 1e-9


@cache
def sound() -> Controller:
    return controller().run()


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
    with pytest.raises(ValueError, match="no message of EGM"):
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


class Cell:
    """Two controllers that follow late, and a box between two springs.

    Attributes:
        force: of the pads on the box [N].
        record: per cycle time, coordinate of the stream, force, its reference, both arms' joints.
    """

    def __init__(self) -> None:
        self.job = read_job()
        config = json.loads(text_of("abb-egm", "config/egm.json"))
        self.stream = Stream(self.job, config)
        self.now, self.force = 50.0, 0.0
        self.offset, self.silent = 0.0, [False, False]
        self.stands = [False, False]
        self.record: list[tuple[float, float, float, float, Array]] = []
        late = round(config["lags"][0] / CYCLE)
        first = [self.job.position(arm, 0.0) for arm in (0, 1)]
        self._told = [deque([q] * (late + 1), maxlen=late + 1) for q in first]
        self._q = [list(q) for q in first]

    def cycle(self) -> None:
        """One cycle of both controllers."""
        self.now += CYCLE
        stream = self.stream
        for arm in (0, 1):
            if not self.stands[arm]:
                self._q[arm] = list(self._told[arm][0])
        q = np.concatenate(self._q)
        along = gap(q)
        s = stream.machine.clock.s
        touches = self.job.begin("press") < s < self.job.begin("retreat")
        self.force = max(0.0, -STIFFNESS / 2.0 * along) if touches else 0.0
        for arm in (0, 1):
            if self.silent[arm]:
                continue
            degrees = [math.degrees(value) for value in self._q[arm]]
            # Of the pressing arm's sensor: what it feels is made right, and the other's is wrong.
            offset = self.offset if arm == stream._arm else 0.0
            felt = [0.0, 0.0, -(self.force + offset), 0.0, 0.0, 0.0]
            message = read_robot(from_robot(1, degrees, felt, True))
            stream.hear(arm, message, self.now)
            # EgmSensor's planned has the number of EgmRobot's feedBack.
            answer = read_robot(stream.answer(arm, 1, self.now)).joints
            self._told[arm].append([math.radians(value) for value in answer])
        stream.tick(self.now)
        if stream.machine.state == "ready":
            stream.machine.start(stream.seen(self.now))
        wanted = self.job.force(stream._arm, s)
        self.record.append((self.now, s, self.force, wanted, q))

    def run(self, *states: str, middle: float = np.inf) -> str:
        """Until it is in one of the states, or beyond a coordinate; the state."""
        machine, begin = self.stream.machine, self.now
        while machine.state not in states and machine.clock.s <= middle:
            self.cycle()
            assert self.now - begin < LONGEST, machine.told()
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
    "silent": (lambda cell: cell.silent.__setitem__(0, True), "no news from left|apart"),
    "stands": (lambda cell: cell.stands.__setitem__(1, True), "behind|left its path|apart"),
    "sensor": (lambda cell: setattr(cell, "offset", 45.0), "instead of"),
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
    if name == "sensor" and phase not in HELD:
        assert machine.clock.s < cell.job.pressed + 0.1, "nothing is lifted"
    if name in ("silent", "Ctrl-C"):
        assert cell.force == pytest.approx(cell.record[-1][3], rel=0.05, abs=1.0)
    if name == "Ctrl-C":
        cell.stream.command = "back"
        cell.run("done")
        assert cell.stream.machine.clock.s == 0.0


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
