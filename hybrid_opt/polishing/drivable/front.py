"""The polish of a whole front of drivable carries: duration against force.

Every attempt is at one force limit. It starts from the path that is driven best there of all that
are known, so that what one attempt finds serves the others, from others in basins of their own and
from the hand-made one; a few rounds tell which of them goes on. The first attempt is a tournament
of more starts, because a search's front often lies in one basin. Then come a gentle force, points
of the given front, evenly spread; both ends and the widest gaps, and where these are narrow, points
again from other paths. In the end the best known path becomes a point at force limits all over
their range.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_PAIRS
from hybrid_opt.polishing.archive import LEAST_SPAN, GrowingFront
from hybrid_opt.polishing.attempt import Lost
from hybrid_opt.polishing.drivable.certified import second_opinion
from hybrid_opt.polishing.drivable.point import DrivableSolver, DriveStart
from hybrid_opt.polishing.drivable.tilts import turned
from hybrid_opt.polishing.drivable.timed import STILL, Goal
from hybrid_opt.polishing.drivable.tournament import SAME, best_of, distance
from hybrid_opt.polishing.functions import PolishFunctions, polish_functions
from hybrid_opt.polishing.point import Solution
from hybrid_opt.polishing.records import Aim, PolishOutcome, Status
from hybrid_opt.polishing.run import Polisher, PolishRun
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.timing.model import TimingModel
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records.task import initial_decision

FAST = 0.75
"""Where between the least and the front's largest force limit the tournament is: basins differ most
where carries are fast."""

LATER = 1.15
"""Paths that are driven slower than this times the fastest are no rivals of it."""

RIVALS = 3
"""Basins at most that an attempt starts in."""

COMPARED = 8
"""Force limits at which paths from beside the front are compared."""


@dataclass(frozen=True)
class DriveAttempt:
    """One attempt; `aim`, `parent`, `start` as in `hybrid_opt.polishing.records.PolishOutcome`.

    Attributes:
        x: (n_var,) decision vector to start from.
        goal: what is wanted.
        rivals: starts of a tournament in place of x, none where there is none.
        solved: whether x is to be improved; otherwise it is judged as it is.
    """

    aim: Aim
    parent: int
    x: Array
    start: Array
    goal: Goal
    rivals: tuple[Array, ...] = ()
    solved: bool = True


class DrivablePolisher(Polisher):
    """Polishes fronts of duration against force. A resource: keep it for several fronts."""

    def __init__(
        self,
        evaluator: CandidateEvaluator,
        settings: PolishSettings,
        functions: PolishFunctions | None = None,
    ) -> None:
        """Load or build the functions.

        Raises:
            SettingsError: the time law is not 'optimal', the objectives are others than duration
                and peak or robust force, or forces are allocated jointly.
            DualArmError: the functions cannot be built.
        """
        if not any(sorted(evaluator.objective_names) == sorted(pair) for pair in DRIVABLE_PAIRS):
            raise SettingsError(
                f"under the time law 'optimal' the polish minimises "
                f"{' or '.join(' and '.join(pair) for pair in DRIVABLE_PAIRS)}; the objectives are "
                f"{', '.join(evaluator.objective_names)}: switch the polish off for them"
            )
        super().__init__(evaluator, settings)
        known = functions or polish_functions(evaluator.compiled)
        self.drivable = DrivableSolver(evaluator, known, settings)
        # At once: the cell's files may be there only for as long as this is made.
        self._timings = TimingModel(evaluator.compiled, self.drivable.driver.timer.intervals)

    def doubt(self, x: Array) -> str:
        """Why a timing is not believed, see `hybrid_opt.polishing.drivable.certified`."""
        return second_opinion(self.drivable.driver, self._timings, x)

    def _run(
        self,
        archive: GrowingFront,
        recorded: list[PolishOutcome | Lost],
        emit: Callable[[PolishOutcome], None],
        paths: Array,
    ) -> DriveRun:
        return DriveRun(self, archive, recorded, emit, paths)


class DriveRun(PolishRun[DriveAttempt]):
    """One polish in progress."""

    def __init__(
        self,
        polisher: DrivablePolisher,
        archive: GrowingFront,
        recorded: list[PolishOutcome | Lost],
        emit: Callable[[PolishOutcome], None],
        paths: Array,
    ) -> None:
        super().__init__(polisher.evaluator, polisher.settings, archive, recorded, emit)
        self._solver, self._doubt = polisher.drivable, polisher.doubt
        task = polisher.evaluator.workcell.task
        self._n_path, self._range = task.n_path, self._solver.judge.force_limit
        self._reference = float(task.reference_force.min())
        self._by_force = 1 - polisher.evaluator.objective_names.index("duration")
        self._tried: set[float] = set()
        self._hand_made = initial_decision(task)[: self._n_path]
        self._paths, self._others, self._largest = paths, paths[:0], self._range[0]

    def all(self, rng: np.random.Generator) -> None:
        """A tournament, a gentle force, the front's points, ends and gaps, other starts, while
        attempts last; then the best known paths all over the range of forces."""
        rows = self._archive.rows()
        count = min(len(rows), ceil(self._settings.attempts * self._settings.front.own_share))
        forces = [
            self._force(rows[k]) for k in np.linspace(0, len(rows) - 1, count).round().astype(int)
        ]
        self._largest = max(*map(self._force, rows), self._range[0])
        self._others = self._leading(np.vstack([self._hand_made, self._paths]))
        self._tournament(self._range[0] + FAST * (self._largest - self._range[0]))
        self._at("extreme", self._between(self._range[0], self._largest))
        for force in forces:
            self._at("point", force)
        self._at("extreme", self._range[1])
        self._at("extreme", self._range[0])
        while self._left() > 0:
            middle = self._widest_gap()
            if middle is None:
                self._elsewhere(rng)
            else:
                self._at("gap", middle)
        self._spread()

    def _force(self, index: int) -> float:
        """Force limit of a known carry that it uses fully [N]."""
        share = float(self._archive.objectives[index][self._by_force])
        return min(float(self._archive.x[index][-1]), share * self._reference)

    def _between(self, first: float, second: float) -> float:
        """A force limit between two: durations go by what a limit leaves above the box at rest."""
        still = self._range[0] * (1.0 - STILL)
        return still + float(np.sqrt((first - still) * (second - still)))

    def _at(self, aim: Aim, force: float) -> None:
        """An attempt at a force limit from the path that is driven best there, and from others in
        basins of their own, the hand-made one among them: which is the best is seen only after some
        rounds, and where carries are slow, it is seldom the one of those driven best so far."""
        rivals = self._rivals(force)
        starts = tuple(np.append(path, force) for path in rivals)
        self._attempt(aim, rivals[0], force, starts if len(starts) > 1 else ())

    def _rivals(self, force: float) -> list[Array]:
        """Known paths (n_path,) far from one another by how fast they are driven, after the best
        one the hand-made."""
        paths, durations = self._driven(force)
        half, best = self._solver.half, paths[int(np.argmin(durations))]
        chosen = [best]
        if distance(best, self._hand_made, half) > SAME:
            chosen.append(self._hand_made)
        for k in np.argsort(durations, kind="stable"):
            away = min(distance(paths[k], path, half) for path in chosen)
            if len(chosen) == RIVALS or not durations[k] <= LATER * durations.min():
                break
            if away > SAME:
                chosen.append(paths[k])
        return chosen

    def _elsewhere(self, rng: np.random.Generator) -> None:
        """An attempt at the force limit of a member of the front, from another known path."""
        rows = self._archive.rows()
        force = max(self._force(rows[int(rng.integers(len(rows)))]), self._range[0])
        paths, durations = self._driven(force)
        others = np.flatnonzero(np.isfinite(durations) & (durations > durations.min()))
        chosen = int(rng.choice(others)) if len(others) else int(np.argmin(durations))
        self._attempt("extreme", paths[chosen], force)

    def _tournament(self, force: float) -> None:
        """An attempt from the best of several starts: the best known path and the hand-made one,
        turned in every sense."""
        paths, durations = self._driven(force)
        best = paths[int(np.argmin(durations))]
        starts = [
            np.append(path, force)
            for base in (best, self._hand_made)
            for path in turned(self._evaluator.workcell.task, self._solver.judge, base, force)
        ]
        if starts:
            self._attempt("extreme", best, force, tuple(starts))

    def _attempt(self, aim: Aim, path: Array, force: float, rivals: tuple[Array, ...] = ()) -> None:
        self._tried.add(force)
        x = np.append(path, force)
        start = self._evaluator.evaluate(x[None]).objectives[0]
        self._do([DriveAttempt(aim, -1, x, start, Goal("duration", force), rivals)])

    def _spread(self) -> None:
        """Points of the best known paths at force limits up to the front's largest."""
        self._most += self._settings.drivable.members
        for force in self._spread_forces(self._settings.drivable.members):
            paths, durations = self._driven(force)
            x = np.append(paths[int(np.argmin(durations))], force)
            found = self._evaluator.evaluate(x)
            objectives = found.objectives[0]
            if found.feasible[0] and not self._archive.dominates(objectives):
                goal = Goal("duration", force)
                self._do([DriveAttempt("gap", -1, x, objectives, goal, solved=False)])

    def _leading(self, paths: Array) -> Array:
        """Of some paths (n, n_path) those that are feasible when pressed hard enough, and of these
        the fastest within some force."""
        x = np.hstack([paths, np.full((len(paths), 1), self._range[1])])
        paths = paths[self._evaluator.evaluate(x).feasible]
        if not len(paths):
            return paths
        durations = [self._solver.judge.durations(paths, f) for f in self._spread_forces(COMPARED)]
        return np.asarray(paths[np.unique(np.argmin(durations, axis=1))])

    def _spread_forces(self, count: int) -> list[float]:
        """Force limits from the least to the front's largest."""
        still = self._range[0] * (1.0 - STILL)
        # What a limit leaves above the box at rest decides how long a carry takes.
        above = np.geomspace(self._range[0] - still, self._largest - still, count)
        return [float(force) for force in np.clip(still + above, self._range[0], self._largest)]

    def _driven(self, force: float) -> tuple[Array, Array]:
        """Paths of the front and those beside it (n, n_path), and how long they take within a
        force."""
        known = [self._archive.x[k][: self._n_path] for k in self._archive.rows()]
        paths = np.unique(np.vstack([*known, self._others]), axis=0)
        return paths, self._solver.judge.durations(paths, force)

    def _widest_gap(self) -> float | None:
        """A force limit in the middle of the largest gap between neighbours; None without any."""
        # What is not polished yet fills no gap: it is to be improved.
        rows = [k for k in self._archive.rows() if self._archive.polished[k]]
        if len(rows) < 2:
            rows = self._archive.rows()
        # By shares: a second matters less to a slow carry than to a fast one.
        values = np.log([self._archive.objectives[k] for k in rows])
        values /= np.maximum(np.ptp(values, axis=0), LEAST_SPAN)
        areas = np.abs(np.prod(np.diff(values, axis=0), axis=1))
        for gap in np.argsort(-areas, kind="stable").tolist():
            if areas[gap] <= self._settings.front.least_gap**2:
                return None
            ends = [max(self._force(rows[k]), self._range[0]) for k in (gap, gap + 1)]
            force = self._between(*ends)
            if force not in self._tried:
                return force
        return None

    def _solution(self, attempt: DriveAttempt) -> Solution:
        if not attempt.solved:
            return Solution(attempt.x, usable=True)
        if attempt.rivals:
            return best_of(self._solver, attempt.rivals, attempt.goal)
        radius = self._settings.drivable.first_radius
        return self._solver.solve(DriveStart(attempt.x, attempt.goal, radius))

    def _verdict(self, attempt: DriveAttempt, answer: Solution | Lost) -> tuple[Status, str, Array]:
        if not attempt.solved and isinstance(answer, Solution):
            return self._recomputed(attempt, answer)
        return super()._verdict(attempt, answer)

    def _worth(
        self, attempt: DriveAttempt, answer: Solution, objectives: Array
    ) -> tuple[Status, str, Array]:
        if self._archive.dominates(objectives):
            return self._not_improved(answer, attempt)
        doubt = self._doubt(answer.x)
        return ("rejected", doubt, attempt.start) if doubt else ("accepted", "", objectives)

    def _take(self, attempt: DriveAttempt, outcome: PolishOutcome) -> None:
        self.outcomes.append(outcome)
        if outcome.status == "accepted":
            self._archive.add(outcome.x, outcome.objectives)
