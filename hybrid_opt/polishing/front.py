"""The polish of a whole front: its points, its ends, its middle and its gaps.

Points of the front are improved first, each against its own start, so that neither objective gets
worse. From the improved ones the solver goes on to the ends of the front and to its balanced
middle, and then along the front into the widest gaps between neighbours. Every answer is judged by
the full evaluator and certified between the samples before it is believed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.evaluations import Evaluations
from hybrid_opt.evaluate.objectives import FORCE_PAIRS, ROBUST_OBJECTIVES
from hybrid_opt.polishing.archive import GrowingFront
from hybrid_opt.polishing.attempt import Lost
from hybrid_opt.polishing.chords import Chord, between, chord_of, widest
from hybrid_opt.polishing.filling import Edge, crept, filling, gaps
from hybrid_opt.polishing.functions import PolishFunctions, polish_functions
from hybrid_opt.polishing.kick import kicked
from hybrid_opt.polishing.mirror import mirror_of
from hybrid_opt.polishing.plan import Attempt, PlanState, aimed, finishing, points
from hybrid_opt.polishing.point import PolishSolver, Solution, SolveStart
from hybrid_opt.polishing.probing import Start, halve, random_starts
from hybrid_opt.polishing.records import PolishedFront, PolishOutcome
from hybrid_opt.polishing.run import Polisher, PolishRun
from hybrid_opt.polishing.settings import PolishSettings
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell


def knows_forces(workcell: Workcell, objectives: Sequence[str]) -> bool:
    """Whether the pads' forces are known: planned ones of any pads, robust ones of two round pads
    that face one another."""
    return workcell.has_facing_pads or tuple(objectives) != ROBUST_OBJECTIVES


ENOUGH = 0.9
"""Share of the points that a front is to have with which it is left."""


class FrontPolisher(Polisher):
    """Polishes fronts of one evaluator. A resource: keep it for several fronts."""

    def __init__(
        self,
        evaluator: CandidateEvaluator,
        settings: PolishSettings,
        functions: PolishFunctions | None = None,
    ) -> None:
        """Load or build the smooth problem's functions.

        Raises:
            SettingsError: the evaluator's objectives are not both peak forces, planned or robust,
                its pads do not close their grasp, or robust forces are those of other pads than two
                round ones that face one another.
            DualArmError: the functions cannot be built.
        """
        if evaluator.objective_names not in FORCE_PAIRS:
            named = " or ".join(" and ".join(pair) for pair in FORCE_PAIRS)
            raise SettingsError(
                f"the polish minimises {named}; the objectives are "
                f"{', '.join(evaluator.objective_names)}: switch the polish off for them"
            )
        if not knows_forces(evaluator.workcell, evaluator.objective_names):
            raise SettingsError(
                "the polish of robust forces knows two round pads that face one another, and no "
                "others: switch it off"
            )
        super().__init__(evaluator, settings)
        known = functions or polish_functions(evaluator.compiled)
        self.solver = PolishSolver(evaluator, known, settings)

    def _run(
        self,
        archive: GrowingFront,
        recorded: list[PolishOutcome | Lost],
        emit: Callable[[PolishOutcome], None],
        paths: Array,
    ) -> ForceRun:
        return ForceRun(self, archive, recorded, emit)


class ForceRun(PolishRun[Attempt]):
    """The polish of both peak forces."""

    def __init__(
        self,
        polisher: FrontPolisher,
        archive: GrowingFront,
        recorded: list[PolishOutcome | Lost],
        emit: Callable[[PolishOutcome], None],
    ) -> None:
        super().__init__(polisher.evaluator, polisher.settings, archive, recorded, emit)
        self._solver, self._mirror = polisher.solver, mirror_of(polisher.evaluator.workcell)
        self._tried: set[tuple[int | None, bytes]] = set()
        self._stalls: dict[int | None, int] = {0: 0, 1: 0, None: 0}
        self._unproven = set[bytes]()
        self._probed = set[bytes]()
        self._ahead = 0

    def _solution(self, attempt: Attempt) -> Solution:
        how = attempt.wide, attempt.near, attempt.brief
        found = self._solver.solve(SolveStart(attempt.x, attempt.target, attempt.radius, *how))
        # Ends and middles have a finer scale of their own.
        unit = float((attempt.target.span / self._archive.span()).max())
        found.residuals = found.residuals.scaled(unit)
        return found

    def all(self, rng: np.random.Generator) -> None:
        """The front's points, then probes far from it, then ends and middle in turns while attempts
        last; then what lies between. Mirror images are taken in all the way, and certified together
        with points on chords in the end."""
        self._do(points(self._archive, self._settings))
        self._ahead = self._left()
        aims = (0, 1, None) if self._mirror is None else (0, None)
        for objective in aims:
            self._probe(objective, rng)
        while self._left() > 0:
            self._turn((0, 1), rng)
            if self._stalls[None] < self._settings.front.middle_stalls:
                self._turn((None,), rng)
        for objective in aims:
            self._most += 1
            self._do([finishing(self._archive, objective, self._settings)])
        probed = self._without_probes()
        self._fill(self._settings.fill.solved)
        self._take_back(probed)
        self._certify_unproven()
        if len(self._archive.rows()) < ENOUGH * self._settings.fill.members:
            # Chords lead nowhere, or where nothing is proven.
            self._fill(self._settings.fill.members)
            self._certify_unproven()

    def _probe(self, objective: int | None, rng: np.random.Generator) -> None:
        """Short solves from random feasible candidates and from the front's best point, then again
        from the better half of what they reached, until one is left. Never from more starts than
        twice the attempts that are ahead."""
        probe = self._settings.probe
        count = probe.starts if self._mirror is not None else (probe.starts + 1) // 2
        count = min(2 * self._ahead, probe.middle_starts if objective is None else count)
        if not count:
            return
        k = self._archive.best(objective)[0]
        pool = [Start(self._archive.x[k], self._archive.objectives[k])]
        pool += random_starts(self._evaluator, self._settings, count - 1, rng)

        def solve(start: Start) -> Start:
            self._most += 1
            self._do([start.probe(objective, self._settings)])
            outcome = self.outcomes[-1]
            return Start(outcome.x, outcome.objectives, spent=outcome.status != "accepted")

        halve(pool, objective, solve)

    def _without_probes(self) -> list[tuple[Array, Array]]:
        """Take out what probes reached, but for the ends and the middle: cut short on purpose, they
        would stand where a gap is to be filled."""
        archive = self._archive
        kept = {archive.best(objective)[0] for objective in (0, 1, None)}
        probed = [k for k, x in enumerate(archive.x) if x.tobytes() in self._probed]
        left = [k for k in probed if k not in kept]
        found = [(archive.x[k], archive.objectives[k]) for k in left]
        archive.drop(left)
        return found

    def _take_back(self, probed: list[tuple[Array, Array]]) -> None:
        """What lies in gaps that stayed far too wide is not given up, nor what a front lacks."""
        for x, objectives in probed:
            wanted = self._is_short or self._is_far(objectives)
            if wanted and not self._archive.dominates(objectives):
                self._archive.add(x, objectives)

    @property
    def _is_short(self) -> bool:
        """Whether the front has fewer points than it is to have."""
        return len(self._archive.rows()) < self._settings.fill.members

    def _is_far(self, objectives: Array) -> bool:
        """Whether a point lies beyond the ends of the front, or in a gap that is far too wide."""
        f = [self._archive.objectives[k][0] for k in self._archive.rows()]
        place = int(np.searchsorted(f, objectives[0]))
        if place in (0, len(f)):
            return True
        return gaps(self._archive)[place - 1].width > self._settings.fill.far

    def _fill(self, solved: int) -> None:
        """Attempts between the ends, until the front has so many points or no side of a gap is
        left; then points on chords between neighbours."""
        tried: set[Edge] = set()
        self._most += self._settings.fill.attempts * self._settings.attempts
        while self._left() > 0:
            found = filling(self._archive, tried, replace(self._settings.fill, solved=solved))
            if found is None:
                break
            tried |= {found.edge, self._reflected(found.edge)}
            self._do([found.attempt])
            outcome = self.outcomes[-1]
            if outcome.status == "accepted" and crept(self._archive, found, outcome.objectives):
                edge = outcome.x.tobytes(), *found.edge[1:]
                tried |= {edge, self._reflected(edge)}
        self._fill_by_chords()

    def _fill_by_chords(self) -> None:
        archive, fill, tried = self._archive, self._settings.fill, set[Chord]()
        while self._is_short and (gap := widest(archive, tried)) is not None:
            first, second = chord_of(archive, gap)
            image = self._reflected_bytes(second), self._reflected_bytes(first)
            tried |= {(first, second), image}
            found = between(self._evaluator, archive, gap, fill)
            if found is not None:
                archive.add(*found)
                self._unproven.add(found[0].tobytes())
                self._take_image(found[0])

    def _reflected(self, edge: Edge) -> Edge:
        """The mirror image of a side of a gap, itself where it has none."""
        start, across, near = edge
        return self._reflected_bytes(start), self._reflected_bytes(across), near

    def _reflected_bytes(self, x: bytes) -> bytes:
        image = self._image(np.frombuffer(x))
        return x if image is None else image.tobytes()

    def _image(self, x: Array) -> Array | None:
        return None if self._mirror is None else self._mirror.image(x)

    def _take(self, attempt: Attempt, outcome: PolishOutcome) -> None:
        super()._take(attempt, outcome)
        if outcome.status == "accepted":
            if attempt.brief:
                self._unproven.add(outcome.x.tobytes())
                self._probed |= {outcome.x.tobytes(), self._reflected_bytes(outcome.x.tobytes())}
            self._take_image(outcome.x)

    def _evaluated(self, attempt: Attempt, x: Array) -> Evaluations:
        """Most of what probes reach is dominated soon: what then stands is certified in the end."""
        if attempt.brief:
            return self._evaluator.evaluate(x)
        return super()._evaluated(attempt, x)

    def _take_image(self, x: Array) -> None:
        if (image := self._image(x)) is None:
            return
        found = self._evaluator.evaluate(image)
        if found.feasible[0] and not self._archive.dominates(found.objectives[0]):
            self._archive.add(image, found.objectives[0])
            self._unproven.add(image.tobytes())

    def _certify_unproven(self) -> None:
        """Leave out what no solve made and is not proven free of collisions between the samples."""
        rows, known = self._archive.rows(), self._unproven
        standing = [k for k in rows if self._archive.x[k].tobytes() in known]
        if standing:
            x = np.array([self._archive.x[k] for k in standing])
            proven = self._evaluator.certified(self._evaluator.evaluate(x)).feasible
            self._archive.drop([k for k, good in zip(standing, proven, strict=True) if not good])

    def _turn(self, objectives: tuple[int | None, ...], rng: np.random.Generator) -> None:
        """An attempt at each of some aims, and whether it came further."""
        kick = partial(kicked, self._evaluator, self._settings.kick, rng=rng)
        for objective in objectives:
            before, stalls = self._archive.best(objective)[1], self._stalls[objective]
            search = PlanState(objective, stalls > 0, self._tried)
            attempt = aimed(self._archive, search, self._settings, kick, rng)
            self._tried.add((objective, attempt.x.tobytes()))
            if (image := self._image(attempt.x)) is not None:
                self._tried.add((None if objective is None else 1 - objective, image.tobytes()))
            self._do([attempt])
            further = self._archive.best(objective)[1] < before - self._settings.front.progress
            self._stalls[objective] = 0 if further else stalls + 1


def polish_front(
    evaluator: CandidateEvaluator,
    front_x: Array,
    settings: PolishSettings,
    rng: np.random.Generator,
) -> PolishedFront:
    """Polish one front; see `FrontPolisher`."""
    return FrontPolisher(evaluator, settings).polish(front_x, rng)
