"""One point's polish, in one page: the only loop.

Each round gathers the rows that are near the best candidate so far, takes a step in a box of trust
about it, and has the full model judge where that leads. What the step violates is learned: its rows
are added, or asked for more strictly, and where that is nothing new, the box is halved. A step that
violates nothing and comes closer to what is wanted is taken, so that the answer is never worse than
the start. The polish ends at an optimum inside the box.

How a step is proposed and judged is a `Way`: that of both peak forces, one nonlinear program per
step (`hybrid_opt.polishing.force`), and that of path and timing together, a quadratic model judged
by the compiled timing (`hybrid_opt.polishing.drive`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from hybrid_opt.polishing.carry import CarryReader, PlacedCarry
from hybrid_opt.polishing.cell import SmoothCell
from hybrid_opt.polishing.constraints.active import ActiveSet, LearnedRows
from hybrid_opt.polishing.constraints.kinds import Limits
from hybrid_opt.polishing.rows import PlaceRow, Row
from hybrid_opt.polishing.solvers.base import UNKNOWN, Residuals
from symbolic.array import Array

SETTLING = 5e-4
"""Units of the level by which an optimum that keeps all that is asked for may be worse than the
best candidate, which may keep less, and is taken in its place."""

HALVED, QUARTERED, DOUBLED = 0.5, 0.25, 2.0
"""Factors of the radius."""

LARGEST = 2.0
"""Largest radius, in halves of the decision variables' ranges."""

INSIDE = 0.9
"""Steps shorter than this share of the radius were not stopped by the box."""

GOOD, POOR = 0.7, 0.3
"""Shares of a promised gain above which the box may grow, and below which it shrinks."""


class TrustRegion:
    """The box of trust: half its width, and its policy.

    A trust region in the sense of Conn, Gould and Toint (2000), with the box in place of the ball
    so that it is nothing but bounds. What a step taught counts before the ratio of its gains: a
    step that violated something new is repeated with that in the program, at the same radius.

    Attributes:
        radius: half the width, in halves of the decision variables' ranges.
    """

    def __init__(self, radius: float, least: float) -> None:
        """least: below it a point is left."""
        self.radius, self._least, self._was_good = radius, least, False

    @property
    def is_spent(self) -> bool:
        """Whether it has become too small to go on."""
        return self.radius < self._least

    def holds(self, length: float) -> bool:
        """Whether the box stopped a step of this length."""
        return length >= INSIDE * self.radius

    def lost(self) -> None:
        """There was no step."""
        self.radius *= QUARTERED

    def barren(self, length: float, factor: float = QUARTERED) -> None:
        """A step of this length brought nothing."""
        self.radius = min(self.radius, length) * factor

    def refused(self, learned: bool, length: float = np.inf) -> None:
        """A step violated something; where that was asked for already, the box was too large."""
        self._was_good = False
        if not learned:
            self.radius = HALVED * min(self.radius, length)

    def taken(self, length: float, kept: float | None = None, is_part: bool = False) -> None:
        """A step of this length was good.

        Args:
            kept: share of the promised gain that it brought, None where nothing was promised: then
                two good steps in a row count.
            is_part: whether the whole step was not good: the box becomes as small as this one.
        """
        if is_part:
            self.radius = length
        grows = self._was_good if kept is None else kept > GOOD
        if grows and self.holds(length):
            self.radius = min(DOUBLED * self.radius, LARGEST)
        elif kept is not None and kept <= POOR:
            self.radius *= HALVED
        self._was_good = True


@dataclass
class Solution:
    """Result of a climb, not yet verified.

    Attributes:
        x: (n_var,) the best candidate, the start where nothing was gained.
        message: how it ended.
        converged: whether it ended at an optimum, by the solver's word.
        usable: whether the start could be worked on.
        residuals: at x, in the program of the last round.
        iterations, rounds: in total.
        rows: constraints at places of the path in the round of the residuals.
    """

    x: Array
    message: str = ""
    converged: bool = False
    usable: bool = False
    residuals: Residuals = UNKNOWN
    iterations: int = 0
    rounds: int = 0
    rows: int = 0


@dataclass(frozen=True)
class ClimbPoint:
    """A candidate that the full model has judged.

    Attributes:
        x: (n_var,).
        carry: on places.
        level: what is minimised.
    """

    x: Array
    carry: PlacedCarry
    level: float


