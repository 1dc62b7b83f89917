"""Straight motions before and after a carry, and choices that make them or a hold possible."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from hybrid_opt.extras.proposing.handling import HandlingMotions
from hybrid_opt.extras.proposing.holding import GUIDES, HoldQuery, find_holds
from hybrid_opt.extras.proposing.kinematics import ArmKinematics
from hybrid_opt.extras.proposing.problem import Problem, read_problem
from hybrid_opt.extras.proposing.redundancy import redundancy, redundant_choices
from hybrid_opt.extras.proposing.setup import prepare
from hybrid_opt.extras.proposing.trial import judge_of
from symbolic.array import Array
from symbolic.cell_model import build_cell_bodies
from symbolic.read.arms import arm_model
from symbolic.read.cell import load
from symbolic.read.editing import completed, merged
from symbolic.records import Body, Box, Workcell
from symbolic.records.poses import box_placement, pose_matrix
from tests.symbolic.read.samples import RACK

SPINS: Array = 2.0 * np.pi * np.arange(12.0) / 12.0


def motions_of(cell: Workcell) -> HandlingMotions:
    ends = cell.task.waypoints[0].lower, cell.task.waypoints[-1].lower
    return HandlingMotions(cell, judge_of(build_cell_bodies(cell)), ends)


def rack_cell(**handling: Any) -> Workcell:
    cell = load(RACK)
    return replace(cell, handling=replace(cell.handling, **handling))


def test_the_box_goes_down_to_what_lies_beneath_and_the_pads_back() -> None:
    cell = rack_cell(lift_height=None, set_down_height=0.03, stand_off=0.07)
    start = cell.task.waypoints[0].lower
    solid = cell.payload.solid
    assert isinstance(solid, Box)
    height = float(solid.size[2])
    top = pose_matrix(start[:3] - [0.0, 0.0, height / 2.0 + 0.05 + 0.01], np.zeros(3))
    support = Body("support", Box(np.array([0.1, 0.1, 0.02])), top)
    cell = replace(cell, environment=(support,))
    motions, kinematics = motions_of(cell), ArmKinematics(cell, 0)
    held = kinematics.held()
    for end, (pose, drop) in enumerate(
        zip((start, cell.task.waypoints[-1].lower), (0.05, 0.03), strict=True)
    ):
        T = box_placement(cell.task.orientation, pose)
        found = motions.targets(kinematics, end, held[None])[:, 0]
        np.testing.assert_allclose(found[0], T @ held, atol=1e-12)
        back = T[:3, :3] @ cell.contacts[0].T_box_pad[:3, 2]
        moved = found[-1][:3, 3] - (T @ held)[:3, 3]
        np.testing.assert_allclose(moved, [0.0, 0.0, -drop] - 0.07 * back, atol=2e-3)
        np.testing.assert_allclose(found[-1][:3, :3], (T @ held)[:3, :3], atol=1e-12)


@pytest.mark.parametrize(("height", "possible"), [(0.0, True), (0.5, False)])
def test_holds_from_which_the_box_cannot_be_set_down_have_no_whole_share(
    height: float, possible: bool
) -> None:
    """Half a metre below its start the box of the rack is out of reach of the arm's posture."""
    cell = rack_cell(lift_height=height, set_down_height=height)
    motions, kinematics = motions_of(cell), ArmKinematics(cell, 0)
    ends = cell.task.waypoints[0].lower, cell.task.waypoints[-1].lower
    holds = find_holds(HoldQuery(*ends, SPINS, None), kinematics, np.random.default_rng(1)).holds
    T_box_joint = np.array([kinematics.held(hold.spin) for hold in holds])
    q = np.array([hold.q_start for hold in holds]), np.array([hold.q_goal for hold in holds])
    shares = motions.shares(kinematics, T_box_joint, q)
    assert (shares == 1.0).any() == possible
    assert ((shares > 0.0) & (shares <= 1.0)).all()


PROBLEMS = RACK.parents[1] / "problems"
PITCH = PROBLEMS / "pitch-panda.toml"


def pandas(**changes: Any) -> Problem:
    """Two Pandas that stand askew and pitch a box far, in a problem that is not written."""
    data = merged(tomllib.loads(PITCH.read_text(encoding="utf-8")), changes)
    return replace(read_problem(PITCH), data=data, text=completed("", data, {}))


