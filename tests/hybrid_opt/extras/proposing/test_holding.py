"""Ways to hold the box and to reach it, and where a machine may stand: Pinocchio and FCL judge."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import hybrid_opt as ho
from hybrid_opt.errors import JobError, ProposalError
from hybrid_opt.extras.proposing.bases import (
    ASIDE,
    LIFT_HEIGHT,
    POSES,
    BaseScorer,
    base_choices,
    draft_of,
    free_detours,
    machine_bases,
    shared_room,
)
from hybrid_opt.extras.proposing.common import machine_holds
from hybrid_opt.extras.proposing.holding import HoldQuery, clear_spins, find_holds, possible_spins
from hybrid_opt.extras.proposing.kinematics import ArmKinematics, rotate_about_normal
from hybrid_opt.extras.proposing.problem import Problem, read_problem
from hybrid_opt.extras.proposing.setup import Setup, prepare, reach_missing
from hybrid_opt.extras.proposing.trial import judge_of
from hybrid_opt.job.plan import job_geometry
from symbolic.array import Array
from symbolic.cell_model import build_cell_bodies
from symbolic.errors import SettingsError, WorkcellError
from symbolic.geometry.separation import coal_distance
from symbolic.read.arms import arm_model
from symbolic.read.cell import load
from symbolic.read.editing import completed, merged
from symbolic.records import Body, Box, Contact, Workcell
from symbolic.records.poses import box_placement, pose_matrix
from symbolic.robot.branches import inverse_kinematics
from tests.hybrid_opt.extras.proposing.problems import tiago_problem
from tests.hybrid_opt.job.jobs import rack, rack_job
from tests.symbolic.cells import hand_cell
from tests.symbolic.geometry.collision_cells import placed_pieces
from tests.symbolic.read.samples import RACK
from tests.torso import Torso

POST = Path("studies/problems/past-a-post.toml")
SPINS: Array = 2.0 * np.pi * np.arange(12.0) / 12.0


@pytest.fixture(scope="module")
def rack_cell() -> Workcell:
    return load(RACK)


def test_placements_and_jacobians_are_pinocchios(rack_cell: Workcell) -> None:
    kinematics = ArmKinematics(rack_cell, 0)
    model = arm_model(rack_cell.robots[0])
    data = model.createData()
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (20, 6))
    T, J = kinematics.pose_and_jacobian(q)
    base = rack_cell.robots[0].T_world_base
    for k in range(len(q)):
        pin.computeJointJacobians(model, data, q[k])
        np.testing.assert_allclose(T[k], base @ data.oMi[6].homogeneous, atol=1e-13)
        own = pin.getJointJacobian(model, data, 6, pin.LOCAL_WORLD_ALIGNED)
        turned = np.vstack([base[:3, :3] @ own[:3], base[:3, :3] @ own[3:]])
        np.testing.assert_allclose(J[k], turned, atol=1e-13)


def test_a_sliding_joint_moves_along_its_axis_and_all_columns_are_slopes(
    rack_cell: Workcell,
) -> None:
    geometry = ArmKinematics(rack_cell, 0).geometry
    slides = replace(geometry, turning=(True, False, *geometry.turning[2:]))
    kinematics = ArmKinematics(rack_cell, 0, slides)
    q, step = np.random.default_rng(2).uniform(-1.0, 1.0, (1, 6)), 1e-6
    T, J = kinematics.pose_and_jacobian(q)
    (forth, _), (back, _) = (
        kinematics.pose_and_jacobian(q + sign * step * np.eye(6)) for sign in (1, -1)
    )
    slope = (forth - back) / (2.0 * step)
    np.testing.assert_allclose(J[0, :3], slope[:, :3, 3].T, atol=1e-9)
    turned = slope[:, :3, :3] @ T[0, :3, :3].T  # the skew matrix of the angular velocity
    np.testing.assert_allclose(J[0, 3], turned[:, 2, 1], atol=1e-9)
    np.testing.assert_allclose(J[0, 4], turned[:, 0, 2], atol=1e-9)
    np.testing.assert_allclose(J[0, 5], turned[:, 1, 0], atol=1e-9)
    far, _ = kinematics.pose_and_jacobian(q + 0.5 * np.eye(6)[1])
    np.testing.assert_allclose(far[0, :3, 3] - T[0, :3, 3], 0.5 * J[0, :3, 1], atol=1e-14)
    np.testing.assert_array_equal(far[0, :3, :3], T[0, :3, :3])


def test_arrays_of_other_lengths_are_no_postures(rack_cell: Workcell) -> None:
    kinematics = ArmKinematics(rack_cell, 0)
    with pytest.raises(ValueError, match="length"):
        kinematics.pose_and_jacobian(np.zeros((2, 5)))
    with pytest.raises(ValueError, match="length"):
        kinematics.solve(np.zeros((2, 6)), np.eye(4)[None], 1)


def test_newtons_method_comes_back_to_where_placements_are_from(rack_cell: Workcell) -> None:
    kinematics = ArmKinematics(rack_cell, 1)
    rng = np.random.default_rng(1)
    q = rng.uniform(-1.5, 1.5, (50, 6))
    T, _ = kinematics.pose_and_jacobian(q)
    found = kinematics.solve(q + rng.normal(0.0, 0.02, q.shape), T, 20, 1e-3)
    away = found.manipulability > 0.01
    assert away.sum() > 25
    np.testing.assert_allclose(found.q[away], q[away], atol=1e-5)
    np.testing.assert_allclose(kinematics.pose_and_jacobian(found.q)[0], T, atol=1e-5)


def test_following_goes_where_the_joints_came_from(rack_cell: Workcell) -> None:
    kinematics = ArmKinematics(rack_cell, 0)
    begin = np.array([0.2, 0.5, 0.4, 0.3, 0.9, 0.1])
    path = begin + np.linspace(0.0, 0.4, 20)[:, None] * np.array([1, -1, 0.5, 0.2, 0.4, 1.0])
    T, _ = kinematics.pose_and_jacobian(path)
    found, kept, _ = kinematics.follow(begin[None], T)
    assert kept.tolist() == [20]
    np.testing.assert_allclose(found[:, 0], path, atol=1e-6)
    far = pose_matrix(np.array([5.0, 0.0, 0.0]), np.zeros(3))
    _, kept, _ = kinematics.follow(np.zeros((1, 6)), np.array([far, far]))
    assert kept.tolist() == [0]


def test_the_spin_turns_the_pad_as_the_file_does(rack_cell: Workcell) -> None:
    """A spin of the joint about the pad's axis is one of the pad."""
    kinematics = ArmKinematics(rack_cell, 0)
    plain, turned = kinematics.held(), kinematics.held(0.7)
    np.testing.assert_allclose(plain[:3, 3], turned[:3, 3], atol=1e-12)
    angle = pin.log3(plain[:3, :3].T @ turned[:3, :3])
    assert np.linalg.norm(angle) == pytest.approx(0.7)
    T_box_joint = np.linalg.inv(kinematics.geometry.T_joint_box)
    np.testing.assert_allclose(T_box_joint, plain, atol=1e-12)


