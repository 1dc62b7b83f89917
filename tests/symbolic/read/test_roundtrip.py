"""What is written to a workcell file is what is read from it."""

from __future__ import annotations

import importlib.metadata
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from symbolic.read.cell import load
from symbolic.read.payload import face_normal, pad_rotation
from symbolic.records import USUAL, Body, Box, Cylinder, Driver, Sphere, Uncertainty, Workcell
from symbolic.records.poses import inverse, pose_matrix
from tests.symbolic.read.samples import GOFA, sample_data, write
from tests.symbolic.read.strategies import cells, numbers, vectors


def expected_pose(data: dict[str, Any]) -> np.ndarray:
    """The transform of {xyz, rpy} by another library."""
    matrix = np.eye(4)
    # Extrinsic x, y, z turns are Rz(yaw) Ry(pitch) Rx(roll).
    matrix[:3, :3] = Rotation.from_euler("xyz", data.get("rpy", [0, 0, 0])).as_matrix()
    matrix[:3, 3] = data.get("xyz", [0, 0, 0])
    return matrix


def assert_same_body(body: Body, data: dict[str, Any]) -> None:
    assert body.name == data["name"]
    np.testing.assert_allclose(body.pose, expected_pose(data), atol=1e-14)
    if data["kind"] == "box":
        assert isinstance(body.shape, Box)
        assert body.shape.size.tolist() == data["size"]
    elif data["kind"] == "sphere":
        assert body.shape == Sphere(data["radius"])
    else:
        assert body.shape == Cylinder(data["radius"], data["length"])


def assert_same_cell(cell: Workcell, data: dict[str, Any]) -> None:
    assert cell.name == data["name"]
    assert cell.start_branch == tuple(r.get("start_branch", -1) for r in data["robots"])
    for robot, entry in zip(cell.robots, data["robots"], strict=True):
        np.testing.assert_allclose(robot.T_world_base, expected_pose(entry["base"]), atol=1e-14)
        np.testing.assert_allclose(robot.T_flange_pad, expected_pose(entry["pad"]), atol=1e-14)
        for key in ("velocity_max", "torque_max", "position_lower", "position_upper"):
            if key in entry:
                assert getattr(robot, key).tolist() == entry[key]
        acceleration = np.broadcast_to(entry.get("acceleration_max", 5.0), 6)
        np.testing.assert_array_equal(robot.acceleration_max, acceleration)
        assert (robot.jerk_max is None) == ("jerk_max" not in entry)
        if robot.jerk_max is not None:
            np.testing.assert_array_equal(robot.jerk_max, np.broadcast_to(entry["jerk_max"], 6))
        assert robot.driver == Driver(**entry.get("driver", {}))
        assert robot.min_manipulability == entry.get("min_manipulability", 0.005)
        for tool, tool_entry in zip(robot.tool, entry["tool"], strict=True):
            assert_same_body(tool, tool_entry)
    payload = data["payload"]
    assert cell.payload.size.tolist() == payload["size"]
    assert cell.payload.mass == payload["mass"]
    assert cell.payload.centre_of_mass.tolist() == payload.get("centre_of_mass", [0, 0, 0])
    if isinstance(payload.get("inertia"), list):
        assert cell.payload.inertia.tolist() == payload["inertia"]
    assert cell.payload.acceleration_max == payload.get("acceleration_max", 5.0)
    assert cell.payload.jerk_max == payload.get("jerk_max")
    for contact, entry in zip(cell.contacts, data["contacts"], strict=True):
        np.testing.assert_allclose(contact.T_box_pad[:3, 3], entry["xyz"], atol=1e-15)
        assert (contact.friction, contact.patch_radius) == (
            entry["friction"],
            entry["patch_radius"],
        )
    assert_same_task(cell, data["task"])
    for body, entry in zip(cell.environment, data["environment"], strict=True):
        assert_same_body(body, entry)
    collision = data.get("collision", {})
    assert cell.collision.tolerance == collision.get("tolerance", 0.0)
    assert [vars(pair) for pair in cell.collision.ignored] == collision.get("ignored", [])


def assert_same_uncertainty(cell: Workcell, data: dict[str, Any] | None) -> None:
    """Nothing that is not told, but the usual set where there is no table."""
    if data is None:
        assert cell.uncertainty is USUAL
        return
    assert cell.uncertainty.stated
    for name, nothing in vars(Uncertainty()).items():
        if name != "stated":
            found = getattr(cell.uncertainty, name)
            np.testing.assert_array_equal(found, data.get(name, nothing), err_msg=name)


def assert_same_handling(cell: Workcell, data: dict[str, Any]) -> None:
    usual = {"stand_off": 0.05, "pressing_speed": 0.05, "pressing_rate": 100.0}
    usual |= {"lifting_speed": 0.1}
    nothing = {"lift_height": None, "set_down_height": None}
    assert vars(cell.handling) == usual | nothing | data


