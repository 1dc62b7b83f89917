"""The unedited `run_job.py` over ROS 2's own client library, messages and FastDDS, with faults.

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
import pytest

from hybrid_opt.store.bundle_file import write_bundle
from symbolic.array import Array
from tests.hybrid_opt.extras.bundles.bundles import as_planned, contents
from tests.hybrid_opt.extras.bundles.bundles import read_job as job
from tests.vendor.ros_environment import ENVIRONMENT, PYTHON

pytestmark = pytest.mark.vendor

ROOT = Path(__file__).resolve().parents[2]

LONGEST = 300.0
"""A program that is not done by then waits for ever [s]."""

SPEED = 0.3
"""Of the cell's time (`ros_cell.py`) over this machine's."""

SKEW = 0.010
"""Allowed between the starts of both arms [s]."""


@pytest.fixture(autouse=True, scope="module")
def _environment() -> None:
    assert PYTHON.exists(), (
        f"{ENVIRONMENT} has no ROS 2: run python -m tests.vendor.ros_environment first"
    )


@dataclass(frozen=True, eq=False)
class Run:
    """A run that is over.

    Attributes:
        code: exit code of the program.
        log: what it said.
        time: (n,) of the controllers [s].
        q, effort: (n, joints) of both arms.
        starts: of all accepted goals [s].
    """

    code: int
    log: str
    time: Array
    q: Array
    effort: Array
    starts: Array


class Live:
    """A program and the cell that it drives, both running."""

    def __init__(self, folder: Path, variables: dict[str, str], program: Any) -> None:
        self.folder, self.program, self._variables = folder, program, variables

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
            time.sleep(0.1)
        return int(self.program.returncode)

    def wait_for(self, text: str, after: float = 0.0) -> None:
        """Wait until the program has said something, and some time longer [s]."""
        begin = time.monotonic()
        while text not in self.said():
            assert time.monotonic() - begin < LONGEST, self.said()
            time.sleep(0.01)
        time.sleep(after)

    def wait_until(self, s: float) -> None:
        """Wait until the controllers are at a coordinate of the job [s]."""
        clock, begin = self.folder / "clock", time.monotonic()
        while not clock.exists() or float(clock.read_text("utf-8")) < s:
            assert time.monotonic() - begin < LONGEST, self.said()
            time.sleep(0.01)

    def command(self, word: str) -> None:
        """Say something on `/carry/command`, as `ros2 topic pub --once` does."""
        say = (
            "import rclpy, time; from std_msgs.msg import String; rclpy.init(); "
            "n = rclpy.create_node('say'); p = n.create_publisher(String, '/carry/command', 10)\n"
            "while not p.get_subscription_count(): time.sleep(0.01)\n"
            f"p.publish(String(data={word!r})); time.sleep(0.5)"
        )
        subprocess.run([PYTHON, "-c", say], env=self._variables, check=True, timeout=LONGEST)


@contextmanager
def cell(folder: Path, variables: dict[str, str], fault: tuple[Any, ...]) -> Iterator[None]:
    """Both arms' drivers."""
    call = [str(PYTHON), "-m", "tests.vendor.ros_cell", str(folder), *map(str, fault)]
    played = subprocess.Popen(call, cwd=ROOT, env=variables, stdout=subprocess.PIPE, text=True)
    assert played.stdout is not None
    assert played.stdout.readline() == "ready\n"
    try:
        yield
    finally:
        played.terminate()
        assert played.wait(LONGEST) == 0


def run(
    driver: str,
    folder: Path,
    *fault: Any,
    act: Callable[[Live], object] = lambda live: None,
) -> Run:
    """Run a bundle's program against its drivers.

    Args:
        fault: name, time and arm, as of `ros_cell.py`.
        act: is called while both run.
    """
    files = dict(contents("torque", driver))
    config = json.loads(files["config/cell.json"]) | {"simulated": True}
    files |= {"config/cell.json": json.dumps(config)}
    write_bundle(folder, as_planned(files), {})
    variables = os.environ | {
        "ROS_DOMAIN_ID": str(os.getpid() % 100 + 1),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(folder / "ros"),
        "PYTHONUNBUFFERED": "1",
    }
    log = folder / "log"
    with cell(folder, variables, fault), log.open("wb") as out:
        program = subprocess.Popen(
            [PYTHON, folder / "run_job.py"], env=variables, stdout=out, stderr=subprocess.STDOUT
        )
        try:
            live = Live(folder, variables, program)
            act(live)
            code = live.leave()
        finally:
            program.kill()
            program.wait()
    found = np.load(folder / "cell.npz")
    columns = (found[name] for name in ("time", "q", "effort", "starts"))
    return Run(code, log.read_text("utf-8"), *columns)


def both(s: float) -> Array:
    """Both arms' planned positions at a coordinate."""
    return np.concatenate([job().position(arm, s) for arm in (0, 1)])