def test_settled_postures_hold_the_box_where_they_did() -> None:
    problem = pandas(handling={"lift_height": 0.1, "set_down_height": 0.1})
    cell = problem.workcell(redundancy(problem, problem.workcell({})))
    motions, kinematics = motions_of(cell), ArmKinematics(cell, 0)
    query = HoldQuery(*problem.poses, SPINS, None)
    holds = find_holds(query, kinematics, np.random.default_rng(1)).holds
    held = np.array([kinematics.held(hold.spin) for hold in holds])
    q = np.array([hold.q_start for hold in holds])
    settled = motions.settled(kinematics, 0, held, q)
    model = arm_model(cell.robots[0])
    data = model.createData()
    T_world_box = box_placement(cell.task.orientation, problem.poses[0])
    for after, T_box_joint in zip(settled, held, strict=True):
        pin.forwardKinematics(model, data, after)
        there = cell.robots[0].T_world_base @ data.oMi[model.njoints - 1].homogeneous
        np.testing.assert_allclose(there, T_world_box @ T_box_joint, atol=1e-4)
        assert (after >= cell.robots[0].position_lower).all()
        assert (after <= cell.robots[0].position_upper).all()
    targets = motions.targets(kinematics, 0, held)
    shares = [motions.followed(kinematics, one, targets)[0] for one in (q, settled)]
    assert (shares[1] >= shares[0]).all()
    assert (shares[1] == 1.0).sum() > (shares[0] == 1.0).sum()


@pytest.mark.slow
def test_another_redundant_joint_is_chosen_where_an_arm_finds_few_holds() -> None:
    """Pandas a little askew that pitch a box by 56 degrees from one side to the other: with the
    best conditioned joint an arm has no hold."""
    askew = [{"base": {"xyz": [-0.094 * s, 0.684 * s, 0.0]}} for s in (1.0, -1.0)]
    problem = pandas(
        robots=[{**one, "pad": {"xyz": [0.0, 0.0, 0.125]}} for one in askew],
        payload={"size": [0.208, 0.284, 0.222]},
        task={
            "start": [-0.2964, -0.0266, 0.3099, 0.0, 0.4908, 0.0],
            "goal": [0.2754, -0.0266, 0.3156, 0.0, -0.4908, 0.0],
        },
        environment=None,
    )
    setup = prepare(problem, {}, SPINS, np.random.default_rng(1))
    own = [[joint for joint, _ in setup.workcell.task.redundant_entries[arm]] for arm in (0, 1)]
    first = [list(redundant_choices(setup.workcell, arm)[0]) for arm in (0, 1)]
    assert own != first
    poses = [box_placement(setup.workcell.task.orientation, pose) for pose in problem.poses]
    for pair in setup.pairs:
        for T_world_box, place in zip(poses, (pair.start, pair.goal), strict=True):
            for arm, (hold, q) in enumerate(zip(pair.holds, place.q, strict=True)):
                kinematics = ArmKinematics(setup.workcell, arm)
                there = kinematics.pose_and_jacobian(q[None])[0][0]
                np.testing.assert_allclose(
                    there, T_world_box @ kinematics.held(hold.spin), atol=1e-4
                )
                assert place.extended[6 + arm] == q[own[arm][0]]


def test_an_arm_passes_beside_a_singular_posture() -> None:
    """A quarter turn between two UR5: on straight guides one arm passes a singular posture."""
    path = PROBLEMS / "turn-ur10.toml"
    data = tomllib.loads(path.read_text(encoding="utf-8"))
    ends = {"start": [-0.17, 0.03, 0.37, 0, 0, 0.76], "goal": [0.14, 0.03, 0.44, 0, 0, -0.71]}
    robots = [
        {"robot": "ur5", "base": {"xyz": [0.0, 0.6 * s, 0.0]}, "pad": {"xyz": [0.0, 0.0, 0.09]}}
        for s in (1.0, -1.0)
    ]
    changes = {"robots": robots, "payload": {"size": [0.24, 0.22, 0.27]}, "task": ends}
    whole = merged(data, changes)
    problem = replace(read_problem(path), data=whole, text=completed("", whole, {}))
    cell = problem.workcell()
    query = HoldQuery(*problem.poses, SPINS, None)
    found = [find_holds(query, ArmKinematics(cell, k), np.random.default_rng(1)) for k in (0, 1)]
    assert all(one.holds for one in found)
    straight = replace(query, guides=len(GUIDES))
    alone = [find_holds(straight, ArmKinematics(cell, k), np.random.default_rng(1)) for k in (0, 1)]
    assert not all(one.holds for one in alone)