def assert_same_task(cell: Workcell, data: dict[str, Any]) -> None:
    task = cell.task
    bounds = [(data["start"], data["start"])]
    for waypoint in data["waypoints"]:
        pair = (
            waypoint.get("lower", waypoint.get("fixed")),
            waypoint.get("upper", waypoint.get("fixed")),
        )
        bounds += [pair] * waypoint.get("count", 1)
    bounds.append((data["goal"], data["goal"]))
    assert [(w.lower.tolist(), w.upper.tolist()) for w in task.waypoints] == bounds
    free = [pair for pair in bounds if pair[0] != pair[1]]
    assert task.n_path == 6 * len(free)
    assert task.n_var == task.n_path + (task.time_law == "optimal") == len(task.lower)
    if "force_limit" in data:
        assert list(task.force_limit) == data["force_limit"]
    else:
        still = cell.payload.mass * 9.81 / sum(c.friction for c in cell.contacts)
        assert task.force_limit[0] == 1.001 * still
        assert task.force_limit[1] == max(1.001 * still, task.reference_force.min())
    centres = np.mean(free, axis=1)
    np.testing.assert_allclose(task.initial, np.array(data.get("initial", centres)), atol=1e-15)
    assert task.samples == data.get("samples", 100)
    assert task.allocation == data.get("allocation", "paper")
    assert task.time_law == data.get("time_law", "constant")
    assert task.reference_speed == data["reference_speed"]
    assert task.reference_angular_speed == data.get("reference_angular_speed", 0.5)
    assert task.ramp_time == data.get("ramp_time", 0.5)
    np.testing.assert_array_equal(task.reference_force, np.broadcast_to(data["reference_force"], 2))
    assert [vars(contact) for contact in task.allowed_contacts] == data["allowed_contacts"]


@given(cells())
def test_written_cells_are_read_back(data: dict[str, Any]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        cell = load(write(Path(folder), data))
    assert_same_cell(cell, data)
    assert_same_uncertainty(cell, data.get("uncertainty"))
    assert_same_handling(cell, data.get("handling", {}))


@given(st.integers(0, 2), st.sampled_from([-1, 1]), numbers(-6, 6))
def test_pad_rotation(axis: int, side: int, spin: float) -> None:
    rotation = pad_rotation(face_normal(axis, side), spin)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    inward = np.zeros(3)
    inward[axis] = -side
    np.testing.assert_array_equal(rotation[:, 2], inward)
    # Turning back about the inward normal restores the documented x axis.
    zero_spin = Rotation.from_rotvec(-spin * inward).as_matrix() @ rotation
    expected = [1, 0, 0] if axis == 2 else [0, 0, 1]
    np.testing.assert_allclose(zero_spin[:, 0], expected, atol=1e-14)


@given(vectors(-9, 9), vectors(-6, 6))
def test_inverse_of_a_pose(xyz: list[float], rpy: list[float]) -> None:
    pose = pose_matrix(xyz, rpy)
    np.testing.assert_allclose(pose @ inverse(pose), np.eye(4), atol=1e-13)


def test_contact_is_moved_onto_its_face(tmp_path: Path) -> None:
    data = sample_data()
    data["contacts"][0]["xyz"] = [0.01, 0.2 + 9e-7, -0.02]
    cell = load(write(tmp_path, data))
    assert cell.contacts[0].T_box_pad[:3, 3].tolist() == [0.01, 0.2, -0.02]


def test_locked_joint_leaves_six(tmp_path: Path) -> None:
    """A seventh joint, between the base and the first one, is held where the file says."""
    text = GOFA.read_text(encoding="utf-8")
    text = text.replace('<parent link="base_link"/>', '<parent link="turntable"/>')
    text = text.replace(
        '<link name="tool0"/>',
        '<link name="tool0"/><link name="turntable"/><joint name="turn" type="revolute">'
        '<parent link="base_link"/><child link="turntable"/><axis xyz="0 0 1"/>'
        '<origin xyz="0 0 0.1"/><limit lower="-3" upper="3" velocity="1" effort="500"/></joint>',
    )
    (tmp_path / "arm.urdf").write_text(text, encoding="utf-8")
    data = sample_data()
    data["robots"][0] |= {"urdf": "arm.urdf", "locked_joints": {"turn": 0.5}}
    cell = load(write(tmp_path, data))
    assert cell.robots[0].locked_joints == (("turn", 0.5),)
    np.testing.assert_allclose(cell.robots[0].torque_max, [390, 400, 160, 60, 60, 60])


def test_another_make_of_arm(tmp_path: Path) -> None:
    """A UR10 with its meshes, as its own package ships it."""
    files = importlib.metadata.files("example-robot-data") or []
    (entry,) = (file for file in files if file.name == "ur10_robot.urdf")
    urdf = Path(str(entry.locate())).resolve()
    share = next(folder.parent for folder in urdf.parents if folder.name == "example-robot-data")
    data = sample_data()
    for robot in data["robots"]:
        robot |= {"urdf": str(urdf), "package_dirs": [str(share)], "flange": "tool0"}
    cell = load(write(tmp_path, data))
    robot = cell.robots[0]
    np.testing.assert_allclose(robot.torque_max, [330, 330, 150, 54, 54, 54])
    assert robot.position_upper[2] == pytest.approx(math.pi)
