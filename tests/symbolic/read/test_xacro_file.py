"""xacro files as they expand, held to URDFs written by hand."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from symbolic.errors import OutsideError, UrdfError
from symbolic.read import descriptions
from symbolic.read.arms import RobotModelWarning
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell, unpack_cell
from symbolic.read.descriptions import description_content, is_xacro, nominal_kinematics
from symbolic.read.editing import completed, with_paths
from symbolic.read.robots import _warn_nominal
from symbolic.read.urdf import read_urdf
from tests.refusals import refused
from tests.symbolic.cells import GOFA
from tests.symbolic.read.samples import sample_data

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


@pytest.mark.parametrize("wiki", ["www.ros.org/wiki", "wiki.ros.org", "ros.org/wiki"])
def test_the_wiki_goes_by_several_names(tmp_path: Path, wiki: str) -> None:
    path = write(tmp_path, '<link name="${1 + 1}"/>')
    path.write_text(path.read_text().replace("www.ros.org/wiki", wiki))
    assert '"2"' in read_urdf(path).kinematics


def test_an_include_is_looked_for_and_read_again(tmp_path: Path) -> None:
    body = '<xacro:include filename="more.xacro" optional="true"/><link name="base"/>'
    path = write(tmp_path, body)
    assert b"tool" not in description_content(path)
    for name in ("tool", "other tool"):
        write(tmp_path, f'<link name="{name}"/>', "more.xacro")
        assert f'"{name}"'.encode() in description_content(path)


def test_found_packages_leave_no_folder_in_mesh_addresses(tmp_path: Path) -> None:
    (tmp_path / "packages" / "arm").mkdir(parents=True)
    mesh = LINK.format(name="base", mesh="file://$(find arm)/meshes/base.stl") + "</link>"
    path = write(tmp_path, mesh)
    urdf = read_urdf(path, package_dirs=[tmp_path / "packages"])
    assert urdf.collision_meshes == ("package://arm/meshes/base.stl",)
    with refused(UrdfError, "package-not-found", "'arm'"):
        read_urdf(path)


@pytest.mark.parametrize(
    "body",
    [
        '<link name="${unknown}"/>',
        "<xacro:unknown/>",
        '<xacro:include filename="gone.xacro"/>',
        '<link name="$(arg unknown)"/>',
        "<link name='${__import__(\"os\").getcwd()}'/>",
        '<link name="$(env NO_SUCH_VARIABLE)"/>',
        f'<link name="{"$" * 10_000}"/>',
        "<link",
    ],
)
def test_what_cannot_be_expanded_is_told_in_one_line(tmp_path: Path, body: str) -> None:
    path = write(tmp_path, body + '<xacro:if value="1"/>')
    with refused(OutsideError, "not-expandable") as caught:
        description_content(path)
    assert "\n" not in str(caught.value)


def macros(depth: int) -> str:
    """Macros each of which calls the next one twice."""
    calls = (
        f'<xacro:macro name="m{k}" params=""><xacro:m{k + 1}/><xacro:m{k + 1}/></xacro:macro>'
        for k in range(depth)
    )
    last = f'<xacro:macro name="m{depth}" params=""><link name="l"/></xacro:macro>'
    return f"{''.join(calls)}{last}<xacro:m0/>"


MEMORY, DEPTH, TIME = "too-much-memory", "too-deep", "too-slow"
UNBOUNDED = {
    "text": ("<link name=\"${'x' * 10**10}\"/>", MEMORY),
    "list": ('<link name="${len([0 for k in python.range(10**12)])}"/>', MEMORY),
    "recursion": (
        '<xacro:macro name="a" params=""><xacro:a/></xacro:macro><xacro:a/>',
        DEPTH,
    ),
    "include": ('<xacro:include filename="arm.urdf.xacro"/>', DEPTH),
    "elements": ("<a>" * 20_000 + "${1}" + "</a>" * 20_000, DEPTH),
    "long": ("<link name=\"${'x' * 2**25}\"/>", "too-large"),
    "power": ('<link name="${10**10**10}"/>', TIME),
    "evaluated power": ('<link name="$(eval 10**10**10)"/>', TIME),
    "sum": ('<link name="${python.sum(python.range(10**12))}"/>', TIME),
    "calls": (macros(40), TIME),
    "expressions": ('<link name="' + "${1}" * 500_000 + '"/>', TIME),
}


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=pytest.mark.slow if code == TIME else ())
        for kind, (_, code) in UNBOUNDED.items()
    ],
)
def test_an_expansion_without_end_is_ended(tmp_path: Path, kind: str) -> None:
    body, code = UNBOUNDED[kind]
    path = write(tmp_path, body + '<xacro:if value="1"/>')
    with pytest.raises(OutsideError) as told:
        description_content(path)
    assert told.value.code in ((TIME, MEMORY) if kind == "calls" else (code,)), told.value


def test_an_expansion_that_took_too_long_is_not_begun_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path, UNBOUNDED["sum"][0])
    begun: list[object] = []
    # The process answers nothing where it takes too long.
    monkeypatch.setattr(descriptions, "_answer", begun.append)
    for _ in range(2):
        with refused(OutsideError, TIME):
            description_content(path)
    assert len(begun) == 1


ESCAPED = "python.vars(python.type)['__subclasses__'](python.type(1).mro()[1])"


def test_an_expression_that_finds_a_way_out_does_nothing(tmp_path: Path) -> None:
    """xacro's own guard looks at names only, and not at those within comprehensions."""
    target = tmp_path / "written"
    found = f"[c for c in {ESCAPED} if c.__name__ == '_wrap_close']"
    deed = f"[c.__init__.__globals__['system']('touch {target}') for c in {found}]"
    with refused(OutsideError, "not-arithmetic"):
        description_content(write(tmp_path, f'<link name="${{{deed}}}"/>'))
    assert not target.exists()


