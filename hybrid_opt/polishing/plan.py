"""What the polish of a front attempts first: points of it, its ends and its middle."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from math import ceil

import numpy as np

from hybrid_opt.polishing.archive import LEAST_SPAN, GrowingFront
from hybrid_opt.polishing.records import Aim
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.targets import (
    Target,
    balance,
    epsilon_constraint,
    extreme,
    pascoletti_serafini,
)
from symbolic.array import Array


@dataclass(frozen=True)
class Attempt:
    """One attempt.

    Attributes:
        aim, parent, start: as in `hybrid_opt.polishing.records.PolishOutcome`.
        x: (n_var,) decision vector to start from.
        target, radius, wide, near, brief: see `hybrid_opt.polishing.point.SolveStart`.
    """

    aim: Aim
    parent: int
    x: Array
    start: Array
    target: Target
    radius: float
    wide: bool = False
    near: bool = False
    brief: bool = False


def points(archive: GrowingFront, settings: PolishSettings) -> list[Attempt]:
    """Evenly spread points of the front, the balanced one among them."""
    rows = archive.rows()
    count = min(len(rows), ceil(settings.attempts * settings.front.own_share))
    chosen = {rows[int(k)] for k in np.round(np.linspace(0, len(rows) - 1, count))}
    middle, _ = archive.best(None)
    if middle not in chosen and count > 2:
        inner = sorted(chosen - {rows[0], rows[-1]}, key=rows.index)
        chosen.remove(min(inner, key=lambda k: abs(rows.index(k) - rows.index(middle))))
        chosen.add(middle)
    span = archive.span()
    attempts = []
    for k in sorted(chosen, key=rows.index):
        start = archive.objectives[k]
        if settings.method == "epsilon":
            objective = int(rows.index(k) >= len(rows) / 2.0)
            target = epsilon_constraint(start, span, objective)
        else:
            target = pascoletti_serafini(start, span)
        attempts.append(
            Attempt("point", archive.parent[k], archive.x[k], start, target, settings.trust.first)
        )
    return attempts


@dataclass(frozen=True)
class PlanState:
    """How far attempts at one aim have come.

    Attributes:
        objective: whose end of the front; None for its balanced middle.
        stalled: whether the last attempt came no further.
        tried: all attempts so far, as objective and bytes of the start.
    """

    objective: int | None
    stalled: bool
    tried: Collection[tuple[int | None, bytes]]


Kick = Callable[[Array, int], tuple[Array, Array] | None]
"""From a decision vector and the objective that matters to another start and its objectives; None
where none was found."""


def aimed(
    archive: GrowingFront,
    state: PlanState,
    settings: PolishSettings,
    kick: Kick,
    rng: np.random.Generator,
) -> Attempt:
    """An attempt at an end of the front or at its balanced middle.

    It goes on from the best point. Where that was tried, or came no further, ends start from a kick
    away from it: they lie in several basins. The middle starts from any other point then, those
    that are dominated by now included.
    """
    objective, stalled, tried = state.objective, state.stalled, state.tried
    radius, k = settings.trust.first, archive.best(objective)[0]
    fresh = [row for row, x in enumerate(archive.x) if (objective, x.tobytes()) not in tried]
    span = np.full(2, LEAST_SPAN)
    away = stalled or k not in fresh
    if away and objective is not None and (kicked := kick(archive.x[k], objective)) is not None:
        x, start = kicked
        return Attempt("extreme", -1, x, start, extreme(start, span, objective), radius)
    if away and fresh:
        k = fresh[int(rng.integers(len(fresh)))]
    elif not fresh:
        radius = settings.front.small_radius
    start = archive.objectives[k]
    if objective is None:
        return Attempt("balance", -1, archive.x[k], start, balance(start, span), radius)
    target = extreme(start, span, objective)
    return Attempt("extreme", -1, archive.x[k], start, target, radius, wide=away)


def finishing(archive: GrowingFront, objective: int | None, settings: PolishSettings) -> Attempt:
    """An attempt from the best point at an end, or at the balanced middle, to the last digits."""
    k, span = archive.best(objective)[0], archive.span()
    x, start, radius = archive.x[k], archive.objectives[k], settings.fill.radius
    if objective is None:
        return Attempt("balance", -1, x, start, balance(start, span), radius, near=True)
    return Attempt("extreme", -1, x, start, extreme(start, span, objective), radius, near=True)
