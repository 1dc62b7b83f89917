"""Programs about cells: inspected, proposed, completed with another program's scene."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

import hybrid_opt as ho
from hybrid_opt.cell import Cell
from hybrid_opt.display.solids import cell_solids
from hybrid_opt.evaluate.evaluation import REASONS, CandidateEvaluator
from hybrid_opt.evaluate.explanation import explain
from hybrid_opt.indicators.metrics import BindingBound
from studies import inspect, propose, scene
from studies.program import BAD_INPUT
from studies.programs import inspection
from studies.programs.inspection import Optimum, inspected, show
from studies.report.pictures_cell import meeting_place
from symbolic.read.cell import load
from symbolic.read.editing import completed
from symbolic.records import Body, Mesh, Workcell
from symbolic.records.poses import pose_matrix
from symbolic.records.task import straight_line
from tests.refusals import ended_by
from tests.studies.conftest import TRANSFER
from tests.symbolic.cells import RACK, standing_text


@pytest.fixture(scope="module")
def transfer() -> Workcell:
    return load(TRANSFER)


class Inspection(SimpleNamespace):
    """The values of an inspection as attributes, and its lines."""


def find(workcell: Workcell, *given: Any, **more: Any) -> Inspection:
    parts = list(inspected(workcell, *given, **more))
    values = {name: value for part in parts for name, value in part.values.items()}
    return Inspection(**values, lines=[line for part in parts for line in part.lines])


@pytest.fixture(scope="module")
def found(transfer: Workcell, tmp_path_factory: pytest.TempPathFactory) -> Inspection:
    folder = tmp_path_factory.mktemp("pictures")
    return find(transfer, 300, 7, folder, view=folder / "new" / "view.html")


def test_the_second_cell_is_worth_searching_and_counts_are_the_evaluators(
    found: Inspection, transfer: Workcell
) -> None:
    assert found.initial.feasible
    assert not found.straight_line.feasible
    assert 0.02 <= found.feasible_share <= 0.20
    evaluator = CandidateEvaluator(transfer)
    x = np.random.default_rng(7).uniform(evaluator.lower, evaluator.upper, (300, evaluator.n_var))
    verdicts = evaluator.evaluate(x)
    assert found.feasible_share == pytest.approx(verdicts.feasible.mean())
    for reason, count in found.infeasible_by_reason.items():
        assert count == (verdicts.reason == REASONS.index(reason)).sum()
    assert sum(found.infeasible_by_reason.values()) == (~verdicts.feasible).sum()


def test_a_new_cell_needs_no_compiler_and_its_meshes_are_told(
    transfer: Workcell, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    box, ball = trimesh.creation.box((0.3, 0.2, 0.1)), trimesh.creation.icosphere(radius=0.04)
    both = trimesh.util.concatenate([box, ball])
    (tmp_path / "part.stl").write_bytes(trimesh.exchange.stl.export_stl(both))
    away = pose_matrix([0.0, 0.0, 4.0], [0.0, 0.0, 0.0])
    part = Body("part", Mesh(tmp_path / "part.stl", np.ones(3)), away)
    cell = replace(transfer, environment=(*transfer.environment, part))
    monkeypatch.setenv("DUAL_ARM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("CC", "no-such-compiler")
    found = find(cell, 1, 1)
    vertices = 8 + len(ball.vertices)
    assert found.meshes == {
        "part.stl": {"parts": 2, "open_parts": 0, "vertices": vertices, "pieces": 1, "corners": 8}
    }
    told = f"  part.stl: {vertices} vertices in 2 part(s) became 8 in 1 convex piece(s)"
    assert told in found.lines
    assert not (tmp_path / "cache").exists()


def test_every_pair_is_active_or_excluded_with_a_reason(found: Inspection) -> None:
    pairs = [frozenset(pair) for pair in found.active_pairs]
    pairs += [frozenset(pair[:2]) for pair in found.excluded_pairs]
    bodies = frozenset().union(*pairs)
    assert len(pairs) == len(set(pairs)) == len(bodies) * (len(bodies) - 1) // 2
    assert all(reason for _, _, reason in found.excluded_pairs)
    assert frozenset(("payload", "wall")) in {frozenset(pair) for pair in found.active_pairs}


def test_one_branch_of_each_arm_is_chosen(found: Inspection) -> None:
    assert set(found.branches) == {"north", "south"}
    for branches in found.branches.values():
        assert sum(branch.chosen for branch in branches) == 1
        assert all(branch.clearance_mm >= 0.0 for branch in branches if branch.clearance_mm)
        assert branches[0].kept_samples == max(branch.kept_samples for branch in branches)


def test_pictures_are_drawn(found: Inspection) -> None:
    names = sorted(Path(file).name for file in found.files)
    drawn = ("cell", "collision_straight_line", "reachable_regions")
    assert names == [f"{name}.png" for name in drawn]
    for file in found.files:
        assert np.asarray(Image.open(file).convert("L")).std() > 10.0


def test_the_view_plays_the_hand_made_trajectory(found: Inspection) -> None:
    page = Path(found.view).read_text("utf-8")
    assert load(TRANSFER).name in page
    assert '<div id="note"></div>' in page
    assert '"begin":0.0' in page
    assert any(found.view in line for line in found.lines)


def test_the_view_of_a_carry_that_fails_begins_there_and_so_does_the_picture(
    transfer: Workcell, found: Inspection, tmp_path: Path
) -> None:
    cell, x = Cell(transfer), straight_line(transfer.task)
    (why,) = explain(cell.evaluator, cell.evaluate(x))
    assert str(why) == found.explained["straight_line"]
    carry, geometry = cell.carry(x), cell.geometry
    page = Path(show(carry, why, tmp_path / "view.html")).read_text("utf-8")
    assert f'<div id="note">{why}</div>' in page
    assert f'"begin":{float(carry.time[why.sample])!r}' in page
    assert page.count('"group":"marked"') == 2
    assert why.pair == ("payload", "wall")
    at = carry.pose[why.sample], carry.q[why.sample]
    place = meeting_place(geometry, cell_solids(geometry), why.pair, *at)
    # The wall, that the payload meets, is 40 mm thick, 0.5 m wide and 0.87 m high.
    assert np.all(np.abs(place - [0.0, 0.0, 0.435]) < [0.021, 0.26, 0.44])
    assert np.all(np.abs(place - at[0][:3]) < [0.2, 0.2, 0.2])


def test_the_straight_line_is_straight(transfer: Workcell) -> None:
    for task in (transfer.task, load(RACK).task):
        start, goal = task.waypoints[0].lower, task.waypoints[-1].lower
        corners = [start, *(w.lower for w in task.waypoints[1:-1] if w.is_fixed), goal]
        for row in straight_line(task).reshape(-1, 6):
            gaps = [
                np.linalg.norm(row - a) + np.linalg.norm(b - row) - np.linalg.norm(b - a)
                for a, b in pairwise(corners)
            ]
            assert min(gaps) == pytest.approx(0.0, abs=1e-12)


def test_verdicts_are_told_before_what_takes_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    def later(*given: object, **more: object) -> None:
        raise NotImplementedError

    for name in ("_optimum", "draw", "show", "frequent"):
        monkeypatch.setattr(inspection, name, later)
    parts = inspected(load(RACK), 10, 1, Path("pictures"), polish=True, view=Path("view"))
    lines: list[str] = []
    with pytest.raises(NotImplementedError):
        lines.extend(line for part in parts for line in part.lines)
    text = "\n".join(lines)
    for words in ("trajectory: feasible", "Straight line: ", "% feasible"):
        assert words in text


def test_text_and_json_say_the_same_of_a_short_polish_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(inspection, "SHORT_POLISH_ATTEMPTS", 1)
    monkeypatch.setattr(ho, "PolishSettings", partial(ho.PolishSettings, rounds=1))
    arguments = [str(RACK), "--candidates", "100", "--no-pictures"]
    assert inspect.main([*arguments, "--polish"]) == 0
    said = capsys.readouterr()
    assert "short polish: 0 of 1 " in said.err
    assert re.search(r"\([1-9]\d* points ", said.out)
    assert inspect.main([*arguments, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["candidates"] == 100
    assert said.out.startswith(document["name"])
    assert f"{100 * document['feasible_share']:.1f} % feasible" in said.out


def test_bounds_that_bind_are_named() -> None:
    bound = BindingBound("waypoint 2, yaw", "upper", 0.4, 3)
    for optimum, words in (
        (Optimum(5, (bound,)), "upper bound of waypoint 2, yaw, 0.4: 3 of 5"),
        (Optimum(5, ()), "none binds"),
        (Optimum(0, (), "its start is infeasible"), "not known: its start is infeasible"),
    ):
        assert words in "\n".join(inspection._optimum_lines(optimum))


PROBLEM = Path("studies/problems/past-a-post.toml")


def test_what_is_in_the_way_is_told_and_nothing_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The box stands in the post."""
    data = tomllib.loads(PROBLEM.read_text(encoding="utf-8"))
    data["task"]["goal"] = [0.05, 0.0, 0.35, 0.0, 0.0, 0.0]
    path = tmp_path / "cell.toml"
    path.write_text(completed("", data, {}), encoding="utf-8")
    assert propose.main([str(path), "--quiet"]) == BAD_INPUT
    told = capsys.readouterr()
    assert re.search("payload .*post .*goal", told.err)
    assert told.out == ""
    assert [entry.name for entry in tmp_path.iterdir()] == ["cell.toml"]


