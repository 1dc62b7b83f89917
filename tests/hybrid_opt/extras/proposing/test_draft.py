"""Numbers of proposed files; the oracle is the reader of workcell files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybrid_opt.extras.proposing.bounds import Bounds
from hybrid_opt.extras.proposing.decimals import RECIPROCAL_UNIT, readable_turns, rounded_outwards
from hybrid_opt.extras.proposing.draft import Draft, changes, decision_bounds
from hybrid_opt.extras.proposing.problem import Problem, read_problem
from symbolic.read.editing import merged
from symbolic.read.tables import TableReader
from symbolic.read.task import MOST_TURN, read_task
from symbolic.records import Task
from symbolic.records.poses import Orientation
from symbolic.records.problems import Problems
from tests.hybrid_opt.extras.proposing.problems import shipped_problem
from tests.odd_cells import turned_cell
from tests.symbolic.cells import hand_cell, with_task


def test_every_limit_of_four_decimals_is_written_as_it_is() -> None:
    limits = np.arange(1, 62832) / 1e4
    both = np.array([-limits, limits])
    np.testing.assert_array_equal(rounded_outwards(both, both), both)
    # Without the limits: the same, by the decimals alone.
    np.testing.assert_array_equal(rounded_outwards(both, 2.0 * both), both)


@given(st.floats(-10.0, 10.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_bounds_are_rounded_outwards_within_limits(low: float, width: float, room: float) -> None:
    bounds = np.array([low, low + width])
    limits = np.array([low - room, low + width + room])
    found = rounded_outwards(bounds, limits)
    noise = 1e-10
    assert limits[0] <= found[0] <= bounds[0] + noise
    assert bounds[1] - noise <= found[1] <= limits[1]
    assert np.abs(found - bounds).max() <= 1.0 / RECIPROCAL_UNIT


def read_back(problem: Problem, found: Draft) -> tuple[Task, list[str]]:
    """Read the task that a draft makes of a problem; with the reader's problems."""
    data: dict[str, Any] = merged(problem.data, changes(problem, found))
    problems = Problems()
    task, _ = read_task(TableReader(data["task"], "task", problems), np.empty(0))
    return task, list(problems.messages()) if problems.found else []


def poses(most_angle: float) -> st.SearchStrategy[list[float]]:
    place, angle = st.floats(-10.0, 10.0), st.floats(-most_angle, most_angle)
    return st.tuples(*[place] * 3, *[angle] * 3).map(list)


def rotation_vectors() -> st.SearchStrategy[list[float]]:
    def shortened(pose: list[float]) -> list[float]:
        length = float(np.linalg.norm(pose[3:]))
        factor = min(1.0, 0.9999 * MOST_TURN / max(length, 1e-9))
        return [*pose[:3], *(factor * angle for angle in pose[3:])]

    return poses(MOST_TURN).map(shortened)


@pytest.mark.parametrize("rotation", ["roll-pitch-yaw", "quaternion"])
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_any_carry_with_any_bounds_is_read_back(rotation: str, data: st.DataObject) -> None:
    """Poses at the file's own limits, angles that go on beyond a full turn, bounds of any width."""
    is_vector = rotation == "quaternion"
    kind = rotation_vectors() if is_vector else poses(2.0 * np.pi)
    ends = [data.draw(kind) for _ in range(2)]
    if ends[0] == ends[1]:
        return
    workcell = turned_cell() if is_vector else hand_cell()
    problem = Problem(
        Path(),
        "",
        {
            "task": {
                "start": ends[0],
                "goal": ends[1],
                "rotation": rotation,
                "reference_speed": 0.2,
                "reference_force": 100.0,
            },
            "contacts": [{"xyz": [0.0, 0.1, 0.0]}, {"xyz": [0.0, -0.1, 0.0]}],
            "robots": [{}, {}],
        },
    )
    via = np.mean(problem.poses, axis=0)
    waypoints = np.round([ends[0], via, ends[1]], 4)
    draft = Draft(workcell, (0.0, 0.0), (-1, -1), waypoints)
    first, wrong = read_back(problem, draft)
    assert wrong == []
    np.testing.assert_allclose(
        first.orientation.unwrapped(np.array([via[3:], first.initial[0, 3:]]))[1],
        via[3:],
        atol=1e-4,
    )
    unit, limits = decision_bounds(with_task(workcell, initial=first.initial))
    scale = data.draw(st.floats(0.02, 8.0))
    centre = first.initial.ravel()
    lower, upper = np.clip([centre - scale * unit, centre + scale * unit], limits[0], limits[1])
    bounds = Bounds(centre, lower, upper, 0.1, 100)
    last, wrong = read_back(problem, replace(draft, bounds=bounds).around(centre))
    assert wrong == []
    assert np.all(last.lower <= lower + 1e-9)
    assert np.all(last.upper >= upper - 1e-9)


