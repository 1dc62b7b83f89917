"""Better places of pads: against every place of a grid, judged by the cell's own recommendation."""

from __future__ import annotations

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.front import Front
from symbolic.errors import SettingsError
from tests.hybrid_opt.cells import shipped

LOWEST, HIGHEST = -0.03, 0.006


@pytest.fixture(scope="module")
def grip() -> ho.Grip:
    told = list[int]()
    found = ho.propose_grip(
        shipped("rack"),
        (LOWEST, HIGHEST),
        (0.0, 0.0),
        trials=15,
        progress=lambda done, total: told.append(done),
    )
    assert told == list(range(1, len(told) + 1))
    assert len(told) >= 10
    return found


def product(up: float) -> float:
    """Of duration and force to command, of the rack's hand-made path with its pads higher up;
    infinite where it touches something."""
    places = {f"contacts[{k}].xyz": [0.0, y, 0.055 + up] for k, y in enumerate((0.2, -0.2))}
    cell = shipped("rack").changed(places).drivable()
    x = cell.initial[None]
    front = Front.of_search(cell, "given", cell.evaluator.certified(cell.evaluate(x)))
    if not len(front):
        return np.inf
    found = ho.recommend(front, alone=True)
    return found.duration * found.force


def test_no_place_of_a_grid_is_better(grip: ho.Grip) -> None:
    """But for what limits on jerk and whole ticks of a job change."""
    best = product(grip.up)
    assert np.isfinite(best)
    assert best < 0.995 * product(0.0)
    assert best < 1.02 * min(product(up) for up in (-0.03, -0.02, -0.01))
    assert grip.duration * grip.force < grip.before


def test_the_cell_is_certified_and_differs_in_its_pads_alone(grip: ho.Grip) -> None:
    cell, given = grip.cell, shipped("rack")
    assert cell.certify(cell.initial).is_free
    assert LOWEST <= grip.up <= HIGHEST
    assert grip.along == 0.0
    for own, other in zip(cell.workcell.contacts, given.workcell.contacts, strict=True):
        moved = own.T_box_pad[:3, 3] - other.T_box_pad[:3, 3]
        np.testing.assert_allclose(moved, [0.0, 0.0, grip.up], atol=1e-9)
    np.testing.assert_array_equal(cell.initial, given.initial)


def test_what_cannot_be_compared_is_told() -> None:
    with pytest.raises(SettingsError, match="closed form"):
        ho.propose_grip(shipped("fork"), (0.0, 0.01), (0.0, 0.0))
    with pytest.raises(SettingsError, match=r"a range from 0\.02 to 0\.01 m"):
        ho.propose_grip(shipped("rack"), (0.02, 0.01), (0.0, 0.0))
    with pytest.raises(SettingsError, match="no place of the pads"):
        ho.propose_grip(shipped("rack"), (0.2, 0.2), (0.0, 0.0))
