"""The export formats by name."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from hybrid_opt.errors import ResultsError
from hybrid_opt.store.export.rapid import rapid_modules
from hybrid_opt.store.export.samples import SampledTrajectory
from symbolic.errors import SettingsError

JSON_FORMAT = "dual-arm-carry timed trajectory"
JSON_VERSION = 1
_POSE = ("x [m]", "y [m]", "z [m]", "roll [rad]", "pitch [rad]", "yaw [rad]")
_JOINT_QUANTITIES = (
    ("position", "rad"),
    ("velocity", "rad/s"),
    ("acceleration", "rad/s^2"),
)


def export_trajectory(
    trajectory: SampledTrajectory, form: str, folder: str | Path, stem: str = "trajectory"
) -> tuple[Path, ...]:
    """Write a trajectory in one of `FORMATS` into a folder, which is made where missing.

    Args:
        form: name of the format.
        stem: beginning of the file names.

    Returns:
        The files written.

    Raises:
        SettingsError: the format is unknown.
        ResultsError: a file cannot be written.
    """
    if form not in FORMATS:
        raise SettingsError(f"unknown format {form!r}; known are {', '.join(FORMATS)}")
    folder = Path(folder)
    paths = []
    for suffix, text in FORMATS[form](trajectory).items():
        path = folder / f"{stem}{suffix}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8", newline="")
        except OSError as error:
            raise ResultsError(f"{path}: cannot be written ({error.strerror})") from error
        paths.append(path)
    return tuple(paths)


def csv_text(trajectory: SampledTrajectory) -> str:
    """One row per time step, one column per quantity, named with its unit."""
    header = ["time [s]", *(f"box {name}" for name in _POSE)]
    for quantity, unit in _JOINT_QUANTITIES:
        for robot, joints in zip(trajectory.robots, trajectory.joints, strict=True):
            header += [f"{robot}/{joint} {quantity} [{unit}]" for joint in joints]
    header += [f"{robot} normal force [N]" for robot in trajectory.robots]
    columns = [
        trajectory.time[:, None],
        trajectory.pose,
        *(getattr(trajectory, quantity).reshape(-1, 12) for quantity, _ in _JOINT_QUANTITIES),
        trajectory.normal_force,
    ]
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(header)
    for row in zip(*columns, strict=True):
        writer.writerow([repr(float(value)) for part in row for value in part])
    return file.getvalue()


def json_text(trajectory: SampledTrajectory) -> str:
    """Everything in one object, numbers in full precision."""
    document = {
        "format": JSON_FORMAT,
        "version": JSON_VERSION,
        "workcell": trajectory.name,
        "time": trajectory.time.tolist(),
        "box": {"pose": trajectory.pose.tolist()},
        "robots": [
            {
                "name": robot,
                "joints": list(trajectory.joints[i]),
                **{
                    quantity: getattr(trajectory, quantity)[:, i].tolist()
                    for quantity, _ in _JOINT_QUANTITIES
                },
                "normal_force": trajectory.normal_force[:, i].tolist(),
            }
            for i, robot in enumerate(trajectory.robots)
        ],
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def joint_trajectory(trajectory: SampledTrajectory, arm: int) -> dict[str, Any]:
    """One arm as a ROS 2 trajectory_msgs/msg/JointTrajectory."""
    points = [
        {
            "positions": trajectory.position[k, arm].tolist(),
            "velocities": trajectory.velocity[k, arm].tolist(),
            "accelerations": trajectory.acceleration[k, arm].tolist(),
            "effort": [],
            "time_from_start": _duration(float(time)),
        }
        for k, time in enumerate(trajectory.time)
    ]
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "joint_names": list(trajectory.joints[arm]),
        "points": points,
    }


def _duration(seconds: float) -> dict[str, int]:
    """A builtin_interfaces/msg/Duration."""
    nanoseconds = round(seconds * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def _csv(trajectory: SampledTrajectory) -> dict[str, str]:
    return {".csv": csv_text(trajectory)}


def _json(trajectory: SampledTrajectory) -> dict[str, str]:
    return {".json": json_text(trajectory)}


def _ros2(trajectory: SampledTrajectory) -> dict[str, str]:
    return {
        f"_arm{arm + 1}.yaml": yaml.safe_dump(
            joint_trajectory(trajectory, arm), sort_keys=False, default_flow_style=None
        )
        for arm in (0, 1)
    }


def _rapid(trajectory: SampledTrajectory) -> dict[str, str]:
    return {f"_T_ROB{arm + 1}.mod": text for arm, text in enumerate(rapid_modules(trajectory))}


FORMATS: Mapping[str, Callable[[SampledTrajectory], dict[str, str]]] = {
    "csv": _csv,
    "json": _json,
    "ros2": _ros2,
    "rapid": _rapid,
}
"""From a sampled trajectory to file contents by the ending of their names."""
