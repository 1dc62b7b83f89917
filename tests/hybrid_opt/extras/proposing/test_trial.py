"""Paths of the closed chain, judged without a compiler: against Pinocchio, FCL and all samples."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import trimesh

from hybrid_opt.errors import JobError
from hybrid_opt.extras.proposing.closed_chain import ChainConfiguration, straight
from hybrid_opt.extras.proposing.draft import Draft, changes
from hybrid_opt.extras.proposing.kinematics import ArmKinematics
from hybrid_opt.extras.proposing.planner import Corridor, plan, search_subspace, straight_paths
from hybrid_opt.extras.proposing.problem import read_problem
from hybrid_opt.extras.proposing.proposal import ProposeSettings
from hybrid_opt.extras.proposing.proposal import _Search as Search
from hybrid_opt.extras.proposing.redundancy import redundancy
from hybrid_opt.extras.proposing.setup import Setup, prepare
from hybrid_opt.extras.proposing.trial import PayloadSceneChecker, Trial, grasp_blocked, judge_of
from hybrid_opt.extras.proposing.via_points import (
    fit,
    free_share,
    joint_length,
    remove_corners,
    shorten_spline,
)
from symbolic.array import Array
from symbolic.cell_model import build_cell_bodies, build_cell_model, own_pairs
from symbolic.functions import CONSTRAINTS, candidate_function, motion_function
from symbolic.geometry.pieces import support
from symbolic.path.spline import path_basis
from symbolic.read.cell import load
from symbolic.records import Body, Box, Handling
from symbolic.records.poses import pose_matrix
from tests.hybrid_opt.collision.test_checker import collision_mask
from tests.hybrid_opt.extras.proposing.problems import BAXTER
from tests.hybrid_opt.extras.proposing.test_proposal import rack_problem
from tests.hybrid_opt.job.jobs import rack, rack_jobs, rack_timing
from tests.symbolic.geometry.collision_cells import placed_pieces
from tests.symbolic.read.samples import RACK

POST = Path("studies/problems/past-a-post.toml")


def test_motion_alone_is_that_of_the_candidate() -> None:
    workcell = load(RACK.with_name("drum.toml"))
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


def box_among(more: str, folder: Path, before: str | None = None) -> PayloadSceneChecker:
    """The box among what stands in the problem with a post, up to a word where one is given, and
    more."""
    text = POST.read_text(encoding="utf-8")
    path = folder / "problem.toml"
    path.write_text(text[: None if before is None else text.index(before)] + more)
    return PayloadSceneChecker(read_problem(path).workcell())


def way_by(y: float = 0.0, z: float = 0.0, height: float = 0.35) -> Array:
    """Box poses from -x to x that bow out in the middle by so much [m]."""
    way = np.zeros((len(WAY), 6))
    way[:, 0], way[:, 1], way[:, 2] = WAY, y * BOW, height + z * BOW
    return way


@pytest.mark.parametrize(
    ("y", "z", "forth", "back"),
    [
        (1.0, 0.0, "left of post", "right of post"),
        (-1.0, 0.0, "right of post", "left of post"),
        (0.3, 1.0, "over post", "over post"),
    ],
)
def test_a_path_says_on_which_side_it_passes_what_is_in_the_way(
    y: float, z: float, forth: str, back: str, tmp_path: Path
) -> None:
    """A post from 0 to 0.6 m, a box that would meet it; left and right change with the way."""
    box, path = box_among("", tmp_path), way_by(y, z)
    assert box.sides_passed(path) == (forth,)
    assert box.sides_passed(path[::-1]) == (back,)
    path[:, 2] += 0.5
    assert box.sides_passed(path) == (), "the straight motion is free there"


@pytest.mark.parametrize(
    ("aside", "told"),
    [(1.0, "between post and second"), (2.6, "left of post"), (-1.0, "right of post")],
)
def test_a_path_between_two_bodies_is_told(aside: float, told: str, tmp_path: Path) -> None:
    """The second post 0.8 m to the left of the first, which alone is in the way."""
    second = """
