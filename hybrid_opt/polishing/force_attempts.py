"""Attempts to improve a front of both peak forces: where each starts, and at which point it aims.

An attempt improves a point of the front relative to its own start, lowers one force alone or the
larger of both, or aims into a gap between two neighbours.

The width of a gap is the root of the area between its neighbours that a point can still dominate
[front's extent]; along flat tails, where that is next to nothing, at least a share of its length.
In a gap the scalarisation of Pascoletti and Serafini finds a point along the diagonal, from a
neighbour: a continuation along the front, each attempt the corrector of the last. Sequential
quadratic programming from a neighbour's solution and multipliers finds the same points in about
three times the time. The best carries of one basin hardly deviate from the straight line between
two neighbours' decision vectors, the chord: the error grows with the square of its length. The full
model's points on a chord are nearly as good as those of a solve, and cost a fiftieth.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from math import ceil

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.force import (
    Scalarisation,
    SolveMode,
    pascoletti_serafini,
    scalarisation_for,
)
from hybrid_opt.polishing.front import (
    LEAST_SPAN,
    OWN_SHARE,
    Aim,
    Attempt,
    ParetoArchive,
)
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.starts import Start
from symbolic.array import Array, evenly

RADIUS, SMALL_RADIUS, NEAR_RADIUS = 1.0, 0.1, 0.4
"""First radii of trust regions [half ranges of the decision variables]: the usual one, that after
an attempt without progress, and that from a neighbour on the front."""

STRIDE = 0.2
"""Largest distance along the front from a neighbour to the aim of an attempt [front's extent]."""

FAR_GAP = 0.1
"""Width above which a gap is far too wide: it is also tried with a large radius if no neighbour
leads into it [front's extent]."""

TAIL = 0.125
"""Least width of a gap as a share of its length."""

LITTLE_PROGRESS = 0.3
"""Share of its intended step along the front below which an attempt counts as having made little
progress."""

CHORD = 16
"""Number of points that are evaluated on each chord."""

Edge = tuple[bytes, bytes, bool]
"""One side of a gap: the decision vectors on this side and on the other side, as bytes, and whether
the attempt is near."""

Chord = tuple[bytes, bytes]
"""Ends of a chord, sorted by the first objective: decision vectors as bytes."""

Perturbation = Callable[[Array, int], tuple[Array, Array] | None]
"""Function from a decision vector and an objective to a perturbed start and its objectives, or
None."""


@dataclass(frozen=True)
class ForceAttempt(Attempt):
    """An attempt to improve a front by one solve of `hybrid_opt.polishing.force.ForceSolver`.

    Attributes:
        target: scalarisation of both peak forces that is minimised.
        radius: radius of the first trust region [half ranges of the decision variables].
        mode: effort of the solve.
    """

    target: Scalarisation
    radius: float = RADIUS
    mode: SolveMode = "usual"


def front_attempts(archive: ParetoArchive, settings: PolishSettings) -> list[ForceAttempt]:
    """Return attempts to improve evenly spread points of a front, among them the balanced point."""
    rows = archive.front_indices()
    count = min(len(rows), ceil(settings.attempts * OWN_SHARE))
    chosen = {rows[k] for k in evenly(len(rows), count)}
    middle, _ = archive.best(None)
    if middle not in chosen and count > 2:
        inner = sorted(chosen - {rows[0], rows[-1]}, key=rows.index)
        chosen.remove(min(inner, key=lambda k: abs(rows.index(k) - rows.index(middle))))
        chosen.add(middle)
    span = archive.span()
    attempts = []
    for k in sorted(chosen, key=rows.index):
        start = archive.objectives[k]
        target = pascoletti_serafini(start, span)
        attempts.append(ForceAttempt("point", archive.parent[k], archive.x[k], start, target))
    return attempts


def extreme_attempt(
    archive: ParetoArchive,
    objective: int | None,
    tried: Collection[tuple[int | None, bytes]],
    stalled: bool,
    perturb: Perturbation,
    rng: np.random.Generator,
) -> ForceAttempt:
    """Return an attempt at an end of the front or at its balanced middle.

    The attempt starts from the best known point. It starts elsewhere if that start was tried
    already, or if the last attempt brought no progress:

    - At an end: from the best feasible one of random perturbations of the best point, because ends
      may have several local optima.
    - At the middle, or if no perturbation is feasible: from a random untried point of the archive,
      which may be dominated.

    If every point was tried, it starts from the best point again with a small trust region.

    Args:
        archive: the points of the front and other known points.
        objective: index of the objective that is least at the end; None for the balanced middle.
        tried: objective (None for the middle) and start, as bytes, of all attempts so far.
        stalled: True if the last attempt brought no progress.
        perturb: function from a decision vector and an objective to a perturbed start, None if
            there is none.
        rng: generator that chooses the untried point.
    """
    radius, k = RADIUS, archive.best(objective)[0]
    fresh = [row for row, x in enumerate(archive.x) if (objective, x.tobytes()) not in tried]
    span, away = np.full(2, LEAST_SPAN), stalled or k not in fresh
    if away and objective is not None and (found := perturb(archive.x[k], objective)) is not None:
        x, start = found
        return ForceAttempt("extreme", -1, x, start, scalarisation_for(start, span, objective))
    if away and fresh:
        k = fresh[int(rng.integers(len(fresh)))]
    elif not fresh:
        radius = SMALL_RADIUS
    x, start = archive.x[k], archive.objectives[k]
    target = scalarisation_for(start, span, objective)
    if objective is None:
        return ForceAttempt("balance", -1, x, start, target, radius)
    return ForceAttempt("extreme", -1, x, start, target, radius, "wide" if away else "usual")


def refinement_attempt(archive: ParetoArchive, objective: int | None) -> ForceAttempt:
    """Return an attempt that starts at the end or middle of the front and solves to high accuracy.

    Args:
        archive: the front so far.
        objective: index of the objective that is least at the end; None for the balanced middle.
    """
    k, span = archive.best(objective)[0], archive.span()
    x, start = archive.x[k], archive.objectives[k]
    target = scalarisation_for(start, span, objective)
    aim: Aim = "balance" if objective is None else "extreme"
    return ForceAttempt(aim, -1, x, start, target, NEAR_RADIUS, "near")


def probe_attempt(start: Start, objective: int | None) -> ForceAttempt:
    """Return an attempt with a short solve towards an end of the front or its balanced middle.

    Args:
        start: feasible candidate from which the solve starts.
        objective: index of the objective that is least at the end; None for the balanced middle.
    """
    target = scalarisation_for(start.objectives, np.full(2, LEAST_SPAN), objective)
    return ForceAttempt("probe", -1, start.x, start.objectives, target, mode="brief")


def better_half(reached: list[Start], objective: int | None) -> list[Start]:
    """Return the better half of some candidates, rounded down, the best first.

    Args:
        reached: the candidates.
        objective: index of the objective by which they are compared; None for the sum of both
            objectives.
    """
    ranked = sorted(reached, key=lambda start: start.value(objective))
    return ranked[: len(reached) // 2]


@dataclass(frozen=True)
class GapAttempt:
    """An attempt to find a point in a gap of the front.

    Attributes:
        attempt: the solve.
        edge: the side of the gap from which the solve starts.
        step: distance along the front from the start to the point that is aimed at [front's
            extent].
    """

    attempt: ForceAttempt
    edge: Edge
    step: float


@dataclass(frozen=True)
class ForceGap:
    """A gap between two neighbouring points of a front.

    Attributes:
        first, second: indices of both points in the archive, sorted by the first objective.
        width: square root of the area that a point in the gap can still dominate, at least a share
            of the length [front's extent].
        length: sum of the differences of both objectives [front's extent].
    """

    first: int
    second: int
    width: float
    length: float


def gaps(archive: ParetoArchive) -> list[ForceGap]:
    """Return the gaps between neighbouring points of a front, sorted by the first objective."""
    rows = archive.front_indices()
    scaled = np.array([archive.objectives[k] for k in rows]) / archive.span()
    sides = np.abs(np.diff(scaled, axis=0))
    lengths = sides.sum(axis=1)
    widths = np.maximum(np.sqrt(sides.prod(axis=1)), TAIL * lengths)
    ends = zip(rows[:-1], rows[1:], widths.tolist(), lengths.tolist(), strict=True)
    return [ForceGap(*gap) for gap in ends]


def gap_attempt(
    archive: ParetoArchive,
    tried: Collection[Edge],
    solved: int,
    *,
    stride: float = STRIDE,
    far: float = FAR_GAP,
) -> GapAttempt | None:
    """Return an attempt to add a point to the widest gap of the front that is not given up yet.

    An attempt starts at an end of the gap and aims at a point a small distance away. Each end is
    tried once. If both ends were tried and the gap is still wider than `far`, the front may jump
    there; then attempts from both ends aim at the gap's middle, with a large radius. After that the
    gap is given up.

    Args:
        archive: the points of the front and other known points.
        tried: starts of earlier attempts: decision vectors of the start and of the gap's other end,
            as bytes, and True for a small distance.
        solved: number of points with which the front is complete.
        stride: largest distance along the front from the start to the point that is aimed at
            [front's extent].
        far: width of a gap above which the large radius is tried [front's extent].

    Returns:
        The attempt; None if the front is complete, or all gaps are given up.
    """
    found = gaps(archive)
    if len(found) + 1 >= solved:
        return None
    for gap in sorted(found, key=lambda gap: -gap.width):
        sides = (gap.first, gap.second, 1), (gap.second, gap.first, -1)
        for near in (True, False) if gap.width > far else (True,):
            edges = [
                (archive.x[start].tobytes(), archive.x[across].tobytes(), near)
                for start, across, _ in sides
            ]
            step = min(gap.length / 2.0, stride) if near else gap.length / 2.0
            for (start, _, sign), edge in zip(sides, edges, strict=True):
                if edge in tried or not archive.polished[start]:
                    continue
                target = _target(archive, start, sign * step)
                radius = NEAR_RADIUS if near else RADIUS
                x, objectives = archive.x[start], archive.objectives[start]
                mode: SolveMode = "near" if near else "usual"
                attempt = ForceAttempt("gap", -1, x, objectives, target, radius, mode)
                return GapAttempt(attempt, edge, step)
    return None


def made_little_progress(
    archive: ParetoArchive, gap_attempt: GapAttempt, objectives: Array
) -> bool:
    """Return True if the result of an attempt to fill a gap lies less than the share
    `LITTLE_PROGRESS` of the wanted distance away from its start.

    Args:
        archive: the front so far.
        gap_attempt: the attempt.
        objectives: (2,) objectives of the result.
    """
    moved = np.abs(objectives - gap_attempt.attempt.start) / archive.span()
    return float(moved.sum()) < LITTLE_PROGRESS * gap_attempt.step


def _target(archive: ParetoArchive, k: int, step: float) -> Scalarisation:
    """Return the scalarisation that aims at a point beside point `k` of the archive, at the signed
    distance `step` [front's extent]. If `step` is positive, the point aimed at has a larger first
    and a smaller second objective."""
    span = archive.span()
    aside = np.array([0.5, -0.5]) * step * span
    return pascoletti_serafini(archive.objectives[k] + aside, span)


def widest_untried_gap(archive: ParetoArchive, tried: Collection[Chord]) -> ForceGap | None:
    """Return the widest gap between two polished neighbours on the front that was not tried yet.

    `ForceGap.width` measures gaps in the space of objectives.

    Args:
        archive: the front so far.
        tried: gaps that were tried, as `chord_across` returns them.

    Returns:
        The gap, or None if all were tried.
    """
    for gap in sorted(gaps(archive), key=lambda gap: -gap.width):
        is_polished = archive.polished[gap.first] and archive.polished[gap.second]
        if is_polished and chord_across(archive, gap) not in tried:
            return gap
    return None


def chord_across(archive: ParetoArchive, gap: ForceGap) -> Chord:
    """Return the decision vectors on both sides of a gap as bytes, by which a tried gap is
    recognised.
    """
    return archive.x[gap.first].tobytes(), archive.x[gap.second].tobytes()


def best_on_chord(
    evaluator: CandidateEvaluator, archive: ParetoArchive, gap: ForceGap
) -> tuple[Array, Array] | None:
    """Evaluate points on the straight line between the decision vectors of a gap's two neighbours.

    Args:
        evaluator: evaluator of candidates by the full model.
        archive: the front so far.
        gap: the gap.

    Returns:
        Decision vector (n_var,) and objectives (2,) of the feasible point that dominates the
        largest area of the gap in the space of objectives; None if all points are dominated or
        infeasible.
    """
    share = np.arange(1, CHORD + 1)[:, None] / (CHORD + 1)
    x = (1.0 - share) * archive.x[gap.first] + share * archive.x[gap.second]
    found = evaluator.evaluate(x)
    corner = archive.objectives[gap.second][0], archive.objectives[gap.first][1]
    won = np.maximum(np.array(corner) - found.objectives, 0.0).prod(axis=1)
    won[~found.feasible] = 0.0
    best = int(won.argmax())
    if won[best] == 0.0 or archive.dominates(found.objectives[best]):
        return None
    return x[best], found.objectives[best]
