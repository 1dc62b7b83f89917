"""Files of the ROS 2 targets: descriptions by Pinocchio, parameters by controllers' rules."""

from __future__ import annotations

import ast
import io
import json
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
import yaml
import yourdfpy

from hybrid_opt.bundles.arms import description, ros_joints
from hybrid_opt.bundles.bundle import write_bundle
from hybrid_opt.bundles.job_file import pad_places
from symbolic.records.poses import pose_matrix
from tests.hybrid_opt.bundles.bundles import contents, exported, text_of
from tests.hybrid_opt.cells import shipped
from tests.hybrid_opt.job.jobs import rack

JOINTS = [f"{arm}_joint_{k}" for arm in ("left", "right") for k in range(1, 7)]

# joint_trajectory_controller_parameters.yaml of ros2_controllers: name -> kind.
JTC: dict[str, Any] = {
    "joints": list,
    "command_interfaces": list,
    "state_interfaces": list,
    "interpolate_from_desired_state": bool,
    "allow_nonzero_velocity_at_trajectory_end": bool,
    "action_monitor_rate": float,
    "constraints": dict,
    "gains": dict,
}
GAINS = {"p", "i", "d", "ff_velocity_scale", "u_clamp_max", "u_clamp_min"}


def judged(parameters: dict[str, Any]) -> None:
    """A joint trajectory controller's parameters as it judges them when it is configured."""
    assert set(parameters) <= set(JTC), set(parameters) - set(JTC)
    for name, value in parameters.items():
        assert isinstance(value, JTC[name]), name
    commands, states = parameters["command_interfaces"], parameters["state_interfaces"]
    # `command_interface_type_combinations`, `state_interface_type_combinations`.
    assert set(commands) <= {"position", "velocity", "acceleration", "effort"}
    if "effort" in commands:
        assert set(commands) in ({"effort"}, {"position", "effort"})
        assert {"position", "velocity"} <= set(states)
    if "velocity" in commands and len(commands) > 1:
        assert "position" in commands
    assert parameters["joints"]
    assert len(set(parameters["joints"])) == len(parameters["joints"])
    assert parameters["action_monitor_rate"] >= 0.1
    for joint, gains in parameters.get("gains", {}).items():
        assert joint in parameters["joints"]
        assert set(gains) <= GAINS
    if commands == ["effort"]:
        assert set(parameters.get("gains", {})) == set(parameters["joints"]), "it would fall"


def test_a_joint_that_moves_both_arms_is_there_once() -> None:
    """The lift of the TIAGo: in the hardware of its description and among the controller's joints,
    with the place of the left arm's."""
    workcell = shipped("tiago").workcell
    joints = ros_joints(workcell)
    assert len(joints) == 15
    assert joints["torso_lift_joint"] == 0
    assert list(joints.values()) == [*range(8), *range(9, 16)]
    q = np.arange(16.0)
    q[8] = q[0]
    (control,) = ElementTree.fromstring(description(workcell, q)).findall("ros2_control")
    first = {
        joint.attrib["name"]: float(joint.findtext("state_interface/param", "nan"))
        for joint in control.findall("joint")
    }
    assert first == {name: float(place) for name, place in joints.items()}
    assert len(control.findall("joint")) == len(joints)


def cell_controller() -> Any:
    document = yaml.safe_load(text_of("ros2-control", "config/controllers.yaml"))
    return document["carry_controller"]["ros__parameters"]


def test_controllers_accept_their_parameters() -> None:
    judged(cell_controller())
    assert cell_controller()["joints"] == JOINTS
    for arm in (1, 2):
        franka = yaml.safe_load(text_of("franka-ros2", f"config/controllers_{arm}.yaml"))["/**"]
        judged(franka["carry_controller"]["ros__parameters"])
        assert franka["controller_manager"]["ros__parameters"]["update_rate"] == 1000


def by_yourdfpy(text: str) -> yourdfpy.URDF:
    """The description as another reader takes it."""
    content = io.BytesIO(text.encode())
    found = yourdfpy.URDF.load(content, load_meshes=False, build_collision_scene_graph=False)
    if not found.validate():
        raise ValueError(found.errors)
    return found


