"""Robots as their makers describe them, against Pinocchio's own reading of the same files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from studies.research.plain.collisions import PlainCollisionChecker
from symbolic.array import Array
from symbolic.cell_model import build_cell_model
from symbolic.functions import candidate_function
from symbolic.geometry.bodies import arm_geometry, collision_bodies
from symbolic.geometry.pairs import CellGeometry
from symbolic.read.arms import (
    arm_links,
    body_names,
    held_joints,
    moving_joints,
    one_machine,
    robot_urdf,
)
from symbolic.records import Robot, Workcell
from symbolic.robot.branches import start_branches
from symbolic.robot.model import build_robot_model
from tests.machines import MACHINES, SINGLE, cell_of
from tests.symbolic.geometry.collision_cells import placed_pieces

pytestmark = pytest.mark.filterwarnings("ignore::symbolic.geometry.hulls.CollisionModelWarning")

NAMES = (*SINGLE, *MACHINES)


def full_model(robot: Robot) -> tuple[pin.Model, list[int], Array]:
    """Pinocchio's model of the whole file, the columns of the arm, all else as it is held."""
    model = pin.buildModelFromUrdf(str(robot.urdf))
    urdf = robot_urdf(robot)
    moving = moving_joints(urdf, robot.chain_root, robot.flange, robot.locked_joints)
    q = pin.neutral(model)
    for name, position in held_joints(urdf, moving, robot.locked_joints):
        _set(model, q, name, position)
    columns = [model.joints[model.getJointId(name)].idx_v for name in moving]
    return model, columns, q


def _set(model: pin.Model, q: Array, name: str, position: float) -> None:
    joint = model.joints[model.getJointId(name)]
    # A continuous joint has cosine and sine as its coordinates.
    values = [position] if joint.nq == 1 else [np.cos(position), np.sin(position)]
    q[joint.idx_q : joint.idx_q + joint.nq] = values


