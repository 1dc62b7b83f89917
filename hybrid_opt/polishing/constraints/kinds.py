"""Kinds of constraints: rows near their bounds, their required values, and violated rows; and the
selection of a program's rows among them.

To add a kind, write a class here, or beside the distances, and list it in `RowSelector`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from hybrid_opt.polishing.cell import PlacedCarry, SmoothCell, local_minima_below
from hybrid_opt.polishing.constraints.distances import (
    AxisSwitchGaps,
    Clearances,
    DistanceConstraintKind,
    SeparatingAxisGaps,
)
from hybrid_opt.polishing.rows import (
    PATCH_MARGIN,
    PROGRAM_BRANCH,
    ConstraintKind,
    ForceRow,
    MinimisedForces,
    PathRow,
    PressureRow,
    Row,
    smooth_values,
)
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.smooth.passage import AxisSwitchGap, SeparatingAxisGap
from symbolic.smooth.path_points import Clearance, JointLimit, ManipulabilityLimit, Side

SAMPLING_MARGIN = 2e-3
"""Margin to joint limits [rad], and to singularities in the square of |det J| over its least
allowed value. It covers the path between points."""

CONE_TIGHT = 0
"""Index of the branch of the normal force with tight friction cones. It governs unless the lateral
acceleration of the box approaches 1 g."""

FORCE_STRIDE = 0.02
"""Distance between force rows along the path, where forces are smooth."""

TIE_STRIDE = 0.06
"""Distance between force rows along the path, for a robot whose force only breaks ties."""

PEAK_SHARE = 0.98
"""Local maxima of the force above this share of the highest get rows."""

BRANCH_SHARE = 0.02
"""Branches within this share of the governing one get rows."""

PRESSURE_SHARE = 0.7
"""Shifts of the centre of pressure beyond this share of the patch radius get rows."""

PRESSURE_STRIDE = 0.04
"""Distance along the path of further rows on both sides of the largest shift."""

JOINT_DISTANCE = 0.05
"""Joints closer to a limit than this get a row [rad]."""

MANIPULABILITY_SHARE, MANIPULABILITY_STRIDE = 0.9, 0.02
"""Stretches of the path with |det J| below this share of its median get rows at this stride: low
values bound the reach, beyond which nothing is defined."""

SINGULAR_RATIO, SINGULAR_STRIDE = 1.1, 0.005
"""Stretches with |det J| below this multiple of its least allowed value get rows at this closer
stride."""

LOST_ARM_STRIDE = 0.04
"""If an arm loses the path, rows follow this point at this distance and at twice this distance."""


class Forces(ConstraintKind[ForceRow]):
    """Rows (scalar inequalities) that keep normal forces below the peak forces, which are variables
    of the program.

    A normal force is the largest of several linear functions (branches) of the required force. The
    branch with tight friction cones has rows along the whole path, other branches only where they
    nearly are the largest. `required_values` has no meaning for force rows.
    """

    persists = True

    def __init__(self, cell: SmoothCell) -> None:
        super().__init__(cell)
        last = len(self.grid.sample_parameter) - 1
        # One-sided differences make the forces of the first and last samples no smooth function.
        self._ends = {0, 1, last - 1, last}
        self._every = set(range(0, last, self.grid.samples(FORCE_STRIDE)))
        self._ties = set(range(0, last + 1, self.grid.samples(TIE_STRIDE)))
        by_program = cell.robust is None and not contact_model(cell.workcell).has_closed_form
        # The branch that has a row wherever forces matter.
        self._main = PROGRAM_BRANCH if by_program else CONE_TIGHT

    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[ForceRow]:
        """Return rows (scalar inequalities) of normal forces at regular distances along the path,
        at both of its ends, at the highest local maxima of the normal forces (`PEAK_SHARE`), and at
        the samples directly before and after these maxima.

        A robot whose force is not minimised has rows at fewer samples; its force only decides
        between candidates that are otherwise equal.

        Args:
            carry: the candidate, evaluated at points of the path.
            limits: for each robot, True if its normal force is minimised.
        """
        samples = self._every | self._ends | self._peaks(carry)
        for robot, limited in enumerate(limits):
            for sample in samples if limited else samples & self._ties:
                yield ForceRow(robot, self._main, sample)
        yield from self._other_branches(carry)

    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[ForceRow]:
        """Return rows (scalar inequalities) for the branches that determine a normal force after a
        step, or nearly do, and that the program may lack.

        A normal force is the maximum of several linear functions, its branches. The branch with
        tight friction cones is left out, because it has rows along the whole path anyway.

        Args:
            carry: candidate after the step.
            known: candidate before the step; not used.
        """
        return self._other_branches(carry)

    def peak_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> set[ForceRow]:
        """Return rows (scalar inequalities) at the highest local maxima (`PEAK_SHARE`) of a
        candidate's minimised normal forces, and at the samples directly before and after them.

        A program without these rows underestimates the peak forces.

        Args:
            carry: the candidate, evaluated at points of the path.
            limits: for each robot, True if its normal force is minimised.
        """
        return {
            ForceRow(robot, self._main, sample)
            for robot, limited in enumerate(limits)
            if limited
            for sample in self._peaks(carry)
        }

    def _values(self, carry: PlacedCarry) -> Array:
        """Evaluate the branches of the normal forces: the linear functions whose maximum is the
        force.

        Args:
            carry: the candidate, evaluated at points of the path.

        Returns:
            (samples, 2, branches) values for both robots [N].
        """
        return np.asarray(np.einsum("rbk,nk->nrb", self.cell.coefficients, carry.split))

    def _peaks(self, carry: PlacedCarry) -> set[int]:
        """Return the indices of the samples at which a robot's normal force has a local maximum of
        at least `PEAK_SHARE` of its largest value, and of the samples before and after each of
        them.
        """
        has_branches = self.cell.robust is None and self._main == CONE_TIGHT
        force = self._values(carry).max(axis=2) if has_branches else carry.force
        inner = force[1:-1]
        high = (inner >= force[:-2]) & (inner >= force[2:])
        high &= inner >= PEAK_SHARE * inner.max(axis=0)
        tops = np.flatnonzero(high.any(axis=1)) + 1
        return {int(k) for k in (tops[:, None] + np.array([-1, 0, 1])).ravel()}

    def _other_branches(self, carry: PlacedCarry) -> list[ForceRow]:
        """Return rows (scalar inequalities) for the branches that determine a normal force, or
        nearly do, except the branch with tight friction cones.

        A normal force is the maximum of several linear functions, its branches. Robust forces and
        forces that a convex program computes have no branches; for them the list is empty.

        Args:
            carry: the candidate, evaluated at points of the path.

        Returns:
            One row for each such branch, robot and sample.
        """
        if self.cell.robust is not None or self._main == PROGRAM_BRANCH:
            return []
        force = self._values(carry)
        share = 1.0 - BRANCH_SHARE
        near = force >= share * force.max(axis=2, keepdims=True)
        near[:, :, CONE_TIGHT] = False
        return [
            ForceRow(robot, branch, sample) for sample, robot, branch in np.argwhere(near).tolist()
        ]


class Pressure(ConstraintKind[PressureRow]):
    """Rows (scalar inequalities) that keep the centres of pressure within the patches.

    The pressure shift is the distance of a centre of pressure from the middle of its patch. In each
    stretch of samples with shifts above a threshold, the sample with the largest shift, both
    neighbouring samples, and those `PRESSURE_STRIDE` before and after it get rows.
    """

    persists = True

    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[PressureRow]:
        """Return rows (scalar inequalities) at and around the largest pressure shift of each
        stretch of samples in which a robot's shift exceeds the share `PRESSURE_SHARE` of the patch
        radius. The class states which samples these are.

        Args:
            carry: the candidate, evaluated at points of the path.
            limits: not used.
        """
        return self._beyond(carry, PRESSURE_SHARE)

    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PressureRow]:
        """Return rows (scalar inequalities) at and around the largest pressure shift of each
        stretch of samples in which a centre of pressure is at the rim of its patch or beyond.

        This is where the square of shift over patch radius exceeds 1 - `PATCH_MARGIN` / 2. Programs
        demand the whole margin; half of it is left for rounding of the solver.

        Args:
            carry: candidate after the step.
            known: candidate before the step; not used.
        """
        return self._beyond(carry, (1.0 - PATCH_MARGIN / 2.0) ** 0.5)

    def _beyond(self, carry: PlacedCarry, share: float) -> Iterable[PressureRow]:
        last = len(carry.shift) - 1
        width = self.grid.samples(PRESSURE_STRIDE)
        for robot in (0, 1):
            for sample in local_minima_below(-carry.shift[:, robot], -share):
                for beside in (-width, -1, 0, 1, width):
                    yield PressureRow(robot, min(max(0, sample + beside), last))


class JointLimits(ConstraintKind[PathRow]):
    """Rows (scalar inequalities) that keep joints within their limits, at the local minima of the
    distance to a limit.
    """

    persists = True

    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[PathRow]:
        """Return rows (scalar inequalities) where a joint is closer to a limit than
        `JOINT_DISTANCE`: one for each stretch of the path, at its closest point.

        Args:
            carry: the candidate, evaluated at points of the path.
            limits: not used.
        """
        return self._below(carry, JOINT_DISTANCE)

    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PathRow]:
        """Return rows (scalar inequalities) where a joint is beyond a limit, or closer to it than
        half of `SAMPLING_MARGIN`: one for each stretch of the path, at its worst point.

        Args:
            carry: candidate after the step.
            known: candidate before the step; not used.
        """
        return self._below(carry, SAMPLING_MARGIN / 2.0)

    def required_values(
        self, carry: PlacedCarry, rows: Sequence[PathRow], is_relaxed: bool = False
    ) -> list[float]:
        """Return the required distance to the joint limit for every row (scalar inequality):
        `SAMPLING_MARGIN` [rad].

        This distance covers the path between points.

        Args:
            carry: not used.
            rows: the rows.
            is_relaxed: not used.
        """
        return [SAMPLING_MARGIN] * len(rows)

    def _below(self, carry: PlacedCarry, limit: float) -> Iterable[PathRow]:
        for arm, robot in enumerate(self.cell.workcell.robots):
            q = carry.q[arm][: carry.reached]
            margins: tuple[tuple[Side, Array], ...] = (
                ("lower", q - robot.position_lower),
                ("upper", robot.position_upper - q),
            )
            for side, margin in margins:
                for joint in range(q.shape[1]):
                    for point in local_minima_below(margin[:, joint], limit):
                        yield PathRow(JointLimit(arm, joint, side), point)


class ManipulabilityLimits(ConstraintKind[PathRow]):
    """Rows (scalar inequalities) that keep both arms away from singularities, by a least value of
    ``|det J|``.

    J is an arm's Jacobian. These rows also bound the reach: at its edge ``|det J|`` is zero, and
    beyond it nothing is defined.
    """

    persists = True

    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[PathRow]:
        """Return rows (scalar inequalities) at regular distances along the parts of the path with a
        low ``|det J|`` of an arm's Jacobian J.

        Low is below `MANIPULABILITY_SHARE` of the median along the path. Where ``|det J|`` is near
        its least allowed value, rows are closer together, so that the minimum does not move between
        two of them.

        Args:
            carry: the candidate, evaluated at points of the path.
            limits: not used.
        """
        points = self.grid.points
        for arm in (0, 1):
            measure = carry.manipulability[:, arm]
            least = max(1.0, MANIPULABILITY_SHARE * float(np.median(measure)))
            chosen = {*local_minima_below(measure, least, points(MANIPULABILITY_STRIDE))}
            chosen |= {*local_minima_below(measure, SINGULAR_RATIO, points(SINGULAR_STRIDE))}
            for point in sorted(chosen):
                yield PathRow(ManipulabilityLimit(arm), point)

    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PathRow]:
        """Return rows (scalar inequalities) where ``|det J|`` of an arm's Jacobian J is below its
        least allowed value plus half of the margin.

        For an arm that does not reach all points, rows at the first unreachable point and at two
        later ones are added: there the arm is stretched out and so singular.

        Args:
            carry: candidate after the step.
            known: candidate before the step; not used.
        """
        least = (1.0 + SAMPLING_MARGIN / 2.0) ** 0.5
        for arm in (0, 1):
            for point in local_minima_below(carry.manipulability[:, arm], least):
                yield PathRow(ManipulabilityLimit(arm), point)
        for arm in carry.unreachable_arms:
            width = self.grid.points(LOST_ARM_STRIDE)
            for later in (0, width, 2 * width):
                yield PathRow(ManipulabilityLimit(arm), carry.reached + later)

    def required_values(
        self, carry: PlacedCarry, rows: Sequence[PathRow], is_relaxed: bool = False
    ) -> list[float]:
        """Return the required value of every row (scalar inequality): `SAMPLING_MARGIN`.

        A row's value is the square of ``|det J|`` over its least allowed value, minus one. The
        margin covers the path between points.

        Args:
            carry: not used.
            rows: the rows.
            is_relaxed: not used.
        """
        return [SAMPLING_MARGIN] * len(rows)

    def tightened_bounds(
        self, carry: PlacedCarry, known: PlacedCarry, rows: Sequence[PathRow], before: list[float]
    ) -> list[float]:
        """Return the new bound of each row (scalar inequality) that a step violated.

        If both arms reach all points after the step, the bound is `SAMPLING_MARGIN`. Otherwise it
        is the mean of two values: the row's bound in the last program, and the value of its left
        side at the candidate before the step.

        Args:
            carry: candidate after the step.
            known: candidate before the step.
            rows: the violated rows.
            before: bound of each row in the last program.
        """
        if not carry.unreachable_arms:
            return self.required_values(carry, rows)
        has = smooth_values(self.cell, known, rows)
        return [(old + new) / 2.0 for old, new in zip(before, has.tolist(), strict=True)]


class RowSelector:
    """Chooses which rows (single scalar inequalities) a program contains near a candidate.

    A row is kept if it is near its bound, or if a step violated it. In drivable cells, whose
    carries are timed from rest to rest within all limits, no row belongs to a sample, because
    `hybrid_opt.polishing.drive` limits the forces of the timing.
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

        A force row of the program never counts as violated: it bounds the force by the peak force,
        which is itself a variable to be minimised.

        Args:
            carry: candidate after the step.
            known: candidate before the step.
            program_rows: rows of the optimisation problem whose solution is the step.
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
        Force rows of the program never count as violated, as in `violated_rows`.

        Args:
            carry: candidate after the step.
            known: candidate before the step.
            program_rows: rows of the optimisation problem whose solution is the step.
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
