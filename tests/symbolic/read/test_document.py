"""docs/workcell.md names every key and shows messages as they are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from symbolic.errors import WorkcellError
from symbolic.read.cell import load
from tests.symbolic.read.problem_cases import put
from tests.symbolic.read.samples import STUDIES, sample_data, write

DOCUMENT = (STUDIES.parent / "docs" / "workcell.md").read_text(encoding="utf-8")
SECTIONS = (
    "",
    "robots[0].",
    "robots[0].base.",
    "robots[0].tool[0].",
    "payload.",
    "contacts[0].",
    "task.",
    "task.waypoints[0].",
    "task.allowed_contacts[0].",
    "environment[0].",
    "environment[1].",
    "environment[2].",
    "collision.",
    "collision.ignored[0].",
)


def problems(path: Path) -> tuple[str, ...]:
    with pytest.raises(WorkcellError) as caught:
        load(path)
    return caught.value.problems


def test_every_key_is_documented(tmp_path: Path) -> None:
    data = sample_data()
    data["task"]["allowed_contacts"] = [{"body": "ground", "departure": 0.1}]
    data["collision"]["ignored"] = [{"first": "payload", "second": "ground", "reason": "r"}]
    (tmp_path / "m.stl").write_bytes(b"")
    data["environment"][1] = {"name": "a", "kind": "mesh", "path": "m.stl"}
    data["environment"][2] = {"name": "b", "kind": "cylinder", "radius": 1.0, "length": 1.0}
    for section in SECTIONS:
        put(data, f"{section}qqqqqqqq", 1)
    told = problems(write(tmp_path, data))
    assert len(told) == len(SECTIONS)
    keys = {key for text in told for key in text.split("allowed keys are ")[1].split(", ")}
    assert len(keys) > 50
    for key in keys:
        assert re.search(rf"\b{key}\b", DOCUMENT), key


def test_the_messages_shown_are_real(tmp_path: Path) -> None:
    data = sample_data()
    put(data, "payload.size[0]", 300)
    put(data, "task.reference_force", 12)
    told = problems(write(tmp_path, data))
    assert len(told) == 2
    for text in told:
        assert f"  - {text}\n" in DOCUMENT
