"""Workcells packed with their files, unpacked elsewhere, and files that mean harm."""

from __future__ import annotations

import base64
import hashlib
import json
import shutil
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import trimesh

from symbolic.errors import BundleError
from symbolic.read.arms import robot_urdf
from symbolic.read.cell import load
from symbolic.read.cell_files import (
    CellFiles,
    cell_from_json,
    cell_to_json,
    collect_cell,
    unpack_cell,
)
from symbolic.read.descriptions import resolve_mesh
from symbolic.records import Mesh, Workcell
from tests.machines import ur10_urdf
from tests.refusals import refused
from tests.symbolic.cells import GOFA, RACK, rack_cell

BODY = '\n[[environment]]\nname = "stone"\nkind = "mesh"\npath = {path}\nxyz = [2.0, 2.0, 0.0]\n'


def round_trip(workcell: Workcell, folder: Path) -> tuple[Workcell, CellFiles]:
    text = json.dumps(cell_to_json(collect_cell(workcell)))
    stored = cell_from_json(json.loads(text))
    return unpack_cell(stored, folder), stored


def write_cell(folder: Path, mesh: str, urdf: str = "../robots/gofa12.urdf") -> Path:
    """The rack with a mesh, in folder/cells, its URDF in folder/robots."""
    (folder / "cells").mkdir(parents=True)
    (folder / "robots").mkdir()
    shutil.copy(GOFA, folder / "robots" / "gofa12.urdf")
    text = RACK.read_text(encoding="utf-8").replace("../robots/gofa12.urdf", urdf)
    path = folder / "cells" / "cell.toml"
    path.write_text(text + BODY.format(path=mesh), encoding="utf-8")
    return path


def test_the_rack_survives_with_its_digest(tmp_path: Path) -> None:
    cell = rack_cell()
    unpacked, stored = round_trip(cell, tmp_path)
    assert unpacked.digest == cell.digest
    assert unpacked.source.is_relative_to(tmp_path)
    assert all(robot.urdf.is_relative_to(tmp_path) for robot in unpacked.robots)
    assert str(RACK.parent) not in json.dumps(cell_to_json(stored))


