"""A problem prepared for a path search: reach, the holds of both arms, and pairs of holds; or the
reason why one of these is missing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import product
from typing import Any

import numpy as np

from hybrid_opt.errors import NoHoldError, ProposalError
from hybrid_opt.evaluate.explanation import missing_reach
from hybrid_opt.extras.proposing.closed_chain import ChainConfiguration, ClosedChain
from hybrid_opt.extras.proposing.common import MachineKinematics, machine_holds
from hybrid_opt.extras.proposing.handling import HandlingMotions
from hybrid_opt.extras.proposing.holding import (
    GUIDES,
    SEARCH_DAMPING,
    Hold,
    HoldQuery,
    HoldSearch,
    find_holds,
    initial_arc,
    manipulability_hint,
    possible_spins,
)
from hybrid_opt.extras.proposing.kinematics import REACHED, ArmKinematics, rotate_about_normal
from hybrid_opt.extras.proposing.planner import Retreats, retreats
from hybrid_opt.extras.proposing.problem import Problem
from hybrid_opt.extras.proposing.redundancy import more_holds, redundancy
from hybrid_opt.extras.proposing.trial import MARGINS, PoseJudge, judge_of
from hybrid_opt.robust.budget import budget_text
from hybrid_opt.static_hold import require_hold
from symbolic.array import Array
from symbolic.cell_model import CellBodies, build_cell_bodies
from symbolic.read.arms import arm_model
from symbolic.read.editing import merged
from symbolic.records import POSE_SIZE, Task, Workcell
from symbolic.records.poses import box_placement

RANKING_GUIDES = 3
"""Number of guides by which pairs are ranked: straight, bowing up, and far up."""

HANDLING = 0.5
"""Promise of a pair with which the motions before and after the carry are possible."""

MOST_PAIRS = 32
"""Number of pairs that are ranked in detail, the best by the scores of both arms."""

ENOUGH_PAIRS = 4
"""Number of pairs of holds with common joints at rest, after which those of the whole machine are
not searched."""


@dataclass(frozen=True, eq=False)
class Pair:
    """A hold of each arm, with which the arms do not collide at start and goal. A hold is a
    rotation of the arm's pad, and a posture at start and goal.

    Attributes:
        holds: the holds of both arms.
        start, goal: configurations of arms and box at both ends of the carry.
        chain: both arms with these holds. Its collision checker requires as much clearance as there
            is at both ends.
        promise: score of the pair; larger is better.
    """

    holds: tuple[Hold, Hold]
    start: ChainConfiguration
    goal: ChainConfiguration
    chain: ClosedChain
    promise: float

    @cached_property
    def retreats(self) -> Retreats:
        """Configurations that straight collision-free motions out of start and goal reach, as
        `planner.retreats` returns them.
        """
        return retreats(self.chain, (self.start, self.goal))


def ranked_pairs(
    workcell: Workcell,
    judge: PoseJudge,
    handling: HandlingMotions,
    holds: Iterable[tuple[Hold, Hold]],
    ends: tuple[Array, Array],
) -> list[Pair]:
    """Find the pairs of holds, one per arm, with which the arms do not collide at start and goal;
    the most promising pair first. A hold is a pad rotation with a start and a goal posture.

    A pair is promising if the arms can follow much of a box path without a collision, and if its
    holds have high scores.

    Args:
        workcell: the cell, with chosen redundant joints.
        judge: checker of collisions, without a margin.
        handling: straight motions before and after the carry.
        holds: pairs of holds; in each pair, joints that move both arms have equal positions.
        ends: start and goal pose (6,) of the box [m, rad].
    """
    both = list(holds)
    if not both:
        return []
    shares = _handling_shares(handling, workcell, both)
    scored = [
        (0.1 * (a.score + b.score) + HANDLING * share, (a, b))
        for (a, b), share in zip(both, shares, strict=True)
    ]
    scored.sort(key=lambda item: -item[0])
    judges = cache(judge.with_margin)
    models = (arm_model(workcell.robots[0]), arm_model(workcell.robots[1]))
    found: list[Pair] = []
    for score, pair in scored[:MOST_PAIRS]:
        start, goal = (_place(workcell.task, pose, pair, k) for k, pose in enumerate(ends))
        wide = next(
            (judges(margin) for margin in MARGINS if _free(judges(margin), start, goal)), None
        )
        if wide is not None:
            chain = ClosedChain(workcell, wide, pair, models)
            promise = _free_share(chain, start, goal) + score
            found.append(Pair(pair, start, goal, chain, promise))
    return sorted(found, key=lambda pair: -pair.promise)


def _handling_shares(
    handling: HandlingMotions, workcell: Workcell, pairs: Sequence[tuple[Hold, Hold]]
) -> Array:
    """Compute how far the motions before and after a carry are possible with each of n pairs of
    holds: (n,) shares of the worse arm."""
    found = []
    for arm in (0, 1):
        own = list({id(pair[arm]): pair[arm] for pair in pairs}.values())
        kinematics = ArmKinematics(workcell, arm)
        ends = (np.array([hold.q_start for hold in own]), np.array([hold.q_goal for hold in own]))
        T_box_joint = np.array([kinematics.held(hold.spin) for hold in own])
        shares = handling.shares(kinematics, T_box_joint, ends)
        known = {id(hold): float(share) for hold, share in zip(own, shares, strict=True)}
        found.append([known[id(pair[arm])] for pair in pairs])
    return np.asarray(np.min(found, axis=0))


def _place(task: Task, pose: Array, holds: tuple[Hold, Hold], end: int) -> ChainConfiguration:
    """Build the configuration of both arms and the box at the start or the goal.

    Args:
        task: the task.
        pose: (6,) pose of the box there [m, rad].
        holds: hold of each arm.
        end: 0 for the start, 1 for the goal.
    """
    joints = [(hold.q_start, hold.q_goal)[end] for hold in holds]
    extended = np.zeros(task.extended_size)
    extended[:POSE_SIZE] = pose
    for arm, q in enumerate(joints):
        for joint, entry in task.redundant_entries[arm]:
            extended[entry] = q[joint]
    return ChainConfiguration(extended, (joints[0], joints[1]))


def _free(judge: PoseJudge, *configurations: ChainConfiguration) -> bool:
    """Return True if no configuration collides.

    Args:
        judge: checker of collisions.
        configurations: the configurations.
    """
    return not any(
        judge.colliding(each.extended[None, :POSE_SIZE], each.q[0][None], each.q[1][None])[0]
        for each in configurations
    )


def _free_share(chain: ClosedChain, start: ChainConfiguration, goal: ChainConfiguration) -> float:
    """Compute how much of a box path both arms can follow without collision, from 0 to 1.

    It is the mean of two shares: the one followed from the start forwards, and the one followed
    from the goal backwards. The best one of the first `RANKING_GUIDES` paths in `GUIDES` counts.

    Args:
        chain: both arms, whose pads stay fixed on the box.
        start: configuration at the start.
        goal: configuration at the goal.
    """
    best = 0.0
    for bow in GUIDES[:RANKING_GUIDES]:
        path = initial_arc(start.extended, goal.extended, bow)
        forth = sum(1 for _ in chain.along(start, path))
        back = sum(1 for _ in chain.along(goal, path[::-1])) if forth < len(path) else forth
        best = max(best, (forth + back) / (2 * len(path)))
    return best


POSTURES = 200
"""Number of random postures from which redundant joints are chosen, and from which arms reach for
the box."""

REACH_STEPS = 40
"""Number of Newton steps from these postures."""

NEAREST = 8
"""Number of postures from which the missing reach is measured, those that come nearest."""

MISSING = 1e-3
"""Missing reach below this counts as none [m]."""

TOLD = 3
"""Largest number of pairs or joints that a message names."""


@dataclass(frozen=True, eq=False)
class Setup:
    """A cell with the pairs of holds in it.

    Attributes:
        given: additions to the problem's tables that were chosen before, such as bases.
        workcell: the cell, with chosen redundant joints.
        bodies: arms and bodies of the cell.
        pairs: pairs of holds, one hold of each arm, the most promising first.
    """

    given: dict[str, Any]
    workcell: Workcell
    bodies: CellBodies
    pairs: list[Pair]


def prepare(
    problem: Problem,
    given: dict[str, Any],
    spins: Array,
    rng: np.random.Generator,
    tell: Callable[[str], None] = lambda text: None,
) -> Setup:
    """Find all holds of both arms, and the pairs of holds in which the arms do not collide. A hold
    is a pad rotation with a start and a goal posture.

    Args:
        problem: the problem.
        given: additions to the problem's tables that were chosen before, such as bases.
        spins: (n,) rotations of the pads about their normals that are tried [rad].
        rng: random generator.
        tell: function that is called before the search with a text on the cell's grip budget.

    Raises:
        ProposalError: an arm cannot hold the box at start and goal; the message says why.
        WorkcellError: the problem is wrong, or the payload cannot be held at rest.
    """
    start, goal = problem.poses
    known, chosen = problem.workcell(given), given
    given = merged(chosen, redundancy(problem, known))
    workcell = problem.workcell(given)
    require_hold(workcell)
    tell(budget_text(workcell))
    lacking = reach_missing(workcell, (start, goal), spins)
    if lacking:
        raise ProposalError(lacking)
    bodies = build_cell_bodies(workcell)
    judge = judge_of(bodies)
    blocked = box_blocked(judge, start, goal)
    if blocked:
        raise NoHoldError(blocked)
    handling = HandlingMotions(workcell, judge, (start, goal))
    query = HoldQuery(start, goal, spins, judge, handling=handling)
    arms = [ArmKinematics(workcell, arm) for arm in (0, 1)]
    machine = MachineKinematics(arms) if arms[0].common else None
    at_rest = query if machine is None else replace(query, common=machine.rest[: machine.common])
    tried = [[find_holds(at_rest, arm, rng) for arm in arms]]
    if machine is None:
        more = [
            more_holds(problem, query, arm, one, rng)
            for arm, one in zip(arms, tried[0], strict=True)
        ]
        tried, ranks = [[one for one, _ in more]], (more[0][1], more[1][1])
        if any(ranks):
            given = merged(chosen, redundancy(problem, known, ranks))
            workcell = problem.workcell(given)
            bodies = build_cell_bodies(workcell, bodies)
            judge = judge_of(bodies)
    held = product(tried[0][0].holds, tried[0][1].holds)
    pairs = ranked_pairs(workcell, judge, handling, held, (start, goal))
    if machine is not None and len(pairs) < ENOUGH_PAIRS:
        found, moving = machine_holds(query, arms, rng)
        tried.append([found])
        pairs += ranked_pairs(workcell, judge, handling, moving, (start, goal))
    if not pairs:
        raise ProposalError(_no_pair(query, judge, max(tried, key=_progress)))
    return Setup(given, workcell, bodies, sorted(pairs, key=lambda pair: -pair.promise))


def _progress(searches: Sequence[HoldSearch]) -> tuple[float, ...]:
    """Return a key that sorts searches for holds (pad rotations with start and goal posture) by
    their success.

    It has four numbers, larger is better: number of holds, largest share of a box path that was
    followed, number of collision-free start postures, number of start postures. The numbers are
    those of the less successful arm.

    Args:
        searches: result for each arm, or for both on common joints.
    """
    return min((len(one.holds), one.kept, one.free, one.within) for one in searches)


def box_blocked(judge: PoseJudge, start: Array, goal: Array) -> str:
    """Return a text on the bodies that the box meets at start or goal; '' for none. Arms are left
    out.

    Args:
        judge: checker of collisions.
        start: (6,) pose of the box at the start [m, rad].
        goal: (6,) pose of the box at the goal [m, rad].
    """
    found = []
    for name, pose in (("start", start), ("goal", goal)):
        for body, deep in judge.resting(pose):
            told = f"payload meets {body} at the {name}"
            allowed = "raise it, or let it rest there by [[task.allowed_contacts]]"
            found.append(told if deep else f"{told}, by less than 1 mm: {allowed}")
    return "; ".join(found)


def reach_missing(workcell: Workcell, ends: tuple[Array, Array], spins: Array) -> str:
    """Return a text on the arms that cannot reach their contacts at start or goal, and on the
    missing distance; '' if both arms reach with some rotation of their pads.

    Args:
        workcell: the cell.
        ends: start and goal pose (6,) of the box [m, rad].
        spins: (n,) rotations of the pads about their normals that are tried [rad].
    """
    found = []
    for arm, (name, pose) in product((0, 1), zip(("start", "goal"), ends, strict=True)):
        robot, contact = workcell.robots[arm], workcell.contacts[arm]
        kinematics = ArmKinematics(workcell, arm)
        T_world_box = box_placement(workcell.task.orientation, pose)
        possible = possible_spins(contact, spins)
        T = np.array([T_world_box @ kinematics.held(spin) for spin in possible])
        which = np.arange(POSTURES) % len(possible)
        q = kinematics.drawn(POSTURES, np.random.default_rng(0))
        near = kinematics.solve(q, T[which], REACH_STEPS, SEARCH_DAMPING)
        if near.residual.min() <= REACHED:
            continue
        missing = min(
            missing_reach(
                robot,
                rotate_about_normal(contact, possible[which[k]]),
                T_world_box,
                np.clip(near.q[k], *kinematics.span),
            )
            for k in np.argsort(near.residual)[:NEAREST]
        )
        if missing > MISSING:
            found.append(f"{robot.name} lacks {missing:.3f} m to its contact at the {name}")
    return "; ".join(found)


def _arm_missing(kinematics: ArmKinematics, search: HoldSearch, name: str) -> str:
    """Return a text on why the arm, or the whole machine called `name`, cannot hold the box from
    start to goal.
    """
    if not search.within:
        names = list(arm_model(kinematics.workcell.robots[kinematics.arm]).names)[1:]
        joints = ", ".join(names[joint] for joint, _ in search.joints.most_common(TOLD))
        told = f"beyond limits are most often {joints}"
        if search.manipulability or not joints:  # some are within limits
            told = manipulability_hint(kinematics, f"is at most {search.manipulability:.2g} m^3")
        return f"{name} has no usable posture at the start: {told}"
    if not search.free:
        return (
            f"{name} collides at the start in every posture: {_pairs(search.pairs)}"
            f"{_overlap_hint(search.pairs)}"
        )
    if search.pairs and search.kept >= 1.0:
        return (
            f"{name} collides in every posture that leads from the start to the goal: "
            f"{_pairs(search.pairs)}"
        )
    return (
        f"{name} follows at most {100.0 * search.kept:.0f} % of the way to the goal: "
        f"{search.stopped}"
    )


def _no_pair(query: HoldQuery, judge: PoseJudge, searches: Sequence[HoldSearch]) -> str:
    """Return a text on why both arms cannot hold the box together: an arm cannot hold it alone, or
    bodies collide only with both arms.

    Args:
        query: box poses that the arms have to hold.
        judge: checker of collisions.
        searches: result of the search for each arm, or one for both arms on common joints.
    """
    workcell = judge.geometry.workcell
    names = [robot.name for robot in workcell.robots] if len(searches) > 1 else ["the machine"]
    told = [
        _arm_missing(ArmKinematics(workcell, arm), one, names[arm])
        for arm, one in enumerate(searches)
        if not one.holds
    ]
    if told:
        return "; ".join(told)
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
    """Return a text on why no path was found: the planner's most frequent obstacle, and the
    evaluator's reasons to refuse paths.

    Args:
        pairs: pairs of holds (pad rotations with start and goal posture of both arms) with which
            paths were searched.
        refusals: reasons of the evaluator.
    """
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
    """Return a remedy for links of one robot that collide in every posture; '' if there are none.

    Args:
        met: number of collisions by pair of bodies.
    """
    owners = [[name.partition("/")[0] for name in pair if "/" in name] for pair in met]
    if not any(len(names) == 2 and names[0] == names[1] for names in owners):
        return ""
    return " (links that overlap by design are left out by srdf or [[collision.ignored]])"
