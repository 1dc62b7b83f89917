"""Sections of a workcell file: contacts, start branches, redundant joints, how it is driven."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from symbolic.errors import BundleError, WorkcellError
from symbolic.path.spline import coarse_task, extended_waypoints, waypoints_of
from symbolic.read.arms import arm_model
from symbolic.read.cell import load, with_branches
from symbolic.read.cell_files import CellFiles, collect_cell, drivable_files, unpack_cell
from symbolic.read.payload import pad_rotation
from symbolic.read.task import best_conditioned, posture_path
from symbolic.records import Cylinder, Mesh, Workcell
from symbolic.records.task import decision_of, initial_decision, straight_line
from tests.machines import SINGLE, single_cell
from tests.odd_cells import PANDA_JOINT, free_pandas, rack_on_rail
from tests.studies.conftest import TRANSFER
from tests.symbolic.cells import rack_cell
from tests.symbolic.read.samples import RACK, sample_data, write


def cell(folder: Path, **changes: Any) -> Workcell:
    """The sample cell held by soft fingers with other tables; `contacts` one per robot."""
    data = sample_data()
    data["task"] |= {"allocation": "soft-finger"} | changes.pop("task", {})
    for name, value in changes.items():
        data[name] = value
    return load(write(folder, data))


def contact(**values: Any) -> dict[str, Any]:
    """A contact of the sample cell, 0.3 x 0.4 x 0.25 m, unless told otherwise."""
    return {"xyz": [0.0, 0.2, 0.0], "friction": 0.8, "patch_radius": 0.02} | values


OPPOSITE = contact(xyz=[0.0, -0.2, 0.0])


def test_a_pad_at_a_given_normal(tmp_path: Path) -> None:
    handle = contact(xyz=[0.0, 0.22, 0.1], normal=[0.0, -2.0, 0.5], spin=0.3)
    first = cell(tmp_path, contacts=[handle, OPPOSITE]).contacts[0]
    z = np.array([0.0, -2.0, 0.5]) / np.hypot(2.0, 0.5)
    np.testing.assert_allclose(first.T_box_pad[:3, 2], z, atol=1e-15)
    np.testing.assert_array_equal(first.T_box_pad[:3, 3], [0.0, 0.22, 0.1])
    unspun = pad_rotation(z, 0.0)
    assert unspun[2, 0] > 0.9  # x along +z as far as it can
    np.testing.assert_allclose(
        unspun.T @ first.T_box_pad[:3, :3],
        [[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]],
        atol=1e-15,
    )


def test_a_rectangular_patch_and_a_fork(tmp_path: Path) -> None:
    fork = contact(
        xyz=[-0.1, 0.2, 0.0], patch_size=[0.06, 0.03], further=[{"xyz": [0.1, 0.2, 0.0]}]
    )
    del fork["patch_radius"]
    found = cell(tmp_path, contacts=[fork, OPPOSITE])
    first, second = found.contacts
    assert first.half_sides == (0.03, 0.015)
    assert first.patch_radius == pytest.approx(np.hypot(0.03, 0.015))
    assert second.half_sides is None
    (other,) = first.further
    np.testing.assert_array_equal(other.T_box_pad[:3, 3], [0.1, 0.2, 0.0])
    assert (other.friction, other.half_sides) == (0.8, (0.03, 0.015))
    assert found.pad_robots == (0, 0, 1)
    assert not found.has_facing_pads


def test_a_cylinder(tmp_path: Path) -> None:
    drum = {"kind": "cylinder", "radius": 0.2, "length": 0.3, "mass": 6.0}
    angle = np.deg2rad(80.0)
    place = [float(0.2 * np.cos(angle)), float(0.2 * np.sin(angle)), 0.05]
    found = cell(tmp_path, payload=drum, contacts=[contact(xyz=place), OPPOSITE])
    assert found.payload.shape == Cylinder(0.2, 0.3)
    np.testing.assert_array_equal(found.payload.size, [0.4, 0.4, 0.3])
    across = 6.0 / 12.0 * (3 * 0.2**2 + 0.3**2)
    np.testing.assert_allclose(found.payload.inertia, np.diag([across, across, 3.0 * 0.2**2]))
    normal = found.contacts[0].T_box_pad[:3, 2]
    np.testing.assert_allclose(normal, [-np.cos(angle), -np.sin(angle), 0.0], atol=1e-12)
    end = contact(xyz=[0.05, 0.0, 0.15])
    contacts = [end, contact(xyz=[0.05, 0.0, -0.15])]
    low = {"goal": [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]}  # within reach from above
    found = cell(tmp_path, payload=drum, contacts=contacts, task=low)
    np.testing.assert_array_equal(found.contacts[0].T_box_pad[:3, 2], [0.0, 0.0, -1.0])


def test_a_mesh(tmp_path: Path) -> None:
    """A homogeneous box as a mesh, off its frame, has the box's centre and inertia."""
    solid = trimesh.creation.box(extents=[200.0, 300.0, 100.0])
    solid.apply_translation([10.0, 20.0, 30.0])
    solid.export(tmp_path / "part.stl")
    mesh = {"kind": "mesh", "path": "part.stl", "scale": 0.001, "mass": 6.0}
    pads = [
        contact(xyz=[0.01, 0.17, 0.03], normal=[0, -1, 0]),
        contact(xyz=[0.01, -0.13, 0.03], normal=[0, 1, 0]),
    ]
    found = cell(tmp_path, payload=mesh, contacts=pads)
    assert isinstance(found.payload.shape, Mesh)
    np.testing.assert_allclose(found.payload.size, [0.22, 0.34, 0.16], rtol=1e-6)
    np.testing.assert_allclose(found.payload.centre_of_mass, [0.01, 0.02, 0.03], atol=1e-7)
    expected = 0.5 * np.diag([0.3**2 + 0.1**2, 0.2**2 + 0.1**2, 0.2**2 + 0.3**2])
    np.testing.assert_allclose(found.payload.inertia, expected, rtol=1e-5, atol=1e-9)
    # The mesh is one of the cell's files: it is told apart by its content, and travels with it.
    digest = found.digest
    there = tmp_path / "elsewhere"
    there.mkdir()
    unpacked = unpack_cell(collect_cell(found), there)
    np.testing.assert_array_equal(unpacked.payload.inertia, found.payload.inertia)
    solid.apply_translation([0.0, 0.0, 1.0])
    solid.export(tmp_path / "part.stl")
    assert load(found.source).digest != digest


