"""What pads anywhere press with beyond the plan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_opt.job.motions import unit_squeeze
from hybrid_opt.robust.squeeze import pressed_together
from symbolic.read.cell import load
from symbolic.records.poses import box_rotation
from tests.symbolic.cells import RACK


@pytest.mark.parametrize("name", ["drum", "fork", "corner"])
def test_more_squeeze_balances_itself_within_all_cones(name: str) -> None:
    """Of pads that press evenly, at any pose."""
    found = load(RACK.with_name(f"{name}.toml"))
    cell = replace(found, task=replace(found.task, allocation="soft-finger"))
    pose = np.array([[0.1, -0.2, 0.3, 0.2, -0.1, 0.4]])
    turned = box_rotation(cell.task.orientation, pose)[0]
    for leader in (0, 1):
        wrenches = unit_squeeze(cell, pose, leader)[0]
        total = wrenches.sum(axis=0)
        for contact, wrench in zip(cell.contacts, wrenches, strict=True):
            total[3:] += np.cross(turned @ contact.T_box_pad[:3, 3], wrench[:3])
        np.testing.assert_allclose(total, 0.0, atol=1e-9)
        together = pressed_together(cell, leader)
        assert together[1 - leader] == 1.0
        for contact, wrench, share in zip(cell.contacts, wrenches, together, strict=True):
            pushed = (turned @ contact.T_box_pad[:3, :3]).T @ wrench[:3]
            assert pushed[2] == pytest.approx(share, rel=1e-9)
            assert np.linalg.norm(pushed[:2]) <= contact.friction * pushed[2]
