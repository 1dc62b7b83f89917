"""Kinds of constraints: what each calls near, requires and finds violated.

A kind answers for its rows. To add one is to write a class here and to list it in
`hybrid_opt.polishing.constraints.active`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.carry import PlacedCarry, local_minima_below
from hybrid_opt.polishing.cell import SmoothCell
from hybrid_opt.polishing.rows import PROGRAM_BRANCH, ForceRow, PathRow, PressureRow, row_numbers
from symbolic.array import Array
from symbolic.smooth.places import JointLimit, ManipulabilityLimit, Side

PATCH_MARGIN = 1e-6
"""Kept from the rims of patches, in the square of the shift over the radius."""

SAMPLING_MARGIN = 2e-3
"""Kept from joint limits [rad] and, in the square of |det J| over its least value, from
singularities: they are judged at places and hold between them as well."""

CONE_TIGHT = 0
"""Branch of the normal force that rules unless the box is accelerated across by nearly 1 g."""

FORCE_ROUNDING = 1e-6
"""Share by which a force exceeds the paper's that is not rounding."""

FORCE_STRIDE = 0.02
"""Distance of force rows: forces are smooth along the path."""

TIE_STRIDE = 0.06
"""The same for a robot whose force only breaks ties."""

PEAK_SHARE = 0.98
"""Local maxima of the force above this share of the highest get rows."""

BRANCH_SHARE = 0.02
"""Branches within this share of the ruling one get rows."""

PRESSURE_SHARE = 0.7
"""Shifts of the centre of pressure beyond this share of the patch get rows."""

PRESSURE_STRIDE = 0.04
"""This far beside the farthest shift there are rows, too."""

JOINT_DISTANCE = 0.05
"""Joints nearer than this to a limit get a row [rad]."""

MANIPULABILITY_SHARE, MANIPULABILITY_STRIDE = 0.9, 0.02
"""Where |det J| is below this share of its median along the path, every such stretch gets a row: it
bounds the reach, beyond which nothing is defined."""

SINGULAR_RATIO, SINGULAR_STRIDE = 1.1, 0.005
"""The same below this multiple of the least |det J|, more densely."""

LOST_ARM_STRIDE = 0.04
"""This far after the loss of an arm, and twice as far, there are rows, too."""

MinimisedForces = tuple[bool, bool]
"""Per robot whether its force matters for more than ties."""

AnyRow = TypeVar("AnyRow", ForceRow, PressureRow, PathRow)


class ConstraintKind(ABC, Generic[AnyRow]):
    """A kind of constraint.

    Attributes:
        cell, grid: what it reads.
        lasting: whether its rows are kept where the solve moves on to another candidate. What is
            asked of others is relative to the candidate that is left behind.
    """

    persists: bool = False

    def __init__(self, cell: SmoothCell) -> None:
        self.cell, self.grid = cell, cell.grid

    @abstractmethod
    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[AnyRow]:
        """Rows of what is near at a candidate."""

    @abstractmethod
    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[AnyRow]:
        """Rows of what a step violates that was made from a known candidate."""

    def required_values(
        self, carry: PlacedCarry, rows: Sequence[AnyRow], is_relaxed: bool = False
    ) -> list[float]:
        """The value that each row has to keep, as learned from a candidate.

        Args:
            lenient: ask for no more than the candidate keeps already, where it is free.
        """
        return [PATCH_MARGIN] * len(rows)

    def tightened_bounds(
        self, carry: PlacedCarry, known: PlacedCarry, rows: Sequence[AnyRow], before: list[float]
    ) -> list[float]:
        """The value that rows which a step violates have to keep from now on.

        Args:
            carry: where the step led.
            known: where it came from.
            before: what the rows had to keep, the margin where they were none.
        """
        return self.required_values(carry, rows)


