"""The step and the judge of drivable carries: a quadratic model of path and timing together.

First a program without the Lagrangian's curvature finds multipliers: they owe nothing to earlier
rounds, which may have been elsewhere. With them the quadratic model is formed and solved, and where
geometric rows bend along the step, it is corrected for that. The judge is the compiled timing of
the path that the step leads to, not the program: a path that is driven no better is refused before
its geometry is looked at. The polish ends where the program's optimality conditions hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.carry import CarryReader
from hybrid_opt.polishing.cell import SmoothCell
from hybrid_opt.polishing.constraints.active import ActiveSet
from hybrid_opt.polishing.intervals import (
    NEGLIGIBLE,
    IntervalGrid,
    IntervalValues,
    JointProgram,
    Linear,
)
from hybrid_opt.polishing.point import (
    HALVED,
    QUARTERED,
    Climb,
    ClimbPoint,
    Step,
    StepVerdict,
    Way,
)
from hybrid_opt.polishing.rows import Row
from hybrid_opt.polishing.solvers.base import Residuals
from hybrid_opt.polishing.solvers.quadratic import (
    BorderedMatrix,
    QuadraticAnswer,
    QuadraticProgram,
    convex,
    solve_quadratic,
)
from hybrid_opt.robust.path_force import PathPoints, robust_path
from hybrid_opt.timing.drive import CandidateDriver
from hybrid_opt.timing.path_timer import PathTiming
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.path.pieces import by_levels, stated_entries
from symbolic.records import Workcell
from symbolic.records.task import waypoints_of

FIRST_RADIUS, LEAST_RADIUS = 0.3, 1e-4
"""Radii of the box of trust, in half ranges of the waypoints; below the least a point is
left."""

STATIONARY, FEASIBLE = 1e-4, 5e-3
"""Residuals of stationarity and of complementarity, and of feasibility, at which a point counts as
optimal: what is asked of distances moves with the path."""

NOISE = 5e-4
"""Relative change of a timing that counts as none: what the timing rounds off."""

CLOSER = 0.1
"""Share of the promised gain that a step has to bring, unless the timing may have rounded it
off."""

PARTS = (1.0, 0.5, 0.25, 0.125)
"""Parts of a step that are tried, the first that is closer is taken: judging costs a tenth of a
round."""

NEWTON = 0.05
"""Steps shorter than this keep the program's squared speeds, longer ones take those of the new
timing."""

ROW_ROUNDS, ROW_TOLERANCE = 3, 1e-6
"""Times that rows are added to one quadratic program, and the predicted excess of a limit that adds
its row."""

STEADINESS = 1.0
"""Curvature by the path of the program that finds multipliers."""

BEND = 0.2
"""Error of geometric rows, by their curvature along a step, above which it is corrected, once."""

FARTHER = (2.0, 4.0, 8.0)
"""Times a step that brought more than it promised: judging costs a tenth of a round."""

LEAST_SQUARED, LARGEST_SQUARED = 0.9, 3.0
"""How far a squared speed may fall and rise in a step, as shares of it."""

UNPOLISHABLE = (
    "the polish does not know the allocation 'joint' of two pads that face one another, nor robust "
    "forces of pads whose normals are not opposite"
)
"""Why a cell is not `is_polishable`."""

STILL = 1e-3
"""The least force limit is this share above the force that holds the box at rest."""


def is_polishable(workcell: Workcell, robust: bool) -> bool:
    """Whether drivable carries of a cell can be polished: those whose planned forces have slopes,
    and where robust ones are limited, of two pads with opposite normals."""
    return workcell.has_force_slopes and (workcell.has_one_squeeze or not robust)


@dataclass(frozen=True)
class TimedPath:
    """A path with its fastest timing within a force limit.

    Attributes:
        duration: [s], infinite where there is none.
        squared: (intervals + 1,) u'^2 at the grid points.
        joints: of both arms at the grid points (intervals + 1, n) [rad].
    """

    duration: float
    squared: Array
    joints: tuple[Array, Array]


class PathJudge:
    """Times paths by the compiled passes.

    Attributes:
        force_limit: least and largest [N].
    """

    def __init__(self, driver: CandidateDriver) -> None:
        self._driver, self.force_limit = driver, force_range(driver)

    def timed(self, x: Array) -> TimedPath:
        """The fastest timing of a decision vector (n_var,)."""
        found, known = self._driver.timed(x)
        duration = found.duration if found.ok else float("inf")
        joints = [np.ascontiguousarray(known[f"q_{arm}"][0][::2]) for arm in (1, 2)]
        return TimedPath(duration, found.grid_speed**2, (joints[0], joints[1]))

    def durations(self, paths: Array, force: float) -> Array:
        """(n,) [s] of paths (n, n_path) within a force, infinite where there is none."""
        found = self._timings(paths, force)
        return np.array([t.duration if t.ok else np.inf for t in found])

    def at_rest(self, paths: Array) -> Array:
        """(n,) [N] what standing still needs of paths (n, n_path), NaN where arms cannot follow."""
        return np.array([timing.limited_force for timing in self._timings(paths, 0.0)])

    def _timings(self, paths: Array, force: float) -> list[PathTiming]:
        limits = [self._driver.limits(force)] * len(paths)
        return self._driver.timer.time_all(np.ascontiguousarray(paths), limits)


def force_range(driver: CandidateDriver) -> tuple[float, float]:
    """The task's least and largest force limit [N]; of robust forces the least is at least what
    holds the box at both ends of every path."""
    workcell = driver.timer.workcell
    least, most = workcell.task.force_limit
    if driver.robust:
        ends = waypoints_of(workcell.task, workcell.task.lower)[[0, -1]]
        (first, second), (a, w) = np.zeros((2, 2, 6)), np.zeros((2, 2))
        held, _ = robust_path(workcell).at(PathPoints(ends, first, second, a, w))
        least = max(least, (1.0 + STILL) * float(held.max()))
    return least, most


@dataclass(frozen=True)
class DrivePoint(ClimbPoint):
    """A carry whose level is its duration [s].

    Attributes:
        joints: as of its timing.
        squared: (intervals + 1,) u'^2, its timing's or those that a program promised.
        lowest: the least level so far: what the timing rounds off must not add up.
    """

    joints: tuple[Array, Array]
    squared: Array
    lowest: float


@dataclass(frozen=True, kw_only=True)
class DriveStep(Step):
    """A step of a path.

    Attributes:
        d: scaled, of the waypoints that are moved.
        squared: (intervals + 1,) u'^2 that its program promises.
        gain: the share of the duration that it promises to take off.
    """

    d: Array
    squared: Array
    gain: float


@dataclass(frozen=True)
class _StepAnswer:
    """A quadratic program's answer, and the rows that it was given."""

    answer: QuadraticAnswer
    linear: Linear