def test_absolute_references_become_relative(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    mesh = here / "stone.stl"
    path = write_cell(here, f"'{mesh}'", urdf=str(here / "robots" / "gofa12.urdf"))
    trimesh.creation.box((0.1, 0.1, 0.1)).export(mesh)
    unpacked, stored = round_trip(load(path), there)
    assert str(here) not in stored.files[stored.workcell].decode()
    shutil.rmtree(here)
    assert unpack_cell(stored, tmp_path / "again").name == unpacked.name


def test_meshes_of_the_cell_and_of_a_urdf_travel_along(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    path = write_cell(here, '"../meshes/deep/stone.stl"')
    stone = here / "meshes" / "deep" / "stone.stl"
    for mesh in (stone, here / "robots" / "near.stl", here / "packages" / "gofa" / "far.stl"):
        mesh.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.icosphere(radius=0.1).export(mesh)
    urdf = here / "robots" / "gofa12.urdf"
    box = '<geometry><box size="0.205 0.2 0.03"/></geometry>'
    visual, collision = "near.stl", "package://gofa/far.stl"
    text = urdf.read_text(encoding="utf-8")
    assert text.count(box) == 2
    for address in (visual, collision):
        text = text.replace(box, f'<geometry><mesh filename="{address}"/></geometry>', 1)
    urdf.write_text(text, encoding="utf-8")
    cell_text = path.read_text(encoding="utf-8")
    line = 'urdf = "../robots/gofa12.urdf"\n'
    path.write_text(cell_text.replace(line, line + 'package_dirs = ["../packages"]\n'))
    cell = load(path)
    unpacked, stored = round_trip(cell, there)
    assert unpacked.digest == cell.digest
    assert {name.split("/")[-1] for name in stored.files} >= {"near.stl", "far.stl"}
    shape = unpacked.environment[-1].shape
    assert isinstance(shape, Mesh)
    assert shape.path.is_relative_to(there)
    assert shape.path.read_bytes() == stone.read_bytes()


@pytest.mark.parametrize("folder", [".", "./", "..", "../..", "packages/..", "C:files", "a\\b"])
def test_package_folders_are_stored_wherever_they_lie(folder: str, tmp_path: Path) -> None:
    """The workcell file's own folder, folders above it, and names that only some systems take."""
    here = tmp_path / "deep" / "here"
    path = write_cell(here, '"stone.stl"')
    cells = path.parent
    for inside in ("packages", folder):
        (cells / inside).mkdir(exist_ok=True)
    meshes = (cells / "stone.stl", cells / folder / "gofa" / "far:mesh.stl")
    for mesh in meshes:
        mesh.parent.mkdir(exist_ok=True)
        trimesh.creation.icosphere(radius=0.1).export(mesh)
    urdf = here / "robots" / "gofa12.urdf"
    box = '<geometry><box size="0.205 0.2 0.03"/></geometry>'
    address = '<geometry><mesh filename="package://gofa/far:mesh.stl"/></geometry>'
    urdf.write_text(urdf.read_text(encoding="utf-8").replace(box, address), encoding="utf-8")
    line = 'urdf = "packages/../../robots/gofa12.urdf"\n'
    text = path.read_text(encoding="utf-8").replace('urdf = "../robots/gofa12.urdf"\n', line)
    path.write_text(
        text.replace(line, f"{line}package_dirs = [{json.dumps(folder)}]\n"), encoding="utf-8"
    )
    unpacked, stored = round_trip(load(path), tmp_path / "there")
    assert not {".", ".."} & set(stored.folders)
    robot = unpacked.robots[0]
    for address in robot_urdf(robot).collision_meshes:
        found = resolve_mesh(address, robot.urdf, robot.package_dirs)
        assert found is not None
        assert found.is_relative_to(tmp_path / "there")
        assert found.read_bytes() == meshes[1].read_bytes()


def test_a_workcell_changed_in_memory_or_on_disk_is_refused(tmp_path: Path) -> None:
    path = write_cell(tmp_path, '"stone.stl"')
    trimesh.creation.box((0.1, 0.1, 0.1)).export(path.parent / "stone.stl")
    cell = load(path)
    with refused(BundleError, "changed-in-memory"):
        collect_cell(replace(cell, payload=replace(cell.payload, mass=11.0)))
    path.write_text(path.read_text(encoding="utf-8") + "# later\n", encoding="utf-8")
    with refused(BundleError, "changed-in-memory"):
        collect_cell(cell)


def entry(name: str, content: bytes) -> dict[str, str]:
    return {
        "path": name,
        "sha256": hashlib.sha256(content).hexdigest(),
        "encoding": "zlib+base64",
        "content": base64.b64encode(zlib.compress(content)).decode(),
    }


def document(**changes: Any) -> dict[str, Any]:
    return cell_to_json(collect_cell(rack_cell())) | changes


@pytest.mark.parametrize(
    "name",
    ["../evil", "/etc/evil", "a/../../evil", "a//b", "", ".", "a\\b", "C:evil", "a\0b", "a/./b"],
)
def test_paths_that_leave_the_folder_are_refused(name: str, tmp_path: Path) -> None:
    data = document()
    data["files"] = [*data["files"], entry(name, b"x")]
    last = len(data["files"]) - 1
    with refused(BundleError, "path", f"cell.files[{last}].path"):
        cell_from_json(data)
    with refused(BundleError, "path", "cell.files"):
        unpack_cell(CellFiles("a", {"a": b"", name: b""}, (), ""), tmp_path)
    with refused(BundleError, "path", "cell.folders"):
        unpack_cell(CellFiles("a", {"a": b""}, (name,), ""), tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ('urdf = "../robots/gofa12.urdf"', 'urdf = "/etc/passwd"', "not-stored"),
        ('urdf = "../robots/gofa12.urdf"', 'urdf = "../../../etc/passwd"', "not-stored"),
        ("urdf =", "arm =", "missing-key"),
        ("[[robots]]", "[[robots", "not-toml"),
        ("mass = 10.0", "mass = -10.0", "workcell"),
        ("mass = 10.0", "mass = 10.5", "digest"),
    ],
)
def test_a_tampered_workcell_is_refused(old: str, new: str, code: str, tmp_path: Path) -> None:
    stored = collect_cell(rack_cell())
    text = stored.files[stored.workcell].decode()
    assert old in text
    files = {**stored.files, stored.workcell: text.replace(old, new).encode()}
    with refused(BundleError, code):
        unpack_cell(replace(stored, files=files), tmp_path)


def test_a_urdf_that_names_files_outside_is_refused(tmp_path: Path) -> None:
    stored = collect_cell(rack_cell())
    (urdf,) = (name for name in stored.files if name.endswith(".urdf"))
    box = b'<box size="0.205 0.2 0.03"/>'
    # A character reference must not hide the path.
    for address in (b"/etc/passwd", b"&#46;./../../x.stl", b"file:///etc/passwd"):
        bad = stored.files[urdf].replace(box, b'<mesh filename="' + address + b'"/>')
        folder = tmp_path / hashlib.sha256(address).hexdigest()
        with refused(BundleError, "not-stored"):
            unpack_cell(replace(stored, files={**stored.files, urdf: bad}), folder)


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"sha256": "0" * 64}, "damaged"),
        ({"encoding": "pickle"}, "field"),
        (entry("bomb", b"x") | {"content": "!!!"}, "not-decodable"),
        (entry("bomb", bytes(10**8)), "too-large"),
    ],
)
def test_damaged_and_exploding_content_is_refused(
    changes: dict[str, str], code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("symbolic.read.cell_files.MAX_TOTAL_BYTES", 10**6)
    data = document()
    data["files"][0] |= changes
    with refused(BundleError, code):
        cell_from_json(data)


@pytest.mark.parametrize(
    "changes",
    [
        {"files": []},
        {"files": "x"},
        {"files": [1]},
        {"folders": [1]},
        {"folders": "x"},
        {"workcell": 1},
        {"workcell": "missing"},
        {"digest": None},
        {"more": 1},
    ],
)
def test_wrong_fields_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(BundleError, match="cell"):
        cell_from_json(document(**changes))


def test_xacro_and_packages_of_this_machine_become_part_of_the_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    path = write_cell(here, '"stone.stl"')
    package = here / "ros" / "share" / "gofa"
    package.mkdir(parents=True)
    for mesh in (here / "cells" / "stone.stl", package / "base.stl"):
        trimesh.creation.box((0.1, 0.1, 0.1)).export(mesh)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(here / "ros"))
    urdf = here / "robots" / "gofa12.urdf"
    text = urdf.read_text(encoding="utf-8")
    box = '<box size="0.205 0.2 0.03"/>'
    text = text.replace(box, '<mesh filename="package://$(arg package)/base.stl"/>')
    text = text.replace("<link", '<xacro:arg name="package" default="none"/><link', 1)
    name = 'xmlns:xacro="http://www.ros.org/wiki/xacro" name='
    urdf.write_text(text.replace("name=", name, 1), encoding="utf-8")
    srdf = '<robot><disable_collisions link1="link_1" link2="link_4"/></robot>'
    (here / "cells" / "gofa.srdf").write_text(srdf, encoding="utf-8")
    line = 'urdf = "../robots/gofa12.urdf"\n'
    more = 'xacro_arguments = { package = "gofa" }\nsrdf = "gofa.srdf"\n'
    path.write_text(path.read_text(encoding="utf-8").replace(line, line + more), encoding="utf-8")
    _, stored = round_trip(load(path), tmp_path / "there")
    shutil.rmtree(here)
    monkeypatch.delenv("AMENT_PREFIX_PATH")
    unpacked = unpack_cell(stored, tmp_path / "again")
    assert load(unpacked.source).digest == unpacked.digest  # as a file of its own, too
    (address,) = robot_urdf(unpacked.robots[0]).collision_meshes
    assert "package://" not in address
    assert str(here) not in json.dumps(cell_to_json(stored))
    harmful = {
        name: content.replace(b"<link", b'<link name="${1}"/><link').replace(
            b"<robot ", b'<robot xmlns:xacro="http://www.ros.org/wiki/xacro" '
        )
        if name.endswith(".urdf")
        else content
        for name, content in stored.files.items()
    }
    with refused(BundleError, "xacro-macros"):
        unpack_cell(replace(stored, files=harmful), tmp_path / "harm")


