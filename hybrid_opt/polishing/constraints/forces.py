"""Normal forces below their peaks: which branches have rows at which samples.

The paper's branches stand wherever the paper's allocation does; where pads press harder than that,
or are about to, and where there is no closed form, stands the joint allocation's.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.polishing.constraints.kind import Kind, Surroundings
from hybrid_opt.polishing.layout import HELD, ForceRow
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.targets import Target
from symbolic.array import Array

CONE_TIGHT = 0
"""Branch of the normal force that rules unless the box is accelerated across by nearly 1 g."""

HARDER = 1e-6
"""Share by which a force exceeds the paper's that is not rounding."""


class Forces(Kind[ForceRow]):
    """Rows of the branch with tight cones along the whole path, of others where they nearly rule.

    The required value has no meaning: a force stays below the peak, which is a variable.
    """

    lasting = True

    def __init__(self, around: Surroundings) -> None:
        super().__init__(around)
        grid = around.cell.grid
        last = len(grid.sample_parameter) - 1
        # One-sided differences make the forces of the first and last samples no smooth function.
        self._ends = {0, 1, last - 1, last}
        self._every = set(range(0, last, grid.samples(self.near_settings.force_stride)))
        self._ties = set(range(0, last + 1, grid.samples(self.near_settings.tie_stride)))
        self._joint = around.workcell.task.allocation == "joint" and around.cell.robust is None
        self._facing = around.workcell.has_facing_pads

    def near(self, carry: PlacedCarry, target: Target) -> Iterable[ForceRow]:
        """At every few samples, at the highest and beside them, where the sample decides."""
        samples = self._every | self._ends | self._peaks(carry)
        main = self._main(carry)
        for robot, limited in enumerate(target.limits):
            for sample in samples if limited else samples & self._ties:
                yield ForceRow(robot, main[sample], sample)
        yield from self._other_branches(carry)

    def violated(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[ForceRow]:
        """Other branches that rule."""
        return self._other_branches(carry)

    def higher(self, carry: PlacedCarry, target: Target) -> set[ForceRow]:
        """Rows at the peaks of a candidate whose forces are higher than the program foresaw."""
        main = self._main(carry)
        return {
            ForceRow(robot, main[sample], sample)
            for robot, limited in enumerate(target.limits)
            if limited
            for sample in self._peaks(carry)
        }

    def _values(self, carry: PlacedCarry) -> Array:
        """(samples, 2, branches) of the paper's [N]."""
        coefficients = self.around.cell.coefficients[:, :HELD]
        return np.asarray(np.einsum("rbk,nk->nrb", coefficients, carry.split))

    def _main(self, carry: PlacedCarry) -> list[int]:
        """Per sample the branch that has a row wherever forces matter."""
        return [HELD if held else CONE_TIGHT for held in self._is_held(carry).tolist()]

    def _is_held(self, carry: PlacedCarry) -> NDArray[np.bool_]:
        """(samples,) whether the joint allocation's forces are, or are nearly, not the paper's."""
        if not self._joint or not self._facing:
            return np.full(len(carry.split), self._joint)
        harder = carry.force > (1.0 + HARDER) * self._values(carry).max(axis=2)
        near = carry.shift > self.near_settings.pressure_share
        return np.asarray((harder | near).any(axis=1))

    def _peaks(self, carry: PlacedCarry) -> set[int]:
        """Samples at and beside local maxima of either robot's normal force."""
        is_paper = self.around.cell.robust is None and not self._joint
        force = self._values(carry).max(axis=2) if is_paper else carry.force
        inner = force[1:-1]
        high = (inner >= force[:-2]) & (inner >= force[2:])
        high &= inner >= self.near_settings.peak_share * inner.max(axis=0)
        tops = np.flatnonzero(high.any(axis=1)) + 1
        return {int(k) for k in (tops[:, None] + np.array([-1, 0, 1])).ravel()}

    def _other_branches(self, carry: PlacedCarry) -> list[ForceRow]:
        """Force rows of other branches than the tight cones' that rule, or nearly do.

        Robust forces have one row at a sample, of the case that rules there.
        """
        if self.around.cell.robust is not None:
            return []
        force = self._values(carry)
        share = 1.0 - self.near_settings.branch_share
        near = force >= share * force.max(axis=2, keepdims=True)
        near[:, :, CONE_TIGHT] = near[self._is_held(carry)] = False
        return [
            ForceRow(robot, branch, sample) for sample, robot, branch in np.argwhere(near).tolist()
        ]
