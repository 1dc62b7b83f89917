"""Verdicts without a compiler, by shortcuts; the oracle is the evaluation of all samples."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import trimesh

from hybrid_opt.errors import JobError
from hybrid_opt.proposing.problem import read_problem
from hybrid_opt.proposing.setup import redundancy
from hybrid_opt.proposing.trial import BoxAlone, Trial, grasp_blocked, judge_of
from symbolic.cell_model import build_cell_model, own_pairs
from symbolic.functions import CONSTRAINTS, candidate_function, motion_function
from symbolic.geometry.pairs import build_geometry
from symbolic.read.cell import load
from symbolic.records import Handling
from tests.hybrid_opt.job.jobs import rack, rack_jobs, rack_timing
from tests.hybrid_opt.proposing.problems import BAXTER
from tests.symbolic.read.samples import RACK

POST = Path("studies/problems/past-a-post.toml")


@pytest.mark.parametrize("name", ["drum", "transfer"])
def test_motion_alone_is_that_of_the_candidate(name: str) -> None:
    workcell = load(RACK.with_name(f"{name}.toml"))
    model = build_cell_model(workcell)
    whole, alone = candidate_function(model), motion_function(model)
    x = np.random.default_rng(3).uniform(workcell.task.lower, workcell.task.upper)
    wanted = dict(zip(whole.name_out(), whole(ca.DM(x)), strict=True))
    found = dict(zip(alone.name_out(), alone(ca.DM(x)), strict=True))
    for key in ("time", "pose", "q_1", "q_2"):
        np.testing.assert_array_equal(np.array(found[key]), np.array(wanted[key]))
    arms = [k for k, name in enumerate(CONSTRAINTS) if name.startswith(("reach", "joint", "sing"))]
    violation = np.array(found["violation"]).ravel()
    np.testing.assert_array_equal(violation[arms], np.array(wanted["violation"]).ravel()[arms])
    assert not np.delete(violation, arms).any()


@pytest.mark.parametrize("name", ["drum", "rack"])
def test_verdicts_are_those_of_the_whole_evaluation(name: str) -> None:
    workcell = load(RACK.with_name(f"{name}.toml"))
    first, second = (np.array(q) for q in build_cell_model(workcell).start)
    trial = Trial(workcell, (first, second))
    task = workcell.task
    x = np.random.default_rng(4).uniform(task.lower, task.upper, (24, task.n_var))
    x[12:] = trial.initial + 0.3 * (x[12:] - trial.initial)
    expected = trial.evaluator.evaluate(x).feasible
    assert 0 < expected.sum() < len(x)
    np.testing.assert_array_equal(trial.feasible(x), expected)


WAY = np.linspace(-0.45, 0.45, 41)
BOW = 0.5 * np.cos(np.pi * WAY / 0.9)


@pytest.mark.parametrize(
    ("aside", "sides"),
    [
        ((0.0, 0.0, 0.0), ("over post",)),
        ((0.0, 1.0, 0.0), ("left of post",)),
        ((0.0, -1.0, 0.0), ("right of post",)),
        ((0.0, 0.3, 1.0), ("over post",)),
    ],
)
@pytest.mark.parametrize("forth", [True, False])
def test_a_path_says_on_which_side_it_passes_what_is_in_the_way(
    aside: tuple[float, float, float], sides: tuple[str, ...], forth: bool
) -> None:
    """A post from 0 to 0.6 m, a box that would meet it; left and right change with the way."""
    box = BoxAlone(read_problem(POST).workcell())
    path = np.zeros((len(WAY), 6))
    path[:, 0], path[:, 2] = WAY, 0.35
    path[:, :3] += BOW[:, None] * aside
    if aside == (0.0, 0.0, 0.0):
        path[10:31, 2] = 0.75
    if not forth:
        path = path[::-1]
        swapped = {"left of post": "right of post", "right of post": "left of post"}
        sides = tuple(swapped.get(side, side) for side in sides)
    assert box.passed(path) == sides
    path[:, 2] += 0.5
    assert box.passed(path) == (), "the straight motion is free there"


@pytest.mark.parametrize(
    ("aside", "told"),
    [(1.0, "between post and second"), (2.6, "left of post"), (-1.0, "right of post")],
)
def test_a_path_between_two_bodies_is_told(aside: float, told: str, tmp_path: Path) -> None:
    """The second post 0.8 m to the left of the first, which alone is in the way."""
    post = POST.read_text(encoding="utf-8")
    second = """
