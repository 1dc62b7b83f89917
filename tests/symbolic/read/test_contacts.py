"""Other contacts and payloads in workcell files: what is read, and what is refused, in words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from symbolic.errors import WorkcellError
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell, unpack_cell
from symbolic.read.payload import pad_rotation
from symbolic.records import Cylinder, Mesh, Workcell
from tests.symbolic.read.samples import sample_data, write

JOINT = {"allocation": "joint"}


def cell(folder: Path, **changes: Any) -> Workcell:
    """The sample cell under the joint allocation with other tables; `contacts` one per robot."""
    data = sample_data()
    data["task"] |= {"allocation": "joint"} | changes.pop("task", {})
    for name, value in changes.items():
        data[name] = value
    return load(write(folder, data))


def contact(**values: Any) -> dict[str, Any]:
    """A contact of the sample cell, 0.3 x 0.4 x 0.25 m, unless told otherwise."""
    return {"xyz": [0.0, 0.2, 0.0], "friction": 0.8, "patch_radius": 0.02} | values


OPPOSITE = contact(xyz=[0.0, -0.2, 0.0])


def test_a_pad_at_a_given_normal(tmp_path: Path) -> None:
    handle = contact(xyz=[0.0, 0.22, 0.1], normal=[0.0, -2.0, 0.5], spin=0.3)
    first = cell(tmp_path, contacts=[handle, OPPOSITE]).contacts[0]
    z = np.array([0.0, -2.0, 0.5]) / np.hypot(2.0, 0.5)
    np.testing.assert_allclose(first.T_box_pad[:3, 2], z, atol=1e-15)
    np.testing.assert_array_equal(first.T_box_pad[:3, 3], [0.0, 0.22, 0.1])
    unspun = pad_rotation(z, 0.0)
    assert unspun[2, 0] > 0.9  # x along +z as far as it can
    np.testing.assert_allclose(
        unspun.T @ first.T_box_pad[:3, :3],
        [[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]],
        atol=1e-15,
    )


def test_a_rectangular_patch_and_a_fork(tmp_path: Path) -> None:
    fork = contact(
        xyz=[-0.1, 0.2, 0.0], patch_size=[0.06, 0.03], further=[{"xyz": [0.1, 0.2, 0.0]}]
    )
    del fork["patch_radius"]
    found = cell(tmp_path, contacts=[fork, OPPOSITE])
    first, second = found.contacts
    assert first.half_sides == (0.03, 0.015)
    assert first.patch_radius == pytest.approx(np.hypot(0.03, 0.015))
    assert second.half_sides is None
    (other,) = first.further
    np.testing.assert_array_equal(other.T_box_pad[:3, 3], [0.1, 0.2, 0.0])
    assert (other.friction, other.half_sides) == (0.8, (0.03, 0.015))
    assert found.pad_robots == (0, 0, 1)
    assert not found.has_facing_pads


def test_a_cylinder(tmp_path: Path) -> None:
    drum = {"kind": "cylinder", "radius": 0.2, "length": 0.3, "mass": 6.0}
    angle = np.deg2rad(80.0)
    place = [float(0.2 * np.cos(angle)), float(0.2 * np.sin(angle)), 0.05]
    found = cell(tmp_path, payload=drum, contacts=[contact(xyz=place), OPPOSITE])
    assert found.payload.shape == Cylinder(0.2, 0.3)
    np.testing.assert_array_equal(found.payload.size, [0.4, 0.4, 0.3])
    across = 6.0 / 12.0 * (3 * 0.2**2 + 0.3**2)
    np.testing.assert_allclose(found.payload.inertia, np.diag([across, across, 3.0 * 0.2**2]))
    normal = found.contacts[0].T_box_pad[:3, 2]
    np.testing.assert_allclose(normal, [-np.cos(angle), -np.sin(angle), 0.0], atol=1e-12)
    end = contact(xyz=[0.05, 0.0, 0.15])
    contacts = [end, contact(xyz=[0.05, 0.0, -0.15])]
    low = {"goal": [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]}  # within reach from above
    found = cell(tmp_path, payload=drum, contacts=contacts, task=low)
    np.testing.assert_array_equal(found.contacts[0].T_box_pad[:3, 2], [0.0, 0.0, -1.0])


def test_a_mesh(tmp_path: Path) -> None:
    """A homogeneous box as a mesh, off its frame, has the box's centre and inertia."""
    solid = trimesh.creation.box(extents=[200.0, 300.0, 100.0])
    solid.apply_translation([10.0, 20.0, 30.0])
    solid.export(tmp_path / "part.stl")
    mesh = {"kind": "mesh", "path": "part.stl", "scale": 0.001, "mass": 6.0}
    pads = [
        contact(xyz=[0.01, 0.17, 0.03], normal=[0, -1, 0]),
        contact(xyz=[0.01, -0.13, 0.03], normal=[0, 1, 0]),
    ]
    found = cell(tmp_path, payload=mesh, contacts=pads)
    assert isinstance(found.payload.shape, Mesh)
    np.testing.assert_allclose(found.payload.size, [0.22, 0.34, 0.16], rtol=1e-6)
    np.testing.assert_allclose(found.payload.centre_of_mass, [0.01, 0.02, 0.03], atol=1e-7)
    expected = 0.5 * np.diag([0.3**2 + 0.1**2, 0.2**2 + 0.1**2, 0.2**2 + 0.3**2])
    np.testing.assert_allclose(found.payload.inertia, expected, rtol=1e-5, atol=1e-9)
    # The mesh is one of the cell's files: it is told apart by its content, and travels with it.
    digest = found.digest
    there = tmp_path / "elsewhere"
    there.mkdir()
    unpacked = unpack_cell(collect_cell(found), there)
    np.testing.assert_array_equal(unpacked.payload.inertia, found.payload.inertia)
    solid.apply_translation([0.0, 0.0, 1.0])
    solid.export(tmp_path / "part.stl")
    assert load(found.source).digest != digest


