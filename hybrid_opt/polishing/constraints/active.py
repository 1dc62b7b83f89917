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
"""Smallest rise of a required value that counts as new [m, rad, 1]."""

ACTIVE_ROW_LIFETIME = 3
"""Number of programs for which a row stays in the working set after it was last active."""


class RowSelector:
    """Selector of the rows of programs for candidates of one evaluator.

    In drivable cells there are no rows at samples: `hybrid_opt.polishing.drive` limits the forces
    of the timing.
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
        """Return the rows of all constraints that are near their bounds at a candidate."""
        rows = set[Row]()
        for kind in self._kinds.values():
            for row in kind.near_rows(carry, limits):
                if self._counts(row):
                    rows.add(row)
        return rows

    def violated_rows(
        self, carry: PlacedCarry, known: PlacedCarry, program_rows: Collection[Row]
    ) -> set[Row]:
        """Return the rows of all constraints that a step from a known candidate violates.

        Args:
            carry: candidate after the step.
            known: candidate before the step.
            program_rows: rows of the program. Their force rows are never violated, because a force
                above its peak raises the peak.
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
        """Return True if a step violates any constraint. Distances are the most expensive, so they
        are checked last and only until one is too small."""
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
        """Return the value that each row has to exceed. The kind of the row computes it from a
        candidate, for example from the distances there."""
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
        """Return the values that violated rows have to exceed from now on, computed by the kinds of
        the rows."""
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
    """Rows that the steps of one solve have added, with the value that each has to exceed."""

    def __init__(self, active: RowSelector, half: Array) -> None:
        """Start with no rows.

        Args:
            active: selector of rows.
            half: (n,) half ranges of the variables that steps move.
        """
        self._active, self._half = active, half
        self._tightened: dict[Row, tuple[float, Array]] = {}
        self._active_for: dict[Row, int] = {}

    @property
    def rows(self) -> set[Row]:
        """Return the rows that the next program has beside those near their bounds."""
        return {*self._tightened, *self._active_for}

    def tighten(self, required: dict[Row, float], x: Array, radius: float) -> None:
        """Raise the required values of the next program's rows, in place.

        Args:
            required: all rows of the program, and their required values.
            x: variables of the candidate that the program is about, (n,) or more.
            radius: radius of the trust region.
        """
        for row, (value, tightened_at) in self._tightened.items():
            n = len(self._half)
            far = float(np.abs((tightened_at[:n] - x[:n]) / self._half).max())
            share = min(1.0, radius / max(far, 1e-300))
            required[row] += share * max(value - required[row], 0.0)

    def learn_from_rejection(
        self, bounds: Mapping[Row, float], x: Array, required: Mapping[Row, float]
    ) -> bool:
        """Add the rows that a rejected step to x violates; return True if any row is new or gets a
        tighter bound.

        Args:
            bounds: the violated rows, and their tightened bounds.
            x: decision vector after the step.
            required: rows of the program and their required values.
        """
        is_new = False
        for row, value in bounds.items():
            tightened = self._tightened[row][0] if row in self._tightened else -np.inf
            is_new |= value > max(required.get(row, -np.inf), tightened) + LEAST_TIGHTENING
            if value > tightened:
                self._tightened[row] = value, x
        return is_new

    def add(self, rows: Iterable[Row], x: Array) -> None:
        """Add rows that the program of a step to x lacked, with their usual bounds."""
        self._tightened.update(dict.fromkeys(rows, (-np.inf, x)))

    def mark_active(self, rows: Iterable[Row]) -> None:
        """Keep these active rows for the next `ACTIVE_ROW_LIFETIME` programs."""
        left = {row: count - 1 for row, count in self._active_for.items() if count > 1}
        self._active_for = left | dict.fromkeys(rows, ACTIVE_ROW_LIFETIME)

    def on_new_best(self, keep_active_set: bool = False) -> None:
        """Discard bounds that are relative to the former best candidate. Unless `keep_active_set`
        is True, discard the active rows too."""
        if not keep_active_set:
            self._active_for = {}
        self._tightened = {
            row: v for row, v in self._tightened.items() if self._active.persists(row)
        }
