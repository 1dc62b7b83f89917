"""Problem files, and the workcell files that complete them."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from hybrid_opt.proposing.problem import Problem, completed, contact_points, merged, read_problem
from symbolic.errors import SettingsError, WorkcellError
from symbolic.read.cell import load
from symbolic.records.poses import rotation_from_rpy
from tests.hybrid_opt.proposing.problems import BAXTER, tiago_problem
from tests.hybrid_opt.proposing.test_proposal import rack_problem

POST = Path("studies/problems/past-a-post.toml")


def test_the_shipped_problem_is_read_without_contact_points() -> None:
    workcell = read_problem(POST).workcell()
    for contact, side in zip(workcell.contacts, (1.0, -1.0), strict=True):
        np.testing.assert_allclose(contact.T_box_pad[:3, 3], [0.0, side * 0.2, 0.0])


@pytest.mark.parametrize(
    ("bases", "expected"),
    [
        ([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], [0.0, 0.2, 0.0]),
        ([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]], [0.0, -0.2, 0.0]),
        ([[-1.0, 0.2, 0.5], [1.0, 0.0, 0.0]], [-0.15, 0.0, 0.0]),
        (None, [0.0, 0.2, 0.0]),
    ],
)
def test_contacts_face_the_robots(bases: Any, expected: list[float]) -> None:
    way = np.array([[-0.4, 0.0, 0.3, 0, 0, 0], [0.4, 0.1, 0.6, 0, 0, 0]])
    given = None if bases is None else np.array(bases)
    first, second = contact_points(np.array([0.3, 0.4, 0.2]), way, np.eye(3), given)
    np.testing.assert_allclose(first, expected)
    np.testing.assert_allclose(second, -np.array(expected))


def test_a_turned_box_is_pressed_on_the_faces_that_look_at_the_robots() -> None:
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    bases = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    first, _ = contact_points(np.array([0.3, 0.4, 0.2]), np.zeros((2, 6)), quarter, bases)
    np.testing.assert_allclose(first, [0.15, 0.0, 0.0])


def test_paths_lead_to_the_same_files_from_another_folder(tmp_path: Path) -> None:
    (tmp_path / "cells").mkdir()
    (tmp_path / "robots").mkdir()
    text = Path("studies/workcells/rack.toml").read_text(encoding="utf-8")
    (tmp_path / "robots" / "gofa12.urdf").write_bytes(
        Path("studies/robots/gofa12.urdf").read_bytes()
    )
    (tmp_path / "cells" / "rack.toml").write_text(text, encoding="utf-8")
    problem = read_problem(tmp_path / "cells" / "rack.toml")
    waypoints = {"task": {"waypoints": [{"lower": [-1.0] * 6, "upper": [1.0] * 6}]}}
    other = tmp_path / "rack.toml"
    other.write_text(problem.completed(waypoints, tmp_path), encoding="utf-8")
    assert tomllib.loads(other.read_text())["robots"][0]["urdf"] == "robots/gofa12.urdf"
    assert load(other).robots[0].urdf == tmp_path / "robots" / "gofa12.urdf"


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"goal": [0.0]}, r"task\.goal"),
        ({"waypoints": [{"fixed": [0.0] * 6}]}, "found a fixed one"),
        ({"time_law": "optimal"}, r"task\.time_law"),
        ({"reference_force": -1.0}, r"task\.reference_force"),
    ],
)
def test_what_is_wrong_is_told_with_its_key_and_the_file(
    changes: dict[str, Any], told: str, tmp_path: Path
) -> None:
    path = rack_problem(tmp_path, {"task": changes})
    with pytest.raises(WorkcellError, match=told) as error:
        read_problem(path).workcell()
    assert str(path) in str(error.value)


def test_missing_sections_are_told(tmp_path: Path) -> None:
    path = tmp_path / "empty.toml"
    path.write_text("name = 'x'\n")
    with pytest.raises(WorkcellError, match="task: is missing"):
        read_problem(path)
    path.write_text(completed("", {"task": {}, "payload": {}, "robots": [], "contacts": [1]}, {}))
    with pytest.raises(WorkcellError, match="allowed are exactly 2"):
        read_problem(path)


BASES = [{"base": {"xyz": [0.0, 0.9, 0.0]}}, {"base": {"xyz": [0.0, -0.9, 0.0]}}]


def problem_of(turn: float, robots: Any = BASES, **task: object) -> Problem:
    start = [0.0, 0.0, 1.0, 0.0, 0.0, turn]
    goal = [0.5, 0.0, 1.0, 0.0, 0.0, 4.0]
    data = {
        "task": {"start": start, "goal": goal, **task},
        "payload": {"size": [0.2, 0.3, 0.1]},
        "contacts": [{}, {}],
        "robots": robots,
    }
    return Problem(Path(), "", data)


def test_angles_go_the_near_way_and_rotation_vectors_as_written() -> None:
    assert problem_of(0.0).poses[1][5] == pytest.approx(4.0 - 2.0 * np.pi)
    assert problem_of(0.0, rotation="quaternion").poses[1][5] == 4.0


@pytest.mark.parametrize("turn", [0.0, np.pi / 2.0, 0.3])
@pytest.mark.parametrize("robots", [BASES, [{}, {}]])
def test_about_one_axis_both_have_the_same_contacts(turn: float, robots: Any) -> None:
    angles = problem_of(turn, robots)
    assert angles.contacts == problem_of(turn, robots, rotation="quaternion").contacts


def test_contacts_lie_on_faces_of_the_turned_reference() -> None:
    quarter = [0.0, 0.0, np.pi / 2.0]
    problem = problem_of(0.0, rotation="quaternion", rotation_reference=quarter)
    np.testing.assert_array_equal(problem.orientation.reference, rotation_from_rpy(quarter))
    assert problem.contacts[0]["xyz"] == [0.1, 0.0, 0.0]


def test_contacts_face_the_shoulders_of_a_machine(tmp_path: Path) -> None:
    """The left arm first: +y, where its shoulder is, although both arms stand at one base."""
    problem = read_problem(tiago_problem(tmp_path))
    assert problem.is_machine
    assert [contact["xyz"] for contact in problem.contacts] == [[0.0, 0.18, 0.0], [0.0, -0.18, 0.0]]


def test_contacts_face_shoulders_that_are_out_of_one_anothers_reach(tmp_path: Path) -> None:
    """A beam of 3 m: each arm reaches the end on its own side only, the left arm that at -y."""
    text = tiago_problem(tmp_path).read_text(encoding="utf-8")
    data = tomllib.loads(text)
    chains = [robot["chain"] for robot in data["robots"]]
    swapped = {"robots": [{"chain": chains[1]}, {"chain": chains[0]}]}
    changes = {"payload": {"size": [0.1, 3.0, 0.1]}, **swapped}
    path = tmp_path / "beam.toml"
    path.write_text(completed(text, data, changes), encoding="utf-8")
    assert [contact["xyz"][1] for contact in read_problem(path).contacts] == [-1.5, 1.5]


def test_two_arms_of_one_type_are_no_machine() -> None:
    assert not read_problem(POST).is_machine


def test_without_bases_a_machine_may_press_either_pair_of_faces_either_way_round(
    tmp_path: Path,
) -> None:
    path = tmp_path / "baxter.toml"
    path.write_text(re.sub(r"\nbase = .*", "", BAXTER), encoding="utf-8")
    sides = read_problem(path).sides()
    found = [[contact["xyz"] for contact in side.contacts] for side in sides]
    pairs = [[[0.1, 0, 0], [-0.1, 0, 0]], [[0, 0.15, 0], [0, -0.15, 0]]]
    assert found == [pair[::way] for pair in pairs for way in (1, -1)]
    post = read_problem(POST)
    assert post.sides() == [post]


def test_a_mesh_of_the_payload_is_found_from_another_folder(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box([0.3, 0.4, 0.25]).export(tmp_path / "meshes" / "box.stl")
    changes = {"payload": {"kind": "mesh", "size": None, "path": "meshes/box.stl"}}
    data = tomllib.loads(POST.read_text(encoding="utf-8"))
    points = [
        {"xyz": [0.0, side * 0.2, 0.0], "normal": [0.0, -side, 0.0], "friction": 0.8}
        for side in (1.0, -1.0)
    ]
    data["contacts"] = [point | {"patch_radius": 0.04} for point in points]
    path = tmp_path / "mesh.toml"
    path.write_text(completed("", data, changes), encoding="utf-8")
    problem = read_problem(path)
    assert problem.workcell().payload.size == pytest.approx([0.3, 0.4, 0.25])
    (tmp_path / "other").mkdir()
    moved = tomllib.loads(problem.completed({}, tmp_path / "other"))
    assert moved["payload"]["path"] == "../meshes/box.stl"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("goal = [0.45,", "goal = [-0.45,", r"task\.goal: found the start again"),
        ("mass = 6.0", "mass = nan", r"payload\.mass: found nan"),
        (
            "[0.0, -0.9, 0.0], rpy = [0.0, 0.0, 1",
            "[0.0, 0.9, 0.0], rpy = [0.0, 0.0, -1",
            "same arm",
        ),
    ],
)
def test_what_no_carry_can_come_of_is_told(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    text = POST.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "cell.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(WorkcellError, match=message):
        read_problem(path).workcell()


TEXT = """# A cell.
name = "cell"   # its name

