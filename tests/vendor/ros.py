"""Runs of the unedited `run_job.py` over ROS 2's own client library, messages and FastDDS.

`python -m tests.vendor.ros_environment` makes the environment that it needs. The cell brings its
own time, as a simulator does: of the bundle, only `simulated` in `config/cell.json` is changed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.extras.bundles.job_file import Contents
from hybrid_opt.store.bundle_file import write_bundle
from symbolic.array import Array
from tests.hybrid_opt.extras.bundles.bundles import as_planned
from tests.vendor.ros_environment import PYTHON

ROOT = Path(__file__).resolve().parents[2]

LONGEST = 900.0
"""A program that is not done by then waits for ever [s]."""

SPEED = 0.3
"""Of the cell's time over this machine's: of a loaded machine, too, programs keep up with it."""


@dataclass(frozen=True, eq=False)
class Run:
    """A run that is over.

    Attributes:
        code: exit code of the program.
        log: what it said.
        time: (n,) of the controllers [s].
        q, effort: (n, joints) of both arms.
        starts: when each controller began with its first goal [s].
        switched: (m, 3) when the outputs of hands were switched [s], of which arm, and whether on.
    """

    code: int
    log: str
    time: Array
    q: Array
    effort: Array
    starts: Array
    switched: Array


class Live:
    """A program and the cell that it drives, both running."""

    def __init__(self, folder: Path, played: Any, program: Any) -> None:
        self.folder, self.played, self.program = folder, played, program

    def said(self) -> str:
        """What the program has said."""
        return (self.folder / "log").read_text("utf-8")

    def leave(self) -> int:
        """Wait for the program's end, and leave a job that is held; returns the exit code."""
        begin, is_left = time.monotonic(), False
        while self.program.poll() is None:
            assert time.monotonic() - begin < LONGEST, self.said()
            if not is_left and "held in" in self.said():
                self.program.send_signal(signal.SIGINT)
                is_left = True
            time.sleep(0.2)
        return int(self.program.returncode)

    def wait_for(self, text: str, after: float = 0.0) -> None:
        """Wait until the program has said something, and some time longer [s]."""
        begin = time.monotonic()
        while text not in self.said():
            assert time.monotonic() - begin < LONGEST, self.said()
            time.sleep(0.05)
        time.sleep(after)

    def wait_until(self, s: float) -> None:
        """Wait until the controllers are at a coordinate of the job [s]."""
        clock, begin = self.folder / "clock", time.monotonic()
        while not clock.exists() or float(clock.read_text("utf-8")) < s:
            assert time.monotonic() - begin < LONGEST, self.said()
            time.sleep(0.05)

    def heal(self) -> None:
        """End every fault of the cell, as people do at the robots."""
        self.played.send_signal(signal.SIGUSR1)

    def back(self) -> None:
        """Let the cell say 'back', and wait until the program ends or holds the job again."""
        before, begin = self.said().count("held in"), time.monotonic()
        self.played.send_signal(signal.SIGUSR2)
        while self.program.poll() is None and self.said().count("held in") == before:
            assert time.monotonic() - begin < LONGEST, self.said()
            time.sleep(0.05)


@contextmanager
def _cell(folder: Path, variables: dict[str, str], fault: tuple[Any, ...]) -> Iterator[Any]:
    """Play both arms' drivers."""
    call = [str(PYTHON), "-m", "tests.vendor.ros_cell", str(folder), str(SPEED), *map(str, fault)]
    played = subprocess.Popen(call, cwd=ROOT, env=variables, stdout=subprocess.PIPE, text=True)
    assert played.stdout is not None
    assert played.stdout.readline() == "ready\n"
    try:
        yield played
    finally:
        played.terminate()
        assert played.wait(LONGEST) == 0


def run(
    files: Contents,
    folder: Path,
    *fault: Any,
    act: Callable[[Live], object] = lambda live: None,
) -> Run:
    """Run a bundle's program against its drivers.

    Args:
        files: of the bundle.
        folder: to write it to.
        fault: name, time and arm, as of `ros_cell.py`.
        act: is called while both run.
    """
    config = json.loads(files["config/cell.json"]) | {"simulated": True}
    files = {**files, "config/cell.json": json.dumps(config)}
    write_bundle(folder, as_planned(files), {})
    variables = os.environ | {
        "ROS_DOMAIN_ID": str(os.getpid() % 100 + 1),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(folder / "ros"),
        "PYTHONUNBUFFERED": "1",
    }
    log = folder / "log"
    with _cell(folder, variables, fault) as played, log.open("wb") as out:
        program = subprocess.Popen(
            [PYTHON, folder / "run_job.py"], env=variables, stdout=out, stderr=subprocess.STDOUT
        )
        try:
            live = Live(folder, played, program)
            act(live)
            code = live.leave()
        finally:
            program.kill()
            program.wait()
    found = np.load(folder / "cell.npz")
    columns = (found[name] for name in ("time", "q", "effort", "starts", "switched"))
    return Run(code, log.read_text("utf-8"), *columns)
