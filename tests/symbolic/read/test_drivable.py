"""The drivable variant of a cell: one key changed, everything else the same."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from symbolic.errors import BundleError
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell, drivable_files, unpack_cell
from tests.studies.conftest import TRANSFER
from tests.symbolic.read.samples import RACK


@pytest.mark.parametrize("path", [RACK, TRANSFER])
def test_only_the_time_law_differs(path: Path, tmp_path: Path) -> None:
    cell = load(path)
    original = collect_cell(cell)
    drivable = unpack_cell(drivable_files(original), tmp_path)
    assert drivable.task.time_law == "optimal"
    assert drivable.task.n_var == cell.task.n_var + 1
    assert drivable.digest != cell.digest
    first, second = (
        tomllib.loads(stored.files[stored.workcell].decode())
        for stored in (original, drivable_files(original))
    )
    assert second["task"].pop("time_law") == "optimal"
    first["task"].pop("time_law")
    assert first == second
    np.testing.assert_array_equal(drivable.task.lower[:-1], cell.task.lower)


@pytest.mark.parametrize(
    "rewrite",
    [
        lambda text: text.replace('time_law = "constant"\n', ""),
        lambda text: text.replace("[task]", "[ task ]  # heading"),
        lambda text: text.replace('time_law = "constant"\n', "").replace(
            "\n[[task.waypoints]]", '\ntime_law = "constant"\n[[task.waypoints]]', 1
        ),
    ],
)
def test_the_key_may_stand_anywhere_in_its_table(rewrite: object) -> None:
    stored = collect_cell(load(RACK))
    text = stored.files[stored.workcell].decode()
    assert callable(rewrite)
    changed = rewrite(text)
    assert changed != text
    variant = replace(stored, files={**stored.files, stored.workcell: changed.encode()})
    made = drivable_files(variant)
    assert tomllib.loads(made.files[made.workcell].decode())["task"]["time_law"] == "optimal"


def test_a_task_written_otherwise_is_refused() -> None:
    stored = collect_cell(load(RACK))
    text = stored.files[stored.workcell].decode()
    odd = text.replace("[task]\n", "", 1).replace("start =", "task.start =", 1)
    variant = replace(stored, files={**stored.files, stored.workcell: odd.encode()})
    with pytest.raises(BundleError, match="time_law"):
        drivable_files(variant)


@pytest.mark.parametrize(
    ("stated", "usual", "driven"),
    [
        ("", "paper", "soft-finger"),
        ('allocation = "joint"\n', "joint", "joint"),
        ('drivable_allocation = "paper"\n', "paper", "paper"),
        ('allocation = "joint"\ndrivable_allocation = "soft-finger"\n', "joint", "soft-finger"),
    ],
)
def test_what_robots_drive_has_an_allocation_of_its_own(
    stated: str, usual: str, driven: str, tmp_path: Path
) -> None:
    stored = collect_cell(load(RACK))
    text = stored.files[stored.workcell].decode().replace("[task]\n", f"[task]\n{stated}")
    variant = replace(stored, files={**stored.files, stored.workcell: text.encode()})
    cell = unpack_cell(variant, tmp_path / "usual", check_digest=False)
    assert cell.task.allocation == usual
    assert unpack_cell(drivable_files(variant), tmp_path / "driven").task.allocation == driven