def test_the_description_places_both_pads_on_the_box() -> None:
    """Read by Pinocchio and by yourdfpy: joints in the job's order lead both pads to the box."""
    text = text_of("ros2-control", "description/cell.urdf")
    model, other = pin.buildModelFromXML(text), by_yourdfpy(text)
    assert list(model.names)[1:] == list(other.actuated_joint_names) == JOINTS
    data, job = model.createData(), exported("ros2-control").sampled
    for k in range(job.span(1).start, job.span(5).stop, 15):
        pin.framesForwardKinematics(model, data, job.q[k])
        other.update_cfg(job.q[k])
        box = pose_matrix(job.pose[k, :3], job.pose[k, 3:])
        for arm, name in enumerate(("left_contact_pad", "right_contact_pad")):
            expected = box @ rack().workcell.contacts[arm].T_box_pad
            pad = data.oMf[model.getFrameId(name)].homogeneous
            np.testing.assert_allclose(pad, expected, atol=1e-5)
            np.testing.assert_allclose(other.get_transform(name, "world"), expected, atol=1e-5)


def test_the_description_weighs_what_the_efforts_hold() -> None:
    model = pin.buildModelFromXML(text_of("ros2-control", "description/cell.urdf"))
    data, job = model.createData(), exported("ros2-control").sampled
    for k in (0, 5, len(job.time) - 3):  # the pads touch nothing
        torque = pin.rnea(model, data, job.q[k], job.q_rate[k], job.q_second[k])
        np.testing.assert_allclose(job.effort[k], torque, atol=0.01)


# ros2_control.xsd of hardware_interface: element -> its attributes and children. The schema knows
# no parameters of state interfaces; the mock hardware's initial values are such.
HARDWARE = {
    "ros2_control": ({"name", "type"}, {"hardware", "joint"}),
    "hardware": (set(), {"plugin", "param"}),
    "plugin": (set(), set()),
    "joint": ({"name"}, {"command_interface", "state_interface"}),
    "command_interface": ({"name"}, {"param"}),
    "state_interface": ({"name"}, {"param"}),
    "param": ({"name"}, set()),
}


def judged_hardware(element: ElementTree.Element) -> None:
    """An element of the description's hardware as the schema judges it."""
    attributes, children = HARDWARE[element.tag]
    assert set(element.attrib) == attributes, element.attrib
    assert {child.tag for child in element} <= children
    order = [child.tag for child in element]
    assert order == sorted(order, key=["hardware", *order].index), "what is alike stands together"
    for child in element:
        judged_hardware(child)


def test_mock_hardware_begins_at_the_first_position() -> None:
    root = ElementTree.fromstring(text_of("ros2-control", "description/cell.urdf"))
    (control,) = root.findall("ros2_control")
    judged_hardware(control)
    assert control.findtext("hardware/plugin") == "mock_components/GenericSystem"
    joints = control.findall("joint")
    assert [joint.get("name") for joint in joints] == JOINTS
    values = [joint.findtext("state_interface/param") for joint in joints]
    first = exported("ros2-control").sampled.q[0]
    np.testing.assert_array_equal([float(value or "nan") for value in values], first)
    commands = [each.get("name") for each in joints[0].findall("command_interface")]
    assert cell_controller()["command_interfaces"] == commands == ["position", "effort"]


def config_of(target: str) -> Any:
    return json.loads(text_of(target, "config/cell.json"))


@pytest.mark.parametrize(
    ("target", "gravity"),
    [("ros2-control", "with_gravity"), ("franka-ros2", "without_gravity"), ("ur-ros2", "")],
)
def test_efforts_say_whose_gravity_they_hold(target: str, gravity: str) -> None:
    """A simulator needs the whole torque, Franka adds gravity by itself, UR takes no torques."""
    assert config_of(target)["effort"] == gravity


def test_frankas_know_their_tool_and_what_is_no_collision() -> None:
    calls = config_of("franka-ros2")["prepare"]
    assert [call["name"].rsplit("/", 1)[1] for call in calls] == [
        "set_load",
        "set_full_collision_behavior",
    ] * 2
    found = exported("franka-ros2")
    for arm, call in enumerate(calls[1::2]):
        torque = np.array(call["request"]["upper_torque_thresholds_nominal"])
        contact = found.holding - found.gravity
        assert (torque > np.abs(found.sampled.arm(arm, contact)).max(axis=0)).all()
        force = call["request"]["upper_force_thresholds_nominal"]
        assert min(force[:3]) > found.sampled.normal_force[:, arm].max()
    rate = np.diff(found.sampled.effort - found.gravity, axis=0)
    assert np.abs(rate / np.diff(found.sampled.time)[:, None]).max() < 1000.0


