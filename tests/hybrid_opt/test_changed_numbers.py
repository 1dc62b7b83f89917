"""No compiler runs after a change of a number, whatever is then asked of the cell.

What is built when a solve first asks for it are rows of the distances of single pairs
(`hybrid_opt.polishing.cell.PolishFunctions`): another number can bring another pair near.
"""

from __future__ import annotations

import shutil
from collections import ChainMap
from collections.abc import Mapping, Sequence
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
from hybrid_opt.robust.force import robust_model
from symbolic.parameters import BODIES
from symbolic.records import Workcell
from tests.hybrid_opt.cells import drivable, shipped
from tests.symbolic.cells import RACK, rack_cell

SHORT = PolishSettings(
    attempts=1,
    rounds=1,
    probe=ProbeSettings(starts=0, middle_starts=0, rounds=1),
    fill=FillSettings(solved=0, members=0, attempts=0),
    drivable=DrivableSettings(first_rounds=1, rounds=1, members=1),
)


def moved(values: Any, *by: float) -> list[float]:
    """Numbers with others added."""
    found: list[float] = (np.asarray(values) + by).round(12).tolist()
    return found


def changes(known: Workcell) -> dict[str, dict[str, Any]]:
    """By group: none of its numbers is what it was."""
    task = known.task
    names = [body.name for body in known.environment]
    pedestal = known.environment[next(k for k, n in enumerate(names) if "pedestal" in n)]
    yaw = float(np.arctan2(*known.robots[1].T_world_base[1::-1, 0]))
    first, second = known.contacts
    along, sides = 5e-3 if known.has_opposite_pads else 0.0, first.half_sides
    patch: dict[str, Any] = {"contacts.patch_radius": 0.96 * first.patch_radius}
    if sides is not None:
        patch = {"contacts.patch_size": moved(2.0 * np.array(sides), 1e-3, -1e-3)}
    return {
        "base": {"robots[0].base.xyz": moved(known.robots[0].T_world_base[:3, 3], 0.0, 0.01, 0.0)},
        "turned base": {"robots[1].base.rpy": [0.0, 0.0, yaw - 0.01]},
        "place of a tool": {"robots[0].pad.xyz": [0.0, 0.0, 0.191]},
        "size of a tool": {"robots[1].tool.pad.length": 0.189},
        "place of an obstacle": {"environment.ground.xyz": [0.0, 0.0, -0.06]},
        "size of an obstacle": {f"environment.{pedestal.name}.size": [0.28, 0.3, 0.2]},
        "start": {"task.start": moved(task.waypoints[0].lower, 0.0, 0.0, 2e-3, 0.0, 0.0, 0.0)},
        "goal": {"task.goal": moved(task.waypoints[-1].lower, 0.0, 0.0, 2e-3, 0.0, 0.0, 0.02)},
        "bounds": {"task.waypoints[0].upper": moved(task.waypoints[1].upper, *[0.01] * 6)},
        "limits of arms": {
            "robots.acceleration_max": 4.5,
            "robots[0].torque_max": [380.0, 390.0, 155.0, 58.0, 58.0, 58.0],
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
            "uncertainty.friction": 0.1 if known.uncertainty.friction != 0.1 else 0.09,
            "uncertainty.mass": 0.03,
            "uncertainty.centre_of_mass": [0.002, 0.003, 0.001],
            "uncertainty.disturbance": [0.1, 0.21, 0.15],
            "uncertainty.tracking": 0.04,
            "uncertainty.tilt": 0.01,
        },
        "mass": {"payload.mass": 0.8 * known.payload.mass},
        "centre of mass": {
            "payload.centre_of_mass": moved(known.payload.centre_of_mass, 4e-3, 6e-3, 3e-3)
        },
        "inertia": {"payload.inertia": [[0.19, 0.0, 0.0], [0.0, 0.13, 0.0], [0.0, 0.0, 0.2]]},
        "size": {"payload.size": moved(known.payload.size, 0.0, 0.0, -0.01)},
        "places of pads": {
            "contacts[0].xyz": moved(first.T_box_pad[:3, 3], 5e-3, 0.0, -5e-3),
            "contacts[1].xyz": moved(second.T_box_pad[:3, 3], along, 0.0, -5e-3),
            "contacts[1].spin": 0.1,
        },
        "friction": {
            "contacts[0].friction": 0.95 * first.friction,
            "contacts[1].friction": 0.98 * second.friction,
        },
        "patches": patch,
    }


