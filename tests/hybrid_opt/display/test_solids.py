"""Shapes and placements that pictures are drawn from, against Pinocchio and closed forms."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.display.scene import cell_solids, joint_placements
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.read.arms import arm_model
from symbolic.read.cell import load
from symbolic.records import Box
from tests.hybrid_opt.campaign.fake import RACK

ANGLES = st.floats(-3.0, 3.0)
TRANSFER = RACK.with_name("transfer.toml")


@pytest.fixture(scope="module")
def geometry() -> CellGeometry:
    return build_geometry(load(TRANSFER))


@given(st.lists(ANGLES, min_size=12, max_size=12))
def test_joint_placements_are_pinocchios(q: list[float]) -> None:
    geometry = build_geometry(load(TRANSFER))
    for i, arm in enumerate(geometry.arms):
        robot = geometry.workcell.robots[i]
        model = arm_model(robot)
        reference = model.createData()
        joints = np.array(q[6 * i : 6 * i + 6])
        pin.forwardKinematics(model, reference, joints)
        placed = joint_placements(arm, joints[None])[0]
        for j in range(6):
            expected = robot.T_world_base @ reference.oMi[j + 1].homogeneous
            np.testing.assert_allclose(placed[j], expected, atol=1e-12)


def test_solids_have_the_bodies_volume_and_place(geometry: CellGeometry) -> None:
    solids = {solid.name: solid for solid in cell_solids(geometry)}
    assert list(solids) == [body.name for body in geometry.bodies]
    for body in geometry.bodies:
        (piece, *more) = body.pieces
        if more or not isinstance(piece.shape, Box):
            continue
        vertices, faces = solids[body.name].vertices, solids[body.name].faces
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        volume = np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6.0
        assert volume == pytest.approx(np.prod(piece.shape.size), rel=1e-9)
        np.testing.assert_allclose(
            (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0, piece.centre, atol=1e-12
        )


def test_only_the_ground_is_ground(geometry: CellGeometry) -> None:
    assert [solid.name for solid in cell_solids(geometry) if solid.is_ground] == ["ground"]