def test_spins_are_left_out_at_which_the_pad_meets_what_stands(rack_cell: Workcell) -> None:
    """A bar beside the pad, and a fin on the pad that meets it in one of four turns."""
    start = np.array(rack_cell.task.waypoints[0].lower)
    goal, robot = start + 0.05 * np.eye(6)[2], rack_cell.robots[0]
    at = pose_matrix(np.array([0.15, 0.0, -0.05]), np.zeros(3))
    fin = Body("fin", Box(np.array([0.3, 0.02, 0.02])), robot.T_flange_pad @ at)
    robot = replace(robot, tool=(fin,))
    pad = box_placement(rack_cell.task.orientation, start) @ rack_cell.contacts[0].T_box_pad
    at = pose_matrix(np.array([0.22, 0.0, -0.05]), np.zeros(3))
    bar = Body("bar", Box(np.full(3, 0.1)), pad @ at)
    cell = replace(rack_cell, robots=(robot, rack_cell.robots[1]), environment=(bar,))
    judge, arm = judge_of(build_cell_bodies(cell)), ArmKinematics(cell, 0)
    spins = SPINS[::3]
    query = HoldQuery(start, goal, spins, judge)
    np.testing.assert_allclose(clear_spins(query, arm, spins), spins[1:])
    np.testing.assert_array_equal(clear_spins(query, arm, spins[:1]), spins[:1])
    np.testing.assert_array_equal(clear_spins(replace(query, judge=None), arm, spins), spins)


