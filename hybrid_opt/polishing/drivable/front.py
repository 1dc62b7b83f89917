"""The polish of a whole front of drivable carries: duration against force.

Every attempt is at one force limit, or at one duration. It starts from the path that is driven
best there of all that are known, so that what one attempt finds serves the others. Points of the
given front come first, evenly spread; then random paths far from all that is known, because a
search's front often lies in one basin of several; then both ends and the widest gaps, and where
these are narrow, points again from other paths.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_OBJECTIVES
from hybrid_opt.polishing.archive import GrowingFront
from hybrid_opt.polishing.attempt import Lost
from hybrid_opt.polishing.drivable.certified import second_opinion
from hybrid_opt.polishing.drivable.point import DrivableSolver, DriveStart
from hybrid_opt.polishing.drivable.timed import Goal
from hybrid_opt.polishing.functions import PolishFunctions, polish_functions
from hybrid_opt.polishing.point import Solution
from hybrid_opt.polishing.records import Aim, PolishOutcome, Status
from hybrid_opt.polishing.run import Polisher, PolishRun
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.timing.model import TimingModel
from symbolic.array import Array
from symbolic.errors import SettingsError

STILL = 1e-3
"""The least force limit is this share above the force that holds the box at rest."""


@dataclass(frozen=True)
class DriveAttempt:
    """One attempt; `aim`, `parent`, `start` as in `hybrid_opt.polishing.records.PolishOutcome`.

    Attributes:
        x: (n_var,) decision vector to start from.
        goal: what is wanted.
    """

    aim: Aim
    parent: int
    x: Array
    start: Array
    goal: Goal


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
                and peak force, or forces are allocated jointly.
            DualArmError: the functions cannot be built.
        """
        if sorted(evaluator.objective_names) != sorted(DRIVABLE_OBJECTIVES):
            raise SettingsError(
                f"under the time law 'optimal' the polish minimises "
                f"{' and '.join(DRIVABLE_OBJECTIVES)}; the objectives are "
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
    ) -> DriveRun:
        return DriveRun(self, archive, recorded, emit)


class DriveRun(PolishRun[DriveAttempt]):
    """One polish in progress."""

    def __init__(
        self,
        polisher: DrivablePolisher,
        archive: GrowingFront,
        recorded: list[PolishOutcome | Lost],
        emit: Callable[[PolishOutcome], None],
    ) -> None:
        super().__init__(polisher.evaluator, polisher.settings, archive, recorded, emit)
        self._solver, self._doubt = polisher.drivable, polisher.doubt
        task = polisher.evaluator.workcell.task
        self._n_path, self._range = task.n_path, task.force_limit
        self._reference = float(task.reference_force.min())
        self._by_force = polisher.evaluator.objective_names.index("peak_force")
        self._tried: set[float] = set()

    def all(self, rng: np.random.Generator) -> None:
        """The front's points, starts far away, ends and gaps, other starts, while attempts last."""
        rows = self._archive.rows()
        count = min(len(rows), ceil(self._settings.attempts * self._settings.front.own_share))
        forces = [
            self._force(rows[k]) for k in np.linspace(0, len(rows) - 1, count).round().astype(int)
        ]
        for force in forces:
            self._at("point", force)
        # Not at the front's largest force, where attempts from far away need most rounds.
        self._far_away(rng, 0.5 * (self._range[0] + max(*forces, self._range[0])))
        self._at("extreme", self._range[1])
        self._at("extreme", self._between(self._range[0], min(map(self._force, rows))))
        while self._left() > 0:
            middle = self._widest_gap()
            if middle is None:
                self._elsewhere(rng)
            else:
                self._at("gap", middle)

    def _force(self, index: int) -> float:
        """Force limit of a known carry that it uses fully [N]."""
        share = float(self._archive.objectives[index][self._by_force])
        return min(float(self._archive.x[index][-1]), share * self._reference)

    def _between(self, first: float, second: float) -> float:
        """A force limit between two: durations go by what a limit leaves above the box at rest."""
        still = self._range[0] * (1.0 - STILL)
        return still + float(np.sqrt((first - still) * (second - still)))

    def _at(self, aim: Aim, force: float) -> None:
        """An attempt at a force limit from the path that is driven best there."""
        durations = self._durations(force)
        self._attempt(aim, int(np.argmin(durations)), force)

    def _elsewhere(self, rng: np.random.Generator) -> None:
        """An attempt at the force limit of a member of the front, from another known path."""
        rows = self._archive.rows()
        force = max(self._force(rows[int(rng.integers(len(rows)))]), self._range[0])
        durations = self._durations(force)
        others = np.flatnonzero(np.isfinite(durations) & (durations > durations.min()))
        chosen = int(rng.choice(others)) if len(others) else int(np.argmin(durations))
        self._attempt("extreme", chosen, force)

    def _far_away(self, rng: np.random.Generator, force: float) -> None:
        """Attempts from random feasible paths that are driven well and lie far from known ones."""
        settings, low, high = self._settings.drivable, self._evaluator.lower, self._evaluator.upper
        count = int(settings.far_share * self._settings.attempts)
        if not count:
            return
        x = rng.uniform(low, high, (settings.candidates, len(low)))
        x[:, -1] = force
        found = self._evaluator.evaluate(x)
        order = np.flatnonzero(found.feasible)
        order = order[np.argsort(found.objectives[order, 1 - self._by_force], kind="stable")]
        x, objectives = x[order], found.objectives[order]
        unit = (high - low)[: self._n_path]
        for _ in range(min(count, len(x))):
            faster = len(x) - len(x) // 2
            known = np.array([path[: self._n_path] for path in self._archive.x])
            away = x[:faster, None, : self._n_path] - known
            distance = np.sqrt(((away / np.where(unit > 0.0, unit, 1.0)) ** 2).mean(axis=2))
            k = int(np.argmax(distance.min(axis=1)))
            goal = Goal("duration", force)
            self._do([DriveAttempt("extreme", -1, x[k], objectives[k], goal)])
            x, objectives = np.delete(x, k, axis=0), np.delete(objectives, k, axis=0)

    def _attempt(self, aim: Aim, index: int, force: float) -> None:
        self._tried.add(force)
        x = np.append(self._archive.x[index][: self._n_path], force)
        start = self._archive.objectives[index]
        self._do([DriveAttempt(aim, -1, x, start, Goal("duration", force))])

    def _durations(self, force: float) -> Array:
        """(members,) of all known paths within a force."""
        paths = np.array([x[: self._n_path] for x in self._archive.x])
        return self._solver.judge.durations(paths, force)

    def _widest_gap(self) -> float | None:
        """A force limit in the middle of the largest gap between neighbours; None without any."""
        # What is not polished yet fills no gap: it is to be improved.
        rows = [k for k in self._archive.rows() if self._archive.polished[k]]
        if len(rows) < 2:
            rows = self._archive.rows()
        span = self._archive.span()
        values = np.array([self._archive.objectives[k] for k in rows]) / span
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
        radius = self._settings.drivable.first_radius
        return self._solver.solve(DriveStart(attempt.x, attempt.goal, radius))

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
