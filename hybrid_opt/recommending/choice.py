"""The carry that a wish names among the paths of a drivable front, which are timed anew at
any force, or so that they take a given time."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from hybrid_opt.cell import Cell
from hybrid_opt.indicators.selection import knee
from hybrid_opt.timing.path_timer import PathTimer, PathTiming
from hybrid_opt.timing.records import TimingLimits
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell

_UNITS = {"duration": "s", "force": "N", "payload": "kg"}

BISECTIONS = 30

LEAST_ABOVE_STILL = 1e-4
"""Where the search for a force begins, as a share above that of holding still."""


@dataclass(frozen=True)
class Wish:
    """At most one of three wishes; without any, the knee of the front is meant.

    Attributes:
        duration: the carry may take so long; asked for is the least force [s].
        force: neither robot may press harder; asked for is the shortest duration [N].
        payload: both robots have to bear so heavy a box within their reference forces on the same
            motion; asked for is the shortest duration [kg].
    """

    duration: float | None = None
    force: float | None = None
    payload: float | None = None

    def __post_init__(self) -> None:
        """Refuse more than one wish, and what is no positive number.

        Raises:
            SettingsError: with what was found.
        """
        given = self.given
        if len(given) > 1:
            raise SettingsError(f"{' and '.join(given)} are wished for; give at most one of them")
        for name, value in given.items():
            if not 0.0 < value < math.inf:
                raise SettingsError(
                    f"{name} {value:g} {_UNITS[name]}: allowed are positive finite numbers"
                )

    @property
    def given(self) -> dict[str, float]:
        """The wishes by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def __str__(self) -> str:
        for name, value in self.given.items():
            return {
                "duration": f"the least force of all carries of at most {value:g} s",
                "force": f"the shortest of all carries that press with at most {value:g} N",
                "payload": f"the shortest of all carries that would bear {value:g} kg",
            }[name]
        return "the knee of the front: one per cent less time costs more than a per cent of force"


class DrivenPaths:
    """Paths of one cell with their geometry, so that each further timing is cheap.

    Attributes:
        x: (k, n_path) free waypoints.
        highest_force: the largest force limit that is tried [N].
    """

    def __init__(
        self, timer: PathTimer, x: Array, highest_force: float, robust: bool = False
    ) -> None:
        """Compute the geometry of the paths.

        Args:
            timer: of the cell.
            x: (k, n_path) free waypoints.
            highest_force: the largest force limit that is tried [N].
            robust: whether limits hold in every case of the cell's uncertainty.
        """
        self.x = np.atleast_2d(np.asarray(x, dtype=float))
        self.highest_force = highest_force
        self._timer, self._robust = timer, robust
        self._known = timer.path_limits(self.x)
        self._failures = timer.failures(self._known)

    @classmethod
    def of(cls, cell: Cell, x: Array) -> DrivenPaths:
        """Paths of a cell within the limits of its drivable carries."""
        highest = cell.workcell.task.force_limit[1]
        return cls(cell.path_timer, x, highest, cell.force_kind.robust)

    def __len__(self) -> int:
        return len(self.x)

    def timings(self, force: Array | float) -> list[PathTiming]:
        """The fastest timing of every path within force limits (k,) or one for all [N]."""
        limits = np.broadcast_to(np.asarray(force, dtype=float), (len(self),))
        return self._timer.time_known(
            self.x,
            self._known,
            [TimingLimits(force=float(limit), robust=self._robust) for limit in limits],
            self._failures,
        )

    def durations(self, force: Array | float) -> Array:
        """(k,) durations [s], infinite where nothing moves within the limit."""
        return np.array([timing.duration for timing in self.timings(force)])

    def forces(self, duration: float) -> Array:
        """(k,) least force limits with which the paths take at most a duration, inf for none [N].

        Durations fall as the limit rises, so bisection finds it.
        """
        still = np.array([timing.limited_force for timing in self.timings(1e-6)])
        low = np.where(np.isfinite(still), still, 1.0) * (1.0 + LEAST_ABOVE_STILL)
        high = np.full(len(self), max(self.highest_force, float(low.max())))
        possible = self.durations(high) <= duration
        for _ in range(BISECTIONS):
            middle = (low + high) / 2.0
            enough = self.durations(middle) <= duration
            low, high = np.where(enough, low, middle), np.where(enough, middle, high)
        return np.where(possible, high, np.inf)


@dataclass(frozen=True)
class Choice:
    """A path and the force it is driven with.

    Attributes:
        index: of the path.
        force: limit on both normal forces [N].
    """

    index: int
    force: float


def force_for_payload(workcell: Workcell, payload: float) -> float:
    """Normal force limit [N] within which both robots would bear a payload [kg] on the same motion.

    Forces grow in proportion to the mass, and the friction cone bounds the whole force of a contact
    by sqrt(1 + mu^2) times its normal force, so the whole force of neither robot can exceed its
    reference force.
    """
    friction = np.array([contact.friction for contact in workcell.contacts])
    normal = workcell.task.reference_force / np.sqrt(1.0 + friction**2)
    return float(normal.min()) * workcell.payload.mass / payload


def choices(workcell: Workcell, paths: DrivenPaths, points: Array, wish: Wish) -> Iterator[Choice]:
    """Answers to a wish, best first.

    Args:
        workcell: the cell.
        paths: of the front's members.
        points: (k, 2) duration [s] and largest limited force [N] of the members themselves.
        wish: what is asked for.

    Raises:
        SettingsError: no member can do it; the message says what is possible.
    """
    if wish.duration is not None:
        yield from _by_duration(paths, wish.duration)
    elif wish.force is not None or wish.payload is not None:
        yield from _by_force(workcell, paths, wish)
    else:
        # At the knee's force another path may be faster than the one that was a member there.
        force = float(points[knee(points), 1])
        yield from _by_force(workcell, paths, Wish(force=force))


def _by_duration(paths: DrivenPaths, duration: float) -> Iterator[Choice]:
    forces = paths.forces(duration)
    if not np.isfinite(forces).any():
        shortest = float(paths.durations(paths.highest_force).min())
        raise SettingsError(
            f"duration {duration:g} s: no carry of the front is so short; the shortest takes "
            f"{shortest:.3f} s"
        )
    for row in np.argsort(forces, kind="stable")[: int(np.isfinite(forces).sum())].tolist():
        yield Choice(row, float(forces[row]))


def _by_force(workcell: Workcell, paths: DrivenPaths, wish: Wish) -> Iterator[Choice]:
    if wish.payload is not None:
        force = force_for_payload(workcell, wish.payload)
        asked = f"payload {wish.payload:g} kg, so {force:.2f} N at {workcell.payload.mass:g} kg"
    else:
        assert wish.force is not None, "one of both is wished for"
        force, asked = wish.force, f"force {wish.force:g} N"
    force = min(force, paths.highest_force)
    durations = paths.durations(force)
    if not np.isfinite(durations).any():
        still = min(timing.limited_force for timing in paths.timings(1e-6))
        raise SettingsError(
            f"{asked}: no carry of the front moves with so little; holding still takes {still:.2f} "
            "N already"
        )
    for row in np.argsort(durations, kind="stable")[: int(np.isfinite(durations).sum())].tolist():
        yield Choice(row, force)
