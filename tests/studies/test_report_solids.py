"""Shapes and placements that pictures are drawn from, against Pinocchio and closed forms."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from studies.report.drawing import FRONT, SIDE, TOP, oblique
from studies.report.reach import last_points, reach_map
from studies.report.records import ReportData
from studies.report.solids import (
    box_placements,
    cell_solids,
    frame_placements,
    joint_placements,
)
from symbolic.geometry.bodies import Frame
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.robot.urdf import arm_model
from symbolic.workcell.file import load
from symbolic.workcell.records import Box
from tests.studies.conftest import TRANSFER

ANGLES = st.floats(-3.0, 3.0)


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


@given(st.lists(ANGLES, min_size=6, max_size=6))
def test_box_placement_is_yaw_pitch_roll(pose: list[float]) -> None:
    T = box_placements(np.array(pose)[None])[0]
    np.testing.assert_allclose(T[:3, :3], pin.rpy.rpyToMatrix(*pose[3:]), atol=1e-12)
    np.testing.assert_array_equal(T[:3, 3], pose[:3])


def test_pads_stay_on_the_box_along_a_carry(data: ReportData) -> None:
    timed = data.initial.timed
    placed = frame_placements(data.geometry, timed.pose, timed.q)
    for i, arm in enumerate(data.geometry.arms):
        carried = placed[Frame("link", i, 5)] @ arm.T_joint_box
        np.testing.assert_allclose(carried, placed[Frame("box")], atol=2e-6)


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


@pytest.mark.parametrize("view", [FRONT, SIDE, TOP, oblique(0.3, 0.5), oblique(-2.0, -0.4)])
def test_views_are_rotations(view: object) -> None:
    assert isinstance(view, type(FRONT))
    axes = np.array([view.right, view.up, view.towards])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_front_is_seen_from_the_side_of_minus_x() -> None:
    np.testing.assert_allclose(FRONT.towards, [-1.0, 0.0, 0.0])
    np.testing.assert_allclose(SIDE.towards, [0.0, -1.0, 0.0])
    np.testing.assert_allclose(TOP.towards, [0.0, 0.0, 1.0])


def test_reach_holds_the_carry_and_ends_where_the_arm_does(data: ReportData) -> None:
    reach = data.reach
    for pose in data.initial.timed.pose[::10]:
        cube = tuple(((pose[:3] - reach.lower) / reach.step).astype(int))
        assert reach.common[cube]
    for i, arm in enumerate(data.geometry.arms):
        shoulder = (arm.T_world_root @ arm.origins[0])[:3, 3]
        cubes = np.argwhere(reach.pads[i])
        centres = reach.lower + (cubes + 0.5) * reach.step
        pad = arm.T_joint_box @ data.workcell.contacts[i].T_box_pad
        stretched = np.linalg.norm(arm.origins[1:, :3, 3], axis=1).sum()
        longest = stretched + np.linalg.norm(pad[:3, 3]) + 2.0 * reach.step
        distances = np.linalg.norm(centres - shoulder, axis=1)
        assert distances.max() <= longest
        assert distances.max() >= 0.85 * longest


def test_reach_repeats_with_its_seed(geometry: CellGeometry) -> None:
    first, second = (reach_map(geometry, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first.common, second.common)


def test_points_go_through_the_arm_as_placements_do(geometry: CellGeometry) -> None:
    arm, point = geometry.arms[0], np.array([0.05, -0.1, 0.2])
    found = last_points(arm, point, np.random.default_rng(2), 50)
    q = np.random.default_rng(2).uniform(arm.lower, arm.upper, (50, 6))
    T_world_joint = joint_placements(arm, q)[:, 5]
    expected = T_world_joint[:, :3, :3] @ point + T_world_joint[:, :3, 3]
    np.testing.assert_allclose(found, expected, atol=1e-12)
