"""Paths of the closed chain in the rack; the oracles are Pinocchio and FCL without screening."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.proposing.holding import ArmKinematics, box_to_last_joint, spun
from hybrid_opt.proposing.planner import Place, Stray, freedom, plan, straight, straight_paths
from hybrid_opt.proposing.problem import read_problem
from hybrid_opt.proposing.setup import Setup, prepare
from hybrid_opt.proposing.trial import BoxAlone
from hybrid_opt.proposing.via_points import fit, free_share, joint_length, shortened, straightened
from symbolic.path.spline import path_basis
from symbolic.records.poses import pose_matrix
from tests.hybrid_opt.collision.queries import collision_mask
from tests.hybrid_opt.proposing.test_proposal import rack_problem

NO_LIMITS = np.empty((0, 2))
SPINS = np.array([0.0, np.pi / 2.0])


@pytest.fixture(scope="module")
def rack(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    problem = read_problem(rack_problem(tmp_path_factory.mktemp("rack")))
    return prepare(problem, {}, SPINS, np.random.default_rng(3))


def planned(setup: Setup, seed: int) -> list[Place]:
    pair = setup.pairs[0]
    ends = pair.start.extended, pair.goal.extended
    room = freedom(*ends, Stray(0.0, 0.15, 0.8), NO_LIMITS)
    found = plan(pair.chain, pair.retreats, room, most=20_000, out_of_time=lambda: False, seed=seed)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def first(rack: Setup) -> list[Place]:
    return planned(rack, 1)


def test_paths_hold_the_box_with_both_arms_and_are_free(rack: Setup, first: list[Place]) -> None:
    pair = rack.pairs[0]
    path = shortened(pair.chain, first, np.random.default_rng(0))
    np.testing.assert_array_equal(path[0].extended, pair.start.extended)
    np.testing.assert_allclose(path[-1].extended, pair.goal.extended, atol=1e-12)
    poses = np.array([place.extended for place in path])
    for arm in (0, 1):
        kinematics = ArmKinematics.of(rack.workcell, arm, ())
        q = np.array([place.q[arm] for place in path])
        contact = spun(rack.workcell.contacts[arm], pair.holds[arm].spin)
        T_box_joint = box_to_last_joint(rack.workcell, kinematics.geometry, contact, arm)
        _, T = kinematics.chain(q)
        wanted = np.array([pose_matrix(pose[:3], pose[3:]) @ T_box_joint for pose in poses])
        np.testing.assert_allclose(T, wanted, atol=1e-5)
        assert np.abs(np.diff(q, axis=0)).max() < 0.5
        assert np.all(q >= rack.workcell.robots[arm].position_lower)
        assert np.all(q <= rack.workcell.robots[arm].position_upper)
    q_1, q_2 = (np.array([place.q[arm] for place in path]) for arm in (0, 1))
    assert not collision_mask(pair.chain.judge.checker, poses, q_1, q_2).any()


def test_straight_motions_lead_out_of_the_shelf_and_in_again(rack: Setup) -> None:
    """Of three: away from the rack, up beside it, back; collisions are FCL's without screening."""
    pair = rack.pairs[0]
    corners = next(straight_paths(pair.chain, pair.retreats, BoxAlone(rack.workcell)))
    out, over = (corners[k + 1].extended - corners[k].extended for k in (0, 1))
    assert out[0] < -0.2
    assert over[2] > 0.3
    np.testing.assert_allclose(corners[-1].extended, pair.goal.extended)
    path = shortened(pair.chain, corners, np.random.default_rng(0))
    poses = np.array([place.extended for place in path])
    q_1, q_2 = (np.array([place.q[arm] for place in path]) for arm in (0, 1))
    assert not collision_mask(pair.chain.judge.checker, poses, q_1, q_2).any()


def test_where_no_straight_motion_is_free_none_is_made_up(rack: Setup) -> None:
    pair = rack.pairs[0]
    ends = pair.start, pair.goal
    alone = tuple([[end]] * len(ways) for end, ways in zip(ends, pair.retreats, strict=True))
    assert not list(straight_paths(pair.chain, (alone[0], alone[1]), BoxAlone(rack.workcell)))


def test_shortcuts_make_the_way_of_the_joints_shorter(rack: Setup) -> None:
    """A path that wanders to both sides, on a task that is symmetric."""
    pair = rack.pairs[0]
    corners = next(straight_paths(pair.chain, pair.retreats, BoxAlone(rack.workcell)))
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
    short = shortened(pair.chain, wandering, np.random.default_rng(0))
    assert joint_length(short) < 0.95 * joint_length(dense)
    assert max(abs(place.extended[1]) for place in short) < 0.04


