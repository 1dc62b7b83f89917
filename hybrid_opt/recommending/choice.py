"""Choice of a carry among the paths of a drivable front, according to a wish.

Every path is timed within several limits of the planned force. Each timing is an option: a duration
of the carry, and a commanded force that holds the box in every case of the cell's uncertainty. A
wish limits the duration or the force of an option, and may replace numbers of the cell.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hybrid_opt.carry import BoxMotion
from hybrid_opt.cell import Cell
from hybrid_opt.robust.budget import GripBudget
from hybrid_opt.robust.cases import LEADER
from hybrid_opt.robust.force import robust_model
from hybrid_opt.static_hold import static_hold_error
from hybrid_opt.timing.records import PathTiming, TimingLimits
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty, Workcell
from symbolic.records.cell import RANGES

_UNITS = {"duration": "s", "force": "N", "payload": "kg", "reference_force": "N"}

FORCES = 10
"""Number of force limits within which every path is timed at first. They are closer together where
the force is small."""

ROUNDS = 6

LEAST_ABOVE_STILL = 1e-3
"""The smallest force limit exceeds the force at rest by this share."""

SAMPLES_PRESSED = 32
"""Number of samples of largest planned force for which the commanded force is computed."""


@dataclass(frozen=True)
class Wish:
    """The user's target of a recommendation, and changes of the cell for which the recommendation
    is made.

    `duration` and `force` exclude each other. Without either, the product of duration and commanded
    force is minimised.

    Attributes:
        duration: longest allowed duration of the carry within the jerk limits [s]; the commanded
            force is then minimised.
        force: largest allowed commanded force [N]; the duration is then minimised.
        payload: mass of the payload in place of the cell's [kg]; its inertia grows in proportion.
        reference_force: reference force of both robots in place of the cell's [N].
        uncertainty: uncertainty in place of the cell's; None keeps the cell's.
    """

    duration: float | None = None
    force: float | None = None
    payload: float | None = None
    reference_force: float | None = None
    uncertainty: Uncertainty | None = None

    def __post_init__(self) -> None:
        """Check that at most one of duration and force is given, and that all numbers are positive.

        Raises:
            SettingsError: both a duration and a force are given, or a number is not positive.
        """
        if self.duration is not None and self.force is not None:
            raise SettingsError(
                "duration and force are wished for; give at most one of them", code="two-wishes"
            )
        for name, value in self.numbers.items():
            if not 0.0 < value < math.inf:
                raise SettingsError(
                    f"{name} {value:g} {_UNITS[name]}: allowed are positive finite numbers"
                )

    @property
    def numbers(self) -> dict[str, float]:
        """Numbers of this wish that are not None, by attribute name; the uncertainty is not among
        them.
        """
        values = {name: getattr(self, name) for name in _UNITS}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def has_target(self) -> bool:
        """True if the user gave a duration or a force."""
        return self.duration is not None or self.force is not None

    @property
    def target(self) -> str:
        """The user's target as a text."""
        if self.duration is not None:
            return f"the least force of all carries of at most {self.duration:g} s"
        if self.force is not None:
            return f"the shortest of all carries that need at most {self.force:g} N commanded"
        return "least product of duration and commanded force"

    def __str__(self) -> str:
        replaced = [
            *([] if self.payload is None else [f"a payload of {self.payload:g} kg"]),
            *(
                []
                if self.reference_force is None
                else [f"reference forces of {self.reference_force:g} N"]
            ),
            *([] if self.uncertainty is None else [f"the uncertainty {self.uncertainty}"]),
        ]
        return f"{self.target}{', with ' if replaced else ''}{' and '.join(replaced)}"


