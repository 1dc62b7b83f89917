"""What is in the way of a carry, in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from hybrid_opt.evaluate.explanation import missing_reach
from hybrid_opt.proposing.holding import HoldQuery, HoldSearch
from hybrid_opt.proposing.judge import PoseJudge
from hybrid_opt.proposing.kinematics import possible_spins, spun
from hybrid_opt.proposing.pairing import Pair
from symbolic.array import Array
from symbolic.read.arms import arm_model
from symbolic.records.poses import box_placement

POSTURES = 6
"""From which the reach that is missing is looked for with each spin."""

TOLD = 3
"""So many pairs or joints are named."""


def box_blocked(judge: PoseJudge, start: Array, goal: Array) -> str:
    """What the box alone meets at the start or the goal, '' where it meets nothing."""
    found = []
    for name, pose in (("start", start), ("goal", goal)):
        for body, deep in judge.resting(pose):
            told = f"payload meets {body} at the {name}"
            allowed = "raise it, or let it rest there by [[task.allowed_contacts]]"
            found.append(told if deep else f"{told}, by less than 1 mm: {allowed}")
    return "; ".join(found)


def holds_missing(query: HoldQuery, searches: Sequence[HoldSearch]) -> str:
    """Why an arm has no way to hold the box, '' where both have one."""
    found = [
        _arm_missing(query, arm, search) for arm, search in enumerate(searches) if not search.holds
    ]
    return "; ".join(found)


def _arm_missing(query: HoldQuery, arm: int, search: HoldSearch) -> str:
    robot = query.workcell.robots[arm]
    if not search.reached:
        missing = _missing(query, arm, query.start)
        return f"{robot.name} lacks {missing:.3f} m to its contact at the start"
    names = list(arm_model(robot).names)[1:]
    if not search.within:
        joints = ", ".join(names[joint] for joint, _ in search.joints.most_common(TOLD))
        told = f"beyond limits are most often {joints}" if joints else "all are near singular"
        return f"{robot.name} has no usable posture at the start: {told}"
    if not search.free:
        return (
            f"{robot.name} collides at the start in every posture: {_pairs(search.pairs)}"
            f"{_overlap_hint(search.pairs)}"
        )
    if search.pairs and search.kept >= 1.0:
        return (
            f"{robot.name} collides in every posture that leads from the start to the goal: "
            f"{_pairs(search.pairs)}"
        )
    missing = _missing(query, arm, query.goal)
    if missing > 1e-3:
        return f"{robot.name} lacks {missing:.3f} m to its contact at the goal"
    return (
        f"{robot.name} follows at most {100.0 * search.kept:.0f} % of the way to the goal in any "
        "posture within its limits and away from singular ones"
    )


def _missing(query: HoldQuery, arm: int, pose: Array) -> float:
    """Reach that an arm lacks to a pose with any spin, from several postures each [m]."""
    robot, contact = query.workcell.robots[arm], query.workcell.contacts[arm]
    rng = np.random.default_rng(0)
    low = np.maximum(robot.position_lower, -np.pi)
    high = np.minimum(robot.position_upper, np.pi)
    contacts = [spun(contact, spin) for spin in possible_spins(contact, query.spins)]
    postures = rng.uniform(low, high, (len(contacts), POSTURES, len(low)))
    T_world_box = box_placement(query.workcell.task.orientation, pose)
    return min(
        missing_reach(robot, spun_contact, T_world_box, q)
        for spun_contact, some in zip(contacts, postures, strict=True)
        for q in some
    )


def no_pair(query: HoldQuery, judge: PoseJudge, searches: Sequence[HoldSearch]) -> str:
    """Which bodies of the two arms meet where each alone is free."""
    met: Counter[tuple[str, str]] = Counter()
    for end, pose in enumerate((query.start, query.goal)):
        for a in searches[0].holds[:8]:
            for b in searches[1].holds[:8]:
                joints = [(hold.q_start, hold.q_goal)[end] for hold in (a, b)]
                pair = judge.first_pair(pose, joints[0], joints[1])
                if pair is not None:
                    met[pair] += 1
    return f"both arms' postures collide at the start or the goal: {_pairs(met)}"


def no_path(pairs: Iterable[Pair], refusals: Sequence[str]) -> str:
    """What the planner met most often, and what the evaluator said of its paths."""
    met: Counter[tuple[str, str]] = Counter()
    refused: Counter[str] = Counter()
    for pair in pairs:
        met += pair.chain.judge.met
        refused += pair.chain.refused
    told = []
    if met:
        told.append(f"most often in the way: {_pairs(met)}")
    if refused:
        told.append(", ".join(name for name, _ in refused.most_common(TOLD)))
    if refusals:
        (text, count), *_ = Counter(refusals).most_common(1)
        told.append(f"the evaluator refused {len(refusals)} carries, {count} because {text}")
    return "; ".join(told)


def _pairs(met: Counter[tuple[str, str]]) -> str:
    total = max(sum(met.values()), 1)
    return ", ".join(
        f"{' – '.join(pair)} ({100.0 * count / total:.0f} %)"
        for pair, count in met.most_common(TOLD)
    )


def _overlap_hint(met: Counter[tuple[str, str]]) -> str:
    """What may be done about links of one robot that meet in every posture."""
    owners = [[name.partition("/")[0] for name in pair if "/" in name] for pair in met]
    if not any(len(names) == 2 and names[0] == names[1] for names in owners):
        return ""
    return " (links that overlap by design are left out by srdf or [[collision.ignored]])"
