"""URDF and SRDF files: what is read, and what is refused by name."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from robot_descriptions._repositories import REPOSITORIES

from symbolic.errors import OutsideError, UrdfError
from symbolic.read.arms import arm_model, link_frame, reduced_model
from symbolic.read.descriptions import find_package, further_package_dirs, resolve_mesh
from symbolic.read.robots import named_robot
from symbolic.read.urdf import MOST_LINKS, parse_urdf, read_srdf, read_urdf
from symbolic.records import IgnoredPair
from tests.machines import robot_record, ur10_urdf
from tests.refusals import refused
from tests.symbolic.read.samples import GOFA
from tests.waiting import soon


def swap(old: str, new: str, count: int = 1) -> Callable[[str], str]:
    return lambda text: text.replace(old, new, count)


def mass(value: str) -> Callable[[str], str]:
    return swap('<mass value="8.411"/>', f'<mass value="{value}"/>')


def inertia(moments: str) -> Callable[[str], str]:
    own = 'ixx="0.0486" ixy="0" ixz="0" iyy="0.0378" iyz="-0.0008" izz="0.0394"'
    return swap(own, moments)


def child(of: str, other: str) -> Callable[[str], str]:
    return swap(f'<child link="{of}"/>', f'<child link="{other}"/>')


def axis(numbers: str) -> Callable[[str], str]:
    return swap('<axis xyz="0 1 0"/>', f'<axis xyz="{numbers}"/>')


def beside(more: str) -> Callable[[str], str]:
    return swap("</robot>", f"{more}</robot>")


def shape(instead: str) -> Callable[[str], str]:
    """Another shape in the first collision element of `base_link`."""
    before = '<collision>\n      <origin xyz="-0.0025 0 0.015" rpy="0 0 0"/>\n      <geometry>'
    return swap(f'{before}<box size="0.205 0.2 0.03"/>', before + instead)


LOOP = (
    '<link name="a"/><link name="b"/>'
    '<joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
    '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint></robot>'
)
MESHES = "".join(
    f"<visual><geometry><mesh filename='package://a/{k}.stl'/></geometry></visual>"
    for k in range(2001)
)
INERTIAL, SHAPE = "link 'link_1'/inertial", "link 'base_link'/collision[0]/geometry"
MASS, INERTIA = f"{INERTIAL}/mass value", f"{INERTIAL}/inertia"
IN_GRAMS = 'ixx="900" ixy="0" ixz="0" iyy="900" iyz="0" izz="900"'

CASES: list[tuple[Callable[[str], str], str, str]] = [
    (mass("nan"), MASS, "'nan'"),
    (mass("-1"), MASS, "0 to 10000 kg"),
    (mass("1e308"), MASS, "1e+308"),
    (mass("heavy"), MASS, "'heavy'"),
    (mass("1_0"), MASS, "'1_0'"),
    (swap('<mass value="8.411"/>', ""), INERTIAL, "<mass>"),
    (swap('ixx="0.0486"', 'ixx="NaN"'), f"{INERTIA} ixx", "'NaN'"),
    (swap('izz="0.0394"', ""), f"{INERTIA} izz", ""),
    (swap('ixx="0.0486"', 'ixx="-0.0486"'), INERTIA, "zero"),
    (inertia(IN_GRAMS), INERTIA, "kg m^2"),
    (child("link_3", "link_2"), "joint 'joint_3'", "'link_2'"),
    (swap("</robot>", LOOP), "link 'a'", "loop"),
    (child("link_3", "link_4"), "joint 'joint_4'/child link", "'joint_3'"),
    (beside('<link name="a"/>'), "robot", "('base_link', 'a')"),
    (child("link_3", "lnik_3"), "joint 'joint_3'/child link", "'link_"),
    (axis("0 0 0"), "joint 'joint_2'/axis xyz", "length"),
    (axis("0 1"), "joint 'joint_2'/axis xyz", "3 numbers"),
    (
        swap('"joint_4" type="revolute"', '"joint_4" type="revolut"'),
        "joint 'joint_4' type",
        "'revolute'",
    ),
    (swap('name="link_2">', 'name="link_1">'), "link[2] name", "found 'link_1'"),
    (swap('<link name="link_2">', "<link>"), "link[2] name", ""),
    (shape('<box size="205 200 30"/>'), f"{SHAPE}/box size[0]", " 0.205 m"),
    (shape('<sphere radius="-1"/>'), f"{SHAPE}/sphere radius", "found -1"),
    (shape('<cone radius="1"/>'), SHAPE, "found 'cone'; "),
    (shape(""), SHAPE, "found nothing"),
    (shape('<mesh filename="a.stl" scale="nan 1 1"/>'), f"{SHAPE}/mesh scale[0]", "'nan'"),
    (shape('<mesh filename="a.stl" scale="1 0 1"/>'), f"{SHAPE}/mesh scale", "zero"),
    (shape("<mesh/>"), f"{SHAPE}/mesh filename", ""),
    (swap('"utf-8"', '"ebcdic"'), "declares", "'ebcdic'"),
    (swap("<robot", '<!DOCTYPE r [<!ENTITY a "b">]>\n<robot'), "has", "document type"),
    (beside('<x:a xmlns:x="http://www.ros.org/wiki/xacro"/>'), "holds", "xacro"),
    (beside("<a>" * 40 + "</a>" * 40), "nested", " 32"),
    (
        beside("<a " + " ".join(f"a{k}=''" for k in range(500_001)) + "/>"),
        "has",
        " 500000 ",
    ),
    (swap("</link>", f"{MESHES}</link>"), "names", " 2000"),
    (
        swap('velocity="2.094395102393195"', 'velocity="-1"'),
        "joint 'joint_1'/limit velocity",
        "found -1; ",
    ),
    (
        swap('<origin xyz="0 0 0.707" rpy="0 0 0"/>\n    <axis', '<origin xyz="0 0 707"/><axis'),
        "joint 'joint_3'/origin xyz[2]",
        " 0.707 m",
    ),
    (beside("<a/>" * 100_001), "has", " 100000 "),
]


TEXT = GOFA.read_text("utf-8")
EVERY = sorted(ur10_urdf().parents[2].rglob("*.urdf"))
# A humanoid with inertias below zero, and a file that includes others.
REFUSED = {"romeo_laas_small.urdf": "'body'/inertial/inertia", "ur3.urdf": "robot: "}


@pytest.mark.parametrize("path", EVERY, ids=[path.name for path in EVERY])
def test_published_robots_are_read_as_pinocchio_reads_them(path: Path) -> None:
    if path.name in REFUSED:
        with pytest.raises(UrdfError, match=REFUSED[path.name]):
            read_urdf(path)
        return
    expected = pin.buildModelFromUrdf(str(path))
    urdf = read_urdf(path)
    found = pin.buildModelFromXML(urdf.kinematics)
    found.name = expected.name
    if all(joint.kind != "continuous" for joint in urdf.joints.values()):
        assert found == expected
        return
    # A continuous joint has cosine and sine in Pinocchio, and one position here.
    assert found.nq == found.nv == expected.nv
    for part in ("names", "parents", "jointPlacements", "inertias"):
        assert list(getattr(found, part)) == list(getattr(expected, part))
    velocity_max = np.where(found.velocityLimit == 0.0, expected.velocityLimit, found.velocityLimit)
    assert np.array_equal(velocity_max, expected.velocityLimit)


def test_a_joint_may_be_named_as_a_link(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(TEXT.replace('joint name="joint_6"', 'joint name="link_6"'))
    model = arm_model(robot_record(path))
    assert model.frames[link_frame(model, "link_6")].type == pin.FrameType.BODY


@pytest.mark.parametrize(
    ("change", "place", "words"),
    CASES,
    ids=[f"{index}-{words or place}" for index, (_, place, words) in enumerate(CASES)],
)
def test_what_is_wrong_is_named(change: Callable[[str], str], place: str, words: str) -> None:
    changed = change(TEXT)
    assert changed != TEXT
    with pytest.raises(UrdfError) as caught:
        parse_urdf(changed.encode(), "arm.urdf")
    assert any(p.startswith(place) and words in p for p in caught.value.problems), caught.value
    assert str(caught.value).startswith("arm.urdf: ")


def chain(links: int) -> str:
    parts = ['<robot name="chain"><link name="l0"/>']
    for k in range(1, links):
        parts.append(
            f'<link name="l{k}"/><joint name="j{k}" type="fixed"><parent link="l{k - 1}"/>'
        )
        parts.append(f'<child link="l{k}"/></joint>')
    return "".join([*parts, "</robot>"])


def test_a_long_chain_is_refused_and_does_not_crash(tmp_path: Path) -> None:
    path = tmp_path / "chain.urdf"
    path.write_text(chain(MOST_LINKS))
    assert reduced_model(read_urdf(path)).njoints == 1
    for links, number in ((MOST_LINKS + 1, "501"), (50_000, "100000")):
        path.write_text(chain(links))
        with soon(), pytest.raises(UrdfError, match=number):
            reduced_model(read_urdf(path))


def test_nothing_is_said_on_the_terminal(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(TEXT.replace("</robot>", LOOP))
    with pytest.raises(UrdfError):
        reduced_model(read_urdf(path))
    reduced_model(read_urdf(GOFA))
    assert capfd.readouterr() == ("", "")


def test_pairs_are_read_in_order_and_those_without_a_link_are_told(tmp_path: Path) -> None:
    path = tmp_path / "arm.srdf"
    path.write_text(
        '<robot name="arm"><group name="g"><joint name="j"/></group>'
        '<disable_collisions link1="a" link2="b" reason="Adjacent"/>'
        '<disable_collisions link1="a" link2="c"/></robot>',
        encoding="utf-8",
    )
    assert read_srdf(path) == (IgnoredPair("a", "b", "Adjacent"), IgnoredPair("a", "c", ""))
    path.write_text('<robot><disable_collisions link1="a"/></robot>', encoding="utf-8")
    with pytest.raises(UrdfError, match=r"arm\.srdf: .*disable_collisions\[0\] link2: "):
        read_srdf(path)


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


def test_given_folders_come_first_and_others_are_added_where_they_lack_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, ament = package(tmp_path / "a" / "arm"), package(tmp_path / "b" / "share" / "arm")
    two = package(tmp_path / "b" / "share" / "two")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nothing:{tmp_path / 'b'}")
    assert find_package("arm", [tmp_path / "a"], NOWHERE) == given
    assert find_package("arm", [], NOWHERE) == ament
    addresses = ["package://arm/a.stl", "package://two/b.stl", "package://three/c.stl", "d.stl"]
    assert further_package_dirs(addresses, [tmp_path / "a"], NOWHERE) == (two.parent,)


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


def test_a_source_folder_may_bear_another_name_than_its_package(tmp_path: Path) -> None:
    """As moveit_resources/panda_description, the package moveit_resources_panda_description."""
    arm = package(tmp_path / "src" / "arm", "vendor_arm")
    (arm / "arm.stl").write_bytes(b"solid")
    assert find_package("vendor_arm", [tmp_path / "src"], NOWHERE) == arm
    for name in ("vendor_arm", "arm"):
        assert find_package(name, [], arm / "urdf" / "arm.urdf") == arm
    assert find_package("vendor", [tmp_path / "src"], NOWHERE) is None
    address = "package://vendor_arm/arm.stl"
    assert resolve_mesh(address, NOWHERE, [tmp_path / "src"]) == (arm / "arm.stl").resolve()
    assert further_package_dirs([address], [], arm / "arm.urdf") == (tmp_path / "src",)
    package(tmp_path / "src" / "vendor_arm")
    assert find_package("vendor_arm", [tmp_path / "src"], NOWHERE) == arm.with_name("vendor_arm")


@pytest.mark.parametrize("name", ["", "..", "../arm", "/etc", ".", "a" * 100_000])
def test_no_name_leads_elsewhere(name: str) -> None:
    assert find_package(name, [Path("/")], NOWHERE) is None


XACRO = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:arg name="ur_type" default="none"/><link name="$(arg ur_type)"/></robot>"""


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty cache of downloads, and a proxy that answers nobody."""
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path))
    monkeypatch.setenv("https_proxy", "http://127.0.0.1:9")
    monkeypatch.delitem(sys.modules, "robot_descriptions.ur10e_description", raising=False)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "code", "quoted"),
    [
        ("ur10_robt", "unknown-description", "'ur10_robot'"),
        ("ur10f_description", "unknown-description", "'ur10e_description'"),
        ("../ur10", "no-name", ""),
    ],
)
def test_what_has_no_such_name(name: str, code: str, quoted: str) -> None:
    with refused(OutsideError, code, quoted):
        named_robot(name)


def test_a_failed_download_is_one_message(no_network: Path) -> None:
    with refused(OutsideError, "no-download") as told:
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
