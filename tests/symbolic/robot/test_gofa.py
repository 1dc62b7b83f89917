"""The GoFa 12's URDF against published figures, by numeric Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from symbolic.read.arms import reduced_model
from symbolic.read.urdf import read_urdf
from tests.symbolic.read.samples import GOFA

# ABB's working-range positions: joint angles [deg] -> centre of the flange [m].
FLANGE_POSITIONS = [
    ((0, 0, 0, 0, 0, 0), (0.635, 0, 1.235)),
    ((0, 0, -78.4, 0, 26.7, 0), (0, 0, 1.719)),
    ((0, 90, -78.4, 0, 26.7, 0), (1.381, 0, 0.338)),
    ((0, 180, -78.4, 0, 26.7, 0), (0, 0, -1.043)),
    ((0, -90, -78.4, 0, 26.7, 0), (-1.381, 0, 0.338)),
    ((0, 180, 11.6, 0, 26.7, 0), (-0.674, 0, -0.369)),
    ((0, 180, 85, 0, 26.7, 0), (-0.193, 0, 0.277)),
    ((0, 180, -168.4, 0, 26.7, 0), (0.674, 0, -0.369)),
    ((0, 180, -225, 0, 26.7, 0), (0.371, 0, 0.194)),
]
STRETCHED = np.radians([0, 90, -78.4, 0, 26.7, 0])


@pytest.fixture(scope="module")
def model() -> pin.Model:
    return reduced_model(read_urdf(GOFA))


def flange_pose(model: pin.Model, q: np.ndarray) -> pin.SE3:
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId("tool0")]


@pytest.mark.parametrize(("degrees", "position"), FLANGE_POSITIONS)
def test_flange_positions(
    model: pin.Model, degrees: tuple[float, ...], position: tuple[float, ...]
) -> None:
    # The published angles are rounded to 0.1 degrees, hence 1 mm per coordinate.
    found = flange_pose(model, np.radians(degrees)).translation
    np.testing.assert_allclose(found, position, atol=1e-3)


def test_flange_points_forward_at_zero(model: pin.Model) -> None:
    rotation = flange_pose(model, np.zeros(6)).rotation
    np.testing.assert_allclose(rotation[:, 2], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rotation[:, 0], [0, 0, -1], atol=1e-12)


def test_limits(model: pin.Model) -> None:
    np.testing.assert_allclose(
        np.degrees(model.lowerPositionLimit), [-270, -180, -225, -180, -180, -270], atol=1e-9
    )
    np.testing.assert_allclose(
        np.degrees(model.upperPositionLimit), [270, 180, 85, 180, 180, 270], atol=1e-9
    )
    np.testing.assert_allclose(
        np.degrees(model.velocityLimit), [120, 120, 125, 200, 200, 200], atol=1e-9
    )
    np.testing.assert_allclose(model.effortLimit, [390, 400, 160, 60, 60, 60])


def test_mass_is_the_robots(model: pin.Model) -> None:
    assert sum(inertia.mass for inertia in model.inertias) == pytest.approx(48.0, abs=0.01)


def test_inertias_are_physical(model: pin.Model) -> None:
    for joint in range(1, model.njoints):
        moments = np.linalg.eigvalsh(model.inertias[joint].inertia)
        assert moments[0] > 0
        assert moments[2] <= moments[0] + moments[1]


def test_gravity_torque_at_full_stretch_with_payload(model: pin.Model) -> None:
    data = model.createData()
    gravity = pin.computeGeneralizedGravity(model, data, STRETCHED)
    jacobian = pin.computeFrameJacobian(
        model, data, STRETCHED, model.getFrameId("tool0"), pin.LOCAL_WORLD_ALIGNED
    )
    torque = np.abs(gravity + jacobian[:3].T @ [0, 0, 12 * 9.81])
    np.testing.assert_allclose(torque[[1, 2, 4]], [367, 126, 16], atol=0.5)
    assert np.all(torque < model.effortLimit)


def test_forearm_and_upper_arm_stand_on_opposite_sides(model: pin.Model) -> None:
    geometry = pin.buildGeomFromUrdf(model, str(GOFA), pin.GeometryType.COLLISION)
    sides = {g.name: g.placement.translation[1] for g in geometry.geometryObjects}
    assert sides["link_2_0"] == pytest.approx(-0.155)
    assert sides["link_4_2"] == pytest.approx(0.09765)