def test_values_and_includes_are_read_through_the_door(tmp_path: Path) -> None:
    (tmp_path / "values.yaml").write_text("link: base")
    os.mkfifo(tmp_path / "pipe")
    values = "<link name=\"${xacro.load_yaml('values.yaml')['link']}\"/>"
    assert b'name="base"' in description_content(write(tmp_path, values))
    for body, name in (
        (values.replace("values.yaml", "/dev/zero"), "zero"),
        ('<xacro:include filename="pipe"/>', "pipe"),
    ):
        with refused(OutsideError, "no-regular-file", name):
            description_content(write(tmp_path, body))


def test_generated_urdfs_that_keep_the_namespace_are_read_as_they_are(tmp_path: Path) -> None:
    path = write(tmp_path, '<link name="base"/>', "arm.urdf")
    assert not is_xacro(path.read_bytes())
    assert description_content(path) == path.read_bytes()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, "kinematics_params"),
        ({"kinematics_params": "config/ur5e/default_kinematics.yaml"}, "kinematics_params"),
        ({"kinematics_params": "my_robot_calibration.yaml"}, ""),
        ({"tool": "cup"}, "kinematics_params"),
    ],
)
def test_a_calibration_that_is_not_given_is_told(
    given: dict[str, str], expected: str, tmp_path: Path
) -> None:
    """Arguments as in the descriptions of Universal Robots and Elite Robots."""
    path = write(
        tmp_path,
        '<xacro:arg name="tool" default="none"/>\n<xacro:arg\n  name="kinematics_params" '
        'default="$(find arm)/config/default_kinematics.yaml"/><link name="base"/>',
    )
    assert nominal_kinematics(path.read_bytes(), tuple(given.items())) == expected
    other = write(tmp_path, '<xacro:arg name="tool" default="none"/>', "other.xacro")
    assert nominal_kinematics(other.read_bytes(), ()) == ""


def test_paths_in_arguments_are_relative_to_the_workcell_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever the program is started, and after the cell's file moves to another folder."""
    (tmp_path / "robots").mkdir()
    (tmp_path / "cells").mkdir()
    gofa = GOFA.read_text(encoding="utf-8")
    body = gofa[gofa.index(">", gofa.index("<robot")) + 1 : gofa.rindex("</robot>")]
    write(tmp_path / "robots", body, "joints.xacro")
    main = '<xacro:arg name="joints" default=""/><xacro:include filename="$(arg joints)"/>'
    write(tmp_path / "robots", main)
    data = sample_data()
    for robot in data["robots"]:
        robot |= {
            "urdf": "../robots/arm.urdf.xacro",
            "xacro_arguments": {"joints": "../robots/joints.xacro"},
        }
    path = tmp_path / "cells" / "cell.toml"
    path.write_text(completed("", data, {}), encoding="utf-8")
    monkeypatch.chdir("/")
    cell = load(path)
    assert [len(robot.torque_max) for robot in cell.robots] == [6, 6]
    _warn_nominal.cache_clear()
    given = '<xacro:arg name="kinematics_config" default=""/>' + main
    write(tmp_path / "robots", given)
    told = r"'left' .* xacro_arguments\.kinematics_config"
    with pytest.warns(RobotModelWarning, match=told):
        load(path)

    def moved(name: str) -> str:
        return os.path.relpath(path.parent / name, tmp_path)

    other = tmp_path / "cell.toml"
    other.write_text(completed("", data, with_paths(data, moved)), encoding="utf-8")
    assert load(other).robots[0].xacro_arguments == cell.robots[0].xacro_arguments
    stored = unpack_cell(collect_cell(cell), tmp_path / "there")
    assert stored.robots[0].flange == cell.robots[0].flange