def test_spins_leave_the_patches_of_an_arm_where_they_are() -> None:
    """Two tines and two fingers make half turns, an array of cups longer than wide as well, a
    square one quarter turns."""
    fork, round_pad = load("studies/workcells/fork.toml").contacts, load(RACK).contacts[0]
    np.testing.assert_array_equal(possible_spins(round_pad, SPINS), SPINS)
    # A rectangle covers the same patch after half a turn only.
    np.testing.assert_allclose(possible_spins(fork[1], SPINS), [0.0, np.pi])
    assert fork[0].further
    np.testing.assert_allclose(possible_spins(fork[0], SPINS), [0.0, np.pi])
    fingers = load("studies/workcells/plate.toml").contacts[0]
    np.testing.assert_allclose(possible_spins(fingers, SPINS), [0.0, np.pi])
    cups = load("studies/workcells/palletising.toml").contacts[0]
    np.testing.assert_allclose(possible_spins(cups, SPINS), [0.0, np.pi])
    others = ((0.0, 0.12), (0.12, 0.0), (0.12, 0.12))
    square = replace(cups, further=tuple(_at(cups, x, y) for x, y in others))
    np.testing.assert_allclose(possible_spins(square, SPINS), np.pi / 2.0 * np.arange(4))


def _at(contact: Contact, x: float, y: float) -> Contact:
    """Return a hand beside another, along its axes [m]."""
    beside = pose_matrix(np.array([x, y, 0.0]), np.zeros(3))
    return replace(contact, T_box_pad=contact.T_box_pad @ beside, further=())


def test_holds_hold_the_box_at_both_ends(rack_cell: Workcell) -> None:
    ends = start, goal = rack_cell.task.waypoints[0].lower, rack_cell.task.waypoints[-1].lower
    kinematics, query = ArmKinematics(rack_cell, 0), HoldQuery(start, goal, SPINS, None)
    holds = find_holds(query, kinematics, np.random.default_rng(1)).holds
    assert len(holds) > 1
    for hold in holds:
        for pose, q in zip(ends, (hold.q_start, hold.q_goal), strict=True):
            T, T_world_box = (
                kinematics.pose_and_jacobian(q[None])[0][0],
                pose_matrix(pose[:3], pose[3:]),
            )
            np.testing.assert_allclose(T, T_world_box @ kinematics.held(hold.spin), atol=1e-5)


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    """A machine with a waist that moves both arms, ready for a path."""
    problem = read_problem(Torso().problem(tmp_path_factory.mktemp("waist")))
    return prepare(problem, {}, SPINS, np.random.default_rng(1))


def test_a_free_waist_leaves_what_a_held_one_allows(machine: Setup, tmp_path: Path) -> None:
    """The position at which a locked joint is held comes first, before any other is compared."""
    held = {"robots": [{"locked_joints": {"torso_joint_0": 0.0}}] * 2}
    path = Torso().problem(tmp_path)
    problem = read_problem(path)
    problem = replace(problem, data=merged(problem.data, held))
    assert prepare(problem, {}, SPINS, np.random.default_rng(1)).pairs
    assert any(pair.start.q[0][0] == 0.0 == pair.goal.q[0][0] for pair in machine.pairs)


def test_both_arms_of_a_pair_hold_the_box_with_one_waist(machine: Setup) -> None:
    workcell = machine.workcell
    arms = [ArmKinematics(workcell, arm) for arm in (0, 1)]
    assert [arm.common for arm in arms] == [[0], [0]]
    task = workcell.task
    for pair in machine.pairs:
        for place, pose in (
            (pair.start, task.waypoints[0].lower),
            (pair.goal, task.waypoints[-1].lower),
        ):
            assert place.q[0][0] == place.q[1][0]
            T_world_box = box_placement(task.orientation, pose)
            for arm, hold, q in zip(arms, pair.holds, place.q, strict=True):
                target = T_world_box @ arm.held(hold.spin)
                np.testing.assert_allclose(arm.pose_and_jacobian(q[None])[0][0], target, atol=1e-5)