GROUPS = tuple(changes(rack_cell()))

UNSEEN = (
    *("place of an obstacle", "size of an obstacle", "size of a tool", "bounds", "margins"),
    *("size", "inertia"),
)
"""What the hand-made carry, which turns nothing, and its forces do not depend on."""

NO_NUMBERS = ("bounds", "margins", "uncertainty")
OF_BODIES = ("size of a tool", "place of an obstacle", "size of an obstacle")
"""What no compiled function takes, and what only those that know the bodies do."""


def asked(cell: ho.Cell, drivable: ho.Cell, polishes: Sequence[ho.Cell]) -> tuple[float, ...]:
    """All that is compiled of a cell, asked once: a carry and its timing, a drivable candidate and
    its robust forces; what polishes are made of is loaded."""
    carry = cell.carry(cell.initial)
    timing = ho.time_path(cell, cell.initial)
    driven = drivable.carry(drivable.initial)
    peak = robust_model(drivable.workcell).peak(driven, drivable.workcell.uncertainty)
    judged = drivable.evaluate(drivable.initial)
    for each in polishes:
        assert each.polish_functions.built
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


def polish(cell: ho.Cell) -> None:
    """A short polish of the hand-made carry."""
    x = cell.initial[None]
    first = Front.of_search(cell, "given", cell.evaluator.certified(cell.evaluate(x)))
    assert len(ho.polish(first, rng=np.random.default_rng(0), settings=SHORT))


def both(name: str) -> tuple[ho.Cell, ho.Cell]:
    """A cell and its drivable form."""
    return shipped(name), drivable(name)


def polished(name: str, cell: ho.Cell, drivable: ho.Cell) -> tuple[ho.Cell, ...]:
    """Those that are polished: for forces at samples, more than two pads compile minutes."""
    return (drivable,) if name == "fork" else (cell, drivable)


@cache
def warmed(name: str, polishes: bool = False) -> tuple[float, ...]:
    """What a cell and its drivable form give; afterwards all is compiled."""
    cell, drivable = both(name)
    # Start postures may be kept while what finds others was evicted: that is compiled.
    assert all(each.compiled.model.branches for each in (cell, drivable))
    for each in polished(name, cell, drivable) if polishes else ():
        polish(each)
    return asked(cell, drivable, polished(name, cell, drivable))