def test_a_spline_is_straightened_as_far_as_it_stays_free(rack: Setup, first: list[Place]) -> None:
    pair, rng = rack.pairs[0], np.random.default_rng(0)
    path = shortened(pair.chain, first, rng)
    found = [fit(pair.chain, path, count, rng) for count in (1, 2, 3, 4, 5)]
    via = next(each for each in found if each is not None)
    whole = np.vstack([pair.start.extended, via, pair.goal.extended])
    short = straightened(pair.chain, pair.start, whole, rng)
    np.testing.assert_array_equal(short[[0, -1]], whole[[0, -1]])
    assert free_share(pair.chain, pair.start, short) == 1.0
    lengths = []
    for waypoints in (whole, short):
        basis = path_basis(len(waypoints), np.linspace(0.0, 1.0, 200)).position
        lengths.append(joint_length(list(pair.chain.along(pair.start, basis @ waypoints))))
    assert lengths[1] < 0.97 * lengths[0]


def test_the_same_seed_gives_the_same_path(rack: Setup, first: list[Place]) -> None:
    again, other = (planned(rack, seed) for seed in (1, 2))
    assert len(first) == len(again)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.extended, b.extended)
    assert len(other) != len(first) or any(
        np.any(a.extended != b.extended) for a, b in zip(first, other, strict=True)
    )


def test_few_via_points_follow_a_path(rack: Setup, first: list[Place]) -> None:
    pair, rng = rack.pairs[0], np.random.default_rng(0)
    path = shortened(pair.chain, first, rng)
    straight = np.array([pair.start.extended, pair.goal.extended])
    assert free_share(pair.chain, pair.start, straight) < 1.0
    found = [fit(pair.chain, path, count, rng) for count in (1, 2, 3, 4, 5)]
    via = next(each for each in found if each is not None)
    whole = np.vstack([straight[:1], via, straight[1:]])
    assert free_share(pair.chain, pair.start, whole) == 1.0


def test_what_may_be_spent_on_a_path_is_kept(rack: Setup) -> None:
    pair = rack.pairs[0]
    ends = pair.start.extended, pair.goal.extended
    room = freedom(*ends, Stray(0.0, 0.15, 0.8), NO_LIMITS)
    out = pair.retreats
    assert plan(pair.chain, out, room, most=10**9, out_of_time=lambda: True, seed=1) is None


def test_a_tilted_path_may_turn_and_a_level_one_may_not() -> None:
    start, goal = np.zeros(6), np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.3])
    level = freedom(start, goal, Stray(0.0, 0.1, 1.0), NO_LIMITS)
    assert level.directions.shape == (6, 4)
    np.testing.assert_allclose(level.extended(level.coordinates(goal)), goal, atol=1e-12)
    assert np.all(level.coordinates(goal) <= level.upper)
    tilted = freedom(start, goal, Stray(0.2, 0.1, 1.0), NO_LIMITS)
    assert tilted.directions.shape == (6, 6)
    turned = np.array([0.0, 0.0, 0.0, 0.15, -0.15, 0.0])
    inside = tilted.coordinates(turned)
    assert np.all((inside >= tilted.lower) & (inside <= tilted.upper))
    np.testing.assert_allclose(tilted.extended(inside), turned, atol=1e-12)


def test_redundant_joints_stray_farther_than_the_box_and_not_beyond_their_limits() -> None:
    start, goal = np.zeros(8), np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.4, 0.0])
    room = freedom(start, goal, Stray(0.0, 0.1, 0.2), np.array([[-0.3, 2.0], [-3.0, 3.0]]))
    least, most = room.extended(room.lower), room.extended(room.upper)
    np.testing.assert_allclose(least, [-0.2, -0.2, -0.2, 0, 0, 0, -0.3, -1.0], atol=1e-7)
    np.testing.assert_allclose(most, [0.7, 0.2, 0.2, 0, 0, 0, 1.4, 1.0], atol=1e-7)


def test_a_path_may_be_kept_to_one_side() -> None:
    start, goal = np.zeros(6), np.array([0.5, 0.0, 0.1, 0.0, 0.0, 0.0])
    room = freedom(start, goal, Stray(0.0, 0.15, 0.8, (0, -1, 0)), NO_LIMITS)
    low, high = room.extended(room.lower), room.extended(room.upper)
    np.testing.assert_allclose(low[:3], [0.0, -0.8, 0.0], atol=1e-6)
    np.testing.assert_allclose(high[:3], [0.5, 0.0, 0.1], atol=1e-6)
