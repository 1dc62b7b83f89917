"""Scenes of other programs: what becomes a body where, and what is told instead."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from symbolic.array import Array
from symbolic.errors import SceneError
from symbolic.read.scene_bodies import ImportedScene
from symbolic.read.scenes import read_scene
from symbolic.read.tables import TableReader, read_body
from symbolic.records import Body, Box, Cylinder, Mesh, Sphere
from symbolic.records.problems import Problems
from tests.refusals import refused


def scene(folder: Path, text: str, name: str = "scene.sdf") -> ImportedScene:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return read_scene(path)


def by_name(found: ImportedScene) -> dict[str, Body]:
    return {body.name: body for body in found.bodies}


def places(found: ImportedScene) -> dict[str, list[float]]:
    return {body.name: body.pose[:3, 3].round(9).tolist() for body in found.bodies}


def sdf(inside: str) -> str:
    return f"<?xml version='1.0'?>\n<!-- a test -->\n<sdf version='1.9'>{inside}</sdf>"


def collision(name: str, shape: str, pose: str = "") -> str:
    return f"<collision name='{name}'>{pose}<geometry>{shape}</geometry></collision>"


BALL = "<sphere><radius>0.1</radius></sphere>"
ELSEWHERE = "<pose relative_to='lnk'/>"
QUARTER = repr(np.pi / 2)

FRAMES = f"""
<world name='w'>
  <frame name='corner'><pose>1 0 0 0 0 {QUARTER}</pose></frame>
  <model name='shelf'>
    <static>true</static>
    <pose relative_to='corner'>1 0 0 0 0 0</pose>
    <link name='back'><pose>0 0 1 0 0 0</pose>
      {collision("own", BALL, "<pose>0.5 0 0 0 0 0</pose>")}
      {collision("low", BALL, "<pose relative_to='__model__'>0 0 0.25 0 0 0</pose>")}
      {collision("far", BALL, "<pose relative_to='drawer::handle'>0 0 0.1 0 0 0</pose>")}
    </link>
    <frame name='rail' attached_to='back'><pose>0 0.5 0 0 0 0</pose></frame>
    <model name='drawer' placement_frame='handle'>
      <pose relative_to='rail' degrees='true'>0 0 0 0 0 90</pose>
      <link name='box'>{collision("c", BALL)}</link>
      <frame name='handle'><pose>0.2 0 0 0 0 0</pose></frame>
    </model>
    <joint name='slide' type='fixed'><parent>back</parent><child>drawer::box</child></joint>
    <link name='knob'><pose relative_to='slide'>0 0 0.3 0 0 0</pose>{collision("c", BALL)}</link>
  </model>
</world>
"""


def test_frames_of_sdf_are_followed(tmp_path: Path) -> None:
    """The shelf stands at (1, 1, 0), turned by a quarter; the drawer's handle is at the rail."""
    found = scene(tmp_path, sdf(FRAMES))
    assert (found.left_out, found.notes) == ((), ())
    assert places(found) == {
        "shelf back own": [1.0, 1.5, 1.0],
        "shelf back low": [1.0, 1.0, 0.25],
        "shelf back far": [0.5, 1.0, 1.1],
        "shelf drawer box c": [0.7, 1.0, 1.0],
        "shelf knob c": [0.7, 1.0, 1.3],
    }


