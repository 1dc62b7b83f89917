"""Files of the torque target: descriptions by Pinocchio, parameters by controllers' rules."""

from __future__ import annotations

import ast
import io
import json
import sys
import types
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
import yaml
import yourdfpy

from hybrid_opt.extras.bundles.arms import description, ros_joints
from hybrid_opt.extras.bundles.job_file import pad_places
from hybrid_opt.extras.bundles.targets import target_for
from hybrid_opt.extras.bundles.torque import (
    driver_of,
    joint_inertia,
    joint_stiffness,
    pad_stiffness,
)
from hybrid_opt.store.bundle_file import write_bundle
from symbolic.errors import SettingsError
from symbolic.records.poses import pose_matrix
from tests.hybrid_opt.cells import shipped
from tests.hybrid_opt.extras.bundles.bundles import DRIVER, contents, driven, exported, text_of
from tests.hybrid_opt.job.jobs import planned, rack
from tests.refusals import refused

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


def parameters(driver: str = "simulation", arm: str = "") -> Any:
    """All parameters of a driver's controllers, by controller."""
    text = text_of("torque", f"config/controllers{arm}.yaml", driver)
    return {n: v["ros__parameters"] for n, v in yaml.safe_load(text)["/**"].items()}


def cell_controller() -> Any:
    return parameters()["carry_controller"]


def test_controllers_accept_their_parameters() -> None:
    judged(cell_controller())
    assert cell_controller()["joints"] == JOINTS
    for driver, rate in (("franka", 1000), ("ur", 500)):
        for arm in (0, 1):
            known = parameters(driver, f"_{arm + 1}")
            judged(known["carry_controller"])
            assert known["carry_controller"]["joints"] == JOINTS[6 * arm : 6 * arm + 6]
            assert known["controller_manager"]["update_rate"] == rate
            # Every one has a type.
            assert set(known) - {"controller_manager"} <= set(known["controller_manager"])


def test_gains_are_those_of_damped_soft_joints() -> None:
    """Each joint of the arm alone, held by its gains, against its own inertia: a damping ratio of
    0.7, and far from what a sampled derivative makes unstable."""
    job = exported("torque").job
    inertia, gains = joint_inertia(job), cell_controller()["gains"]
    torque = job.workcell.stack_joint_limits("torque_max")
    for k, joint in enumerate(JOINTS):
        p, d = gains[joint]["p"], gains[joint]["d"]
        assert p <= 7.0 * torque[k] + 1e-9
        poles = np.roots([inertia[k], d, p])
        np.testing.assert_allclose(-poles.real / np.abs(poles), 0.7, atol=1e-9)
        # Semi-implicit Euler at 500 Hz, which needs no more of a joint than its inertia.
        step = np.array([[1.0 - 0.002 * d / inertia[k], -0.002 * p / inertia[k]], [0.002, 1.0]])
        step[1] += 0.002 * (step[0] - [1.0, 0.0])
        assert np.abs(np.linalg.eigvals(step)).max() < 1.0


def test_the_pads_are_as_stiff_as_the_gains_make_them() -> None:
    """By differences: the displacement of both pads along the normal under opposite forces."""
    job = exported("torque").job
    first = len(job.joint_names[0])
    stiff = 0.0
    for phase in job.held:
        for q in phase.motion.q[::10]:
            apart = 0.0
            for arm, span in enumerate((slice(0, first), slice(first, None))):
                gains, h = joint_stiffness(job)[span], 1e-6
                own = q[span]
                moved = np.array([own, *(own + h * np.eye(len(own)))])
                pads = pad_places(job.workcell, arm, moved)
                along = (pads[1:, :3, 3] - pads[0, :3, 3]) @ pads[0, :3, 2] / h
                apart += float((along**2 / gains).sum())
            stiff = max(stiff, 2.0 / apart)
    assert pad_stiffness(job) == pytest.approx(stiff, rel=1e-4)


def by_yourdfpy(text: str) -> yourdfpy.URDF:
    """The description as another reader takes it."""
    content = io.BytesIO(text.encode())
    found = yourdfpy.URDF.load(content, load_meshes=False, build_collision_scene_graph=False)
    if not found.validate():
        raise ValueError(found.errors)
    return found


def test_the_description_places_both_pads_on_the_box() -> None:
    """Read by Pinocchio and by yourdfpy: joints in the job's order lead both pads to the box."""
    text = text_of("torque", "description/cell.urdf")
    model, other = pin.buildModelFromXML(text), by_yourdfpy(text)
    assert list(model.names)[1:] == list(other.actuated_joint_names) == JOINTS
    data, job = model.createData(), exported("torque").sampled
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
    model = pin.buildModelFromXML(text_of("torque", "description/cell.urdf"))
    data, job = model.createData(), exported("torque").sampled
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


