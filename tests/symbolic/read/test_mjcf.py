"""Arms of other files: models of MuJoCo, and chains that are locked, tilted and given tools."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import trimesh

from symbolic.array import Array
from symbolic.errors import RobotModelError, UrdfError, WorkcellError
from symbolic.geometry.bodies import arm_geometry, collision_bodies
from symbolic.read.arms import (
    arm_model,
    chain_joints,
    common_joints,
    held_joints,
    machine_problem,
    reduced_model,
    without_links,
)
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell, unpack_cell
from symbolic.read.descriptions import resolve_mesh
from symbolic.read.meshes import read_mesh
from symbolic.read.urdf import FULL_TURNS, Urdf, UrdfMesh, parse_urdf, read_urdf
from symbolic.records import Box, Robot, ToolLoad
from tests.machines import robot_record
from tests.refusals import refused
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
        stand_as_in_mujoco(found, data, "base", "carriage", "body_3")
        np.testing.assert_allclose(found["tool"][:3, 3], data.site("tool").xpos, atol=1e-9)
        T_world_mesh = found["carriage"] @ mesh.pose
        ours = corners @ T_world_mesh[:3, :3].T + T_world_mesh[:3, 3]
        geom = data.geom("wedge")
        theirs = other.mesh_vert @ geom.xmat.reshape(3, 3).T + geom.xpos
        np.testing.assert_allclose(
            ours[np.lexsort(ours.round(5).T)], theirs[np.lexsort(theirs.round(5).T)], atol=1e-6
        )


def stand_as_in_mujoco(found: dict[str, Array], data: mujoco.MjData, *names: str) -> None:
    for name in names:
        body = data.body(int(name[5:]) if name.startswith("body_") else name)
        np.testing.assert_allclose(found[name][:3, 3], body.xpos, atol=1e-9)
        np.testing.assert_allclose(found[name][:3, :3].ravel(), body.xmat, atol=1e-9)


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
    stand_as_in_mujoco(placements(model, np.array([0.4])), data, "pelvis", "arm")


def arm(side: str, place: str) -> str:
    """Six hinges in a row, each link 0.2 m above the one before."""
    axes = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
    inside = f'<body name="{side}_hand" pos="0 0 .2"><geom size=".02"/></body>'
    for k in reversed(range(6)):
        inside = (
            f'<body name="{side}_{k}" pos="0 0 .2"><joint name="{side}_joint_{k}" range="-3 3" '
            f'axis="{axes[k]}"/><geom size=".05"/>{inside}</body>'
        )
    return f'<body name="{side}" pos="{place}"><geom size=".06"/>{inside}</body>'


def test_a_scene_of_two_arms_stands_where_it_stands(tmp_path: Path) -> None:
    """Base poses and the floor are the scene's; a loose box lies where the scene has it."""
    path = tmp_path / "scene.xml"
    path.write_text(
        '<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1" pos="0 0 -.1"/>'
        + arm("left", "0 .6 0")
        + arm("right", "0 -.6 .1")
        + '<body name="crate" pos="1 0 .2"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
        + '<body name="ball" pos="2 0 .2"><freejoint/><geom size=".1"/></body>'
        + "</worldbody></mujoco>"
    )
    data = sample_data()
    for robot, side in zip(data["robots"], ("left", "right"), strict=True):
        robot.clear()
        robot |= {"name": side, "urdf": "scene.xml", "chain": [side, f"{side}_hand"]}
        robot |= {"base": {"xyz": [0.0, 0.0, 0.0]}, "pad": {"xyz": [0.0, 0.0, 0.1]}}
        robot |= {"velocity_max": 2.0, "acceleration_max": 10.0, "torque_max": 100.0}
    cell = load(write(tmp_path, data), reach=False)
    bodies = {body.name: body for body in collision_bodies(cell)}
    other = mujoco.MjModel.from_xml_path(str(path))
    simulated = mujoco.MjData(other)
    mujoco.mj_kinematics(other, simulated)
    standing = [name for name, body in bodies.items() if body.group == "environment"]
    for name in ("left", "right", "crate", "ball"):
        (found,) = (each for each in standing if each.endswith(f"/{name}"))
        pose = bodies[found].pieces[0].pose
        np.testing.assert_allclose(pose[:3, 3], simulated.body(name).xpos, atol=1e-9)
    (floor,) = bodies[next(name for name in standing if name.endswith("/world"))].pieces
    assert isinstance(floor.shape, Box)
    top = floor.pose @ [0.0, 0.0, floor.shape.size[2] / 2.0, 1.0]
    np.testing.assert_allclose(top[:3], [0.0, 0.0, -0.1], atol=1e-9)
    for i, side in enumerate(("left", "right")):
        first = arm_geometry(cell, i)
        np.testing.assert_allclose(
            (first.T_world_root @ first.origins[0])[:3, 3], simulated.body(f"{side}_0").xpos
        )


