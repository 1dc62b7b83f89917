"""A study that was struck in every stage equals one left in peace, times apart."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.kills import STAGES, STRIKES, Tally, differences, struck, undisturbed


@pytest.mark.slow
def test_a_study_struck_in_every_stage_is_the_same(tmp_path: Path) -> None:
    for name in ("peace", "struck"):
        (tmp_path / name).mkdir()
    expected, took = undisturbed(tmp_path / "peace", report=True)
    tally = Tally()
    found = struck(tmp_path / "struck", STRIKES, took, 7, tally)
    assert differences(expected, found) == []
    assert tally.hits >= len(STAGES)
    assert sum(tally.ways.values()) == sum(tally.stages.values()) == tally.hits