[[environment]]
name = "second"
kind = "cylinder"
radius = 0.06
length = 0.60
xyz = [0.0, 0.8, 0.3]
"""
    box, way = box_among(second, tmp_path), way_by(0.8 * aside)
    assert box.sides_passed(way) == (told,)
    way[1:-1, 2] += 0.5  # above both
    assert not box.sides_passed(way)[0].startswith("between")


def test_a_path_through_a_frame_is_told(tmp_path: Path) -> None:
    """An opening of 1 m by 0.7 m in one body, whose lower bar is in the straight way."""
    bars = [((0.1, 1.6, 0.3), (0.0, 0.0, 0.25)), ((0.1, 1.6, 0.3), (0.0, 0.0, 1.25))]
    bars += [((0.1, 0.3, 1.3), (0.0, side * 0.65, 0.75)) for side in (-1.0, 1.0)]
    parts = [trimesh.creation.box(size).apply_translation(at) for size, at in bars]
    frame_mesh = trimesh.util.concatenate(parts)
    (tmp_path / "frame.stl").write_bytes(trimesh.exchange.stl.export_stl(frame_mesh))
    frame = '[[environment]]\nname = "frame"\nkind = "mesh"\npath = "frame.stl"\n'
    box = box_among(frame, tmp_path, before="[[environment]]")
    assert box.sides_passed(way_by(z=0.8)) == ("through frame",)
    assert box.sides_passed(way_by(z=3.4)) == ("over frame",)


def test_what_the_box_stands_on_is_not_passed(tmp_path: Path) -> None:
    assert box_among("", tmp_path).sides_passed(way_by(1.0, height=0.115)) == ("left of post",)


def test_the_torso_counts_for_both_arms_of_a_machine(tmp_path: Path) -> None:
    """Baxter's forearms folded onto its chest; the torso is listed with the left arm."""
    path = tmp_path / "baxter.toml"
    path.write_text(BAXTER, encoding="utf-8")
    problem = read_problem(path)
    given = redundancy(problem, problem.workcell({}))
    judge = judge_of(build_cell_bodies(problem.workcell(given)))
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
        ({"lift_height": 0.0, "set_down_height": 0.0}, ""),
        ({"set_down_height": 0.02}, "set down: .*payload.*liner"),
        ({"lift_height": 0.03}, "lift: .*payload.*middle board"),
        ({"stand_off": 1.2}, "approach: "),
        ({"lift_height": 0.5}, "lift: .*payload"),
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
    assert re.match(told, found)
    with pytest.raises(JobError):
        rack_jobs().plan(rack_timing(), handling=chosen)


@pytest.mark.parametrize(
    ("stated", "blocked", "stand_off"),
    [({}, "", 0.03), ({"stand_off": 0.05}, "approach: left/link_5 meets peg", None)],
)
def test_pads_stand_off_less_where_something_is_behind_unless_the_file_says_how_far(
    stated: dict[str, float], blocked: str, stand_off: float | None, trial: Trial, tmp_path: Path
) -> None:
    """A peg 35 mm behind the left wrist at the start."""
    cell, outputs = trial.workcell, trial.evaluator.outputs(trial.initial[None])
    at = (outputs[name][0, 0] for name in ("pose", "q_1", "q_2"))
    link, back = rack().geometry.index("left/link_5"), np.array([0.0, 1.0, 0.0])
    piece = max(placed_pieces(rack().geometry, *at)[link], key=lambda p: support(p, back)[0])
    place = piece.centre + (float(support(piece, back)[0]) - piece.centre[1] + 0.045) * back
    peg = Body("peg", Box(np.full(3, 0.02)), pose_matrix(place, np.zeros(3)))
    cell = replace(cell, environment=(*cell.environment, peg))
    problem = read_problem(rack_problem(tmp_path, {"handling": stated}))
    search = Search(problem, np.random.default_rng(1), ProposeSettings(), print, lambda *_: None)
    assert search._pads_way(Trial(cell, trial.model.start)) == (blocked, stand_off)
    draft = Draft(cell, (0.0, 0.0), (-1, -1), np.zeros((3, 6)), stand_off=stand_off)
    assert ("handling" in changes(problem, draft)) == (stand_off is not None)


