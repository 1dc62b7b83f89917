"""Robust forces at points of a path as functions of u'' and u'^2, with derivatives.

u is the path parameter; u' and u'' are its time derivatives. In every case of the uncertainty the
least squeeze is convex in the required force and moment, which are affine in (u'', u'^2). So the
largest squeeze over the worst cases is convex too; its slope is the slope of the case that needs
the largest squeeze, called governing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from codegen.interpreted import interpret
from hybrid_opt.carry import BoxMotion, Carry, box_motion, motion_inputs, tile_motion
from hybrid_opt.compiled_cell import CACHED_WORKCELLS, bound_to, contact_function
from hybrid_opt.robust.cases import (
    FOLLOWER,
    LEADER,
    GoverningCases,
    governing_cases,
    transmitted_share,
    worst_cases,
)
from hybrid_opt.robust.force import robust_model
from symbolic.array import Array
from symbolic.contact.registry import command_model
from symbolic.contact.worst_cases import (
    case_excess_function,
    case_gradient_function,
    case_origin_load_function,
    case_slopes_function,
    case_squeeze_function,
)
from symbolic.errors import SettingsError
from symbolic.parameters import HELD, WorkcellParameters
from symbolic.records import Workcell

BY_TIMING = slice(18, 20)
"""Columns of a slope that hold the derivatives by u'' and u'^2."""

BELOW = -np.inf
"""Normal force of cases that need less than the limit; their forces are not computed."""


@dataclass(frozen=True)
class PathPoints:
    """n points of paths, with the path acceleration and the squared path speed at each point.

    Attributes:
        pose, first, second: (n, 6) box poses [m, rad], and their first and second derivative with
            respect to the path parameter u.
        a: (n,) path acceleration u'' [1/s^2].
        w: (n,) squared path speed u'^2 [1/s^2].
    """

    pose: Array
    first: Array
    second: Array
    a: Array
    w: Array

    def __len__(self) -> int:
        return len(self.a)

    def at(self, rows: NDArray[np.intp]) -> PathPoints:
        """Return some of the points.

        Args:
            rows: (m,) indices of the points.
        """
        return PathPoints(*[values[rows] for values in self.driven])

    @property
    def driven(self) -> tuple[Array, ...]:
        """The arrays pose, first, second, a and w of this record, in the order of the arguments of
        `case_slopes_function`.
        """
        return self.pose, self.first, self.second, self.a, self.w

    @property
    def motion(self) -> BoxMotion:
        """Box poses and their time derivatives at the points."""
        rate = self.first * np.sqrt(np.maximum(self.w, 0.0))[:, None]
        second = self.first * self.a[:, None] + self.second * self.w[:, None]
        return BoxMotion(self.pose, rate, second)


