"""A job for ROS 2: trajectories and goals as messages in YAML, wrench references, a launch file.

Messages as ROS 2 defines them: trajectory_msgs/JointTrajectory, control_msgs/action/
FollowJointTrajectory (its goal), geometry_msgs/WrenchStamped. docs/export.md says how to run it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import yaml

from hybrid_opt.bundles.arms import description, prefixes
from hybrid_opt.bundles.manifest import BundleOptions
from hybrid_opt.job.records import Job, SampledJob
from symbolic.array import Array
from symbolic.records.poses import box_rotation

UPDATE_RATE = 1000
"""Update rate of the controller manager [Hz]."""

PATH_TOLERANCE = 0.02
GOAL_TOLERANCE = 0.002
"""Tolerances of every joint on the path and at the goal [rad]."""

GOAL_TIME = 0.5
"""How much later than planned a goal may be reached [s]."""

JOINT_STATES = "joint_state_broadcaster"
CONTROLLER = "joint_trajectory_controller/JointTrajectoryController"

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


def ros2_files(sampled: SampledJob, options: BundleOptions) -> dict[str, str | bytes]:
    """All files of a bundle for ROS 2 by their paths."""
    job = sampled.job
    groups = joint_groups(job, options.per_arm)
    files: dict[str, str | bytes] = {
        "description/cell.urdf": description(job.workcell, sampled.q[0]),
        "config/controllers.yaml": _yaml(controllers(job, groups)),
        "launch/bringup.launch.py": LAUNCH,
        "run_job.py": RUN,
        "wrench_references.yaml": _yaml(wrench_references(sampled)),
    }
    phases = []
    for index, phase in enumerate(job.phases):
        goals = {}
        for name, columns in groups.items():
            path = f"goals/{index + 1}_{phase.name}{'' if len(groups) == 1 else f'_{name}'}.yaml"
            names = [job_joints(job)[column] for column in columns]
            message = joint_trajectory(sampled, sampled.span(index), names, columns)
            files[path] = _yaml(follow_goal(message))
            goals[f"{name}_controller"] = path
        span = sampled.span(index)
        phases.append(
            {
                "name": phase.name,
                "begin": float(sampled.time[span.start]),
                "end": float(sampled.time[span.stop - 1]),
                "goals": goals,
            }
        )
    files["job.yaml"] = _yaml({"phases": phases})
    whole = slice(0, len(sampled.time))
    for name, columns in groups.items():
        names = [job_joints(job)[column] for column in columns]
        message = joint_trajectory(sampled, whole, names, columns)
        files[f"{name}_joint_trajectory.yaml"] = _yaml(message)
    return files


def job_joints(job: Job) -> tuple[str, ...]:
    """Names of all joints in ROS: each behind its robot's prefix."""
    return tuple(
        f"{prefix}{joint}"
        for prefix, joints in zip(prefixes(job.workcell), job.joint_names, strict=True)
        for joint in joints
    )


def joint_groups(job: Job, per_arm: bool) -> dict[str, list[int]]:
    """The joints that one controller drives, by its name: their columns."""
    first = len(job.joint_names[0])
    everything = list(range(first + len(job.joint_names[1])))
    if not per_arm:
        return {"dual_arm": everything}
    return {"arm_1": everything[:first], "arm_2": everything[first:]}


def joint_trajectory(
    sampled: SampledJob, span: slice, names: Sequence[str], columns: Sequence[int]
) -> dict[str, Any]:
    """A trajectory_msgs/msg/JointTrajectory of some joints over some samples."""
    begin = float(sampled.time[span.start])

    def rows(values: Array) -> list[list[float]]:
        found: list[list[float]] = values[span][:, list(columns)].tolist()
        return found

    quantities = zip(
        rows(sampled.q),
        rows(sampled.q_rate),
        rows(sampled.q_second),
        rows(sampled.effort),
        sampled.time[span].tolist(),
        strict=True,
    )
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "joint_names": list(names),
        "points": [
            {
                "positions": q,
                "velocities": rate,
                "accelerations": second,
                "effort": effort,
                "time_from_start": duration(time - begin),
            }
            for q, rate, second, effort, time in quantities
        ],
    }


