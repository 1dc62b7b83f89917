"""Front of both peak forces: its points, its ends, its middle and its gaps.

Points of the front are improved first, each relative to its own start, so that neither objective
gets worse. From the improved ones solves continue to the ends of the front and to its balanced
middle, and then along the front into the widest gaps between neighbours
(`hybrid_opt.polishing.force_attempts`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator, Evaluations
from hybrid_opt.polishing.cell import SmoothCell
from hybrid_opt.polishing.force import (
    ForceSolver,
)
from hybrid_opt.polishing.force_attempts import (
    FAR_GAP,
    Chord,
    Edge,
    ForceAttempt,
    best_on_chord,
    better_half,
    chord_across,
    extreme_attempt,
    front_attempts,
    gap_attempt,
    gaps,
    made_little_progress,
    probe_attempt,
    refinement_attempt,
    widest_untried_gap,
)
from hybrid_opt.polishing.front import (
    IMPROVEMENT_TOLERANCE,
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
from symbolic.array import Array

LEAST_MEMBER_SHARE = 0.9
"""Share of the wanted number of points with which a front counts as complete."""

LEAST_PROGRESS = 2e-5
"""Least gain of an attempt that counts as progress [reference force]."""

MIDDLE_STALLS = 1
"""Number of successive attempts at the balanced middle without progress after which no further one
is made."""


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
