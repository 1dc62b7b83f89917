"""Front of drivable carries: duration against force.

One path is polished at a low force limit, by moves of the waypoints in the task's file. A sweep of
increasing force limits continues from there and moves all waypoints for a few iterations at each: a
path that holds at rest within one limit can be driven within every higher one. Each starts from the
fastest known path, so that better basins take over. In the end the widest gaps get points of paths
between their neighbours, which are timed but not improved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import ceil
from typing import Literal

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.cell import SmoothCell
from hybrid_opt.polishing.drive import REST_FORCE_MARGIN, DriveStepMethod
from hybrid_opt.polishing.front import (
    LEAST_SPAN,
    Attempt,
    ParetoArchive,
    Polisher,
    PolishRun,
    Solution,
    Status,
)
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.starts import rotated_starts
from hybrid_opt.timing.candidates import CandidateDriver
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.solve import drive_path
from symbolic.array import Array
from symbolic.path.spline import coarse_task, resample_decisions

LEAST_GAP = 0.02
"""Gaps narrower than this are not filled [front's extent]."""

COMPARED_LIMITS = 8
"""Number of force limits at which known paths that are not on the front are compared."""

FIRST_SWEEP_MARGIN, LAST_SWEEP_MARGIN = 0.02, 0.6
"""First force limit of the sweep, and the limit that it reaches at least, as shares above the force
at rest."""

LEAST_GAIN = 1e-3
"""Relative reduction of the duration by two successive iterations below which the sweep continues
with the next force limit."""

INTERPOLATED_SHARES = (0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875)
"""Shares of the way between two paths of the front at which interpolated paths are tried."""

MOST_DRIVE_ATTEMPTS = 10**6
"""Upper bound of the number of attempts, without effect: the number follows from force limits and
gaps."""

FRONT_ENDS = 2
"""Number of ends of a front."""

MOST_PATHS_TRIED = 4
"""Largest number of paths that are evaluated per gap, because some collide."""

EXTRAPOLATED_SHARES = (0.5, 1.0)
"""Shares of the step between the last two paths of the sweep by which starts are extrapolated."""


@dataclass(frozen=True)
class DriveAttempt(Attempt):
    """An attempt to reduce the duration at the force limit that its decision vector contains.

    Attributes:
        moves: waypoints that the solve moves: 'stated' for the waypoints of the workcell file,
            'all', or 'none' to evaluate x unchanged.
    """

    moves: Literal["stated", "all", "none"] = "stated"


@dataclass(frozen=True)
class DriveGap:
    """A gap between two neighbouring points of the front.

    Attributes:
        force: force limit between the force limits of both points [N].
        ends: indices of both points in the archive.
    """

    force: float
    ends: tuple[int, int]


def recheck_timing(driver: CandidateDriver, model: TimingModel, x: Array) -> str:
    """Check a candidate's timing against all limits on a ten times finer grid.

    Args:
        driver: computes timings of candidates.
        model: timing model of the driver's workcell and intervals.
        x: (n_var,) decision vector.

    Returns:
        Reason why the timing fails; '' if it satisfies all limits.
    """
    timing = driver.time_candidate(np.asarray(x)).timing
    if not timing.ok:
        return f"no timing: {timing.status}"
    limits = driver.limits(float(x[-1]))
    driven = drive_path(model, x, timing.grid_speed, limits, model.path_motion(x))
    return "" if driven.ok else f"on the tenfold grid: {driven.reason}"


class DriveRun(PolishRun[DriveAttempt]):
    """State of the polish of one front of drivable carries while it runs."""

    def __init__(
        self,
        drive_method: DriveStepMethod,
        settings: PolishSettings,
        timings: TimingModel,
        archive: ParetoArchive,
        on_progress: Callable[[int, int], None],
        paths: Array,
    ) -> None:
        """Prepare the polish of a front, and find the force limit at which the front starts: the
        least one with which some known path can hold the box at rest.

        Known paths are those of the archive, the hand-made one and `paths`.

        Args:
            drive_method: step method of drivable carries.
            settings: settings of the polish.
            timings: timing model with which `recheck_timing` checks results.
            archive: the front to be polished.
            on_progress: function called with the number of finished attempts and the expected
                total.
            paths: (m, n_path) free waypoints of further known paths, which are not on the front.
        """
        super().__init__(drive_method.cell.evaluator, settings, archive, on_progress)
        self._most_attempts = MOST_DRIVE_ATTEMPTS
        self._method, self._timings, task = drive_method, timings, drive_method.cell.task
        self._n_path, self._range = task.n_path, drive_method.force_limit
        self._reference = float(task.reference_force.min())
        self._by_force = 1 - self._evaluator.objective_names.index("duration")
        self._tried: set[float] = set()
        self._hand_made, self._driver = drive_method.hand_made, drive_method.driver
        self._paths, self._others, self._largest = paths, paths[:0], self._range[0]
        known = [x[: self._n_path] for x in archive.x]
        every = np.vstack([*known, self._hand_made, paths])
        rest = [t.limited_force for t in self._driver.time_paths(every, np.zeros(len(every)))]
        # No known path can be held still with less.
        least = np.nanmin(rest, initial=self._range[1])
        self._least = min(
            max(self._range[0], (1.0 + REST_FORCE_MARGIN) * float(least)), self._range[1]
        )
        self._still = self._least / (1.0 + REST_FORCE_MARGIN)

    def attempts(self, rng: np.random.Generator) -> Iterator[DriveAttempt]:
        """Yield all attempts of the polish.

        The fastest known path is polished at a low force limit by moves of the workcell file's
        waypoints. A sweep of increasing force limits then moves all waypoints. In the end gaps of
        the front are filled.

        Args:
            rng: not used; the attempts are not random.
        """
        forces = map(self._used_force, self._archive.front_indices())
        fast = min((1.0 + LAST_SWEEP_MARGIN) * self._still, self._range[1])
        self._largest = max(*forces, fast, self._least)
        self._others = self._fastest_paths(np.vstack([self._hand_made, self._paths]))
        least = min(max(self._least, (1.0 + FIRST_SWEEP_MARGIN) * self._still), fast)
        limits = self._limits(least, fast, self._settings.attempts)
        ahead = len(limits) + FRONT_ENDS + self._settings.drivable.members
        self._announce(1 + ahead)
        paths, durations = self._known_paths(limits[0])
        yield self._attempt(paths[int(np.argmin(durations))], limits[0], "stated")
        if self._method.cell.has_pressure_limit:
            middle = self._intermediate_force(limits[0], fast)
            turned_paths = self._rotated(middle)
            self._announce(len(turned_paths) + ahead)
            for path in turned_paths:
                yield self._attempt(path, middle, "stated")
        task, last = self._method.cell.task, list[Array]()
        for force in limits:
            paths, durations = self._known_paths(force)
            if len(last) > 1:
                onward = last[-1] + np.outer(EXTRAPOLATED_SHARES, last[-1] - last[-2])
                onward = np.clip(onward, task.lower[:-1], task.upper[:-1])
                paths = np.vstack([paths, onward])
                durations = np.append(durations, self._driver.durations(onward, force))
            yield self._attempt(paths[int(np.argmin(durations))], force, "all")
            if self.outcomes[-1].status == "accepted":
                last.append(self.outcomes[-1].x[: self._n_path])
        yield from self._gaps()

    def _attempt(self, path: Array, force: float, moves: Literal["stated", "all"]) -> DriveAttempt:
        """Build an attempt to reduce the duration of a path within a force limit.

        Args:
            path: (n_path,) free waypoints at which the solve starts.
            force: force limit [N].
            moves: which waypoints the solve moves, see `DriveAttempt`.
        """
        x = np.append(path, force)
        return DriveAttempt("gap", -1, x, self._evaluator.evaluate(x).objectives[0], moves)

    def _rotated(self, force: float) -> list[Array]:
        """Return further paths (n_path,) from which solves start, with the box tilted otherwise at
        the waypoints of the workcell file.

        Each is the fastest known path or the hand-made one, with the box rotated about one axis in
        one direction. For pads whose pressure may shift within the patches, the tilt decides in
        which local optimum a solve ends.

        Args:
            force: force limit [N]; paths without a timing within it are left out.
        """
        paths, durations = self._known_paths(force)
        best = paths[int(np.argmin(durations))]
        task, own = self._method.cell.task, coarse_task(self._method.cell.task)

        def durations_of(turned_paths: Array) -> Array:
            return self._driver.durations(resample_decisions(turned_paths, own, task), force)

        return [
            resample_decisions(path, own, task)[0]
            for base in resample_decisions(np.array([best, self._hand_made]), task, own)
            for path in rotated_starts(own, base, durations_of)
        ]

    def _used_force(self, index: int) -> float:
        """Return the normal force that a carry really uses, at most its force limit [N].

        Args:
            index: index of the carry in the archive.
        """
        share = float(self._archive.objectives[index][self._by_force])
        return min(float(self._archive.x[index][-1]), share * self._reference)

    def _intermediate_force(self, first: float, second: float) -> float:
        """Return a force limit [N] between two others.

        Its excess over the force at rest is the geometric mean of their excesses, because durations
        depend on the square root of the excess.

        Args:
            first: a force limit [N].
            second: another force limit [N].
        """
        above = np.sqrt((first - self._still) * (second - self._still))
        return float(self._still + above)

    def _gaps(self) -> Iterator[DriveAttempt]:
        """Yield attempts that evaluate known paths at both ends of the front, and interpolated
        paths in its widest gaps."""
        members = self._settings.drivable.members
        for ahead, force in ((FRONT_ENDS, self._least), (FRONT_ENDS - 1, self._largest)):
            self._announce(ahead + members)
            yield from self._fastest(self._known_paths(force)[0], force)
        for ahead in range(members, 0, -1):
            gap = self._widest_gap()
            if gap is None:
                break
            self._announce(ahead)
            first, second = (self._archive.x[k][: self._n_path] for k in gap.ends)
            between = first + np.outer(INTERPOLATED_SHARES, second - first)
            yield from self._fastest(np.vstack([between, self._others]), gap.force)

    def _fastest(self, paths: Array, force: float) -> Iterator[DriveAttempt]:
        """Yield attempts that evaluate paths at a force limit without moving their waypoints.

        The fastest path comes first. At most `MOST_PATHS_TRIED` paths are tried, until one is
        accepted or a known point dominates the next one.

        Args:
            paths: (n, n_path) free waypoints.
            force: the force limit [N].
        """
        self._tried.add(force)
        durations = self._driver.durations(paths, force)
        for k in np.argsort(durations, kind="stable")[:MOST_PATHS_TRIED]:
            x = np.append(paths[k], force)
            found = self._evaluator.evaluate(x)
            if not found.feasible[0]:
                continue
            if self._archive.dominates(found.objectives[0]):
                break
            yield DriveAttempt("gap", -1, x, found.objectives[0], "none")
            if self.outcomes[-1].status == "accepted":
                break

    def _fastest_paths(self, paths: Array) -> Array:
        """Select the paths that are the fastest within at least one of several force limits.

        Args:
            paths: (n, n_path) free waypoints. Paths that are infeasible at the task's largest force
                limit are left out.

        Returns:
            (k, n_path) the selected paths.
        """
        x = np.hstack([paths, np.full((len(paths), 1), self._range[1])])
        paths = paths[self._evaluator.evaluate(x).feasible]
        if not len(paths):
            return paths
        limits = self._limits(self._least, self._largest, COMPARED_LIMITS)
        durations = [self._driver.durations(paths, force) for force in limits]
        return np.asarray(paths[np.unique(np.argmin(durations, axis=1))])

    def _limits(self, least: float, fast: float, count: int) -> list[float]:
        """Return increasing force limits [N] for the sweep.

        Their excess over the force at rest, on which the duration depends, grows by a constant
        ratio. Limits above `fast` follow with the same ratio, up to the largest limit of the front.

        Args:
            least: first limit [N].
            fast: limit that is reached after `count` limits [N].
            count: number of limits from `least` to `fast`.
        """
        low, high, most = np.array([least, fast, self._largest]) - self._still
        step = np.log(high / low) / max(count - 1, 1)
        if most > high and step > 0.0:
            count = 1 + ceil(np.log(most / low) / step)
        above = np.minimum(low * np.exp(step * np.arange(count)), most)
        limits: list[float] = np.clip(self._still + above, least, self._largest).tolist()
        return sorted(set(limits))

    def _known_paths(self, force: float) -> tuple[Array, Array]:
        """Return all known paths (n, n_path), and their shortest durations (n,) [s] within a force
        limit; infinite for a path without a timing.

        Args:
            force: the force limit [N].
        """
        known = [self._archive.x[k][: self._n_path] for k in self._archive.front_indices()]
        paths = np.unique(np.vstack([*known, self._others]), axis=0)
        return paths, self._driver.durations(paths, force)

    def _widest_gap(self) -> DriveGap | None:
        """Return the widest gap between neighbouring points of the front, with a force limit
        between those of both points.

        Gaps in which this force limit was tried already are left out. None if no wide gap remains.
        """
        # What is not polished yet fills no gap: it is to be improved.
        rows = [k for k in self._archive.front_indices() if self._archive.polished[k]]
        if len(rows) < 2:
            rows = self._archive.front_indices()
        # By speed and by shares of force: a second matters less to a slow carry than to a fast one.
        values = np.array([self._archive.objectives[k] for k in rows])
        values[:, 1 - self._by_force] **= -1.0
        values[:, self._by_force] = np.log(values[:, self._by_force])
        values /= np.maximum(np.ptp(values, axis=0), LEAST_SPAN)
        areas = np.abs(np.prod(np.diff(values, axis=0), axis=1))
        for gap in np.argsort(-areas, kind="stable").tolist():
            if areas[gap] <= LEAST_GAP**2:
                return None
            ends = [max(self._used_force(rows[k]), self._least) for k in (gap, gap + 1)]
            force = self._intermediate_force(*ends)
            if force not in self._tried:
                return DriveGap(force, (rows[gap], rows[gap + 1]))
        return None

    def _solve(self, attempt: DriveAttempt) -> Solution:
        if attempt.moves == "none":
            return Solution(attempt.x, usable=True)
        settings = self._settings.drivable
        if attempt.moves == "all":
            return self._method.solve_from(attempt.x).run(settings.rounds, LEAST_GAIN)
        return self._method.coarse.solve_from(attempt.x).run(settings.first_rounds)

    def _classify(
        self, attempt: DriveAttempt, answer: Solution, objectives: Array
    ) -> tuple[Status, str, Array]:
        if self._archive.dominates(objectives):
            return self._not_improved(answer, attempt)
        reason = recheck_timing(self._driver, self._timings, answer.x)
        return ("rejected", reason, attempt.start) if reason else ("accepted", "", objectives)


class DrivePolisher(Polisher):
    """Polishes fronts of drivable carries, path and timing together.

    Attributes:
        drive_method: step method of drivable carries.
    """

    solver_name = "quadratic"

    def __init__(
        self, evaluator: CandidateEvaluator, settings: PolishSettings, functions: PolishFunctions
    ) -> None:
        super().__init__(evaluator, settings)
        self.drive_method = DriveStepMethod(SmoothCell(evaluator, functions, settings.clearance))
        self._timings = TimingModel(evaluator.compiled, self.drive_method.driver.timer.intervals)

    def new_run(
        self, archive: ParetoArchive, on_progress: Callable[[int, int], None], paths: Array
    ) -> DriveRun:
        """Return the polish of one front, see `Polisher.new_run`."""
        given = archive, on_progress, paths
        return DriveRun(self.drive_method, self.settings, self._timings, *given)