def wished_cell(cell: Cell, wish: Wish) -> Cell:
    """Return the cell with the payload, reference forces and uncertainty that a user wishes.

    Args:
        cell: the cell.
        wish: values that replace those of the cell.

    Raises:
        SettingsError: robots and pads cannot hold the payload still.
        WorkcellError: the cell with these values is invalid.
    """
    known, changes = cell.workcell, dict[str, Any]()
    if wish.payload is not None and wish.payload != known.payload.mass:
        inertia = wish.payload / known.payload.mass * known.payload.inertia
        changes |= {"payload.mass": wish.payload, "payload.inertia": inertia}
    force = wish.reference_force
    if force is not None and (known.task.reference_force != force).any():
        changes["task.reference_force"] = force
    if wish.uncertainty is not None:
        ranges = {name: getattr(wish.uncertainty, name) for name in (*RANGES, "stiffness")}
        if any(np.any(value != getattr(known.uncertainty, name)) for name, value in ranges.items()):
            changes |= {f"uncertainty.{name}": value for name, value in ranges.items()}
    if not changes:
        return cell
    found = cell.changed(changes)
    reason = static_hold_error(found.workcell)
    if reason:
        raise SettingsError(f"{_listed(wish)}: {reason}")
    return found


def _listed(wish: Wish) -> str:
    return ", ".join(f"{name} {value:g} {_UNITS[name]}" for name, value in wish.numbers.items())


@dataclass(frozen=True)
class Goal:
    """Limits that a timed path has to keep, and the cost by which timed paths are compared.

    Attributes:
        longest: largest allowed duration [s].
        hardest: (2,) largest allowed robust force of each robot [N].
        cost: function of duration [s] and commanded force [N] to minimise.
    """

    longest: float
    hardest: Array
    cost: Callable[[float, float], float]

    @classmethod
    def of(cls, wish: Wish, workcell: Workcell) -> Goal:
        """Convert a user's wish to limits and a cost.

        Each robot's force is limited by its reference force, also if the wish states no force.

        Args:
            wish: the user's target.
            workcell: the cell, with the reference forces.
        """
        allowed, longest = workcell.task.reference_force, math.inf
        cost: Callable[[float, float], float] = operator.mul
        if wish.force is not None:
            allowed, cost = commanded_at_most(wish.force, allowed), duration_alone
        elif wish.duration is not None:
            longest, cost = wish.duration, force_alone
        return cls(longest, allowed, cost)


def commanded_at_most(force: float, others: Array | float = np.inf) -> Array:
    """Return the upper bounds (2,) of both robots' normal forces [N] that follow from a limit on
    the commanded force, which is the force of the force-controlled arm.

    Args:
        force: largest allowed commanded force [N].
        others: further upper bound of the forces, one for both robots or one per robot (2,) [N].
    """
    found = np.broadcast_to(others, 2).astype(float)
    found[1 - LEADER] = min(found[1 - LEADER], force)
    return found


def duration_alone(duration: float, force: float) -> float:
    """Return the duration as the cost of a timed path.

    Args:
        duration: duration [s].
        force: commanded force; not used.
    """
    return duration


def force_alone(duration: float, force: float) -> float:
    """Return the commanded force as the cost of a timed path.

    Args:
        duration: duration; not used.
        force: commanded force [N].
    """
    return force


