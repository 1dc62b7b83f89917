"""The task section of a workcell file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast, get_args

import numpy as np

from symbolic.array import Array
from symbolic.read.tables import Table, checked_vector
from symbolic.records import Allocation, AllowedContact, Contact, Payload, Task, TimeLaw, Waypoint
from symbolic.records import quantities as quantity
from symbolic.records.poses import Orientation, Rotation, read_only, rotation_from_rpy
from symbolic.records.problems import Problems, shown
from symbolic.records.quantities import GRAVITY
from symbolic.records.task import components

MIN_SAMPLES = 5
MAX_SAMPLES = 2_000
MAX_WAYPOINTS = 100
MAX_PIECES = 10
TIME_LAWS = ("constant", "ramped", "optimal")
ALLOCATIONS = get_args(Allocation)
ROTATIONS = ("roll-pitch-yaw", "quaternion")

MOST_TURN = 5.0
"""Largest rotation vector of a waypoint [rad]: a full turn less what the spline may swing out."""

ABOVE_STILL = 1.001


def read_task(table: Table) -> Task:
    """What is to be carried where, and how a candidate is sampled and judged.

    The table stays open for `symbolic.read.redundancy`.
    """
    problems, orientation = table.problems, _orientation(table)
    names = components(orientation)
    start = _fixed(table, "start")
    between = [w for entry in table.tables("waypoints") for w in _waypoints(entry, names)]
    goal = _fixed(table, "goal")
    waypoints = (start, *between, goal)
    if problems.clean(table.at("waypoints")):
        if all(waypoint.is_fixed for waypoint in waypoints):
            problems.add(
                table.at("waypoints"), "no waypoint is free; allowed is at least one free waypoint"
            )
        if len(waypoints) > MAX_WAYPOINTS:
            problems.add(
                table.at("waypoints"),
                f"found {len(waypoints)} poses with start and goal; allowed are {MAX_WAYPOINTS}",
            )
    time_law = cast("TimeLaw", table.choice("time_law", TIME_LAWS, "constant"))
    pieces = table.integer("drivable_pieces", 1, MAX_PIECES, 1)
    task = Task(
        waypoints=waypoints,
        samples=table.integer("samples", MIN_SAMPLES, MAX_SAMPLES, 100),
        time_law=time_law,
        reference_speed=table.number("reference_speed", quantity.SPEED),
        reference_angular_speed=table.number(
            "reference_angular_speed", quantity.ANGULAR_SPEED, 0.5
        ),
        ramp_time=table.number("ramp_time", quantity.DURATION, 0.5),
        reference_force=table.vector("reference_force", (quantity.FORCE,) * 2, scalar_fills=True),
        initial=_read_initial(table, [w for w in waypoints if not w.is_fixed], names),
        allowed_contacts=tuple(_allowed_contact(e) for e in table.tables("allowed_contacts")),
        allocation=_allocation(table, time_law),
        force_limit=_force_limit(table),
        orientation=orientation,
        pieces=pieces if time_law == "optimal" else 1,
    )
    if orientation.is_vector:
        _check_vectors(task, problems)
    return task


def _allocation(table: Table, time_law: TimeLaw) -> Allocation:
    """The allocation of forces. What robots drive is held by soft fingers where nothing else is
    stated."""
    driven = time_law == "optimal"
    usual = table.choice("allocation", ALLOCATIONS, "soft-finger" if driven else "paper")
    own = table.choice("drivable_allocation", ALLOCATIONS, usual)
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
    rotation = cast("Rotation", table.choice("rotation", ROTATIONS, ROTATIONS[0]))
    if rotation == "roll-pitch-yaw":
        if "rotation_reference" in table:
            table.raw("rotation_reference")
            table.problems.add(
                table.at("rotation_reference"), 'allowed with rotation = "quaternion" only'
            )
        return Orientation(rotation)
    rpy = table.vector("rotation_reference", (quantity.ANGLE,) * 3, default=(0.0, 0.0, 0.0))
    return Orientation(rotation, read_only(rotation_from_rpy(rpy)))


def _force_limit(table: Table) -> tuple[float, float]:
    """Bounds of the force limit; infinite above where the file has none."""
    if "force_limit" not in table:
        return (0.0, np.inf)
    low, high = table.vector("force_limit", (quantity.FORCE,) * 2)
    if low > high:
        table.problems.add(
            table.at("force_limit"),
            f"found {low:g} above {high:g}; allowed is the least limit, then the largest",
        )
    return (float(low), float(high))


def _fixed(table: Table, key: str) -> Waypoint:
    pose = table.vector(key, quantity.POSE)
    return Waypoint(pose, pose)


def _waypoints(table: Table, names: Sequence[str]) -> list[Waypoint]:
    """One fixed waypoint, or `count` free ones that share their bounds."""
    problems = table.problems
    if "fixed" in table:
        pose = table.vector("fixed", quantity.POSE)
        beside = [key for key in ("lower", "upper", "count") if key in table]
        if beside:
            for key in beside:
                table.raw(key)
            listed = " and ".join(map(repr, beside))
            problems.add(table.at("fixed"), f"found beside {listed}; allowed is one or the other")
        table.close()
        return [Waypoint(pose, pose)]
    lower = table.vector("lower", quantity.POSE)
    upper = table.vector("upper", quantity.POSE)
    count = table.integer("count", 1, MAX_WAYPOINTS, 1)
    table.raw("fixed", ())
    table.close()
    if problems.clean(table.path):
        for index, (component, low, high) in enumerate(zip(names, lower, upper, strict=True)):
            if low > high:
                problems.add(
                    f"{table.at('lower')}[{index}]",
                    f"found {low:g} for {component}, above its upper bound {high:g}; allowed is "
                    "lower <= upper",
                )
        if np.array_equal(lower, upper):
            problems.add(
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
    if not problems.clean(table.at("waypoints")):
        return read_only(np.reshape(rows, (-1, 6)))
    if len(rows) != len(free):
        problems.add(
            path, f"found {len(rows)} rows; allowed is one per free waypoint, {len(free)} here"
        )
    for row, (values, waypoint) in enumerate(zip(rows, free, strict=False)):
        if not problems.clean(f"{path}[{row}]"):
            continue
        outside = np.flatnonzero((values < waypoint.lower) | (values > waypoint.upper))
        for column in outside:
            problems.add(
                f"{path}[{row}][{column}]",
                f"found {values[column]:g} for {names[int(column)]}, outside its bounds; allowed "
                f"is {waypoint.lower[column]:g} to {waypoint.upper[column]:g}",
            )
    return read_only(np.reshape(rows, (-1, 6)))


def _allowed_contact(table: Table) -> AllowedContact:
    contact = AllowedContact(table.text("body"), table.number("departure", quantity.DEPARTURE))
    table.close()
    return contact