def end_of_motion(found: Run) -> float:
    """When the joints moved last [s]."""
    moved = np.abs(np.diff(found.q, axis=0)).max(axis=1) > 1e-6
    return float(found.time[np.flatnonzero(moved)[-1] + 1])


def assert_presses(found: Run, s: float) -> None:
    """The controllers hold a coordinate with its squeeze."""
    for arm, part in ((0, slice(0, 6)), (1, slice(6, 12))):
        held = job().effort(arm, "without_gravity", s, 0.0)
        np.testing.assert_allclose(found.effort[-1, part], held, atol=2.0)
        assert job().distance(arm, found.q[-1, part].tolist(), s) < 1e-3


def held_at(found: Run) -> float:
    """Where along the path the program says that it holds the job [s]."""
    return float(found.log.rpartition("held in ")[2].partition(" s:")[0].rpartition(", ")[2])


@pytest.mark.parametrize("driver", ["simulation", "franka", "ur"])
def test_the_job_is_done(driver: str, tmp_path: Path) -> None:
    found = run(driver, tmp_path)
    assert found.code == 0, found.log
    np.testing.assert_allclose(found.q[-1], both(job().end), atol=1e-6)
    assert np.ptp(found.starts) < SKEW
    assert end_of_motion(found) - found.starts[0] == pytest.approx(job().end, abs=0.1)


REFUSED = {
    "mm from its place": ("franka", "elsewhere", -1.0, 0),
    "does not take its goal": ("franka", "rejects", -1.0, 1),
    "zero its sensor": ("ur", "offset", -1.0, 0),
    "no force is measured at the pad of": ("franka", "deaf", -1.0, 0),
    "no news from": ("ur", "silent", -1.0, 1),
}
"""What the program says by driver and fault from the beginning."""


@pytest.mark.parametrize("told", REFUSED)
def test_nothing_moves_that_should_not(told: str, tmp_path: Path) -> None:
    driver, *fault = REFUSED[told]
    found = run(driver, tmp_path, *fault)
    assert found.code == 2, found.log
    assert told in found.log
    # A goal that the other controller has taken is replaced before it begins.
    assert np.ptp(found.q, axis=0).max() < 0.01


def middle() -> float:
    """A coordinate in the carry [s]."""
    return job().begin("carry") + 0.4 * (job().begin("set_down") - job().begin("carry"))


FAULTS = {
    "stands": "left its path|behind|apart",
    "silent": "no news from",
    "deaf": "no force is measured at the pad of",
    "aborts": "Aborted due to hardware",
}
"""What the program says after a fault in the carry."""


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_stops_both_arms(name: str, tmp_path: Path) -> None:
    """The arm without the fault stops at the place that the program names, and presses."""

    def wait_until_held(live: Live) -> None:
        live.wait_for("held in", after=1.0)

    found = run("franka", tmp_path, name, middle(), 1, act=wait_until_held)
    assert found.code == 1, found.log
    assert any(text in found.log for text in FAULTS[name].split("|")), found.log
    stopped = end_of_motion(found) - found.starts[0]
    seen = 0.1 + 0.1 + job().limits.silence
    assert stopped < middle() + seen + job().limits.stop_time
    s, part = held_at(found), slice(0, 6)
    assert job().distance(0, found.q[-1, part].tolist(), s) < 1e-3
    held = job().effort(0, "without_gravity", s, 0.0)
    np.testing.assert_allclose(found.effort[-1, part], held, atol=2.0)


def test_ctrl_c_holds_and_back_brings_the_box_home(tmp_path: Path) -> None:
    def act(live: Live) -> None:
        live.wait_until(middle())
        live.program.send_signal(signal.SIGINT)
        live.wait_for("held in", after=0.5)
        live.command("back")
        live.program.wait(LONGEST)

    found = run("ur", tmp_path, act=act)
    assert found.code == 3, found.log
    np.testing.assert_allclose(found.q[-1], both(0.0), atol=1e-4)
    assert np.abs(np.diff(found.q, axis=0)).max() < 0.05, "no arm jumps"


@pytest.mark.parametrize("pause", [0.05, 0.2])
def test_a_pause_of_the_program_stops_nothing(pause: float, tmp_path: Path) -> None:
    def act(live: Live) -> None:
        live.wait_until(middle())
        live.program.send_signal(signal.SIGSTOP)
        time.sleep(pause / SPEED)
        live.program.send_signal(signal.SIGCONT)

    found = run("franka", tmp_path, act=act)
    assert found.code == 0, found.log
    np.testing.assert_allclose(found.q[-1], both(job().end), atol=1e-6)


def test_controllers_end_the_job_of_a_killed_program(tmp_path: Path) -> None:
    """As docs/reference/bundles.md says: nothing is dropped, and the box is set down."""

    def act(live: Live) -> None:
        live.wait_until(middle())
        live.program.kill()
        live.wait_until(job().end + 0.5)

    found = run("ur", tmp_path, act=act)
    assert found.code == -signal.SIGKILL
    np.testing.assert_allclose(found.q[-1], both(job().end), atol=1e-6)