class DrivenPaths:
    """Paths of one drivable cell, with stored geometry, to be timed repeatedly within force limits.

    The carries of a drivable cell are timed from rest to rest within all limits of robots, payload
    and pads. The timings here satisfy all of them except those on jerk.

    Attributes:
        x: (k, n_path) decision vectors of k paths, without the force limit.
        highest_force: largest force limit that is tried [N].
        robust: True if force limits bound the robust forces, False if they bound the planned
            forces.
    """

    def __init__(self, cell: Cell, x: Array) -> None:
        """Compute the geometry of the paths.

        Args:
            cell: drivable cell.
            x: (k, n_path) decision vectors of the paths, without the force limit.
        """
        self.x = np.atleast_2d(np.asarray(x, dtype=float))
        self._model = robust_model(cell.workcell)
        self.highest_force = cell.workcell.task.force_limit[1]
        self._timer, self.robust = cell.path_timer, cell.force_kind.robust
        # Each timing has a force limit of its own.
        self._limits = TimingLimits(force=1.0, robust=self.robust)
        self._known = self._timer.path_limits(self.x)
        self._failures = self._timer.path_errors(self._known)

    def __len__(self) -> int:
        return len(self.x)

    def _driven(
        self, force: Array | float, rows: Sequence[int] | None = None
    ) -> list[tuple[int, float, PathTiming]]:
        """Compute the fastest timing of paths within force limits.

        Args:
            force: force limit [N]: one for each timed path, or one for all of them.
            rows: indices of the paths to time; None for all.

        Returns:
            For each timed path its index, its force limit [N], and its timing.
        """
        chosen = list(range(len(self)) if rows is None else rows)
        limits = np.broadcast_to(np.asarray(force, dtype=float), (len(chosen),))
        known = self._known
        if rows is not None:
            known = {name: values[chosen] for name, values in known.items()}
        timings = self._timer.time_all(
            self.x[chosen],
            self._limits,
            limits,
            known,
            [self._failures[row] for row in chosen],
        )
        return list(zip(chosen, limits.tolist(), timings, strict=True))

    def durations(self, force: Array | float) -> Array:
        """Compute the shortest duration (k,) of each path within a force limit [s].

        The duration is infinite for a path that has no timing within the limit.

        Args:
            force: force limit, one per path (k,) or one for all [N].
        """
        return np.array([timing.duration for _, _, timing in self._driven(force)])

    def options(self, force: Array | float, rows: Sequence[int] | None = None) -> list[Option]:
        """Compute the fastest timing of paths within force limits. Paths that have none within
        their limit are left out.

        Args:
            force: force limit, one per timed path or one for all [N].
            rows: indices of the paths to time; None for all.
        """
        found = []
        for row, limit, timing in self._driven(force, rows):
            if timing.ok:
                found.append(self._option(row, limit, timing))
        return found

    def _option(self, row: int, limit: float, timing: PathTiming) -> Option:
        speed = timing.grid_speed
        a = np.repeat(np.diff(speed**2) * (len(speed) - 1) / 2.0, 2)
        v = np.stack([speed[:-1], speed[1:]], axis=1).reshape(-1)
        # Both ends of every interval; between them paths have a sample in the middle.
        at = np.repeat(2 * np.arange(len(speed) - 1), 2) + np.tile([0, 2], len(speed) - 1)
        pose, first, second = (
            np.ascontiguousarray(self._known[name][row][at, :6])
            for name in ("pose", "pose_first", "pose_second")
        )
        rate, second_rate = first * v[:, None], first * a[:, None] + second * v[:, None] ** 2
        motion = BoxMotion(pose, rate, second_rate)
        most = np.argsort(-self._model.nominal(motion).max(axis=1))[:SAMPLES_PRESSED]
        force = self._model.peak(motion.at(most), self._model.workcell.uncertainty, LEADER)
        return Option(row, limit, timing.duration, force)

    def all_options(
        self, own: Array | float, told: Callable[[], None] = lambda: None
    ) -> list[Option]:
        """Compute timings of every path: one within the path's own force limit, and one within each
        of `FORCES` further limits.

        The further limits of a path lie between slightly more than the force that holds the box at
        rest and `highest_force`. There are none if force limits apply to robust normal forces,
        which hold the box in every case of the uncertainty.

        Args:
            own: force limit with which each path was found [N]: one per path (k,), or one for all
                paths.
            told: function without arguments that advances a progress display; it is called `FORCES`
                times.
        """
        found, limits = self.options(own), []
        if not self.robust:
            still = np.array([timing.limited_force for _, _, timing in self._driven(1e-6)])
            least = np.where(np.isfinite(still), still, self.highest_force)
            low = np.minimum((1.0 + LEAST_ABOVE_STILL) * least, self.highest_force)
            # Closer together where force is least and durations change most.
            shares = np.linspace(0.0, 1.0, FORCES) ** 2
            limits = [low + share * (self.highest_force - low) for share in shares]
        for k in range(FORCES):
            for limit in limits[k : k + 1]:
                found += self.options(limit)
            told()
        return found


