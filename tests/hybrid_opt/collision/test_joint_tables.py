"""Tabulated distances of links, against Coal's at joint positions anywhere in the cells."""

from __future__ import annotations

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.collision.joint_tables import CELLS, JointTable, joint_tables
from symbolic.array import Array
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.geometry.separation import coal_distance, relative_placement


@pytest.fixture(scope="module")
def geometry() -> CellGeometry:
    return build_geometry(ho.example("pandas").workcell)


@pytest.fixture(scope="module")
def tables(geometry: CellGeometry) -> tuple[JointTable, ...]:
    return joint_tables(geometry)


def positions(geometry: CellGeometry, table: JointTable, n: int) -> Array:
    """Random positions, half of them beside corners of the table's cells, some whole turns off."""
    arm, rng = geometry.arms[table.robot], np.random.default_rng(table.pair)
    q = rng.uniform(arm.lower, arm.upper, (n, arm.joints))
    width = 2.0 * np.pi / CELLS
    corners = np.round(q[: n // 2] / width) * width
    q[: n // 2] = corners + rng.choice([-1e-12, 1e-12], corners.shape)
    q[::3] += 2.0 * np.pi * rng.integers(-2, 3, q[::3].shape)
    return q


def distances(geometry: CellGeometry, table: JointTable, q: Array) -> Array:
    pair, arm = geometry.active[table.pair], geometry.arms[table.robot]
    bodies = geometry.bodies[pair.first], geometry.bodies[pair.second]
    low, high = sorted(bodies, key=lambda body: body.frame.joint)
    found = []
    for each in q:
        T = relative_placement(arm, low.frame.joint, high.frame.joint, each)
        moved = tuple(piece.moved(T) for piece in high.pieces)
        found.append(coal_distance(low.pieces, moved))
    return np.array(found)


def test_no_bound_exceeds_the_distance(
    geometry: CellGeometry, tables: tuple[JointTable, ...]
) -> None:
    """Nor does it stay far below one that matters, but beside the joints' limits."""
    assert {table.robot for table in tables} == {0, 1}
    for table in tables:
        q = positions(geometry, table, 150)
        bounds, expected = table.look_up(q), distances(geometry, table, q)
        assert np.all(bounds <= np.maximum(expected, 0.0) + 1e-6)
        clear = expected > 0.01
        assert np.count_nonzero(clear) > 20
        assert np.mean(bounds[clear] > 0.2 * expected[clear]) > 0.9


def test_positions_that_have_no_cell_have_no_bound(tables: tuple[JointTable, ...]) -> None:
    q = np.zeros((4, 7))
    q[1:, tables[0].joint + 1] = np.nan, np.inf, -1e7
    bounds = tables[0].look_up(q)
    assert np.isfinite(bounds[0])
    assert np.isneginf(bounds[1:]).all()
