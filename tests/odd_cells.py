"""Cells with redundant joints, with these joints locked, and with boxes that are turned over."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from symbolic.array import Array
from symbolic.read.cell import load
from symbolic.records import TimeLaw, Waypoint, Workcell
from symbolic.records.poses import Orientation, rotation_from_rpy
from tests.machines import MACHINES, SINGLE, machine_cell, single_cell
from tests.symbolic.cells import fixed, free, hand_cell, with_task
from tests.symbolic.read.samples import RACK

PANDA_JOINT = "panda_joint3"


def locked_pandas(folder: Path, angle: float) -> Workcell:
    """Two Pandas that carry a box a little, their third joints locked."""
    return load(single_cell(SINGLE["panda"], folder, {PANDA_JOINT: angle}))


def _redundant(path: Path, *entries: str) -> Workcell:
    """The cell of a file whose task is told these redundant joints."""
    given = f'"redundant" = [{", ".join(f"{{joint = {entry}}}" for entry in entries)}]'
    path.write_text(path.read_text().replace('"samples" =', f'{given}, "samples" ='))
    return load(path)


def free_pandas(folder: Path, entry: str = "", joint: str = PANDA_JOINT) -> Workcell:
    """The same, these joints redundant; `entry` is what the file says of them, or of another."""
    path = single_cell(SINGLE["panda"], folder, {})
    return _redundant(path, f'"{joint}", {entry}') if entry else load(path)


def seven_joints(name: str, folder: Path) -> Workcell:
    """A cell of an arm of `SINGLE` or a machine of `MACHINES`, the joint that is locked there
    redundant."""
    if name in SINGLE:
        arms = [SINGLE[name]]
        path = single_cell(SINGLE[name], folder, {})
    else:
        machine = MACHINES[name]
        arms = [machine.left, machine.right]
        left, right = (replace(arm, locked={}) for arm in arms)
        path = machine_cell(replace(machine, left=left, right=right), folder)
    text = path.read_text()
    for arm in arms:  # a joint of both robots' arms is named twice, as it has to be
        text = re.sub(
            rf'(?<="chain" = \["{arm.chain[0]}", "{arm.chain[1]}"\], )',
            f'"redundant_joints" = {json.dumps(list(arm.locked))}, ',
            text,
        )
    path.write_text(text)
    joints = [entry for arm in arms for entry in arm.locked.items()]
    return _redundant(path, *(f'"{joint}", initial = {angle}' for joint, angle in joints))


def rack_on_rail(folder: Path, away: float, room: float = 0.0) -> Workcell:
    """The rack, its left robot on a slide whose root stands `away` [m] behind its place: it is
    there where the slide is out by as much, as in the hand-made trajectory. Elsewhere it may be as
    far from there as there is room [m]."""
    urdf = RACK.parent.parent / "robots/gofa12.urdf"
    slide = """<link name="rail"/>
  <joint name="slide" type="prismatic">
    <parent link="rail"/><child link="base_link"/><axis xyz="1 0 0"/>
    <limit lower="-9" upper="9" effort="2000" velocity="1.0"/>
  </joint>
  <link name="base_link">"""
    (folder / "rail.urdf").write_text(urdf.read_text().replace('<link name="base_link">', slide, 1))
    text = RACK.read_text().replace("../robots/gofa12.urdf", "rail.urdf", 1)
    text = text.replace("../robots/gofa12.urdf", str(urdf))
    # The root's x axis is the world's -y.
    text = text.replace("[-0.15, 1.15, 0.20]", f"[-0.15, {1.15 + away}, 0.20]")
    low, high = away - room, away + room
    given = f'redundant = [{{joint = "slide", lower = {low}, upper = {high}, initial = {away}}}]'
    path = folder / "cell.toml"
    path.write_text(text.replace("[task]", f"[task]\n{given}"))
    return load(path)


def machine_on_lift(folder: Path, height: float, free: bool) -> Workcell:
    """TIAGo's two arms, its lift a joint of both that is redundant or locked [m]."""
    machine = MACHINES["tiago_dual"]
    folder.mkdir(parents=True, exist_ok=True)
    arms = []
    for arm in (machine.left, machine.right):
        held = arm.locked if free else arm.locked | {"torso_lift_joint": height}
        arms.append(replace(arm, chain=("base_footprint", arm.chain[1]), locked=held))
    x, y, z = machine.box
    lifted = replace(machine, left=arms[0], right=arms[1], box=(x, y, z + height))
    path = machine_cell(lifted, folder)
    return _redundant(path, f'"torso_lift_joint", initial = {height}') if free else load(path)


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
