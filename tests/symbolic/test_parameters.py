"""Functions of a cell's numbers against the same with constants, and what is structure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest

from symbolic.array import Array
from symbolic.cell_model import CellBodies, CellModel, build_cell_bodies
from symbolic.contact.load import load_function
from symbolic.functions import arm_functions, sample_functions
from symbolic.limit_coefficients import path_force_function, sample_limits_function
from symbolic.parameters import GROUPS, HELD, START, TASK, CellParameters
from symbolic.read.cell import changed, load
from symbolic.records import Workcell
from symbolic.records.poses import pose_matrix
from tests.symbolic.cells import RACK, hand_cell, hand_model, rack_cell, with_task


@cache
def bodies() -> CellBodies:
    return build_cell_bodies(rack_cell())


def numbers_of(cell: Workcell) -> CellParameters:
    own = build_cell_bodies(cell)
    return CellParameters(cell, own.screen, own.robots)


def turned_cell() -> Workcell:
    """The hand-written cell with everything at odd places, so that no number is a zero or a one."""
    cell = hand_cell()
    spin = pose_matrix((0.01, 0.02, 0.03), (0.0, 0.0, 0.1))
    first, second = (replace(r, T_world_base=spin @ r.T_world_base) for r in cell.robots)
    payload = replace(
        cell.payload,
        mass=7.3,
        centre_of_mass=np.array([0.01, -0.02, 0.015]),
        inertia=np.array([[0.2, 0.01, 0.02], [0.01, 0.18, -0.01], [0.02, -0.01, 0.15]]),
    )
    turns = [pose_matrix((0.0, 0.003, 0.0), (0.0, 0.0, angle)) for angle in (0.3, -0.2)]
    one, two = (
        replace(contact, friction=mu, T_box_pad=contact.T_box_pad @ turn)
        for contact, mu, turn in zip(cell.contacts, (0.7, 0.8), turns, strict=True)
    )
    return replace(cell, robots=(first, second), payload=payload, contacts=(one, two))


def vectors(numbers: CellParameters) -> dict[str, Array]:
    """Of all groups."""
    return {name: numbers.vector(name) for name in numbers.sizes}


def both(cell: Workcell) -> tuple[CellModel, CellModel, dict[str, Array]]:
    """The model with constants, with symbols, and the values of these."""
    plain = hand_model(cell)
    numbers = CellParameters(cell, plain.screen, plain.robots)
    values = vectors(numbers) | {START: np.concatenate(plain.start)}
    return plain, numbers.symbolic(plain), values


@cache
def turned_models(**changes: Any) -> tuple[CellModel, CellModel, dict[str, Array]]:
    return both(with_task(turned_cell(), **changes))


def compare(plain: ca.Function, symbolic: ca.Function, values: dict[str, Array], seed: int) -> None:
    rng = np.random.default_rng(seed)
    more = symbolic.n_in() - plain.n_in()
    assert more > 0
    # The inputs of a path have no names.
    given = [name if name in GROUPS else TASK for name in symbolic.name_in()[-more:]]
    for _ in range(3):
        inputs = [rng.uniform(-0.3, 0.3, plain.size_in(k)) for k in range(plain.n_in())]
        expected = plain.call(inputs)
        found = symbolic.call([*inputs, *[values[name] for name in given]])
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(np.array(one), np.array(other), rtol=1e-8, atol=1e-8)


MAKERS: dict[str, Callable[[CellModel], ca.Function]] = {
    "candidate": lambda model: arm_functions(model)["candidate"],
    "posture": lambda model: arm_functions(model)["posture"],
    "load": lambda model: load_function(model.workcell),
    "limits": sample_limits_function,
    "path force": lambda model: path_force_function(model.workcell),
    "clearance": lambda model: model.screening["clearance"],
    "far clearance": lambda model: model.screening["far_clearance"],
    "pieces": lambda model: model.screening["piece_poses"],
    "motion": lambda model: model.screening["motion"],
    "path": lambda model: sample_functions(model)["path"],
}
OTHERS: list[tuple[str, dict[str, Any]]] = [
    ("load", {"allocation": "soft-finger"}),
    ("path", {"time_law": "ramped"}),
]


@pytest.mark.parametrize(("name", "changes"), [*((name, {}) for name in MAKERS), *OTHERS])
def test_numbers_as_inputs_give_what_constants_give(name: str, changes: dict[str, Any]) -> None:
    plain, symbolic, values = turned_models(**changes)
    compare(MAKERS[name](plain), MAKERS[name](symbolic), values, 0)


def test_where_a_squeeze_is_looked_for_what_it_starts_from_is_a_number() -> None:
    cell = load(RACK.with_name("fork.toml"))
    plain, symbolic, values = both(cell)
    ours, task = numbers_of(cell), cell.task
    start, *others = task.waypoints
    pose = start.lower + np.array([0.0, 0.0, 0.01, 0.1, 0.0, 0.0])
    points = (replace(start, lower=pose, upper=pose), *others)
    other = numbers_of(replace(cell, task=replace(task, waypoints=points)))
    assert other.bodies_digest == ours.bodies_digest
    assert not np.array_equal(other.vector(HELD), ours.vector(HELD))
    compare(MAKERS["path"](plain), MAKERS["path"](symbolic), values, 2)


STRUCTURE: dict[str, dict[str, Any]] = {
    "roll and pitch of a base": {"robots[0].base.rpy": [0.01, 0.02, -1.5707963267948966]},
    "load of a tool": {"robots[0].tool_load.mass": 1.2},
    "proportions of a body": {"robots[1].tool.pad.length": 0.09},
    "samples": {"task.samples": 60},
    "time law": {"task.time_law": "ramped"},
    "allocation": {"task.allocation": "soft-finger"},
    "pads beside one another": {"contacts[0].xyz": [0.01, 0.2, 0.055]},
}
"""What is compiled anew, see docs/explanation/speed.md."""


def test_structure_is_what_formulas_are_written_of() -> None:
    """What is none, `tests/hybrid_opt/test_changed_numbers.py` goes through."""
    cell = rack_cell()
    one, two = (replace(contact, half_sides=(0.02, 0.02)) for contact in cell.contacts)
    others = [
        *(changed(cell, values) for values in STRUCTURE.values()),
        replace(cell, contacts=(one, two)),
        replace(cell, environment=cell.environment[:-1]),
    ]
    digests = [numbers_of(each).bodies_digest for each in (cell, *others)]
    assert len(set(digests)) == len(digests)
    without = [numbers_of(each).digest for each in (cell, others[-1])]
    assert without[0] == without[1]


def test_entries_are_named_by_their_keys() -> None:
    numbers = CellParameters(rack_cell(), bodies().screen, bodies().robots)
    held = {entry.key for entry in numbers.layout["held_numbers"]}
    assert {"payload.mass", "contacts[0].friction", "contacts[1].patch_radius"} <= held
    for group, entries in numbers.layout.items():
        sizes = [int(np.prod(entry.shape, dtype=int)) for entry in entries]
        assert sum(sizes) == numbers.sizes[group] == len(numbers.vector(group))
