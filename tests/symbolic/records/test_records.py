"""Records: digests, orientations, patterns of names."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from symbolic.errors import WorkcellError
from symbolic.path.spline import extended_waypoints
from symbolic.read.cell import load
from symbolic.records import Mesh, Workcell
from symbolic.records.poses import Orientation, rotation_from_rpy
from symbolic.records.problems import matching
from symbolic.records.task import variable_names
from tests.odd_cells import turned_transfer
from tests.symbolic.read.samples import GOFA, sample_data, write

COLLISION_BOX = '<geometry><box size="0.161 0.093 0.707"/></geometry>'
FILES = (
    "cell.toml",
    "arm.urdf",
    "packages/own/link.stl",
    "shapes/stored.stl",
    "shapes/tool.stl",
)


def make_cell(folder: Path) -> Path:
    """A cell whose URDF, environment and tool all name meshes."""
    folder.mkdir()
    for name in FILES[2:]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box((0.1, 0.1, 0.1)).export(folder / name)
    urdf = GOFA.read_text(encoding="utf-8")
    assert COLLISION_BOX in urdf
    mesh = '<geometry><mesh filename="package://own/link.stl"/></geometry>'
    (folder / "arm.urdf").write_text(urdf.replace(COLLISION_BOX, mesh), encoding="utf-8")
    data = sample_data()
    for robot in data["robots"]:
        robot |= {"urdf": "arm.urdf", "package_dirs": ["packages"]}
    data["environment"].append({"name": "stored", "kind": "mesh", "path": "shapes/stored.stl"})
    data["robots"][1]["tool"].append(
        {"name": "hose", "kind": "mesh", "path": "shapes/tool.stl", "scale": 0.5}
    )
    return write(folder, data)


def test_meshes_are_found(tmp_path: Path) -> None:
    cell = load(make_cell(tmp_path / "cell"))
    stored = cell.environment[-1].shape
    assert isinstance(stored, Mesh)
    assert stored.path == tmp_path / "cell" / "shapes" / "stored.stl"
    assert stored.scale.tolist() == [1.0, 1.0, 1.0]
    hose = cell.robots[1].tool[-1].shape
    assert isinstance(hose, Mesh)
    assert hose.scale.tolist() == [0.5, 0.5, 0.5]
    assert cell.robots[0].package_dirs == (tmp_path / "cell" / "packages",)


@pytest.mark.parametrize("name", FILES)
def test_digest_changes_with_each_file(tmp_path: Path, name: str) -> None:
    path = make_cell(tmp_path / "cell")
    before = load(path).digest
    changed = tmp_path / "cell" / name
    if changed.suffix == ".stl":
        trimesh.creation.box((0.1, 0.1, 0.11)).export(changed)
    else:
        comment = "\n<!-- -->\n" if changed.suffix == ".urdf" else "\n# \n"
        changed.write_text(changed.read_text(encoding="utf-8") + comment, encoding="utf-8")
    assert load(path).digest != before


def test_swapped_meshes_are_another_cell(tmp_path: Path) -> None:
    path = make_cell(tmp_path / "cell")
    shapes = tmp_path / "cell" / "shapes"
    trimesh.creation.icosphere(radius=0.1).export(shapes / "tool.stl")
    before = load(path).digest
    (shapes / "tool.stl").rename(shapes / "other.stl")
    (shapes / "stored.stl").rename(shapes / "tool.stl")
    (shapes / "other.stl").rename(shapes / "stored.stl")
    assert load(path).digest != before


def changed_cells(cell: Workcell) -> dict[str, Workcell]:
    """The cell with one value changed in memory."""
    first, second = cell.robots
    nearer = replace(first, T_world_base=first.T_world_base + 1e-12)
    return {
        "nothing": cell,
        "name": replace(cell, name="other"),
        "time law": replace(cell, task=replace(cell.task, time_law="ramped")),
        "samples": replace(cell, task=replace(cell.task, samples=cell.task.samples + 1)),
        "mass": replace(cell, payload=replace(cell.payload, mass=11.0)),
        "base": replace(cell, robots=(nearer, second)),
        "order": replace(cell, robots=(second, first)),
        "environment": replace(cell, environment=cell.environment[:-1]),
        "tolerance": replace(cell, collision=replace(cell.collision, tolerance=1e-3)),
    }


def test_a_cell_changed_in_memory_is_another_cell_and_the_same_anywhere(tmp_path: Path) -> None:
    """A change that is taken back is none."""
    cell = load(make_cell(tmp_path / "cell"))
    digests = {name: changed.digest for name, changed in changed_cells(cell).items()}
    assert all(len(digest) == 64 for digest in digests.values()), digests
    assert len(set(digests.values())) == len(digests)
    shutil.copytree(tmp_path / "cell", tmp_path / "elsewhere")
    elsewhere = changed_cells(load(tmp_path / "elsewhere" / cell.source.name))
    assert {name: changed.digest for name, changed in elsewhere.items()} == digests
    changed = replace(cell, task=replace(cell.task, samples=11))
    assert replace(changed, task=cell.task).digest == cell.digest
    copied = replace(
        cell.payload, mass=float(str(cell.payload.mass)), size=cell.payload.size.copy()
    )
    assert replace(cell, payload=copied).digest == cell.digest


def test_files_that_were_not_read_identify_nothing(tmp_path: Path) -> None:
    path = make_cell(tmp_path / "cell")
    cell = load(path)
    first, second = cell.robots
    other = replace(first, urdf=path.parent / "other.urdf")
    assert replace(cell, robots=(other, second)).digest == ""
    argued = replace(first, xacro_arguments=(("size", "2"),))
    assert replace(cell, robots=(argued, second)).digest == ""
    assert replace(cell, reading=None).digest == ""


def test_rotation_vectors_count_from_their_reference(tmp_path: Path) -> None:
    path = turned_transfer(tmp_path).source
    reference = "[task]\nrotation_reference = [0.1, 0.2, -0.3]\n"
    path.write_text(path.read_text().replace("[task]\n", reference))
    task = load(path).task
    assert task.orientation.rotation == "quaternion"
    np.testing.assert_array_equal(task.orientation.reference, rotation_from_rpy([0.1, 0.2, -0.3]))
    assert not task.orientation.reference.flags.writeable
    assert variable_names(task)[3:6] == tuple(f"waypoint 1, rotation {axis}" for axis in "xyz")


def test_angles_are_unwrapped_and_rotation_vectors_are_not() -> None:
    jump = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]])
    assert Orientation().unwrapped(jump)[1, 2] == pytest.approx(2.0 * np.pi - 3.0)
    np.testing.assert_array_equal(Orientation("quaternion").unwrapped(jump), jump)


def test_a_path_of_rotation_vectors_is_as_written(tmp_path: Path) -> None:
    path = turned_transfer(tmp_path).source
    text = path.read_text().replace("goal = [0.30, 0.0, 0.90, 0.0,", "goal = [0.3, 0.0, 0.9, -3.5,")
    text = text.replace("start = [-0.30, 0.0, 0.90, 0.0,", "start = [-0.3, 0.0, 0.9, 3.0,")
    path.write_text(text)
    task = load(path).task
    points = extended_waypoints(task, np.array([0.0, 0.0, 0.95, 0.0, 1.5, 0.0]))
    np.testing.assert_array_equal(points[:, 3], [3.0, 0.0, -3.5])


KEY = 'rotation = "quaternion"\n'


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (KEY, 'rotation = "euler"\n', "task.rotation: found 'euler'"),
        (KEY, f"{KEY}rotation_reference = [0, 0, 9]\n", "task.rotation_reference[2]: found 9"),
        (KEY, f"{KEY}rotation_reference = [0, 0]\n", "task.rotation_reference: found [0, 0]"),
        (KEY, "rotation_reference = [0, 0, 0]\n", 'rotation = "quaternion"'),
        ("0.1, 1.8, 0.1]", "3.5, 3.5, 2.0]", " 5.34 rad"),
    ],
)
def test_wrong_rotations_are_told(tmp_path: Path, old: str, new: str, told: str) -> None:
    path = turned_transfer(tmp_path).source
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(WorkcellError) as problem:
        load(path)
    assert told in str(problem.value)


NAMES = ("payload", "left/link_1", "left/link_2", "right/link_1", "odd*name", "odd[1]")


def test_patterns() -> None:
    assert matching("left/*", NAMES) == ("left/link_1", "left/link_2")
    assert matching("*/link_?", NAMES) == NAMES[1:4]
    assert matching("odd*name", NAMES) == ("odd*name",)
    assert matching("odd[1]*", NAMES) == ("odd[1]",)
    assert matching("link", NAMES) == ()


@given(st.lists(st.text("ab*?", min_size=1), min_size=1), st.data())
def test_every_name_is_matched_by_itself(names: list[str], data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(names))
    assert matching(name, names) == (name,)
