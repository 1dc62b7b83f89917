"""Cells changed in memory: what is compiled stays, and they say what a file of them says."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybrid_opt as ho
from codegen.compiler import Compiler
from symbolic.errors import WorkcellError
from tests.symbolic.cells import RACK

CHANGES: dict[str, dict[str, Any]] = {
    "payload": {"payload.mass": 8.0, "payload.centre_of_mass": [0.0, 0.01, 0.0]},
    "friction": {"contacts.friction": 0.9},
    "grip": {"contacts[0].xyz": [0.0, 0.2, 0.05], "contacts[1].xyz": [0.0, -0.2, 0.05]},
    "base": {"robots.left.base.xyz": [-0.15, 1.155, 0.2]},
    "goal": {"task.goal": [0.0, 0.0, 1.15, 0.0, 0.0, 0.0]},
    "shelf": {"environment.top board.xyz": [0.0, 0.0, 0.985]},
    "limits": {"robots.acceleration_max": 4.0, "task.reference_speed": 0.3},
}


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is compiled fails."""
    cell = ho.Cell.load(RACK)
    cell.carry(cell.initial)  # what the structure needs is built

    def refused(*_: Any, **__: Any) -> None:
        raise AssertionError("a compiler was asked for")

    monkeypatch.setattr(Compiler, "compile", refused)


@pytest.mark.parametrize("name", list(CHANGES))
@pytest.mark.usefixtures("no_compiler")
def test_a_changed_number_needs_no_compiler_and_is_what_its_file_says(
    name: str, tmp_path: Path
) -> None:
    cell = ho.Cell.load(RACK)
    new = cell.changed(CHANGES[name])
    text = new.workcell.text
    assert text is not None
    shutil.copytree(RACK.parents[1] / "robots", tmp_path / "robots")
    (tmp_path / "workcells").mkdir()
    file = tmp_path / "workcells" / RACK.name
    file.write_bytes(text)
    read = ho.Cell.load(file)
    assert read.workcell.digest == new.workcell.digest
    x = np.clip(
        cell.initial + 0.05 * np.random.default_rng(1).standard_normal((6, cell.n_var)),
        cell.lower,
        cell.upper,
    )
    ours, theirs = new.evaluate(x), read.evaluate(x)
    for part in ("penalised", "feasible", "reason", "position", "violation"):
        np.testing.assert_array_equal(getattr(ours, part), getattr(theirs, part), part)
    carry, other = new.carry(new.initial), read.carry(read.initial)
    for part in ("time", "normal_force", "pressure_shift", "pose"):
        np.testing.assert_array_equal(getattr(carry, part), getattr(other, part), part)
    np.testing.assert_array_equal(carry.arms[0].q, other.arms[0].q)
    plain = cell.carry(cell.initial)
    told = [getattr(plain, part).tolist() for part in ("time", "normal_force", "pose")]
    if name not in ("grip", "base", "shelf"):
        assert told != [getattr(carry, part).tolist() for part in ("time", "normal_force", "pose")]


def test_a_changed_drivable_cell_needs_no_compiler_either(monkeypatch: pytest.MonkeyPatch) -> None:
    cell = ho.Cell.load(RACK).drivable()
    held = cell.carry(cell.initial)

    def refused(*_: Any, **__: Any) -> None:
        raise AssertionError("a compiler was asked for")

    monkeypatch.setattr(Compiler, "compile", refused)
    new = cell.changed({"payload.mass": 8.0, "payload.acceleration_max": 4.0})
    carry = new.carry(new.initial)
    assert carry.peak_normal_force.max() < held.peak_normal_force.max()
    assert carry.duration > 0.0


def test_changing_back_gives_the_same_bits() -> None:
    cell = ho.Cell.load(RACK)
    there = cell.changed({"payload.mass": 3.0})
    back = there.changed({"payload.mass": 10.0})
    np.testing.assert_array_equal(
        cell.carry(cell.initial).normal_force, back.carry(back.initial).normal_force
    )
    assert there.carry(there.initial).peak_normal_force.max() < 0.5 * (
        cell.carry(cell.initial).peak_normal_force.max()
    )


def test_a_wrong_change_is_told() -> None:
    with pytest.raises(WorkcellError, match="allowed is"):
        ho.Cell.load(RACK).changed({"contacts.friction": -0.1})
