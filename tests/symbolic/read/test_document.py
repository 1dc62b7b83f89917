"""Workcell files: read, changed, written and read again."""

from __future__ import annotations

import dataclasses
import re
import tempfile
import tomllib
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from symbolic.array import Range
from symbolic.errors import WorkcellError
from symbolic.read.cell import changed, changed_text, load, stretched_length
from symbolic.read.payload import pad_rotation
from symbolic.records import (
    USUAL_UNCERTAINTY,
    Body,
    Box,
    CollisionSettings,
    Cylinder,
    Handling,
    Payload,
    Sphere,
    Task,
    Uncertainty,
    Workcell,
)
from tests.refusals import refused
from tests.symbolic.cells import rack_cell
from tests.symbolic.read.samples import RACK, STUDIES, cells, numbers, sample_data, write
from tests.symbolic.read.test_problems import put

DOCUMENT = (STUDIES.parent / "docs/reference/workcell.md").read_text(encoding="utf-8")
SECTIONS = (
    "",
    "robots[0].",
    "robots[0].base.",
    "robots[0].tool[0].",
    "payload.",
    "contacts[0].",
    "task.",
    "task.waypoints[0].",
    "task.allowed_contacts[0].",
    "environment[0].",
    "environment[1].",
    "environment[2].",
    "collision.",
    "collision.ignored[0].",
)


def problems(path: Path) -> tuple[str, ...]:
    with pytest.raises(WorkcellError) as caught:
        load(path)
    return caught.value.problems


def test_every_key_is_documented(tmp_path: Path) -> None:
    data = sample_data()
    data["task"]["allowed_contacts"] = [{"body": "ground", "departure": 0.1}]
    data["collision"]["ignored"] = [{"first": "payload", "second": "ground", "reason": "r"}]
    (tmp_path / "m.stl").write_bytes(b"")
    data["environment"][1] = {"name": "a", "kind": "mesh", "path": "m.stl"}
    data["environment"][2] = {"name": "b", "kind": "cylinder", "radius": 1.0, "length": 1.0}
    for section in SECTIONS:
        put(data, f"{section}qqqqqqqq", 1)
    told = problems(write(tmp_path, data))
    assert len(told) == len(SECTIONS)
    keys = {key for text in told for key in text.split("allowed keys are ")[1].split(", ")}
    assert len(keys) > 50
    for key in keys:
        assert re.search(rf"\b{key}\b", DOCUMENT), key


def test_the_messages_shown_are_real(tmp_path: Path) -> None:
    data = sample_data()
    put(data, "payload.size[0]", 300)
    put(data, "task.reference_force", 0.5)
    told = problems(write(tmp_path, data))
    assert len(told) == 2
    for text in told:
        assert f"  - {text}\n" in DOCUMENT


def ranges_in(kind: Any) -> list[Range]:
    if isinstance(kind, Range):
        return [kind]
    return [found for inner in get_args(kind) for found in ranges_in(inner)]


@pytest.mark.parametrize(
    ("section", "record"),
    [
        ("[payload]", Payload),
        ("[task]", Task),
        ("[uncertainty]", Uncertainty),
        ("[handling]", Handling),
        ("[collision]", CollisionSettings),
    ],
)
def test_documented_ranges_and_units_are_those_of_the_records(section: str, record: type) -> None:
    text = DOCUMENT.split(f"## `{section}`")[1].split("\n## ")[0]
    kinds, compared = get_type_hints(record, include_extras=True), 0
    for name, kind in kinds.items():
        row = re.search(rf"^\| `{name}` \|.*$", text, re.MULTILINE)
        told = row and re.search(r"([\d.e-]+)(?: to |–)([\d.e]+)", row[0].split("|")[-2])
        if row is None or told is None:
            continue
        for allowed in ranges_in(kind):
            assert (float(told[1]), float(told[2])) == (allowed.low, allowed.high), name
            assert f"[{allowed.unit}]" in row[0] or not allowed.unit, name
            compared += 1
    assert compared >= 2


