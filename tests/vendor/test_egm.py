"""The unedited `run_egm.py` over UDP, in messages of ABB's own egm.proto, with faults."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_opt.extras.bundles.programs.carry_machine import SLOW
from tests.hybrid_opt.extras.bundles.bundles import read_job as job
from tests.hybrid_opt.extras.bundles.test_abb import CYCLE
from tests.vendor.egm import LOCAL, Controllers
from tests.vendor.short import egm

pytestmark = pytest.mark.vendor

TRACKED = 0.10
"""Allowed error of the forces in the carry, over the commanded ones."""


@pytest.fixture
def controllers(tmp_path: Path) -> Any:
    made = Controllers(egm(LOCAL, False).files, tmp_path)
    yield made
    made.program.kill()
    made.program.wait()


def middle() -> float:
    """A coordinate in the carry [s]."""
    return job().begin("carry") + 0.4 * (job().begin("set_down") - job().begin("carry"))


def test_the_job_is_done_and_presses(controllers: Controllers) -> None:
    controllers.run(lambda: False)
    assert controllers.program.returncode == 0, controllers.said()
    leader = 1 - controllers.pressing
    part = slice(0, 6) if leader == 0 else slice(6, None)
    ratio = []
    for since, force, q in controllers.record[::5]:
        # Where the leading arm is: late by its lag, and by what it takes to see it move. A slow
        # one says too little of it.
        s = job().coordinate(leader, q[part].tolist(), since, (-0.2, 0.2))
        in_carry = job().begin("carry") < s < job().begin("set_down")
        if in_carry and job().speed(leader, s) > SLOW * job().fastest:
            ratio.append(force / job().force(controllers.pressing, s))
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
    largest = max(job().robots[controllers.pressing]["normal_force"])
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
    assert controllers.record[-1][1] > 0.5 * max(job().robots[controllers.pressing]["normal_force"])


def test_a_sensor_that_is_off_starts_nothing(controllers: Controllers) -> None:
    controllers.offset = 10.0
    controllers.run(lambda: False)
    assert controllers.program.returncode == 2
    assert "sensor" in controllers.said()
    assert math.isclose(float(np.ptp([row[2] for row in controllers.record], axis=0).max()), 0.0)
