"""Selection of rows for a program, and the working set of a solve.

A bound that a rejected step tightened was measured where that step led. Bounds of distances are not
smooth, and a much shorter step need not satisfy them. So only the share of the tightening counts
that the trust region reaches of the way to the candidate that caused it. With the full tightening
in a small region the only feasible step would be to that candidate.

Rows are at local minima along the path. Where two minima are equally low, each step raises the one
with a row and lowers the other, without end. Therefore, in the polish of drivable carries, active
rows stay in the working set while steps are short. After a long step they would hold the payload on
its former side of an edge.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np

from hybrid_opt.polishing.carry import PlacedCarry
from hybrid_opt.polishing.cell import SmoothCell
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
from symbolic.smooth.places import Clearance, JointLimit, ManipulabilityLimit

LEAST_TIGHTENING = 1e-4
"""Least rise of a required value that counts as new [m, rad, 1]."""

ACTIVE_ROW_LIFETIME = 3
"""Programs for which a row stays after it was active last."""


class RowSelector:
    """Selects the rows of a program for candidates of one evaluator.

    Carries in drivable cells have no rows at samples: `hybrid_opt.polishing.drive`
    limits their forces.
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
        """Return rows of all constraints near their bounds at a candidate."""
        rows = set[Row]()
        for kind in self._kinds.values():
            for row in kind.near_rows(carry, limits):
                if self._counts(row):
                    rows.add(row)
        return rows

    def violated_rows(
        self, carry: PlacedCarry, known: PlacedCarry, program_rows: Collection[Row]
    ) -> set[Row]:
        """Return rows of all constraints that a step from a known candidate violates.

        Args:
            program_rows: rows of the program. Their forces are no violation: they raise the peaks.
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
        """Return True if a step violates anything; distances, the most expensive, are checked last
        and only until one is too small."""
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
        """Return the required value of each row at a candidate; see `ConstraintKind`."""
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
        """Return the required values of violated rows; see `ConstraintKind`."""
        values: dict[Row, float] = {}
        for kind, own in self._by_kind(rows).items():
            margins = [before.get(row, 0.0) for row in own]
            values.update(zip(own, kind.tightened_bounds(carry, known, own, margins), strict=True))
        return values

    def persists(self, row: Row) -> bool:
        """Return True if a row's tightened bound stays valid at other candidates."""
        return self._kind_of(row).persists

    def _kind_of(self, row: Row) -> ConstraintKind[Any]:
        return self._kinds[type(row.constraint) if isinstance(row, PathRow) else type(row)]

    def _counts(self, row: Row) -> bool:
        return not isinstance(row, PathRow) or self._movable(row.place)

    def _by_kind(self, rows: Iterable[Row]) -> dict[ConstraintKind[Any], list[Row]]:
        groups: dict[ConstraintKind[Any], list[Row]] = {}
        for row in rows:
            groups.setdefault(self._kind_of(row), []).append(row)
        return groups


class WorkingSet:
    """Rows added by the steps of one solve, with the value that each has to exceed."""

    def __init__(self, active: RowSelector, half: Array) -> None:
        """Start empty.

        Args:
            active: selects rows.
            half: (n,) half ranges of the variables that steps move.
        """
        self._active, self._half = active, half
        self._tightened: dict[Row, tuple[float, Array]] = {}
        self._active_for: dict[Row, int] = {}

    def required_values(
        self, carry: PlacedCarry, limits: MinimisedForces, x: Array, radius: float, is_relaxed: bool
    ) -> dict[Row, float]:
        """Return the rows of the next program about a candidate, and their required values.

        Args:
            carry: the candidate's.
            x: its variables, (n,) or more.
            radius: of the trust region.
            is_relaxed: see `ConstraintKind.required_values`.
        """
        rows = (
            self._active.near_rows(carry, limits) | self._tightened.keys() | self._active_for.keys()
        )
        required = self._active.required_values(carry, rows, is_relaxed)
        for row, (value, tightened_at) in self._tightened.items():
            n = len(self._half)
            far = float(np.abs((tightened_at[:n] - x[:n]) / self._half).max())
            share = min(1.0, radius / max(far, 1e-300))
            required[row] += share * max(value - required[row], 0.0)
        return required

    def learn_from_rejection(
        self,
        carry: PlacedCarry,
        known: PlacedCarry,
        x: Array,
        violated: Iterable[Row],
        required: Mapping[Row, float],
    ) -> bool:
        """Add the rows that a step to x violated; return True if any is new or tighter.

        Args:
            carry, known: after the step, and before.
            required: rows of the program and their required values.
        """
        is_new = False
        for row, value in self._active.tightened_bounds(carry, known, violated, required).items():
            tightened = self._tightened[row][0] if row in self._tightened else -np.inf
            is_new |= value > max(required.get(row, -np.inf), tightened) + LEAST_TIGHTENING
            if value > tightened:
                self._tightened[row] = value, x
        return is_new

    def add(self, rows: Iterable[Row], x: Array) -> None:
        """Add the rows that were missing for a step to x, with their usual bounds."""
        self._tightened.update(dict.fromkeys(rows, (-np.inf, x)))

    def mark_active(self, rows: Iterable[Row]) -> None:
        """Keep rows with multipliers for the next `ACTIVE_ROW_LIFETIME` programs."""
        left = {row: count - 1 for row, count in self._active_for.items() if count > 1}
        self._active_for = left | dict.fromkeys(rows, ACTIVE_ROW_LIFETIME)

    def on_new_best(self, keep_active_set: bool = False) -> None:
        """Discard bounds relative to the former candidate, and after a long step the active
        rows."""
        if not keep_active_set:
            self._active_for = {}
        self._tightened = {
            row: v for row, v in self._tightened.items() if self._active.persists(row)
        }
