"""Least contact forces of uniformly pressing pads: any number, normals and patches.

    minimise the sum of all |f_i|^2  subject to  the wrenches balance the load of the motion,
                                                 each lies within its patch's cone

`symbolic.contact.central_path` solves this program. (The paper, Eqs. 38-42 and 51-59, minimises the
forces first and balances the moment afterwards.) The method starts from an internal squeeze
(`symbolic.contact.force_closure`) of the size that the load needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import accumulate
from typing import Any

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.contact.central_path import START_WEIGHT, Patch, central_point, least_effort, minimum
from symbolic.contact.even_patch import EvenPatch
from symbolic.contact.force_closure import (
    EVEN,
    LOAD_SIZE,
    MOMENT_ARM,
    WRENCH_SIZE,
    derive_grasp_numbers,
    scaled_patch,
)
from symbolic.contact.soft_finger import SoftPatch
from symbolic.expression import number, reciprocal, sx_parameters
from symbolic.records import Contact, Workcell
from symbolic.records.numbered import GraspNumbers, NumberedWorkcell

SCALE_FLOOR = 1e-9
"""Force scale of a zero load [N]."""

START_FLOOR = 1e-3
"""Initial squeeze for a zero load, over the scale."""

START_SHARE = 0.97
"""Share of the way from the squeeze to the cones' boundary by which a load may move the start."""

BEYOND = 1e12
"""Normal force, over the load's scale, that marks a grasp that friction does not close."""

REST_WEIGHT = 0.02
"""Weight of the barriers at the stored point of the central path at rest, over the effort per
degree."""

REST_SHARE = 0.95
"""Share of the way from this point to the cones' boundary that the first-order prediction may
go."""

ALIKE = 0.1
"""A load counts as similar to the load at rest if it needs less additional squeeze than this, over
the scale."""

SCALING_INPUTS = ("friction", "reach")
"""Names of the inputs after the load that scale states. Others may follow them."""

WHOLE = ca.SX.ones(2)
"""Relative sizes of unchanged patches."""


