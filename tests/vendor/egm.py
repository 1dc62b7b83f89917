"""Runs of the unedited `run_egm.py` over UDP, in messages of ABB's own egm.proto.

abb-robot-client brings egm.proto compiled by protoc. Two controllers follow late and press a
spring; everything runs in real time. Of the bundle, only the ports are changed, so that several
runs have room side by side.
"""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from hybrid_opt.extras.bundles.job_file import Contents
from hybrid_opt.extras.bundles.programs.carry_job import Job
from hybrid_opt.store.bundle_file import write_bundle
from symbolic.array import Array
from tests.hybrid_opt.extras.bundles.bundles import DRIVER, as_planned
from tests.hybrid_opt.extras.bundles.test_abb import CYCLE, STIFFNESS, gap

LONGEST = 60.0
"""A program that is not done by then waits for ever [s]."""

LAG = 0.028
"""With which both arms follow [s]."""

SIGN = -1.0
"""Of what the sensors read when the pads press."""

BUSY = 0.1
"""Share of the cycles after which a computer that is late becomes busy."""

LOCAL = replace(DRIVER, address="127.0.0.1", lag=LAG, stiffness=STIFFNESS)
"""Both controllers, on this machine."""


def free_ports() -> list[int]:
    """Ports of UDP that nobody uses."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in (0, 1)]
    for each in sockets:
        each.bind(("", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


class Controllers:
    """Both arms' controllers at the other end of a program.

    Attributes:
        program: that streams both arms.
        pressing: the arm whose sensor the program presses by.
        silent, stands: arms without messages, and arms that do not follow.
        offset: of the sensor [N].
        deaf: nothing is measured.
        is_empty: nothing stands between the pads.
        stopped: EGM has ended in both controllers.
        late: longest time for which the program's computer is busy with something else [s].
        record: per cycle time since the job began [s], force [N] and both arms' joints [rad].
    """

    def __init__(
        self,
        files: Contents,
        folder: Path,
        stiffness: float = STIFFNESS,
        before: Sequence[str] = (),
        arguments: Sequence[str] = (),
    ) -> None:
        """Start the program of a bundle in a folder, at ports that are free.

        Args:
            files: of the bundle.
            folder: to write it to.
            before: command that starts the program's interpreter.
            arguments: of the program.
        """
        from abb_robot_client._egm_protobuf import egm_pb2

        self._egm, self.stiffness = egm_pb2, stiffness
        config = json.loads(files["config/egm.json"]) | {"ports": free_ports()}
        write_bundle(folder, as_planned({**files, "config/egm.json": json.dumps(config)}, SIGN), {})
        self.job = Job(json.loads(files["job.json"]))
        self._targets = [("127.0.0.1", port) for port in config["ports"]]
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in self._targets]
        for each in self._sockets:
            each.setblocking(False)
        self._q = [np.array(self.job.position(arm, 0.0)) for arm in (0, 1)]
        self._told = [deque([(0.0, q)]) for q in self._q]
        self.pressing = config["press"]["arm"]
        self._number, self._began = 0, 0.0
        self.silent, self.stands, self.offset = [False, False], [False, False], 0.0
        self.deaf, self.stopped, self.late, self.is_empty = False, False, 0.0, False
        self._rng, self._busy = random.Random(0), 0.0
        self.record: list[tuple[float, float, Array]] = []
        with suppress(PermissionError):
            # Controllers are other computers: what loads this one does not load them.
            os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(10))
        self.log = (folder / "log").open("w+", encoding="utf-8")
        self.program = subprocess.Popen(
            [*before, sys.executable, folder / "run_egm.py", *arguments],
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
        force = 0.0 if self.is_empty else max(0.0, -self.stiffness / 2.0 * gap(self.q))
        moved = max(
            float(np.abs(q - self.job.position(arm, 0.0)).max()) for arm, q in enumerate(self._q)
        )
        if not self._began and moved > 1e-6:
            self._began = now
        self.record.append((now - self._began if self._began else 0.0, force, self.q))
        self._number += 1
        self._load(now)
        for arm, (own, target) in enumerate(zip(self._sockets, self._targets, strict=True)):
            last = self._receive(own)
            if last is not None:
                self._told[arm].append((now, last))
            if not self.silent[arm]:
                own.sendto(self._message(arm, force), target)

    def _load(self, now: float) -> None:
        """Let the program's computer be busy with something else at random."""
        if self._busy and now >= self._busy:
            self.program.send_signal(signal.SIGCONT)
            self._busy = 0.0
        elif not self._busy and self.late and self._rng.random() < BUSY:
            self.program.send_signal(signal.SIGSTOP)
            self._busy = now + self._rng.uniform(0.0, self.late)

    def _message(self, arm: int, force: float) -> bytes:
        message = self._egm.EgmRobot()
        message.header.seqno, message.header.mtype = self._number, 2
        message.feedBack.joints.joints.extend(np.rad2deg(self._q[arm]).tolist())
        state = self._egm.EgmMCIState
        message.mciState.state = state.MCI_STOPPED if self.stopped else state.MCI_RUNNING
        felt = force + (self.offset if arm == self.pressing else 0.0)
        if not self.deaf:
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

    def go_on(self, seconds: float) -> None:
        """Let time pass, whatever the program does [s]."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.cycle()
            time.sleep(CYCLE)

    def turn(self, arm: int, angle: float) -> None:
        """Let the first joint of an arm be elsewhere by an angle [rad]."""
        self._q[arm] = self._q[arm] + angle * np.eye(len(self._q[arm]))[0]
        self._told[arm] = deque([(0.0, self._q[arm])])

    def heal(self) -> None:
        """End every fault."""
        self.silent, self.stands, self.offset = [False, False], [False, False], 0.0
        self.deaf = self.stopped = False

    def command(self, word: str) -> None:
        """Type something."""
        assert self.program.stdin is not None
        self.program.stdin.write(f"{word}\n")
        self.program.stdin.flush()
