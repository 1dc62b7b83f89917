"""Front of both peak forces: its points, its ends, its middle and its gaps.

Points of the front are improved first, each relative to its own start, so that neither objective
gets worse. From the improved ones solves continue to the ends of the front and to its balanced
middle, and then along the front into the widest gaps between neighbours.

The width of a gap is the root of the area between its neighbours that a point can still dominate
[front's extent]; along flat tails, where that is next to nothing, at least a share of its length.
In the widest gap the scalarisation of Pascoletti and Serafini finds a point along the diagonal,
from a neighbour: a continuation along the front, each attempt the corrector of the last. Sequential
quadratic programming from a neighbour's solution and multipliers finds the same points in about
three times the time. The best carries of one basin hardly deviate from the straight line between
two neighbours' decision vectors, the chord: the error grows with the square of its length. The full
model's points on a chord are nearly as good as those of a solve, and cost a fiftieth.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial
from math import ceil

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator, Evaluations
from hybrid_opt.polishing.cell import SmoothCell
from hybrid_opt.polishing.force import (
    ForceSolver,
    Scalarisation,
    SolveMode,
    pascoletti_serafini,
    scalarisation_for,
)
from hybrid_opt.polishing.front import (
    IMPROVEMENT_TOLERANCE,
    LEAST_SPAN,
    OWN_SHARE,
    Aim,
    Attempt,
    ParetoArchive,
    Polisher,
    PolishOutcome,
    PolishRun,
    Solution,
    Status,
)
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.starts import Start, mirror_of, perturb_start, random_starts
from symbolic.array import Array, evenly

LEAST_MEMBER_SHARE = 0.9
"""Share of the wanted number of points with which a front counts as complete."""

LEAST_PROGRESS = 2e-5
"""Least gain of an attempt that counts as progress [reference force]."""

MIDDLE_STALLS = 1
"""Number of successive attempts at the balanced middle without progress after which no further one
is made."""

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


class ForceRun(PolishRun[ForceAttempt]):
    """State of the polish of one front of both peak forces while it runs."""

    def __init__(
        self,
        solver: ForceSolver,
        settings: PolishSettings,
        archive: ParetoArchive,
        on_progress: Callable[[int, int], None],
    ) -> None:
        super().__init__(solver.cell.evaluator, settings, archive, on_progress)
        self._solver, self._mirror = solver, mirror_of(solver.cell.workcell)
        self._tried: set[tuple[int | None, bytes]] = set()
        self._stalls: dict[int | None, int] = {0: 0, 1: 0, None: 0}
        self._unproven = set[bytes]()
        self._probed = set[bytes]()
        self._ahead = 0

    def _solve(self, attempt: ForceAttempt) -> Solution:
        found = self._solver.solve(attempt.x, attempt.target, attempt.radius, attempt.mode)
        # Ends and middles have a finer scale of their own.
        unit = float((attempt.target.span / self._archive.span()).max())
        found.residuals = found.residuals.scaled(unit)
        return found

    def attempts(self, rng: np.random.Generator) -> Iterator[ForceAttempt]:
        """Yield all attempts of the polish.

        Attempts improve points of the front first. Short solves then look for better basins far
        from the front. Attempts at the ends and the middle of the front follow in turns, and
        attempts in its gaps last. For a symmetric cell the mirror image of each result is added at
        once. Mirror images, and points on the lines across gaps, are certified at the end.

        Args:
            rng: generator of random starts.
        """
        first, fill = front_attempts(self._archive, self._settings), self._settings.fill
        self._ahead = max(self._attempts_left() - len(first), 0)
        aims = (0, 1, None) if self._mirror is None else (0, None)
        later = len(aims) + min(fill.solved, fill.attempts * self._settings.attempts)
        probes = sum(max(2 * self._starts(objective) - 1, 0) for objective in aims)
        self._announce(self._attempts_left() + probes + later)
        yield from first
        for objective in aims:
            yield from self._probes(objective, rng)
        self._announce(self._attempts_left() + later)
        while self._attempts_left() > 0:
            yield from self._ends((0, 1), rng)
            if self._stalls[None] < MIDDLE_STALLS:
                yield from self._ends((None,), rng)
        for objective in aims:
            self._most_attempts += 1
            yield refinement_attempt(self._archive, objective)
        probed = self._remove_probes()
        yield from self._gaps(fill.solved)
        self._restore_probes(probed)
        self._certify_unproven()
        if len(self._archive.front_indices()) < LEAST_MEMBER_SHARE * fill.members:
            # Chords lead nowhere, or where nothing is proven.
            yield from self._gaps(fill.members)
            self._certify_unproven()

    def _probes(self, objective: int | None, rng: np.random.Generator) -> Iterator[ForceAttempt]:
        """Yield short solves far from the front, by successive halving.

        The first ones start from random feasible candidates and from the best known point, the next
        ones from the better half of the results, until one is left.

        Args:
            objective: index of the objective that is least at the end of the front; None for its
                balanced middle.
            rng: generator of random starts.
        """
        count = self._starts(objective)
        if not count:
            return
        k = self._archive.best(objective)[0]
        pool = [Start(self._archive.x[k], self._archive.objectives[k])]
        pool += random_starts(self._evaluator, count - 1, rng)
        while pool:
            reached = []
            for start in pool:
                end = start
                if not start.is_exhausted:
                    self._most_attempts += 1
                    yield probe_attempt(start, objective)
                    found = self.outcomes[-1]
                    end = Start(found.x, found.objectives, found.status != "accepted")
                reached.append(end)
            pool = better_half(reached, objective)

    def _starts(self, objective: int | None) -> int:
        """Return the number of starts of short solves towards a part of the front, at most twice
        the number of remaining attempts.

        Args:
            objective: index of the objective that is least at the end of the front; None for its
                balanced middle.
        """
        probe = self._settings.probe
        count = probe.starts if self._mirror is not None else (probe.starts + 1) // 2
        return min(2 * self._ahead, probe.middle_starts if objective is None else count)

    def _remove_probes(self) -> list[tuple[Array, Array]]:
        """Remove the results of probes (short solves from random starts) from the archive.

        The best points at both ends and in the middle of the front stay. The other results are not
        optimal, and would occupy gaps that further attempts shall fill.

        Returns:
            Decision vector (n_var,) and objectives (2,) of each removed point.
        """
        archive = self._archive
        kept = {archive.best(objective)[0] for objective in (0, 1, None)}
        probed = [k for k, x in enumerate(archive.x) if x.tobytes() in self._probed]
        left = [k for k in probed if k not in kept]
        found = [(archive.x[k], archive.objectives[k]) for k in left]
        archive.drop(left)
        return found

    def _restore_probes(self, probed: list[tuple[Array, Array]]) -> None:
        """Add removed results of probes again where the front needs them.

        It needs them in gaps wider than `FAR_GAP` and beyond its ends. If the front has fewer
        points than wanted, all non-dominated results are added.

        Args:
            probed: decision vector (n_var,) and objectives (2,) of each removed point.
        """
        for x, objectives in probed:
            wanted = self._is_short or self._is_far(objectives)
            if wanted and not self._archive.dominates(objectives):
                self._archive.add(x, objectives)

    @property
    def _is_short(self) -> bool:
        return len(self._archive.front_indices()) < self._settings.fill.members

    def _is_far(self, objectives: Array) -> bool:
        """Return True if objectives (2,) lie beyond the front's ends or in a gap over `FAR_GAP`."""
        f = [self._archive.objectives[k][0] for k in self._archive.front_indices()]
        following = int(np.searchsorted(f, objectives[0]))
        if following in (0, len(f)):
            return True
        return gaps(self._archive)[following - 1].width > FAR_GAP

    def _gaps(self, solved: int) -> Iterator[ForceAttempt]:
        """Yield attempts that fill gaps, until the front has `solved` points or attempts started at
        both ends of every gap. Then add points on the straight lines between the decision vectors
        of the gaps' ends.
        """
        tried: set[Edge] = set()
        self._most_attempts += self._settings.fill.attempts * self._settings.attempts
        while self._attempts_left() > 0:
            found = gap_attempt(self._archive, tried, solved)
            if found is None:
                break
            self._announce(min(self._attempts_left(), solved - len(self._archive.front_indices())))
            tried |= {found.edge, self._reflected(found.edge)}
            yield found.attempt
            outcome = self.outcomes[-1]
            if outcome.status == "accepted" and made_little_progress(
                self._archive, found, outcome.objectives
            ):
                edge = outcome.x.tobytes(), *found.edge[1:]
                tried |= {edge, self._reflected(edge)}
        self._fill_by_chords()

    def _fill_by_chords(self) -> None:
        archive, tried = self._archive, set[Chord]()
        while self._is_short and (gap := widest_untried_gap(archive, tried)) is not None:
            first, second = chord_across(archive, gap)
            image = self._reflected_bytes(second), self._reflected_bytes(first)
            tried |= {(first, second), image}
            found = best_on_chord(self._evaluator, archive, gap)
            if found is not None:
                archive.add(*found)
                self._unproven.add(found[0].tobytes())
                self._add_image(found[0])

    def _reflected(self, edge: Edge) -> Edge:
        """Return the mirror image of an end of a gap, from which an attempt starts; `edge` itself
        for a cell without mirror symmetry.
        """
        start, across, near = edge
        return self._reflected_bytes(start), self._reflected_bytes(across), near

    def _reflected_bytes(self, x: bytes) -> bytes:
        image = self._image(np.frombuffer(x))
        return x if image is None else image.tobytes()

    def _image(self, x: Array) -> Array | None:
        return None if self._mirror is None else self._mirror.image(x)

    def _classify(
        self, attempt: ForceAttempt, answer: Solution, objectives: Array
    ) -> tuple[Status, str, Array]:
        gain = attempt.start - objectives
        if attempt.aim == "point":
            if gain.min() < -IMPROVEMENT_TOLERANCE:
                return "rejected", "an objective became worse", attempt.start
            if gain.max() <= IMPROVEMENT_TOLERANCE:
                return self._not_improved(answer, attempt)
        elif attempt.aim == "probe":
            # Kept even if dominated: solves may continue from it.
            if gain.max() <= IMPROVEMENT_TOLERANCE:
                return self._not_improved(answer, attempt)
        elif self._archive.dominates(objectives):
            return "rejected", "dominated", attempt.start
        return "accepted", "", objectives

    def _record(self, attempt: ForceAttempt, outcome: PolishOutcome) -> None:
        super()._record(attempt, outcome)
        if outcome.status == "accepted":
            if attempt.mode == "brief":
                self._unproven.add(outcome.x.tobytes())
                self._probed |= {outcome.x.tobytes(), self._reflected_bytes(outcome.x.tobytes())}
            self._add_image(outcome.x)

    def _evaluate(self, attempt: ForceAttempt, x: Array) -> Evaluations:
        """Evaluate the result x (n_var,) of an attempt by the full model, and certify it unless it
        results from a probe. Results of probes are certified later, if they remain on the front.
        """
        if attempt.mode == "brief":
            return self._evaluator.evaluate(x)
        return super()._evaluate(attempt, x)

    def _add_image(self, x: Array) -> None:
        if (image := self._image(x)) is None:
            return
        found = self._evaluator.evaluate(image)
        if found.feasible[0] and not self._archive.dominates(found.objectives[0]):
            self._archive.add(image, found.objectives[0])
            self._unproven.add(image.tobytes())

    def _certify_unproven(self) -> None:
        """Certify the front's points that are not certified yet, and remove those that collide
        between the samples, until all points of the front are certified."""
        while standing := [
            k
            for k in self._archive.front_indices()
            if self._archive.x[k].tobytes() in self._unproven
        ]:
            x = np.array([self._archive.x[k] for k in standing])
            proven = self._evaluator.certified(self._evaluator.evaluate(x)).feasible
            self._unproven -= {row.tobytes() for row in x[proven]}
            self._archive.drop([k for k, good in zip(standing, proven, strict=True) if not good])

    def _ends(
        self, objectives: tuple[int | None, ...], rng: np.random.Generator
    ) -> Iterator[ForceAttempt]:
        """Yield one attempt at each of the given ends of the front.

        After each attempt, update the number of successive attempts at this end without progress.

        Args:
            objectives: index of the objective that is least at each end; None for the balanced
                middle.
            rng: generator of perturbed starts.
        """
        perturb = partial(perturb_start, self._evaluator, rng=rng)
        for objective in objectives:
            before, stalls = self._archive.best(objective)[1], self._stalls[objective]
            attempt = extreme_attempt(
                self._archive, objective, self._tried, stalls > 0, perturb, rng
            )
            self._tried.add((objective, attempt.x.tobytes()))
            if (image := self._image(attempt.x)) is not None:
                self._tried.add((None if objective is None else 1 - objective, image.tobytes()))
            yield attempt
            gained = self._archive.best(objective)[1] < before - LEAST_PROGRESS
            self._stalls[objective] = 0 if gained else stalls + 1


class ForcePolisher(Polisher):
    """Polishes fronts of both peak forces."""

    def __init__(
        self, evaluator: CandidateEvaluator, settings: PolishSettings, functions: PolishFunctions
    ) -> None:
        super().__init__(evaluator, settings)
        self._solver = ForceSolver(SmoothCell(evaluator, functions, settings.clearance), settings)

    @property
    def solver_name(self) -> str:
        """Name of the solver of the programs, see `PolishedFront.solver`."""
        return self.settings.solver

    def new_run(
        self, archive: ParetoArchive, on_progress: Callable[[int, int], None], paths: Array
    ) -> ForceRun:
        """Return the polish of one front, see `Polisher.new_run`; it uses no known paths."""
        return ForceRun(self._solver, self.settings, archive, on_progress)
