"""Controllers of both arms in one controller manager: ros2 launch launch/control.launch.py

The description names mock hardware; a simulator's plugin goes in its place.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from launch import LaunchDescription
from launch_ros.actions import Node

BUNDLE = Path(__file__).resolve().parent.parent


def generate_launch_description() -> Any:
    """The controller manager, its controllers and the description."""
    description = {"robot_description": (BUNDLE / "description/cell.urdf").read_text()}
    controllers = str(BUNDLE / "config/controllers.yaml")
    names = ["joint_state_broadcaster", "carry_controller"]
    return LaunchDescription(
        [
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                parameters=[description],
            ),
            Node(
                package="controller_manager",
                executable="ros2_control_node",
                parameters=[description, controllers],
            ),
            Node(package="controller_manager", executable="spawner", arguments=names),
        ]
    )
