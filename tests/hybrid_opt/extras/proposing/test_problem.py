"""Problem files, the workcell files that complete them, and bounds around a path."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

import hybrid_opt as ho
from hybrid_opt.extras.proposing.bounds import Sampling
from hybrid_opt.extras.proposing.problem import (
    Problem,
    contact_points,
    read_problem,
)
from symbolic.array import Array
from symbolic.errors import SettingsError, WorkcellError
from symbolic.read.cell import load
from symbolic.read.editing import completed, merged
from symbolic.records.poses import rotation_from_rpy
from tests.hybrid_opt.extras.proposing.problems import BAXTER, tiago_problem
from tests.hybrid_opt.extras.proposing.test_proposal import rack_problem
from tests.refusals import refused

POST = Path("studies/problems/past-a-post.toml")


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
    size, given = np.array([0.3, 0.4, 0.2]), None if bases is None else np.array(bases)
    first, second = contact_points(size, way, np.eye(3), given)
    np.testing.assert_allclose(first, expected)
    np.testing.assert_allclose(second, -np.array(expected))
    if given is None or expected[1] <= 0.0:
        return
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    first, _ = contact_points(size, way, quarter, given)
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
        ({"task": {"goal": [0.0]}}, r"task\.goal"),
        ({"task": {"goal": [0.0, 0.0, 0.745, 0.0, 0.0, 0.0]}}, r"task\.goal"),
        ({"task": {"waypoints": [{"fixed": [0.0] * 6}]}}, r"task\.waypoints"),
        ({"task": {"time_law": "optimal"}}, r"task\.time_law"),
        ({"task": {"reference_force": -1.0}}, r"task\.reference_force"),
        ({"payload": {"mass": float("nan")}}, r"payload\.mass: "),
    ],
)
def test_what_is_wrong_is_told_with_its_key_and_the_file(
    changes: dict[str, Any], told: str, tmp_path: Path
) -> None:
    path = rack_problem(tmp_path, changes)
    with pytest.raises(WorkcellError, match=told) as error:
        read_problem(path).workcell()
    assert str(path) in str(error.value)


def test_missing_sections_are_told(tmp_path: Path) -> None:
    path = tmp_path / "empty.toml"
    path.write_text("name = 'x'\n")
    with refused(WorkcellError, "workcell", "task: "):
        read_problem(path)
    path.write_text(completed("", {"task": {}, "payload": {}, "robots": [], "contacts": [1]}, {}))
    with refused(WorkcellError, "workcell", "robots: ", "contacts"):
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
    assert not post.is_machine
    assert post.sides() == [post]


def test_the_shipped_problem_states_its_grip_budget() -> None:
    told = re.search(r"(\d+\.\d) N hold this box still", POST.read_text(encoding="utf-8"))
    assert told is not None
    budget = ho.grip_budget(read_problem(POST).workcell())
    assert budget.fits
    assert float(told[1]) == pytest.approx(budget.required.max(), abs=0.05)


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


def test_comments_stay_with_the_table_that_they_are_about() -> None:
    """Before the heading of what stands there, whichever tables come or go before it."""
    heading = '\n\n# What stands there.\n[[environment]]\nname = "post"\n'
    assert TEXT.endswith(heading)
    waypoints = {"waypoints": [{"lower": [0.0]}, {"lower": [1.0]}]}
    first = completed(TEXT, tomllib.loads(TEXT), {"task": {"initial": [[2.0]], **waypoints}})
    allowed = {"allowed_contacts": [{"body": "post"}]}
    second = completed(first, tomllib.loads(first), {"task": allowed})
    third = completed(second, tomllib.loads(second), {"task": dict.fromkeys(allowed | waypoints)})
    assert third == completed(TEXT, tomllib.loads(TEXT), {"task": {"initial": [[2.0]]}})
    for text in (first, second, third):
        assert text.endswith(heading)
    assert "[1.0]\n\n[[task.allowed_contacts]]" in second


def test_tables_are_merged_and_written_without_text_or_refused_with_another() -> None:
    """Lists of tables of another length are replaced."""
    assert merged({"a": [{"x": 1}]}, {"a": [{"y": 1}, {"y": 2}]}) == {"a": [{"y": 1}, {"y": 2}]}
    assert merged({"a": [{"x": 1}]}, {"a": [{"y": 1}]}) == {"a": [{"x": 1, "y": 1}]}
    data, goal = tomllib.loads(TEXT), {"task": {"goal": [1.0]}}
    assert tomllib.loads(completed("", data, goal)) == merged(data, goal)
    with refused(SettingsError, "not-completable"):
        completed(TEXT, {"name": "another"}, {"task": {}})


def sampling(n: int, seed: int) -> Sampling:
    """Feasible is what lies in a ball about (0.3, ...)."""

    def feasible(x: Array) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(x - 0.3, axis=1) < 0.5)

    limits = np.array([np.full(n, -10.0), np.full(n, 10.0)])
    rng = np.random.default_rng(seed)

    def certain(x: Array) -> bool:
        return bool(feasible(x[None])[0])

    return Sampling(feasible, certain, np.full(n, 0.1), limits, rng, 0.02, 0.20, lambda: False)


@pytest.mark.parametrize("n", [3, 6, 12])
def test_the_wanted_share_of_candidates_is_feasible(n: int) -> None:
    how = sampling(n, 1)
    found = how.bounds_around(np.zeros(n) + 0.2)
    assert 0.02 <= found.share <= 0.20
    fresh = np.random.default_rng(7).uniform(found.lower, found.upper, (20_000, n))
    assert 0.015 <= how.feasible(fresh).mean() <= 0.25
    assert how.feasible(found.carry[None])[0]
    assert np.all(found.lower <= found.carry + 1e-4)
    assert np.all(found.carry <= found.upper + 1e-4)


def test_bounds_move_to_where_feasible_candidates_lie_and_the_carry_stays() -> None:
    edge = np.full(6, 0.3) - 0.45 / np.sqrt(6.0)
    found = sampling(6, 2).bounds_around(edge)
    middle = (found.lower + found.upper) / 2.0
    assert np.linalg.norm(middle - 0.3) < 0.7 * np.linalg.norm(edge - 0.3)
    assert np.all((found.lower - 1e-4 <= found.carry) & (found.carry <= found.upper + 1e-4))
    assert np.linalg.norm(found.carry - edge) < 0.7 * np.linalg.norm(middle - edge)


@pytest.mark.parametrize("limit", [0.35, 0.15])
def test_bounds_keep_to_limits_unless_the_carry_is_beyond_them(limit: float) -> None:
    how = sampling(3, 3)
    how.limits[1] = limit
    found = how.bounds_around(np.full(3, 0.2))
    assert np.all(found.upper <= max(limit, 0.2))
    assert np.all((found.lower <= found.carry) & (found.carry <= found.upper))


@pytest.mark.parametrize("calls", [0, 3, 6])
def test_when_time_is_up_the_best_bounds_so_far_are_taken(calls: int) -> None:
    how, asked = sampling(6, 5), [0]

    def out_of_time() -> bool:
        asked[0] += 1
        return asked[0] > calls

    found = replace(how, out_of_time=out_of_time).bounds_around(np.full(6, 0.2))
    assert found.candidates >= 32
    assert how.feasible(found.carry[None])[0]
