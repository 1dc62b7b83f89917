"""What timing says of a trajectory survives being stored."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.errors import ResultsError
from hybrid_opt.store.files import to_json, write_json
from hybrid_opt.timing.analysis import (
    TimedTrajectory,
    read_timing,
    timed_trajectory,
    timing_document,
)
from hybrid_opt.timing.jerk import time_with_jerk
from hybrid_opt.timing.records import JerkLimits, TimingLimits
from tests.hybrid_opt.timing.cells import hand_timing, initial

TOLD: list[tuple[int, int]] = []
"""Timings done and in all, as `timed` told them."""


@cache
def timed() -> TimedTrajectory:
    # The limit cannot be kept: that timing has no carry.
    return timed_trajectory(
        hand_timing(),
        initial(),
        force_limit=1.0,
        curve_points=3,
        progress=lambda done, total: TOLD.append((done, total)),
    )


def test_every_timing_is_told_and_stored(tmp_path: Path) -> None:
    timed()
    # Three for every carry, one within the force limit, the margins, three of the curve.
    assert [(k, 8) for k in range(1, 9)] == TOLD
    path = tmp_path / "timing.json"
    document = to_json(timing_document(timed()))
    write_json(path, document)
    assert to_json(read_timing(path)) == document


def test_figures_are_those_of_the_timings() -> None:
    document = timing_document(timed())
    fastest, carry = document.timings["fastest"], timed().timings["fastest"].driven
    assert fastest.duration == carry.time[-1] - carry.time[0]
    assert fastest.peak_normal_force is not None
    np.testing.assert_array_equal(fastest.peak_normal_force, carry.normal_force.max(axis=0))
    limited = document.timings["force limited"]
    assert limited.status == "infeasible at rest"
    assert limited.peak_normal_force is None
    assert to_json(limited)["duration"] is None
    assert document.force_curve is not None
    assert len(document.force_curve.force) == 3
    assert document.margins == timed().margins


def test_what_limits_on_jerk_cost_is_stored(tmp_path: Path) -> None:
    limits = JerkLimits(np.full(12, 40.0), 30.0)
    found = time_with_jerk(hand_timing(), initial(), TimingLimits(), limits)
    named = timed().timings | {"within jerk limits": found.timing}
    jerky = replace(timed(), timings=named, jerk=found)
    path = tmp_path / "timing.json"
    write_json(path, to_json(timing_document(jerky)))
    stored = read_timing(path)
    assert stored.jerk is not None
    assert (stored.jerk.duration, stored.jerk.without) == (found.timing.duration, found.without)
    assert (stored.jerk.joint_use, stored.jerk.payload_use) == found.jerk_use
    assert stored.timings["within jerk limits"].duration == stored.jerk.duration
    assert timing_document(timed()).jerk is None


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"timings": {"fastest": {}}}, "damaged at timings.fastest.status"),
        ({"timings": {"fastest": {"status": "fine"}}}, "'fine'"),
        ({"margins": None}, "damaged at margins"),
        ({"nominal_duration": "long"}, "damaged at nominal_duration"),
    ],
)
def test_damage_is_told_with_its_place(
    tmp_path: Path, change: dict[str, object], told: str
) -> None:
    path = tmp_path / "timing.json"
    path.write_text(json.dumps(to_json(timing_document(timed())) | change), encoding="utf-8")
    with pytest.raises(ResultsError, match=told):
        read_timing(path)
