"""The export formats by name."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hybrid_opt.carry import Carry
from hybrid_opt.errors import ResultsError
from hybrid_opt.store.export.rapid import rapid_modules
from hybrid_opt.store.export.samples import sample_timing
from hybrid_opt.store.trajectory_file import FORMAT as TRAJECTORY_FORMAT
from hybrid_opt.timing.model import joint_names
from hybrid_opt.timing.records import Timing
from symbolic.errors import SettingsError
from symbolic.robot.urdf import arm_model, turning_joints

JSON_FORMAT = "dual-arm-carry timed trajectory"
JSON_VERSION = 1
_POSE = ("x [m]", "y [m]", "z [m]", "roll [rad]", "pitch [rad]", "yaw [rad]")
_JOINT_QUANTITIES = (
    ("q", "position", "rad"),
    ("q_rate", "velocity", "rad/s"),
    ("q_second", "acceleration", "rad/s^2"),
)
"""Of `hybrid_opt.carry.ArmMotion`, with the files' words and units, m for rad where a joint
slides."""

_HEAD = 200
"""Characters at the beginning of a file that tell what it is."""


def export(
    timing: Timing,
    form: str,
    folder: str | Path,
    stem: str = "trajectory",
    step: float | None = None,
) -> tuple[Path, ...]:
    """Write a timing in one of `FORMATS` into a folder, which is made where missing.

    Args:
        timing: one that robots can drive.
        form: name of the format.
        stem: beginning of the file names.
        step: time between samples [s], None for the format's own in `DEFAULT_STEP`.

    Returns:
        The files written.

    Raises:
        SettingsError: the format is unknown, the step out of range, or the timing fails.
        ResultsError: a file cannot be written, or another file of this project is in its place.
    """
    if form not in FORMATS:
        raise SettingsError(f"unknown format {form!r}; known are {', '.join(FORMATS)}")
    carry = sample_timing(timing, DEFAULT_STEP[form] if step is None else step)
    folder = Path(folder)
    contents = {folder / f"{stem}{end}": text for end, text in FORMATS[form](carry).items()}
    for path in contents:
        _refuse_to_replace_a_trajectory(path)
    for path, text in contents.items():
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8", newline="")
        except OSError as error:
            raise ResultsError(f"{path}: cannot be written ({error.strerror})") from error
    return tuple(contents)


def _refuse_to_replace_a_trajectory(path: Path) -> None:
    """A stored trajectory is the only copy of a result; an export can be made again."""
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            begin = file.read(_HEAD)
    except OSError:
        return
    if f'"{TRAJECTORY_FORMAT}"' in begin:
        raise ResultsError(
            f"{path} is a stored trajectory, which an export would replace; choose another "
            "folder or file name"
        )


def csv_text(carry: Carry) -> str:
    """One row per time step, one column per quantity, named with its unit."""
    robots = [robot.name for robot in carry.workcell.robots]
    names = [joint_names(robot) for robot in carry.workcell.robots]
    turning = {robot.name: turning_joints(arm_model(robot)) for robot in carry.workcell.robots}
    header = ["time [s]", *(f"box {name}" for name in _POSE)]
    columns = [carry.time[:, None], carry.pose]
    for quantity, word, unit in _JOINT_QUANTITIES:
        for robot, joints in zip(robots, names, strict=True):
            own = (unit if turns else unit.replace("rad", "m") for turns in turning[robot])
            header += [
                f"{robot}/{joint} {word} [{each}]" for joint, each in zip(joints, own, strict=True)
            ]
        columns.append(carry.side_by_side(quantity))
    header += [f"{robot} normal force [N]" for robot in robots]
    columns.append(carry.normal_force)
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(header)
    for row in np.concatenate(columns, axis=1).tolist():
        writer.writerow([repr(value) for value in row])
    return file.getvalue()


def json_text(carry: Carry) -> str:
    """Everything in one object, numbers in full precision."""
    document = {
        "format": JSON_FORMAT,
        "version": JSON_VERSION,
        "workcell": carry.workcell.name,
        "time": carry.time.tolist(),
        "box": {"pose": carry.pose.tolist()},
        "robots": [
            {
                "name": robot.name,
                "joints": list(joint_names(robot)),
                **{word: getattr(arm, name).tolist() for name, word, _ in _JOINT_QUANTITIES},
                "normal_force": carry.normal_force[:, i].tolist(),
            }
            for i, (robot, arm) in enumerate(zip(carry.workcell.robots, carry.arms, strict=True))
        ],
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def joint_trajectory(carry: Carry, arm: int) -> dict[str, Any]:
    """One arm as a ROS 2 trajectory_msgs/msg/JointTrajectory."""
    motion = carry.arms[arm]
    points = [
        {
            "positions": motion.q[k].tolist(),
            "velocities": motion.q_rate[k].tolist(),
            "accelerations": motion.q_second[k].tolist(),
            "effort": [],
            "time_from_start": _duration(float(time)),
        }
        for k, time in enumerate(carry.time)
    ]
    return {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "joint_names": list(joint_names(carry.workcell.robots[arm])),
        "points": points,
    }


def _duration(seconds: float) -> dict[str, int]:
    """A builtin_interfaces/msg/Duration."""
    nanoseconds = round(seconds * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def _csv(carry: Carry) -> dict[str, str]:
    return {".csv": csv_text(carry)}


def _json(carry: Carry) -> dict[str, str]:
    return {".json": json_text(carry)}


def _ros2(carry: Carry) -> dict[str, str]:
    return {
        f"_arm{arm + 1}.yaml": yaml.safe_dump(
            joint_trajectory(carry, arm), sort_keys=False, default_flow_style=None
        )
        for arm in range(len(carry.arms))
    }


def _rapid(carry: Carry) -> dict[str, str]:
    return {f"_T_ROB{arm + 1}.mod": text for arm, text in enumerate(rapid_modules(carry))}


FORMATS: Mapping[str, Callable[[Carry], dict[str, str]]] = {
    "csv": _csv,
    "json": _json,
    "ros2": _ros2,
    "rapid": _rapid,
}
"""From a sampled trajectory to file contents by the ending of their names."""

DEFAULT_STEP = {"csv": 0.01, "json": 0.01, "ros2": 0.02, "rapid": 0.1}
"""Time step [s] of each format where none is given."""