ROBOTS = "package://example-robot-data/robots/ur_description"


def test_a_robot_of_a_package_travels_along(tmp_path: Path) -> None:
    """Also one by its name, which the stored file does not have."""
    own, text = 'urdf = "../robots/gofa12.urdf"', RACK.read_text(encoding="utf-8")
    text = text.replace(own, f'urdf = "{ROBOTS}/urdf/ur10_robot.urdf"', 1)
    text = text.replace(own, "robot = 'ur10'  # by name")
    line = 'flange = "tool0"\n'
    text = text.replace(line, f'{line}srdf = "{ROBOTS}/srdf/ur5.srdf"\n')
    path = tmp_path / "cell.toml"
    path.write_text(text, encoding="utf-8")
    cell = load(path)
    assert all(robot.urdf == ur10_urdf() for robot in cell.robots)
    unpacked, stored = round_trip(cell, tmp_path / "there")
    for word in (b"package://", b"robot = "):
        assert word not in stored.files[stored.workcell]
    for robot in unpacked.robots:
        assert robot.urdf.is_relative_to(tmp_path)
        assert robot.srdf is not None
        assert robot.srdf.is_relative_to(tmp_path)
        assert all(
            resolve_mesh(address, robot.urdf, ()) for address in robot_urdf(robot).collision_meshes
        )
