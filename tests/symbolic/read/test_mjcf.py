"""Robots in MJCF: the same arm as in URDF, moved as MuJoCo moves it."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import trimesh

from symbolic.array import Array
from symbolic.errors import UrdfError, WorkcellError
from symbolic.read.arms import reduced_model
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell, unpack_cell
from symbolic.read.descriptions import resolve_mesh
from symbolic.read.meshes import read_mesh
from symbolic.read.urdf import UrdfMesh, read_urdf
from tests.symbolic.read.samples import GOFA, sample_data, write

ROUNDED = 2e-5
"""MuJoCo writes six digits."""


@pytest.fixture(scope="module")
def gofa(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The GoFa as MuJoCo reads its URDF and writes its MJCF."""
    spec = mujoco.MjSpec.from_file(str(GOFA))
    spec.compiler.fusestatic = False
    spec.compile()
    path = tmp_path_factory.mktemp("mjcf") / "gofa.xml"
    path.write_text(spec.to_xml(), encoding="utf-8")
    return path


def placements(model: pin.Model, q: Array) -> dict[str, Array]:
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    bodies = (k for k, f in enumerate(model.frames) if f.type == pin.FrameType.BODY)
    return {model.frames[k].name: data.oMf[k].homogeneous for k in bodies}


def test_the_same_arm_from_both_descriptions(gofa: Path) -> None:
    """Places, forces of any motion, limits and shapes of the GoFa."""
    ours, theirs = (reduced_model(read_urdf(path)) for path in (gofa, GOFA))
    assert list(ours.names) == list(theirs.names)
    for limit in ("lowerPositionLimit", "upperPositionLimit", "effortLimit"):
        np.testing.assert_allclose(
            getattr(ours, limit), getattr(theirs, limit), rtol=ROUNDED, err_msg=limit
        )
    rng = np.random.default_rng(1)
    for _ in range(5):
        q, v, a = rng.uniform(-2.0, 2.0, (3, 6))
        found, expected = placements(ours, q), placements(theirs, q)
        for name, pose in expected.items():
            np.testing.assert_allclose(found[name], pose, atol=ROUNDED, err_msg=name)
        one, other = (pin.rnea(model, model.createData(), q, v, a) for model in (ours, theirs))
        np.testing.assert_allclose(one, other, atol=5e-3)
    shapes, expected_shapes = read_urdf(gofa).collisions, read_urdf(GOFA).collisions
    assert shapes.keys() == expected_shapes.keys()
    for link, found_shapes in shapes.items():
        for one, other in zip(found_shapes, expected_shapes[link], strict=True):
            assert type(one.shape) is type(other.shape)
            np.testing.assert_allclose(one.pose, other.pose, atol=ROUNDED)


ODD = """<mujoco><compiler angle="degree" meshdir="meshes"/>
<asset><mesh name="wedge" file="wedge.stl" scale="0.1 0.2 0.1"/></asset>
<worldbody><body name="base" pos="0.1 0 0" euler="0 0 30"><geom size="0.1"/>
 <body name="carriage" pos="0 0 0.2">
  <joint name="slide" type="slide" axis="1 1 0" range="-0.5 0.5" pos="0.1 0 0"/>
  <joint name="turn" axis="0 0 1" pos="0 0.2 0" range="-90 90"/>
  <joint name="tilt" axis="0 1 0" limited="false" pos="0 0.1 0.3"/>
  <geom name="wedge" type="mesh" mesh="wedge" pos="0.1 0.2 0.3" euler="10 20 30"/>
  <geom type="capsule" size="0.05 0.2" contype="0" conaffinity="0"/>
  <body pos="0.5 0 0" euler="0 40 0"><joint name="last" axis="1 0 0"/><geom size="0.1" mass="2"/>
   <site name="tool" pos="0 0 0.3"/></body>
 </body></body></worldbody>
<actuator>
 <motor joint="turn" gear="10" forcerange="-3 4" ctrlrange="-9 9"/>
 <general joint="tilt" gear="-2" gainprm="5" ctrlrange="-3 7"/>
 <motor joint="tilt" ctrlrange="-4 4" forcerange="-100 100"/>
 <position joint="last" kp="50" ctrlrange="-1 1"/>
</actuator></mujoco>"""


