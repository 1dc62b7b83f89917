"""The front of drivable carries: duration against force.

Every attempt is at one force limit. It starts from the path that is driven best there of all that
are known, so that what one attempt finds serves the others, from others in basins of their own and
from the hand-made one; a few rounds tell which of them goes on. The first attempt is a tournament
of more starts, because a search's front often lies in one basin. Then come a gentle force, points
of the given front, evenly spread; both ends and the widest gaps, and where these are narrow,
points again from other paths. Where the task has more waypoints than its file states, the first
few of these attempts move the stated ones, and a sweep of force limits then moves all of them. In
the end the widest gaps get points of known paths, or of paths between both neighbours', which are
driven but not improved: a path that tilts the box until standing still uses its limit up cannot be
driven within less.

Of several starts of one goal, all take few rounds, and only the most promising ones go on
(successive halving, Jamieson and Talwalkar 2016): the half stays that promises more, by what it has
come to and what it gained last. Those that hardly gain any more stay behind, however good they are:
they have arrived. So does one of two in the same basin. Random starts in place of turned paths
found the fast basin once in 28.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Literal

import numpy as np

from hybrid_opt.polishing.drive import STILL, DrivePoint, DriveStep, DriveWay
from hybrid_opt.polishing.front import LEAST_SPAN, OWN_SHARE, Attempt, GrowingFront, Loss, PolishRun
from hybrid_opt.polishing.point import Climb, Solution
from hybrid_opt.polishing.records import Aim, PolishOutcome, Status
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.starts import turned
from hybrid_opt.timing.drive import CandidateDriver
from hybrid_opt.timing.limits import drive_path
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array, evenly
from symbolic.path.pieces import same_paths, stated
from symbolic.records.task import initial_decision

LEAST_GAP = 0.02
"""Gaps narrower than this are left, in units of the front's extent."""

AGREEMENT = 5e-3
"""Largest relative difference of the durations of a timing and of the independent one."""

FAST = 0.75
"""Where between the least and the front's largest force limit the tournament is: basins differ most
where carries are fast."""

LATER = 1.15
"""Paths that are driven slower than this times the fastest are no rivals of it."""

RIVALS = 3
"""Basins at most that an attempt starts in."""

COMPARED = 8
"""Force limits at which paths from beside the front are compared."""

GENTLE = 0.02
"""Least force limit, as a share above the box at rest, whose points are moved by all waypoints."""

STALLED = 1e-3
"""Gain of half a turn below which a climb that is nearly stationary has arrived, as a share of its
level."""

NEARLY = 1e-2
"""Residual of stationarity below which it is."""

BETWEEN = (0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875)
"""Shares of the way from one path of the front to the next that are tried as paths, too."""

FASTEST = 4
"""Paths that are judged at most before a gap is left: some touch something."""

ONWARD = (0.5, 1.0)
"""Shares of the way between two refined paths that the next one may start ahead of the second."""

SAME = 0.25
"""Paths nearer than this to one another lie in one basin, in halves of the variables' ranges."""

DriveClimb = Climb[DrivePoint, DriveStep]


@dataclass(frozen=True)
class DriveAttempt(Attempt):
    """An attempt at the force limit of its decision vector.

    Attributes:
        rivals: starts of a tournament in place of x, none where there is none.
        moves: which waypoints improve x: the stated ones, all, or none where it is judged as it is.
    """

    rivals: tuple[Array, ...] = ()
    moves: Literal["stated", "all", "none"] = "stated"


@dataclass(frozen=True)
class Gap:
    """A gap of the front.

    Attributes:
        force: limit in its middle [N].
        ends: indices of the points on both sides.
    """

    force: float
    ends: tuple[int, int]