def test_a_cell_of_mjcf_is_stored_with_its_digest(gofa: Path, tmp_path: Path) -> None:
    """MJCF has no velocity limits: the cell gives them, or is told to."""
    data = sample_data()
    for robot in data["robots"]:
        robot["urdf"] = "gofa.xml"
    shutil.copy(gofa, tmp_path)
    with pytest.raises(WorkcellError, match=r"robots\[0\]\.velocity_max"):
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
    ("text", "code", "quoted"),
    [
        ("<mujoco><worldbody><geom/></worldbody></mujoco>", "not-mjcf", "geom"),
        (body("<body><joint type='ball'/><geom size='.1'/></body>"), "joint-kind", "'joint_0'"),
        (body("<joint name='j' ref='1' type='slide'/>"), "joint-reference", "'j'"),
        (body("<geom type='ellipsoid' size='1 2 3'/>"), "shape-kind", "ellipsoid"),
        (
            "<mujoco><asset><mesh name='m' vertex='0 0 0 1 0 0 0 1 0 0 0 1' refpos='1 0 0'/>"
            "</asset><worldbody><geom type='mesh' mesh='m'/></worldbody></mujoco>",
            "moved-mesh",
            "refpos",
        ),
        (
            "<mujoco><asset><mesh name='m' vertex='0 0 0 1 0 0 0 1 0 0 0 1'/>"
            "</asset><worldbody><geom type='mesh' mesh='m'/></worldbody></mujoco>",
            "shape-kind",
            "mesh",
        ),
    ],
)
def test_what_urdf_has_no_words_for_is_refused(
    tmp_path: Path, text: str, code: str, quoted: str
) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(text, encoding="utf-8")
    with refused(UrdfError, code, "arm.xml: ", quoted):
        read_urdf(path)


def test_mjcf_needs_mujoco(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(body(""), encoding="utf-8")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with refused(UrdfError, "missing-extra", "dual-arm-carry[sim]"):
        read_urdf(path)


ARM = ("x", "y", "z", "x", "y", "z")


def joint(name: str, parent: str, child: str, kind: str = "revolute", extra: str = "") -> str:
    axis = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}.get(name[-1], "0 0 1")
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="0.1 0 0.2"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="{axis}"/>'
        f'<limit lower="-2" upper="2" effort="9" velocity="3"/>{extra}</joint>'
    )


def machine() -> str:
    """A base, a lift, two arms of six joints, and on each a gripper whose fingers mimic."""
    links, joints = ["base", "torso"], [joint("lift", "base", "torso", "prismatic")]
    for side in ("left", "right"):
        parent = "torso"
        for k, axis in enumerate(ARM):
            child = f"{side}_{k}"
            joints.append(joint(f"{side}_{k}_{axis}", parent, child))
            links.append(child)
            parent = child
        links += [f"{side}_thumb", f"{side}_finger"]
        mimic = f'<mimic joint="{side}_grip" multiplier="-2" offset="0.5"/>'
        joints.append(joint(f"{side}_grip", parent, f"{side}_thumb"))
        joints.append(joint(f"{side}_follow", parent, f"{side}_finger", extra=mimic))
    inertial = (
        '<inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" '
        'iyz="0"/></inertial><collision><geometry><sphere radius="0.05"/></geometry></collision>'
    )
    body = "".join(f'<link name="{link}">{inertial}</link>' for link in links)
    return f'<robot name="machine">{body}{"".join(joints)}</robot>'


