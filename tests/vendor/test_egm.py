"""The unedited `run_egm.py` over UDP, in messages of ABB's own egm.proto, with faults.

abb-robot-client brings egm.proto compiled by protoc. Two controllers follow late and press a
spring; everything runs in real time.
"""

from __future__ import annotations

import json
import math
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_opt.extras.bundles import BundleOptions
from hybrid_opt.extras.bundles.bundle import prepared
from hybrid_opt.extras.bundles.egm import egm_files
from hybrid_opt.extras.bundles.job_file import Contents
from hybrid_opt.extras.bundles.programs.carry_machine import SLOW
from hybrid_opt.store.bundle_file import write_bundle
from symbolic.array import Array
from tests.hybrid_opt.extras.bundles.bundles import DRIVER, as_planned, driven
from tests.hybrid_opt.extras.bundles.bundles import read_job as job
from tests.hybrid_opt.extras.bundles.test_abb import CYCLE, STIFFNESS, gap
from tests.hybrid_opt.job.jobs import rack_job

pytestmark = pytest.mark.vendor

LONGEST = 60.0
"""A program that is not done by then waits for ever [s]."""

LAG = 0.028
"""With which both arms follow [s]."""

SIGN = -1.0
"""Of what the sensors read when the pads press."""

TRACKED = 0.10
"""Allowed error of the forces in the carry, over the commanded ones."""


@cache
def bundle() -> Contents:
    here = replace(DRIVER, address="127.0.0.1", lag=LAG, stiffness=STIFFNESS)
    return egm_files(prepared(driven(rack_job(), here), "abb-egm", BundleOptions()))


class Controllers:
    """Both arms' controllers at the other end of a program.

    Attributes:
        program: that streams both arms.
        record: per cycle time since the job began [s], force [N] and both arms' joints [rad].
    """

    def __init__(self, folder: Path) -> None:
        """Start the program of a bundle in a folder."""
        from abb_robot_client._egm_protobuf import egm_pb2

        self._egm = egm_pb2
        files = bundle()
        write_bundle(folder, as_planned(files, SIGN), {})
        config = json.loads(files["config/egm.json"])
        self._targets = [("127.0.0.1", port) for port in config["ports"]]
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in self._targets]
        for each in self._sockets:
            each.setblocking(False)
        self._q = [np.array(job().position(arm, 0.0)) for arm in (0, 1)]
        self._told = [deque([(0.0, q)]) for q in self._q]
        self._pressing = config["press"]["arm"]
        self._number, self._began = 0, 0.0
        self.silent, self.stands, self.offset = [False, False], [False, False], 0.0
        self.record: list[tuple[float, float, Array]] = []
        self.log = (folder / "log").open("w+", encoding="utf-8")
        self.program = subprocess.Popen(
            [sys.executable, folder / "run_egm.py"],
            stdin=subprocess.PIPE,
            stderr=self.log,
            text=True,
        )

    def said(self) -> str:
        """What the program has said."""
        self.log.flush()
        return Path(self.log.name).read_text("utf-8")

    @property
    def q(self) -> Array:
        return np.concatenate(self._q)

    def cycle(self) -> None:
        """One cycle of both controllers."""
        now = time.monotonic()
        for arm in (0, 1):
            told = self._told[arm]
            while len(told) > 1 and told[1][0] <= now - LAG:
                told.popleft()
            if not self.stands[arm]:
                self._q[arm] = told[0][1]
        force = max(0.0, -STIFFNESS / 2.0 * gap(self.q))
        moved = max(
            float(np.abs(q - job().position(arm, 0.0)).max()) for arm, q in enumerate(self._q)
        )
        if not self._began and moved > 1e-6:
            self._began = now
        self.record.append((now - self._began if self._began else 0.0, force, self.q))
        self._number += 1
        for arm, (own, target) in enumerate(zip(self._sockets, self._targets, strict=True)):
            last = self._receive(own)
            if last is not None:
                self._told[arm].append((now, last))
            if not self.silent[arm]:
                own.sendto(self._message(arm, force), target)

    def _message(self, arm: int, force: float) -> bytes:
        message = self._egm.EgmRobot()
        message.header.seqno, message.header.mtype = self._number, 2
        message.feedBack.joints.joints.extend(np.rad2deg(self._q[arm]).tolist())
        message.mciState.state = self._egm.EgmMCIState.MCI_RUNNING
        felt = force + (self.offset if arm == self._pressing else 0.0)
        message.measuredForce.fcActive = True
        message.measuredForce.force.extend([0.0, 0.0, SIGN * felt, 0.0, 0.0, 0.0])
        return bytes(message.SerializeToString())

    def _receive(self, own: socket.socket) -> Array | None:
        found = None
        while True:
            try:
                data = own.recv(4096)
            except (BlockingIOError, ConnectionRefusedError):
                return found
            message = self._egm.EgmSensor.FromString(data)
            assert message.header.mtype == self._egm.EgmHeader.MSGTYPE_CORRECTION
            found = np.deg2rad(message.planned.joints.joints)

    def run(self, until: Callable[[], object], longest: float = LONGEST) -> None:
        """Let cycles pass until something is so, or the program ends."""
        begin = due = time.monotonic()
        while self.program.poll() is None and not until():
            assert time.monotonic() - begin < longest, self.said()
            self.cycle()
            due += CYCLE
            time.sleep(max(0.0, due - time.monotonic()))

    def at(self, s: float) -> Callable[[], bool]:
        """Whether the job is at a coordinate [s]."""
        return lambda: self._began > 0.0 and time.monotonic() - self._began > s

    def command(self, word: str) -> None:
        """Type something."""
        assert self.program.stdin is not None
        self.program.stdin.write(f"{word}\n")
        self.program.stdin.flush()