def best_of(way: DriveWay, starts: Sequence[Array]) -> Solution:
    """The best answer from any of some decision vectors (n_var,).

    Its rounds and iterations are those of all together.
    """
    climbs = [way.climb(x) for x in starts]
    left = climbs
    while len(left) > 1:
        for climb in left:
            climb.go_on(way.settings.turn)
        left = _promising(way, left)
    for climb in left:
        way.finish(climb)
    finished = list(left)
    while (best := _best(way, climbs)) not in finished:
        # Promises are not always kept.
        way.finish(best)
        finished.append(best)
    found = best.solution
    found.rounds = sum(climb.solution.rounds for climb in climbs)
    found.iterations = sum(climb.solution.iterations for climb in climbs)
    return found


def _best(way: DriveWay, climbs: list[DriveClimb]) -> DriveClimb:
    """The one that has come farthest. A start may touch something, and one that never moved does so
    in the end."""
    sound = way.cell.evaluator.evaluate(np.array([climb.best.x for climb in climbs])).feasible
    levels = np.array([climb.best.level for climb in climbs])
    return climbs[int(np.lexsort((levels, ~sound))[0])]


def _promising(way: DriveWay, climbs: list[DriveClimb]) -> list[DriveClimb]:
    """The more promising half of those that may still gain, no two in one basin."""
    n, kept, seen = len(way.half), list[DriveClimb](), list[Array]()
    for climb in sorted(climbs, key=_promise):
        path = climb.best.x[:n]
        away = min((distance(path, x, way.half) for x in seen), default=np.inf)
        seen.append(path)
        if away > SAME and not _has_arrived(climb):
            kept.append(climb)
    return kept[: (len(climbs) + 1) // 2]


def _promise(climb: DriveClimb) -> float:
    """The level that half a turn more leads to, should it bring what the last one brought: a start
    from afar is still behind others when it already overtakes them."""
    return climb.best.level - climb.last_gain if np.isfinite(climb.last_gain) else climb.best.level


def _has_arrived(climb: DriveClimb) -> bool:
    nearly = climb.solution.residuals.stationarity <= NEARLY
    return climb.ended or (nearly and climb.last_gain <= STALLED * climb.best.level)


def distance(path: Array, other: Array, half: Array) -> float:
    """Root mean square, in halves of the variables' ranges."""
    return float(np.sqrt(np.mean(((path - other) / half) ** 2)))


def second_opinion(
    driver: CandidateDriver, model: TimingModel, x: Array, independent: bool = True
) -> str:
    """Why the timing of a decision vector (n_var,) is not believed, empty where it is: by the
    tenfold grid, and the independent `time_path`.

    Args:
        model: of the driver's workcell and intervals.
        independent: whether `time_path` is asked, too.
    """
    (timing,) = driver.timings(np.asarray(x)[None])
    if not timing.ok:
        return f"no timing: {timing.status}"
    motion, limits = model.path_motion(x), driver.limits(float(x[-1]))
    driven = drive_path(model, x, timing.grid_speed, limits, motion)
    if not driven.ok:
        return f"on the tenfold grid: {driven.reason}"
    if not independent:
        return ""
    other = time_path(model, x, limits, motion)
    if not other.ok:
        return f"the independent timing: {other.reason}"
    if abs(timing.duration / other.duration - 1.0) > AGREEMENT:
        return f"the independent timing takes {other.duration:.3f} s, not {timing.duration:.3f} s"
    return ""


class DriveRun(PolishRun[DriveAttempt]):
    """One polish in progress."""

    def __init__(
        self,
        way: DriveWay,
        settings: PolishSettings,
        doubt: Callable[[Array, bool], str],
        archive: GrowingFront,
        recorded: list[PolishOutcome | Loss],
        emit: Callable[[PolishOutcome], None],
        paths: Array,
    ) -> None:
        """Begin.

        Args:
            doubt: why the timing of a decision vector is not believed, see `second_opinion`.
            paths: (m, n_path) known beside the front.
        """
        super().__init__(way.cell.evaluator, settings, archive, recorded, emit)
        self._way, self._doubt, task = way, doubt, way.cell.task
        self._n_path, self._range = task.n_path, way.paths.force_limit
        self._reference = float(task.reference_force.min())
        self._by_force = 1 - self._evaluator.objective_names.index("duration")
        self._tried: set[float] = set()
        self._hand_made = initial_decision(task)[: self._n_path]
        self._paths, self._others, self._largest = paths, paths[:0], self._range[0]
        if way.stated is not way:
            self._most = min(self._most, settings.drivable.rough)

    def all(self, rng: np.random.Generator) -> None:
        """A tournament, a gentle force, the front's points, ends and gaps, other starts, while
        attempts last; then the best known paths all over the range of forces."""
        rows = self._archive.rows()
        refines = self._way.stated is not self._way
        # What is moved by all waypoints afterwards needs no points of the given front.
        count = 0 if refines else min(len(rows), ceil(self._settings.attempts * OWN_SHARE))
        forces = [self._force(rows[k]) for k in evenly(len(rows), count)]
        self._largest = max(*map(self._force, rows), self._range[0])
        self._others = self._leading(np.vstack([self._hand_made, self._paths]), COMPARED)
        self._tournament(self._range[0] + FAST * (self._largest - self._range[0]))
        self._at("extreme", self._between(self._range[0], self._largest))
        for force in forces:
            self._at("point", force)
        self._at("extreme", self._range[0])
        self._at("extreme", self._range[1])
        while self._left() > 0:
            gap = self._widest_gap()
            if gap is None:
                self._elsewhere(rng)
            else:
                self._at("gap", gap.force)
        if refines:
            self._refine()
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
        half, best = self._way.half, paths[int(np.argmin(durations))]
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
        turned in every sense by their stated waypoints."""
        paths, durations = self._driven(force)
        best = paths[int(np.argmin(durations))]
        task, own = self._way.cell.task, stated(self._way.cell.task)

        def durations_of(turned_paths: Array) -> Array:
            return self._way.paths.durations(same_paths(turned_paths, own, task), force)

        starts = [
            np.append(same_paths(path, own, task)[0], force)
            for base in same_paths(np.array([best, self._hand_made]), task, own)
            for path in turned(own, base, durations_of)
        ]
        if starts:
            self._attempt("extreme", best, force, tuple(starts))

    def _attempt(self, aim: Aim, path: Array, force: float, rivals: tuple[Array, ...] = ()) -> None:
        self._tried.add(force)
        x = np.append(path, force)
        start = self._evaluator.evaluate(x[None]).objectives[0]
        self._do([DriveAttempt(aim, -1, x, start, rivals)])

    def _refine(self) -> None:
        """Points moved by all waypoints, from gentle to fast: what rest holds within one limit is
        driven within every higher one. The way from one to the next leads on to the one after."""
        count, still = self._settings.drivable.refined, self._range[0] * (1.0 - STILL)
        least = min(max(self._range[0], (1.0 + GENTLE) * still), self._largest)
        self._most = len(self.outcomes) + count
        task, last = self._way.cell.task, list[Array]()
        for above in np.geomspace(least - still, self._largest - still, count):
            force = float(np.clip(still + above, self._range[0], self._largest))
            paths, durations = self._driven(force)
            if len(last) > 1:
                onward = last[-1] + np.outer(ONWARD, last[-1] - last[-2])
                onward = np.clip(onward, task.lower[:-1], task.upper[:-1])
                paths = np.vstack([paths, onward])
                durations = np.append(durations, self._way.paths.durations(onward, force))
            x = np.append(paths[int(np.argmin(durations))], force)
            start = self._evaluator.evaluate(x).objectives[0]
            self._do([DriveAttempt("gap", -1, x, start, moves="all")])
            if self.outcomes[-1].status == "accepted":
                last.append(self.outcomes[-1].x[: self._n_path])

    def _spread(self) -> None:
        """Points of the best known paths at both ends of the front, then in its largest gaps, there
        also of paths between both neighbours'."""
        for force in (self._range[0], self._largest):
            self._best_known(force, self._others[:0])
        for _ in range(self._settings.drivable.members):
            gap = self._widest_gap()
            if gap is None:
                break
            first, second = (self._archive.x[k][: self._n_path] for k in gap.ends)
            self._best_known(gap.force, first + np.outer(BETWEEN, second - first))

    def _best_known(self, force: float, paths: Array) -> None:
        """A point of the fastest path within a force, of all that are known and of others
        (n, n_path)."""
        self._tried.add(force)
        known, durations = self._driven(force)
        durations = np.append(durations, self._way.paths.durations(paths, force))
        fastest = np.vstack([known, paths])[np.argsort(durations, kind="stable")[:FASTEST]]
        x = np.column_stack([fastest, np.full(len(fastest), force)])
        found = self._evaluator.evaluate(x)
        for k in np.flatnonzero(found.feasible):
            if self._archive.dominates(found.objectives[k]):
                break
            self._most = len(self.outcomes) + 1
            self._do([DriveAttempt("gap", -1, x[k], found.objectives[k], moves="none")])
            if self.outcomes[-1].status == "accepted":
                break

    def _leading(self, paths: Array, count: int) -> Array:
        """Those of some paths (n, n_path) that are feasible when pressed hard enough and are the
        fastest within one of `count` forces."""
        x = np.hstack([paths, np.full((len(paths), 1), self._range[1])])
        paths = paths[self._evaluator.evaluate(x).feasible]
        if not len(paths):
            return paths
        durations = [self._way.paths.durations(paths, f) for f in self._spread_forces(count)]
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
        return paths, self._way.paths.durations(paths, force)

    def _widest_gap(self) -> Gap | None:
        """The largest gap between neighbours whose middle was not tried; None without any."""
        # What is not polished yet fills no gap: it is to be improved.
        rows = [k for k in self._archive.rows() if self._archive.polished[k]]
        if len(rows) < 2:
            rows = self._archive.rows()
        # By speed and by shares of force: a second matters less to a slow carry than to a fast one.
        values = np.array([self._archive.objectives[k] for k in rows])
        values[:, 1 - self._by_force] **= -1.0
        values[:, self._by_force] = np.log(values[:, self._by_force])
        values /= np.maximum(np.ptp(values, axis=0), LEAST_SPAN)
        areas = np.abs(np.prod(np.diff(values, axis=0), axis=1))
        for gap in np.argsort(-areas, kind="stable").tolist():
            if areas[gap] <= LEAST_GAP**2:
                return None
            ends = [max(self._force(rows[k]), self._range[0]) for k in (gap, gap + 1)]
            force = self._between(*ends)
            if force not in self._tried:
                return Gap(force, (rows[gap], rows[gap + 1]))
        return None

    def _solution(self, attempt: DriveAttempt) -> Solution:
        if attempt.moves == "none":
            return Solution(attempt.x, usable=True)
        if attempt.moves == "all":
            return self._way.climb(attempt.x).go_on(self._way.settings.refining)
        return best_of(self._way.stated, attempt.rivals or (attempt.x,))

    def _verdict(self, attempt: DriveAttempt, answer: Solution | Loss) -> tuple[Status, str, Array]:
        if attempt.moves == "none" and isinstance(answer, Solution):
            return self._recomputed(attempt, answer)
        return super()._verdict(attempt, answer)

    def _worth(
        self, attempt: DriveAttempt, answer: Solution, objectives: Array
    ) -> tuple[Status, str, Array]:
        if self._archive.dominates(objectives):
            return self._not_improved(answer, attempt)
        doubt = self._doubt(answer.x, attempt.moves != "none")
        return ("rejected", doubt, attempt.start) if doubt else ("accepted", "", objectives)

    def _take(self, attempt: DriveAttempt, outcome: PolishOutcome) -> None:
        self.outcomes.append(outcome)
        if outcome.status == "accepted":
            self._archive.add(outcome.x, outcome.objectives)
