"""Both arms' controllers, as `config/cell.json` lists them: ros2 launch launch/NAME.launch.py

carry_controller stays inactive: run_job.py activates it once the arms know their loads. A simulator
brings its own controller manager, with config/controllers.yaml.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from launch import LaunchDescription
from launch.actions import GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node, PushRosNamespace
from launch_ros.substitutions import FindPackageShare

BUNDLE = Path(__file__).resolve().parent.parent


def generate_launch_description() -> Any:
    """Return the launch description of both arms, with all entries under `launch` of
    config/cell.json.
    """
    config = json.loads((BUNDLE / "config/cell.json").read_text())
    return LaunchDescription([action for each in config["launch"] for action in actions(each)])


def actions(each: dict[str, Any]) -> list[Any]:
    """Return the launch actions of one robot, or of one controller manager, of config/cell.json.

    The actions start a driver's launch file or a robot description, then a controller manager if
    the table names parameter files, then the controllers.

    Args:
        each: one table of config/cell.json with the keys `namespace`, `parameters` (paths of
            parameter files in the bundle) and `controllers` (names), all possibly empty. For a
            driver it has also `package`, `file` and `arguments` of its launch file.
    """
    parameters: list[Any] = [str(BUNDLE / name) for name in each["parameters"]]
    outside, inside = list[Any](), list[Any]()
    if each["namespace"]:
        inside.append(PushRosNamespace(each["namespace"]))
    if "package" in each:
        path = PathJoinSubstitution([FindPackageShare(each["package"]), "launch", each["file"]])
        arguments = {k: v.replace("BUNDLE", str(BUNDLE)) for k, v in each["arguments"].items()}
        include = IncludeLaunchDescription(
            PythonLaunchDescriptionSource([path]), launch_arguments=arguments.items()
        )
        # Launch files that take a namespace put themselves into it.
        (outside if "namespace" in arguments else inside).append(include)
    else:
        text = {"robot_description": (BUNDLE / "description/cell.urdf").read_text()}
        name = "robot_state_publisher"
        inside.append(Node(package=name, executable=name, parameters=[text]))
    package = "controller_manager"
    if parameters:
        inside.append(Node(package=package, executable="ros2_control_node", parameters=parameters))
    for names in (each["controllers"], ["carry_controller", "--inactive"]):
        if names:
            inside.append(Node(package=package, executable="spawner", arguments=names))
    return [*outside, GroupAction(inside)]
