"""The bridge against numeric Pinocchio, on fixed arms and on models with other joints."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from types import ModuleType, SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from symbolic.array import Array
from symbolic.errors import BridgeError
from symbolic.read.arms import reduced_model
from symbolic.read.urdf import read_urdf
from symbolic.robot import bridge
from tests.robots import GOFA_URDF, ur10_urdf

# Rounding of some hundred operations on numbers of order 10 (rates) to 1000 (torques).
TOLERANCE = 1e-12


def _random_humanoid() -> pin.Model:
    """Free flyer, random placements, axes and inertias; nq differs from nv."""
    pin.seed(0)
    return pin.buildSampleModelHumanoidRandom()


MODELS: dict[str, Callable[[], pin.Model]] = {
    "gofa12": lambda: reduced_model(read_urdf(GOFA_URDF)),
    "ur10": lambda: reduced_model(read_urdf(ur10_urdf())),
    "manipulator": pin.buildSampleModelManipulator,
    "humanoid": _random_humanoid,
}


class Case:
    """A model, its last frame, and its functions, built once for all examples."""

    def __init__(self, name: str) -> None:
        self.model = MODELS[name]()
        self.data = self.model.createData()
        self.frame = self.model.nframes - 1
        self.kinematics = bridge.frame_kinematics(self.model, self.frame)
        self.drift = bridge.frame_drift(self.model, self.frame)
        self.joint_placements = bridge.joint_placements(self.model)
        self.inverse_dynamics = bridge.inverse_dynamics(self.model)

    def state(self, seed: int) -> tuple[Array, Array, Array]:
        """A random configuration, velocity and acceleration."""
        rng = np.random.default_rng(seed)
        q = pin.integrate(
            self.model, pin.neutral(self.model), rng.uniform(-np.pi, np.pi, self.model.nv)
        )
        return q, rng.uniform(-3, 3, self.model.nv), rng.uniform(-10, 10, self.model.nv)


@pytest.fixture(scope="module", params=MODELS)
def case(request: pytest.FixtureRequest) -> Case:
    return Case(request.param)


seeds = st.integers(0, 2**32 - 1)


@given(seed=seeds)
def test_kinematics(case: Case, seed: int) -> None:
    q, _, _ = case.state(seed)
    rotation, position, jacobian = (np.array(out) for out in case.kinematics(q))
    expected = pin.computeFrameJacobian(
        case.model, case.data, q, case.frame, pin.LOCAL_WORLD_ALIGNED
    )
    pin.framesForwardKinematics(case.model, case.data, q)
    placement = case.data.oMf[case.frame]
    assert_allclose(rotation, placement.rotation, rtol=0, atol=TOLERANCE)
    assert_allclose(position[:, 0], placement.translation, rtol=0, atol=TOLERANCE)
    assert_allclose(jacobian, expected, rtol=0, atol=TOLERANCE)


@given(seed=seeds)
def test_drift_completes_the_classical_acceleration(case: Case, seed: int) -> None:
    q, v, a = case.state(seed)
    pin.forwardKinematics(case.model, case.data, q, v, a)
    pin.updateFramePlacements(case.model, case.data)
    expected = pin.getFrameClassicalAcceleration(
        case.model, case.data, case.frame, pin.LOCAL_WORLD_ALIGNED
    ).vector
    jacobian = np.array(case.kinematics(q)[2])
    drift = np.array(case.drift(q, v))[:, 0]
    scale = 1 + np.abs(expected).max()
    assert_allclose(jacobian @ a + drift, expected, rtol=0, atol=TOLERANCE * scale)


@given(seed=seeds)
def test_joint_placements(case: Case, seed: int) -> None:
    q, _, _ = case.state(seed)
    rotations, positions = (np.array(out) for out in case.joint_placements(q))
    pin.forwardKinematics(case.model, case.data, q)
    expected = [case.data.oMi[joint] for joint in range(1, case.model.njoints)]
    assert_allclose(
        rotations, np.hstack([pose.rotation for pose in expected]), rtol=0, atol=TOLERANCE
    )
    assert_allclose(
        positions, np.column_stack([pose.translation for pose in expected]), rtol=0, atol=TOLERANCE
    )


@given(seed=seeds)
def test_inverse_dynamics(case: Case, seed: int) -> None:
    q, v, a = case.state(seed)
    torque = np.array(case.inverse_dynamics(q, v, a))[:, 0]
    expected = pin.rnea(case.model, case.data, q, v, a)
    scale = 1 + np.abs(expected).max()
    assert_allclose(torque, expected, rtol=0, atol=TOLERANCE * scale)


def test_frame_that_does_not_exist() -> None:
    model = MODELS["manipulator"]()
    with pytest.raises(IndexError, match=f"frame 1000 of a model with {model.nframes} frames"):
        bridge.frame_kinematics(model, 1000)


def test_text_that_is_no_model() -> None:
    with pytest.raises(ValueError, match="not a serialised Pinocchio model"):
        bridge.inverse_dynamics(SimpleNamespace(saveToString=lambda: "22 nonsense"))


@pytest.fixture
def fresh_extension() -> Iterator[None]:
    """Have the bridge look for its extension again, during the test and after it."""
    bridge._extension.cache_clear()
    yield
    bridge._extension.cache_clear()


@pytest.mark.usefixtures("fresh_extension")
def test_missing_extension_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "symbolic.robot.bridge._pinocchio_casadi", None)
    with pytest.raises(BridgeError, match=r"cannot be loaded .*pip install -e \."):
        bridge.inverse_dynamics(MODELS["manipulator"]())


@pytest.mark.usefixtures("fresh_extension")
def test_extension_built_for_other_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    other = ModuleType("symbolic.robot.bridge._pinocchio_casadi")
    other.PINOCCHIO_VERSION, other.CASADI_VERSION = "3.9.0", "3.7.2"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, other.__name__, other)
    with pytest.raises(BridgeError) as caught:
        bridge.inverse_dynamics(MODELS["manipulator"]())
    message = str(caught.value)
    assert f"pinocchio {pin.__version__} is installed, 3.9.0 was compiled against" in message
    assert "3.7.2 was compiled against" in message
    assert "pip install -e ." in message


@pytest.mark.parametrize(
    ("built", "installed", "fits"),
    [
        ("4.1.0", "4.1.7", True),
        ("4.1.0", "4.2.0", False),
        ("4.1.0", "5.1.0", False),
        ("4.1.0", "4.10.0", False),
    ],
)
def test_only_the_patch_version_may_differ(built: str, installed: str, fits: bool) -> None:
    versions = {"pinocchio": built}, {"pinocchio": installed}
    if fits:
        bridge.require_same_minor(*versions)
    else:
        with pytest.raises(BridgeError, match=installed):
            bridge.require_same_minor(*versions)


@pytest.mark.usefixtures("fresh_extension")
def test_an_installed_pinocchio_casadi_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    foreign = ModuleType("pinocchio.casadi")
    monkeypatch.setitem(sys.modules, "pinocchio.casadi", foreign)
    monkeypatch.setattr(pin, "casadi", foreign, raising=False)
    model = MODELS["manipulator"]()
    assert bridge.joint_placements(model).size1_out("positions") == 3
