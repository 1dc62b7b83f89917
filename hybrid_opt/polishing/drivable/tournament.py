"""Several starts of one goal, few rounds each, and only the most promising ones go on.

Successive halving (Jamieson and Talwalkar 2016): in every turn all that are left take some rounds,
and the half stays that promises more, by what it has come to and what it gained last. Those that
hardly gain any more stay behind, however good they are: they have arrived. So does one of two in
the same basin. Random starts in place of turned paths found the fast basin once in 28.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybrid_opt.polishing.drivable.point import Climb, DrivableSolver
from hybrid_opt.polishing.drivable.timed import Goal
from hybrid_opt.polishing.point import Solution
from symbolic.array import Array

STALLED = 1e-3
"""Gain of half a turn below which a climb that is nearly stationary has arrived, as a share of its
level."""

NEARLY = 1e-2
"""Residual of stationarity below which it is."""

SAME = 0.25
"""Paths nearer than this to one another lie in one basin, in halves of the variables' ranges."""


def best_of(solver: DrivableSolver, starts: Sequence[Array], goal: Goal) -> Solution:
    """The best answer from any of some decision vectors (n_var,).

    Its rounds and iterations are those of all together.
    """
    settings = solver.settings.drivable
    climbs = [Climb(solver, x, goal) for x in starts]
    left = climbs
    while len(left) > 1:
        for climb in left:
            climb.go_on(settings.turn)
        left = _promising(solver, left)
    for climb in left:
        climb.finish()
    finished = list(left)
    while (best := _best(solver, climbs)) not in finished:
        # Promises are not always kept.
        best.finish()
        finished.append(best)
    found = best.solution
    found.rounds = sum(climb.solution.rounds for climb in climbs)
    found.iterations = sum(climb.solution.iterations for climb in climbs)
    return found


def _best(solver: DrivableSolver, climbs: list[Climb]) -> Climb:
    """The one that has come farthest. A start may touch something, and one that never moved does so
    in the end."""
    sound = solver.evaluator.evaluate(np.array([climb.x for climb in climbs])).feasible
    levels = np.array([climb.level for climb in climbs])
    return climbs[int(np.lexsort((levels, ~sound))[0])]


def _promising(solver: DrivableSolver, climbs: list[Climb]) -> list[Climb]:
    """The more promising half of those that may still gain, no two in one basin."""
    n, kept, seen = len(solver.half), list[Climb](), list[Array]()
    for climb in sorted(climbs, key=_promise):
        path = climb.x[:n]
        away = min((distance(path, x, solver.half) for x in seen), default=np.inf)
        seen.append(path)
        if away > SAME and not _has_arrived(climb):
            kept.append(climb)
    return kept[: (len(climbs) + 1) // 2]


def _promise(climb: Climb) -> float:
    """The level that half a turn more leads to, should it bring what the last one brought: a start
    from afar is still behind others when it already overtakes them."""
    return climb.level - climb.last_gain if np.isfinite(climb.last_gain) else climb.level


def _has_arrived(climb: Climb) -> bool:
    nearly = climb.solution.residuals.stationarity <= NEARLY
    return climb.ended or (nearly and climb.last_gain <= STALLED * climb.level)


def distance(path: Array, other: Array, half: Array) -> float:
    """Root mean square, in halves of the variables' ranges."""
    return float(np.sqrt(np.mean(((path - other) / half) ** 2)))
