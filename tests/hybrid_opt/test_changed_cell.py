"""Cells changed in memory: what is compiled stays, and they say what a file of them says."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
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
    "base": {"robots.left.base.xyz": [-0.15, 1.18, 0.2]},  # other pairs come within reach
    "far base": {"robots.left.base.xyz": [-0.3, 1.0, 0.3]},
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
    if "base" in name:
        assert new.geometry.active != cell.geometry.active
        assert new.geometry.possible == cell.geometry.possible
    carry, other = new.carry(new.initial), read.carry(read.initial)
    for part in ("time", "normal_force", "pressure_shift", "pose"):
        np.testing.assert_array_equal(getattr(carry, part), getattr(other, part), part)
    np.testing.assert_array_equal(carry.arms[0].q, other.arms[0].q)
    plain = cell.carry(cell.initial)
    told = [getattr(plain, part).tolist() for part in ("time", "normal_force", "pose")]
    if name not in ("grip", "base", "far base", "shelf"):
        assert told != [getattr(carry, part).tolist() for part in ("time", "normal_force", "pose")]


CHANGE = {"payload.mass": 8.0, "robots.left.base.xyz": [-0.15, 1.18, 0.2]}

PROGRAM = f"""
import hybrid_opt as ho

cell = ho.Cell.load({str(RACK)!r})
new = cell.changed({CHANGE})
print(new.carry(new.initial).normal_force.max(), new.evaluate(new.initial).feasible.all())
"""


@pytest.mark.process
def test_nor_does_a_machine_without_one(tmp_path: Path) -> None:
    ho.Cell.load(RACK).evaluate(ho.Cell.load(RACK).initial)  # what the structure needs is built
    without = {name: value for name, value in os.environ.items() if name != "CC"} | {"PATH": ""}
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, env=without, capture_output=True, text=True, check=True)
    cell = ho.Cell.load(RACK).changed(CHANGE)
    feasible = cell.evaluate(cell.initial).feasible.all()
    assert done.stdout == f"{cell.carry(cell.initial).normal_force.max()} {feasible}\n"
    empty = without | {"DUAL_ARM_CACHE": str(tmp_path / "empty")}
    done = subprocess.run(command, env=empty, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "no C compiler that works was found" in done.stderr.splitlines()[-1]


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