def test_every_shape_of_sdf(tmp_path: Path) -> None:
    """A plane is a slab below its surface, a capsule three bodies, a mesh keeps its scale."""
    trimesh.creation.box((1.0, 2.0, 3.0)).export(tmp_path / "part.stl")
    shapes = {
        "box": "<box><size>0.3 0.02 0.8</size></box>",
        "post": "<cylinder><radius>0.05</radius><length>2</length></cylinder>",
        "rail": "<capsule><radius>0.1</radius><length>0.4</length></capsule>",
        "wall": "<plane><normal>1 0 0</normal><size>100 100</size></plane>",
        "mesh": "<mesh><uri>part.stl</uri><scale>0.1 0.1 0.2</scale></mesh>",
        "none": "<empty/>",
    }
    inside = "".join(collision(name, shape) for name, shape in shapes.items())
    model = f"<model name='m'><static>1</static><pose>2 0 0 0 0 0</pose><link name='l'>{inside}"
    bodies = by_name(scene(tmp_path, sdf(f"{model}</link></model>")))
    assert list(bodies) == [
        *("m l box", "m l post", "m l rail", "m l rail end", "m l rail end 2", "m l wall"),
        "m l mesh",
    ]
    box = bodies["m l box"].shape
    assert isinstance(box, Box)
    assert box.size.tolist() == [0.3, 0.02, 0.8]
    assert bodies["m l post"].shape == Cylinder(0.05, 2.0)
    assert bodies["m l rail end"].shape == Sphere(0.1)
    assert [bodies[f"m l rail end{n}"].pose[2, 3] for n in ("", " 2")] == [-0.2, 0.2]
    mesh = bodies["m l mesh"].shape
    assert isinstance(mesh, Mesh)
    size = np.asarray(trimesh.load_mesh(mesh.path).extents) * mesh.scale
    np.testing.assert_allclose(size, np.array([0.1, 0.2, 0.6]), atol=1e-12)
    slab = bodies["m l wall"]
    assert isinstance(slab.shape, Box)
    corners = np.asarray(trimesh.creation.box(slab.shape.size, slab.pose).bounds)
    np.testing.assert_allclose(corners, np.array([[1.9, -5, -5], [2, 5, 5]]), atol=1e-12)


def test_models_are_included(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a path, by a model's folder and its configuration, and by the folders of Gazebo."""
    parcel = "<model name='parcel'><pose>0 0 1 0 0 0</pose><link name='l'>"
    text = sdf(f"{parcel}{collision('c', BALL)}</link></model>")
    (tmp_path / "near").mkdir()
    (tmp_path / "near" / "parcel.sdf").write_text(text)
    folder = tmp_path / "elsewhere" / "crate"
    folder.mkdir(parents=True)
    (folder / "crate.sdf").write_text(text)
    (folder / "model.config").write_text("<model><name>c</name><sdf>crate.sdf</sdf></model>")
    monkeypatch.setenv("GZ_SIM_RESOURCE_PATH", str(folder.parent))
    world = """<world name='w'>
      <include><uri>near/parcel.sdf</uri><static>true</static></include>
      <include><uri>near/parcel.sdf</uri><name>second</name><pose>1 0 0 0 0 0</pose></include>
      <include><uri>model://crate</uri><name>third</name></include>
      <include><uri>model://nowhere</uri></include>
      <include><uri>https://fuel.gazebosim.org/x</uri><name>online</name></include>
    </world>"""
    found = scene(tmp_path, sdf(world))
    assert places(found) == {
        "parcel l c": [0.0, 0.0, 1.0],
        "second l c": [1.0, 0.0, 0.0],
        "third l c": [0.0, 0.0, 1.0],
    }
    assert [note.partition(":")[0] for note in found.notes] == ["second", "third"]
    assert [told.partition(":")[0] for told in found.left_out] == [
        "world 'w'/include[3]",
        "online",
    ]
    assert "GZ_SIM_RESOURCE_PATH" in found.left_out[0]


@pytest.mark.parametrize(
    ("shape", "why"),
    [
        ("<ellipsoid><radii>1 1 2</radii></ellipsoid>", "'ellipsoid'"),
        ("<heightmap/>", "'heightmap'"),
        ("<box><size>300 1 1</size></box>", " mm"),
        ("<sphere><radius>0</radius></sphere>", "1e-06"),
        ("<mesh><uri>none.stl</uri></mesh>", "'none.stl'"),
        ("<mesh><uri>flat.stl</uri></mesh>", "flat"),
        ("<mesh><uri>flat.stl</uri><submesh><name>a</name></submesh></mesh>", "flat.stl"),
        ("<mesh><uri>box.stl</uri><scale>-1 1 1</scale></mesh>", "-1"),
    ],
)
def test_what_is_no_body_is_told(tmp_path: Path, shape: str, why: str) -> None:
    plate = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    plate.export(tmp_path / "flat.stl")
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "box.stl")
    link = f"<link name='l'>{collision('odd', shape)}{collision('ball', BALL)}</link>"
    found = scene(tmp_path, sdf(f"<model name='m'>{link}</model>"))
    assert list(by_name(found)) == ["m l ball"]
    (told,) = found.left_out
    assert told.startswith("m l odd: ")
    assert why in told


