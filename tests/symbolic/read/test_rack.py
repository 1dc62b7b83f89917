"""The rack cell as it is read."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from symbolic.read.arms import body_names
from symbolic.read.cell import load
from symbolic.read.checks import stretched_length
from symbolic.records import Box, Cylinder, Mesh, Workcell
from tests.symbolic.read.samples import RACK


@pytest.fixture(scope="module")
def rack() -> Workcell:
    return load(RACK)


def test_robots(rack: Workcell) -> None:
    left, right = rack.robots
    assert (left.name, right.name) == ("left", "right")
    assert left.urdf == right.urdf
    assert left.urdf.is_absolute()
    for robot, side in ((left, 1.0), (right, -1.0)):
        base = robot.T_world_base
        assert np.sign(base[1, 3]) == side
        # The base's x axis looks at the rack, along y.
        np.testing.assert_allclose(base[:3, :3] @ [1, 0, 0], [0, -side, 0], atol=1e-12)
        (tool,) = robot.tool
        assert isinstance(tool.shape, Cylinder)
        pad = robot.T_flange_pad
        # The tool reaches from the flange to the pad.
        far_end = tool.pose @ [0, 0, tool.shape.length / 2, 1]
        np.testing.assert_allclose(far_end, pad[:, 3], atol=1e-12)
        np.testing.assert_allclose(np.degrees(robot.position_upper), [270, 180, 85, 180, 180, 270])
        np.testing.assert_allclose(robot.torque_max, [390, 400, 160, 60, 60, 60])
        assert robot.acceleration_max.shape == (6,)


def test_payload(rack: Workcell) -> None:
    payload = rack.payload
    np.testing.assert_array_equal(payload.size, [0.30, 0.40, 0.25])
    assert payload.mass == 10.0
    np.testing.assert_array_equal(payload.centre_of_mass, np.zeros(3))
    expected = 10 / 12 * np.array([0.4**2 + 0.25**2, 0.3**2 + 0.25**2, 0.3**2 + 0.4**2])
    np.testing.assert_allclose(payload.inertia, np.diag(expected), rtol=1e-15)


def test_contacts_squeeze_the_box(rack: Workcell) -> None:
    for robot, contact in zip(rack.robots, rack.contacts, strict=True):
        origin, normal = contact.T_box_pad[:3, 3], contact.T_box_pad[:3, 2]
        assert abs(origin[1]) == pytest.approx(0.20)
        # The normal leads from the robot that holds the contact into the box.
        assert normal @ origin < 0
        assert normal @ (origin - robot.T_world_base[:3, 3]) > 0
        assert (contact.friction, contact.patch_radius) == (1.0, 0.0315)


def test_task(rack: Workcell) -> None:
    task = rack.task
    assert task.waypoints[0].is_fixed
    assert task.waypoints[-1].is_fixed
    assert task.n_var == 6 * len(task.free_indices) == task.initial.size
    assert np.all(task.initial.ravel() >= task.lower)
    assert np.all(task.initial.ravel() <= task.upper)
    assert task.reference_speed == 0.25
    assert task.samples == 100
    np.testing.assert_allclose(task.reference_force, 12 * 9.80665, atol=5e-4)


def test_boards_from_the_paper(rack: Workcell) -> None:
    bodies = {body.name: body for body in rack.environment}
    for name, top in (("bottom board", 0.2), ("middle board", 0.6), ("top board", 1.0)):
        shape = bodies[name].shape
        assert isinstance(shape, Box)
        np.testing.assert_allclose(shape.size[:2], [0.40, 1.00])
        assert bodies[name].pose[2, 3] + shape.size[2] / 2 == pytest.approx(top)
    ground = bodies["ground"]
    assert isinstance(ground.shape, Box)
    assert ground.pose[2, 3] + ground.shape.size[2] / 2 == pytest.approx(0.0)


def test_names_of_bodies(rack: Workcell) -> None:
    names = body_names(rack)
    assert names["payload"] == ("payload",)
    assert names["left"][0] == "left/base_link"
    assert names["right"][-1] == "right/pad"
    assert "top board" in names["environment"]
    flat = [name for group in names.values() for name in group]
    assert len(set(flat)) == len(flat)


def test_stretched_length_is_the_sum_of_the_links(rack: Workcell) -> None:
    shoulder, length = stretched_length(rack.robots[0])
    above = shoulder - rack.robots[0].T_world_base[:3, 3]
    np.testing.assert_allclose(above, [0.0, 0.0, 0.338], atol=1e-12)
    assert length == pytest.approx(0.707 + 0.110 + 0.534 + np.hypot(0.101, 0.080))


def arrays_in(value: object) -> list[np.ndarray]:
    if isinstance(value, np.ndarray):
        return [value]
    if isinstance(value, tuple):
        return [array for entry in value for array in arrays_in(entry)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return [array for f in fields for array in arrays_in(getattr(value, f.name))]
    return []


def test_arrays_are_read_only(rack: Workcell) -> None:
    arrays = arrays_in(rack)
    assert len(arrays) > 40
    for array in arrays:
        assert array.dtype == np.float64
        assert not array.flags.writeable


def test_records_are_frozen(rack: Workcell) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        rack.name = "other"  # type: ignore[misc]


def test_source_and_digest(rack: Workcell) -> None:
    assert rack.source == RACK.resolve()
    assert len(rack.digest) == 64
    assert load(str(RACK)).digest == rack.digest
    assert not any(isinstance(body.shape, Mesh) for body in rack.environment)
    assert isinstance(rack.source, Path)
