"""Bodies of another program's scene, printed and added to a file."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from studies.program import BAD_INPUT
from studies.scene import main
from symbolic.read.cell import load
from symbolic.records import Mesh

SHELF = """<sdf version='1.9'><model name='shelf'><static>true</static><link name='board'>
<collision name='top'><pose>0 0 3 0 0 0</pose>
<geometry><box><size>1 0.3 0.02</size></box></geometry></collision>
</link></model></sdf>"""
BOARD = {"name": "shelf board top", "kind": "box", "size": [1.0, 0.3, 0.02], "xyz": [0.0, 0.0, 3.0]}


@pytest.fixture
def shelf(tmp_path: Path) -> Path:
    path = tmp_path / "shelf.sdf"
    path.write_text(SHELF, encoding="utf-8")
    return path


def test_bodies_are_printed(shelf: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(shelf)]) == 0
    assert tomllib.loads(capsys.readouterr().out) == {"environment": [BOARD]}


def test_bodies_are_added_to_a_cell_that_loads(
    shelf: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every line of the file stays; what is there already is not added again."""
    before = Path("studies/workcells/transfer.toml").read_text(encoding="utf-8")
    before = before.replace("../robots", str(Path("studies/robots").resolve()))
    path = shelf.with_name("cell.toml")
    path.write_text(before, encoding="utf-8")
    assert main([str(shelf), "--into", str(path)]) == 0
    after = path.read_text(encoding="utf-8")
    added = after.splitlines()
    for line in before.splitlines():
        added.remove(line)
    assert tomllib.loads("\n".join(added)) == {"environment": [BOARD]}
    assert load(path).environment[-1].name == "shelf board top"
    capsys.readouterr()
    assert main([str(shelf), "--into", str(path)]) == BAD_INPUT
    assert "'shelf board top' already" in capsys.readouterr().err
    assert path.read_text(encoding="utf-8") == after


def test_a_file_without_obstacles_gets_some(shelf: Path) -> None:
    path = shelf.with_name("cell.toml")
    path.write_text('name = "a"  # of mine\n', encoding="utf-8")
    assert main([str(shelf), "--into", str(path)]) == 0
    assert path.read_text(encoding="utf-8").startswith('name = "a"  # of mine\n\n[[environment]]\n')


def test_what_is_left_out_is_told_by_the_code(
    shelf: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shelf.write_text(SHELF.replace("<box><size>1 0.3 0.02</size></box>", "<heightmap/>"))
    assert main([str(shelf)]) == 1
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("left out: shelf board top: ")


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        (None, "cell.toml: cannot be read"),
        ("name = ", "cell.toml: not valid TOML"),
        ("environment = []\n", "cannot be completed as it is written"),
        ("environment = 3\n", "cannot be completed as it is written"),
    ],
)
def test_a_file_that_takes_none_is_left_alone(
    shelf: Path, cell: str | None, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = shelf.with_name("cell.toml")
    if cell is not None:
        path.write_text(cell, encoding="utf-8")
    assert main([str(shelf), "--into", str(path)]) == BAD_INPUT
    told = capsys.readouterr().err
    assert words in told
    assert len(told.splitlines()) == 1
    assert (path.read_text() if path.exists() else None) == cell


def test_meshes_of_the_scene_become_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    corners = "[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]"
    faces = "[[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]"
    path = tmp_path / "scene.yaml"
    path.write_text(
        "world: {collision_objects: [{id: a/b, meshes: "
        f"[{{vertices: {corners}, triangles: {faces}}}]}}]}}"
    )
    assert main([str(path)]) == BAD_INPUT
    assert "--into" in capsys.readouterr().err
    before = Path("studies/workcells/transfer.toml").read_text(encoding="utf-8")
    cell = tmp_path / "cell.toml"
    cell.write_text(before.replace("../robots", str(Path("studies/robots").resolve())))
    assert main([str(path), "--into", str(cell)]) == 0
    shape = load(cell).environment[-1].shape
    assert isinstance(shape, Mesh)
    assert shape.path == tmp_path / "cell-meshes" / "1-a-b.stl"
