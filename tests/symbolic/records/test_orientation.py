"""What the last three numbers of a pose are, as a workcell file says it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from symbolic.errors import WorkcellError
from symbolic.read.cell import load
from symbolic.records.poses import Orientation, rotation_from_rpy
from symbolic.records.task import extended_waypoints, variable_names
from tests.turned_cells import turned_transfer


def changed(folder: Path, *lines: str) -> Path:
    """The turned transfer with further lines in its task."""
    path = turned_transfer(folder).source
    path.write_text(path.read_text().replace("[task]\n", "\n".join(["[task]", *lines, ""])))
    return path


def test_rotation_vectors_count_from_their_reference(tmp_path: Path) -> None:
    task = load(changed(tmp_path, "rotation_reference = [0.1, 0.2, -0.3]")).task
    assert task.orientation.rotation == "quaternion"
    np.testing.assert_array_equal(task.orientation.reference, rotation_from_rpy([0.1, 0.2, -0.3]))
    assert not task.orientation.reference.flags.writeable
    assert variable_names(task)[3:6] == tuple(f"waypoint 1, rotation {axis}" for axis in "xyz")


def test_angles_are_unwrapped_and_rotation_vectors_are_not() -> None:
    jump = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]])
    assert Orientation().unwrapped(jump)[1, 2] == pytest.approx(2.0 * np.pi - 3.0)
    np.testing.assert_array_equal(Orientation("quaternion").unwrapped(jump), jump)


def test_a_path_of_rotation_vectors_is_as_written(tmp_path: Path) -> None:
    path = turned_transfer(tmp_path).source
    text = path.read_text().replace("goal = [0.30, 0.0, 0.90, 0.0,", "goal = [0.3, 0.0, 0.9, -3.5,")
    text = text.replace("start = [-0.30, 0.0, 0.90, 0.0,", "start = [-0.3, 0.0, 0.9, 3.0,")
    path.write_text(text)
    task = load(path).task
    points = extended_waypoints(task, np.array([0.0, 0.0, 0.95, 0.0, 1.5, 0.0]))
    np.testing.assert_array_equal(points[:, 3], [3.0, 0.0, -3.5])


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ('rotation = "euler"', "task.rotation: found 'euler'"),
        ("rotation_reference = [0, 0, 9]", "task.rotation_reference"),
        ("rotation_reference = [0, 0]", "task.rotation_reference"),
    ],
)
def test_problems_are_told(tmp_path: Path, lines: str, told: str) -> None:
    path = turned_transfer(tmp_path).source
    text = path.read_text()
    key = lines.split(" =")[0]
    text = "\n".join(line for line in text.splitlines() if not line.startswith(f"{key} ="))
    path.write_text(text.replace("[task]\n", f"[task]\n{lines}\n"))
    with pytest.raises(WorkcellError) as problem:
        load(path)
    assert told in str(problem.value)


def test_a_reference_without_rotation_vectors_is_refused(tmp_path: Path) -> None:
    path = turned_transfer(tmp_path).source
    text = path.read_text().replace('rotation = "quaternion"', "rotation_reference = [0, 0, 0]")
    path.write_text(text)
    with pytest.raises(WorkcellError, match='allowed with rotation = "quaternion" only'):
        load(path)


def test_rotations_near_a_full_turn_are_refused(tmp_path: Path) -> None:
    path = turned_transfer(tmp_path).source
    path.write_text(path.read_text().replace("0.1, 1.8, 0.1]", "3.5, 3.5, 2.0]"))
    with pytest.raises(WorkcellError, match=r"found a rotation of up to 5\.34 rad at pose 1"):
        load(path)
