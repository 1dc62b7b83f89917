"""Values of keys changed in a workcell file's text."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
import pytest

from symbolic.errors import WorkcellError
from symbolic.read.cell import changed, load
from symbolic.read.changes import changed_text
from tests.symbolic.cells import RACK, rack_cell

TEXT = b"""
name = "a \\"cell\\""
[task]
samples = 100
goal = [0.0, 1e-3, 2]
[[contacts]]
friction = 1.0
[[contacts]]
friction = 2.0
further = [{ xyz = [0, 0, 1], normal = [0.0, 1.0, 0.0] }]
[[environment]]
name = "top board"
xyz = [1.0, 2.0, 3.0]
[[environment]]
name = "v1.5"
kind = "box"
"""


def read(changes: dict[str, Any]) -> dict[str, Any]:
    return tomllib.loads(changed_text(TEXT, changes, "cell.toml").decode())


def test_nothing_changed_reads_the_same() -> None:
    assert read({}) == tomllib.loads(TEXT.decode())


def test_the_rack_reads_the_same() -> None:
    content = RACK.read_bytes()
    again = changed_text(content, {}, "rack.toml")
    assert tomllib.loads(again.decode()) == tomllib.loads(content.decode())


def test_paths_lead_by_index_by_name_or_to_all() -> None:
    assert read({"task.samples": 50})["task"]["samples"] == 50
    assert [c["friction"] for c in read({"contacts.friction": 0.5})["contacts"]] == [0.5, 0.5]
    assert [c["friction"] for c in read({"contacts[1].friction": 0.5})["contacts"]] == [1.0, 0.5]
    found = read({"environment.top board.xyz": np.array([0.0, 0.0, 1.0])})["environment"]
    assert found[0]["xyz"] == [0.0, 0.0, 1.0]
    assert "xyz" not in found[1]
    assert read({"environment.v1.5.kind": "sphere"})["environment"][1]["kind"] == "sphere"
    assert read({"uncertainty.friction": 0.1})["uncertainty"] == {"friction": 0.1}
    assert read({"contacts[1].further[0].xyz": [1, 2, 3]})["contacts"][1]["further"][0]["xyz"] == [
        1, 2, 3,
    ]  # fmt: skip


@pytest.mark.parametrize(
    "path", ["", "contacts[2].friction", "task.samples.more", "name.of", "contacts[0]", ".x"]
)
def test_a_path_that_leads_nowhere_is_told(path: str) -> None:
    with pytest.raises(WorkcellError, match="leads nowhere"):
        changed_text(TEXT, {path: 1.0}, "cell.toml")


def test_a_changed_cell_is_checked_like_a_file() -> None:
    with pytest.raises(WorkcellError, match=r"payload\.mass: found -1; allowed is"):
        changed(rack_cell(), {"payload.mass": -1.0})
    with pytest.raises(WorkcellError, match=r"payload\.mas: unknown key"):
        changed(rack_cell(), {"payload.mas": 1.0})
    with pytest.raises(WorkcellError, match="outside the box"):
        changed(rack_cell(), {"contacts[0].xyz": [0.0, 0.3, 0.0]})


def test_changes_add_up_and_do_not_touch_the_cell(tmp_path: Any) -> None:
    cell = rack_cell()
    lighter = changed(cell, {"payload.mass": 5.0})
    both = changed(lighter, {"contacts.friction": 0.8})
    assert cell.payload.mass == 10.0
    assert (both.payload.mass, both.contacts[1].friction) == (5.0, 0.8)
    assert len({cell.digest, lighter.digest, both.digest}) == 3
    # Solid boxes of another mass have another inertia.
    assert lighter.payload.inertia[0, 0] == pytest.approx(0.5 * cell.payload.inertia[0, 0])
    file = RACK.with_name("never written.toml")
    assert load(file.with_name(RACK.name), text=both.text).digest == both.digest