[[environment]]
name = "second"
kind = "cylinder"
radius = 0.06
length = 0.60
xyz = [0.0, 0.8, 0.3]
"""
    path = tmp_path / "posts.toml"
    path.write_text(post + second, encoding="utf-8")
    box = BoxAlone(read_problem(path).workcell())
    way = np.zeros((len(WAY), 6))
    way[:, 0], way[:, 1], way[:, 2] = WAY, 0.8 * aside * BOW, 0.35
    assert box.passed(way) == (told,)
    way[:, 2] += 0.5  # above both
    way[[0, -1], 2] = 0.35
    assert not box.passed(way)[0].startswith("between")


def test_a_path_through_a_frame_is_told(tmp_path: Path) -> None:
    """An opening of 1 m by 0.7 m in one body, whose lower bar is in the straight way."""
    bars = [((0.1, 1.6, 0.3), (0.0, 0.0, 0.25)), ((0.1, 1.6, 0.3), (0.0, 0.0, 1.25))]
    bars += [((0.1, 0.3, 1.3), (0.0, side * 0.65, 0.75)) for side in (-1.0, 1.0)]
    parts = [trimesh.creation.box(size).apply_translation(at) for size, at in bars]
    frame_mesh = trimesh.util.concatenate(parts)
    (tmp_path / "frame.stl").write_bytes(trimesh.exchange.stl.export_stl(frame_mesh))
    text = POST.read_text(encoding="utf-8")
    text = text[: text.index("[[environment]]")]
    frame = '[[environment]]\nname = "frame"\nkind = "mesh"\npath = "frame.stl"\n'
    path = tmp_path / "frame.toml"
    path.write_text(text + frame, encoding="utf-8")
    box = BoxAlone(read_problem(path).workcell())
    way = np.zeros((len(WAY), 6))
    way[:, 0], way[:, 2] = WAY, 0.35 + 0.8 * BOW
    assert box.passed(way) == ("through frame",)
    way[:, 2] += 2.6 * BOW
    assert box.passed(way) == ("over frame",)


def test_what_the_box_stands_on_is_not_passed(tmp_path: Path) -> None:
    text = POST.read_text(encoding="utf-8").replace("0.35, 0.0, 0.0, 0.0]", "0.115, 0.0, 0.0, 0.0]")
    path = tmp_path / "standing.toml"
    path.write_text(text, encoding="utf-8")
    box = BoxAlone(read_problem(path).workcell())
    way = np.zeros((len(WAY), 6))
    way[:, 0], way[:, 1], way[:, 2] = WAY, BOW, 0.115
    assert box.passed(way) == ("left of post",)


def test_the_torso_counts_for_both_arms_of_a_machine(tmp_path: Path) -> None:
    """Baxter's forearms folded onto its chest; the torso is listed with the left arm."""
    path = tmp_path / "baxter.toml"
    path.write_text(BAXTER, encoding="utf-8")
    problem = read_problem(path)
    given = redundancy(problem, problem.workcell({}))
    judge = judge_of(build_geometry(problem.workcell(given)))
    rng, met = np.random.default_rng(0), []
    pose = np.array([2.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    for arm in (0, 1):
        lower, upper = judge.geometry.arms[arm].lower, judge.geometry.arms[arm].upper
        pairs = set()
        for q in rng.uniform(lower, upper, (60, len(lower))):
            q_1, q_2 = (q, np.zeros(len(q))) if arm == 0 else (np.zeros(len(q)), q)
            pairs.add(judge.first_pair(pose, q_1, q_2, arm))
        named = {name for pair in pairs if pair for name in pair}
        assert not any("/right" in name for name in named) or arm == 1
        met.append(named)
    for named in met:
        assert any(name.startswith("left/") and "torso" in name for name in named)
    names = judge.geometry.pair_names
    for arm, own in enumerate(("left/", "right/")):
        with_torso = [names[k] for k in own_pairs(judge.geometry, arm) if "left/torso" in names[k]]
        moving = {name for pair in with_torso for name in pair} - {"left/torso"}
        assert moving
        assert all(name.startswith(own) for name in moving)


@pytest.fixture(scope="module")
def trial() -> Trial:
    begin = rack().carry(rack().initial)
    return Trial(load(RACK), (begin.arms[0].q[0], begin.arms[1].q[0]))


@pytest.mark.parametrize(
    ("handling", "told"),
    [
        ({}, ""),
        ({"lift_height": 0.0, "set_down_height": 0.0}, ""),
        ({"set_down_height": 0.02}, "set down: payload meets liner"),
        ({"lift_height": 0.03}, "lift: payload meets middle board"),
        ({"stand_off": 1.2}, "approach: an arm "),
        ({"lift_height": 0.5}, "lift: payload meets"),
    ],
)
def test_what_blocks_is_what_refuses_the_job(
    handling: dict[str, float], told: str, trial: Trial
) -> None:
    chosen = Handling(**handling)
    found = grasp_blocked(trial, chosen)
    if not told:
        assert found == ""
        rack_jobs().plan(rack_timing(), handling=chosen)
        return
    assert found.startswith(told)
    with pytest.raises(JobError):
        rack_jobs().plan(rack_timing(), handling=chosen)


def test_pads_that_have_no_jobs_are_not_looked_at(
    trial: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = trial.workcell.contacts[0]
    same = replace(trial.workcell, contacts=(first, first))
    assert not same.has_facing_pads
    monkeypatch.setattr(trial, "workcell", same)
    assert grasp_blocked(trial, same.handling) == ""
