"""Bounds that solutions lie on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybrid_opt.indicators.bounds import binding_bounds
from symbolic.read.cell import load
from symbolic.records import Waypoint
from symbolic.records.task import variable_names
from tests.symbolic.read.samples import RACK

TASK = load(RACK).task
MIDDLE = (TASK.lower + TASK.upper) / 2.0


def test_variables_have_the_names_of_their_waypoints() -> None:
    names = variable_names(TASK)
    assert len(names) == TASK.n_var
    assert names[0] == "waypoint 1, x"
    assert names[-1] == "waypoint 3, yaw"
    assert variable_names(replace(TASK, time_law="optimal"))[-1] == "force limit"


def test_only_bounds_that_are_touched_are_told_with_how_many() -> None:
    x = np.tile(MIDDLE, (5, 1))
    assert binding_bounds(TASK, x) == ()
    x[0, 7] = TASK.lower[7]
    x[1:3, 17] = TASK.upper[17] - 5e-4 * (TASK.upper[17] - TASK.lower[17])
    x[4, 17] = TASK.upper[17] - 5e-3 * (TASK.upper[17] - TASK.lower[17])
    found = binding_bounds(TASK, x)
    assert [(b.variable, b.side, b.solutions) for b in found] == [
        ("waypoint 2, y", "lower", 1),
        ("waypoint 3, yaw", "upper", 2),
    ]
    assert found[0].value == TASK.lower[7]


def test_what_has_no_range_does_not_bind() -> None:
    waypoint = TASK.waypoints[1]
    upper = waypoint.upper.copy()
    upper[0] = waypoint.lower[0]
    waypoints = (TASK.waypoints[0], Waypoint(waypoint.lower, upper), *TASK.waypoints[2:])
    task = replace(TASK, waypoints=waypoints)
    assert binding_bounds(task, (task.lower + task.upper) / 2.0) == ()
    optimal = replace(TASK, time_law="optimal", force_limit=(50.0, 100.0))
    assert binding_bounds(optimal, np.append(MIDDLE, 50.0)) == ()
