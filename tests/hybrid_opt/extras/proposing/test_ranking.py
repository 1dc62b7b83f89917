"""Classes of carries are compared by the fastest carry of each."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hybrid_opt.display.table import NOTHING
from hybrid_opt.extras.proposing import ranking
from symbolic.errors import SettingsError

SECONDS = {"over post": 2.0, "left of post": 1.5, "right of post": None}


def proposal(side: str) -> Any:
    """As much of a proposal as is compared; its file says which it is."""
    return SimpleNamespace(
        sides=(side,),
        passes=side,
        length=4.0,
        found=SimpleNamespace(branches=(1, 0)),
        text=lambda folder: side,
    )


def test_the_fastest_class_comes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(path: Path) -> str:
        return path.read_text(encoding="utf-8")

    def fastest(side: str, evaluations: int, rng: np.random.Generator) -> Any:
        assert evaluations == 300
        seconds = SECONDS[side]
        if seconds is None:
            raise SettingsError("no carry that holds")
        return SimpleNamespace(duration=seconds, peak_normal_force=np.array([[30.0, 31.25]]))

    monkeypatch.setattr(ranking, "Cell", SimpleNamespace(load=load))
    monkeypatch.setattr(ranking, "fastest_carry", fastest)
    given = [proposal(side) for side in ("right of post", "over post", "left of post")]
    told: list[str] = []
    found, table = ranking.rank_homotopy_classes(given, 300, np.random.default_rng(1), told.append)
    assert told == [f"study of carry {k} of 3" for k in (1, 2, 3)]
    assert [one.sides[0] for one in found] == ["left of post", "over post", "right of post"]
    assert table.rows[0] == ("left of post", "1 and 0", "4.00", "1.50", "31.2")
    assert table.rows[2][3:] == (NOTHING, NOTHING)