@dataclass(frozen=True)
class Option:
    """One path, timed within one force limit.

    Attributes:
        index: index of the path in its `DrivenPaths`.
        limit: force limit [N].
        duration: duration of the timing, without regard to jerk limits [s].
        force: (2,) largest robust force of each robot [N].
    """

    index: int
    limit: float
    duration: float
    force: Array

    @property
    def commanded(self) -> float:
        """Largest normal force of the force-controlled arm [N]."""
        return float(self.force[1 - LEADER])


def ranked(options: Sequence[Option], goal: Goal) -> list[Option]:
    """Return the timed paths that keep the limits of a goal, in order of increasing cost.

    Args:
        options: timed paths.
        goal: limits, and the cost to minimise.
    """
    kept = [
        option
        for option in options
        if option.duration <= goal.longest and (option.force <= goal.hardest).all()
    ]
    return sorted(kept, key=lambda option: goal.cost(option.duration, option.commanded))


def best_of_paths(
    paths: DrivenPaths, options: Sequence[Option], goal: Goal, most: int
) -> Iterator[Option]:
    """Yield the best paths that keep the limits of a goal, each with its timing of least cost, in
    order of cost.

    Force limits between the limits of the given timings are tried as well.

    Args:
        paths: paths to which the timings belong.
        options: timings that are known already.
        goal: limits, and cost to minimise.
        most: largest number of paths that are yielded.
    """
    best: dict[int, Option] = {}
    for option in ranked(options, goal):
        best.setdefault(option.index, option)
    for option in list(best.values())[:most]:
        known = [other for other in options if other.index == option.index]
        for _ in range(ROUNDS):
            limits = sorted(other.limit for other in known)
            at = limits.index(option.limit)
            low, high = limits[max(at - 1, 0)], limits[min(at + 1, len(limits) - 1)]
            if low < high:
                between = np.linspace(low, high, 5)[1:-1]
                known += paths.options(between, [option.index] * len(between))
            option = ranked(known, goal)[0]
        yield option


def gentle_start(cell: Cell) -> Array:
    """Return the decision vector (n_var,) of the hand-made path with its best force limit.

    This limit gives the least product of duration and commanded force, with forces within the
    reference forces. If every limit leads to larger forces, the limit with the least commanded
    force is taken.

    Args:
        cell: drivable cell: its carries are timed from rest to rest within all limits.
    """
    paths = DrivenPaths(cell, cell.initial[:-1])
    options = paths.all_options(float(cell.initial[-1]))
    best = next(best_of_paths(paths, options, Goal.of(Wish(), cell.workcell), 1), None)
    if best is None:
        best = min(options, key=lambda each: each.commanded, default=None)
    return cell.initial if best is None else np.append(paths.x[0], best.limit)


def refuse(options: Sequence[Option], wish: Wish, goal: Goal, budget: GripBudget) -> None:
    """Raise an error if no timed path fulfils a user's wish. The message states the possible
    durations and forces.

    Args:
        options: timed paths of the front.
        wish: the wish, for the message.
        goal: limits that follow from the wish.
        budget: grip budget of the cell, for the message.

    Raises:
        SettingsError: no timed path fulfils the wish.
    """
    if ranked(options, goal):
        return
    held = ranked(options, replace(goal, longest=math.inf))
    if wish.duration is not None and held:
        shortest = min(option.duration for option in held)
        raise SettingsError(
            f"duration {wish.duration:g} s: no carry of the front is so short; the shortest takes "
            f"{shortest:.3f} s, before limits on jerk",
            code="too-short",
        )
    if not options:
        raise SettingsError("no carry of the front can be driven: it cannot even be held still")
    least = min(option.commanded for option in options)
    remedies = f". {budget.advice}" if budget.advice else ""
    raise SettingsError(
        f"{_listed(wish)}: no carry of the front holds within {goal.hardest.min():.1f} N in every "
        f"case of {budget.uncertainty.title}; the gentlest needs {least:.1f} N commanded; "
        f"{budget}{remedies}",
        code="too-gentle",
    )