def follow_goal(trajectory: dict[str, Any]) -> dict[str, Any]:
    """A control_msgs/action/FollowJointTrajectory goal that drives a trajectory."""

    def tolerances(position: float) -> list[dict[str, Any]]:
        return [
            {"name": name, "position": position, "velocity": 0.0, "acceleration": 0.0}
            for name in trajectory["joint_names"]
        ]

    return {
        "trajectory": trajectory,
        "path_tolerance": tolerances(PATH_TOLERANCE),
        "goal_tolerance": tolerances(GOAL_TOLERANCE),
        "goal_time_tolerance": duration(GOAL_TIME),
    }


def wrench_references(sampled: SampledJob) -> dict[str, Any]:
    """Per robot the force that its pad exerts on the box, as geometry_msgs/msg/WrenchStamped.

    Along the pad's own axes, z into the box, about its centre: so the reference of a force
    controller is `force.z`.
    """
    robots = []
    for arm, (prefix, robot) in enumerate(
        zip(prefixes(sampled.job.workcell), sampled.job.workcell.robots, strict=True)
    ):
        frame = pad_frame(prefix, arm)
        robots.append(
            {
                "robot": robot.name,
                "force_controlled": arm != sampled.job.squeeze.leader,
                "topic": f"/{frame}/wrench_reference",
                "messages": [
                    {
                        "header": {"stamp": duration(time), "frame_id": frame},
                        "wrench": wrench_message(row),
                    }
                    for time, row in zip(
                        sampled.time.tolist(), pad_wrench(sampled, arm).tolist(), strict=True
                    )
                ],
            }
        )
    return {"robots": robots}


def pad_wrench(sampled: SampledJob, arm: int) -> Array:
    """(n, 6) force and moment that a pad exerts on the box, along the pad's axes [N, N m]."""
    T_box_pad = sampled.job.workcell.contacts[arm].T_box_pad
    turned = box_rotation(sampled.job.workcell.task.orientation, sampled.pose)
    R_world_pad = turned @ T_box_pad[:3, :3]
    both = sampled.wrench[:, arm].reshape(-1, 2, 3)
    return np.asarray(np.einsum("nji,nkj->nki", R_world_pad, both).reshape(-1, 6))


def wrench_message(wrench: Sequence[float]) -> dict[str, Any]:
    """A geometry_msgs/msg/Wrench of force and moment (6,)."""
    return {
        "force": dict(zip("xyz", wrench[:3], strict=True)),
        "torque": dict(zip("xyz", wrench[3:], strict=True)),
    }


def pad_frame(prefix: str, arm: int) -> str:
    """Name of a pad's frame."""
    return f"{prefix or f'arm_{arm + 1}_'}contact_pad"


def controllers(job: Job, groups: dict[str, list[int]]) -> dict[str, Any]:
    """The parameters of ros2_control's controller manager and controllers."""
    document: dict[str, Any] = {
        "controller_manager": {
            "ros__parameters": {
                "update_rate": UPDATE_RATE,
                JOINT_STATES: {"type": f"{JOINT_STATES}/JointStateBroadcaster"},
                **{f"{name}_controller": {"type": CONTROLLER} for name in groups},
            }
        }
    }
    for name, columns in groups.items():
        joints = [job_joints(job)[column] for column in columns]
        document[f"{name}_controller"] = {
            "ros__parameters": {
                "joints": joints,
                # The effort of each point is passed on as it is: a feed-forward beside positions.
                "command_interfaces": ["position", "effort"],
                "state_interfaces": ["position", "velocity"],
                "allow_nonzero_velocity_at_trajectory_end": False,
                "constraints": {
                    "stopped_velocity_tolerance": 0.01,
                    "goal_time": GOAL_TIME,
                    **{
                        joint: {"trajectory": PATH_TOLERANCE, "goal": GOAL_TOLERANCE}
                        for joint in joints
                    },
                },
            }
        }
    return document


def duration(seconds: float) -> dict[str, int]:
    """A builtin_interfaces/msg/Duration, or Time."""
    nanoseconds = round(seconds * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def _yaml(document: Any) -> str:
    # The C library's dumper is some times faster, and not part of every PyYAML.
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    text: str = yaml.dump(document, Dumper=dumper, sort_keys=False, width=10_000)
    return text
