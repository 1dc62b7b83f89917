"""The rack cell as it is read."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from symbolic.read.arms import body_names
from symbolic.read.cell import load
from symbolic.read.checks import stretched_length
from symbolic.records import Box, Workcell
from tests.symbolic.read.samples import RACK


@pytest.fixture(scope="module")
def rack() -> Workcell:
    return load(RACK)


def test_contacts_squeeze_the_box(rack: Workcell) -> None:
    for robot, contact in zip(rack.robots, rack.contacts, strict=True):
        origin, normal = contact.T_box_pad[:3, 3], contact.T_box_pad[:3, 2]
        assert abs(origin[1]) == pytest.approx(0.20)
        # The normal leads from the robot that holds the contact into the box.
        assert normal @ origin < 0
        assert normal @ (origin - robot.T_world_base[:3, 3]) > 0
        assert (contact.friction, contact.patch_radius) == (1.0, 0.0315)


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