def urdf() -> Urdf:
    return parse_urdf(machine().encode(), "machine.urdf")


def arms(folder: Path) -> tuple[Robot, Robot]:
    path = folder / "machine.urdf"
    path.write_text(machine(), encoding="utf-8")
    left, right = (
        replace(robot_record(path), name=side, chain_root="torso", flange=f"{side}_5")
        for side in ("left", "right")
    )
    return left, right


def test_a_chain_goes_from_root_to_tip() -> None:
    names = chain_joints(urdf(), "torso", "left_5")
    assert names == tuple(f"left_{k}_{axis}" for k, axis in enumerate(ARM))
    assert chain_joints(urdf(), "base", "left_0") == ("lift", "left_0_x")


@pytest.mark.parametrize(
    ("root", "tip", "code"),
    [
        ("torsi", "left_5", "unknown-link"),
        ("left_5", "torso", "not-connected"),
        ("left_0", "right_5", "not-connected"),
    ],
)
def test_links_that_are_no_chain_are_told(root: str, tip: str, code: str) -> None:
    with refused(RobotModelError, code, root):
        chain_joints(urdf(), root, tip)


def test_everything_else_is_held_and_mimics_follow() -> None:
    moving = chain_joints(urdf(), "torso", "left_5")
    held = dict(held_joints(urdf(), moving, (("left_grip", 0.3),)))
    assert held["left_follow"] == pytest.approx(-2 * 0.3 + 0.5)
    assert held["right_follow"] == pytest.approx(0.5)
    assert held["lift"] == 0.0
    assert not set(moving) & set(held)
    assert len(moving) + len(held) == 1 + 2 * 8
    # Where zero is out of its range, a joint is held at the nearest limit.
    text = machine().replace('lower="-2" upper="2"', 'lower="0.4" upper="2"', 1)
    assert dict(held_joints(parse_urdf(text.encode(), "m"), (), ()))["lift"] == 0.4


def test_a_fixed_joint_may_bear_a_links_name() -> None:
    """As Baxter's hands do; Pinocchio itself refuses to hold joints of such a model."""
    plate = joint("left_thumb", "left_thumb", "left_plate", "fixed")
    text = machine().replace("</robot>", f'<link name="left_plate"/>{plate}</robot>')
    urdf = parse_urdf(text.encode(), "machine.urdf")
    moving = chain_joints(urdf, "base", "left_5")
    model = reduced_model(urdf, held_joints(urdf, moving, ()))
    assert tuple(model.names)[1:] == moving
    names = [frame.name for frame in model.frames]
    assert {"left_thumb", "left_plate"} <= set(names)
    assert names.count("left_thumb") == 1


def test_joints_that_cannot_be_held_are_told() -> None:
    with refused(RobotModelError, "unknown-joint", "'lifd'", "'lift'"):
        held_joints(urdf(), (), (("lifd", 0.0),))
    with refused(RobotModelError, "mimics-moving-joint", "'left_follow'", "'left_grip'"):
        held_joints(urdf(), ("left_grip",), ())
    with refused(RobotModelError, "mimicking-joint", "'left_follow'"):
        held_joints(urdf(), ("left_follow",), ())


def test_joints_that_follow_one_another_are_told_and_unknown_ones_are_left() -> None:
    circle = machine().replace('mimic joint="left_grip"', 'mimic joint="left_follow"')
    with pytest.raises(UrdfError, match="'left_follow'/mimic"):
        parse_urdf(circle.encode(), "m")
    unknown = machine().replace('mimic joint="left_grip"', 'mimic joint="nowhere"')
    assert parse_urdf(unknown.encode(), "m").joints["left_follow"].mimics == ""