@pytest.mark.parametrize(
    ("first", "allocation", "path", "words"),
    [
        ({"normal": [0, 0, 0]}, "soft-finger", "contacts[0].normal", "direction"),
        (
            {"xyz": [0, 0.9, 0], "normal": [0, -1, 0]},
            "soft-finger",
            "contacts[0].xyz",
            "diagonal",
        ),
        ({"patch_size": [0.1, 0.1]}, "soft-finger", "contacts[0].patch_size", "beside"),
        (
            {"further": [{"xyz": [0.05, 0.2, 0]}] * 3},
            "soft-finger",
            "contacts",
            "5 pads",
        ),
        ({"xyz": [0.15, 0, 0]}, "soft-finger", "contacts", "close"),
        ({"xyz": [0.15, 0, 0]}, "paper", "contacts[1].xyz", "'soft-finger'"),
        ({"further": [{"xyz": [0.05, 0.2, 0]}]}, "paper", "contacts[1].xyz", "3 pads"),
    ],
)
def test_refuses(
    first: dict[str, Any], allocation: str, path: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(WorkcellError) as caught:
        cell(tmp_path, contacts=[contact(**first), OPPOSITE], task={"allocation": allocation})
    found = [problem for problem in caught.value.problems if problem.startswith(f"{path}: ")]
    assert any(words in problem for problem in found), caught.value.problems


@pytest.mark.parametrize(
    ("robots", "decided", "expected"),
    [
        ("[{start_branch = 'search'}, {start_branch=\"search\"}]", (3, 5), [3, 5]),
        ('[{start_branch = "search"}, {start_branch = "search"}]', (-2, 5), ["search", 5]),
        ('[{start_branch = 7}, {"start_branch" = "search"}]', (3, 5), [7, 5]),
        ('[{start_branch = "search"}, {}]', (3, 5), [3, None]),
    ],
)
def test_each_robot_gets_its_own_branch_where_it_is_decided(
    robots: str, decided: tuple[int, int], expected: list[int | str | None]
) -> None:
    text = f"robots = {robots}\n".encode()
    changed = with_branches(text, tomllib.loads(text.decode()), decided)
    found = tomllib.loads(changed.decode())["robots"]
    assert [robot.get("start_branch") for robot in found] == expected


def test_the_tool_chooses_what_leaves_the_others_conditioned_best(tmp_path: Path) -> None:
    """With bounds and a path within the limits."""
    cell = free_pandas(tmp_path)
    assert [joint.drives for joint in cell.task.redundant] == [(2, -1), (-1, 2)]
    for joint, robot in zip(cell.task.redundant, cell.robots, strict=True):
        assert joint.name == f"{robot.name}/panda_joint3"
        assert robot.redundant_joints == ("panda_joint3",)
        np.testing.assert_array_equal(joint.lower, robot.position_lower[2])
        np.testing.assert_array_equal(joint.upper, robot.position_upper[2])
        assert np.all((joint.lower < joint.initial) & (joint.initial < joint.upper))
    path = posture_path(cell.robots[0], cell.contacts[0], cell.task, {})
    assert path is not None
    least = [
        min(np.linalg.svd(np.delete(J, k, axis=1), compute_uv=False)[-1] for J in path.jacobian)
        for k in range(7)
    ]
    assert best_conditioned(path, 7, ()) == (int(np.argmax(least)),)
    assert best_conditioned(path, 7, (5,)) == (5,)


def test_what_the_file_says_holds(tmp_path: Path) -> None:
    entry = "lower = [0.1, -0.5, -0.6], upper = [0.1, 0.5, 0.6], initial = 0.1"
    task = free_pandas(tmp_path, entry).task
    assert task.n_var == 6 + 4
    np.testing.assert_array_equal(task.lower[6:], [-0.5, -0.6] * 2)
    x = np.concatenate([task.initial.ravel(), [0.2, 0.3, -0.2, -0.3]])
    points = extended_waypoints(task, x)
    np.testing.assert_array_equal(points[:, 6], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(points[:, 7], [0.1, -0.2, -0.3])
    np.testing.assert_array_equal(points[:, :6], waypoints_of(task, x))
    np.testing.assert_array_equal(decision_of(task, points), x)
    np.testing.assert_array_equal(initial_decision(task)[6:], 0.1)
    np.testing.assert_array_equal(straight_line(task)[6:], 0.1)


def test_a_slide_is_redundant_by_itself(tmp_path: Path) -> None:
    cell = rack_on_rail(tmp_path, 0.3)
    assert cell.robots[0].redundant_joints == ("slide",)
    assert cell.robots[1].redundant_joints == ()
    assert [str(j.shortname()) for j in arm_model(cell.robots[0]).joints[1:2]] == ["JointModelPX"]
    assert cell.task.n_var == load(RACK).task.n_var


@pytest.mark.parametrize(
    ("joint", "entry", "told"),
    [
        (PANDA_JOINT, "lower = 1.0, upper = 0.5", "lower <= initial <= upper"),
        (PANDA_JOINT, "upper = 3.5", "limits"),
        (PANDA_JOINT, "initial = [0.1, 0.2]", "3 numbers"),
        (PANDA_JOINT, "joints = 3", "joints"),
        ("elbow", "initial = 0.1", "left/panda_joint3, right/panda_joint3"),
    ],
)
def test_wrong_entries_are_told(tmp_path: Path, joint: str, entry: str, told: str) -> None:
    with pytest.raises(WorkcellError, match=r"task\.redundant") as error:
        free_pandas(tmp_path, entry, joint)
    assert told in str(error.value)


def test_redundant_joints_are_as_many_as_there_are_beyond_six(tmp_path: Path) -> None:
    path = single_cell(SINGLE["panda"], tmp_path, {})
    named = '"redundant_joints" = ["panda_joint1", "panda_joint3"], "base" ='
    path.write_text(path.read_text().replace('"base" =', named))
    with pytest.raises(WorkcellError, match=r"redundant_joints: .*2.* 1 "):
        load(path)
    path.write_text(path.read_text().replace('"panda_joint1", "panda_joint3"', '"panda_joint5"'))
    assert load(path).robots[0].redundant_joints == ("panda_joint5",)


LAW = 'time_law = "constant"\n'


@pytest.mark.parametrize("path", [RACK, TRANSFER])
def test_only_the_time_law_differs(path: Path, tmp_path: Path) -> None:
    cell = load(path)
    original = collect_cell(cell)
    drivable = unpack_cell(drivable_files(original), tmp_path)
    assert drivable.task.time_law == "optimal"
    assert coarse_task(drivable.task).n_var == cell.task.n_var + 1
    assert drivable.digest != cell.digest
    first, second = (
        tomllib.loads(stored.files[stored.workcell].decode())
        for stored in (original, drivable_files(original))
    )
    assert second["task"].pop("time_law") == "optimal"
    first["task"].pop("time_law")
    assert first == second
    np.testing.assert_array_equal(coarse_task(drivable.task).lower[:-1], cell.task.lower)


def rewritten(old: str, new: str) -> CellFiles:
    """The rack's files, the workcell's text changed."""
    stored = collect_cell(rack_cell())
    text = stored.files[stored.workcell].decode()
    assert old in text
    changed = text.replace(old, new).encode()
    return replace(stored, files={**stored.files, stored.workcell: changed})


@pytest.mark.parametrize(("old", "new"), [(LAW, ""), ("[task]", "[ task ]  # heading")])
def test_the_key_may_stand_anywhere_in_its_table_or_be_missing(old: str, new: str) -> None:
    made = drivable_files(rewritten(old, new))
    assert tomllib.loads(made.files[made.workcell].decode())["task"]["time_law"] == "optimal"


def test_a_task_written_otherwise_is_refused() -> None:
    with pytest.raises(BundleError, match="time_law"):
        drivable_files(rewritten("[task]\nstart =", "task.start ="))


@pytest.mark.parametrize(
    ("stated", "usual", "driven"),
    [
        ("", "paper", "soft-finger"),
        ('allocation = "soft-finger"\n', "soft-finger", "soft-finger"),
        ('drivable_allocation = "paper"\n', "paper", "paper"),
        ('allocation = "soft-finger"\ndrivable_allocation = "paper"\n', "soft-finger", "paper"),
    ],
)
def test_what_robots_drive_has_an_allocation_of_its_own(
    stated: str, usual: str, driven: str, tmp_path: Path
) -> None:
    variant = rewritten("[task]\n", f"[task]\n{stated}")
    cell = unpack_cell(variant, tmp_path / "usual", check_digest=False)
    assert cell.task.allocation == usual
    assert unpack_cell(drivable_files(variant), tmp_path / "driven").task.allocation == driven