class RobustPath:
    """Computes robust normal forces at points of a workcell's paths, with their derivatives.

    Arm `LEADER` is position controlled, the other arm is force controlled.
    """

    def __init__(self, workcell: Workcell) -> None:
        """Load or build the compiled functions.

        Args:
            workcell: the cell.

        Raises:
            SettingsError: the pads' normals are not opposite, or the workcell's uncertainty leaves
                no friction.
            DualArmError: a function cannot be built.
        """
        if not command_model(workcell).has_scalar_squeeze:
            raise SettingsError(
                "limits and slopes of robust forces need two pads with opposite normals"
            )
        self._set, self._model = workcell.uncertainty, robust_model(workcell)
        self._cases = self._model.worst_cases(self._set, LEADER)
        self._share = float(self._model.leading_share[LEADER])
        # Slopes add up in loops, for which there is no form in lanes.
        self._slopes = contact_function(workcell, "case slopes", case_slopes_function, lanes=1)
        self._excess = contact_function(workcell, "case excess", case_excess_function, lanes=0)

    def at(self, points: PathPoints) -> tuple[Array, Array]:
        """Compute the least normal forces that hold the box in every case of the workcell's
        uncertainty.

        Args:
            points: n points of paths.

        Returns:
            Normal forces (n, 2) of both robots [N], and their slopes (n, 2, 20). The columns of the
            slopes are the derivatives with respect to the pose (6), to its first and second
            derivative by u (12), to u'' and to u'^2.
        """
        least = self._model.least_squeeze(points.motion, self._cases, LEADER)
        governing = governing_cases(least, self._set, LEADER, leading_share=self._share)
        return governing.force, self.slopes(points, governing)

    def governing_above(
        self, points: PathPoints, level: Array
    ) -> tuple[NDArray[np.intp], GoverningCases]:
        """Find the points at which a robot needs more than a given normal force to hold the box in
        every case of the uncertainty.

        `RobustModel.slack` proves that most cases need less; only the forces of the remaining cases
        are computed. Call `slopes` with the result for the derivatives.

        Args:
            points: n points of paths.
            level: (n,) normal force at each point [N].

        Returns:
            Indices of the points found; and the governing cases, which need the largest force, at
            these points.
        """
        n, k = len(points), len(self._cases)
        every, cases = tile_motion(points.motion, k), np.repeat(self._cases, n, axis=0)
        difference = self._excess.batch(*motion_inputs(every), cases)["excess"].reshape(k, n)
        excess = (transmitted_share(difference, self._set) * difference).max(axis=0)
        room = np.minimum(level, (level - excess) / max(self._share, LEAST_SHARE))
        left = ~(self._model.slack(every, cases, np.tile(room, k), LEADER) > 0.0)
        found = np.full((k * n, 2), BELOW)
        if left.any():
            wanted = every.at(left), cases[left]
            found[left] = self._model.least(*wanted, LEADER, 1, displaced=False)
        least = found.reshape(k, n, 2)
        rows = np.flatnonzero(least[:, :, FOLLOWER].max(axis=0) > room)
        # A case with a commanded force below the level may still govern the leading arm's force.
        known = least[:, rows]
        own, beyond = known[:, :, FOLLOWER], difference[:, rows]
        known[:, :, LEADER] = np.where(own == BELOW, BELOW, self._share * own + beyond)
        return rows, governing_cases(known, self._set, LEADER, beyond, self._share)

    def most_demanding(self, points: PathPoints, count: int) -> tuple[Array, Array]:
        """Compute the normal forces in the `count` cases of the uncertainty that need the largest
        commanded forces, at each of n points, with derivatives.

        A polish needs several cases, because the case with the largest force changes along the
        path, and with it the derivative.

        Args:
            points: n points of paths.
            count: number of cases.

        Returns:
            Normal forces (n, 2, count) of both robots [N], the largest commanded force first; and
            their derivatives (n, 2, count, 20) by the pose (6), its first and second derivative by
            u (12), u'' and u'^2.
        """
        n, least = len(points), self._model.least_squeeze(points.motion, self._cases, LEADER)
        governing = governing_cases(least, self._set, LEADER, leading_share=self._share)
        first = np.argsort(-least[:, :, FOLLOWER], axis=0)[:count]
        beyond = governing.force[:, LEADER] - self._share * governing.force[:, FOLLOWER]
        force, slope = np.empty((n, 2, count)), np.empty((n, 2, count, BY_TIMING.stop))
        for j, case in enumerate(first):
            one = replace(governing, commanded=case)
            force[:, FOLLOWER, j] = least[case, np.arange(n), FOLLOWER]
            force[:, LEADER, j] = self._share * force[:, FOLLOWER, j] + beyond
            slope[:, :, j] = self.slopes(points, one)
        return force, slope

    def slopes(self, points: PathPoints, governing: GoverningCases) -> Array:
        """Compute the derivatives of both robots' normal forces in the governing cases, which need
        the largest force.

        Args:
            points: n points of paths.
            governing: the governing cases at these points.

        Returns:
            (n, 2, 20) derivatives by the pose (6), its first and second derivative by u (12), u''
            and u'^2.
        """
        if not len(points):
            return np.zeros((0, 2, BY_TIMING.stop))
        cases = np.concatenate([self._cases[governing.commanded], self._cases[governing.leading]])
        twice = [np.concatenate([values, values]) for values in points.driven]
        slopes = self._slopes.batch(*twice, cases)["slope"]
        return governing.slopes(slopes[: len(points)], slopes[len(points) :])


robust_path = lru_cache(maxsize=CACHED_WORKCELLS)(RobustPath)
"""Return the `RobustPath` of a workcell. Repeated calls with the same record return the same
object."""


LEAST_SHARE = 1e-200
"""Divisor in place of a zero share of the commanded force."""

TIED = 1e-6
"""A case governs too if its force is below the largest force by at most this share."""

TRIFLE = 1e-9
"""Relative reduction by which a friction coefficient is made the lower of the two."""

SMOOTH = 1e-2
"""One case governs if both one-sided changes differ by less than this share."""