def test_simulated_hardware_begins_at_the_first_position() -> None:
    root = ElementTree.fromstring(text_of("torque", "description/cell.urdf"))
    (control,) = root.findall("ros2_control")
    judged_hardware(control)
    assert control.findtext("hardware/plugin") == "gz_ros2_control/GazeboSimSystem"
    weightless = {each.get("reference") for each in root.findall("gazebo[gravity='false']")}
    assert weightless == {link.get("name") for link in root.findall("link")}
    joints = control.findall("joint")
    assert [joint.get("name") for joint in joints] == JOINTS
    values = [joint.findtext("state_interface/param") for joint in joints]
    first = exported("torque").sampled.q[0]
    np.testing.assert_array_equal([float(value or "nan") for value in values], first)
    commands = [each.get("name") for each in joints[0].findall("command_interface")]
    assert cell_controller()["command_interfaces"] == commands == ["effort"]


def config_of(driver: str) -> Any:
    return json.loads(text_of("torque", "config/cell.json", driver))


def test_frankas_know_their_tool_and_what_is_no_collision() -> None:
    calls = config_of("franka")["prepare"]
    # libfranka sets a load only while no motion runs.
    order = ["switch_controller", "set_load", "set_full_collision_behavior", "switch_controller"]
    assert [call["name"].rsplit("/", 1)[1] for call in calls] == 2 * order
    found = exported("torque", "franka")
    for arm, call in enumerate(calls[2::4]):
        (request,) = call["requests"]
        torque = np.array(request["upper_torque_thresholds_nominal"])
        contact = found.holding - found.gravity
        assert (torque > np.abs(found.sampled.arm(arm, contact)).max(axis=0)).all()
        force = request["upper_force_thresholds_nominal"]
        assert min(force[:3]) > found.sampled.normal_force[:, arm].max()
    rate = np.diff(found.sampled.effort - found.gravity, axis=0)
    assert np.abs(rate / np.diff(found.sampled.time)[:, None]).max() < 1000.0


def test_forces_are_read_where_drivers_publish_them() -> None:
    """force_torque_sensor_broadcaster on `~/wrench` on all branches, franka_ros2's broadcaster."""
    topics = {
        "ur": "/{}/force_torque_sensor_broadcaster/wrench",
        "franka": "/{}/franka_robot_state_broadcaster/external_wrench_in_stiffness_frame",
    }
    for driver, topic in topics.items():
        wrench = config_of(driver)["wrench"]
        assert [each["topic"] for each in wrench] == [topic.format(n) for n in ("left", "right")]
    assert config_of("simulation")["wrench"] == [None, None]


@pytest.mark.parametrize("target", ["torque", "abb-egm"])
def test_programs_need_nothing_of_this_project(target: str) -> None:
    program = "run_egm.py" if target == "abb-egm" else "run_job.py"
    assert {program, "carry_job.py", "job.json"} <= set(contents(target))
    for name in (name for name in contents(target) if name.endswith(".py")):
        nodes = list(ast.walk(ast.parse(text_of(target, name))))
        modules = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
        assert not any(module.startswith("hybrid_opt") for module in modules), name


def launched(driver: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The actions of a bundle's launch file with the namespace of each, by stand-ins for launch."""
    write_bundle(folder, contents("torque", driver), {})
    name = driver

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
    ("driver", "spaces"),
    [
        ("simulation", [""] * 3),
        ("franka", ["", "left", "", "right"]),
        ("ur", ["left"] * 4 + ["right"] * 4),
    ],
)
def test_launch_files_start_what_the_programs_ask(
    driver: str, spaces: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Controllers that actions and services belong to, in the namespaces that these have; the one
    that drives the arms inactive, until the program activates it."""
    found = launched(driver, tmp_path, monkeypatch)
    assert [space for space, *_ in found] == spaces
    config = config_of(driver)
    spawned = {
        f"{space}/{controller}".lstrip("/"): "--inactive" in named["arguments"]
        for space, kind, _, named in found
        if kind == "Node" and named["executable"] == "spawner"
        for controller in named["arguments"]
        if controller != "--inactive"
    }
    driving = [g["action"].removesuffix("/follow_joint_trajectory") for g in config["groups"]]
    assert {name for name, inactive in spawned.items() if inactive} == {
        name.lstrip("/") for name in driving
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


def by(name: str, joints: str = "", **stated: Any) -> Any:
    """A cell's job with something stated of its drivers, its joints called otherwise."""
    job = driven(planned(name), replace(DRIVER, **stated))
    if joints:
        north, south = (tuple(n.replace("panda", joints) for n in own) for own in job.joint_names)
        job = replace(job, joint_names=(north, south))
    return job


@pytest.mark.parametrize(
    ("job", "code", "quoted"),
    [
        (lambda: by("pandas"), "joint-names", "fer, fp3, fr3, fr3v2"),
        (lambda: by("pandas", "fr3", prefix="l"), "prefix", "'_'"),
        (lambda: by("rack"), "no-driver", "abb-egm"),
    ],
)
def test_drivers_know_their_arms(job: Callable[[], Any], code: str, quoted: str) -> None:
    with refused(SettingsError, code, quoted):
        target_for("torque", job().workcell).refuse(job(), "torque", any_arm=False)


def test_arms_without_addresses_are_simulated() -> None:
    assert driver_of(by("rack", address="").workcell) == "simulation"
    assert driver_of(by("pandas").workcell) == "franka"
    first, second = by("rack").workcell.robots
    lone = replace(second, driver=replace(DRIVER, address=""))
    with refused(SettingsError, "one-address"):
        driver_of(replace(by("rack").workcell, robots=(first, lone)))
