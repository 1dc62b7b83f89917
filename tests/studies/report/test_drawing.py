"""What pictures of a cell are made of: faces cut to size, and where the arms reach."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from hybrid_opt.display.solids import cell_solids
from studies.report import drawn
from studies.report.drawing import MAX_EDGE, cut_faces
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.read.cell import load
from tests.studies.conftest import TRANSFER


@pytest.fixture(scope="module")
def geometry() -> CellGeometry:
    return build_geometry(load(TRANSFER))


def test_faces_are_small_and_leave_no_cracks(geometry: CellGeometry) -> None:
    solids = cell_solids(geometry)
    for solid, cut in zip(solids, cut_faces(solids), strict=True):
        following = np.roll(cut.triangles, -1, axis=1)
        lengths = np.linalg.norm(following - cut.triangles, axis=2)
        assert solid.is_ground or lengths.max() <= MAX_EDGE
        # Every edge is once that of either neighbour, the other way round.
        edges = np.concatenate([cut.triangles, following], axis=2).reshape(-1, 6).round(9) + 0.0
        ways = {tuple(edge) for edge in edges.tolist()}
        assert ways == {(*edge[3:], *edge[:3]) for edge in ways}
        whole = solid.vertices[solid.faces]
        areas = [
            np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
            for a, b, c in (np.moveaxis(each, 1, 0) for each in (whole, cut.triangles))
        ]
        assert areas[1] == pytest.approx(areas[0], rel=1e-9)


def test_holes_of_the_reach_are_closed_as_scipy_does(
    geometry: CellGeometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = drawn.reach_map(geometry, np.random.default_rng(0))
    monkeypatch.setattr(drawn, "_closed", lambda cubes: ndimage.binary_closing(cubes, iterations=2))
    expected = drawn.reach_map(geometry, np.random.default_rng(0))
    monkeypatch.setattr(drawn, "_closed", lambda cubes: cubes)
    raw = drawn.reach_map(geometry, np.random.default_rng(0))
    for pads in zip(found.pads, expected.pads, raw.pads, strict=True):
        np.testing.assert_array_equal(pads[0], pads[1])
        assert pads[0].sum() > pads[2].sum()