[[robots]]
name = "a"

[[robots.tool]]
name = "pad"

[[robots]]
name = "b"

[task]
start = [0.0, 1.0]
initial = [[1.0]]

# What stands there.
[[environment]]
name = "post"
"""


def test_comments_stay_and_values_are_set() -> None:
    changes = {
        "robots": [{"start_branch": 2}, {"base": {"xyz": [0.0, 0.0, 1.0]}}],
        "task": {"initial": None, "waypoints": [{"lower": [0.0]}, {"lower": [1.0]}]},
    }
    found = completed(TEXT, tomllib.loads(TEXT), changes)
    assert "# A cell." in found
    assert '"cell"   # its name' in found
    assert "# What stands there." in found
    said = tomllib.loads(found)
    assert said["robots"][0] == {"name": "a", "start_branch": 2, "tool": [{"name": "pad"}]}
    assert said["robots"][1] == {"name": "b", "base": {"xyz": [0.0, 0.0, 1.0]}}
    assert said["task"] == {"start": [0.0, 1.0], "waypoints": [{"lower": [0.0]}, {"lower": [1.0]}]}
    assert said["environment"] == [{"name": "post"}]


def test_without_text_all_of_it_is_written() -> None:
    data = tomllib.loads(TEXT)
    assert tomllib.loads(completed("", data, {"task": {"goal": [1.0]}})) == merged(
        data, {"task": {"goal": [1.0]}}
    )


def test_lists_of_tables_of_another_length_are_replaced() -> None:
    assert merged({"a": [{"x": 1}]}, {"a": [{"y": 1}, {"y": 2}]}) == {"a": [{"y": 1}, {"y": 2}]}
    assert merged({"a": [{"x": 1}]}, {"a": [{"y": 1}]}) == {"a": [{"x": 1, "y": 1}]}


def test_text_that_says_something_else_is_refused() -> None:
    with pytest.raises(SettingsError, match="cannot be completed"):
        completed(TEXT, {"name": "another"}, {})
