"""The unedited `run_job.py` over ROS 2's own client library, messages and FastDDS, with faults."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import numpy as np
import pytest

from symbolic.array import Array
from tests.hybrid_opt.extras.bundles.bundles import contents
from tests.hybrid_opt.extras.bundles.bundles import read_job as job
from tests.vendor.ros import SPEED, Live, Run, run
from tests.vendor.ros_environment import ENVIRONMENT, PYTHON

pytestmark = pytest.mark.vendor

SKEW = 0.010
"""Allowed between the starts of both arms [s]."""


@pytest.fixture(autouse=True, scope="module")
def _environment() -> None:
    assert PYTHON.exists(), (
        f"{ENVIRONMENT} has no ROS 2: run python -m tests.vendor.ros_environment first"
    )


def both(s: float) -> Array:
    """Both arms' planned positions at a coordinate."""
    return np.concatenate([job().position(arm, s) for arm in (0, 1)])


def end_of_motion(found: Run) -> float:
    """When the joints moved last [s]."""
    moved = np.abs(np.diff(found.q, axis=0)).max(axis=1) > 1e-6
    return float(found.time[np.flatnonzero(moved)[-1] + 1])


def held_at(found: Run) -> float:
    """Where along the path the program says that it holds the job [s]."""
    return float(found.log.rpartition("held in ")[2].partition(" s:")[0].rpartition(", ")[2])


@pytest.mark.parametrize("driver", ["simulation", "franka", "ur"])
def test_the_job_is_done(driver: str, tmp_path: Path) -> None:
    found = run(contents("torque", driver), tmp_path)
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
    found = run(contents("torque", driver), tmp_path, *fault)
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

    found = run(contents("torque", "franka"), tmp_path, name, middle(), 1, act=wait_until_held)
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
        live.back()

    found = run(contents("torque", "ur"), tmp_path, act=act)
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

    found = run(contents("torque", "franka"), tmp_path, act=act)
    assert found.code == 0, found.log
    np.testing.assert_allclose(found.q[-1], both(job().end), atol=1e-6)


def test_controllers_end_the_job_of_a_killed_program(tmp_path: Path) -> None:
    """As docs/reference/bundles.md says: nothing is dropped, and the box is set down."""

    def act(live: Live) -> None:
        live.wait_until(middle())
        live.program.kill()
        live.wait_until(job().end + 0.5)

    found = run(contents("torque", "ur"), tmp_path, act=act)
    assert found.code == -signal.SIGKILL
    np.testing.assert_allclose(found.q[-1], both(job().end), atol=1e-6)