@pytest.fixture
def odd(tmp_path: Path) -> Path:
    (tmp_path / "meshes").mkdir()
    corners = np.array([[0.5, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    trimesh.Trimesh(corners, faces).export(tmp_path / "meshes" / "wedge.stl")
    path = tmp_path / "odd.xml"
    path.write_text(ODD, encoding="utf-8")
    return path


def test_links_move_as_in_mujoco(odd: Path) -> None:
    """Several joints of a body, each about a point of its own; sites; a mesh that MuJoCo turns."""
    urdf = read_urdf(odd)
    model, other = reduced_model(urdf), mujoco.MjModel.from_xml_path(str(odd))
    data = mujoco.MjData(other)
    assert list(model.names)[1:] == ["slide", "turn", "tilt", "last"]
    np.testing.assert_allclose(model.effortLimit, [0.0, 30.0, 34.0, 0.0])
    for control in (-1e6, 1e6):
        data.ctrl[:3] = control, -control, control
        mujoco.mj_forward(other, data)
        reached = np.abs(data.qfrc_actuator)
        assert np.all(model.effortLimit[1:3] <= reached[1:3] + 1e-9)
    kinds = [urdf.joints[name].kind for name in ("slide", "turn", "tilt")]
    assert kinds == ["prismatic", "revolute", "continuous"]
    (mesh,) = urdf.collisions["carriage"]
    assert isinstance(mesh.shape, UrdfMesh)
    file = resolve_mesh(mesh.shape.address, odd, ())
    assert file is not None
    corners = read_mesh(file, mesh.shape.scale).vertices
    rng = np.random.default_rng(2)
    for q in rng.uniform(-1.0, 1.0, (5, 4)):
        data.qpos[:] = q
        mujoco.mj_kinematics(other, data)
        found = placements(model, q)
        for name in ("base", "carriage", "body_3"):
            body = int(name[-1]) if name == "body_3" else other.body(name).id
            np.testing.assert_allclose(found[name][:3, 3], data.xpos[body], atol=1e-9)
            np.testing.assert_allclose(found[name][:3, :3].ravel(), data.xmat[body], atol=1e-9)
        np.testing.assert_allclose(found["tool"][:3, 3], data.site("tool").xpos, atol=1e-9)
        T_world_mesh = found["carriage"] @ mesh.pose
        ours = corners @ T_world_mesh[:3, :3].T + T_world_mesh[:3, 3]
        geom = data.geom("wedge")
        theirs = other.mesh_vert @ geom.xmat.reshape(3, 3).T + geom.xpos
        np.testing.assert_allclose(
            ours[np.lexsort(ours.round(5).T)], theirs[np.lexsort(theirs.round(5).T)], atol=1e-6
        )


def test_a_floating_base_stands_where_the_file_has_it(tmp_path: Path) -> None:
    path = tmp_path / "humanoid.xml"
    path.write_text(
        '<mujoco><worldbody><body name="pelvis" pos="0.1 0.2 1" euler="0 0 90"><freejoint/>'
        '<geom size=".1"/><body name="arm" pos="0.3 0 0"><joint name="turn"/><geom size=".1"/>'
        "</body></body></worldbody></mujoco>"
    )
    model, other = reduced_model(read_urdf(path)), mujoco.MjModel.from_xml_path(str(path))
    assert list(model.names)[1:] == ["turn"]
    data = mujoco.MjData(other)
    data.qpos[7] = 0.4
    mujoco.mj_kinematics(other, data)
    found = placements(model, np.array([0.4]))
    for name in ("pelvis", "arm"):
        np.testing.assert_allclose(found[name][:3, 3], data.body(name).xpos, atol=1e-9)
        np.testing.assert_allclose(found[name][:3, :3].ravel(), data.body(name).xmat, atol=1e-9)


def test_a_cell_of_mjcf_is_stored_with_its_digest(gofa: Path, tmp_path: Path) -> None:
    """MJCF has no velocity limits: the cell gives them, or is told to."""
    data = sample_data()
    for robot in data["robots"]:
        robot["urdf"] = "gofa.xml"
    shutil.copy(gofa, tmp_path)
    with pytest.raises(WorkcellError, match="give velocity_max here"):
        load(write(tmp_path, data))
    for robot in data["robots"]:
        robot["velocity_max"] = 2.0
    cell = load(write(tmp_path, data))
    there = tmp_path / "there"
    there.mkdir()
    assert unpack_cell(collect_cell(cell), there).digest == cell.digest


def body(inside: str) -> str:
    return f"<mujoco><worldbody><body><geom size='.1'/>{inside}</body></worldbody></mujoco>"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<mujoco><worldbody><geom/></worldbody></mujoco>", "MuJoCo does not take it"),
        (body("<body><joint type='ball'/><geom size='.1'/></body>"), "is a ball"),
        (
            "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body>"
            "<body><freejoint/><geom size='.1'/></body></worldbody></mujoco>",
            "one of several free ones",
        ),
        (body("<joint name='j' ref='1' type='slide'/>"), "joint 'j' has a ref"),
        (body("<geom type='ellipsoid' size='1 2 3'/>"), "of the kind ellipsoid"),
        (
            "<mujoco><worldbody><geom type='plane' size='1 1 1'/></worldbody></mujoco>",
            "body 'world' has a shape of the kind plane; allowed are boxes, cylinders, spheres, "
            "capsules and meshes with a file; name the robot's file, not a scene's",
        ),
        (
            "<mujoco><asset><mesh name='m' vertex='0 0 0 1 0 0 0 1 0 0 0 1' refpos='1 0 0'/>"
            "</asset><worldbody><geom type='mesh' mesh='m'/></worldbody></mujoco>",
            "refpos",
        ),
        (
            "<mujoco><asset><mesh name='m' vertex='0 0 0 1 0 0 0 1 0 0 0 1'/>"
            "</asset><worldbody><geom type='mesh' mesh='m'/></worldbody></mujoco>",
            "of the kind mesh; allowed",
        ),
    ],
)
def test_what_urdf_has_no_words_for_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UrdfError) as refused:
        read_urdf(path)
    assert str(refused.value).startswith("arm.xml: ")
    assert words in str(refused.value)


def test_mjcf_needs_mujoco(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(body(""), encoding="utf-8")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(UrdfError, match=r"pip install 'dual-arm-carry\[sim\]'"):
        read_urdf(path)
