"""Where both arms can hold the box: Pinocchio's closed chain, FCL and the maker's reach judge."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from hybrid_opt.extras.proposing.closed_chain import ChainConfiguration, ClosedChain
from hybrid_opt.extras.proposing.hold_map import (
    HoldMap,
    HoldMapSettings,
    hold_map,
    holds_anywhere,
    turned,
)
from hybrid_opt.extras.proposing.hold_search import PoseState
from hybrid_opt.extras.proposing.holding import Hold
from hybrid_opt.extras.proposing.problem import Problem, read_problem
from hybrid_opt.extras.proposing.remedies import PROBLEM_CHANGES, least_changes
from hybrid_opt.extras.proposing.setup import prepare
from hybrid_opt.extras.proposing.trial import judge_of
from symbolic.array import Array
from symbolic.cell_model import CellBodies, build_cell_bodies
from symbolic.errors import SettingsError, WorkcellError
from symbolic.read.arms import arm_model
from symbolic.records.poses import Orientation, box_placement

SPINS: Array = 2.0 * np.pi * np.arange(12.0) / 12.0

ROD = Path("studies/problems/rod-poles-irb120.toml").resolve()

MAKERS_REACH = 0.58 + 0.072 + 0.06
"""Reach of an IRB 120's wrist by its maker, from the axis of its second joint, with flange and pad
[m]."""

SECOND_JOINT = 0.29
"""Height of this axis above the base [m]."""


def box_text(apart: float = 0.42) -> str:
    """Two IRB 120 that face one another and a box on a table; no poses, no places of pads."""
    text = ROD.read_text("utf-8").replace("../robots/", f"{ROD.parents[1]}/robots/")
    table = text[text.rindex("[[environment]]") :]
    text = text[: text.index("[[environment]]")]
    text = re.sub(r"(?m)^(start|goal|reference_speed) = .*\n", "", text)
    text = re.sub(r"(?m)(?<=\[\[contacts\]\]\n)xyz = .*\n", "", text)
    text = text.replace("size = [0.3, 0.012, 0.012]", "size = [0.2, 0.15, 0.1]")
    return text.replace("0.45, 0.0, 0.0]", f"{apart}, 0.0, 0.0]") + table


def problem_of(folder: Path, text: str) -> Problem:
    path = folder / "box.toml"
    path.write_text(text, encoding="utf-8")
    return read_problem(path, with_poses=False)


@pytest.fixture(scope="module")
def problem(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return problem_of(tmp_path_factory.mktemp("box"), box_text())


@pytest.fixture(scope="module")
def found(problem: Problem) -> HoldMap:
    settings = HoldMapSettings(step=0.1, heights=(0.02, 0.3, 3.0), yaws=2)
    return hold_map(problem, SPINS, np.random.default_rng(1), settings)


def test_what_holds_is_a_closed_chain_without_collision(problem: Problem, found: HoldMap) -> None:
    places = np.argwhere(found.holds)
    assert len(places) > 20
    bodies: dict[int, CellBodies] = {}
    for at in map(tuple, places[:: max(len(places) // 12, 1)].tolist()):
        way, pose, q = int(found.way[at]), found.poses[at], (found.q[0][at], found.q[1][at])
        if way not in bodies:
            workcell = problem.workcell({"contacts": found.ways[way]})
            bodies[way] = build_cell_bodies(workcell)
        workcell = bodies[way].geometry.workcell
        first, second = (Hold(float(found.spins[at][k]), q[k], q[k], 0.0) for k in (0, 1))
        models = arm_model(workcell.robots[0]), arm_model(workcell.robots[1])
        chain = ClosedChain(workcell, judge_of(bodies[way]), (first, second), models)
        (closed,) = chain.along(ChainConfiguration(pose, q), pose[None])
        np.testing.assert_allclose(np.hstack(closed.q), np.hstack(q), atol=1e-4)
        T_world_box = box_placement(workcell.task.orientation, pose)
        for robot, contact, model, own in zip(
            workcell.robots, workcell.contacts, models, q, strict=True
        ):
            data = model.createData()
            pin.framesForwardKinematics(model, data, own)
            flange = data.oMf[model.getFrameId(robot.flange)].homogeneous
            T_world_pad = robot.T_world_base @ flange @ robot.T_flange_pad
            pressed = T_world_box @ contact.T_box_pad
            np.testing.assert_allclose(T_world_pad[:3, 2:], pressed[:3, 2:], atol=1e-5)


def test_propose_finds_ways_to_hold_the_box_at_the_best_place(
    problem: Problem, found: HoldMap
) -> None:
    best = found.best()
    assert best is not None
    goal = best.pose + np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0])
    task = problem.data["task"] | {"start": best.pose.tolist(), "goal": goal.tolist()}
    placed = replace(problem, data={**problem.data, "task": task})
    assert prepare(placed, {}, SPINS, np.random.default_rng(2)).pairs


def test_nothing_holds_beyond_the_makers_reach_or_in_the_table(found: HoldMap) -> None:
    workcell = found.geometry.workcell
    for at in map(tuple, np.argwhere(found.holds).tolist()):
        T_world_box = box_placement(workcell.task.orientation, found.poses[at])
        for robot, contact in zip(workcell.robots, found.ways[int(found.way[at])], strict=True):
            pad = (T_world_box @ [*contact["xyz"], 1.0])[:3]
            shoulder = robot.T_world_base[:3, 3] + [0.0, 0.0, SECOND_JOINT]
            assert np.linalg.norm(pad - shoulder) <= MAKERS_REACH
    assert (found.state[0] == PoseState.MEETS_SCENE).all()
    assert (found.state[2] == PoseState.OUT_OF_REACH).all()
    assert found.best(2) is None


def test_arms_that_face_one_another_give_a_symmetric_map(found: HoldMap) -> None:
    """A half turn about the vertical exchanges the arms, and the box stays what it is."""
    np.testing.assert_allclose(found.x, -found.x[::-1])
    np.testing.assert_allclose(found.y, -found.y[::-1])
    other = found.holds[:, ::-1, ::-1]
    assert (found.holds != other).sum() <= 0.03 * found.holds.sum()


def test_a_turn_about_the_vertical_keeps_what_is_upright() -> None:
    for orientation in (Orientation(), Orientation("quaternion")):
        angles = np.array([0.2, -0.3, 0.5])
        pose = np.concatenate([np.zeros(3), angles])
        before = box_placement(orientation, pose)[:3, :3]
        pose[3:] = turned(orientation, angles, np.pi / 2.0)
        after = box_placement(orientation, pose)[:3, :3]
        np.testing.assert_allclose(after[2], before[2], atol=1e-12)
        np.testing.assert_allclose(after[:2], [-before[1], before[0]], atol=1e-12)


def test_bases_are_needed_and_the_grid_is_bounded(tmp_path: Path, problem: Problem) -> None:
    text = re.sub(r"(?m)^base = .*\n", "", box_text())
    with pytest.raises(WorkcellError, match=re.escape("robots[0].base")):
        problem_of(tmp_path, text)
    for wrong in ({"step": 0.0}, {"yaws": 0}, {"heights": (99.0,)}):
        with pytest.raises(SettingsError):
            HoldMapSettings(**wrong)
    huge = HoldMapSettings(step=0.01, heights=tuple(np.linspace(0.2, 0.4, 300)), yaws=1)
    with pytest.raises(SettingsError, match="step"):
        hold_map(problem, SPINS, np.random.default_rng(1), huge)


@pytest.mark.slow
def test_bases_too_far_apart_are_freed_by_the_least_change(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, box_text(apart=0.85))

    def can_hold(changed: Problem) -> bool:
        return holds_anywhere(changed, SPINS, np.random.default_rng(1))

    assert not can_hold(problem)
    (kind, amount), *_ = least_changes(problem, can_hold, lambda: False, PROBLEM_CHANGES[:1])
    assert kind is PROBLEM_CHANGES[0]
    assert 0.05 <= amount <= 0.3
    assert not can_hold(kind.applied(problem, amount / 2.0))
