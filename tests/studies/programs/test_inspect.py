"""`python -m studies.inspect`, and what the second cell promises."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from hybrid_opt.cell import Cell
from hybrid_opt.display.scene import cell_solids
from hybrid_opt.evaluate.evaluation import REASONS, CandidateEvaluator
from hybrid_opt.evaluate.explanation import explain
from hybrid_opt.indicators.metrics import BindingBound
from studies.inspect import main
from studies.programs import inspection
from studies.programs.inspection import (
    Optimum,
    inspected,
    show,
)
from studies.report.pictures_cell import meeting_place
from symbolic.read.cell import load
from symbolic.records import Workcell
from symbolic.records.task import straight_line
from tests.studies.conftest import TRANSFER
from tests.symbolic.cells import RACK


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
    return find(transfer, 1500, 7, folder, view=folder / "new" / "view.html")


def test_the_second_cell_is_worth_searching(found: Inspection) -> None:
    assert found.initial.feasible
    assert not found.straight_line.feasible
    assert 0.02 <= found.feasible_share <= 0.20


def test_the_second_cell_is_of_another_kind(transfer: Workcell) -> None:
    rack = load(RACK)
    assert transfer.task.time_law != rack.task.time_law
    assert transfer.task.allowed_contacts
    assert any(waypoint.is_fixed for waypoint in transfer.task.waypoints[1:-1])
    assert np.any(transfer.payload.centre_of_mass)
    kinds = {type(body.shape).__name__ for body in transfer.environment}
    assert kinds == {"Box", "Cylinder", "Sphere"}
    assert transfer.contacts[0].friction < rack.contacts[0].friction


def test_counts_agree_with_the_evaluator(found: Inspection, transfer: Workcell) -> None:
    evaluator = CandidateEvaluator(transfer)
    x = np.random.default_rng(7).uniform(evaluator.lower, evaluator.upper, (500, evaluator.n_var))
    again = find(transfer, 500, 7)
    verdicts = evaluator.evaluate(x)
    assert again.feasible_share == pytest.approx(verdicts.feasible.mean())
    for reason, count in again.infeasible_by_reason.items():
        assert count == (verdicts.reason == REASONS.index(reason)).sum()
    total = sum(found.infeasible_by_reason.values()) + round(1500 * found.feasible_share)
    assert total == 1500


def test_the_static_bound_is_the_closed_form(found: Inspection) -> None:
    # m g / (2 mu), and (m g / 2) sqrt(1 + 1 / mu^2) at the reference force of 117.68 N.
    force = 8.0 * 9.81 / (2.0 * 0.8)
    assert found.static_normal_force == pytest.approx((force, force), rel=1e-12)
    limit = 117.68 / (9.81 / 2.0 * np.sqrt(1.0 + 1.0 / 0.8**2))
    assert found.static_payload_limit == pytest.approx(limit, rel=1e-12)


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
    assert "Transfer over a wall" in page
    assert '<div id="note"></div>' in page
    assert '"begin":0.0' in page
    assert f"View: {found.view} (open it in a browser)" in found.lines


def test_the_view_of_a_carry_that_fails_begins_there(
    transfer: Workcell, found: Inspection, tmp_path: Path
) -> None:
    cell = Cell(transfer)
    (why,) = explain(cell.evaluator, cell.evaluate(straight_line(transfer.task)))
    assert str(why) == found.explained["straight_line"]
    carry = cell.carry(straight_line(transfer.task))
    page = Path(show(carry, why, tmp_path / "view.html")).read_text("utf-8")
    assert f'<div id="note">{why}</div>' in page
    assert f'"begin":{float(carry.time[why.sample])!r}' in page
    assert page.count('"group":"marked"') == 2


def test_bodies_meet_where_the_picture_looks(transfer: Workcell) -> None:
    cell = Cell(transfer)
    (why,) = explain(cell.evaluator, cell.evaluate(straight_line(transfer.task)))
    assert why.pair is not None
    carry, geometry = cell.carry(straight_line(transfer.task)), cell.geometry
    at = carry.pose[why.sample], carry.q[why.sample]
    place = meeting_place(geometry, cell_solids(geometry), why.pair, *at)
    # The wall, that the payload meets, is 40 mm thick, 0.5 m wide and 0.87 m high.
    assert why.pair == ("payload", "wall")
    assert np.all(np.abs(place - [0.0, 0.0, 0.435]) < [0.021, 0.26, 0.44])
    assert np.all(np.abs(place - at[0][:3]) < [0.2, 0.2, 0.2])


def test_the_straight_line_is_straight(transfer: Workcell) -> None:
    rack = load(RACK)
    for workcell in (transfer, rack):
        start, goal = workcell.task.waypoints[0].lower, workcell.task.waypoints[-1].lower
        rows = straight_line(workcell.task).reshape(-1, 6)
        fixed = [w.lower for w in workcell.task.waypoints[1:-1] if w.is_fixed]
        corners = [start, *fixed, goal]
        for row in rows:
            gaps = [
                np.linalg.norm(row - a) + np.linalg.norm(b - row) - np.linalg.norm(b - a)
                for a, b in pairwise(corners)
            ]
            assert min(gaps) == pytest.approx(0.0, abs=1e-12)


def test_tells_which_bounds_bind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inspection, "POLISH_ATTEMPTS", 1)
    found = find(load(TRANSFER), 10, 1, polish=True)
    assert found.optimum.solutions >= 1
    assert found.optimum.problem == ""
    assert "points of a short polish)" in "\n".join(found.lines)
    bound = BindingBound("waypoint 2, yaw", "upper", 0.4, 3)
    for optimum, words in (
        (Optimum(5, (bound,)), "upper bound of waypoint 2, yaw, 0.4: 3 of 5"),
        (Optimum(5, ()), "none binds"),
        (Optimum(0, (), "its start is infeasible"), "not known: its start is infeasible"),
    ):
        assert words in "\n".join(inspection._optimum_lines(optimum))


def test_verdicts_are_told_before_what_takes_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    def later(*given: object, **more: object) -> None:
        raise AssertionError("too early")

    for name in ("_optimum", "draw", "show", "frequent"):
        monkeypatch.setattr(inspection, name, later)
    parts = inspected(load(TRANSFER), 10, 1, Path("pictures"), polish=True, view=Path("view"))
    lines: list[str] = []
    with pytest.raises(AssertionError, match="too early"):
        lines.extend(line for part in parts for line in part.lines)
    text = "\n".join(lines)
    for words in ("At rest, level", "trajectory: feasible", "Straight line: ", "% feasible"):
        assert words in text


def test_a_short_polish_tells_how_far_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(inspection, "POLISH_ATTEMPTS", 1)
    assert main([str(RACK), "--candidates", "10", "--no-pictures", "--polish"]) == 0
    said = capsys.readouterr()
    assert "short polish: 0 of 1 attempts" in said.err
    assert "points of a short polish)" in said.out


def test_prints_text_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(TRANSFER), "--candidates", "100", "--no-pictures"]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "Transfer over a wall" in text
    assert "random candidates" in text
    assert main([*arguments, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["candidates"] == 100
    assert f"{100 * document['feasible_share']:.1f} % feasible" in text
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--candidates", "0"], "--candidates: found '0'; allowed is a whole number 1 to"),
        (["--seed", "-1"], "--seed: found '-1'; allowed is a whole number 0 to"),
    ],
)
def test_misuse_is_one_message(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([str(TRANSFER), *arguments, "--no-pictures"])
    assert message in capsys.readouterr().err


def test_a_missing_cell_is_one_message(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["missing.toml", "--no-pictures"]) == 2
    assert "missing.toml" in capsys.readouterr().err