def test_pads_that_have_no_jobs_are_not_looked_at(
    trial: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = trial.workcell.contacts[0]
    same = replace(trial.workcell, contacts=(first, first))
    assert not same.has_facing_pads
    monkeypatch.setattr(trial, "workcell", same)
    assert grasp_blocked(trial, same.handling) == ""


NO_LIMITS = np.empty((0, 2))
SPINS = np.array([0.0, np.pi / 2.0])


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    problem = read_problem(rack_problem(tmp_path_factory.mktemp("rack")))
    return prepare(problem, {}, SPINS, np.random.default_rng(3))


def found_in(setup: Setup, seed: int, out_of_time: bool = False) -> list[ChainConfiguration] | None:
    pair = setup.pairs[0]
    ends = pair.start.extended, pair.goal.extended
    room = search_subspace(*ends, Corridor(0.0, 0.15, 0.8), NO_LIMITS)
    return plan(
        pair.chain,
        pair.retreats,
        room,
        most=100_000,
        out_of_time=lambda: out_of_time,
        rng=np.random.default_rng(seed),
    )


def planned(setup: Setup, seed: int) -> list[ChainConfiguration]:
    found = found_in(setup, seed)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def first(shelf: Setup) -> list[ChainConfiguration]:
    return planned(shelf, 1)


def shortened_path(setup: Setup, corners: list[ChainConfiguration]) -> list[ChainConfiguration]:
    """Places along corners without needless ones; FCL without screening finds them free."""
    pair = setup.pairs[0]
    path = remove_corners(pair.chain, corners, np.random.default_rng(0))
    np.testing.assert_array_equal(path[0].extended, pair.start.extended)
    np.testing.assert_allclose(path[-1].extended, pair.goal.extended, atol=1e-12)
    poses = np.array([place.extended for place in path])
    q_1, q_2 = (np.array([place.q[arm] for place in path]) for arm in (0, 1))
    assert not collision_mask(pair.chain.judge.checker, poses, q_1, q_2).any()
    return path


def test_a_path_beyond_reach_is_followed_as_far_as_both_arms_hold_the_box(shelf: Setup) -> None:
    pair = shelf.pairs[0]
    chain, begin = pair.chain, pair.start
    path = straight(begin.extended, begin.extended + np.array([0.0, 0.0, 3.0, 0.0, 0.0, 0.0]))
    before = chain.refused.copy()
    found, whole = chain.followed(path, begin.q)
    assert not whole
    assert 0 < len(found) < len(path)
    ((reason, count),) = (chain.refused - before).items()
    assert count == 1
    assert any(robot.name in reason for robot in shelf.workcell.robots)
    # Newton's method from there, many poses side by side, ends in the same postures.
    near = tuple(np.array([place.q[arm] for place in found]) for arm in (0, 1))
    q, closed = chain.close_many(path[: len(found)], (near[0] + 1e-3, near[1] - 1e-3))
    assert closed.all()
    for arm in (0, 1):
        np.testing.assert_allclose(q[arm], near[arm], atol=1e-5)
    assert chain.followed(path[: len(found)], begin.q)[1]


def test_paths_hold_the_box_with_both_arms_and_are_free(
    shelf: Setup, first: list[ChainConfiguration]
) -> None:
    pair, path = shelf.pairs[0], shortened_path(shelf, first)
    poses = np.array([place.extended for place in path])
    for arm in (0, 1):
        kinematics = ArmKinematics(shelf.workcell, arm)
        q = np.array([place.q[arm] for place in path])
        T_box_joint = kinematics.held(pair.holds[arm].spin)
        T, _ = kinematics.pose_and_jacobian(q)
        wanted = np.array([pose_matrix(pose[:3], pose[3:]) @ T_box_joint for pose in poses])
        np.testing.assert_allclose(T, wanted, atol=1e-5)
        assert np.abs(np.diff(q, axis=0)).max() < 0.5
        assert np.all(q >= shelf.workcell.robots[arm].position_lower)
        assert np.all(q <= shelf.workcell.robots[arm].position_upper)


def test_many_motions_are_followed_as_one_after_another(
    shelf: Setup, first: list[ChainConfiguration]
) -> None:
    """Motions of 0.1 m or rad in all directions, from places on a path."""
    pair, rng = shelf.pairs[0], np.random.default_rng(2)
    begins = 3 * shortened_path(shelf, first)
    away = rng.normal(size=(len(begins), len(pair.start.extended)))
    away *= 0.1 / np.linalg.norm(away, axis=1, keepdims=True)
    ends = np.array([begin.extended for begin in begins]) + away
    found = pair.chain.reach_many(begins, ends)
    alone = [pair.chain.reach(*both) for both in zip(begins, ends, strict=True)]
    free = [place is not None for place in alone]
    assert 20 < sum(free) < len(free) - 20
    assert [place is not None for place in found] == free
    for one, other in zip(found, alone, strict=True):
        if one is not None and other is not None:
            np.testing.assert_array_equal(one.extended, other.extended)
            np.testing.assert_allclose(np.hstack(one.q), np.hstack(other.q), atol=1e-5)


def test_straight_motions_lead_out_of_the_shelf_and_in_again(shelf: Setup) -> None:
    """Of three: away from the rack, up beside it, back."""
    pair = shelf.pairs[0]
    corners = next(straight_paths(pair.chain, pair.retreats, PayloadSceneChecker(shelf.workcell)))
    out, over = (corners[k + 1].extended - corners[k].extended for k in (0, 1))
    assert out[0] < -0.2
    assert over[2] > 0.3
    shortened_path(shelf, corners)


def test_where_no_straight_motion_is_free_none_is_made_up(shelf: Setup) -> None:
    pair = shelf.pairs[0]
    ends = pair.start, pair.goal
    alone = tuple([[end]] * len(ways) for end, ways in zip(ends, pair.retreats, strict=True))
    assert not list(
        straight_paths(pair.chain, (alone[0], alone[1]), PayloadSceneChecker(shelf.workcell))
    )


def test_shortcuts_make_the_way_of_the_joints_shorter(shelf: Setup) -> None:
    """A path that wanders to both sides, on a task that is symmetric."""
    pair = shelf.pairs[0]
    corners = next(straight_paths(pair.chain, pair.retreats, PayloadSceneChecker(shelf.workcell)))
    path = np.array([corner.extended for corner in corners])
    path = np.insert(path, 2, (path[1] + path[2]) / 2.0, axis=0)
    path[2, 1] += 0.08
    wandering = [corners[0]]
    for extended in path[1:]:
        reached = pair.chain.reach(wandering[-1], extended)
        assert reached is not None
        wandering.append(reached)
    dense = [wandering[0]]
    for corner in wandering[1:]:
        dense += pair.chain.along(dense[-1], straight(dense[-1].extended, corner.extended)[1:])
    short = remove_corners(pair.chain, wandering, np.random.default_rng(0))
    assert joint_length(short) < 0.95 * joint_length(dense)
    assert max(abs(place.extended[1]) for place in short) < 0.04


def test_few_via_points_follow_a_path_and_are_straightened(
    shelf: Setup, first: list[ChainConfiguration]
) -> None:
    """As far as the spline stays free."""
    pair, rng = shelf.pairs[0], np.random.default_rng(0)
    path = remove_corners(pair.chain, first, rng)
    straight = np.array([pair.start.extended, pair.goal.extended])
    assert free_share(pair.chain, pair.start, straight) < 1.0
    fits = (fit(pair.chain, path, count, rng) for count in (1, 2, 3, 4, 5))
    via = next(each for each in fits if each is not None)
    whole = np.vstack([straight[:1], via, straight[1:]])
    assert free_share(pair.chain, pair.start, whole) == 1.0
    short = shorten_spline(pair.chain, pair.start, whole, rng)
    np.testing.assert_array_equal(short[[0, -1]], whole[[0, -1]])
    assert free_share(pair.chain, pair.start, short) == 1.0
    lengths = []
    for waypoints in (whole, short):
        basis = path_basis(len(waypoints), np.linspace(0.0, 1.0, 200)).position
        lengths.append(joint_length(list(pair.chain.along(pair.start, basis @ waypoints))))
    assert lengths[1] < 0.97 * lengths[0]


def test_the_same_seed_gives_the_same_path(shelf: Setup, first: list[ChainConfiguration]) -> None:
    for a, b in zip(first, planned(shelf, 1), strict=True):
        np.testing.assert_array_equal(a.extended, b.extended)


def test_what_may_be_spent_on_a_path_is_kept(shelf: Setup) -> None:
    assert found_in(shelf, 1, out_of_time=True) is None


def test_a_tilted_path_may_turn_and_a_level_one_may_not() -> None:
    start, goal = np.zeros(6), np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.3])
    level = search_subspace(start, goal, Corridor(0.0, 0.1, 1.0), NO_LIMITS)
    assert level.directions.shape == (6, 4)
    np.testing.assert_allclose(level.extended(level.coordinates(goal)), goal, atol=1e-12)
    assert np.all(level.coordinates(goal) <= level.upper)
    tilted = search_subspace(start, goal, Corridor(0.2, 0.1, 1.0), NO_LIMITS)
    assert tilted.directions.shape == (6, 6)
    turned = np.array([0.0, 0.0, 0.0, 0.15, -0.15, 0.0])
    inside = tilted.coordinates(turned)
    assert np.all((inside >= tilted.lower) & (inside <= tilted.upper))
    np.testing.assert_allclose(tilted.extended(inside), turned, atol=1e-12)


def test_redundant_joints_stray_farther_than_the_box_and_not_beyond_their_limits() -> None:
    start, goal = np.zeros(8), np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.4, 0.0])
    room = search_subspace(
        start, goal, Corridor(0.0, 0.1, 0.2), np.array([[-0.3, 2.0], [-3.0, 3.0]])
    )
    least, most = room.extended(room.lower), room.extended(room.upper)
    np.testing.assert_allclose(least, [-0.2, -0.2, -0.2, 0, 0, 0, -0.3, -1.0], atol=1e-7)
    np.testing.assert_allclose(most, [0.7, 0.2, 0.2, 0, 0, 0, 1.4, 1.0], atol=1e-7)


def test_a_path_may_be_kept_to_one_side() -> None:
    start, goal = np.zeros(6), np.array([0.5, 0.0, 0.1, 0.0, 0.0, 0.0])
    room = search_subspace(start, goal, Corridor(0.0, 0.15, 0.8, (0, -1, 0)), NO_LIMITS)
    low, high = room.extended(room.lower), room.extended(room.upper)
    np.testing.assert_allclose(low[:3], [0.0, -0.8, 0.0], atol=1e-6)
    np.testing.assert_allclose(high[:3], [0.5, 0.0, 0.1], atol=1e-6)
