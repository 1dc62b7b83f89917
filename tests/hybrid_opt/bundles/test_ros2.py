"""The ROS 2 bundle, read by PyYAML, by ROS 2's message definitions (rosbags) and by Pinocchio."""

from __future__ import annotations

import ast
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml
from rosbags.typesys import Stores, get_typestore

from symbolic.records.poses import pose_matrix
from tests.hybrid_opt.bundles.bundles import contents, sampled, text_of
from tests.hybrid_opt.job.jobs import rack, rack_job

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINTS = [f"{arm}_joint_{k}" for arm in ("left", "right") for k in range(1, 7)]


def message(value: dict[str, Any], kind: str) -> Any:
    """A message object of ROS 2's own definition; unknown or missing fields are errors."""
    fields = STORE.get_msgdef(kind).fields
    assert [name for name, _ in fields] == list(value), kind
    return STORE.types[kind](
        **{
            name: _field(value[name], node)
            for name, (name, node) in zip(value, fields, strict=True)
        }
    )


def _field(value: Any, node: Any) -> Any:
    sort, description = node
    if sort.name == "NAME":
        return message(value, description)
    if sort.name == "BASE":
        return value
    (inner, name), _ = description
    if inner.name == "NAME":
        return [message(each, name) for each in value]
    return list(value) if name[0] == "string" else np.array(value, dtype=name[0])


def round_trip(value: dict[str, Any], kind: str) -> Any:
    """A message through ROS 2's own serialisation."""
    return STORE.deserialize_cdr(STORE.serialize_cdr(message(value, kind), kind), kind)


def test_the_whole_job_is_one_joint_trajectory() -> None:
    document = yaml.safe_load(text_of("ros2", "dual_arm_joint_trajectory.yaml"))
    found = round_trip(document, "trajectory_msgs/msg/JointTrajectory")
    job = sampled()
    assert found.joint_names == JOINTS
    assert len(found.points) == len(job.time)
    for k, point in enumerate(found.points):
        stamp = point.time_from_start
        assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(job.time[k], abs=1e-9)
        np.testing.assert_array_equal(point.positions, job.q[k])
        np.testing.assert_array_equal(point.velocities, job.q_rate[k])
        np.testing.assert_array_equal(point.accelerations, job.q_second[k])
        np.testing.assert_array_equal(point.effort, job.effort[k])


@pytest.mark.parametrize("per_arm", [False, True])
def test_each_phase_is_a_goal(per_arm: bool) -> None:
    index = yaml.safe_load(text_of("ros2", "job.yaml", per_arm))
    assert [phase["name"] for phase in index["phases"]] == [p.name for p in rack_job().phases]
    controllers = yaml.safe_load(text_of("ros2", "config/controllers.yaml", per_arm))
    job = sampled()
    for place, phase in enumerate(index["phases"]):
        columns: list[str] = []
        for controller, path in phase["goals"].items():
            goal = yaml.safe_load(text_of("ros2", path, per_arm))
            names = goal["trajectory"]["joint_names"]
            columns += names
            assert controllers[controller]["ros__parameters"]["joints"] == names
            assert {"trajectory", "path_tolerance", "goal_tolerance", "goal_time_tolerance"} == set(
                goal
            )
            assert [each["name"] for each in goal["goal_tolerance"]] == names
            trajectory = round_trip(goal["trajectory"], "trajectory_msgs/msg/JointTrajectory")
            span = job.span(place)
            assert trajectory.points[0].time_from_start.sec == 0
            last = trajectory.points[-1]
            wanted = [JOINTS.index(name) for name in names]
            np.testing.assert_array_equal(last.positions, job.q[span.stop - 1, wanted])
            np.testing.assert_allclose(last.velocities, 0.0, atol=1e-9)
            end = last.time_from_start.sec + 1e-9 * last.time_from_start.nanosec
            assert end == pytest.approx(phase["end"] - phase["begin"], abs=1e-8)
        assert columns == JOINTS
        assert len(phase["goals"]) == (2 if per_arm else 1)


def test_wrench_references_are_along_the_pads() -> None:
    document = yaml.safe_load(text_of("ros2", "wrench_references.yaml"))
    job = sampled()
    assert [robot["force_controlled"] for robot in document["robots"]] == [False, True]
    for arm, robot in enumerate(document["robots"]):
        assert len(robot["messages"]) == len(job.time)
        for k in range(0, len(job.time), 20):
            found = round_trip(robot["messages"][k], "geometry_msgs/msg/WrenchStamped")
            assert found.wrench.force.z == pytest.approx(job.normal_force[k, arm], abs=1e-6)
            size = np.linalg.norm(job.wrench[k, arm, :3])
            both = [found.wrench.force.x, found.wrench.force.y, found.wrench.force.z]
            assert np.linalg.norm(both) == pytest.approx(size, abs=1e-6)


def test_the_description_places_both_pads_on_the_box() -> None:
    """Read by Pinocchio: joints in the trajectory's order lead both pads to the box."""
    model = pin.buildModelFromXML(text_of("ros2", "description/cell.urdf"))
    assert list(model.names)[1:] == JOINTS
    data = model.createData()
    job = sampled()
    press = job.span(1)
    for k in range(press.start, job.span(5).stop, 15):
        pin.framesForwardKinematics(model, data, job.q[k])
        box = pose_matrix(job.pose[k, :3], job.pose[k, 3:])
        for arm, name in enumerate(("left_contact_pad", "right_contact_pad")):
            pad = data.oMf[model.getFrameId(name)].homogeneous
            expected = box @ rack().workcell.contacts[arm].T_box_pad
            np.testing.assert_allclose(pad, expected, atol=1e-5)


def test_the_description_weighs_what_the_efforts_hold() -> None:
    model = pin.buildModelFromXML(text_of("ros2", "description/cell.urdf"))
    data, job = model.createData(), sampled()
    for k in (0, 5, len(job.time) - 3):  # the pads touch nothing
        torque = pin.rnea(model, data, job.q[k], job.q_rate[k], job.q_second[k])
        np.testing.assert_allclose(job.effort[k], torque, atol=0.01)


def test_mock_hardware_begins_at_the_first_position() -> None:
    import xml.etree.ElementTree as tree

    root = tree.fromstring(text_of("ros2", "description/cell.urdf"))
    control = root.find("ros2_control")
    assert control is not None
    assert control.findtext("hardware/plugin") == "mock_components/GenericSystem"
    joints = control.findall("joint")
    assert [joint.get("name") for joint in joints] == JOINTS
    values = [joint.findtext("state_interface/param") for joint in joints]
    np.testing.assert_array_equal([float(value or "nan") for value in values], sampled().q[0])
    commands = [each.get("name") for each in joints[0].findall("command_interface")]
    parameters = yaml.safe_load(text_of("ros2", "config/controllers.yaml"))
    controller = parameters["dual_arm_controller"]["ros__parameters"]
    assert controller["command_interfaces"] == commands == ["position", "effort"]
    assert parameters["controller_manager"]["ros__parameters"]["update_rate"] == 1000


def test_its_programs_are_python() -> None:
    for name in ("run_job.py", "launch/bringup.launch.py"):
        tree = ast.parse(text_of("ros2", name))
        functions = [each.name for each in ast.walk(tree) if isinstance(each, ast.FunctionDef)]
        assert {"main", "generate_launch_description"} & set(functions)
    assert {"run_job.py", "job.yaml"} <= set(contents("ros2"))
