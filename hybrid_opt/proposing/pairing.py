"""Pairs of ways to hold, one per arm, in the order in which they are tried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from hybrid_opt.proposing.agreement import Agreement
from hybrid_opt.proposing.closed_chain import ClosedChain, Place
from hybrid_opt.proposing.holding import GUIDE_POSES, GUIDES, Hold
from hybrid_opt.proposing.judge import MARGINS, PoseJudge
from hybrid_opt.proposing.kinematics import box_poses
from symbolic.array import Array
from symbolic.read.arms import arm_model
from symbolic.records import POSE_SIZE, Task, Workcell

GUIDES_TRIED = 3
"""Guides by which pairs are ranked: straight, bowing up, and far up."""

MOST_PAIRS = 32
"""Pairs that are looked at closer, the best of both arms' own scores."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Both arms' ways to hold.

    Attributes:
        holds: of both arms.
        start, goal: the closed chain at both ends.
        chain: it, with a judge that keeps as much clearance as both ends do.
        free_share: of the freest guide from start to goal.
    """

    holds: tuple[Hold, Hold]
    start: Place
    goal: Place
    chain: ClosedChain
    free_share: float


def ranked_pairs(
    workcell: Workcell, judge: PoseJudge, holds: Sequence[Sequence[Hold]], ends: tuple[Array, Array]
) -> list[Pair]:
    """The pairs whose arms do not meet at start and goal, the most promising first.

    Args:
        workcell: with its redundant joints chosen.
        judge: of collisions, with nothing to spare.
        holds: per arm.
        ends: start and goal poses of the box (6,).
    """
    scored = [(a.score + b.score, (a, b)) for a in holds[0] for b in holds[1]]
    scored.sort(key=lambda item: -item[0])
    judges = cache(judge.with_margin)
    models = (arm_model(workcell.robots[0]), arm_model(workcell.robots[1]))
    agreement = Agreement(workcell, ends)
    found: list[tuple[float, Pair]] = []
    for score, alone in scored[:MOST_PAIRS]:
        pair = agreement.of(alone)
        if pair is None:
            continue
        start, goal = (_place(workcell.task, pose, pair, k) for k, pose in enumerate(ends))
        wide = next(
            (judges(margin) for margin in MARGINS if _free(judges(margin), start, goal)), None
        )
        if wide is not None:
            chain = ClosedChain(workcell, wide, pair, models)
            share = _free_share(chain, start, goal)
            found.append((share + 0.1 * score, Pair(pair, start, goal, chain, share)))
    found.sort(key=lambda item: -item[0])
    return [pair for _, pair in found]


def _place(task: Task, pose: Array, holds: tuple[Hold, Hold], end: int) -> Place:
    """The closed chain at the start (0) or the goal (1)."""
    joints = [(hold.q_start, hold.q_goal)[end] for hold in holds]
    extended = np.zeros(task.extended_size)
    extended[:POSE_SIZE] = pose
    for arm, q in enumerate(joints):
        for joint, place in task.redundant_of(arm):
            extended[place] = q[joint]
    return Place(extended, (joints[0], joints[1]))


def _free(judge: PoseJudge, *places: Place) -> bool:
    """Whether nothing collides in any of these configurations."""
    return not any(
        judge.colliding(place.extended[None, :POSE_SIZE], place.q[0][None], place.q[1][None])[0]
        for place in places
    )


def _free_share(chain: ClosedChain, start: Place, goal: Place) -> float:
    """Of the freest guide."""
    best = 0.0
    for bow in GUIDES[:GUIDES_TRIED]:
        path = box_poses(start.extended, goal.extended, GUIDE_POSES)
        path[:, :3] += np.sin(np.linspace(0.0, np.pi, len(path)))[:, None] * bow
        forth = sum(1 for _ in chain.along(start, path))
        back = sum(1 for _ in chain.along(goal, path[::-1])) if forth < len(path) else forth
        best = max(best, (forth + back) / (2 * len(path)))
    return best
