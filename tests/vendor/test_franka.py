"""The torque bundle of two Frankas carries a box in a scene of others, through libfranka."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from tests.vendor.franka import Outcome

pytestmark = pytest.mark.vendor

NEAR = 0.010
"""Allowed distance of the box from its goal [m]."""

TRACKED = 0.20
"""Allowed error of the forces in the carry, over the commanded ones."""


@cache
def carried(share: float) -> Outcome:
    # franky-sim and pylibfranka are there where these tests are asked for.
    from tests.vendor.franka import bundle, carry

    return carry(*bundle(), share)


def test_the_job_is_done_and_pressed_as_commanded() -> None:
    found = carried(1.0)
    assert found.code == 0, found.log
    inside = found.carried
    ratio = found.force[inside] / found.commanded[inside]
    missed = np.linalg.norm(found.box[-1, :3] - found.goal)
    print(
        f"box {1e3 * missed:.1f} mm off its goal; forces {found.force[inside].min():.1f} to "
        f"{found.force[inside].max():.1f} N, {ratio.min():.2f} to {ratio.max():.2f} of the "
        f"command; peak {found.force.max():.1f} N"
    )
    assert missed < NEAR
    assert np.abs(ratio - 1.0).max() < TRACKED


def test_with_half_the_force_the_box_falls() -> None:
    """Sensors that feel twice the force let the program go on: the scene shows what it is worth."""
    found = carried(0.5)
    assert found.code != 0
    assert np.linalg.norm(found.box[-1, :3] - found.goal) > 10.0 * NEAR