@dataclass(frozen=True, kw_only=True)
class Step:
    """A step that a way proposes.

    Attributes:
        length: largest change of a scaled variable.
        required: the rows of its program, and what each had to keep.
        residuals: tells those at a candidate.
        iterations: of the solver.
        is_end: whether where it starts is an optimum already.
        converged: whether it leads to an optimum of its program, by the solver's word.
        pressing: rows at places that have multipliers.
    """

    length: float
    required: Mapping[Row, float]
    residuals: Callable[[ClimbPoint], Residuals] = field(repr=False)
    iterations: int
    is_end: bool = False
    converged: bool = False
    pressing: tuple[PlaceRow, ...] = ()


AnyPoint = TypeVar("AnyPoint", bound=ClimbPoint)
AnyStep = TypeVar("AnyStep", bound=Step)


@dataclass(frozen=True)
class StepVerdict(Generic[AnyPoint]):
    """Verdict of the full model on a step.

    Attributes:
        reached: where it leads; None where that is no closer and teaches nothing.
        closer: whether it comes closer to what is wanted.
        factor: of the radius after a step that comes no closer.
        kept: share of the promised gain, None where nothing was promised.
        part: of the step that leads there.
        surprising: whether it brought more than promised, so that going farther is worth a look.
        is_short: whether rows that press stay.
    """

    reached: AnyPoint | None
    closer: bool
    factor: float = QUARTERED
    kept: float | None = None
    part: float = 1.0
    surprising: bool = False
    is_short: bool = False


class Way(ABC, Generic[AnyPoint, AnyStep]):
    """What one polish wants, and how its steps are proposed and judged.

    Attributes:
        cell, active, reader: rows, and candidates with their places.
        half: (n,) half ranges of the variables that steps move.
        limits: see `Limits`.
        least_radius: of the box of trust, below which a point is left.
        refused_by_length: whether a refused step shrinks the box to less than its own length.
        stays_lenient: whether rows ask for no more than the candidate keeps until a step comes
            closer; otherwise only in the first round. A start may be nearer to obstacles than is
            wanted, and to get away from them must not cost what no step can bring.
        parts: shares of a refused step that are tried in its place, the longest first.
        farther: times a surprising step that are tried after it, the shortest first.
    """

    limits: Limits = (True, True)
    least_radius: float
    refused_by_length: bool = False
    stays_lenient: bool = False
    parts: tuple[float, ...] = ()
    farther: tuple[float, ...] = ()

    def __init__(self, cell: SmoothCell, active: ActiveSet, reader: CarryReader) -> None:
        self.cell, self.active, self.reader = cell, active, reader
        self.half = cell.half

    @abstractmethod
    def start(self, x: Array) -> AnyPoint:
        """Where a climb begins."""

    @abstractmethod
    def propose(
        self, best: AnyPoint, required: Mapping[Row, float], radius: float
    ) -> AnyStep | None:
        """A step within the box of trust about the best candidate; None where there is none."""

    @abstractmethod
    def judge(self, best: AnyPoint, step: AnyStep) -> StepVerdict[AnyPoint]:
        """Where a step leads."""

    @abstractmethod
    def along(
        self, begin: AnyPoint, best: AnyPoint, step: AnyStep, share: float
    ) -> AnyPoint | None:
        """Where a share of a step from its beginning leads; None where that is no closer than the
        best candidate."""

    def missing(self, reached: AnyPoint) -> set[Row]:
        """Rows that a program lacked whose step came no closer."""
        return set()


