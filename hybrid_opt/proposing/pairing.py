"""Pairs of ways to hold, one per arm, in the order in which they are tried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from hybrid_opt.proposing.closed_chain import ClosedChain, Place
from hybrid_opt.proposing.holding import (
    GUIDES,
    LIMIT_MARGIN,
    MANIPULABILITY_MARGIN,
    Hold,
)
from hybrid_opt.proposing.judge import MARGINS, PoseJudge
from hybrid_opt.proposing.kinematics import (
    REACHED,
    ArmKinematics,
    box_to_last_joint,
    guide,
    spun,
)
from hybrid_opt.proposing.planner import Retreats, retreats
from symbolic.array import Array
from symbolic.read.arms import arm_model
from symbolic.records import POSE_SIZE, Task, Workcell
from symbolic.records.poses import box_placement

GUIDES_TRIED = 3
"""Guides by which pairs are ranked: straight, bowing up, and far up."""

MOST_PAIRS = 32
"""Pairs that are looked at closer, the best of both arms' own scores."""

SHARES = np.array([0.5, 0.25, 0.75, 0.0, 1.0])
"""Of the way from the first arm's value to the second's: what is tried, in this order."""

STEPS = 15
"""Newton steps from each arm's own posture."""


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

    @cached_property
    def retreats(self) -> Retreats:
        """Where straight motions lead out of start and goal."""
        return retreats(self.chain, (self.start, self.goal))


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
        path = guide(start.extended, goal.extended, bow)
        forth = sum(1 for _ in chain.along(start, path))
        back = sum(1 for _ in chain.along(goal, path[::-1])) if forth < len(path) else forth
        best = max(best, (forth + back) / (2 * len(path)))
    return best


class Agreement:
    """Moves the joints that move both arms to values that suit both."""

    def __init__(self, workcell: Workcell, ends: tuple[Array, Array]) -> None:
        """Prepare both arms.

        Args:
            workcell: with its redundant joints chosen.
            ends: start and goal poses of the box (6,).
        """
        task = workcell.task
        self._workcell = workcell
        self._common = np.array(
            [joint.drives for joint in task.redundant if min(joint.drives) >= 0], dtype=np.intp
        ).reshape(-1, 2)
        self._T_world_box = [box_placement(task.orientation, end) for end in ends]
        self._arms = [
            ArmKinematics.of(workcell, arm, tuple(joint for joint, _ in task.redundant_of(arm)))
            for arm in (0, 1)
        ]

    def of(self, holds: tuple[Hold, Hold]) -> tuple[Hold, Hold] | None:
        """Both arms' ways to hold with the same values of the joints that move both, None where
        no tried values suit both."""
        if not len(self._common):
            return holds
        ends = [
            self._agreed(end, (q_1, q_2), (holds[0].spin, holds[1].spin))
            for end, (q_1, q_2) in enumerate(
                ((holds[0].q_start, holds[1].q_start), (holds[0].q_goal, holds[1].q_goal))
            )
        ]
        if ends[0] is None or ends[1] is None:
            return None
        first, second = (
            replace(hold, q_start=ends[0][arm], q_goal=ends[1][arm])
            for arm, hold in enumerate(holds)
        )
        return first, second

    def _agreed(
        self, end: int, q: tuple[Array, Array], spins: tuple[float, float]
    ) -> tuple[Array, Array] | None:
        """Both arms' postures at the start (0) or the goal (1)."""
        own = [q[arm][self._common[:, arm]] for arm in (0, 1)]
        values = own[0] + SHARES[:, None] * (own[1] - own[0])
        moved, fine = [], np.ones(len(SHARES), dtype=bool)
        for arm, kinematics in enumerate(self._arms):
            contact = spun(self._workcell.contacts[arm], spins[arm])
            T = box_to_last_joint(self._workcell, kinematics.geometry, contact, arm)
            begin = np.tile(q[arm], (len(SHARES), 1))
            begin[:, self._common[:, arm]] = values
            target = np.tile(self._T_world_box[end] @ T, (len(SHARES), 1, 1))
            found = kinematics.solve(begin, target, STEPS)
            least = self._workcell.robots[arm].min_manipulability * MANIPULABILITY_MARGIN
            inside = (found.q >= kinematics.lower + LIMIT_MARGIN) & (
                found.q <= kinematics.upper - LIMIT_MARGIN
            )
            fine &= (found.residual <= REACHED) & (found.manipulability >= least)
            fine &= inside.all(axis=1)
            moved.append(found.q)
        if not fine.any():
            return None
        at = int(np.argmax(fine))
        return moved[0][at], moved[1][at]