class Grasp:
    """Convex program of a workcell's pads, for any number of pads and any normals. Programs are
    equal only to themselves.

    The scaled wrench (4,) of a pad, also called its state, is N, T / mu (2,), M / (mu r): normal
    force N, tangential force T, torsion M, friction coefficient mu, patch radius r.

    Attributes:
        robots: index of the robot of each pad.
        patches: barrier functions of the pads, as in `ConvexProgram`.
        cell_sizes: names and sizes of the inputs: load (6,), friction (2,).
        given: symbolic parameters by name of their group.
        friction: (2,) friction coefficients of the robots' pads.
        numbers: derived constants of the grasp.
    """

    def __init__(self, workcell: Workcell, numbers: GraspNumbers | None = None) -> None:
        """Take the constants of the grasp, or derive them.

        Args:
            workcell: cell with the pads, the payload and the friction coefficients.
            numbers: constants of the grasp; None to take them from a workcell with symbolic
                parameters, or to derive them.

        Raises:
            SettingsError: no internal squeeze exists.
        """
        if numbers is None and isinstance(workcell, NumberedWorkcell):
            numbers = workcell.grasp
        self.numbers = derive_grasp_numbers(workcell) if numbers is None else numbers
        self.given = sx_parameters(workcell.payload, self.numbers)
        self.robots, self._pads = workcell.pad_robots, workcell.pads
        self.patches = tuple(map(_patch, self._pads, self.numbers.shapes))
        self.friction = ca.vertcat(*[ca.SX(number(c.friction)) for c in workcell.contacts])
        self.cell_sizes: tuple[tuple[str, int], ...] = (("load", LOAD_SIZE), ("friction", 2))
        self._left = np.array(self.numbers.left)
        sizes = [patch.wrench_size for patch in self.patches]
        self._wrench_ends = [0, *accumulate(sizes)]
        self._free = np.setdiff1d(np.arange(sum(sizes)), self._left)
        self._ends = [0, *accumulate(patch.state_size for patch in self.patches)]

    @property
    def free_size(self) -> int:
        """Number of free components of the wrenches: those that the load does not determine."""
        return len(self._free)

    def free(self, wrenches: list[ca.SX]) -> ca.SX:
        """Select those components (free_size,) of all pads' scaled wrenches (4,) that the load does
        not determine."""
        return ca.vertcat(*wrenches)[self._free.tolist()]

    def balanced(self, free: ca.SX, cell: list[ca.SX]) -> list[ca.SX]:
        """Compute the scaled wrench (4,) of each pad such that all pads together balance the load.

        A scaled wrench holds normal force, tangential force (2,) over the friction coefficient, and
        torsion over friction coefficient times patch radius.

        Args:
            free: (free_size,) components of the scaled wrenches that the load does not determine.
            cell: inputs of the convex program in this order: load (6,) about the box frame's
                origin, along the box's axes; friction (2,) of each robot's pads; in some programs
                relative patch sizes (2,).
        """
        load, *sizes = cell
        return self._balanced_wrenches(load, free, sizes)

    def _balanced_wrenches(self, load: ca.SX, free: ca.SX, sizes: list[ca.SX]) -> list[ca.SX]:
        """Compute the scaled wrench (4,) of each pad such that all pads together balance a load.

        Args:
            load: (6,) force and moment about the box frame's origin, along the box's axes.
            free: (free_size,) components of the scaled wrenches that the load does not determine.
            sizes: friction (2,), and relative patch sizes (2,) if the convex program has this
                input.
        """
        units = ca.vertcat(*[self.units(i, *sizes) for i in range(len(self.patches))])
        given = ca.mtimes(number(self.numbers.free_to_left), units[self._free.tolist()] * free)
        left = ca.mtimes(number(self.numbers.load_to_left), load) - given
        whole = ca.SX(units.shape[0], 1)
        whole[self._free.tolist()] = free
        whole[self._left.tolist()] = left * reciprocal(units[self._left.tolist()])
        wrenches: list[ca.SX] = ca.vertsplit(whole, self._wrench_ends)
        return wrenches

    def effort(self, wrenches: list[ca.SX], cell: list[ca.SX]) -> ca.SX:
        """Compute half the sum of the squared magnitudes of all pad forces, a scalar.

        Args:
            wrenches: scaled wrench (4,) of each pad.
            cell: inputs of the program: load, then friction (2,).
        """
        friction, total = cell[1], 0.0
        for wrench, robot in zip(wrenches, self.robots, strict=True):
            total += wrench[0] ** 2 + friction[robot] ** 2 * ca.sumsqr(wrench[1:3])
        return 0.5 * total

    def start(self, cell: list[ca.SX]) -> tuple[list[ca.SX], ca.SX]:
        """Compute the start of the interior-point method.

        For a load similar to the load at rest, the states are predicted to first order from the
        stored point of the central path at rest. Otherwise they are the states of least norm that
        balance the load. In both cases internal squeeze is added until the states lie inside the
        cones.

        Args:
            cell: inputs of the program: load (6,) divided by its size, friction (2,), and relative
                patch sizes (2,) if the program has this input.

        Returns:
            State (4,) of each pad, in balance with the load; and a scalar s: the initial weight of
            the barriers is s times the effort at these states, over the sum of the patches'
            degrees.
        """
        load, *sizes = cell[: 1 + len(SCALING_INPUTS)]
        given, rest = self.squeeze_states(*sizes), ca.SX(number(self.numbers.load_at_rest))
        states, slopes = self._at_rest
        times = ca.fmax(ca.dot(rest, load) / ca.sumsqr(rest), 0.0)
        near = self._at(times * states, *sizes)
        moves = self._at(ca.mtimes(slopes, load - times * rest), *sizes)
        inside = [p.slack(state) for p, state in zip(self.patches, near, strict=True)]
        taken = [p.lowest(s, move) for p, s, move in zip(self.patches, near, moves, strict=True)]
        # With much less friction than the cell's, the states at rest lie outside the cones.
        within = minimum(inside) > 0.0
        stays = ca.logic_and(within, minimum(taken) > -REST_SHARE)
        part = [move + REST_SHARE * s for s, move in zip(near, moves, strict=True)]
        press = ca.if_else(stays, START_FLOOR, self._squeeze_scale(given, part))
        asked, alike = self.least_states(load, *sizes), ca.logic_and(within, press < ALIKE)
        press = ca.if_else(alike, press, self._squeeze_scale(given, asked))
        pairs = zip(near, moves, asked, strict=True)
        chosen = [ca.if_else(alike, s + move, a) for s, move, a in pairs]
        share = ca.if_else(alike, REST_WEIGHT + press, START_WEIGHT)
        return [c + press * s for c, s in zip(chosen, given, strict=True)], share

    def _squeeze_scale(self, given: list[ca.SX], asked: list[ca.SX]) -> ca.SX:
        """Compute a factor on the internal squeeze. With this multiple of the squeeze added, the
        states of all pads lie within their friction cones.

        Args:
            given: state (4,) of each pad in the internal squeeze.
            asked: state (4,) of each pad to which the squeeze is added.
        """
        shares = [p.lowest(s, a) for p, s, a in zip(self.patches, given, asked, strict=True)]
        return ca.fmax(-minimum(shares), 0.0) / START_SHARE + START_FLOOR

    @cached_property
    def _at_rest(self) -> tuple[ca.SX, ca.SX]:
        """States (n,) of all pads with the payload at rest, one after the other, and their
        derivatives (n, 6) by the load.

        The states balance the load at rest and lie on the convex program's central path.
        """
        numbers = self.numbers if self.numbers.rest is not None else self.complete()
        return ca.SX(number(numbers.rest)), ca.SX(number(numbers.rest_slopes))

    def complete(self) -> GraspNumbers:
        """Compute how the pads hold the payload at rest, and return `numbers` with the results in
        the fields `rest` and `rest_slopes`.

        `rest` (n,) holds the scaled states of all pads on the central path, `rest_slopes` (n, 6)
        their derivatives by the load. The grasp must have no symbolic parameters.
        """
        inputs = [self.numbers.load_at_rest, *map(np.array, self._nominal())]
        load, *sizes = [ca.SX(ca.DM(value)) for value in inputs][: 1 + len(SCALING_INPUTS)]
        asked, given = self.least_states(load, *sizes), self.squeeze_states(*sizes)
        held = ca.vertcat(*asked) + self._squeeze_scale(given, asked) * ca.vertcat(*given)
        rest, slopes = central_point(self, np.array(ca.evalf(held)), inputs, REST_WEIGHT)
        return replace(self.numbers, rest=rest, rest_slopes=slopes)

    def _nominal(self) -> tuple[list[float], ...]:
        """Return the workcell's own values of all inputs of the convex program except the load: a
        tuple with one list, the friction coefficients (2,).
        """
        return (np.array(ca.evalf(self.friction)).ravel().tolist(),)

    def least_states(self, load: ca.SX, friction: ca.SX, reach: ca.SX = WHOLE) -> list[ca.SX]:
        """Compute the scaled wrench (4,) of each pad such that all pads together balance a load
        with the least norm. The wrenches may lie outside the friction cones.

        Args:
            load: (6,) force and moment about the box frame's origin, along the box's axes.
            friction: (2,) friction coefficients of the robots' pads.
            reach: (2,) sizes of the robots' patches over the cell's own sizes.
        """
        return self._at(ca.mtimes(number(self.numbers.spread), load), friction, reach)

    def squeeze_states(self, friction: ca.SX, reach: ca.SX = WHOLE) -> list[ca.SX]:
        """Return the internal squeeze, pad forces that balance one another, as one scaled state
        (4,) per pad. The normal forces of all pads sum to one.

        The states are scaled by the given friction and patch sizes. They may lie outside the cones
        if friction is far below its nominal value.

        Args:
            friction: (2,) friction coefficients of the robots' pads.
            reach: (2,) sizes of the robots' patches over the cell's own sizes.
        """
        return self._at(ca.SX(number(self.numbers.squeeze)), friction, reach)

    def squeeze_normals(self) -> Array:
        """Compute the sum of the normal forces of each robot (2,) in the internal squeeze: pad
        forces that balance one another, scaled so that all normal forces sum to one. The grasp must
        have no symbolic parameters."""
        return np.array(ca.evalf(self.normals)).ravel()

    @property
    def normals(self) -> ca.SX:
        """Sum of the normal forces of each robot (2,) in the internal squeeze, as an expression.
        The two sums add up to one."""
        squeeze, found = number(self.numbers.squeeze), ca.SX(2, 1)
        for at, robot in zip(self._ends, self.robots, strict=False):
            found[robot] += squeeze[at]
        return found

    def squeeze_wrenches(self) -> Array:
        """Compute the wrenches (k, 6) of all k pads in the internal squeeze, whose normal forces
        sum to one. The grasp must have no symbolic parameters.

        A wrench holds normal force, tangential force (2,), the normal force times the shift (2,) of
        the centre of pressure, and torsion, along the pad's axes.
        """
        states = ca.vertsplit(ca.SX(number(self.numbers.squeeze)), self._ends)
        parts = [
            full_wrench(self.units(i, self.friction) * state) for i, state in enumerate(states)
        ]
        return np.array(ca.evalf(ca.horzcat(*parts))).T

    def solve(
        self, cell: list[ca.MX], given: Sequence[ca.MX], differentiable: bool = False
    ) -> ca.MX:
        """Build the expression of the pad wrenches of least effort, (6 k,) for k pads, as
        `grasp_wrenches` describes them [N, N m].

        Args:
            cell: inputs of the convex program: load (6,) about the box frame's origin, along the
                box's axes [N, N m]; friction (2,) of each robot's pads; in some programs relative
                patch sizes (2,).
            given: symbolic parameters of the grasp.
            differentiable: True for exact first derivatives.
        """
        load, *others = cell
        size = ca.sqrt(ca.sumsqr(load[:3]) + ca.sumsqr(load[3:] / MOMENT_ARM) + SCALE_FLOOR**2)
        found = least_effort(self, load / size, *others, *given, differentiable=differentiable)
        return self._in_newtons()(found, size, *others[: len(SCALING_INPUTS)], *given)

    def _in_newtons(self) -> ca.Function:
        found, size = ca.SX.sym("w", self._wrench_ends[-1]), ca.SX.sym("s")
        names = [name for name, _ in self.cell_sizes if name in SCALING_INPUTS]
        sizes = [ca.SX.sym(name, 2) for name in names]
        result, beyond = self.result(ca.vertsplit(found, self._wrench_ends), sizes)
        squeezed = zip(self.patches, self.squeeze_states(*sizes), strict=True)
        closes = minimum([patch.slack(state) for patch, state in squeezed]) > 0.0
        held = size * ca.if_else(closes, result, beyond)
        return ca.Function("in_newtons", [found, size, *sizes, *self.given.values()], [held])

    def result(
        self, wrenches: list[ca.SX], sizes: list[ca.SX]
    ) -> tuple[ca.SX, ca.SX | ca.DM | float]:
        """Convert the scaled wrenches of a solution to wrenches. `solve` has divided the load by
        its size, so these are wrenches over the size of the load.

        Args:
            wrenches: scaled wrench (4,) of each pad.
            sizes: inputs named in `SCALING_INPUTS`: friction coefficients (2,), and relative patch
                sizes (2,) if the convex program has this input.

        Returns:
            Wrenches (6 k,) of all k pads; and the values (6 k,), beyond every limit, that replace
            them if friction does not close the grasp.
        """
        whole = [full_wrench(self.units(i, *sizes) * own) for i, own in enumerate(wrenches)]
        beyond = ca.DM([BEYOND, 0, 0, 0, 0, 0])
        return ca.vertcat(*whole), ca.repmat(beyond, len(wrenches), 1)

    def units(self, i: int, friction: ca.SX, reach: ca.SX = WHOLE) -> ca.SX:
        """Return the factors (4,) that convert the scaled wrench of pad `i` to newtons and newton
        metres.

        Args:
            i: index of the pad.
            friction: (2,) friction coefficients of the robots' pads.
            reach: (2,) sizes of the robots' patches over the cell's own sizes.
        """
        robot = self.robots[i]
        radius = self.numbers.reach * self._pads[i].patch_radius
        mu = friction[robot]
        return ca.vertcat(1.0, mu, mu, mu * (reach[robot] * radius))

    def _at(self, states: ca.SX, friction: ca.SX, reach: ca.SX = WHOLE) -> list[ca.SX]:
        """Convert states of all pads to the scales of another friction and other patch sizes. The
        forces stay the same.

        Args:
            states: (n,) states of all pads, one after the other, scaled by the nominal friction and
                patch sizes.
            friction: (2,) friction coefficients of the robots' pads.
            reach: (2,) sizes of the robots' patches over the cell's own sizes.

        Returns:
            One state (4,) per pad.
        """
        moved, owns = [], ca.vertsplit(states, self._ends)
        for pad, robot, state in zip(self._pads, self.robots, owns, strict=True):
            by_friction, by_reach = pad.friction / friction[robot], 1.0 / reach[robot]
            factors = (1.0, by_friction, by_friction, by_friction * by_reach)
            moved.append(state * ca.vertcat(*factors))
        return moved