def refuse_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is compiled from here on fails, but for single rows."""
    plainly = Compiler.compile

    def refused(self: Compiler, source: Path, *given: Any, **more: Any) -> None:
        assert source.name.startswith("row_"), f"{source.name} is compiled"
        plainly(self, source, *given, **more)

    monkeypatch.setattr(Compiler, "compile", refused)


def changed_both(name: str, changed: Mapping[str, Any]) -> tuple[ho.Cell, ho.Cell]:
    """A cell and its drivable form with other numbers."""
    cell, driven = (each.changed(changed) for each in both(name))
    return cell, driven


def needs_no_compiler(
    name: str, new: tuple[ho.Cell, ho.Cell], monkeypatch: pytest.MonkeyPatch, polishes: bool
) -> bool:
    """Whether what is asked of a changed cell, without a compiler, is another answer."""
    before = warmed(name, polishes)
    refuse_compiler(monkeypatch)
    found = asked(*new, polished(name, *new))
    for each in polished(name, *new) if polishes else ():
        polish(each)
    return found != before


@pytest.mark.parametrize("group", GROUPS)
def test_the_rack_needs_no_compiler(group: str, monkeypatch: pytest.MonkeyPatch) -> None:
    new = changed_both("rack", changes(rack_cell())[group])
    assert needs_no_compiler("rack", new, monkeypatch, False) is (group not in UNSEEN)
    ours, other = shipped("rack").compiled.numbers, new[0].compiled.numbers
    differ = [k for k in ours.sizes if not np.array_equal(ours.vector(k), other.vector(k))]
    assert (differ == []) == (group in NO_NUMBERS)
    assert (differ == [BODIES]) == (group in OF_BODIES)


ALL = dict(ChainMap(*changes(rack_cell()).values()))


def test_nor_does_its_polish_after_all_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    assert needs_no_compiler("rack", changed_both("rack", ALL), monkeypatch, True)


@pytest.mark.parametrize(
    "changed",
    [ALL, *({"robots[0].base.xyz": place} for place in ([-0.15, 1.18, 0.2], [-0.3, 1.0, 0.3]))],
    ids=["all", "base", "far base"],
)
def test_a_changed_cell_is_what_its_file_says(
    changed: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the bit; from other places of its base an arm has other pairs within reach."""
    cell = shipped("rack")
    warmed("rack")
    refuse_compiler(monkeypatch)
    new = cell.changed(changed)
    text = new.workcell.text
    assert text is not None
    shutil.copytree(RACK.parents[1] / "robots", tmp_path / "robots")
    (tmp_path / "workcells").mkdir()
    file = tmp_path / "workcells" / RACK.name
    file.write_bytes(text)
    read = ho.Cell.load(file)
    assert read.workcell.digest == new.workcell.digest
    spread = np.random.default_rng(1).standard_normal((6, cell.n_var))
    x = np.clip(cell.initial + 0.05 * spread, cell.lower, cell.upper)
    ours, theirs = new.evaluate(x), read.evaluate(x)
    for part in ("penalised", "feasible", "reason", "position", "violation"):
        np.testing.assert_array_equal(getattr(ours, part), getattr(theirs, part), part)
    assert new.geometry.active != cell.geometry.active or changed is ALL
    assert new.geometry.possible == cell.geometry.possible
    carry, other = new.carry(new.initial), read.carry(read.initial)
    for part in ("time", "normal_force", "pressure_shift", "pose", "q"):
        np.testing.assert_array_equal(getattr(carry, part), getattr(other, part), part)


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("name", ["rack", "corner", "fork"])
def test_nor_do_polishes_and_pads_anywhere(
    name: str, group: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    new = changed_both(name, changes(shipped(name).workcell)[group])
    assert needs_no_compiler(name, new, monkeypatch, True) is (group not in UNSEEN)


@pytest.mark.parametrize("name", ["rack", "fork", "corner"])
def test_no_number_is_structure(name: str) -> None:
    every = dict(ChainMap(*changes(shipped(name).workcell).values()))
    for cell, new in zip(both(name), changed_both(name, every), strict=True):
        ours, other = cell.compiled.numbers, new.compiled.numbers
        assert other.bodies_digest == ours.bodies_digest
        assert other.layout == ours.layout


@pytest.mark.filterwarnings("ignore::symbolic.read.arms.RobotModelWarning")
def test_unknown_torques_limit_no_timing() -> None:
    """As large torques that no carry uses up; a third of the rack's torques makes it slower."""
    cell = ho.example("rack").drivable()
    torques = cell.workcell.robots[0].torque_max
    durations = {}
    for name, value in (("unknown", "unknown"), ("large", 1e5), ("small", 0.35 * torques)):
        timing = ho.time_path(cell.changed({"robots.torque_max": value}), cell.initial)
        durations[name] = np.inf if timing.carry is None else timing.carry.duration
    assert durations["unknown"] == durations["large"]
    assert durations["small"] > durations["large"]
