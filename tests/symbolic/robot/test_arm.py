"""An arm: the bridge and its model against Pinocchio, and following a path."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from studies.research.plain.arm import PlainArm
from symbolic import extension
from symbolic.array import Array
from symbolic.errors import BridgeError, RobotModelError
from symbolic.read.arms import reduced_model
from symbolic.read.urdf import read_urdf
from symbolic.robot import bridge
from symbolic.robot.arm import (
    CHEAP_STEPS,
    IK_NEWTON_STEPS,
    MAX_JOINT_STEP,
    REACH_TOLERANCE,
    follow_function,
    newton_step,
    pose_error,
    track_function,
)
from symbolic.robot.model import build_robot_model
from tests.machines import robot_record, ur10_urdf
from tests.refusals import refused
from tests.symbolic.cells import call, gofa_model, hand_cell, start_posture
from tests.symbolic.read.samples import GOFA

CELL = hand_cell()
ARMS = tuple(PlainArm(r, c) for r, c in zip(CELL.robots, CELL.contacts, strict=True))

_q = ca.SX.sym("q", 6)
_R, _p = ca.SX.sym("R", 3, 3), ca.SX.sym("p", 3)


def step_function() -> ca.Function:
    model = gofa_model()
    result = _q
    for _ in range(IK_NEWTON_STEPS):
        result = newton_step(model, result, _R, _p)
    _, residual = pose_error(_R, _p, *model.placement(result))
    return ca.Function("step", [_q, _R, _p], [result, residual])


def random_posture(rng: np.random.Generator, margin: float = 0.2) -> Array:
    robot = CELL.robots[0]
    return rng.uniform(robot.position_lower + margin, robot.position_upper - margin)


@given(axis=st.integers(0, 2), angle=st.floats(-np.pi, np.pi), shift=st.floats(-1.0, 1.0))
def test_residual_vanishes_for_equal_placements_only(axis: int, angle: float, shift: float) -> None:
    """In particular not for half a turn, where the sine of the error angle vanishes."""
    R = Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
    right, residual = pose_error(ca.DM(R), ca.DM([shift, 0, 0]), ca.DM(np.eye(3)), ca.DM([0, 0, 0]))
    expected = np.hypot(shift, 2 * np.sin(angle / 2))
    assert float(residual) == pytest.approx(expected, abs=1e-12)
    np.testing.assert_allclose(np.array(right)[3:, 0], np.sin(angle) * np.eye(3)[axis], atol=1e-12)


def test_a_singular_posture_keeps_its_joints_and_shows_its_residual() -> None:
    """Stretched arm and aligned wrist: the Jacobian has no inverse."""
    q = np.zeros(6)
    q[2] = -np.arctan2(0.534, 0.110)
    target = ARMS[0].place(q).copy()
    found, residual = step_function()(
        q, target.rotation, target.translation + np.array([0.1, 0.0, 0.3])
    )
    assert np.all(np.isfinite(found.full()))
    assert float(residual) > 0.01


def test_ten_thousand_random_poses_are_never_wrongly_reported_as_reached() -> None:
    """Poses of random postures, Newton from a disturbed posture; Pinocchio judges the outcome."""
    rng = np.random.default_rng(11)
    count = 10_000
    true = np.array([random_posture(rng, 0.0) for _ in range(count)])
    # From a sample's usual distance to one from which two steps cannot arrive.
    guess = true + rng.normal(size=(count, 6)) * 10.0 ** rng.uniform(-4, 0, (count, 1))
    targets = [ARMS[0].place(q).copy() for q in true]
    R = np.hstack([t.rotation for t in targets])
    p = np.column_stack([t.translation for t in targets])
    found, residual = (v.full() for v in step_function().map(count)(guess.T, R, p))
    reached = residual[0] <= REACH_TOLERANCE
    assert 0.2 < reached.mean() < 0.8
    for q, target, claimed in zip(found.T, targets, residual[0], strict=True):
        actual = ARMS[0].residual(q, target)
        assert actual == pytest.approx(claimed, abs=1e-11, rel=1e-6)


def straight_path(arm: int, end: Array, samples: int = 40) -> tuple[Array, Array]:
    start = CELL.task.waypoints[0].lower
    poses = start + np.linspace(0.0, 1.0, samples)[:, None] * (end - start)
    return start_posture(CELL)[arm], poses


def test_the_first_step_of_a_coarse_path_is_reached_as_well() -> None:
    """The second sample has no motion before it; its prediction must make up for that."""
    start, poses = straight_path(0, np.array([-0.4, 0.0, 0.8, 0.0, 0.0, 0.0]), samples=30)
    follow = follow_function(CELL.robots[0], gofa_model(), CELL.contacts[0], 30, "follow")
    result = call(follow, start, poses, np.zeros((30, 6)))
    assert result["ik_residual"][1] < 1e-9
    assert not result["lost"].any()


def test_an_arm_that_lost_the_path_stays_lost_even_when_it_finds_back() -> None:
    start = start_posture(CELL)[0]
    pose = CELL.task.waypoints[0].lower
    # Out of reach and back again.
    x = np.concatenate([np.linspace(0.0, -1.5, 40), np.linspace(-1.5, 0.0, 40), np.zeros(40)])
    poses = np.tile(pose, (120, 1))
    poses[:, 0] = x
    follow = follow_function(CELL.robots[0], gofa_model(), CELL.contacts[0], 120, "follow")
    result = call(follow, start, poses, np.zeros((120, 6)))
    first = int(np.argmax(result["lost"]))
    assert result["lost"][:first].max() == 0.0
    assert result["lost"][first:].min() == 1.0
    assert result["ik_residual"][first:].max() > 0.1
    # It waits where it was, and its residual says how far off that is.
    assert np.all(result["q"][first:] == result["q"][first - 1])
    held = result["q"][first - 1]
    for pose, residual in zip(poses[first:], result["ik_residual"][first:], strict=True):
        assert residual == pytest.approx(ARMS[0].residual(held, ARMS[0].flange_target(pose)))


def test_a_jump_to_another_branch_counts_as_lost() -> None:
    """The sample is reached, but by a change of joints that no motion makes."""
    track = track_function(CELL.robots[0], gofa_model(), CELL.contacts[0], "track")
    start, pose = start_posture(CELL)[0], CELL.task.waypoints[0].lower
    previous = start + 2.0 * MAX_JOINT_STEP * np.eye(6)[0]
    # Extrapolation with this change lands exactly on the posture that holds the box.
    change = start - previous
    assert ARMS[0].residual(start, ARMS[0].flange_target(pose)) < REACH_TOLERANCE
    result = call(track, np.concatenate([previous, change, np.zeros(7)]), pose, np.zeros(6))
    assert result["lost"][0] == 1.0
    np.testing.assert_array_equal(result["q"], previous)


def test_a_sample_that_the_cheap_steps_miss_is_reached_all_the_same() -> None:
    """A wild change of the last change sends the extrapolation astray; the QR steps find back."""
    track = track_function(CELL.robots[0], gofa_model(), CELL.contacts[0], "track")
    start, pose = start_posture(CELL)[0], CELL.task.waypoints[0].lower
    rng = np.random.default_rng(6)
    astray = 0
    for _ in range(20):
        state = np.concatenate([start, np.zeros(6), rng.normal(0.0, 2.0, 6), [0.0]])
        result = call(track, state, pose, np.zeros(6))
        assert result["lost"] == 0.0
        assert ARMS[0].residual(result["q"], ARMS[0].flange_target(pose)) < REACH_TOLERANCE
        guess = start + state[12:18]
        for _ in range(CHEAP_STEPS + 1):
            guess = ARMS[0].newton_step(guess, ARMS[0].flange_target(pose))
        astray += ARMS[0].residual(guess, ARMS[0].flange_target(pose)) > REACH_TOLERANCE
    assert astray > 5


angles = st.lists(st.floats(-np.pi, np.pi), min_size=6, max_size=6).map(np.array)
rates = st.lists(st.floats(-3, 3), min_size=6, max_size=6).map(np.array)


@given(q=angles, v=rates, a=rates, roll=st.floats(-np.pi, np.pi), pitch=st.floats(-1.5, 1.5))
def test_torque_on_a_tilted_base(q: Array, v: Array, a: Array, roll: float, pitch: float) -> None:
    """The same arm, hung in Pinocchio onto a tilted fixed joint under upright gravity."""
    T_world_base = np.eye(4)
    T_world_base[:3, :3] = pin.rpy.rpyToMatrix(roll, pitch, 0.3)
    T_world_base[:3, 3] = 1.0, -2.0, 0.5
    arm = build_robot_model(robot_record(GOFA, T_world_base))
    upright = build_robot_model(robot_record(GOFA)).model
    tilted = upright.copy()
    tilted.jointPlacements[1] = pin.SE3(T_world_base) * upright.jointPlacements[1]
    expected = pin.rnea(tilted, tilted.createData(), q, v, a)
    torque = np.array(arm.inverse_dynamics(q, v, a))[:, 0]
    assert_allclose(torque, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"locked_joints": (("joint_6", 0.0),)}, "gofa12.* 5 "),
        ({"flange": "tool1"}, "'tool1'.*'tool0'"),
        ({"urdf": Path("absent.urdf")}, r"absent\.urdf"),
    ],
)
def test_what_is_no_arm_is_told(change: dict[str, Any], told: str) -> None:
    with pytest.raises(RobotModelError, match=told):
        build_robot_model(replace(robot_record(GOFA), **change))


# Rounding of some hundred operations on numbers of order 10 (rates) to 1000 (torques).
TOLERANCE = 1e-12


def _random_humanoid() -> pin.Model:
    """Free flyer, random placements, axes and inertias; nq differs from nv."""
    pin.seed(0)
    return pin.buildSampleModelHumanoidRandom()


MODELS: dict[str, Callable[[], pin.Model]] = {
    "gofa12": lambda: reduced_model(read_urdf(GOFA)),
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


def test_what_is_no_frame_or_no_model_is_told() -> None:
    model = MODELS["manipulator"]()
    with pytest.raises(IndexError, match=f"1000 .*{model.nframes}"):
        bridge.frame_kinematics(model, 1000)
    with pytest.raises(ValueError, match="signature"):
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
    with refused(BridgeError, "not-loadable", "pip install -e ."):
        bridge.inverse_dynamics(MODELS["manipulator"]())


@pytest.mark.usefixtures("fresh_extension")
def test_extension_built_for_other_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    other = ModuleType("symbolic.robot.bridge._pinocchio_casadi")
    other.PINOCCHIO_VERSION, other.CASADI_VERSION = "3.9.0", "3.7.2"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, other.__name__, other)
    numbers = (f"pinocchio {pin.__version__}", "3.9.0", "3.7.2", "pip install -e .")
    with refused(BridgeError, "versions", *numbers):
        bridge.inverse_dynamics(MODELS["manipulator"]())


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
        extension.require_same_minor(*versions)
    else:
        with refused(BridgeError, "versions", installed):
            extension.require_same_minor(*versions)


@pytest.mark.usefixtures("fresh_extension")
def test_an_installed_pinocchio_casadi_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    foreign = ModuleType("pinocchio.casadi")
    monkeypatch.setitem(sys.modules, "pinocchio.casadi", foreign)
    monkeypatch.setattr(pin, "casadi", foreign, raising=False)
    model = MODELS["manipulator"]()
    assert bridge.joint_placements(model).size1_out("positions") == 3