@pytest.mark.parametrize(
    ("text", "code", "quoted"),
    [
        ("<sdf version='1.9'><model>", "not-xml", "line 1"),
        ("<robot name='r'/>", "no-scene", "<sdf>"),
        ("name: nothing", "no-scene", "<sdf>"),
        ("<!-- --> " * 5000, "no-scene", "<sdf>"),
        (sdf(""), "no-obstacle", ""),
        (
            sdf("<model name='m'><link name='l'><collision name='c'/></link></model>"),
            "scene",
            "<geometry>",
        ),
        (
            sdf(f"<model><link name='l'>{collision('c', BALL)}</link></model>"),
            "scene",
            "model[0] name: ",
        ),
        (
            sdf(f"<model name='m'><link name='l'>{collision('c', '<box/>')}</link></model>"),
            "scene",
            "link 'l'/collision 'c'/geometry/box: <size>",
        ),
        (
            sdf("<model name='m'><pose>0 0 one 0 0 0</pose></model>"),
            "scene",
            "pose[2]: found 'one'",
        ),
        (sdf("<model name='m'><pose>0 0 0</pose></model>"), "scene", "6 numbers"),
        (
            sdf("<model name='m'><pose rotation_format='quat_xyzw'>0 0 0 1 1 1 1</pose></model>"),
            "scene",
            "length 2",
        ),
        (
            sdf(f"<model name='m'><link name='l'>{collision('c', BALL, ELSEWHERE)}</link></model>"),
            "unknown-frame",
            "'lnk'",
        ),
        (
            sdf(
                "<model name='m'><frame name='a' attached_to='b'/><frame name='b' attached_to='a'/>"
                f"<link name='l'><pose relative_to='a'/>{collision('c', BALL)}</link></model>"
            ),
            "circular",
            "model 'm'",
        ),
        (
            sdf("<world name='w'><include><uri>scene.sdf</uri></include></world>"),
            "circular",
            "scene.sdf",
        ),
        ("<!DOCTYPE x><sdf/>", "no-scene", "<sdf>"),
        ("<mujoco><world></mujoco>", "not-mjcf", "MuJoCo"),
    ],
)
def test_a_broken_scene_is_refused(tmp_path: Path, text: str, code: str, quoted: str) -> None:
    require_refusal(tmp_path, "scene.sdf", text, code, quoted)


def require_refusal(folder: Path, name: str, text: str, code: str, quoted: str) -> None:
    with refused(SceneError, code, quoted) as told:
        scene(folder, text, name)
    assert str(told.value).startswith(f"{name}: ")


def test_a_missing_scene_is_told(tmp_path: Path) -> None:
    with refused(SceneError, "unreadable", "none.sdf"):
        read_scene(tmp_path / "none.sdf")


# --- planning scenes of MoveIt ---


