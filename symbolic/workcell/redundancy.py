"""The redundant joints of a workcell file: joints beyond six, whose paths are decided."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from symbolic.array import Array
from symbolic.robot.machine import common_joints
from symbolic.robot.urdf import FOLLOWING, arm_model, turning_joints
from symbolic.workcell import quantities as quantity
from symbolic.workcell.contacts import SHAPE_KEYS
from symbolic.workcell.problems import Problems
from symbolic.workcell.reader import Table, read_only
from symbolic.workcell.records import RedundantJoint, Robot, Workcell

if TYPE_CHECKING:
    from symbolic.robot.redundancy import PosturePath

FULL_TURN = 2.0 * np.pi
"""Widest default bounds of a joint, about its initial value [rad]: beyond it repeats itself."""

MOST_BEYOND = 6
"""Most joints beyond six of one arm: the choice among them is made by trying all."""


_NEEDED = (
    *("urdf", "chain", "flange", "locked_joints", "drop_links", "redundant_joints"),
    *("position_lower", "position_upper", "base", "pad"),
)


@dataclass(frozen=True)
class RedundancyEntry:
    """What a file says of a redundant joint; None where it says nothing.

    Attributes:
        path: of the entry in the file.
        joint: 'robot/joint', or a joint's name, which stands for that of either robot.
        lower, upper, initial: (n_waypoints,) [rad or m].
    """

    path: str
    joint: str
    lower: Array | None
    upper: Array | None
    initial: Array | None


def read_redundant(table: Table, n_waypoints: int) -> tuple[RedundancyEntry, ...]:
    """The entries of `task.redundant`."""
    found = []
    for entry in table.tables("redundant") if "redundant" in table else ():
        values = {
            key: entry.vector(key, (quantity.LOCKED_POSITION,) * n_waypoints, scalar_fills=True)
            if key in entry
            else entry.raw(key, None)
            for key in ("lower", "upper", "initial")
        }
        found.append(RedundancyEntry(entry.path, entry.text("joint"), **values))
        entry.close()
    table.raw("redundant", None)
    return tuple(found)


def with_redundancy(
    workcell: Workcell, entries: Sequence[RedundancyEntry], problems: Problems
) -> Workcell:
    """The workcell with its redundant joints, chosen and placed where its file says nothing."""
    needed = [f"robots[{i}].{part}" for i in (0, 1) for part in _NEEDED]
    if not problems.clean(*needed, "task", "contacts", *SHAPE_KEYS):
        return workcell
    models = [arm_model(robot) for robot in workcell.robots]
    names = [tuple(model.names)[1:] for model in models]
    if not entries and all(len(joints) == FOLLOWING for joints in names):
        return workcell
    common = common_joints(workcell.robots)
    arms, found = [], []
    for i, robot in enumerate(workcell.robots):
        if len(names[i]) - FOLLOWING > MOST_BEYOND:
            told = f"found {len(names[i])} joints that move; allowed are {FOLLOWING + MOST_BEYOND}"
            problems.add(f"robots[{i}].chain", f"{told}: hold others by locked_joints")
            return workcell
        path, redundant = _choice(workcell, i, entries, common)
        if not set(common) <= set(redundant):
            problems.add(
                f"robots[{i}].redundant_joints",
                f"joint {common[0]!r} moves both arms; allowed are arms with at least six joints "
                "of their own, and redundant joints that name the common ones",
            )
            return workcell
        arms.append(replace(robot, redundant_joints=redundant))
        for name in redundant:
            if i == 0 or name not in common:
                drives = tuple(
                    names[k].index(name) if k == i or name in common else -1 for k in (0, 1)
                )
                said = _entry(entries, robot, name) or RedundancyEntry("", name, None, None, None)
                found.append(_joint(workcell, i, (drives[0], drives[1]), said, path, problems))
    known = {joint.name for joint in found} | {joint.name.split("/")[1] for joint in found}
    known |= {f"{workcell.robots[1].name}/{name}" for name in common}
    for entry in entries:
        if entry.joint not in known:
            listed = ", ".join(joint.name for joint in found) or "none in this cell"
            problems.add(
                f"{entry.path}.joint", f"found {entry.joint!r}; redundant joints are: {listed}"
            )
    task = replace(workcell.task, redundant=tuple(found))
    return replace(workcell, robots=(arms[0], arms[1]), task=task)


def _choice(
    workcell: Workcell, i: int, entries: Sequence[RedundancyEntry], common: tuple[str, ...]
) -> tuple[PosturePath | None, tuple[str, ...]]:
    """Arm i's path along the hand-made trajectory, where it is needed, and its redundant joints."""
    # Not imported at the top: it needs CasADi, which cells of six-joint arms do not to be read.
    from symbolic.robot.redundancy import best_conditioned, posture_path

    robot = workcell.robots[i]
    model = arm_model(robot)
    names, beyond = list(model.names)[1:], model.nq - FOLLOWING
    chosen = tuple(sorted(robot.redundant_joints, key=names.index))
    told = [_entry(entries, robot, name) for name in chosen]
    if not beyond or (chosen and all(entry and entry.initial is not None for entry in told)):
        return None, chosen
    held = {}
    for name in common:
        joint, entry = names.index(name), _entry(entries, robot, name)
        middle = (robot.position_lower[joint] + robot.position_upper[joint]) / 2.0
        held[joint] = float(middle if entry is None or entry.initial is None else entry.initial[0])
    path = posture_path(robot, workcell.contacts[i], workcell.task, held)
    if not chosen:
        sliding = [
            k for k, turns in enumerate(turning_joints(model)) if not turns and k not in held
        ]
        forced = [*held, *sliding][:beyond]
        chosen = tuple(names[k] for k in best_conditioned(path, model.nq, forced))
    return path, chosen


def _entry(entries: Sequence[RedundancyEntry], robot: Robot, name: str) -> RedundancyEntry | None:
    """What the file says of a joint; the entry of this robot before one for either."""
    for wanted in (f"{robot.name}/{name}", name):
        for entry in entries:
            if entry.joint == wanted:
                return entry
    return None


def _joint(
    workcell: Workcell,
    i: int,
    drives: tuple[int, int],
    said: RedundancyEntry,
    path: PosturePath | None,
    problems: Problems,
) -> RedundantJoint:
    robot, n = workcell.robots[i], len(workcell.task.waypoints)
    joint, name = drives[i], said.joint.removeprefix(f"{robot.name}/")
    least, most = float(robot.position_lower[joint]), float(robot.position_upper[joint])
    initial = said.initial
    if initial is None:
        middle = np.full(n, (least + most) / 2.0)
        initial = middle if path is None else path.at_waypoints(joint)
        initial = np.maximum(initial, least if said.lower is None else said.lower)
        initial = np.minimum(initial, most if said.upper is None else said.upper)
    reach = np.inf if most - least <= FULL_TURN else FULL_TURN / 2.0
    lower = np.maximum(least, initial - reach) if said.lower is None else said.lower
    upper = np.minimum(most, initial + reach) if said.upper is None else said.upper
    where = said.path or f"robots[{i}].redundant_joints"
    if np.any(lower < least) or np.any(upper > most):
        problems.add(where, f"found bounds beyond the joint's limits {least:g} to {most:g}")
    elif np.any(lower > initial) or np.any(initial > upper):
        problems.add(where, "allowed is lower <= initial <= upper at every waypoint")
    first = f"{robot.name}/{name}"
    return RedundantJoint(first, drives, read_only(lower), read_only(upper), read_only(initial))
