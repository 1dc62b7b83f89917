"""Turned paths: driven, turned far, about one axis each."""

from __future__ import annotations

import numpy as np

from hybrid_opt.polishing.drivable.tilts import LEAST_TURN, SHARES, turned
from symbolic.records import POSE_SIZE
from tests.hybrid_opt.polishing.drivable.cells import drivable_rack, polisher, start

FORCE = 55.0


def test_each_is_driven_and_turned_about_one_axis_by_one_share() -> None:
    task, judge, path = drivable_rack().task, polisher().drivable.judge, start(FORCE)[:-1]
    found = turned(task, judge, path, FORCE)
    assert np.isfinite(judge.durations(np.array(found), FORCE)).all()
    columns, senses = task.free_entries[1], set()
    for other in found:
        changed = np.flatnonzero(other != path)
        (axis,) = set(columns[changed].tolist())
        assert 3 <= axis < POSE_SIZE
        assert len(changed) == np.count_nonzero(columns == axis)
        up = bool(other[changed[0]] > path[changed[0]])
        bound = (task.upper if up else task.lower)[changed]
        shares = (other - path)[changed] / (bound - path[changed])
        np.testing.assert_allclose(shares, shares[0])
        assert np.isclose(shares[0], SHARES).any()
        assert np.abs(bound - path[changed]).mean() >= LEAST_TURN
        senses.add((axis, up))
    assert len(senses) == len(found) >= 2


def test_a_path_that_nothing_can_drive_has_no_turned_ones() -> None:
    judge = polisher().drivable.judge
    assert turned(drivable_rack().task, judge, start(FORCE)[:-1], 1.0) == []
