"""URDF files as records: what is right is read as Pinocchio reads it, what is wrong is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from symbolic.errors import UrdfError
from symbolic.read.arms import arm_model, link_frame, reduced_model
from symbolic.read.urdf import MOST_LINKS, UrdfMesh, parse_urdf, read_urdf
from symbolic.records import Box, Cylinder
from tests.robots import GOFA_URDF, robot_record, ur10_urdf
from tests.symbolic.read.urdf_cases import CASES, LOOP
from tests.waiting import soon

GOFA = GOFA_URDF.read_text("utf-8")
EVERY = sorted(ur10_urdf().parents[2].rglob("*.urdf"))
# A humanoid with inertias below zero, and a file that includes others.
REFUSED = {"romeo_laas_small.urdf": "allowed are none below zero", "ur3.urdf": "has no links"}


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


def test_shapes_of_the_gofa_are_those_of_pinocchio() -> None:
    model = pin.buildModelFromUrdf(str(GOFA_URDF))
    geometry = pin.buildGeomFromUrdf(model, str(GOFA_URDF), pin.GeometryType.COLLISION)
    urdf = read_urdf(GOFA_URDF)
    seen = 0
    for link, collisions in urdf.collisions.items():
        T_joint_link = model.frames[link_frame(model, link)].placement.homogeneous
        for index, collision in enumerate(collisions):
            other = geometry.geometryObjects[geometry.getGeometryId(f"{link}_{index}")]
            np.testing.assert_allclose(
                T_joint_link @ collision.pose, other.placement.homogeneous, atol=1e-12
            )
            shape = collision.shape
            if isinstance(shape, Box):
                np.testing.assert_allclose(2.0 * other.geometry.halfSide, shape.size, atol=1e-12)
            else:
                assert isinstance(shape, Cylinder)
                assert other.geometry.radius == pytest.approx(shape.radius, abs=1e-12)
                assert 2.0 * other.geometry.halfLength == pytest.approx(shape.length, abs=1e-12)
            seen += 1
    assert seen == len(geometry.geometryObjects)


def test_meshes_keep_their_address_and_scale() -> None:
    urdf = read_urdf(ur10_urdf())
    shapes = [found.shape for collisions in urdf.collisions.values() for found in collisions]
    meshes = [shape for shape in shapes if isinstance(shape, UrdfMesh)]
    assert len(meshes) == 7
    assert urdf.collision_meshes == tuple(mesh.address for mesh in meshes)
    assert all(address.startswith("package://") for address in urdf.collision_meshes)
    assert all(np.array_equal(mesh.scale, np.ones(3)) for mesh in meshes)
    assert len(urdf.visual_meshes) == 7


def test_a_joint_may_be_named_as_a_link(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(GOFA.replace('joint name="joint_6"', 'joint name="link_6"'))
    model = arm_model(robot_record(path))
    assert model.frames[link_frame(model, "link_6")].type == pin.FrameType.BODY


@pytest.mark.parametrize(
    ("change", "place", "words"),
    CASES,
    ids=[f"{index}-{words or place}" for index, (_, place, words) in enumerate(CASES)],
)
def test_what_is_wrong_is_named(change: Callable[[str], str], place: str, words: str) -> None:
    changed = change(GOFA)
    assert changed != GOFA
    with pytest.raises(UrdfError) as caught:
        parse_urdf(changed.encode(), "arm.urdf")
    assert any(p.startswith(place) and words in p for p in caught.value.problems), caught.value
    assert str(caught.value).startswith("arm.urdf: ")


def test_an_origin_in_millimetres_is_told() -> None:
    start = GOFA.index('<joint name="joint_3"')
    changed = GOFA[:start] + GOFA[start:].replace("0 0 0.707", "0 0 707", 1)
    with pytest.raises(UrdfError, match=r"joint 'joint_3'/origin xyz\[2\].*707 mm are 0.707 m"):
        parse_urdf(changed.encode(), "arm.urdf")


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
    for links, words in ((MOST_LINKS + 1, "has 501 links"), (50_000, "more than 100000 elements")):
        path.write_text(chain(links))
        with soon(), pytest.raises(UrdfError, match=words):
            reduced_model(read_urdf(path))


def test_nothing_is_said_on_the_terminal(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(GOFA.replace("</robot>", LOOP))
    with pytest.raises(UrdfError):
        reduced_model(read_urdf(path))
    reduced_model(read_urdf(GOFA_URDF))
    assert capfd.readouterr() == ("", "")
