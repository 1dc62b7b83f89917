"""The digest follows the content of every named file, and nothing else."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import trimesh

from symbolic.workcell.file import load
from symbolic.workcell.records import Mesh
from tests.symbolic.workcell.samples import GOFA, sample_data, write

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


def test_digest_does_not_depend_on_the_place(tmp_path: Path) -> None:
    path = make_cell(tmp_path / "cell")
    shutil.copytree(tmp_path / "cell", tmp_path / "elsewhere")
    assert load(tmp_path / "elsewhere" / "cell.toml").digest == load(path).digest


def test_swapped_meshes_are_another_cell(tmp_path: Path) -> None:
    path = make_cell(tmp_path / "cell")
    shapes = tmp_path / "cell" / "shapes"
    trimesh.creation.icosphere(radius=0.1).export(shapes / "tool.stl")
    before = load(path).digest
    (shapes / "tool.stl").rename(shapes / "other.stl")
    (shapes / "stored.stl").rename(shapes / "tool.stl")
    (shapes / "other.stl").rename(shapes / "stored.stl")
    assert load(path).digest != before