def test_a_waist_turns_where_the_box_is_beside_the_machine(machine: Setup) -> None:
    """The start and the goal lie at 50 and -50 degrees. Pinocchio places the box in both hands."""
    workcell, task = machine.workcell, machine.workcell.task
    turned = [
        np.array([0.40 * np.cos(a), 0.40 * np.sin(a), 0.85, 0.0, 0.0, a]) for a in (0.9, -0.9)
    ]
    arms = [ArmKinematics(workcell, arm) for arm in (0, 1)]
    query = HoldQuery(turned[0], turned[1], SPINS, None)
    counts, found = machine_holds(query, arms, np.random.default_rng(1))
    assert counts.within >= len(found) > 4
    for holds in found:
        for pose, end in zip(turned, ("q_start", "q_goal"), strict=True):
            q = [getattr(hold, end) for hold in holds]
            assert q[0][0] == q[1][0]
            for arm, hold in enumerate(holds):
                robot, model = workcell.robots[arm], arm_model(workcell.robots[arm])
                assert (q[arm] >= robot.position_lower).all()
                assert (q[arm] <= robot.position_upper).all()
                data = model.createData()
                pin.forwardKinematics(model, data, q[arm])
                target = box_placement(task.orientation, pose) @ arms[arm].held(hold.spin)
                there = robot.T_world_base @ data.oMi[model.njoints - 1].homogeneous
                np.testing.assert_allclose(there, target, atol=1e-5)
    waist = np.array([[hold.q_start[0], hold.q_goal[0]] for hold, _ in found])
    assert np.median(waist[:, 0]) > 0.3
    assert np.median(waist[:, 1]) < -0.3


def test_an_arm_that_comes_near_a_singular_posture_is_told_with_the_key(tmp_path: Path) -> None:
    too_much = {"robots": [{"min_manipulability": 0.05}, {}]}
    problem = read_problem(Torso().problem(tmp_path, **too_much))
    told = (
        r"left has no usable posture .*: abs\(det J\) is at most 0\.0\d+ m\^3, .*"
        r"1\.1 times robots\[0\]\.min_manipulability = 0\.05 m\^3"
    )
    with pytest.raises(ProposalError, match=told):
        prepare(problem, {}, SPINS, np.random.default_rng(1))


def test_spins_are_chosen_before_reach_is_checked(tmp_path: Path) -> None:
    """Side tools that reach at some spins only; with the spin of the file the cell is refused."""
    tool = {"pad": {"xyz": [0.0, 0.14, 0.22], "rpy": [-1.5707963267948966, 0.0, 0.0]}, "tool": []}
    ends = {"start": [0.66, 0.0, 0.30, 0, 0, 0], "goal": [0.66, 0.0, 0.45, 0, 0, 0]}
    data = tomllib.loads(POST.read_text(encoding="utf-8"))
    bases = [{"base": {"xyz": [-0.35, side * 0.45, 0.0]}} for side in (1.0, -1.0)]
    robots = [{"robot": "ur5", "chain": ["base_link", "tool0"], **base, **tool} for base in bases]
    changes = {"robots": robots, "task": ends, "environment": None}
    path = tmp_path / "side.toml"
    path.write_text(completed("", data, changes), encoding="utf-8")
    problem = read_problem(path)
    found = problem.workcell()
    assert not reach_missing(found, problem.poses, SPINS)
    with pytest.raises(WorkcellError, match=r"task\.start|task\.goal"):
        load(path, text=completed("", merged(data, changes), _draft(problem)).encode())


def _draft(problem: Problem) -> dict[str, object]:
    """What a problem lacks to be a cell, as the file has it: no spin."""
    start, goal = problem.poses
    bounds = {"lower": (start - 0.1).tolist(), "upper": (goal + 0.1).tolist()}
    return {"contacts": problem.contacts, "task": {"waypoints": [bounds]}}


@pytest.mark.parametrize(
    ("least", "told"),
    [(0.03, "farther"), (0.15, "robots[0].min_manipulability = 0.15 m^3")],
)
def test_what_ends_the_way_to_a_goal_out_of_reach_is_told(
    rack_cell: Workcell, least: float, told: str
) -> None:
    start, goal = rack_cell.task.waypoints[0].lower, rack_cell.task.waypoints[-1].lower
    far = goal + np.array([0.0, -2.0, 0.0, 0.0, 0.0, 0.0])
    robot = replace(rack_cell.robots[0], min_manipulability=least)
    cell = replace(rack_cell, robots=(robot, rack_cell.robots[1]))
    query, rng = HoldQuery(start, far, SPINS, None), np.random.default_rng(1)
    found = find_holds(query, ArmKinematics(cell, 0), rng)
    assert not found.holds
    assert 0.0 < found.kept < 1.0
    assert told in found.stopped


