"""Chains picked from a description written for the test: two arms, a lift and a gripper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from symbolic.errors import RobotModelError
from symbolic.read.arms import (
    arm_model,
    chain_joints,
    common_joints,
    held_joints,
    machine_problem,
    reduced_model,
    without_links,
)
from symbolic.read.urdf import FULL_TURNS, Urdf, parse_urdf
from symbolic.records import Robot, ToolLoad
from tests.robots import GOFA_URDF, robot_record

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
    ("root", "tip", "message"),
    [
        ("torsi", "left_5", "no link of machine.urdf; did you mean 'torso'"),
        ("left_5", "torso", "does not hang on"),
        ("left_0", "right_5", "does not hang on"),
    ],
)
def test_links_that_are_no_chain_are_told(root: str, tip: str, message: str) -> None:
    with pytest.raises(RobotModelError, match=message):
        chain_joints(urdf(), root, tip)


def test_everything_else_is_held_and_mimics_follow() -> None:
    moving = chain_joints(urdf(), "torso", "left_5")
    held = dict(held_joints(urdf(), moving, (("left_grip", 0.3),)))
    assert held["left_follow"] == pytest.approx(-2 * 0.3 + 0.5)
    assert held["right_follow"] == pytest.approx(0.5)
    assert held["lift"] == 0.0
    assert not set(moving) & set(held)
    assert len(moving) + len(held) == 1 + 2 * 8


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


def test_a_joint_without_zero_in_its_range_is_held_at_its_nearest_limit() -> None:
    text = machine().replace('lower="-2" upper="2"', 'lower="0.4" upper="2"', 1)
    held = dict(held_joints(parse_urdf(text.encode(), "m"), (), ()))
    assert held["lift"] == 0.4


def test_joints_that_cannot_be_held_are_told() -> None:
    with pytest.raises(RobotModelError, match=r"no moving joint 'lifd'.*did you mean 'lift'"):
        held_joints(urdf(), (), (("lifd", 0.0),))
    with pytest.raises(RobotModelError, match="'left_follow' mimics 'left_grip', which moves"):
        held_joints(urdf(), ("left_grip",), ())
    with pytest.raises(RobotModelError, match="'left_follow' of the chain mimics"):
        held_joints(urdf(), ("left_follow",), ())


def test_joints_that_follow_one_another_are_told_and_unknown_ones_are_left() -> None:
    circle = machine().replace('mimic joint="left_grip"', 'mimic joint="left_follow"')
    with pytest.raises(RobotModelError, match="follow one another in a circle"):
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
    with pytest.raises(RobotModelError, match=r"matches no link.*did you mean"):
        without_links(urdf(), ("left_thump",))
    with pytest.raises(RobotModelError, match="every link"):
        without_links(urdf(), ("*",))


def test_a_held_lift_moves_the_arm(tmp_path: Path) -> None:
    low, high = (
        arm_model(replace(arms(tmp_path)[0], locked_joints=(("lift", height),)))
        for height in (0.0, 0.7)
    )
    step = high.jointPlacements[1].translation - low.jointPlacements[1].translation
    assert step == pytest.approx([0.0, 0.0, 0.7])


def test_a_continuous_joint_has_one_coordinate_and_wide_limits() -> None:
    text = machine().replace('"left_3_x" type="revolute"', '"left_3_x" type="continuous"')
    model = reduced_model(parse_urdf(text.encode(), "m"))
    index = model.joints[model.getJointId("left_3_x")]
    assert index.nq == 1
    assert model.upperPositionLimit[index.idx_q] == FULL_TURNS
    assert model.velocityLimit[index.idx_v] == 3.0


def test_arms_of_one_machine_agree(tmp_path: Path) -> None:
    left, right = arms(tmp_path)
    assert machine_problem((left, right)) == ""
    lifted = replace(left, locked_joints=(("lift", 0.3),))
    assert "'lift' of the machine is held at 0.3" in machine_problem((lifted, right))
    both = replace(left, flange="left_4", chain_root="base")
    other = replace(right, flange="right_4", chain_root="base")
    assert machine_problem((both, other)) == ""
    assert common_joints((both, other)) == ("lift",)
    assert "'lift' moves robot 'right' too" in machine_problem((both, right))
    assert "names the same arm as robots[0]" in machine_problem((left, left))
    # The gripper of one arm is no business of the other.
    gripping = replace(left, locked_joints=(("left_grip", 0.3),))
    assert machine_problem((gripping, right)) == ""


def test_the_tool_weighs_on_the_joints() -> None:
    bare = robot_record(GOFA_URDF)
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
