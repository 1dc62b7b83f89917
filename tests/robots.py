"""Robots that tests of several packages use."""

from __future__ import annotations

from importlib.metadata import distribution
from pathlib import Path

import numpy as np

from symbolic.array import Array
from symbolic.records import Robot

GOFA_URDF = Path(__file__).parent.parent / "studies" / "robots" / "gofa12.urdf"


def ur10_urdf() -> Path:
    """The UR10 of the wheel `example-robot-data`."""
    wheel = distribution("example-robot-data")
    folder = "cmeel.prefix/share/example-robot-data/robots/ur_description/urdf"
    return Path(str(wheel.locate_file(f"{folder}/ur10_robot.urdf")))


def robot_record(urdf: Path, T_world_base: Array | None = None) -> Robot:
    """An arm with a bare flange `tool0` and wide limits."""
    wide = np.full(6, 1e3)
    return Robot(
        name=urdf.stem,
        urdf=urdf,
        package_dirs=(),
        flange="tool0",
        locked_joints=(),
        T_world_base=np.eye(4) if T_world_base is None else T_world_base,
        T_flange_pad=np.eye(4),
        tool=(),
        position_lower=-wide,
        position_upper=wide,
        velocity_max=wide,
        acceleration_max=wide,
        torque_max=wide,
        min_manipulability=0.0,
    )