MESSAGE = f"""
name: bench
fixed_frame_transforms:
- header: {{frame_id: world}}
  child_frame_id: cart
  transform: {{translation: {{x: 0.0, y: 2.0, z: 0.0}}, rotation: {{x: 0, y: 0, z: 0, w: 1}}}}
robot_state:
  attached_collision_objects:
  - object: {{id: cup}}
world:
  collision_objects:
  - header: {{frame_id: cart}}
    id: table
    pose:
      position: {{x: 1.0, y: 0, z: 0}}
      orientation: {{x: 0, y: 0, z: {2**-0.5}, w: {2**-0.5}}}
    primitives:
    - {{type: 1, dimensions: [1.0, 0.5, 0.1]}}
    - {{type: 3, dimensions: [0.8, 5e-02]}}
    primitive_poses:
    - {{position: {{x: 0, y: 0, z: 0.5}}, orientation: {{x: 0, y: 0, z: 0, w: 1}}}}
    - {{position: {{x: 0.5, y: 0, z: 0}}, orientation: {{x: 0, y: 0, z: 0, w: 0}}}}
    operation: 0
  - id: can
    primitives: [{{type: cylinder, dimensions: [0.1, 3e-2]}}]
    primitive_poses: [{{position: [0.5, 0.0, 0.25], orientation: [0, 0, 0, 1]}}]
  - id: floor
    header: {{frame_id: odom}}
    planes: [{{coef: [0, 0, 2, 1]}}]
  - id: hat
    primitives: [{{type: 4, dimensions: [1, 1]}}]
  - id: gone
    operation: 1
  - id: wedge
    meshes:
    - triangles:
      - vertex_indices: [0, 2, 1]
      - [0, 1, 3]
      - [1, 2, 3]
      - [0, 3, 2]
      vertices: [{{x: 0, y: 0, z: 0}}, [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    mesh_poses: [{{position: [0, 0, 1]}}]
  octomap: {{octomap: {{data: [1, 2]}}}}
---
"""


def test_a_planning_scene(tmp_path: Path) -> None:
    """As MoveIt reads it: an object's pose counts, a row of zeros is no rotation."""
    found = scene(tmp_path, MESSAGE, "scene.yaml")
    assert places(found) == {
        "table primitives 1": [1.0, 2.0, 0.5],
        "table primitives 2": [1.0, 2.5, 0.0],
        "can": [0.5, 0.0, 0.25],
        "floor": [0.0, 0.0, -0.55],
        "wedge": [0.0, 0.0, 1.0],
    }
    bodies = by_name(found)
    assert bodies["table primitives 2"].shape == Cylinder(0.05, 0.8)
    assert bodies["can"].shape == Cylinder(0.03, 0.1)
    np.testing.assert_allclose(bodies["table primitives 1"].pose[:3, 0], np.eye(3)[1], atol=1e-12)
    assert [told.partition(":")[0] for told in found.left_out] == ["hat", "gone", "octomap", "cup"]
    assert [note.partition(":")[0] for note in found.notes] == ["floor", "floor"]
    (content,) = found.files.values()
    wedge = trimesh.load_mesh(BytesIO(content), file_type="stl")
    assert wedge.is_watertight
    assert abs(wedge.volume - 1 / 6) < 1e-9


SAVED = """(noname)+
* shelf board
{placed}2
box
1 0.5 0.1
{first}
0 0 0 1
0 0 0 0
cylinder
0.05 0.8
0 0 3
0 0 0 1
0 0 0 0
{subframes}* tip
{unmoved}1
mesh
4 4
0 0 0
1 0 0
0 1 0
0 0 1
0 2 1
0 1 3
1 2 3
0 3 2
0 0 1
0 0 0 1
0 0 0 0
{none}.
"""
OLD = dict.fromkeys(("placed", "subframes", "unmoved", "none"), "") | {"first": "1 2 0.5"}
NEW = {
    "placed": "1 2 0\n0 0 0 1\n",
    "first": "0 0 0.5",
    "subframes": "1\nmiddle of it\n0 0 0\n0 0 0 1\n",
    "unmoved": "0 0 0\n0 0 0 1\n",
    "none": "0\n",
}


@pytest.mark.parametrize("words", [OLD, NEW])
def test_a_saved_scene_of_either_age(tmp_path: Path, words: dict[str, str]) -> None:
    """Shapes are in the world, or in their object."""
    found = scene(tmp_path, SAVED.format(**words), "saved.scene")
    second = [1.0, 2.0, 3.0] if words is NEW else [0.0, 0.0, 3.0]
    expected = {"shelf board 1": [1.0, 2.0, 0.5], "shelf board 2": second, "tip": [0.0, 0.0, 1.0]}
    assert places(found) == expected
    assert by_name(found)["shelf board 2"].shape == Cylinder(0.05, 0.8)
    assert len(found.files) == 1


