"""Robots by the names that two packages give them, without a network."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from robot_descriptions._repositories import REPOSITORIES

from symbolic.errors import OutsideError, WorkcellError
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell, unpack_cell
from symbolic.read.named_robots import named_robot
from symbolic.read.urdf import read_urdf
from tests.robots import ur10_urdf
from tests.symbolic.cells import RACK

XACRO = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:arg name="ur_type" default="none"/><link name="$(arg ur_type)"/></robot>"""


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty cache of downloads, and a proxy that answers nobody."""
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path))
    monkeypatch.setenv("https_proxy", "http://127.0.0.1:9")
    monkeypatch.delitem(sys.modules, "robot_descriptions.ur10e_description", raising=False)
    return tmp_path


def test_files_of_an_installed_wheel() -> None:
    assert named_robot("ur10_robot").path == ur10_urdf()
    assert named_robot("ur10").path == ur10_urdf()


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("ur10_robt", "did you mean 'ur10_robot'"),
        ("ur10f_description", "did you mean 'ur10e_description'"),
        ("../ur10", "is no name"),
    ],
)
def test_what_has_no_such_name(name: str, told: str) -> None:
    with pytest.raises(OutsideError, match=told):
        named_robot(name)


def test_a_failed_download_is_one_message(no_network: Path) -> None:
    with pytest.raises(OutsideError, match="is the network reachable, and git installed") as told:
        named_robot("ur10e_description")
    assert "\n" not in str(told.value)


def test_a_clone_in_the_cache_is_used(no_network: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*words: str) -> str:
        who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        done = subprocess.run(
            ["git", "-C", str(clone), *who, *words], capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

    place = REPOSITORIES["Universal_Robots_ROS2_Description"].cache_path
    clone = no_network / "first"
    (clone / "urdf").mkdir(parents=True)
    (clone / "urdf" / "ur.urdf.xacro").write_text(XACRO, encoding="utf-8")
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "as downloaded")
    commit = git("rev-parse", "HEAD")
    (no_network / f"{place}-{commit}").mkdir()
    clone.rename(no_network / f"{place}-{commit}" / place)
    monkeypatch.setenv("ROBOT_DESCRIPTION_COMMIT", commit)
    found = named_robot("ur10e_description")
    # The links are those of the macro with the module's own arguments.
    assert read_urdf(found.path, found.arguments, found.package_dirs).links == ("ur10e",)


def by_name(folder: Path, name: str) -> Path:
    """The rack with robots by name, whatever they are there."""
    text = RACK.read_text(encoding="utf-8")
    path = folder / "cell.toml"
    key = 'urdf = "../robots/gofa12.urdf"'
    assert text.count(key) == 2
    path.write_text(text.replace(key, f"robot = '{name}'  # by name"), encoding="utf-8")
    return path


def test_a_cell_is_that_of_the_file_and_travels_without_the_name(tmp_path: Path) -> None:
    cell = load(by_name(tmp_path, "ur10"))
    assert cell.robots[0].urdf == ur10_urdf()
    stored = collect_cell(cell)
    (tmp_path / "unpacked").mkdir()
    unpacked = unpack_cell(stored, tmp_path / "unpacked")
    assert unpacked.robots[0].urdf.is_relative_to(tmp_path)
    assert b"robot = " not in stored.files[stored.workcell]


def test_a_name_that_is_none_is_told_with_its_key(tmp_path: Path) -> None:
    with pytest.raises(WorkcellError, match=r"robots\[0\].urdf: robot = 'ur11' is the name of no"):
        load(by_name(tmp_path, "ur11"))


def test_a_name_beside_a_file_is_refused(tmp_path: Path) -> None:
    path = by_name(tmp_path, "ur10")
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("# by name", "\nurdf = 'a.urdf'", 1), encoding="utf-8")
    with pytest.raises(WorkcellError, match=r"robots\[0\].urdf: found beside 'robot'"):
        load(path)
