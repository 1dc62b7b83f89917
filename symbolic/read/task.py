"""The task section of a workcell file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast, get_args

import numpy as np

from symbolic.array import Array
from symbolic.read.redundancy import RedundancyEntry, read_redundant
from symbolic.read.tables import Table, checked_vector
from symbolic.records import Allocation, Contact, Payload, Task, TimeLaw, Waypoint
from symbolic.records import quantities as quantity
from symbolic.records.poses import Orientation, Rotation, read_only, rotation_from_rpy
from symbolic.records.problems import Problems, shown
from symbolic.records.quantities import GRAVITY
from symbolic.records.task import components

MAX_WAYPOINTS = 100
MAX_PIECES = 10

MOST_TURN = 5.0
"""Largest rotation vector of a waypoint [rad]: a full turn less what the spline may swing out."""

ABOVE_STILL = 1.001


def read_task(table: Table) -> tuple[Task, tuple[RedundancyEntry, ...]]:
    """What is to be carried where, and how a candidate is sampled and judged; and what is said of
    redundant joints."""
    orientation = _orientation(table)
    names = components(orientation)
    start = _fixed(table, "start")
    between = [w for entry in table.tables("waypoints") for w in _waypoints(entry, names)]
    waypoints = (start, *between, _fixed(table, "goal"))
    if table.clean("waypoints"):
        if all(waypoint.is_fixed for waypoint in waypoints):
            table.add("waypoints", "no waypoint is free; allowed is at least one free waypoint")
        if len(waypoints) > MAX_WAYPOINTS:
            table.add(
                "waypoints",
                f"found {len(waypoints)} poses with start and goal; allowed are {MAX_WAYPOINTS}",
            )
    time_law = cast("TimeLaw", table.choice("time_law", get_args(TimeLaw), "constant"))
    pieces = table.integer("drivable_pieces", 1, MAX_PIECES, 1)
    redundant = read_redundant(table, len(waypoints))
    task = table.record(
        Task,
        waypoints=waypoints,
        time_law=time_law,
        initial=_read_initial(table, [w for w in waypoints if not w.is_fixed], names),
        allocation=_allocation(table, time_law),
        force_limit=_force_limit(table),
        redundant=(),
        orientation=orientation,
        pieces=pieces if time_law == "optimal" else 1,
    )
    if orientation.is_vector:
        _check_vectors(task, table.problems)
    return task, redundant


def _allocation(table: Table, time_law: TimeLaw) -> Allocation:
    """The allocation of forces. What robots drive is held by soft fingers where nothing else is
    stated."""
    driven, known = time_law == "optimal", get_args(Allocation)
    usual = table.choice("allocation", known, "soft-finger" if driven else "paper")
    own = table.choice("drivable_allocation", known, usual)
    return cast("Allocation", own if driven else usual)


def _check_vectors(task: Task, problems: Problems) -> None:
    """Every rotation vector that a waypoint allows stays well below a full turn, at which small
    changes of it no longer turn the box about every axis."""
    for k, waypoint in enumerate(task.waypoints):
        farthest = np.maximum(np.abs(waypoint.lower[3:]), np.abs(waypoint.upper[3:]))
        if np.linalg.norm(farthest) > MOST_TURN:
            problems.add(
                "task.rotation",
                f"found a rotation of up to {np.linalg.norm(farthest):.2f} rad at pose {k} of the "
                f"path, start and goal included; allowed are {MOST_TURN:g} rad from "
                "task.rotation_reference",
            )


def with_force_limit(task: Task, payload: Payload, contacts: Sequence[Contact]) -> Task:
    """The task with the default bounds of the force limit where its file has none.

    From a thousandth above the force that holds the payload level and still between upright
    contacts to the smaller reference force.
    """
    if np.isfinite(task.force_limit[1]):
        return task
    still = payload.mass * -GRAVITY[2] / sum(contact.friction for contact in contacts)
    highest = max(float(task.reference_force.min()), ABOVE_STILL * still)
    return replace(task, force_limit=(ABOVE_STILL * still, highest))


def _orientation(table: Table) -> Orientation:
    """What the last three numbers of every pose of the task mean."""
    known = get_args(Rotation)
    rotation = cast("Rotation", table.choice("rotation", known, known[0]))
    rpy = table.vector("rotation_reference", (quantity.ANGLE,) * 3, default=(0.0, 0.0, 0.0))
    if rotation == "roll-pitch-yaw":
        if "rotation_reference" in table:
            table.add("rotation_reference", 'allowed with rotation = "quaternion" only')
        return Orientation(rotation)
    return Orientation(rotation, read_only(rotation_from_rpy(rpy)))


def _force_limit(table: Table) -> tuple[float, float]:
    """Bounds of the force limit; infinite above where the file has none."""
    if "force_limit" not in table:
        return (0.0, np.inf)
    low, high = table.vector("force_limit", (quantity.FORCE,) * 2)
    if low > high:
        table.add(
            "force_limit",
            f"found {low:g} above {high:g}; allowed is the least limit, then the largest",
        )
    return (float(low), float(high))


def _fixed(table: Table, key: str) -> Waypoint:
    pose = table.vector(key, quantity.POSE)
    return Waypoint(pose, pose)


def _waypoints(table: Table, names: Sequence[str]) -> list[Waypoint]:
    """One fixed waypoint, or `count` free ones that share their bounds."""
    if table.has("fixed"):
        pose = table.vector("fixed", quantity.POSE)
        table.refuse("fixed", ("lower", "upper", "count"))
        table.close()
        return [Waypoint(pose, pose)]
    lower, upper = (table.vector(key, quantity.POSE) for key in ("lower", "upper"))
    count = table.integer("count", 1, MAX_WAYPOINTS, 1)
    table.close()
    if table.problems.clean(table.path):
        for index, (component, low, high) in enumerate(zip(names, lower, upper, strict=True)):
            if low > high:
                table.add(
                    f"lower[{index}]",
                    f"found {low:g} for {component}, above its upper bound {high:g}; allowed is "
                    "lower <= upper",
                )
        if np.array_equal(lower, upper):
            table.problems.add(
                table.path, "lower equals upper everywhere; a fixed pose is written fixed = [...]"
            )
    return [Waypoint(lower, upper)] * count


def _read_initial(table: Table, free: list[Waypoint], names: Sequence[str]) -> Array:
    """The hand-made free waypoints (n_free, 6); the centres of the bounds by default."""
    value = table.raw("initial", None)
    path, problems = table.at("initial"), table.problems
    if value is None:
        return read_only(np.reshape([(w.lower + w.upper) / 2 for w in free], (-1, 6)))
    if not isinstance(value, list):
        problems.add(path, f"found {shown(value)}; allowed is an array of rows of 6 numbers")
        return read_only(np.zeros((len(free), 6)))
    rows = [
        checked_vector(row, quantity.POSE, f"{path}[{index}]", problems)
        for index, row in enumerate(value)
    ]
    found = read_only(np.reshape(rows, (-1, 6)))
    if not table.clean("waypoints"):
        return found
    if len(rows) != len(free):
        problems.add(
            path, f"found {len(rows)} rows; allowed is one per free waypoint, {len(free)} here"
        )
    for row, (values, waypoint) in enumerate(zip(rows, free, strict=False)):
        low, high = waypoint.lower, waypoint.upper
        sound = problems.clean(f"{path}[{row}]")
        for column in np.flatnonzero((values < low) | (values > high)) if sound else ():
            problems.add(
                f"{path}[{row}][{column}]",
                f"found {values[column]:g} for {names[int(column)]}, outside its bounds; allowed "
                f"is {low[column]:g} to {high[column]:g}",
            )
    return found
