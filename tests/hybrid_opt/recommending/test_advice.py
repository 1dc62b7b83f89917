"""What is told of other pads than two round ones that face one another, against changed files."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from hybrid_opt.recommending.advice import changes_of_cell
from hybrid_opt.robust.force import RobustModel
from symbolic.read.cell import changed
from tests.hybrid_opt.robust.test_force import SMALL as SET
from tests.hybrid_opt.robust.test_force import model, motion

PLACES: dict[str, dict[str, list[float]]] = {
    "drum": {
        "contacts[0].xyz": [-0.0439992377, 0.1642073905, 0.07],
        "contacts[1].xyz": [-0.0439992377, -0.1642073905, 0.07],
    },
    "fork": {
        "contacts[0].xyz": [-0.08, 0.20, 0.055],
        "contacts[0].further[0].xyz": [0.08, 0.20, 0.055],
        "contacts[1].xyz": [0.0, -0.20, 0.055],
    },
}
WIDER: dict[str, dict[str, list[float]]] = {
    "drum": {"contacts.patch_size": [0.062, 0.032]},
    "fork": {"contacts[0].patch_size": [0.032, 0.032], "contacts[1].patch_size": [0.052, 0.052]},
}


@pytest.mark.parametrize("name", PLACES)
def test_changes_of_pads_anywhere_are_those_of_the_file(name: str) -> None:
    workcell, moved = model(f"{name}, even").workcell, motion(name)
    told = dict(changes_of_cell(workcell, moved))

    def force(changes: dict[str, Any]) -> float:
        """Largest that holds every case with other numbers in the file [N]."""
        cell = changed(workcell, changes | {"task.allocation": "soft-finger"})
        return float(RobustModel(replace(cell, uncertainty=SET)).hold(moved, SET)[0].max())

    def lower(by: float) -> dict[str, list[float]]:
        return {path: [x, y, z - by] for path, (x, y, z) in PLACES[name].items()}

    now = force({})
    files: dict[str, dict[str, Any]] = {
        "friction 0.05 higher": {"contacts.friction": 0.85},
        "patches 1 mm wider to each side": dict(WIDER[name]),
        "pads 1 mm lower": dict(lower(1e-3)),
    }
    for change, numbers in files.items():
        assert told[change] == pytest.approx(force(numbers) - now, rel=1e-3)
    height = 1e3 * (PLACES[name]["contacts[0].xyz"][2] - workcell.payload.centre_of_mass[2])
    level = f"pads at the height of the centre of mass, now {height:.0f} mm above it"
    assert told[level] == pytest.approx(force(lower(height / 1e3)) - now, rel=1e-3)
    assert all(change < 0.0 for change in told.values())