class DriveWay(Way[DrivePoint, DriveStep]):
    """The least duration within the force limit of the start. A resource: one per process.

    Attributes:
        driver, paths: how carries and paths are timed.
        stated: the same by moves of the waypoints that the file states, along which the others
            follow; itself where there are no others. Fewer variables take fewer and cheaper rounds.
    """

    least_radius, farther = LEAST_RADIUS, FARTHER
    refused_by_length = stays_lenient = True

    def __init__(self, cell: SmoothCell, by_stated: bool = False) -> None:
        """Prepare programs.

        Args:
            by_stated: whether moves are those of the stated waypoints.

        Raises:
            SettingsError: the time law is not 'optimal', or forces have no closed form.
        """
        driver, task = cell.evaluator.driver, cell.task
        if driver is None or not is_polishable(cell.workcell, driver.robust):
            raise SettingsError(
                f"the polish of drivable carries needs the time law 'optimal'; {UNPOLISHABLE}: "
                "switch the polish off"
            )
        super().__init__(cell, ActiveSet(cell), CarryReader(cell))
        self.driver, self._n = driver, task.n_path
        self.half = cell.half[: task.n_path]
        self._own = own = stated_entries(task) if by_stated else np.arange(task.n_path)
        self._bounds = task.lower[own], task.upper[own]
        by, square = by_levels(task)
        self._unit = (self.half * square)[own]
        self._newton = NEWTON * float(square[own].min())
        self._spread = by[:, own] * self._unit
        self.paths = PathJudge(driver)
        intervals, threads = driver.timer.intervals, cell.evaluator.threads
        self._intervals = IntervalGrid(
            cell.workcell, intervals, self._spread, driver.robust, threads
        )
        self.stated = self
        if task.pieces > 1 and not by_stated:
            self.stated = DriveWay(cell, by_stated=True)

    def start(self, x: Array) -> DrivePoint:
        """See `Way`."""
        timed = self.paths.timed(x)
        return self._reached(x, timed, timed.squared, np.inf)

    def _reached(self, x: Array, timed: TimedPath, squared: Array, lowest: float) -> DrivePoint:
        lowest = min(lowest, timed.duration)
        return DrivePoint(x, self.reader.read(x), timed.duration, timed.joints, squared, lowest)

    def _moved(self, x: Array, d: Array) -> Array:
        """(n_var,) after a scaled step of the path."""
        n, task = self._n, self.cell.task
        moved = x[:n] + self._spread @ d
        return np.append(np.clip(moved, task.lower[:n], task.upper[:n]), x[n:])

    def judge(self, best: DrivePoint, step: DriveStep) -> StepVerdict[DrivePoint]:
        """See `Way`. What the timing rounds off may hide a small gain, but must not add up."""
        tiny = step.gain <= NOISE
        for part in PARTS:
            x = self._moved(best.x, part * step.d)
            timed = self.paths.timed(x)
            gain = 1.0 - timed.duration / best.level
            kept = timed.duration <= best.lowest * (1.0 + NOISE)
            if gain >= CLOSER * part * step.gain or (tiny and kept):
                break
            if not np.isfinite(timed.duration):
                return StepVerdict(None, closer=False, factor=QUARTERED)
        else:
            return StepVerdict(None, closer=False, factor=HALVED * part)
        share = gain / max(part * step.gain, 1e-300)
        is_short = part == 1.0 and step.length <= self._newton
        squared = step.squared if is_short else timed.squared
        return StepVerdict(
            self._reached(x, timed, squared, best.lowest),
            closer=True,
            kept=max(share, 0.5) if tiny else share,
            part=part,
            surprising=part == 1.0 and gain > step.gain and not tiny,
            is_short=is_short,
        )

    def along(
        self, begin: DrivePoint, best: DrivePoint, step: DriveStep, share: float
    ) -> DrivePoint | None:
        """See `Way`."""
        x = self._moved(begin.x, share * step.d)
        timed = self.paths.timed(x)
        if timed.duration >= best.level * (1.0 - NOISE):
            return None
        return self._reached(x, timed, timed.squared, best.lowest)

    def propose(
        self, best: DrivePoint, required: Mapping[Row, float], radius: float
    ) -> DriveStep | None:
        """Form the joint program about the best carry so far, and solve its quadratic model."""
        grid = self._intervals
        values = IntervalValues(grid, self.cell.functions, best.x, best.squared, best.joints)
        program = JointProgram(grid, values, best.x, best.squared, self.cell, required, best.carry)
        box, chosen = self._box(best, radius), program.near()
        steady = np.zeros(program.n)
        steady[: program.n_path] = STEADINESS
        plain = program.curvature().raised(steady)
        first = self._solved(program, chosen, (plain, np.zeros(program.n)), box)
        if first is None:
            return None
        H = program.curvature(first.linear, first.answer.rows)
        active = first.answer.rows > NEGLIGIBLE
        model = convex(H, first.linear.A.of(active), first.linear.b[active])
        second = self._solved(program, chosen, model, box)
        if second is None:
            return None
        residuals = min(
            (self._residuals(program, best, found) for found in (first, second)),
            key=lambda known: known.stationarity + known.complementarity,
        )
        bent = program.geometry_after(second.answer.d)
        if np.abs(bent).max(initial=0.0) > BEND:
            second = self._solved(program, chosen, model, box, bent) or second
        d = second.answer.d
        squared = best.squared.copy()
        squared[1:-1] *= 1.0 + d[program.speeds]
        rows = program.place_rows
        presses = second.answer.rows[len(second.linear.point) :][: len(rows)] > NEGLIGIBLE
        path = d[: program.n_path]
        return DriveStep(
            length=float(np.abs(path).max()),
            required=required,
            residuals=lambda _: residuals,
            iterations=1,
            is_end=_is_optimal(residuals),
            pressing=tuple(row for row, own in zip(rows, presses, strict=True) if own),
            d=path,
            squared=squared,
            gain=max(program.gain(d), 0.0),
        )

    def _solved(
        self,
        program: JointProgram,
        chosen: NDArray[np.bool_],
        model: tuple[BorderedMatrix, Array],
        box: tuple[Array, Array],
        bent: Array | float = 0.0,
    ) -> _StepAnswer | None:
        """Solve a quadratic model; rows that its answer violates are added. `chosen` grows."""
        g = program.gradient() + model[1]
        found: _StepAnswer | None = None
        for left in reversed(range(ROW_ROUNDS)):
            linear = program.linear(chosen, bent)
            asked = QuadraticProgram(model[0], g, linear.A, linear.b, *box)
            answer = solve_quadratic(asked)
            if answer is None:
                # Rows that the box has no room for are asked for as far as they are kept now.
                answer = solve_quadratic(replace(asked, b=np.maximum(linear.b, 0.0)))
            if answer is None:
                return None
            found = _StepAnswer(answer, linear)
            fresh = (program.predicted(answer.d) > ROW_TOLERANCE) & ~chosen
            if not fresh.any():
                break
            chosen |= fresh
            if not left:
                chosen &= ~fresh
        return found

    def _box(self, best: DrivePoint, radius: float) -> tuple[Array, Array]:
        """Bounds of a step."""
        (lower, upper), xi = self._bounds, best.x[self._own]
        speeds = np.ones(self._intervals.intervals - 1)
        low = np.maximum((lower - xi) / self._unit, -radius)
        high = np.minimum((upper - xi) / self._unit, radius)
        return (
            np.concatenate([low, -LEAST_SQUARED * speeds]),
            np.concatenate([high, LARGEST_SQUARED * speeds]),
        )

    def _residuals(self, program: JointProgram, best: DrivePoint, found: _StepAnswer) -> Residuals:
        """Residuals of the program at its iterate, with a step's multipliers. Bounds count where
        they are the variables' own, not the box of trust's."""
        (lower, upper), n, answer = self._bounds, program.n_path, found.answer
        edge, own = 1e-6 * self._unit, answer.bounds[:n]
        reached = best.x[self._own] + self._unit * answer.d[:n]
        at_low = (own < 0.0) & (reached < lower + edge)
        at_high = (own > 0.0) & (reached > upper - edge)
        bounds = np.zeros(program.n)
        bounds[:n] = np.where(at_low | at_high, own, 0.0)
        return program.residuals(bounds, found.linear, answer.rows)

    def climb(self, x: Array) -> Climb[DrivePoint, DriveStep]:
        """A climb from a decision vector (n_var,), before its first round."""
        return Climb(self, x, FIRST_RADIUS)


def _is_optimal(residuals: Residuals) -> bool:
    return (
        residuals.stationarity <= STATIONARY
        and residuals.complementarity <= STATIONARY
        and residuals.feasibility <= FEASIBLE
    )