TEXT = b"""
name = "a \\"cell\\""
[task]
samples = 100
goal = [0.0, 1e-3, 2]
[[contacts]]
friction = 1.0
[[contacts]]
friction = 2.0
further = [{ xyz = [0, 0, 1], normal = [0.0, 1.0, 0.0] }]
[[environment]]
name = "top board"
xyz = [1.0, 2.0, 3.0]
[[environment]]
name = "v1.5"
kind = "box"
"""


def read(changes: dict[str, Any]) -> dict[str, Any]:
    return tomllib.loads(changed_text(TEXT, changes, "cell.toml").decode())


def test_paths_lead_by_index_by_name_or_to_all() -> None:
    assert read({}) == tomllib.loads(TEXT.decode())
    assert read({"task.samples": 50})["task"]["samples"] == 50
    assert [c["friction"] for c in read({"contacts.friction": 0.5})["contacts"]] == [0.5, 0.5]
    assert [c["friction"] for c in read({"contacts[1].friction": 0.5})["contacts"]] == [1.0, 0.5]
    found = read({"environment.top board.xyz": np.array([0.0, 0.0, 1.0])})["environment"]
    assert found[0]["xyz"] == [0.0, 0.0, 1.0]
    assert "xyz" not in found[1]
    assert read({"environment.v1.5.kind": "sphere"})["environment"][1]["kind"] == "sphere"
    assert read({"uncertainty.friction": 0.1})["uncertainty"] == {"friction": 0.1}
    assert read({"contacts[1].further[0].xyz": [1, 2, 3]})["contacts"][1]["further"][0]["xyz"] == [
        1, 2, 3,
    ]  # fmt: skip


@pytest.mark.parametrize(
    "path", ["", "contacts[2].friction", "task.samples.more", "name.of", "contacts[0]", ".x"]
)
def test_a_path_that_leads_nowhere_is_told(path: str) -> None:
    with pytest.raises(WorkcellError, match=r"cell\.toml"):
        changed_text(TEXT, {path: 1.0}, "cell.toml")


def test_a_changed_cell_is_checked_like_a_file() -> None:
    changes = {"payload.mas": 1.0, "contacts[0].xyz": [0.0, 0.3, 0.0]}
    with refused(WorkcellError, "workcell", "payload.mas: ", "contacts[0].xyz"):
        changed(rack_cell(), changes)


def test_changes_add_up_and_do_not_touch_the_cell(tmp_path: Any) -> None:
    cell = rack_cell()
    lighter = changed(cell, {"payload.mass": 5.0})
    both = changed(lighter, {"contacts.friction": 0.8})
    assert cell.payload.mass == 10.0
    assert (both.payload.mass, both.contacts[1].friction) == (5.0, 0.8)
    assert len({cell.digest, lighter.digest, both.digest}) == 3
    # Solid boxes of another mass have another inertia.
    assert lighter.payload.inertia[0, 0] == pytest.approx(0.5 * cell.payload.inertia[0, 0])
    file = RACK.with_name("never written.toml")
    assert load(file.with_name(RACK.name), text=both.text).digest == both.digest


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


def assert_same(record: Any, data: dict[str, Any], *others: str) -> None:
    """Fields but for some are as the file has them, and as usual where it has none of them."""
    for field in dataclasses.fields(record):
        if field.name in others:
            continue
        usual = field.default
        if usual is dataclasses.MISSING and field.default_factory is not dataclasses.MISSING:
            usual = field.default_factory()
        found, expected = getattr(record, field.name), data.get(field.name, usual)
        if isinstance(found, np.ndarray):
            expected = np.broadcast_to(expected, found.shape)
        np.testing.assert_array_equal(found, expected, err_msg=field.name)