@pytest.fixture
def controllers(tmp_path: Path) -> Any:
    made = Controllers(tmp_path)
    yield made
    made.program.kill()
    made.program.wait()


def middle() -> float:
    """A coordinate in the carry [s]."""
    return job().begin("carry") + 0.4 * (job().begin("set_down") - job().begin("carry"))


def test_the_job_is_done_and_presses(controllers: Controllers) -> None:
    controllers.run(lambda: False)
    assert controllers.program.returncode == 0, controllers.said()
    leader = 1 - controllers._pressing
    part = slice(0, 6) if leader == 0 else slice(6, None)
    ratio = []
    for since, force, q in controllers.record[::5]:
        # Where the leading arm is: late by its lag, and by what it takes to see it move. A slow
        # one says too little of it.
        s = job().coordinate(leader, q[part].tolist(), since, (-0.2, 0.2))
        in_carry = job().begin("carry") < s < job().begin("set_down")
        if in_carry and job().speed(leader, s) > SLOW * job().fastest:
            ratio.append(force / job().force(controllers._pressing, s))
    print(f"force over command {min(ratio):.3f} to {max(ratio):.3f}")
    assert np.abs(np.array(ratio) - 1.0).max() < TRACKED
    last = np.concatenate([job().position(arm, job().end) for arm in (0, 1)])
    np.testing.assert_allclose(controllers.q, last, atol=1e-3)


FAULTS: dict[str, tuple[Callable[[Controllers], object], str]] = {
    "link lost": (lambda c: c.silent.__setitem__(0, True), "no news from left|apart"),
    "one arm stops": (lambda c: c.stands.__setitem__(1, True), "behind|left its path|apart"),
    "sensor": (lambda c: setattr(c, "offset", 45.0), "instead of"),
    "Ctrl-C": (lambda c: c.program.send_signal(signal.SIGINT), "Ctrl-C"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_hold_both_arms(name: str, controllers: Controllers) -> None:
    fault, told = FAULTS[name]
    controllers.run(controllers.at(middle()))
    fault(controllers)
    controllers.run(lambda: "held in" in controllers.said())
    assert any(text in controllers.said() for text in told.split("|")), controllers.said()
    until = time.monotonic() + 0.5
    controllers.run(lambda: time.monotonic() > until)
    q = np.array([row[2] for row in controllers.record[-50:]])
    assert np.ptp(q, axis=0).max() < 1e-3
    largest = max(job().robots[controllers._pressing]["normal_force"])
    assert 0.3 * largest < controllers.record[-1][1] < 1.5 * largest
    controllers.command("back" if name == "Ctrl-C" else "leave")
    controllers.run(lambda: False)
    assert controllers.program.returncode == (3 if name == "Ctrl-C" else 1), controllers.said()


@pytest.mark.parametrize("pause", [0.05, 0.2])
def test_a_pause_of_the_program_drops_nothing(pause: float, controllers: Controllers) -> None:
    """Neither the pause nor what follows makes an arm jump; a long one may stop the job."""
    controllers.run(controllers.at(middle()))
    controllers.program.send_signal(signal.SIGSTOP)
    until = time.monotonic() + pause
    controllers.run(lambda: time.monotonic() > until)
    controllers.program.send_signal(signal.SIGCONT)
    controllers.run(lambda: "held in" in controllers.said())
    if controllers.program.returncode is None:
        controllers.command("continue")
        controllers.run(lambda: False)
    assert controllers.program.returncode == 0, controllers.said()
    q = np.array([row[2] for row in controllers.record])
    assert np.abs(np.diff(q, axis=0)).max() < 0.05


def test_arms_of_a_killed_program_stand_and_press(controllers: Controllers) -> None:
    controllers.run(controllers.at(middle()))
    controllers.program.kill()
    for _ in range(250):
        controllers.cycle()
        time.sleep(CYCLE)
    q = np.array([row[2] for row in controllers.record[-50:]])
    assert np.ptp(q, axis=0).max() < 1e-6
    assert controllers.record[-1][1] > 0.5 * max(
        job().robots[controllers._pressing]["normal_force"]
    )


def test_a_sensor_that_is_off_starts_nothing(controllers: Controllers) -> None:
    controllers.offset = 10.0
    controllers.run(lambda: False)
    assert controllers.program.returncode == 2
    assert "zero its sensor" in controllers.said()
    assert math.isclose(float(np.ptp([row[2] for row in controllers.record], axis=0).max()), 0.0)