def test_force_mode_presses_into_the_box() -> None:
    """Its task frame on the flange is the pad's, whose z axis points into the box."""
    (force,) = config_of("ur-ros2")["force"]
    found, arm, request = exported("ur-ros2"), force["arm"], force["request"]
    assert arm == found.follower
    pose = request["task_frame"]["pose"]
    T = np.eye(4)
    x, y, z, w = (pose["orientation"][k] for k in "xyzw")
    T[:3, :3] = pin.Quaternion(w, x, y, z).toRotationMatrix()
    T[:3, 3] = [pose["position"][k] for k in "xyz"]
    robot = found.workcell.robots[arm]
    np.testing.assert_allclose(T, robot.T_flange_pad, atol=1e-12)
    assert request["task_frame"]["header"]["frame_id"] == f"right_{robot.flange}"
    sampled = found.sampled
    first = sampled.span(3).start
    (pad,) = pad_places(found.workcell, arm, sampled.arm(arm, sampled.q)[[first]])
    towards = sampled.pose[first, :3] - pad[:3, 3]
    assert pad[:3, 2] @ towards > 0.0
    selected = [axis for axis in ("x", "y", "z", "rx") if request[f"selection_vector_{axis}"]]
    assert selected == ["z"]
    assert 0.0 <= request["damping_factor"] <= 1.0
    assert 0.0 < request["gain_scaling"] <= 1.0


@pytest.mark.parametrize("target", ["ros2-control", "franka-ros2", "ur-ros2", "abb-egm"])
def test_programs_need_nothing_of_this_project(target: str) -> None:
    program = "run_egm.py" if target == "abb-egm" else "run_job.py"
    assert {program, "carry_job.py", "job.json"} <= set(contents(target))
    for name in (name for name in contents(target) if name.endswith(".py")):
        nodes = list(ast.walk(ast.parse(text_of(target, name))))
        modules = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
        assert not any(module.startswith("hybrid_opt") for module in modules), name


def launched(target: str, name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The actions of a bundle's launch file with the namespace of each, by stand-ins for launch."""
    write_bundle(folder, contents(target), {})

    def action(kind: str) -> Callable[..., Any]:
        return lambda *positional, **named: (kind, positional, named)

    text = (folder / f"launch/{name}.launch.py").read_text()
    for node in ast.walk(ast.parse(text)):
        module = getattr(node, "module", "") or ""
        if isinstance(node, ast.ImportFrom) and module.startswith("launch"):
            stub = types.ModuleType(module)
            vars(stub).update({alias.name: action(alias.name) for alias in node.names})
            monkeypatch.setitem(sys.modules, module, stub)
    space: dict[str, Any] = {"__file__": str(folder / f"launch/{name}.launch.py")}
    exec(compile(text, name, "exec"), space)
    found = []
    for kind, positional, named in space["generate_launch_description"]()[1][0]:
        group = positional[0] if kind == "GroupAction" else [(kind, positional, named)]
        pushed = next((a[1][0] for a in group if a[0] == "PushRosNamespace"), "")
        found += [(pushed, *a) for a in group if a[0] != "PushRosNamespace"]
    return found


@pytest.mark.parametrize(
    ("target", "name", "spaces"),
    [
        ("ros2-control", "control", [""] * 3),
        ("franka-ros2", "franka", ["", "left", "", "right"]),
        ("ur-ros2", "ur", ["left"] * 3 + ["right"] * 3),
    ],
)
def test_launch_files_start_what_the_programs_ask(
    target: str, name: str, spaces: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Controllers that actions and services belong to, in the namespaces that these have."""
    found = launched(target, name, tmp_path, monkeypatch)
    assert [space for space, *_ in found] == spaces
    config = config_of(target)
    spawned = {
        f"{space}/{controller}"
        for space, kind, _, named in found
        if kind == "Node" and named["executable"] == "spawner"
        for controller in named["arguments"]
    }
    names = [group["action"] for group in config["groups"]]
    names += [call["name"] for call in (*config["force"], *config["sliders"])]
    assert {each.removesuffix(f"/{each.rsplit('/', 1)[1]}").lstrip("/") for each in names} <= {
        each.lstrip("/") for each in spawned
    }
    for _, kind, _, named in found:
        files: list[str] = []
        if kind == "IncludeLaunchDescription":
            arguments = dict(named["launch_arguments"])
            assert arguments["robot_ip"] == "192.168.0.10"
            files = [v for v in arguments.values() if v.endswith(".yaml")]
        elif named["executable"] == "ros2_control_node":
            files = [each for each in named["parameters"] if isinstance(each, str)]
        assert all(Path(file).is_file() for file in files)