def assert_same_cell(cell: Workcell, data: dict[str, Any]) -> None:
    assert cell.name == data["name"]
    assert cell.start_branch == tuple(r.get("start_branch", -1) for r in data["robots"])
    for robot, entry in zip(cell.robots, data["robots"], strict=True):
        np.testing.assert_allclose(robot.T_world_base, expected_pose(entry["base"]), atol=1e-14)
        np.testing.assert_allclose(robot.T_flange_pad, expected_pose(entry["pad"]), atol=1e-14)
        others = {"urdf", "T_world_base", "T_flange_pad", "tool", "driver"}
        described = {"velocity_max", "torque_max", "position_lower", "position_upper"}
        described |= {"package_dirs", "locked_joints"}
        usual = {"acceleration_max": 5.0, "min_manipulability": 3.2e-3}
        assert_same(robot, usual | entry, *others, *(described - entry.keys()))
        assert_same(robot.driver, entry.get("driver", {}))
        for tool, tool_entry in zip(robot.tool, entry["tool"], strict=True):
            assert_same_body(tool, tool_entry)
    told = {"centre_of_mass": [0, 0, 0]} | data["payload"]
    assert_same(cell.payload, told, *([] if isinstance(told.get("inertia"), list) else ["inertia"]))
    for contact, entry in zip(cell.contacts, data["contacts"], strict=True):
        np.testing.assert_allclose(contact.T_box_pad[:3, 3], entry["xyz"], atol=1e-15)
        assert_same(contact, entry, "T_box_pad")
    assert_same_task(cell, data["task"])
    for body, entry in zip(cell.environment, data["environment"], strict=True):
        assert_same_body(body, entry)
    collision = data.get("collision", {})
    assert_same(cell.collision, collision, "ignored")
    assert [vars(pair) for pair in cell.collision.ignored] == collision.get("ignored", [])
    assert_same(cell.handling, data.get("handling", {}))
    if "uncertainty" in data:
        assert_same(cell.uncertainty, data["uncertainty"])
    else:
        assert cell.uncertainty is USUAL_UNCERTAINTY


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
    still = 1.001 * cell.payload.mass * 9.81 / sum(c.friction for c in cell.contacts)
    usual = [still, max(still, task.reference_force.min())]
    np.testing.assert_allclose(task.force_limit, data.get("force_limit", usual), rtol=1e-15)
    np.testing.assert_allclose(
        task.initial, np.array(data.get("initial", np.mean(free, axis=1))), atol=1e-15
    )
    assert [vars(contact) for contact in task.allowed_contacts] == data["allowed_contacts"]
    others = ("waypoints", "force_limit", "initial", "allowed_contacts", "orientation")
    assert_same(task, data, *others)


@given(cells())
def test_written_cells_are_read_back(data: dict[str, Any]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        cell = load(write(Path(folder), data))
    assert_same_cell(cell, data)


@given(st.integers(0, 2), st.sampled_from([-1, 1]), numbers(-6, 6))
def test_pad_rotation(axis: int, side: int, spin: float) -> None:
    rotation = pad_rotation(-side * np.eye(3)[axis], spin)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    inward = np.zeros(3)
    inward[axis] = -side
    np.testing.assert_array_equal(rotation[:, 2], inward)
    # Turning back about the inward normal restores the documented x axis.
    zero_spin = Rotation.from_rotvec(-spin * inward).as_matrix() @ rotation
    expected = [1, 0, 0] if axis == 2 else [0, 0, 1]
    np.testing.assert_allclose(zero_spin[:, 0], expected, atol=1e-14)


def test_contact_is_moved_onto_its_face(tmp_path: Path) -> None:
    data = sample_data()
    data["contacts"][0]["xyz"] = [0.01, 0.2 + 9e-7, -0.02]
    cell = load(write(tmp_path, data))
    assert cell.contacts[0].T_box_pad[:3, 3].tolist() == [0.01, 0.2, -0.02]


def test_stretched_length_is_the_sum_of_the_links() -> None:
    robot = rack_cell().robots[0]
    shoulder, length = stretched_length(robot)
    above = shoulder - robot.T_world_base[:3, 3]
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


def test_arrays_are_read_only() -> None:
    arrays = arrays_in(rack_cell())
    assert len(arrays) > 40
    for array in arrays:
        assert array.dtype == np.float64
        assert not array.flags.writeable
