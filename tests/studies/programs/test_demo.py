"""The demonstration's first result: figures of the rack, and a front that beats the hand."""

from __future__ import annotations

import re

import pytest

from hybrid_opt.polishing import settings
from studies.demo import first_result

pytestmark = pytest.mark.heavy


def test_the_first_result_says_what_is_slow_and_what_was_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(settings, "QUICK_DRIVABLE_ATTEMPTS", 3)
    by_hand, front = first_result(evaluations=100)
    assert re.search(r" (\w+ \w+, )*joint acceleration", by_hand)
    rows = [line.split() for line in front.splitlines() if re.match(r"\d+\.\d ", line)]
    assert len(rows) > 2
    times = [(float(row[1]), float(row[2])) for row in rows if row[1] != "-"]
    assert all(found < hand for hand, found in times[:2])
    forces = [float(row[0]) for row in rows]
    assert forces == sorted(forces, reverse=True)
