"""Orientations in a problem file: angles, and rotation vectors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.proposing.problem import Problem, contact_points, orientation_of
from symbolic.physics.pose import rotation_from_rpy

POSE = [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]


def data_of(turn: float, **task: object) -> dict[str, dict[str, object]]:
    start, goal = [*POSE[:5], turn], [0.5, 0.0, 1.0, 0.0, 0.0, 4.0]
    return {"task": {"start": start, "goal": goal, **task}, "payload": {"size": [0.2, 0.3, 0.1]}}


def test_angles_go_the_near_way_and_rotation_vectors_as_written() -> None:
    angles = Problem(Path(), "", data_of(0.0))
    assert angles.poses[1][5] == pytest.approx(4.0 - 2.0 * np.pi)
    vectors = Problem(Path(), "", data_of(0.0, rotation="quaternion"))
    assert vectors.poses[1][5] == 4.0


@pytest.mark.parametrize("turn", [0.0, np.pi / 2.0, 0.3])
def test_about_one_axis_both_have_the_same_contacts(turn: float) -> None:
    bases = np.array([[0.0, 0.9, 0.0], [0.0, -0.9, 0.0]])
    angles, vectors = data_of(turn), data_of(turn, rotation="quaternion")
    for given in (bases, None):
        assert contact_points(angles, given) == contact_points(vectors, given)


def test_contacts_lie_on_faces_of_the_turned_reference() -> None:
    quarter = [0.0, 0.0, np.pi / 2.0]
    task = {"rotation": "quaternion", "rotation_reference": quarter}
    np.testing.assert_array_equal(orientation_of(task).reference, rotation_from_rpy(quarter))
    bases = np.array([[0.0, 0.9, 0.0], [0.0, -0.9, 0.0]])
    first, _ = contact_points(data_of(0.0, **task), bases)
    assert first == [0.1, 0.0, 0.0]