OBJECT = "world: {collision_objects: [{id: a, "


@pytest.mark.parametrize(
    ("text", "code", "quoted"),
    [
        ("a: [", "not-yaml", "line 2"),
        ("- 1", "no-message", ""),
        ("world: {}", "no-scene", "world.collision_objects"),
        ("world: {collision_objects: 3}", "scene", "world.collision_objects: "),
        (f"{OBJECT}primitives: [{{type: 1, dimensions: [1, 2]}}]}}]}}", "scene", "3 numbers"),
        (f"{OBJECT}primitives: [{{type: 2, dimensions: [.inf]}}]}}]}}", "scene", "found inf"),
        (
            f"{OBJECT}primitives: [{{}}], primitive_poses: [{{}}, {{}}]}}]}}",
            "scene",
            "primitive_poses: found 2",
        ),
        (f"{OBJECT}pose: {{position: [0, 0]}}}}]}}", "scene", "position: found [0, 0]"),
        (f"{OBJECT}meshes: [{{triangles: 3}}]}}]}}", "scene", "triangles"),
        (f"{OBJECT}meshes: [{{triangles: [[0, 1]]}}]}}]}}", "scene", "triangles"),
        (f"{OBJECT}meshes: [{{triangles: [[0, 1, 2]]}}]}}]}}", "scene", "corners"),
        (f"{OBJECT}planes: [{{coef: [0, 0, 0, 1]}}]}}]}}", "scene", "normal"),
        ("name\n* a\n1\nbox\n1 2", "not-as-written", "'a'"),
        ("name\n* a\n1\nmesh\n-1 0\n", "not-as-written", "-1"),
        ("name\n* a\n1\nteapot\n", "not-as-written", "'teapot'"),
        ("name\n* a\n1\nsphere\nbig\n", "not-as-written", "'big'"),
        ("name\n*", "not-as-written", "''"),
        ("name\n.\n", "no-obstacle", ""),
    ],
)
def test_a_broken_planning_scene_is_refused(
    tmp_path: Path, text: str, code: str, quoted: str
) -> None:
    name = "s.scene" if text.startswith("name") else "s.yaml"
    require_refusal(tmp_path, name, text, code, quoted)


# --- MJCF ---


MJCF = """<mujoco>
<compiler angle="degree"/>
<asset><mesh name="wedge" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/>
<hfield name="hills" nrow="2" ncol="2" size="1 1 1 1" elevation="0 1 0 1"/></asset>
<worldbody>
  <geom name="floor" type="plane" size="0 0 1" pos="0 0 -0.1"/>
  <geom type="box" size="0.5 0.25 0.05" pos="1 2 0.5" euler="0 0 90"/>
  <geom name="hills" type="hfield" hfield="hills"/>
  <geom name="ghost" size="0.1" contype="0" conaffinity="0"/>
  <body name="shelf" pos="1 0 0" euler="0 0 90">
    <body name="board" pos="1 0 0.25">
      <geom name="rail" type="capsule" fromto="0 0 0  0.4 0 0" size="0.1"/>
      <geom name="post" type="cylinder" size="0.05 0.4" pos="0 0 1"/>
      <geom name="wedge" type="mesh" mesh="wedge"/>
    </body>
  </body>
  <body name="arm"><joint/><geom size="0.1"/><body><geom size="0.1"/></body></body>
  <body name="robot" pos="5 0 0"><geom size="0.1"/>
    <body><joint/><geom size="0.1"/></body>
  </body>
</worldbody></mujoco>"""


