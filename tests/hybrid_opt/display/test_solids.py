"""Bodies as meshes: closed, of the right shape and size, and where Pinocchio has their joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.display.solids import SECTIONS, cell_solids, joint_placements
from symbolic.geometry.bodies import CollisionBody, Frame
from symbolic.geometry.hulls import hull_of
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.geometry.pieces import ConvexShape, Piece
from symbolic.read.arms import arm_model
from symbolic.read.cell import load
from symbolic.records import Box, Capsule, Cylinder, Sphere
from symbolic.records.poses import pose_matrix
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


POSE = pose_matrix([0.3, -0.2, 0.1], [0.4, -0.7, 1.1])

ANGLES_UP = np.linspace(-np.pi / 2.0, np.pi / 2.0, SECTIONS // 2 + 1)
HALF_CIRCLE = np.column_stack([np.cos(ANGLES_UP), np.sin(ANGLES_UP)])

CLOUD = np.random.default_rng(1).normal(scale=0.1, size=(40, 3))


@pytest.mark.parametrize(
    ("shape", "mesh"),
    [
        (Box(np.array([0.3, 0.2, 0.1])), trimesh.creation.box((0.3, 0.2, 0.1))),
        (Cylinder(0.1, 0.4), trimesh.creation.cylinder(0.1, 0.4, sections=SECTIONS)),
        (Sphere(0.2), trimesh.creation.revolve(0.2 * HALF_CIRCLE, sections=SECTIONS)),
        (Capsule(0.1, 0.4), trimesh.creation.capsule(0.4, 0.1, count=(SECTIONS // 2, SECTIONS))),
        (hull_of(CLOUD), trimesh.convex.convex_hull(CLOUD)),
    ],
    ids=lambda shape: type(shape).__name__,
)
def test_meshes_are_closed_and_those_of_trimesh(
    geometry: CellGeometry, shape: ConvexShape, mesh: trimesh.Trimesh
) -> None:
    body = CollisionBody("body", "environment", Frame("world"), (Piece(shape, POSE),))
    (solid,) = cell_solids(replace(geometry, bodies=(body,)))
    found = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    assert found.is_watertight
    assert found.is_winding_consistent
    mesh.apply_transform(POSE)
    assert len(found.faces) == len(mesh.faces)
    assert found.volume == pytest.approx(mesh.volume, rel=1e-9)
    np.testing.assert_allclose(found.bounds, mesh.bounds, atol=1e-9)


def test_solids_are_in_the_order_of_the_bodies(geometry: CellGeometry) -> None:
    names = [body.name for body in geometry.bodies]
    assert [solid.name for solid in cell_solids(geometry)] == names


def test_only_the_ground_is_ground(geometry: CellGeometry) -> None:
    assert [solid.name for solid in cell_solids(geometry) if solid.is_ground] == ["ground"]
