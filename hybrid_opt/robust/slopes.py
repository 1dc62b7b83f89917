"""How the force to command moves with what it is made of.

The force is the largest over cases and samples. Its derivative is that of what rules (Danskin);
where several rule, the largest of theirs either way. What rules has a derivative in closed form,
by its motion, by its case and by the cell's numbers, or, of pads anywhere, by the load: the
multipliers of the balance of forces.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from codegen.interpreted import InterpretedFunction
from codegen.source import dense
from hybrid_opt.carry import Carry
from hybrid_opt.compiled_cell import bound_to
from hybrid_opt.robust.cases import is_squeezed, worst_cases
from hybrid_opt.robust.force import BoxMotion, box_motion, pressing_model
from symbolic.array import Array
from symbolic.contact.worst_cases import (
    case_gradient_function,
    case_grasp_function,
    case_grasp_gradient_function,
    case_origin_load_function,
)
from symbolic.numbers import HELD, WorkcellNumbers
from symbolic.records import Workcell

TIED = 1e-6
"""Share of the largest force by which another one that rules as well may be less."""

TRIFLE = 1e-9
"""Share of a friction by which it is the lower one."""

SMOOTH = 1e-2
"""Share of a change by which it may differ either way where only one case rules."""


class RulingForce:
    """The largest force to command of a carry that holds in every case of its cell's uncertainty.

    Attributes:
        force: [N].
        samples: (k,) of the carry at which it is needed, one per ruling case.
    """

    def __init__(self, carry: Carry, leader: int) -> None:
        """Find what rules.

        Args:
            leader: index of the arm whose force is not commanded.

        Raises:
            SettingsError: the uncertainty leaves nothing that holds.
        """
        model = pressing_model(carry.workcell)
        self._workcell, self._leader = model.workcell, leader
        self._squeezed = is_squeezed(model.workcell)
        needed = model.commanded(carry, carry.workcell.uncertainty, leader)
        few = np.flatnonzero(needed >= (1.0 - TIED) * needed.max())
        cases = worst_cases(model.workcell, carry.workcell.uncertainty, leader)
        least = model.least_squeeze(box_motion(carry).at(few), cases, leader)[:, :, 1 - leader]
        self.force = float(least.max())
        self._ruling, at = np.nonzero(least >= (1.0 - TIED) * self.force)
        self.samples = few[at]
        self._count, self._motion = len(cases), box_motion(carry).at(self.samples)
        self._cases = cases[self._ruling]

    def slopes(
        self, low: Workcell, high: Workcell, motions: tuple[BoxMotion, BoxMotion], pads: bool
    ) -> tuple[float, float]:
        """What the force changes by from here to the higher, and to the lower of two cells nearby,
        which lie as far to either side [N].

        Args:
            motions: at `samples`, of the lower and of the higher one.
            pads: whether the cells' pads differ. What pads anywhere need is solved for again then.
        """
        before, after = (
            self._inputs(cell, at, pads) for cell, at in zip((low, high), motions, strict=True)
        )
        if not pads or self._squeezed:
            by = (self._gradient * ((after - before) / 2.0)[:, None]).sum(axis=2)
            return float(by.max()), float((-by).max())
        rise, fall = float((after - self._solved).max()), float((before - self._solved).max())
        if abs(rise + fall) < SMOOTH * max(abs(rise), abs(fall)):
            return (rise - fall) / 2.0, (fall - rise) / 2.0
        return rise, fall

    @cached_property
    def _solved(self) -> Array:
        return self._inputs(self._workcell, self._motion, pads=True)

    def _inputs(self, cell: Workcell, motion: BoxMotion, pads: bool) -> Array:
        """(k, m) what the gradient is by; or the force itself, see `change`."""
        allocation = self._workcell.task.allocation
        cell = replace(cell, task=replace(cell.task, allocation=allocation))
        cases = worst_cases(cell, cell.uncertainty, self._leader)
        assert len(cases) == self._count, "no range of the uncertainty begins or ends"
        cases = cases[self._ruling]
        moved = np.hstack([motion.pose, motion.rate, motion.second_rate, cases])
        if self._squeezed:
            held = WorkcellNumbers(cell).vector(HELD)
            return np.hstack([moved, np.tile(held, (len(moved), 1))])
        if pads:
            least = case_grasp_function(cell, 1 - self._leader)
            rows = [np.split(row, (6, 12, 18)) for row in moved]
            return np.array([[float(least(*row)[1 - self._leader])] for row in rows])
        load, own = case_origin_load_function(cell), self._motion
        known = zip(own.pose, own.rate, own.second_rate, self._cases, strict=True)
        return np.hstack([moved, [np.array(load(*row)).ravel() for row in known]])

    @cached_property
    def _gradient(self) -> Array:
        """(k, 2, m) of the force of each ruling case by `_inputs`, were either friction the lower
        one by a trifle: the lower one decides what the opposed force takes."""
        if self._squeezed:
            numbers = WorkcellNumbers(self._workcell)
            found = case_gradient_function(numbers.symbols(), numbers=True)
            function = bound_to(InterpretedFunction(dense(found)), numbers)
        else:
            found = case_grasp_gradient_function(self._workcell, 1 - self._leader)
            function = InterpretedFunction(dense(found))
        own, slopes = self._motion, []
        for arm in (0, 1):
            cases = self._cases.copy()
            cases[:, arm] *= 1.0 - TRIFLE
            found = function.batch(own.pose, own.rate, own.second_rate, cases)["slope"]
            slopes.append(found[:, 1 - self._leader])
        return np.stack(slopes, axis=1)
