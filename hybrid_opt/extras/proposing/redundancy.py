"""Choice of the redundant joints of arms with more than six joints.

An arm's path leads through singular postures of the six joints that follow the box, or not,
depending on which joint is redundant. So other joints are tried where an arm finds few holds.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from hybrid_opt.extras.proposing.holding import FEW_HOLDS, HoldQuery, HoldSearch, find_holds
from hybrid_opt.extras.proposing.kinematics import ArmKinematics
from hybrid_opt.extras.proposing.problem import Problem
from symbolic.read.arms import FOLLOWING, arm_model, common_joints, turning_joints
from symbolic.records import Workcell

CONDITIONED = 200
"""Number of random postures by which choices of redundant joints are compared."""

MOST_JOINT_CHOICES = 7
"""Largest number of choices of redundant joints of an arm that are tried, the best conditioned."""

Ranks = tuple[int, int]
"""For each arm a place in the list of `redundant_choices`."""


def redundancy(problem: Problem, workcell: Workcell, ranks: Ranks = (0, 0)) -> dict[str, Any]:
    """Choose the redundant joints of arms with more than six joints, and their initial positions,
    the middle of their ranges. Redundant joints that the file names are kept.

    Args:
        problem: the problem.
        workcell: its cell.
        ranks: the choice of each arm; 0 for the best conditioned.

    Returns:
        Additions to the tables `robots` and `task` of the problem; empty if no arm has more than
        six joints.
    """
    robots: list[dict[str, Any]] = [{}, {}]
    entries: dict[str, dict[str, Any]] = {}
    common = common_joints(workcell.robots)
    for i, robot in enumerate(workcell.robots):
        model = arm_model(robot)
        if model.nq == FOLLOWING:
            continue
        names = list(model.names)[1:]
        chosen = list(robot.redundant_joints)
        if not _states_joints(problem, i):
            chosen = [names[k] for k in redundant_choices(workcell, i)[ranks[i]]]
        robots[i]["redundant_joints"] = chosen
        for name in chosen:
            joint = names.index(name)
            middle = float(robot.position_lower[joint] + robot.position_upper[joint]) / 2.0
            key = name if name in common else f"{robot.name}/{name}"
            entries.setdefault(key, {"joint": key, "initial": middle})
    return {"robots": robots, "task": {"redundant": list(entries.values())}} if entries else {}


def _states_joints(problem: Problem, arm: int) -> bool:
    return bool(problem.data["robots"][arm].get("redundant_joints"))


def redundant_choices(workcell: Workcell, arm: int) -> list[tuple[int, ...]]:
    """Return choices of the redundant joints of an arm, the one first whose other six joints are
    best conditioned: the smallest singular value of their Jacobian is largest, in the median of
    random postures. Joints that move both arms and sliding joints are part of every choice.

    Args:
        workcell: the cell.
        arm: index of the arm.

    Returns:
        At most `MOST_JOINT_CHOICES` choices, indices of joints.
    """
    model = arm_model(workcell.robots[arm])
    names, beyond = list(model.names)[1:], model.nq - FOLLOWING
    held = [names.index(name) for name in common_joints(workcell.robots)]
    sliding = [k for k, turns in enumerate(turning_joints(model)) if not turns and k not in held]
    forced = [*held, *sliding][:beyond]
    kinematics = ArmKinematics(workcell, arm)
    q = kinematics.drawn(CONDITIONED, np.random.default_rng(0))
    _, jacobian = kinematics.pose_and_jacobian(q)

    def condition(joints: tuple[int, ...]) -> float:
        rest = [k for k in range(model.nq) if k not in joints]
        return float(np.median(np.linalg.svd(jacobian[:, :, rest], compute_uv=False)[:, -1]))

    others = [k for k in range(model.nq) if k not in forced]
    found = combinations(others, beyond - len(forced))
    ranked = sorted((tuple(sorted((*forced, *more))) for more in found), key=condition)
    return ranked[: -MOST_JOINT_CHOICES - 1 : -1]


def more_holds(
    problem: Problem,
    query: HoldQuery,
    kinematics: ArmKinematics,
    found: HoldSearch,
    rng: np.random.Generator,
) -> tuple[HoldSearch, int]:
    """Search the holds of an arm with few of them again, with other redundant joints.

    Args:
        problem: the problem.
        query: box poses and effort of the search.
        kinematics: the arm, with its first choice of redundant joints.
        found: result with this choice.
        rng: generator of random postures.

    Returns:
        The result with the most holds, and the rank of its choice.
    """
    workcell, arm = kinematics.workcell, kinematics.arm
    best, rank = found, 0
    if not kinematics.redundant or not found.free or _states_joints(problem, arm):
        return best, rank
    for k, joints in enumerate(redundant_choices(workcell, arm)[1:], start=1):
        if len(best.holds) >= FEW_HOLDS:
            break
        other = find_holds(query, kinematics.with_redundant(joints), rng)
        if len(other.holds) > len(best.holds):
            best, rank = other, k
    return best, rank
