"""Both arms with ur_robot_driver, each in its namespace: ros2 launch launch/ur.launch.py"""

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

PORTS = ("reverse_port", "script_sender_port", "trajectory_port", "script_command_port")

FIRST_PORT, PORTS_PER_ARM = 50001, 10

ACTIVE = [
    "joint_state_broadcaster",
    "io_and_status_controller",
    "speed_scaling_state_broadcaster",
    "force_torque_sensor_broadcaster",
    "passthrough_trajectory_controller",
    "force_mode_controller",
]


def generate_launch_description() -> Any:
    """Per arm the description with the driver's hardware, a controller manager, controllers."""
    config = json.loads((BUNDLE / "config/cell.json").read_text())
    source = PathJoinSubstitution(
        [FindPackageShare("ur_robot_driver"), "launch", "ur_rsp.launch.py"]
    )
    groups = []
    for number, driver in enumerate(config["drivers"]):
        first = FIRST_PORT + PORTS_PER_ARM * number
        arguments = {
            "ur_type": driver["type"],
            "robot_ip": driver["address"],
            "tf_prefix": driver["prefix"],
            "headless_mode": "true",
            **{name: str(first + k) for k, name in enumerate(PORTS)},
        }
        groups.append(
            GroupAction(
                [
                    PushRosNamespace(driver["namespace"]),
                    IncludeLaunchDescription(
                        PythonLaunchDescriptionSource([source]), launch_arguments=arguments.items()
                    ),
                    Node(
                        package="controller_manager",
                        executable="ros2_control_node",
                        parameters=[str(BUNDLE / f"config/controllers_{number + 1}.yaml")],
                    ),
                    Node(package="controller_manager", executable="spawner", arguments=ACTIVE),
                ]
            )
        )
    return LaunchDescription(groups)
