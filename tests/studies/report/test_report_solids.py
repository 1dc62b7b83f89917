"""Placements along a carry, directions of view, and where the arms reach."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.display.scene import frame_placements
from studies.report.data import ReportData, reach_map
from studies.report.drawing import FRONT, SIDE, oblique
from symbolic.geometry.bodies import Frame
from symbolic.geometry.pairs import CellGeometry, build_geometry
from symbolic.read.cell import load
from tests.studies.conftest import TRANSFER


@pytest.fixture(scope="module")
def geometry() -> CellGeometry:
    return build_geometry(load(TRANSFER))


def test_pads_stay_on_the_box_along_a_carry(data: ReportData) -> None:
    timed = data.initial.timed
    placed = frame_placements(data.geometry, timed.pose, timed.q)
    for i, arm in enumerate(data.geometry.arms):
        carried = placed[Frame("link", i, 5)] @ arm.T_joint_box
        np.testing.assert_allclose(carried, placed[Frame("box")], atol=2e-6)


@pytest.mark.parametrize("view", [FRONT, SIDE, oblique(0.3, 0.5), oblique(-2.0, -0.4)])
def test_views_are_rotations(view: object) -> None:
    assert isinstance(view, type(FRONT))
    axes = np.array([view.right, view.up, view.towards])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)


def test_front_is_seen_from_the_side_of_minus_x() -> None:
    np.testing.assert_allclose(FRONT.towards, [-1.0, 0.0, 0.0])
    np.testing.assert_allclose(SIDE.towards, [0.0, -1.0, 0.0])


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