def test_fixed_shapes_of_mjcf(tmp_path: Path) -> None:
    """Where the file puts them; a mesh where its vertices are, wherever MuJoCo puts its frame."""
    found = scene(tmp_path, MJCF, "scene.xml")
    near = {
        "floor": [0.0, 0.0, -0.15],
        "geom 1": [1.0, 2.0, 0.5],
        "board rail": [1.0, 1.2, 0.25],
        "board rail end": [1.0, 1.4, 0.25],
        "board rail end 2": [1.0, 1.0, 0.25],
        "board post": [1.0, 1.0, 1.25],
        "robot": [5.0, 0.0, 0.0],
    }
    assert {name: place for name, place in places(found).items() if "wedge" not in name} == near
    bodies = by_name(found)
    crate = bodies["geom 1"]
    assert isinstance(crate.shape, Box)
    bounds = np.asarray(trimesh.creation.box(crate.shape.size, crate.pose).bounds)
    expected = np.array([[0.75, 1.5, 0.45], [1.25, 2.5, 0.55]])
    np.testing.assert_allclose(bounds, expected, atol=1e-12)
    assert bodies["board post"].shape == Cylinder(0.05, 0.8)
    (content,) = found.files.values()
    wedge = trimesh.load_mesh(BytesIO(content), file_type="stl")
    wedge.apply_transform(bodies["board wedge"].pose)
    np.testing.assert_allclose(wedge.bounds, np.array([[0, 1, 0.25], [1, 2, 1.25]]), atol=1e-6)
    assert [told.partition(":")[0] for told in found.left_out] == ["hills", "arm", "robot"]
    assert "2 shapes" in found.left_out[1]
    assert [told.partition(":")[0] for told in found.notes] == ["floor", "ghost", "robot"]


def test_a_scene_that_is_only_to_be_seen_says_so(tmp_path: Path) -> None:
    ghost = '<geom name="ghost" size="0.1" contype="0" conaffinity="0"/>'
    visual = f"<visual name='v'><geometry>{BALL}</geometry></visual>"
    for text, told in (
        (f"<mujoco><worldbody>{ghost}</worldbody></mujoco>", "ghost: "),
        (sdf(f"<model name='m'><link name='l'>{visual}</link></model>"), "m l: "),
    ):
        with refused(SceneError, "no-obstacle", told):
            scene(tmp_path, text, "scene.xml")


# --- the names and poses that are written ---


def test_names_are_those_of_an_environment(tmp_path: Path) -> None:
    """Unique, at most 80 letters, without what key paths, patterns and robots' bodies hold."""
    inside = "".join(collision(name, BALL) for name in ("a/b", "a.b", "a*b", "x" * 90))
    model = f"<model name='payload'><link name='l'>{inside}</link></model>"
    found = scene(tmp_path, sdf(model))
    assert list(by_name(found)) == [
        *("payload l a-b", "payload l a-b 2", "payload l a-b 3"),
        f"payload l {'x' * 64}",
    ]


metres = st.floats(-1.5, 1.5)
angle = st.one_of(st.floats(-6.0, 6.0), st.just(np.pi / 2))
poses = st.tuples(st.tuples(metres, metres, metres), st.tuples(angle, angle, angle))


def by_scipy(pose: tuple[tuple[float, ...], tuple[float, ...]]) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", pose[1]).as_matrix()
    T[:3, 3] = pose[0]
    return T


def written(pose: tuple[tuple[float, ...], tuple[float, ...]]) -> str:
    return f"<pose>{' '.join(map(repr, (*pose[0], *pose[1])))}</pose>"


@given(model=poses, link=poses, shape=poses)
def test_a_pose_survives_the_scene_and_the_table(
    tmp_path_factory: pytest.TempPathFactory,
    model: tuple[tuple[float, ...], tuple[float, ...]],
    link: tuple[tuple[float, ...], tuple[float, ...]],
    shape: tuple[tuple[float, ...], tuple[float, ...]],
) -> None:
    """SciPy composes the same poses; the workcell's own reader reads what is written."""
    text = (
        f"<model name='m'>{written(model)}<link name='l'>{written(link)}"
        f"{collision('c', BALL, written(shape))}</link></model>"
    )
    folder = tmp_path_factory.getbasetemp()
    expected = by_scipy(model) @ by_scipy(link) @ by_scipy(shape)
    found = scene(folder, sdf(text))
    (table,) = found.tables(folder, folder)
    problems = Problems()
    body = read_body(TableReader(table, "", problems), folder)
    assert not problems.found
    np.testing.assert_allclose(body.pose, expected, atol=1e-8)