def other_branch(q: Array) -> Array:
    """Another posture of the first arm with its flange where it is, both arms side by side."""
    robot, model = rack().workcell.robots[0], rack().compiled.model.robots[0]
    data = model.model.createData()
    pin.framesForwardKinematics(model.model, data, q[:6])
    flange = data.oMf[model.flange_id].homogeneous
    found = inverse_kinematics(robot, model, flange)
    return np.concatenate([found[np.argmin(np.abs(found[:, 1] - 0.3))], q[6:]])


@pytest.mark.parametrize("after", [False, True])
def test_an_arm_changes_its_branch_before_it_grips_and_drives_home(after: bool) -> None:
    job = rack_job()
    end = job.phases[-1].motion.q[-1] if after else job.phases[0].motion.q[0]
    pose = job.phases[-1].motion.pose[-1] if after else job.phases[0].motion.pose[0]
    home = np.array([0.0, 0.0, 0.0, 0.0, 1.57, 0.0] * 2) if after else other_branch(end)
    way = ho.plan_reach(job, home, rng=np.random.default_rng(1), after=after)
    ends = (end, home) if after else (home, end)
    np.testing.assert_array_equal(way[[0, -1]], ends)
    geometry = job_geometry(job.workcell, everywhere=True)
    assert len(geometry.active) > len(job_geometry(job.workcell).active), "pads against the box"
    for first, last in pairwise(way):
        for q in np.linspace(first, last, 12):
            pieces = placed_pieces(geometry, pose, q[:6], q[6:])
            for pair in geometry.active:
                names = {geometry.bodies[k].group for k in (pair.first, pair.second)}
                if names != {"payload", "environment"}:  # the box stands
                    assert coal_distance(pieces[pair.first], pieces[pair.second]) > 0.0


def test_what_cannot_be_is_told() -> None:
    job, rng = rack_job(), np.random.default_rng(1)
    with pytest.raises(SettingsError, match=" 12 "):
        ho.plan_reach(job, np.zeros(6), rng=rng)
    held = job.phase("carry").motion.q[0].copy()
    held[1] += 0.5
    with pytest.raises(JobError, match="meets"):
        ho.plan_reach(job, held, rng=rng)


pytestmark = pytest.mark.filterwarnings("ignore::symbolic.geometry.hulls.CollisionModelWarning")


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return read_problem(tiago_problem(tmp_path_factory.mktemp("tiago")))


@pytest.fixture(scope="module")
def drafted(problem: Problem) -> tuple[Problem, Workcell]:
    """Its left hand on the left, and the cell of that."""
    (side,) = (s for s in problem.sides() if s.contacts[0]["xyz"] == [0.0, 0.18, 0.0])
    return side, draft_of(side)


def at(x: float) -> Array:
    return np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_a_machine_stands_where_its_arms_reach(
    problem: Problem, drafted: tuple[Problem, Workcell]
) -> None:
    """With its left hand on the left it looks along x, before the tote; else against it."""
    for side in problem.sides()[2:]:
        left = np.array(side.contacts[0]["xyz"])
        assert left[1] != 0.0
        for base in machine_bases(side, drafted[1]):
            across = [-np.sin(base[5]), np.cos(base[5]), 0.0]
            assert left @ across > 0.0
            ahead = np.array([np.cos(base[5]), np.sin(base[5])])
            assert (np.array([0.6, 0.0]) - base[:2]) @ ahead > 0.2


def test_too_near_there_is_no_room_and_in_the_shelf_no_place(
    drafted: tuple[Problem, Workcell],
) -> None:
    scorer = BaseScorer(*drafted, SPINS, np.random.default_rng(1))
    rooms = []
    for x in (0.07, 0.20):
        arms = [scorer.rank(arm, at(x)) for arm in (0, 1)]
        assert arms[0] is not None
        assert arms[1] is not None
        rooms.append(shared_room(arms[0], arms[1]))
    assert rooms[0] > rooms[1]
    assert scorer.rank(0, at(0.6)) is None
    assert scorer.rank(0, at(-1.5)) is None, "out of reach"