class Forces(ConstraintKind[ForceRow]):
    """Rows of the branch with tight cones along the whole path, of others where they nearly rule.

    The required value has no meaning: a force stays below the peak, which is a variable.
    """

    persists = True

    def __init__(self, cell: SmoothCell) -> None:
        super().__init__(cell)
        last = len(self.grid.sample_parameter) - 1
        # One-sided differences make the forces of the first and last samples no smooth function.
        self._ends = {0, 1, last - 1, last}
        self._every = set(range(0, last, self.grid.samples(FORCE_STRIDE)))
        self._ties = set(range(0, last + 1, self.grid.samples(TIE_STRIDE)))
        self._joint = cell.robust is None and not cell.workcell.has_closed_form
        self._facing = cell.workcell.has_facing_pads

    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[ForceRow]:
        """Rows at every few samples, at the highest and beside them, where the sample decides."""
        samples = self._every | self._ends | self._peaks(carry)
        main = self._main(carry)
        for robot, limited in enumerate(limits):
            for sample in samples if limited else samples & self._ties:
                yield ForceRow(robot, main[sample], sample)
        yield from self._other_branches(carry)

    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[ForceRow]:
        """Other branches that rule."""
        return self._other_branches(carry)

    def peak_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> set[ForceRow]:
        """Rows at the peaks of a candidate whose forces are higher than the program foresaw."""
        main = self._main(carry)
        return {
            ForceRow(robot, main[sample], sample)
            for robot, limited in enumerate(limits)
            if limited
            for sample in self._peaks(carry)
        }

    def _values(self, carry: PlacedCarry) -> Array:
        """(samples, 2, branches) of the paper's [N]."""
        return np.asarray(np.einsum("rbk,nk->nrb", self.cell.coefficients, carry.split))

    def _main(self, carry: PlacedCarry) -> list[int]:
        """Per sample the branch that has a row wherever forces matter."""
        return [
            PROGRAM_BRANCH if held else CONE_TIGHT
            for held in self._is_found_by_program(carry).tolist()
        ]

    def _is_found_by_program(self, carry: PlacedCarry) -> NDArray[np.bool_]:
        """(samples,) whether the joint allocation's forces are, or are nearly, not the paper's."""
        if not self._joint or not self._facing:
            return np.full(len(carry.split), self._joint)
        harder = carry.force > (1.0 + FORCE_ROUNDING) * self._values(carry).max(axis=2)
        near = carry.shift > PRESSURE_SHARE
        return np.asarray((harder | near).any(axis=1))

    def _peaks(self, carry: PlacedCarry) -> set[int]:
        """Samples at and beside local maxima of either robot's normal force."""
        is_paper = self.cell.robust is None and not self._joint
        force = self._values(carry).max(axis=2) if is_paper else carry.force
        inner = force[1:-1]
        high = (inner >= force[:-2]) & (inner >= force[2:])
        high &= inner >= PEAK_SHARE * inner.max(axis=0)
        tops = np.flatnonzero(high.any(axis=1)) + 1
        return {int(k) for k in (tops[:, None] + np.array([-1, 0, 1])).ravel()}

    def _other_branches(self, carry: PlacedCarry) -> list[ForceRow]:
        """Force rows of other branches than the tight cones' that rule, or nearly do.

        Robust forces have one row at a sample, of the case that rules there.
        """
        if self.cell.robust is not None:
            return []
        force = self._values(carry)
        share = 1.0 - BRANCH_SHARE
        near = force >= share * force.max(axis=2, keepdims=True)
        near[:, :, CONE_TIGHT] = near[self._is_found_by_program(carry)] = False
        return [
            ForceRow(robot, branch, sample) for sample, robot, branch in np.argwhere(near).tolist()
        ]


class Pressure(ConstraintKind[PressureRow]):
    """Rows at the farthest shift of every stretch near the rim of a patch, and beside it."""

    persists = True

    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[PressureRow]:
        """Rows of shifts beyond a share of the patch's radius."""
        return self._beyond(carry, PRESSURE_SHARE)

    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PressureRow]:
        """At the rim: half of the margin is left to what the solver rounds off."""
        return self._beyond(carry, (1.0 - PATCH_MARGIN / 2.0) ** 0.5)

    def _beyond(self, carry: PlacedCarry, share: float) -> Iterable[PressureRow]:
        last = len(carry.shift) - 1
        width = self.grid.samples(PRESSURE_STRIDE)
        for robot in (0, 1):
            for sample in local_minima_below(-carry.shift[:, robot], -share):
                for beside in (-width, -1, 0, 1, width):
                    yield PressureRow(robot, min(max(0, sample + beside), last))


