"""No compiler runs after a change of a number, whatever is then asked of the cell.

What is built when a solve first asks for it are rows of the distances of single pairs
(`hybrid_opt.polishing.cell.RowFunctions`): another number can bring another pair near.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybrid_opt as ho
from codegen.compiler import Compiler
from hybrid_opt.front import Front
from hybrid_opt.polishing.settings import (
    DrivableSettings,
    FillSettings,
    PolishSettings,
    ProbeSettings,
)
from hybrid_opt.robust.force import pressing_model
from tests.hybrid_opt.cells import shipped

SHORT = PolishSettings(
    attempts=1,
    rounds=1,
    probe=ProbeSettings(starts=0, middle_starts=0, rounds=1),
    fill=FillSettings(solved=0, members=0, attempts=0),
    drivable=DrivableSettings(rounds=1, most_rounds=1, turn=1, members=1),
)

PLACES: dict[str, dict[str, Any]] = {
    "base": {"robots.left.base.xyz": [-0.15, 1.16, 0.2]},
    "turned base": {"robots.right.base.rpy": [0.0, 0.0, 1.56]},
    "place of a tool": {"robots.left.pad.xyz": [0.0, 0.0, 0.191]},
    "size of a tool": {"robots.right.tool.pad.length": 0.189},
    "place of an obstacle": {"environment.ground.xyz": [0.0, 0.0, -0.06]},
    "size of an obstacle": {"environment.right pedestal.size": [0.28, 0.3, 0.2]},
    "start": {"task.start": [0.0, 0.0, 0.747, 0.0, 0.0, 0.0]},
    "goal": {"task.goal": [0.0, 0.0, 1.147, 0.0, 0.0, 0.02]},
    "bounds": {"task.waypoints[0].upper": [-0.27, 0.03, 0.93, 0.02, 0.12, 0.12]},
    "limits of arms": {
        "robots.acceleration_max": 4.5,
        "robots.left.torque_max": [380.0, 390.0, 155.0, 58.0, 58.0, 58.0],
        "robots.min_manipulability": 0.028,
    },
    "limits of the payload": {
        "payload.velocity_max": 0.9,
        "payload.acceleration_max": 4.5,
        "payload.angular_velocity_max": 1.8,
        "payload.angular_acceleration_max": 9.0,
    },
    "references": {
        "task.reference_force": 110.0,
        "task.reference_speed": 0.24,
        "task.reference_angular_speed": 0.45,
        "task.ramp_time": 0.45,
    },
    "margins": {"collision.tolerance": 5e-4},
    "uncertainty": {
        "uncertainty.friction": 0.1,
        "uncertainty.mass": 0.03,
        "uncertainty.centre_of_mass": [0.002, 0.003, 0.001],
        "uncertainty.disturbance": [0.1, 0.2, 0.15],
        "uncertainty.tracking": 0.04,
        "uncertainty.tilt": 0.01,
    },
}
"""Of every kind of cell, by group: none of its numbers is what it was."""

HELD: dict[str, dict[str, Any]] = {
    "mass": {"payload.mass": 8.0},
    "centre of mass": {"payload.centre_of_mass": [0.004, 0.006, 0.003]},
    "inertia": {"payload.inertia": [[0.19, 0.0, 0.0], [0.0, 0.13, 0.0], [0.0, 0.0, 0.2]]},
    "size": {"payload.size": [0.29, 0.4, 0.24]},
    "places of pads": {
        "contacts[0].xyz": [0.01, 0.2, 0.05],
        "contacts[1].xyz": [0.01, -0.2, 0.05],
        "contacts[0].spin": 0.1,
    },
    "friction": {"contacts[0].friction": 0.9, "contacts[1].friction": 0.95},
    "patches": {"contacts.patch_radius": 0.03},
}
"""Of pads whose forces need no squeeze to start from."""

UNSEEN = (
    *("place of an obstacle", "size of an obstacle", "size of a tool", "bounds", "margins"),
    *("size", "inertia"),
)
"""What the hand-made carry, which turns nothing, and its forces do not depend on."""


def asked(cell: ho.Cell, drivable: ho.Cell, polishes: tuple[ho.Cell, ...]) -> tuple[float, ...]:
    """All that is compiled of a cell, asked once: a carry and its timing, a drivable candidate,
    its robust forces, and a short polish."""
    carry = cell.carry(cell.initial)
    timing = ho.time_path(cell, cell.initial)
    driven = drivable.carry(drivable.initial)
    peak = pressing_model(drivable.workcell).peak(driven, drivable.workcell.uncertainty)
    judged = drivable.evaluate(drivable.initial)
    for each in polishes:
        x = each.initial[None]
        first = Front.of_search(each, "given", each.evaluator.certified(each.evaluate(x)))
        assert len(first.x) == 1
        ho.polish(first, rng=np.random.default_rng(0), settings=SHORT)
    return (
        float(carry.normal_force.max()),
        *(float(arm.torque.max()) for arm in carry.arms),
        float(carry.pose.sum()),
        timing.duration,
        float(driven.duration),
        *peak.tolist(),
        *judged.violation.ravel().tolist(),
        *cell.evaluate(cell.initial).objectives.ravel().tolist(),
    )


@cache
def warmed(name: str) -> tuple[ho.Cell, ho.Cell, tuple[float, ...]]:
    """A cell and its drivable form, and what both give."""
    cell = shipped(name)
    drivable = cell.drivable()
    # What looks for start postures is compiled also where the cache knows those of this cell.
    assert cell.compiled.model.start
    return cell, drivable, asked(cell, drivable, polished(name, cell, drivable))


def polished(name: str, cell: ho.Cell, drivable: ho.Cell) -> tuple[ho.Cell, ...]:
    """Those that are polished: for forces at samples pads anywhere compile minutes."""
    return (cell, drivable) if name == "rack" else (drivable,)


def needs_no_compiler(name: str, groups: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """What is asked of a changed cell is another answer, without a compiler."""
    cell, drivable, _ = warmed(name)
    plainly = Compiler.compile

    def refused(self: Compiler, source: Path, *given: Any, **more: Any) -> None:
        assert source.name.startswith("row_"), f"{source.name} is compiled"
        plainly(self, source, *given, **more)

    monkeypatch.setattr(Compiler, "compile", refused)
    changes: dict[str, Any] = {}
    for group in groups:
        changes |= (PLACES | HELD)[group]
    new, driven = cell.changed(changes), drivable.changed(changes)
    found = asked(new, driven, polished(name, new, driven))
    assert (found == warmed(name)[2]) is (set(groups) <= set(UNSEEN))


def test_the_rack_needs_no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    needs_no_compiler("rack", [*PLACES, *HELD], monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("group", [*PLACES, *HELD])
def test_nor_does_it_after_one_change(group: str, monkeypatch: pytest.MonkeyPatch) -> None:
    needs_no_compiler("rack", [group], monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("group", [name for name in PLACES if "payload" not in name])
def test_nor_do_pads_anywhere(group: str, monkeypatch: pytest.MonkeyPatch) -> None:
    needs_no_compiler("fork", [group], monkeypatch)