@pytest.mark.parametrize(
    ("changes", "path", "words"),
    [
        ({"contacts": [contact(normal=[0, 0, 0]), OPPOSITE]}, "contacts[0].normal", "no direction"),
        (
            {"contacts": [contact(xyz=[0, 0.9, 0], normal=[0, -1, 0]), OPPOSITE]},
            "contacts[0].xyz",
            "at most a diagonal of the payload away",
        ),
        (
            {"contacts": [contact(patch_size=[0.1, 0.1]), OPPOSITE]},
            "contacts[0].patch_size",
            "beside",
        ),
        (
            {"contacts": [contact(further=[{"xyz": [0.05, 0.2, 0]}] * 3), OPPOSITE]},
            "contacts",
            "found 5 pads; allowed are 4",
        ),
        (
            {"contacts": [contact(xyz=[0.15, 0, 0]), OPPOSITE]},
            "contacts",
            "do not close their grasp",
        ),
        (
            {"contacts": [contact(xyz=[0.15, 0, 0]), OPPOSITE], "task": {"allocation": "paper"}},
            "contacts[1].xyz",
            "task.allocation = 'soft-finger' and 'joint' take any",
        ),
        (
            {
                "contacts": [contact(further=[{"xyz": [0.05, 0.2, 0]}]), OPPOSITE],
                "task": {"allocation": "paper"},
            },
            "contacts[1].xyz",
            "more than two pads",
        ),
        (
            {"payload": {"kind": "drum", "mass": 1.0}},
            "payload.kind",
            "allowed is one of 'box', 'cylinder', 'mesh'",
        ),
        (
            {"payload": {"kind": "cylinder", "radius": 0.25, "length": 0.3, "mass": 6.0}},
            "contacts[0].xyz",
            "or a normal of its own",
        ),
    ],
)
def test_refuses(changes: dict[str, Any], path: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(WorkcellError) as caught:
        cell(tmp_path, **changes)
    found = [problem for problem in caught.value.problems if problem.startswith(f"{path}: ")]
    assert any(words in problem for problem in found), caught.value.problems
