"""The programs of a ROS 2 bundle, which run where ROS 2 is installed."""

LAUNCH = '''"""Mock hardware, controllers, description: ros2 launch launch/bringup.launch.py"""

from pathlib import Path

import yaml
from launch import LaunchDescription
from launch_ros.actions import Node

BUNDLE = Path(__file__).resolve().parent.parent


def generate_launch_description():
    description = {"robot_description": (BUNDLE / "description/cell.urdf").read_text()}
    controllers = str(BUNDLE / "config/controllers.yaml")
    names = yaml.safe_load((BUNDLE / "config/controllers.yaml").read_text())
    parameters = names["controller_manager"]["ros__parameters"]
    to_start = [name for name, value in parameters.items() if isinstance(value, dict)]
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
            Node(package="controller_manager", executable="spawner", arguments=to_start),
        ]
    )
'''

RUN = '''"""Drives the job, phase by phase: python3 run_job.py (beside a running bringup)

All goals of a phase are stamped with one start time, so that controllers of two arms start in the
same cycle. Wrench references are published along with the motion. The next phase begins only when
every goal of the last one was reached.
"""

import sys
from pathlib import Path

import rclpy
import yaml
from control_msgs.action import FollowJointTrajectory
from geometry_msgs.msg import WrenchStamped
from rclpy.action import ActionClient
from rclpy.duration import Duration
from rosidl_runtime_py import set_message_fields

BUNDLE = Path(__file__).resolve().parent
LEAD = 0.2  # [s] from sending a goal to its start


def read(name):
    return yaml.safe_load((BUNDLE / name).read_text())


class References:
    def __init__(self, node):
        self.node = node
        self.robots = []
        for robot in read("wrench_references.yaml")["robots"]:
            publisher = node.create_publisher(WrenchStamped, robot["topic"], 10)
            times = [m["header"]["stamp"] for m in robot["messages"]]
            seconds = [t["sec"] + 1e-9 * t["nanosec"] for t in times]
            self.robots.append((publisher, seconds, robot["messages"]))

    def publish(self, moment):
        for publisher, seconds, messages in self.robots:
            index = max(0, sum(second <= moment for second in seconds) - 1)
            message = WrenchStamped()
            set_message_fields(message, messages[index])
            message.header.stamp = self.node.get_clock().now().to_msg()
            publisher.publish(message)


def main():
    rclpy.init()
    node = rclpy.create_node("run_job")
    references = References(node)
    clients = {}
    for phase in read("job.yaml")["phases"]:
        node.get_logger().info(f"phase {phase['name']}")
        goals = {}
        for controller, path in phase["goals"].items():
            goal = FollowJointTrajectory.Goal()
            set_message_fields(goal, read(path))
            goals[controller] = goal
            if controller not in clients:
                action = f"/{controller}/follow_joint_trajectory"
                clients[controller] = ActionClient(node, FollowJointTrajectory, action)
                if not clients[controller].wait_for_server(timeout_sec=10.0):
                    sys.exit(f"{action} is not there; is the bringup running?")
        start = node.get_clock().now() + Duration(seconds=LEAD)
        sent = []
        for controller, goal in goals.items():
            goal.trajectory.header.stamp = start.to_msg()
            sent.append(clients[controller].send_goal_async(goal))
        for future in sent:
            rclpy.spin_until_future_complete(node, future)
        handles = [future.result() for future in sent]
        if not all(handle.accepted for handle in handles):
            for handle in handles:
                if handle.accepted:
                    handle.cancel_goal_async()
            sys.exit(f"phase {phase['name']}: a controller refused its goal; nothing moves")
        results = [handle.get_result_async() for handle in handles]
        while not all(result.done() for result in results):
            rclpy.spin_once(node, timeout_sec=0.005)
            elapsed = (node.get_clock().now() - start).nanoseconds * 1e-9
            references.publish(min(phase["begin"] + max(elapsed, 0.0), phase["end"]))
            failed = [r for r in results if r.done() and r.result().result.error_code != 0]
            if failed:
                for handle in handles:
                    handle.cancel_goal_async()
                sys.exit(f"phase {phase['name']}: {failed[0].result().result.error_string}")
    node.get_logger().info("done")


if __name__ == "__main__":
    main()
'''