class GoverningForce:
    """Largest commanded normal force along a carry that holds the box in every case of the
    workcell's uncertainty, with its derivatives.

    A case of the uncertainty governs if it needs this force at some sample. The derivative of the
    force is the derivative in the governing case (Danskin's theorem); if several cases govern, the
    directional derivative is the largest of their derivatives. For pads with opposite normals the
    inputs are the motion, the case and the cell's parameters; for other pads, the motion, the case
    and the load.

    Attributes:
        force: the force [N].
        samples: (k,) indices of the samples of the carry that need this force, one per governing
            case.
    """

    def __init__(self, carry: Carry, leader: int) -> None:
        """Find the cases of the uncertainty that need the largest commanded force along a carry.

        Args:
            carry: the carry.
            leader: index of the position-controlled arm, whose force is not commanded.

        Raises:
            SettingsError: some cases cannot be held by any force, or the uncertainty leaves no
                friction or contact patch.
        """
        model = robust_model(carry.workcell)
        self._workcell, self._leader = model.workcell, leader
        self._squeezed = command_model(model.workcell).has_scalar_squeeze
        needed = model.commanded(carry, carry.workcell.uncertainty, leader)
        few = np.flatnonzero(needed >= (1.0 - TIED) * needed.max())
        cases = worst_cases(command_model(model.workcell), carry.workcell.uncertainty, leader)
        least = model.least_squeeze(box_motion(carry).at(few), cases, leader)[:, :, 1 - leader]
        self.force = float(least.max())
        self._governing, at = np.nonzero(least >= (1.0 - TIED) * self.force)
        self.samples = few[at]
        self._count, self._motion = len(cases), box_motion(carry).at(self.samples)
        self._cases = cases[self._governing]

    def slopes(
        self, low: Workcell, high: Workcell, motions: tuple[BoxMotion, BoxMotion], pads: bool
    ) -> tuple[float, float]:
        """Compute how much the largest commanded force changes [N] if one number of the cell is
        raised or lowered.

        Args:
            low, high: two cells in which the number is lower, and higher by the same amount, than
                in this cell.
            motions: box motions in the cell `low` and in the cell `high`, at `samples`.
            pads: True if the pads of `low` and `high` differ. For pads without opposite normals the
                forces are then computed in both cells, because the derivatives do not include the
                pads.

        Returns:
            Changes of the force from this cell to `high`, and from this cell to `low`.
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
        """Compute the inputs of `_gradient` for another cell: the quantities on which the commanded
        force depends in each of the k cases that need the largest force.

        A row contains the box pose, its first and second time derivative, and the case of the
        uncertainty. For pads with opposite normals the cell's parameters follow, for other pads the
        load on the box.

        Args:
            cell: the other cell.
            motion: box motion in the other cell at `samples`.
            pads: True if the other cell's pads differ from this cell's.

        Returns:
            (k, m) quantities in SI units, in the order of the last axis of `_gradient`. If `pads`
            is True and the pads' normals are not opposite, `_gradient` does not apply: the result
            then is the normal force (k, 1) of the force-controlled arm [N].
        """
        cases = worst_cases(command_model(cell), cell.uncertainty, self._leader)
        assert len(cases) == self._count, "no range of the uncertainty begins or ends"
        cases = cases[self._governing]
        moved = np.hstack([*motion_inputs(motion), cases])
        if self._squeezed:
            held = WorkcellParameters(cell).vector(HELD)
            return np.hstack([moved, np.tile(held, (len(moved), 1))])
        if pads:
            least = case_squeeze_function(cell, 1 - self._leader)
            rows = [np.split(row, (6, 12, 18)) for row in moved]
            return np.array([[float(least(*row)[1 - self._leader])] for row in rows])
        load = case_origin_load_function(cell)
        known = zip(*motion_inputs(self._motion), self._cases, strict=True)
        return np.hstack([moved, [np.array(load(*row)).ravel() for row in known]])

    @cached_property
    def _gradient(self) -> Array:
        """Gradient (k, 2, m) of the commanded force by the m inputs of `_inputs`, in each of the k
        cases that need the largest force.

        The second axis has two one-sided gradients: with the friction coefficient of robot 0
        slightly lowered, and with that of robot 1. They differ if both coefficients are equal,
        because the lower one decides how the arms share the force.
        """
        if self._squeezed:
            numbers = WorkcellParameters(self._workcell)
            made = case_gradient_function(numbers.symbols(), numbers=True)
            function = bound_to(interpret(made), numbers)
        else:
            made = case_gradient_function(self._workcell, 1 - self._leader, numbers=True)
            function = interpret(made)
        slopes = []
        for arm in (0, 1):
            cases = self._cases.copy()
            cases[:, arm] *= 1.0 - TRIFLE
            found = function.batch(*motion_inputs(self._motion), cases)["slope"]
            slopes.append(found[:, 1 - self._leader])
        return np.stack(slopes, axis=1)