@pytest.mark.parametrize("name", NAMES)
def test_kinematics_and_dynamics_are_those_of_the_whole_file(name: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    for robot in cell_of(name, tmp_path).robots:
        arm = build_robot_model(robot)
        model, columns, q_full = full_model(robot)
        model.gravity.linear = arm.model.gravity.linear
        data = model.createData()
        for _ in range(3):
            q = rng.uniform(robot.position_lower, robot.position_upper)
            v, a = rng.uniform(-1.0, 1.0, (2, 6))
            for joint, position in zip(arm.joint_names, q, strict=True):
                _set(model, q_full, joint, position)
            pin.framesForwardKinematics(model, data, q_full)
            frame = model.getFrameId(robot.flange, pin.FrameType.BODY)
            rotation, position = arm.placement(q)
            assert np.array(rotation) == pytest.approx(data.oMf[frame].rotation, abs=1e-12)
            expected = data.oMf[frame].translation
            assert np.array(position).ravel() == pytest.approx(expected, abs=1e-12)
            world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            jacobian = pin.computeFrameJacobian(model, data, q_full, frame, world)[:, columns]
            assert np.array(arm.jacobian(q)) == pytest.approx(jacobian, abs=1e-12)
            if not robot.drop_links:
                v_full, a_full = np.zeros(model.nv), np.zeros(model.nv)
                v_full[columns], a_full[columns] = v, a
                torque = pin.rnea(model, data, q_full, v_full, a_full)[columns]
                found = np.array(arm.inverse_dynamics(q, v, a)).ravel()
                assert found == pytest.approx(torque, abs=1e-12 * max(1.0, np.abs(torque).max()))


@pytest.mark.parametrize("name", ["panda", "pr2"])
def test_the_box_is_held_and_followed(name: str, tmp_path: Path) -> None:
    follow_a_candidate(cell_of(name, tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["ur3", "ur5", "ur10", "z1", "kinova", "xarm7", "tiago_dual", "tiago_pro", "talos"]
)
def test_more_machines_hold_the_box_and_follow(name: str, tmp_path: Path) -> None:
    follow_a_candidate(cell_of(name, tmp_path))


def follow_a_candidate(workcell: Workcell) -> None:
    """Both flanges stand where the box wants them, by Pinocchio's reading of the whole file."""
    model = build_cell_model(workcell)
    function = candidate_function(model)
    outputs = function(workcell.task.initial.reshape(-1))
    found = dict(zip(function.name_out(), map(np.array, outputs), strict=True))
    pose = found["pose"][:, -1]
    T_world_box = pin.SE3(pin.rpy.rpyToMatrix(pose[3:]), pose[:3]).homogeneous
    for i, robot in enumerate(workcell.robots):
        assert not np.any(found[f"lost_{i + 1}"])
        q = found[f"q_{i + 1}"].T
        assert np.all(q >= robot.position_lower)
        assert np.all(q <= robot.position_upper)
        full, _, q_full = full_model(robot)
        for joint, position in zip(model.robots[i].joint_names, q[-1], strict=True):
            _set(full, q_full, joint, position)
        data = full.createData()
        pin.framesForwardKinematics(full, data, q_full)
        T = robot.T_world_base @ data.oMf[full.getFrameId(robot.flange)].homogeneous
        expected = T_world_box @ workcell.contacts[i].T_box_pad
        assert T @ robot.T_flange_pad == pytest.approx(expected, abs=1e-6)


def test_every_link_of_a_machine_is_modelled_once(tmp_path: Path) -> None:
    workcell = cell_of("talos", tmp_path)
    assert one_machine(workcell.robots)
    left, right = (arm_links(workcell.robots, i) for i in (0, 1))
    assert "arm_right_4_link" in right.moved
    assert not any("right" in link for link in left.moved)
    assert right.still == ()
    assert {"torso_2_link", "head_1_link", "leg_left_3_link"} <= set(left.still)
    assert (left.mount, right.mount) == ("torso_2_link", "torso_2_link")
    links = [link for arm in (left, right) for link in (*arm.moved, *arm.still)]
    dropped = {link for link in robot_urdf(workcell.robots[0]).links if "gripper_right" in link}
    assert dropped
    assert not dropped & set(links)
    assert len(links) == len(set(links))
    assert "left/torso_2_link" in body_names(workcell)["left"]
    assert not any("torso" in name for name in body_names(workcell)["right"])


def test_start_postures_are_within_their_limits(tmp_path: Path) -> None:
    """The Panda's ranges are narrow and far from symmetric."""
    workcell = cell_of("panda", tmp_path)
    for i, robot in enumerate(workcell.robots):
        for branch in start_branches(workcell, i, build_robot_model(robot)):
            assert np.all(branch.q >= robot.position_lower)
            assert np.all(branch.q <= robot.position_upper)


def test_links_stand_where_the_plain_reference_puts_them(tmp_path: Path) -> None:
    """Every solid that is checked, in random postures of both arms of a machine."""
    workcell = cell_of("pr2", tmp_path)
    # Pairs, which take long to sort, do not matter here.
    arms = (arm_geometry(workcell, 0), arm_geometry(workcell, 1))
    geometry = CellGeometry(workcell, collision_bodies(workcell), arms, (), (), (), 0)
    checker = PlainCollisionChecker(workcell)
    rng = np.random.default_rng(4)
    q = [rng.uniform(robot.position_lower, robot.position_upper) for robot in workcell.robots]
    for arm, posture in zip(checker.arms, q, strict=True):
        arm.move(posture)
    seen = 0
    for body, pieces in zip(geometry.bodies, placed_pieces(geometry, np.zeros(6), *q), strict=True):
        if body.name == "payload":
            continue
        for piece, solid in zip(pieces, checker.bodies[body.name], strict=True):
            pose = solid.object.getTransform()
            assert pose.getTranslation() == pytest.approx(piece.pose[:3, 3], abs=1e-9)
            assert pose.getRotation() == pytest.approx(piece.pose[:3, :3], abs=1e-9)
            seen += 1
    assert seen > 30