def grasp_wrenches(
    grasp: Grasp,
    load: ca.MX,
    friction: ca.MX,
    given: Sequence[ca.MX] = (),
) -> ca.MX:
    """Build the expression of the pad wrenches of least effort, (6 k,) for k pads one after the
    other.

    A wrench holds, along the pad's axes, normal force and tangential force (2,) [N], the normal
    force times the shift (2,) of the centre of pressure, and torsion [N m]. Normal forces exceed
    any limit if friction does not close the grasp.

    Args:
        grasp: convex program of the pads.
        load: (6,) force and moment about the box frame's origin, along the box's axes [N, N m].
        friction: (2,) Coulomb coefficients of the robots' pads.
        given: symbolic parameters of the grasp.
    """
    return grasp.solve([load, friction], given)


def full_wrench(wrench: ca.SX) -> ca.SX:
    """Return all six entries of a pad's wrench, with zero for the two moments that an evenly
    pressing pad cannot bear.

    Args:
        wrench: (4, n) normal force, tangential force (2,) and torsion of n wrenches, one per
            column.
    """
    whole = ca.SX(WRENCH_SIZE, wrench.shape[1])
    whole[list(EVEN), :] = wrench
    return ca.densify(whole)


def _patch(contact: Contact, shape: Any) -> Patch:
    if contact.half_sides is None:
        return EvenPatch(scaled_patch(contact))
    twist, *spread = ca.vertsplit(ca.SX(number(shape)))
    return EvenPatch(SoftPatch(twist, ca.diagcat(*spread)))
