"""The polish as a nonlinear program with exact first and second derivatives.

Variables z = (xi, phi, a): the decision vector scaled to [-1, 1] by its bounds, both robots' peak
forces f (the epigraph of the paper's Eq. 60) as phi = (f - anchor) / span, and a level. With the
target's anchor, span, direction, offset and cost,

    minimise    cost . (a, phi_1, phi_2)
    subject to  (N_i,k(x) / N_ref,i - anchor_i) / span_i <= phi_i    chosen samples k, robot i
                phi_j <= direction_j a + offset_j                    both objectives
                1 - (shift_i,k(x) / patch radius_i)^2 >= margin      chosen robots and samples
                c_r(x) / scale_r >= required_r / scale_r             chosen rows at chosen places.

That covers the scalarisation of Pascoletti and Serafini (direction of ones), the epsilon
constraint (a zero in the direction) and normal boundary intersection (the normal as direction).
Values and derivatives are put together here, in NumPy, from batches over samples and places:
another set of rows costs no more than choosing them. Joints as variables with closure constraints
lead to the same optima and take four times as long.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hybrid_opt.polishing.compiled_rows import RowParts
from hybrid_opt.polishing.force_values import ForceValues
from hybrid_opt.polishing.inequalities import Inequalities
from hybrid_opt.polishing.interior_steps import estimated
from hybrid_opt.polishing.layout import HELD, Layout, PlaceRow, Row
from hybrid_opt.polishing.place_values import Places, PlaceValues
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.residuals import Residuals, residuals
from hybrid_opt.polishing.sample_values import SampleValues
from hybrid_opt.polishing.smooth_cell import SmoothCell
from hybrid_opt.polishing.targets import Target, needed_level
from symbolic.array import Array

SLACK = 0.1
"""What the epigraph variables start above the peak forces, in units of the span."""

LEVEL_BOUND = 2e3
"""Bound of |phi| and |a|; beyond anything the targets ask for."""


def place_values(cell: SmoothCell, rows: tuple[PlaceRow, ...], carry: PlacedCarry) -> PlaceValues:
    """What evaluates rows at places, with the joints of a carry to start from."""
    grid = cell.grid
    at = np.array(sorted({row.place for row in rows}), dtype=np.intp)
    index = {place: k for k, place in enumerate(at.tolist())}
    places = Places(
        grid.basis[at],
        grid.rate_basis[at],
        cell.free,
        (carry.q[0][at], carry.q[1][at]),
    )
    local = tuple(PlaceRow(row.constraint, index[row.place]) for row in rows)
    return PlaceValues(local, places, cell.functions.closures, cell.functions.rows)


class SmoothProgram:
    """The program of a set of rows near one candidate; attributes as of `solvers.Program`, and:

    Attributes:
        layout: where everything stands.
    """

    def __init__(
        self,
        cell: SmoothCell,
        required: Mapping[Row, float],
        target: Target,
        carry: PlacedCarry,
        x: Array,
        radius: float,
    ) -> None:
        """Around a candidate.

        Args:
            required: the rows, and what each has to keep; forces stay below their peaks.
            target: what to aim at.
            carry: the candidate x (n_var,) on places.
            radius: half the width of the box of trust, in halves of the variables' ranges.
        """
        self._cell, self._target = cell, target
        self.layout = layout = Layout.of(cell.task.n_var, required)
        sampled = cell.blocks, cell.functions
        self._forces = ForceValues(layout.force_rows, *sampled, cell.rounding)
        pressed = {row.sample for row in layout.pressure_rows}
        self._patches = SampleValues(
            "pressure", cell.blocks, cell.functions.samples, pressed, cell.rounding
        )
        self._places = place_values(cell, layout.place_rows, carry)
        self._index_rows()
        self._correct_forces(x, carry)
        self._correct_pressure(x, carry)

        phi = (carry.peak - target.anchor) / target.span + SLACK
        xi, low, high = (cell.unit.scaled(v) for v in (x, cell.task.lower, cell.task.upper))
        self.cost = np.zeros(layout.n_variables)
        self.cost[layout.level], self.cost[layout.peaks] = target.cost[0], target.cost[1:]
        self.start = np.concatenate([xi, phi, [needed_level(target, phi) + SLACK]])
        self.low, self.high = np.full((2, layout.n_variables), LEVEL_BOUND)
        self.low *= -1.0
        self.low[layout.decision], self.high[layout.decision] = low, high
        self._own_bounds = self.low.copy(), self.high.copy()
        self.low[layout.decision] = np.maximum(low, xi - radius)
        self.high[layout.decision] = np.minimum(high, xi + radius)
        self.below = np.full(layout.n_rows, -np.inf)
        self.above = np.full(layout.n_rows, np.inf)
        self.above[: layout.sides.stop] = 0.0
        self.below[layout.patches] = [required[row] for row in layout.pressure_rows]
        self.below[layout.places] = [
            required[row] / row.constraint.scale for row in layout.place_rows
        ]
        self._fixed = self._fixed_part()
        self._offset = np.zeros(layout.n_rows)
        self._offset[layout.forces] = self._lacking - self._anchor
        self._offset[layout.sides] = -target.offset
        self._offset[layout.patches] = self._patch_lacking
        self._known = b""
        self._values = self._offset
        self._jacobian: Array | None = None
        self._compiled = cell.bind(self._parts())

    def _parts(self) -> RowParts:
        cell, layout = self._cell, self.layout
        return RowParts(
            unit=cell.unit,
            fixed=self._fixed,
            offset=self._offset,
            first_patch=layout.patches.start,
            first_place=layout.places.start,
            forces=self._forces,
            patches=self._patches,
            places=self._places,
            mix=self._mix,
            pressed_column=self._pressed_column,
            pressed=self._pressed,
            scale=self._scale,
            slope=None if cell.robust is None else (self._lacking_slope, self._x),
            still=cell.still,
            free=cell.free,
        )

    def _index_rows(self) -> None:
        """Rows as arrays: what each takes of the values at samples, and its scale."""
        forces = np.array([(r.robot, r.branch, r.sample) for r in self.layout.force_rows])
        robot, branch, sample = forces.reshape(-1, 3).astype(np.intp).T
        span = self._target.span[robot]
        reference = self._cell.task.reference_force[robot]
        self._owner = robot
        self._mix = self._cell.coefficients[robot, branch] / (reference * span)[:, None]
        self._anchor = self._target.anchor[robot] / span
        self._sample = sample
        pressed = np.array([(r.robot, r.sample) for r in self.layout.pressure_rows])
        self._pressed, sample = pressed.reshape(-1, 2).astype(np.intp).T
        self._pressed_column = self._patches.column[sample]
        self._scale = np.array([row.constraint.scale for row in self.layout.place_rows])

    def _correct_forces(self, x: Array, carry: PlacedCarry) -> None:
        """What the rows' forces lack at the candidate: what the rounded time law takes off them and
        the joint allocation's barriers add, or what makes planned forces robust ones, with their
        slopes (see `hybrid_opt.polishing.robust_samples`)."""
        self._x, robust, layout = x, self._cell.robust, self.layout
        self._lacking = np.zeros(len(layout.force_rows))
        self._lacking_slope = np.zeros((len(layout.force_rows), len(x)))
        at, sample = self._forces.column, self._sample
        found = self._forces.values(x)[at]
        if robust is None:
            held = np.array([row.branch == HELD for row in layout.force_rows])[:, None]
            exact = np.where(held, carry.force[sample], carry.split[sample])
            self._lacking = np.einsum("rk,rk->r", self._mix, exact - found)
            return
        force, by_x = robust.first(x)
        unit = self._cell.task.reference_force[self._owner] * self._target.span[self._owner]
        self._lacking = force[sample, self._owner] / unit
        self._lacking -= np.einsum("rk,rk->r", self._mix, found)
        self._lacking_slope = by_x[sample, self._owner] / unit[:, None]
        self._lacking_slope -= np.einsum("rk,rkx->rx", self._mix, self._forces.gradients[at])

    def _correct_pressure(self, x: Array, carry: PlacedCarry) -> None:
        """What the rounded time law takes off the rows' pressure at the candidate."""
        self._patch_lacking = np.zeros(len(self._pressed))
        if len(self._pressed):
            sample = [row.sample for row in self.layout.pressure_rows]
            margin = 1.0 - carry.shift[sample, self._pressed] ** 2
            found = self._patches.values(x)
            self._patch_lacking = margin - found[self._pressed_column, self._pressed]

    def _fixed_part(self) -> Array:
        """The Jacobian's constant columns, of the peaks and the level."""
        layout = self.layout
        fixed = np.zeros((layout.n_rows, layout.n_variables))
        fixed[np.arange(layout.forces.stop), layout.peaks.start + self._owner] = -1.0
        fixed[layout.sides, layout.peaks] = np.eye(2)
        fixed[layout.sides, layout.level] = -self._target.direction
        return fixed

    def values(self, z: Array) -> Array:
        """See `solvers.Program`; what was evaluated last is remembered."""
        key = z.tobytes()
        if key != self._known:
            self._values, self._jacobian = self._evaluated(z), None
            self._known = key
        return self._values

    def constraints(self, z: Array) -> tuple[Array, Array]:
        """See `solvers.Program`: what gave the values at z knows its slopes as well."""
        values = self.values(z)
        if self._jacobian is None:
            self._jacobian = self._slopes()
        return values, self._jacobian

    def _evaluated(self, z: Array) -> Array:
        if self._compiled is not None:
            return self._compiled.evaluate(z, self._cell.waypoints)
        layout = self.layout
        x = self._cell.unit.unscaled(z[layout.decision])
        values = self._fixed @ z
        values += self._offset
        taken = self._forces.values(x).take(self._forces.column, axis=0)
        taken *= self._mix
        forces = values[layout.forces]
        forces += taken[:, 0]
        forces += taken[:, 1]
        if self._cell.robust is not None:
            forces += self._lacking_slope @ (x - self._x)
        if len(self._pressed):
            margin = self._patches.values(x)
            values[layout.patches] += margin[self._pressed_column, self._pressed]
        if len(self._scale):
            value = self._places.values(self._cell.waypoints(x))
            value /= self._scale
            values[layout.places] = value
        return values

    def _slopes(self) -> Array:
        """The Jacobian where the values were found last."""
        if self._compiled is not None:
            return self._compiled.slopes()
        layout = self.layout
        jacobian = self._fixed.copy()
        slope = self._forces.gradients.take(self._forces.column, axis=0)
        slope *= self._mix[:, :, None]
        forces = jacobian[layout.forces, layout.decision]
        np.add(slope[:, 0], slope[:, 1], out=forces)
        if self._cell.robust is not None:
            forces += self._lacking_slope
        if len(self._pressed):
            slope = self._patches.gradients
            jacobian[layout.patches, layout.decision] = slope[self._pressed_column, self._pressed]
        if len(self._scale):
            by_path = self._places.gradients()
            by_path /= self._scale[:, None]
            jacobian[layout.places, layout.decision] = by_path
        jacobian[:, layout.decision] *= self._cell.unit.half
        return jacobian

    def curvature(self, z: Array, multipliers: Array) -> Array:
        """See `solvers.Program`."""
        self.constraints(z)
        layout, half = self.layout, self._cell.unit.half
        full = np.zeros((layout.n_variables, layout.n_variables))
        second = self._second(z, multipliers)
        full[layout.decision, layout.decision] = second * np.outer(half, half)
        return full

    def _second(self, z: Array, multipliers: Array) -> Array:
        """(n_var, n_var) second derivatives by the decision vector itself."""
        if self._compiled is not None:
            return self._compiled.curvature(multipliers)
        layout = self.layout
        x = self._cell.unit.unscaled(z[layout.decision])
        weighted = multipliers[layout.forces, None] * self._mix
        columns = self._forces.column
        weight = np.zeros((self._forces.count, 2))
        for k, own in enumerate(weighted.T):
            weight[:, k] = np.bincount(columns, own, len(weight))
        total = self._forces.second(x, weight)
        if len(self._pressed):
            weight = np.zeros((self._patches.count, 2))
            where = (self._pressed_column, self._pressed)
            np.add.at(weight, where, multipliers[layout.patches])
            total += self._patches.second(x, weight)
        if len(self._scale):
            total += self._places.second(multipliers[layout.places] / self._scale)
        return total

    def residuals_at(self, x: Array, carry: PlacedCarry) -> Residuals:
        """Residuals at a candidate x, with the multipliers that satisfy the conditions best there.
        Only the variables' own bounds count: those of the box of trust would take up what is left
        to be won."""
        layout, target = self.layout, self._target
        z = np.empty(layout.n_variables)
        z[layout.decision] = self._cell.unit.scaled(x)
        phi = (carry.peak - target.anchor) / target.span
        z[layout.peaks], z[layout.level] = phi, needed_level(target, phi)
        low, high = self._own_bounds
        rows = Inequalities(self)
        slacks = np.abs(rows.values(z)), np.abs(z - low), np.abs(high - z)
        lam_z, y = estimated(self.cost, rows.slopes(z), slacks)
        return residuals(self, z, lam_z, rows.multipliers(y), self._own_bounds)

    def candidate(self, z: Array) -> Array:
        """(n_var,) the decision vector at z, within its bounds and the box of trust."""
        decision = self.layout.decision
        xi = np.clip(z[decision], self.low[decision], self.high[decision])
        return self._cell.unit.unscaled(xi)
