"""Selection of rows for a program, and the working set of a solve.

A rejected step tightens the bounds of the rows that it violates. These bounds hold at the end of
the rejected step. Bounds of distances are not smooth, so a much shorter step need not satisfy them.
Therefore only a share of the tightening counts: the share of the way to the rejected candidate that
the trust region covers. With the full tightening, the only feasible step in a small region would
lead to that candidate.

Rows are at local minima along the path. Where two minima are equally low, each step would raise the
one with a row and lower the other, without end. Therefore, in the polish of drivable carries,
active rows stay in the working set while steps are short. After a long step they are dropped, since
they would hold the payload on its former side of an edge.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np

from hybrid_opt.polishing.cell import PlacedCarry, SmoothCell
from hybrid_opt.polishing.constraints.distances import (
    AxisSwitchGaps,
    Clearances,
    DistanceConstraintKind,
    SeparatingAxisGaps,
)
from hybrid_opt.polishing.constraints.kinds import (
    ConstraintKind,
    Forces,
    JointLimits,
    ManipulabilityLimits,
    MinimisedForces,
    Pressure,
)
from hybrid_opt.polishing.rows import ForceRow, PathRow, PressureRow, Row
from symbolic.array import Array
from symbolic.smooth.passage import AxisSwitchGap, SeparatingAxisGap
from symbolic.smooth.path_points import Clearance, JointLimit, ManipulabilityLimit

LEAST_TIGHTENING = 1e-4
"""Smallest rise of a required value that counts as new [m, rad, 1]."""

ACTIVE_ROW_LIFETIME = 3
"""Number of programs for which a row stays in the working set after it was last active."""


class RowSelector:
    """Chooses which rows (single scalar inequalities) a program contains near a candidate.

    A row is kept if it is near its bound, or if a step violated it. In drivable cells no row
    belongs to a sample, because `hybrid_opt.polishing.drive` limits the forces of the timing.
    """

    def __init__(self, cell: SmoothCell) -> None:
        self.forces = Forces(cell)
        self._movable = cell.grid.movable
        self._distances = Clearances(cell)
        sampled: dict[type, ConstraintKind[Any]] = {ForceRow: self.forces}
        if cell.has_pressure_limit:
            sampled[PressureRow] = Pressure(cell)
        driven = cell.task.law.is_drivable
        self._kinds: dict[type, ConstraintKind[Any]] = ({} if driven else sampled) | {
            Clearance: self._distances,
            SeparatingAxisGap: SeparatingAxisGaps(cell),
            AxisSwitchGap: AxisSwitchGaps(cell),
            JointLimit: JointLimits(cell),
            ManipulabilityLimit: ManipulabilityLimits(cell),
        }

    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> set[Row]:
        """Return the rows (scalar inequalities) of all kinds of constraints that are near their
        bounds at a candidate.

        Args:
            carry: the candidate, evaluated at points of the path.
            limits: for each robot, True if its normal force is minimised.
        """
        rows = set[Row]()
        for kind in self._kinds.values():
            for row in kind.near_rows(carry, limits):
                if self._counts(row):
                    rows.add(row)
        return rows

    def violated_rows(
        self, carry: PlacedCarry, known: PlacedCarry, program_rows: Collection[Row]
    ) -> set[Row]:
        """Return the rows (scalar inequalities) of all kinds of constraints that are violated after
        a step.

        Args:
            carry: candidate after the step.
            known: candidate before the step.
            program_rows: rows of the optimisation problem whose solution is the step. Force rows
                among these never count as violated, because a force above its peak only raises the
                peak.
        """
        rows = set[Row]()
        for kind in self._kinds.values():
            for row in kind.violated_rows(carry, known):
                is_peak = isinstance(row, ForceRow) and row in program_rows
                if self._counts(row) and not is_peak:
                    rows.add(row)
        return rows

    def has_violation(
        self, carry: PlacedCarry, known: PlacedCarry, program_rows: Collection[Row]
    ) -> bool:
        """Return True if a candidate violates any constraint after a step.

        Distances are the most expensive, so they are checked last and only until one is too small.

        Args:
            carry: candidate after the step.
            known: candidate before the step.
            program_rows: rows of the program that proposed the step. Force rows among these never
                count as violated.
        """
        return any(
            row not in program_rows or not isinstance(row, ForceRow)
            for kind in self._kinds.values()
            if not isinstance(kind, DistanceConstraintKind)
            for row in kind.violated_rows(carry, known)
            if self._counts(row)
        ) or not carry.distances.exceed(self._distances.least)

    def required_values(
        self, carry: PlacedCarry, rows: Iterable[Row], is_relaxed: bool = False
    ) -> dict[Row, float]:
        """Return the value that each row (scalar inequality) has to exceed in the optimisation
        problem of the next step.

        Args:
            carry: the candidate from which the step starts.
            rows: rows of this optimisation problem.
            is_relaxed: True to require no larger distance between bodies than the candidate has.
        """
        values: dict[Row, float] = {}
        for kind, own in self._by_kind(rows).items():
            values.update(zip(own, kind.required_values(carry, own, is_relaxed), strict=True))
        return values

    def tightened_bounds(
        self,
        carry: PlacedCarry,
        known: PlacedCarry,
        rows: Iterable[Row],
        before: Mapping[Row, float],
    ) -> dict[Row, float]:
        """Return the new, stricter bound of each row (scalar inequality) that a step violated.

        Args:
            carry: candidate after the step.
            known: candidate before the step.
            rows: the violated rows.
            before: bound of each row in the last quadratic program, by row.
        """
        values: dict[Row, float] = {}
        for kind, own in self._by_kind(rows).items():
            margins = [before.get(row, 0.0) for row in own]
            values.update(zip(own, kind.tightened_bounds(carry, known, own, margins), strict=True))
        return values

    def persists(self, row: Row) -> bool:
        """Return True if the tightened bound of a row (scalar inequality) remains valid when the
        best candidate changes; False if it applies only to the candidate at which it was measured.
        """
        return self._kind_of(row).persists

    def _kind_of(self, row: Row) -> ConstraintKind[Any]:
        return self._kinds[type(row.constraint) if isinstance(row, PathRow) else type(row)]

    def _counts(self, row: Row) -> bool:
        return not isinstance(row, PathRow) or self._movable(row.point)

    def _by_kind(self, rows: Iterable[Row]) -> dict[ConstraintKind[Any], list[Row]]:
        groups: dict[ConstraintKind[Any], list[Row]] = {}
        for row in rows:
            groups.setdefault(self._kind_of(row), []).append(row)
        return groups


class WorkingSet:
    """Rows (scalar inequalities) that a solve keeps in its programs, besides the rows that are near
    their bounds.

    These are rows that a rejected step violated, each with the value that it has to exceed, and
    rows that were active in one of the last programs.
    """

    def __init__(self, active: RowSelector, half: Array) -> None:
        """Start with no rows.

        Args:
            active: selector of rows, which knows whether a row's tightened bound stays valid at
                other candidates.
            half: (n,) half ranges of the variables that steps change [m, rad].
        """
        self._active, self._half = active, half
        self._tightened: dict[Row, tuple[float, Array]] = {}
        self._active_for: dict[Row, int] = {}

    @property
    def rows(self) -> set[Row]:
        """All rows (scalar inequalities) of the next program apart from those near their bounds."""
        return {*self._tightened, *self._active_for}

    def tighten(self, required: dict[Row, float], x: Array, radius: float) -> None:
        """Raise the values that rows (scalar inequalities) have to exceed in the next step towards
        the tightened bounds that rejected steps gave them.

        Only a share of the difference between tightened bound and value is added: the radius of the
        trust region over the distance to the candidate at which the bound was tightened, at most 1.

        Args:
            required: value that each row has to exceed, changed in place.
            x: decision vector from which the next step starts; its first n entries are the
                variables that steps change.
            radius: radius of the trust region [half ranges of the variables].
        """
        for row, (value, tightened_at) in self._tightened.items():
            n = len(self._half)
            far = float(np.abs((tightened_at[:n] - x[:n]) / self._half).max())
            share = min(1.0, radius / max(far, 1e-300))
            required[row] += share * max(value - required[row], 0.0)

    def learn_from_rejection(
        self, bounds: Mapping[Row, float], x: Array, required: Mapping[Row, float]
    ) -> bool:
        """Add the rows (scalar inequalities) that a rejected step violates.

        Args:
            bounds: tightened bound of each violated row.
            x: (n_var,) decision vector after the step.
            required: value that each row of the program had to exceed.

        Returns:
            True if any row is new, or if its bound rises by more than `LEAST_TIGHTENING`.
        """
        is_new = False
        for row, value in bounds.items():
            tightened = self._tightened[row][0] if row in self._tightened else -np.inf
            is_new |= value > max(required.get(row, -np.inf), tightened) + LEAST_TIGHTENING
            if value > tightened:
                self._tightened[row] = value, x
        return is_new

    def add(self, rows: Iterable[Row], x: Array) -> None:
        """Add rows (scalar inequalities) that the optimisation problem of a step lacked, without
        tightening their bounds.

        Args:
            rows: the missing rows.
            x: (n_var,) decision vector after the step.
        """
        self._tightened.update(dict.fromkeys(rows, (-np.inf, x)))

    def mark_active(self, rows: Iterable[Row]) -> None:
        """Keep rows (scalar inequalities) in the optimisation problems of the next
        `ACTIVE_ROW_LIFETIME` steps.

        Args:
            rows: rows that have a nonzero multiplier in the last step.
        """
        left = {row: count - 1 for row, count in self._active_for.items() if count > 1}
        self._active_for = left | dict.fromkeys(rows, ACTIVE_ROW_LIFETIME)

    def on_new_best(self, keep_active_set: bool = False) -> None:
        """Discard the tightened bounds that are relative to the former best candidate, because a
        better one was found.

        Args:
            keep_active_set: False to discard also the rows that were active in the last programs.
        """
        if not keep_active_set:
            self._active_for = {}
        self._tightened = {
            row: v for row, v in self._tightened.items() if self._active.persists(row)
        }
