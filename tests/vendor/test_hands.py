"""Hands that hold by themselves, switched and heard by the unedited `run_job.py` over ROS 2.

A UR switches and hears them by SetIO and IOStates, a simulator by SetBool and Bool.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from symbolic.array import Array
from tests.hybrid_opt.extras.bundles.controlled import VALVE
from tests.hybrid_opt.extras.bundles.test_hands import height, read_job, torque
from tests.vendor.ros import Live, Run, run

pytestmark = pytest.mark.vendor

OFF = 1e-3
"""A box so far from where it stands is off it [m]."""


def lifted(found: Run) -> NDArray[np.bool_]:
    """(n,) whether the box is off both places where it stands, by the arms' postures."""
    robots, (_, off) = read_job().robots, height()
    known = np.concatenate([np.array(robot["position"]) for robot in robots], axis=1)
    nearest = [int(np.abs(known - row).max(axis=1).argmin()) for row in found.q]
    return np.asarray(off[nearest] > OFF)


def holding(found: Run) -> NDArray[np.bool_]:
    """(n,) whether the hands of both arms hold: their outputs have been on for a valve's time."""
    both = []
    for arm in (0, 1):
        times = found.switched[found.switched[:, 1] == arm]
        levels = np.concatenate([[0.0], times[:, 2]])
        both.append(levels[np.searchsorted(times[:, 0] + VALVE, found.time)] > 0.0)
    return np.logical_and(*both)


def levels(found: Run) -> list[list[bool]]:
    """What the outputs of each arm were switched to, one after the other."""
    return [[bool(on) for _, a, on in found.switched if a == arm] for arm in (0, 1)]


def places(s: float) -> Array:
    """Both arms' planned positions at a coordinate."""
    return np.concatenate([read_job().position(arm, s) for arm in (0, 1)])


@pytest.mark.parametrize("driver", ["simulation", "ur"])
def test_the_job_is_done(driver: str, tmp_path: Path) -> None:
    found = run(torque(driver), tmp_path)
    assert found.code == 0, found.log
    assert levels(found) == [[False, True, False]] * 2
    assert lifted(found).sum() > 50
    assert holding(found)[lifted(found)].all()
    np.testing.assert_allclose(found.q[-1], places(read_job().end), atol=1e-6)


def test_hands_that_lose_hold_stop_the_job_and_stay_on(tmp_path: Path) -> None:
    """Once they hold again, `back` sets the box down where it stood, and lets go there."""
    begin, end = (read_job().begin(name) for name in ("carry", "set_down"))

    def act(live: Live) -> None:
        live.wait_for("held in", after=0.5)
        live.heal()
        live.wait_for("held in", after=2.0)
        live.back()

    found = run(torque("ur"), tmp_path, "leaks", 0.5 * (begin + end), 0, act=act)
    assert found.code == 3, found.log
    assert re.search("hands .*left", found.log)
    assert levels(found) == [[False, True, False]] * 2
    assert holding(found)[lifted(found)].all()
    np.testing.assert_allclose(found.q[-1], places(0.0), atol=1e-4)
