"""Packages found as ROS finds them, in folders made for the test."""

from __future__ import annotations

from pathlib import Path

import pytest

from symbolic.read.descriptions import find_package, further_package_dirs, resolve_mesh
from tests.robots import ur10_urdf

NOWHERE = Path("/nowhere/arm.urdf")


@pytest.fixture(autouse=True)
def no_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)


def package(folder: Path, name: str = "") -> Path:
    folder.mkdir(parents=True)
    text = f"<package><name>{name}</name></package>" if name else "<package/>"
    (folder / "package.xml").write_text(text, encoding="utf-8")
    return folder


def test_given_folders_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given, ament = package(tmp_path / "a" / "arm"), package(tmp_path / "b" / "share" / "arm")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nothing:{tmp_path / 'b'}")
    assert find_package("arm", [tmp_path / "a"], NOWHERE) == given
    assert find_package("arm", [], NOWHERE) == ament


def test_a_workspace_is_searched_below_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = package(tmp_path / "src" / "vendor" / "arm")
    package(tmp_path / "src" / "build" / "arm_2")
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path / 'src'}")
    assert find_package("arm", [], NOWHERE) == deep
    assert find_package("arm_2", [], NOWHERE) is None
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(deep))
    assert find_package("arm", [], NOWHERE) == deep


def test_a_description_lies_in_its_own_package(tmp_path: Path) -> None:
    own = package(tmp_path / "arm_description")
    assert find_package("arm_description", [], own / "urdf" / "arm.urdf") == own


def test_a_source_folder_may_bear_another_name_than_its_package(tmp_path: Path) -> None:
    """As moveit_resources/panda_description, the package moveit_resources_panda_description."""
    arm = package(tmp_path / "src" / "arm", "vendor_arm")
    (arm / "arm.stl").write_bytes(b"solid")
    assert find_package("vendor_arm", [tmp_path / "src"], NOWHERE) == arm
    assert find_package("vendor_arm", [], arm / "urdf" / "arm.urdf") == arm
    assert find_package("vendor", [tmp_path / "src"], NOWHERE) is None
    address = "package://vendor_arm/arm.stl"
    assert resolve_mesh(address, NOWHERE, [tmp_path / "src"]) == (arm / "arm.stl").resolve()
    assert further_package_dirs([address], [], arm / "arm.urdf") == (tmp_path / "src",)
    package(tmp_path / "src" / "vendor_arm")
    assert find_package("vendor_arm", [tmp_path / "src"], NOWHERE) == arm.with_name("vendor_arm")


def test_packages_of_the_python_environment_are_found() -> None:
    found = find_package("example-robot-data", [], NOWHERE)
    assert found is not None
    assert ur10_urdf().is_relative_to(found)


@pytest.mark.parametrize("name", ["", "..", "../arm", "/etc", ".", "a" * 100_000])
def test_no_name_leads_elsewhere(name: str) -> None:
    assert find_package(name, [Path("/")], NOWHERE) is None


def test_only_what_is_missing_is_added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package(tmp_path / "given" / "one")
    package(tmp_path / "ament" / "share" / "two")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "ament"))
    addresses = ["package://one/a.stl", "package://two/b.stl", "package://three/c.stl", "d.stl"]
    found = further_package_dirs(addresses, [tmp_path / "given"], NOWHERE)
    assert found == (tmp_path / "ament" / "share",)