class JointLimits(ConstraintKind[PathRow]):
    """Rows at the tightest places of every joint that comes near a limit."""

    persists = True

    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[PathRow]:
        """Joints near a limit."""
        return self._below(carry, JOINT_DISTANCE)

    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PathRow]:
        """Joints beyond a limit, or nearer than half of what is kept from it."""
        return self._below(carry, SAMPLING_MARGIN / 2.0)

    def required_values(
        self, carry: PlacedCarry, rows: Sequence[PathRow], is_relaxed: bool = False
    ) -> list[float]:
        """What lets a limit hold between places as well."""
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
                    for place in local_minima_below(margin[:, joint], limit):
                        yield PathRow(JointLimit(arm, joint, side), place)


class ManipulabilityLimits(ConstraintKind[PathRow]):
    """Rows where |det J| is low: beyond the edge of the reach nothing else is defined."""

    persists = True

    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[PathRow]:
        """Below a share of the median along the path, every few places; more densely where there is
        little left, so that the least does not move between two rows."""
        places = self.grid.places
        for arm in (0, 1):
            measure = carry.manipulability[:, arm]
            least = max(1.0, MANIPULABILITY_SHARE * float(np.median(measure)))
            chosen = {*local_minima_below(measure, least, places(MANIPULABILITY_STRIDE))}
            chosen |= {*local_minima_below(measure, SINGULAR_RATIO, places(SINGULAR_STRIDE))}
            for place in sorted(chosen):
                yield PathRow(ManipulabilityLimit(arm), place)

    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[PathRow]:
        """Below the least value and half of what is kept beyond it; and where an arm loses the path
        and after it: at the edge of its reach it is stretched, and so singular."""
        least = (1.0 + SAMPLING_MARGIN / 2.0) ** 0.5
        for arm in (0, 1):
            for place in local_minima_below(carry.manipulability[:, arm], least):
                yield PathRow(ManipulabilityLimit(arm), place)
        for arm in carry.unreachable_arms:
            width = self.grid.places(LOST_ARM_STRIDE)
            for later in (0, width, 2 * width):
                yield PathRow(ManipulabilityLimit(arm), carry.reached + later)

    def required_values(
        self, carry: PlacedCarry, rows: Sequence[PathRow], is_relaxed: bool = False
    ) -> list[float]:
        """What lets the measure hold between places as well."""
        return [SAMPLING_MARGIN] * len(rows)

    def tightened_bounds(
        self, carry: PlacedCarry, known: PlacedCarry, rows: Sequence[PathRow], before: list[float]
    ) -> list[float]:
        """Where an arm lost the path: half way to what the known candidate has there."""
        if not carry.unreachable_arms:
            return self.required_values(carry, rows)
        has = smooth_values(self.cell, known, rows)
        return [(old + new) / 2.0 for old, new in zip(before, has.tolist(), strict=True)]


def smooth_values(cell: SmoothCell, carry: PlacedCarry, rows: Sequence[PathRow]) -> Array:
    """The rows' values as the smooth problem sees them."""
    values = np.empty(len(rows))
    groups: dict[str, list[int]] = {}
    for k, row in enumerate(rows):
        groups.setdefault(row.constraint.family, []).append(k)
    for members in groups.values():
        at = [rows[k].place for k in members]
        functions, kinds = cell.functions, [rows[k].constraint for k in members]
        inputs = [array[at] for array in (carry.pose, carry.rate, *carry.q)]
        inputs += row_numbers(kinds, functions)
        function = functions.row(kinds[0], "first")
        values[members] = function.batch(*inputs)["value"]
    return values
