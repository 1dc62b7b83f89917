"""Both arms with franka_ros2, each in its namespace: ros2 launch launch/franka.launch.py"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

BUNDLE = Path(__file__).resolve().parent.parent


def generate_launch_description() -> Any:
    """The maker's launch file once per arm, and the controller that carries."""
    config = json.loads((BUNDLE / "config/cell.json").read_text())
    source = PathJoinSubstitution(
        [FindPackageShare("franka_bringup"), "launch", "franka.launch.py"]
    )
    actions: list[Any] = []
    for number, driver in enumerate(config["drivers"], start=1):
        controllers = str(BUNDLE / f"config/controllers_{number}.yaml")
        arguments = {
            "robot_type": driver["type"],
            "arm_prefix": driver["prefix"],
            "namespace": driver["namespace"],
            "robot_ip": driver["address"],
            "load_gripper": "false",
            "controllers_yaml": controllers,
        }
        actions += [
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource([source]), launch_arguments=arguments.items()
            ),
            Node(
                package="controller_manager",
                executable="spawner",
                namespace=driver["namespace"],
                arguments=["carry_controller"],
            ),
        ]
    return LaunchDescription(actions)