def test_dropped_links_take_along_what_hangs_on_them() -> None:
    kept = without_links(urdf(), ("right_1", "left_t*"))
    assert "left_finger" in kept.links
    assert "left_thumb" not in kept.links
    assert not {"right_1", "right_5", "right_finger"} & set(kept.links)
    assert set(kept.collisions) == set(kept.links)
    full = pin.buildModelFromXML(kept.kinematics)
    assert full.njoints - 1 == len(kept.joints) == 1 + 7 + 1
    with refused(RobotModelError, "unknown-link", "'left_thump'", "'left_thumb'"):
        without_links(urdf(), ("left_thump",))
    with refused(RobotModelError, "no-link-left"):
        without_links(urdf(), ("*",))


def test_a_continuous_joint_has_one_coordinate_and_wide_limits() -> None:
    text = machine().replace('"left_3_x" type="revolute"', '"left_3_x" type="continuous"')
    model = reduced_model(parse_urdf(text.encode(), "m"))
    index = model.joints[model.getJointId("left_3_x")]
    assert index.nq == 1
    assert model.upperPositionLimit[index.idx_q] == FULL_TURNS
    assert model.velocityLimit[index.idx_v] == 3.0


def require_quoted(problem: str, *quoted: str) -> None:
    assert all(word in problem for word in quoted), problem


def test_arms_of_one_machine_agree(tmp_path: Path) -> None:
    left, right = arms(tmp_path)
    assert machine_problem((left, right)) == ""
    lifted = replace(left, locked_joints=(("lift", 0.3),))
    require_quoted(machine_problem((lifted, right)), "'lift'", "0.3")
    both = replace(left, flange="left_4", chain_root="base")
    other = replace(right, flange="right_4", chain_root="base")
    assert machine_problem((both, other)) == ""
    assert common_joints((both, other)) == ("lift",)
    require_quoted(machine_problem((both, right)), "'lift'", "'right'")
    assert "robots[0]" in machine_problem((left, left))
    # The gripper of one arm is no business of the other.
    gripping = replace(left, locked_joints=(("left_grip", 0.3),))
    assert machine_problem((gripping, right)) == ""


def test_the_tool_weighs_on_the_joints() -> None:
    bare = robot_record(GOFA)
    load = ToolLoad(2.0, np.array([0.0, 0.01, 0.05]), np.diag([0.01, 0.02, 0.03]))
    q, v, a = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 6))
    with_tool = arm_model(replace(bare, tool_load=load))
    found = pin.rnea(with_tool, with_tool.createData(), q, v, a)
    # The tool alone: its wrench about its centre of mass, through the Jacobian of that point.
    model = arm_model(bare)
    flange = model.frames[model.getFrameId("tool0")]
    centre = model.addFrame(
        pin.Frame(
            "centre",
            flange.parentJoint,
            flange.placement * pin.SE3(np.eye(3), load.centre_of_mass),
            pin.FrameType.OP_FRAME,
        )
    )
    data = model.createData()
    pin.forwardKinematics(model, data, q, v, a)
    pin.updateFramePlacements(model, data)
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    R = data.oMf[centre].rotation
    motion = pin.getFrameClassicalAcceleration(model, data, centre, world)
    omega = pin.getFrameVelocity(model, data, centre, world).angular
    inertia = R @ load.inertia @ R.T
    force = load.mass * (motion.linear - model.gravity.linear)
    moment = inertia @ motion.angular + np.cross(omega, inertia @ omega)
    jacobian = pin.computeFrameJacobian(model, model.createData(), q, centre, world)
    expected = pin.rnea(model, data, q, v, a) + jacobian.T @ np.concatenate([force, moment])
    assert found == pytest.approx(expected, abs=1e-10)
