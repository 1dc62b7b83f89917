"""xacro files as they expand, held to URDFs written by hand."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from symbolic.errors import OutsideError, UrdfError
from symbolic.robot.urdf_file import read_urdf
from symbolic.robot.xacro_file import description_content, is_xacro

HEAD = '<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">'
LINK = '<link name="{name}"><collision><geometry><mesh filename="{mesh}"/></geometry></collision>'


def write(folder: Path, body: str, name: str = "arm.urdf.xacro") -> Path:
    path = folder / name
    path.write_text(f"{HEAD}{body}</robot>", encoding="utf-8")
    return path


def test_arguments_and_relative_includes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(
        tmp_path,
        '<xacro:macro name="joint" params="a b"><joint name="${a}_${b}" type="fixed">'
        '<parent link="${a}"/><child link="${b}"/></joint></xacro:macro>',
        "joint.xacro",
    )
    path = write(
        tmp_path,
        '<xacro:arg name="tool" default="tool"/><xacro:include filename="joint.xacro"/>'
        '<link name="base"/><link name="$(arg tool)"/><xacro:joint a="base" b="$(arg tool)"/>',
    )
    monkeypatch.chdir("/")
    assert '"base_tool"' in read_urdf(path).kinematics
    assert '"base_gripper"' in read_urdf(path, (("tool", "gripper"),)).kinematics
    assert str(tmp_path).encode() not in description_content(path)


def test_a_changed_include_is_seen(tmp_path: Path) -> None:
    write(tmp_path, '<link name="one"/>', "links.xacro")
    path = write(tmp_path, '<xacro:include filename="links.xacro"/>')
    assert '"one"' in read_urdf(path).kinematics
    write(tmp_path, '<link name="two"/>', "links.xacro")
    assert '"two"' in read_urdf(path).kinematics


def test_found_packages_leave_no_folder_in_mesh_addresses(tmp_path: Path) -> None:
    (tmp_path / "packages" / "arm").mkdir(parents=True)
    mesh = LINK.format(name="base", mesh="file://$(find arm)/meshes/base.stl") + "</link>"
    path = write(tmp_path, mesh)
    urdf = read_urdf(path, package_dirs=[tmp_path / "packages"])
    assert urdf.collision_meshes == ("package://arm/meshes/base.stl",)
    with pytest.raises(UrdfError, match="names the package 'arm', which is not found"):
        read_urdf(path)


@pytest.mark.parametrize(
    "body",
    [
        '<link name="${unknown}"/>',
        "<xacro:unknown/>",
        '<xacro:include filename="gone.xacro"/>',
        '<link name="$(arg unknown)"/>',
        "<link name='${__import__(\"os\").getcwd()}'/>",
        "<link",
    ],
)
def test_what_cannot_be_expanded_is_told_in_one_line(tmp_path: Path, body: str) -> None:
    path = write(tmp_path, body + '<xacro:if value="1"/>')
    with pytest.raises(OutsideError, match="cannot be expanded: ") as caught:
        description_content(path)
    assert "\n" not in str(caught.value)


def test_generated_urdfs_that_keep_the_namespace_are_read_as_they_are(tmp_path: Path) -> None:
    path = write(tmp_path, '<link name="base"/>', "arm.urdf")
    assert not is_xacro(path.read_bytes())
    assert description_content(path) == path.read_bytes()


def test_an_included_pipe_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    path = tmp_path / "arm.xacro"
    path.write_text(
        '<robot name="a" xmlns:xacro="http://www.ros.org/wiki/xacro">'
        '<xacro:include filename="pipe"/><link name="${1 + 1}"/></robot>'
    )
    with pytest.raises(OutsideError, match="it is a pipe"):
        description_content(path)