def test_angles_beyond_a_turn_are_turned_back_and_others_stay() -> None:
    path = np.zeros((3, 6))
    path[:, 5] = [6.2, 6.7, -6.9]
    found = readable_turns(path, Orientation())
    np.testing.assert_allclose(found[:, 5], [6.2, 6.7 - 2 * np.pi, 2 * np.pi - 6.9])
    path[:, 5] = [4.0, 4.5, 4.9]
    np.testing.assert_array_equal(readable_turns(path, Orientation("quaternion", np.eye(3))), path)


@pytest.mark.parametrize("limit", [2.8065, 2.0000499, 1.9999500001, np.pi - 0.3])
def test_redundant_joints_may_go_to_their_limits_and_no_farther(
    limit: float, tmp_path: Path
) -> None:
    """The last of the seven joints' limits is other in the second robot."""
    path = shipped_problem("pandas", tmp_path)
    problem = read_problem(path)
    upper = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    data = problem.data | {"robots": [dict(robot) for robot in problem.data["robots"]]}
    for robot in data["robots"]:
        (name,) = robot["redundant_joints"]
        upper[int(name[-1]) - 1] = limit
        robot["position_upper"] = upper
    problem = replace(problem, text="", data=data)
    workcell = problem.workcell()
    joints = workcell.task.redundant
    ends = np.array([problem.data["task"][key] for key in ("start", "goal")])
    beside = np.full((3, len(joints)), limit - 0.02)
    waypoints = np.hstack([[ends[0], ends.mean(axis=0), ends[1]], np.round(beside, 4)])
    draft = Draft(workcell, (0.0, 0.0), (-1, -1), waypoints)
    found = problem.workcell(changes(problem, draft))
    unit, limits = decision_bounds(found)
    x = np.concatenate([found.task.initial.ravel(), np.round(beside, 4).T.ravel()])
    lower, most = np.clip([x - 8.0 * unit, x + 8.0 * unit], limits[0], limits[1])
    bounded = replace(draft, bounds=Bounds(x, lower, most, 0.1, 100))
    last = problem.workcell(changes(problem, bounded))
    for joint in last.task.redundant:
        np.testing.assert_array_equal(joint.upper, limit)


@pytest.mark.parametrize("pitch", [-3.0, 0.0, 1.4, 2.0, 3.1])
def test_limits_hold_a_box_at_any_pitch(pitch: float) -> None:
    cell = with_task(hand_cell(), initial=np.array([[0.0, 0.0, 1.0, 0.1, pitch, -0.2]] * 3))
    unit, limits = decision_bounds(cell)
    x = cell.task.initial.ravel()
    assert unit.shape == x.shape
    assert np.all(limits[0] < x)
    assert np.all(limits[1] > x)
    assert np.abs(limits[:, 4]).max() <= 6.28


@pytest.mark.parametrize("length", [0.0, 2.0, 4.5, 4.995, 5.0])
def test_corners_of_limits_are_rotation_vectors_that_files_may_hold(length: float) -> None:
    pose = np.array([0.0, 0.0, 1.0, 0.0, length, 0.0])
    cell = turned_cell()
    _, limits = decision_bounds(with_task(cell, initial=np.array([pose] * 3)))
    farthest = np.abs(limits[:, 3:6]).max(axis=0)
    assert np.linalg.norm(farthest) <= 5.0
    assert np.all(limits[0, 3:6] <= pose[3:])
    assert np.all(limits[1, 3:6] >= pose[3:])
