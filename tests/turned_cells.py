"""Cells in which the box is turned over on its way, for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from symbolic.array import Array
from symbolic.read.cell import load
from symbolic.records import TimeLaw, Waypoint, Workcell
from symbolic.records.poses import Orientation, rotation_from_rpy
from tests.symbolic.cells import fixed, free, hand_cell, with_task
from tests.symbolic.read.samples import RACK

QUARTER = np.pi / 2.0
TURNS = [0.0, 0.7, QUARTER, 2.5, np.pi]
"""Of the box about the line through both pads at the waypoints: through a right angle, where roll,
pitch and yaw are singular."""

REFERENCE = Orientation("quaternion", rotation_from_rpy([0.0, -QUARTER, 0.0]))
"""Rotation vectors count from a box that lies on its side."""


def turned_cell(time_law: TimeLaw = "constant") -> Workcell:
    """The hand-written cell with the box turned over; waypoints may tilt it as well."""
    return with_task(
        hand_cell(),
        waypoints=_waypoints(),
        time_law=time_law,
        orientation=REFERENCE,
        samples=30,
    )


def _waypoints() -> tuple[Waypoint, ...]:
    given = hand_cell().task.waypoints
    half = [0.05, 0.03, 0.05, 0.12, 0.1, 0.12]
    poses = [np.array([*(w.lower + w.upper)[:3] / 2.0, 0.0, QUARTER, 0.0]) for w in given]
    for pose, turn in zip(poses, TURNS, strict=True):
        pose[4] += turn
    return (fixed(poses[0]), *(free(pose, half) for pose in poses[1:-1]), fixed(poses[-1]))


def turned_transfer(folder: Path) -> Workcell:
    """The transfer cell without its obstacles, its crate turned over about the pads' line and
    tilted on the way, as a file."""
    text = RACK.with_name("transfer.toml").read_text()
    text = text.replace("../robots/", f"{RACK.parent.parent}/robots/")
    text = text[: text.index("[task]")]
    task = f"""[task]
rotation = "quaternion"
start = [-0.30, 0.0, 0.90, 0.0, 0.0, 0.0]
goal = [0.30, 0.0, 0.90, 0.0, {np.pi}, 0.0]
samples = 60
time_law = "constant"
reference_speed = 0.30
reference_force = 117.68
initial = [[0.0, 0.0, 0.95, 0.05, {QUARTER}, -0.05]]

[[task.waypoints]]
lower = [-0.05, -0.05, 0.90, -0.1, 1.4, -0.1]
upper = [0.05, 0.05, 1.00, 0.1, 1.8, 0.1]
"""
    path = folder / "turned.toml"
    path.write_text(text + task)
    return load(path)


def random_x(cell: Workcell, seed: int) -> Array:
    """A decision vector within the bounds."""
    return np.random.default_rng(seed).uniform(cell.task.lower, cell.task.upper)