@pytest.mark.slow
def test_a_machine_without_a_place_gets_a_carry(problem: Problem) -> None:
    """The best places are before the shelf: behind it, its back is in the way."""
    choices = base_choices(problem, SPINS, np.random.default_rng(1))
    assert all(-0.1 < choice["robots"][0]["base"]["xyz"][0] < 0.1 for choice in choices[:2])
    settings = ho.ProposeSettings(bases=True)
    found = ho.propose(problem.source, rng=np.random.default_rng(1), settings=settings)
    assert found.judgement.feasible
    assert found.seconds <= settings.seconds


START, GOAL = np.array([0.0, 0, 0.7, 0, 0, 0]), np.array([0.0, 0, 1.1, 0, 0, 0.2])
SHELF = {
    "lower board": ([0.0, 0.0, 0.56], [0.3, 0.3, 0.02]),
    "upper board": ([0.0, 0.0, 0.95], [0.3, 0.3, 0.02]),
    "back": ([0.25, 0.0, 0.8], [0.02, 0.3, 1.4]),
}
"""Middles and edges [m]: open to -x and to both sides."""


def cell_with(bodies: dict[str, tuple[list[float], list[float]]]) -> Workcell:
    environment = tuple(
        Body(name, Box(np.array(size)), pose_matrix(np.array(middle), np.zeros(3)))
        for name, (middle, size) in bodies.items()
    )
    return replace(hand_cell(), environment=environment)


def meets(pose: Array, size: Array) -> bool:
    """Whether a level box of these edges meets the shelf."""
    return any(
        bool(np.all(np.abs(pose[:3] - middle) < (size + edges) / 2.0))
        for middle, edges in SHELF.values()
    )


def test_without_obstacles_every_detour_is_free() -> None:
    found = free_detours(cell_with({}), START, GOAL)
    assert found.shape == (1 + 9 * len(ASIDE), POSES, 6)
    np.testing.assert_allclose(found[:, 0], np.tile(START, (len(found), 1)))
    np.testing.assert_allclose(found[:, -1], np.tile(GOAL, (len(found), 1)))
    away = np.linalg.norm(found[:, :, :2], axis=2).max(axis=1)
    # Some poses stand a little beside the corner.
    assert away[0] == 0.0
    assert away.max() == pytest.approx(max(ASIDE), abs=0.02)
    assert found[:, :, 2].max() == pytest.approx(GOAL[2] + LIFT_HEIGHT + max(ASIDE), abs=0.05)
    wall = {"wall": ([0.0, 0.0, 0.9], [2.0, 2.0, 0.02])}
    assert free_detours(cell_with(wall), START, GOAL).shape == (0, POSES, 6)


def test_what_is_left_leads_around_the_shelf() -> None:
    goal = GOAL * [1, 1, 1, 1, 1, 0]  # level, as the oracle wants it
    cell = cell_with(SHELF)
    every, found = free_detours(cell_with({}), START, goal), free_detours(cell, START, goal)
    size = cell.payload.size
    ends = (START, goal)
    expected = [
        path
        for path in every
        if not any(
            meets(pose, size)
            for pose in path
            if min(np.abs(pose - end).max() for end in ends) >= LIFT_HEIGHT
        )
    ]
    np.testing.assert_array_equal(found, np.array(expected))
    farthest = found[np.arange(len(found)), np.abs(found[:, :, :2]).sum(axis=2).argmax(axis=1)]
    assert 0 < len(found) < len(every) / 3
    assert np.all(farthest[:, 0] < 0.1), "through the back"


def test_a_cell_that_holds_the_box_otherwise_shares_functions_that_say_the_same(
    rack_cell: Workcell,
) -> None:
    """Turned pads change no pair that may meet; a thing that stands there does."""
    known, rng = build_cell_bodies(rack_cell), np.random.default_rng(0)
    first, second = (rotate_about_normal(contact, 1.0) for contact in rack_cell.contacts)
    turned = replace(rack_cell, contacts=(first, second))
    shared, own = build_cell_bodies(turned, known), build_cell_bodies(turned)
    assert shared.screening is known.screening
    at = [rng.normal(size=6) for _ in range(3)]
    for name in ("clearance", "piece_poses"):
        np.testing.assert_array_equal(shared.screening[name](*at)[0], own.screening[name](*at)[0])
    emptied = build_cell_bodies(replace(rack_cell, environment=()), known)
    assert emptied.screening is not known.screening
