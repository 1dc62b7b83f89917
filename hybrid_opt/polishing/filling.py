"""The front between its ends: points spread along it, each found from a neighbour.

What a gap between neighbours is worth is the root of the area between them that a point could still
win, in units of the front's extent; along flat tails, where that is next to nothing, at least a
share of its length. In the widest gap a point is found by Pascoletti and Serafini's method, along
the diagonal through a point beside a neighbour that is nearly there: a continuation along the
front, each attempt the corrector of the last. Sequential quadratic programming from a neighbour's
solution and multipliers finds the same points in about three times the time.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from hybrid_opt.polishing.archive import GrowingFront
from hybrid_opt.polishing.plan import Attempt
from hybrid_opt.polishing.settings import FillSettings
from hybrid_opt.polishing.targets import Target, pascoletti_serafini
from symbolic.array import Array

TAIL = 0.125
"""Share of its length that a gap is wide at least."""

CREEP = 0.3
"""Share of its step that an attempt has to come along the front."""

Edge = tuple[bytes, bytes, bool]
"""A gap as seen from one side: decision vectors there and across, as bytes, and whether an attempt
stays near."""


@dataclass(frozen=True)
class Filling:
    """An attempt in a gap.

    Attributes:
        attempt: what it is.
        edge: the side that it starts from.
        step: how far along the front it aims, in units of its extent.
    """

    attempt: Attempt
    edge: Edge
    step: float


@dataclass(frozen=True)
class Gap:
    """Neighbours on a front: indices into the archive, and how far apart they are.

    Attributes:
        first, second: by increasing first objective.
        width: see the module.
        length: sum of the differences of both objectives, in units of the front's extent.
    """

    first: int
    second: int
    width: float
    length: float


def gaps(archive: GrowingFront) -> list[Gap]:
    """All of a front, in its order."""
    rows = archive.rows()
    scaled = np.array([archive.objectives[k] for k in rows]) / archive.span()
    sides = np.abs(np.diff(scaled, axis=0))
    lengths = sides.sum(axis=1)
    widths = np.maximum(np.sqrt(sides.prod(axis=1)), TAIL * lengths)
    ends = zip(rows[:-1], rows[1:], widths.tolist(), lengths.tolist(), strict=True)
    return [Gap(*gap) for gap in ends]


def filling(
    archive: GrowingFront, tried: Collection[Edge], settings: FillSettings
) -> Filling | None:
    """An attempt in the widest gap, from the side that was not tried.

    Where both sides' continuations failed, because the front jumps there, a gap that is far too
    wide is aimed at half way, without staying near.

    Args:
        archive: the front so far.
        tried: sides of gaps that attempts started from.

    Returns:
        The attempt; None where the front has enough points, or no side of a gap is left.
    """
    found = gaps(archive)
    if len(found) + 1 >= settings.solved:
        return None
    for gap in sorted(found, key=lambda gap: -gap.width):
        sides = (gap.first, gap.second, 1), (gap.second, gap.first, -1)
        for near in (True, False) if gap.width > settings.far else (True,):
            edges = [
                (archive.x[start].tobytes(), archive.x[across].tobytes(), near)
                for start, across, _ in sides
            ]
            step = min(gap.length / 2.0, settings.stride) if near else gap.length / 2.0
            for (start, _, sign), edge in zip(sides, edges, strict=True):
                if edge in tried or not archive.polished[start]:
                    continue
                target = _target(archive, start, sign * step)
                radius = settings.radius if near else settings.far_radius
                x, objectives = archive.x[start], archive.objectives[start]
                attempt = Attempt("gap", -1, x, objectives, target, radius, near=near)
                return Filling(attempt, edge, step)
    return None


def crept(archive: GrowingFront, filling: Filling, objectives: Array) -> bool:
    """Whether what an attempt found is hardly farther along the front than where it started."""
    moved = np.abs(objectives - filling.attempt.start) / archive.span()
    return float(moved.sum()) < CREEP * filling.step


def _target(archive: GrowingFront, k: int, step: float) -> Target:
    """From a member to a distance along the front."""
    span = archive.span()
    aside = np.array([0.5, -0.5]) * step * span
    return pascoletti_serafini(archive.objectives[k] + aside, span)