class Climb(Generic[AnyPoint, AnyStep]):
    """One point's polish, which may be left and gone on with.

    Attributes:
        solution: what it has come to.
        best: the best candidate so far.
    """

    def __init__(self, way: Way[AnyPoint, AnyStep], x: Array, radius: float) -> None:
        """Judge the start.

        Args:
            x: (n_var,) feasible decision vector to start from.
            radius: of the first box of trust.
        """
        self._way, task = way, way.cell.task
        self.best = way.start(np.clip(x, task.lower, task.upper))
        self._first, self._lenient = self.best.level, True
        self._region = TrustRegion(radius, way.least_radius)
        self._learned = LearnedRows(way.active, way.half)
        self._last: Step | None = None
        self.solution = Solution(self.best.x, usable=bool(np.isfinite(self.best.level)))

    @property
    def ended(self) -> bool:
        """Whether more rounds bring nothing."""
        return self.solution.converged or self._region.is_spent or not self.solution.usable

    def go_on(self, rounds: int, least_gain: float = 0.0) -> Solution:
        """Some more rounds, fewer where it ends.

        Args:
            least_gain: share of the level that two rounds in a row have to bring once a step was
                taken, or it is left. Before that, refused steps teach, and say nothing of gains.
        """
        solution, levels = self.solution, [self.best.level]
        for _ in range(rounds):
            if self.ended:
                break
            solution.rounds += 1
            self._round()
            if len(levels) > 1 or self.best.level != levels[0]:
                levels.append(self.best.level)
            if len(levels) > 3 and levels[-3] - levels[-1] < least_gain * levels[-1]:
                break
        solution.x = self.best.x
        if self._last is not None:
            solution.residuals = self._last.residuals(self.best)
            solution.rows = sum(isinstance(row, PlaceRow) for row in self._last.required)
        if not solution.usable:
            solution.message = "the start cannot be judged"
        elif solution.converged:
            solution.message = "stationary"
        else:
            solution.message = "the box of trust is spent" if self.ended else "out of rounds"
        return solution

    def _round(self) -> None:
        way, best, region = self._way, self.best, self._region
        lenient, self._lenient = self._lenient, self._lenient and way.stays_lenient
        required = self._learned.required(best.carry, way.limits, best.x, region.radius, lenient)
        step = way.propose(best, required, region.radius)
        if step is None:
            region.lost()
            return
        self._last = step
        self.solution.iterations += step.iterations
        self._learned.press(step.pressing)
        if step.is_end:
            self.solution.converged = True
            return
        judged = way.judge(best, step)
        self._lenient = way.stays_lenient and not judged.closer
        if judged.reached is None:
            region.barren(step.length, judged.factor)
        elif not self._refuses(step, judged.reached):
            if judged.closer:
                self._take(step, judged, judged.reached)
            else:
                self._stay(step, judged.reached)

    def _refuses(self, step: AnyStep, reached: AnyPoint) -> bool:
        """Learn from what a step violates, if it does; the longest part of it that violates nothing
        and comes closer is taken, if there is one."""
        best, carry = self.best, reached.carry
        violated = self._way.active.violated(carry, best.carry, step.required)
        if not violated and carry.is_followed:
            return False
        learned = self._learned.refuse(carry, best.carry, reached.x, violated, step.required)
        length = step.length if self._way.refused_by_length else np.inf
        self._region.refused(learned and carry.is_followed, length)
        for share in self._way.parts:
            if self._goes(best, step, share):
                break
        return True

    def _take(self, step: AnyStep, judged: StepVerdict[AnyPoint], reached: AnyPoint) -> None:
        begin = self.best
        self._move(reached, judged.is_short)
        self.solution.converged = step.converged and not self._region.holds(step.length)
        if judged.surprising:
            for times in self._way.farther:
                if not self._goes(begin, step, times, judged.is_short):
                    break
        self._region.taken(judged.part * step.length, judged.kept, judged.part < 1.0)

    def _stay(self, step: AnyStep, reached: AnyPoint) -> None:
        """A step that violates nothing came no closer: its program lacked rows, or it ended at an
        optimum, or the box is too large."""
        asked = self._way.missing(reached) - step.required.keys()
        self._learned.ask(asked, reached.x)
        if step.converged and not asked and not self._region.holds(step.length):
            self.solution.converged = True
            if reached.level < min(self._first, self.best.level + SETTLING):
                self._move(reached)
        elif not asked:
            self._region.barren(step.length)

    def _goes(self, begin: AnyPoint, step: AnyStep, share: float, is_short: bool = False) -> bool:
        """Go to a share of a step if that is closer and violates nothing; whether it is."""
        reached = self._way.along(begin, self.best, step, share)
        if reached is None or not reached.carry.is_followed:
            return False
        if self._way.active.violates(reached.carry, self.best.carry, step.required):
            return False
        self._move(reached, is_short)
        return True

    def _move(self, reached: AnyPoint, is_short: bool = False) -> None:
        self.best = reached
        self._learned.move(is_short)
