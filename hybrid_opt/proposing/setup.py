"""A problem made ready for a path: the cell's bodies, both arms' ways to hold, their pairs."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from hybrid_opt.errors import ProposalError
from hybrid_opt.evaluate.static_hold import require_hold
from hybrid_opt.proposing.document import merged
from hybrid_opt.proposing.holding import HoldQuery, HoldSearch, find_holds
from hybrid_opt.proposing.judge import judge_of
from hybrid_opt.proposing.kinematics import ArmKinematics
from hybrid_opt.proposing.pairing import Pair, ranked_pairs
from hybrid_opt.proposing.problem import Problem
from hybrid_opt.proposing.reasons import box_blocked, holds_missing, no_pair
from symbolic.array import Array
from symbolic.geometry.pairs import build_geometry
from symbolic.read.arms import FOLLOWING, arm_model, common_joints, turning_joints
from symbolic.records import Workcell

POSTURES = 200
"""Random postures by which redundant joints are chosen."""


@dataclass(frozen=True, eq=False)
class Setup:
    """A cell and the pairs of ways to hold in it.

    Attributes:
        given: what was added to the problem's tables before, such as bases.
        workcell: the cell, its redundant joints chosen.
        pairs: the most promising first.
    """

    given: dict[str, Any]
    workcell: Workcell
    pairs: list[Pair]


def prepare(
    problem: Problem, given: dict[str, Any], spins: Array, rng: np.random.Generator
) -> Setup:
    """Find all ways to hold.

    Args:
        given: added to the problem's tables.
        spins: of both pads that are tried [rad].

    Raises:
        ProposalError: an arm cannot hold the box at start and goal; the text says why.
        WorkcellError: the problem is wrong, or no arms could hold the payload still.
    """
    given = merged(given, redundancy(problem, problem.workcell(given)))
    workcell = problem.workcell(given)
    require_hold(workcell)
    start, goal = problem.poses
    judge = judge_of(build_geometry(workcell))
    blocked = box_blocked(judge, start, goal)
    if blocked:
        raise ProposalError(blocked)
    query = HoldQuery(workcell, start, goal, spins, judge)
    searches: list[HoldSearch] = []
    for arm in (0, 1):
        redundant = tuple(joint for joint, _ in workcell.task.redundant_of(arm))
        searches.append(find_holds(query, arm, ArmKinematics.of(workcell, arm, redundant), rng))
    missing = holds_missing(query, searches)
    if missing:
        raise ProposalError(missing)
    pairs = ranked_pairs(workcell, judge, [found.holds for found in searches], (start, goal))
    if not pairs:
        raise ProposalError(no_pair(query, judge, searches))
    return Setup(given, workcell, pairs)


def redundancy(problem: Problem, workcell: Workcell) -> dict[str, Any]:
    """The joints beyond six where the file does not name them, at the middle of their ranges."""
    robots: list[dict[str, Any]] = [{}, {}]
    entries: dict[str, dict[str, Any]] = {}
    common = common_joints(workcell.robots)
    for i, robot in enumerate(workcell.robots):
        model = arm_model(robot)
        if model.nq == FOLLOWING:
            continue
        names = list(model.names)[1:]
        chosen = list(robot.redundant_joints)
        if not problem.data["robots"][i].get("redundant_joints"):
            chosen = [names[k] for k in redundant_joints(workcell, i, common)]
        robots[i]["redundant_joints"] = chosen
        for name in chosen:
            joint = names.index(name)
            middle = float(robot.position_lower[joint] + robot.position_upper[joint]) / 2.0
            key = name if name in common else f"{robot.name}/{name}"
            entries.setdefault(key, {"joint": key, "initial": middle})
    return {"robots": robots, "task": {"redundant": list(entries.values())}} if entries else {}


def redundant_joints(workcell: Workcell, arm: int, common: tuple[str, ...]) -> tuple[int, ...]:
    """Indices of the joints of an arm without which the other six are conditioned best, in the
    median of random postures; joints of both arms and joints that slide in any case."""
    robot = workcell.robots[arm]
    model = arm_model(robot)
    names, beyond = list(model.names)[1:], model.nq - FOLLOWING
    held = [names.index(name) for name in common]
    sliding = [k for k, turns in enumerate(turning_joints(model)) if not turns and k not in held]
    forced = [*held, *sliding][:beyond]
    kinematics = ArmKinematics.of(workcell, arm, ())
    low, high = np.maximum(kinematics.lower, -np.pi), np.minimum(kinematics.upper, np.pi)
    q = np.random.default_rng(0).uniform(low, high, (POSTURES, len(low)))
    jacobian = kinematics.jacobian(*kinematics.chain(q))

    def condition(joints: tuple[int, ...]) -> float:
        rest = [k for k in range(model.nq) if k not in joints]
        return float(np.median(np.linalg.svd(jacobian[:, :, rest], compute_uv=False)[:, -1]))

    others = [k for k in range(model.nq) if k not in forced]
    found = combinations(others, beyond - len(forced))
    return max((tuple(sorted((*forced, *more))) for more in found), key=condition)