@pytest.mark.slow
def test_pads_go_where_the_carry_that_was_found_costs_less(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "cell.toml"
    given = [str(PROBLEM), "--output", str(file), "--quiet", "--grips=-0.03:0.02,-0.02:0.02"]
    assert propose.main(given) == 0
    first, last = capsys.readouterr().out.splitlines()
    assert "certified" in first
    before, after = (float(part.split(" N s")[0].split()[-1]) for part in last.split("in place of"))
    assert before <= after, "the product was larger where the pads were"
    cell = Cell.load(file)
    assert cell.evaluator.certified(cell.evaluate(cell.initial)).feasible.all()
    one, two = (contact.T_box_pad[:3, 3] for contact in cell.workcell.contacts)
    np.testing.assert_allclose(one[[0, 2]], two[[0, 2]], atol=1e-9)
    assert -0.03 <= one[2] <= 0.02
    assert abs(one[0]) <= 0.02


@pytest.mark.parametrize("ranges", ["0.02:0.01", "0.01", "0:1,0:1,0:1", "a:b"])
def test_wrong_ranges_are_refused(ranges: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        propose.main([str(PROBLEM), f"--grips={ranges}"])
    assert "--grips" in capsys.readouterr().err


SHELF = """<sdf version='1.9'><model name='shelf'><static>true</static><link name='board'>
<collision name='top'><pose>0 0 3 0 0 0</pose>
<geometry><box><size>1 0.3 0.02</size></box></geometry></collision>
</link></model></sdf>"""
BOARD = {"name": "shelf board top", "kind": "box", "size": [1.0, 0.3, 0.02], "xyz": [0.0, 0.0, 3.0]}


@pytest.fixture
def shelf(tmp_path: Path) -> Path:
    path = tmp_path / "shelf.sdf"
    path.write_text(SHELF, encoding="utf-8")
    return path


def test_bodies_are_printed(shelf: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert scene.main([str(shelf)]) == 0
    assert tomllib.loads(capsys.readouterr().out) == {"environment": [BOARD]}


def test_bodies_are_added_to_a_cell_that_loads(
    shelf: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Or to a file without any; every line of it stays, what is there is not added again."""
    before = standing_text(TRANSFER)
    path = shelf.with_name("cell.toml")
    path.write_text(before, encoding="utf-8")
    assert scene.main([str(shelf), "--into", str(path)]) == 0
    after = path.read_text(encoding="utf-8")
    added = after.splitlines()
    for line in before.splitlines():
        added.remove(line)
    assert tomllib.loads("\n".join(added)) == {"environment": [BOARD]}
    assert load(path).environment[-1].name == "shelf board top"
    capsys.readouterr()
    assert scene.main([str(shelf), "--into", str(path)]) == BAD_INPUT
    assert "'shelf board top'" in capsys.readouterr().err
    assert path.read_text(encoding="utf-8") == after
    path.write_text('name = "a"  # of mine\n', encoding="utf-8")
    assert scene.main([str(shelf), "--into", str(path)]) == 0
    assert path.read_text(encoding="utf-8").startswith('name = "a"  # of mine\n\n[[environment]]\n')


def test_what_is_left_out_is_told_by_the_code(
    shelf: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shelf.write_text(SHELF.replace("<box><size>1 0.3 0.02</size></box>", "<heightmap/>"))
    assert scene.main([str(shelf)]) == 1
    told = capsys.readouterr()
    assert told.out == ""
    assert "shelf board top: " in told.err


@pytest.mark.parametrize(
    ("cell", "code"),
    [
        (None, "unreadable"),
        ("name = ", "not-toml"),
        ("environment = []\n", "not-completable"),
        ("environment = 3\n", "not-completable"),
    ],
)
def test_a_file_that_takes_none_is_left_alone(
    shelf: Path, cell: str | None, code: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = shelf.with_name("cell.toml")
    if cell is not None:
        path.write_text(cell, encoding="utf-8")
    with ended_by(code):
        assert scene.main([str(shelf), "--into", str(path)]) == BAD_INPUT
    told = capsys.readouterr().err
    assert len(told.splitlines()) == 1
    assert (path.read_text() if path.exists() else None) == cell


def test_meshes_of_the_scene_become_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    corners = "[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]"
    faces = "[[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]"
    path = tmp_path / "scene.yaml"
    path.write_text(
        "world: {collision_objects: [{id: a/b, meshes: "
        f"[{{vertices: {corners}, triangles: {faces}}}]}}]}}"
    )
    assert scene.main([str(path)]) == BAD_INPUT
    assert "--into" in capsys.readouterr().err
    cell = tmp_path / "cell.toml"
    cell.write_text(standing_text(TRANSFER))
    assert scene.main([str(path), "--into", str(cell)]) == 0
    shape = load(cell).environment[-1].shape
    assert isinstance(shape, Mesh)
    assert shape.path == tmp_path / "cell-meshes" / "1-a-b.stl"
