"""The stream for ABB's EGM against controllers that follow late, and a box that pushes back."""

from __future__ import annotations

import importlib.util
import json
import math
import struct
import sys
from collections import deque
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from hybrid_opt.bundles.programs.carry_job import Job
from hybrid_opt.bundles.programs.egm_wire import FromRobot, read_robot, to_robot
from symbolic.array import Array
from symbolic.robot.model import build_robot_model
from tests.hybrid_opt.bundles.bundles import contents, exported, text_of

CYCLE = 0.004
"""Of EGM [s]."""

STIFFNESS = 1e4
"""Of each arm at its pad [N/m]."""


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
def models() -> list[tuple[Any, Any, int]]:
    found = [build_robot_model(robot) for robot in exported("abb-egm").workcell.robots]
    return [(each.model, each.model.createData(), each.flange_id) for each in found]


def gap(q: Array) -> float:
    """The distance between the pads along the first one's normal less the box between them [m]."""
    cell, places = exported("abb-egm").workcell, []
    for arm, (model, data, flange) in enumerate(models()):
        pin.framesForwardKinematics(model, data, q[6 * arm : 6 * arm + 6])
        robot = cell.robots[arm]
        places.append(robot.T_world_base @ data.oMf[flange].homogeneous @ robot.T_flange_pad)
    one, other = (contact.T_box_pad for contact in cell.contacts)
    normal = places[0][:3, 2]
    planned = one[:3, 2] @ (other[:3, 3] - one[:3, 3])
    return float(normal @ (places[1][:3, 3] - places[0][:3, 3]) - planned)


@cache
def program() -> Any:
    """run_egm.py as the bundle has it."""
    folder = Path(__file__).parent
    modules = {}
    for name in ("carry_job", "egm_wire", "run_egm"):
        spec = importlib.util.spec_from_loader(name, None)
        assert spec is not None
        modules[name] = importlib.util.module_from_spec(spec)
        modules[name].__file__ = str(folder / f"{name}.py")
        sys.modules[name] = modules[name]
        exec(compile(text_of("abb-egm", f"{name}.py"), name, "exec"), vars(modules[name]))
    return modules["run_egm"]


class Cell:
    """Two controllers that follow late, and a box between two springs.

    Attributes:
        force: of the pads on the box [N].
        record: per cycle time, coordinate of the stream, force, its reference, both arms' joints.
    """

    def __init__(self) -> None:
        self.job = Job(json.loads(text_of("abb-egm", "job.json")))
        config = json.loads(text_of("abb-egm", "config/egm.json"))
        self.stream = program().Stream(self.job, config)
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
            felt = [0.0, 0.0, -(self.force + self.offset), 0.0, 0.0, 0.0]
            message = read_robot(from_robot(1, degrees, felt, True))
            stream.hear(arm, message, self.now)
            answer = read_answer(stream.answer(arm, 1, self.now))
            self._told[arm].append([math.radians(value) for value in answer])
        stream.tick(self.now)
        if stream.machine.state == "ready":
            stream.machine.start(stream.seen(self.now))
        wanted = self.job.force(stream._arm, s)
        self.record.append((self.now, s, self.force, wanted, q))

    def run(self, until: Callable[[Cell], bool], most: float = 40.0) -> None:
        begin = self.now
        while not until(self):
            self.cycle()
            assert self.now - begin < most, self.stream.machine.told()


def read_answer(data: bytes) -> tuple[float, ...]:
    """The joints that a controller is told: EgmSensor's planned has the number of feedBack."""
    return read_robot(data).joints


def test_the_job_is_done_and_presses() -> None:
    cell = Cell()
    cell.run(lambda cell: cell.stream.machine.state == "done")
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


@pytest.mark.parametrize("name", FAULTS)
def test_faults_hold_both_arms(name: str) -> None:
    fault, told = FAULTS[name]
    cell = Cell()
    middle = cell.job.begin("carry") + 2.0
    cell.run(lambda cell: cell.stream.machine.clock.s > middle)
    fault(cell)
    cell.run(lambda cell: cell.stream.machine.state == "held")
    assert any(part in cell.stream.machine.reason for part in told.split("|"))
    for _ in range(100):
        cell.cycle()
    q = np.array([row[4] for row in cell.record[-20:]])
    assert np.ptp(q, axis=0).max() < 1e-4
    if name in ("silent", "Ctrl-C"):
        assert cell.force == pytest.approx(cell.record[-1][3], rel=0.05)
    if name == "Ctrl-C":
        cell.stream.command = "back"
        cell.run(lambda cell: cell.stream.machine.state == "done")
        assert cell.stream.machine.clock.s == 0.0


def test_a_pause_of_the_computer_makes_no_arm_jump() -> None:
    cell = Cell()
    middle = cell.job.begin("carry") + 2.0
    cell.run(lambda cell: cell.stream.machine.clock.s > middle)
    cell.now += 0.05
    for _ in range(25):
        cell.cycle()
    q = np.array([row[4] for row in cell.record[-40:]])
    assert np.abs(np.diff(q, axis=0)).max() < 0.01
    assert cell.stream.machine.state == "running"


def test_both_tasks_start_egm() -> None:
    for name in ("T_ROB1/CarryEgm1.mod", "T_ROB2/CarryEgm2.mod"):
        text = text_of("abb-egm", name)
        for word in ("EGMSetupUC", "EGMActJoint", "EGMRunJoint", "EGM_STOP_HOLD", "EXIT;"):
            assert word in text
        assert " Stop;" not in text
    assert {"run_egm.py", "egm_wire.py", "carry_job.py", "job.json"} <= set(contents("abb-egm"))
