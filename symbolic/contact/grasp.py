"""The least contact forces of pads that press evenly on a payload: any normals, any patches.

    minimise the sum of all |f_i|^2  subject to  the wrenches balance what the motion needs,
                                                 each lies within its patch's cone

(`symbolic.contact.central_path`), where the paper (Eqs. 38-42, 51-59) takes the least forces first
and asks for the moment afterwards. The method starts from an internal squeeze
(`symbolic.contact.force_closure`), pressed as hard as the load asks.
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
from symbolic.contact.central_path import START_WEIGHT, Patch, central_point, least, least_effort
from symbolic.contact.even_patch import EvenPatch
from symbolic.contact.force_closure import (
    EVEN,
    LOAD_SIZE,
    MOMENT_ARM,
    WRENCH_SIZE,
    derived,
    scaled_patch,
)
from symbolic.contact.soft_finger import SoftPatch
from symbolic.expression import number, reciprocal, sx_parameters
from symbolic.records import Contact, Workcell
from symbolic.records.numbered import GraspNumbers, NumberedWorkcell

SCALE_FLOOR = 1e-9
"""Force scale [N] where nothing has to be carried."""

START_FLOOR = 1e-3
"""Squeeze over the scale to start from where nothing has to be carried."""

START_SHARE = 0.97
"""Share of the way to the cones' boundary by which a load may move a start off the squeeze."""

BEYOND = 1e12
"""Normal force over the load's scale that says that friction does not close the grasp."""

REST_WEIGHT = 0.02
"""Weight, over the effort per degree, of the central path's place that is known at rest."""

REST_SHARE = 0.95
"""Share of the way from there to the cones' boundary along which the slope by the load is used."""

ALIKE = 0.1
"""Squeeze, over the scale, up to which a load counts as like that at rest."""


SCALING_INPUTS = ("friction", "reach")
"""Inputs after the load that scale states; others may follow."""

WHOLE = ca.SX.ones(2)
"""Patches of their own size."""


class Grasp:
    """The pads of one workcell, as a convex program. Compared by identity.

    Attributes:
        robots: per pad the index of its robot.
        patches, cell_sizes, given: see `symbolic.contact.central_path.ConvexProgram`.
        friction: (2,) coefficients of the robots' pads.
        numbers: what else its formulas are made of.
    """

    def __init__(self, workcell: Workcell, numbers: GraspNumbers | None = None) -> None:
        """Find the squeeze to start from, where the cell's numbers are not symbols.

        Args:
            numbers: where they are known.

        Raises:
            SettingsError: no squeeze holds the payload whatever is asked.
        """
        if numbers is None and isinstance(workcell, NumberedWorkcell):
            numbers = workcell.grasp
        self.numbers = derived(workcell) if numbers is None else numbers
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
        """Components of the wrenches that are free."""
        return len(self._free)

    def free(self, wrenches: list[ca.SX]) -> ca.SX:
        """See `symbolic.contact.central_path.ConvexProgram`."""
        return ca.vertcat(*wrenches)[self._free.tolist()]

    def balanced(self, free: ca.SX, cell: list[ca.SX]) -> list[ca.SX]:
        """See `symbolic.contact.central_path.ConvexProgram`."""
        load, *sizes = cell
        return self._left_by(load, free, sizes)

    def _left_by(self, load: ca.SX, free: ca.SX, sizes: list[ca.SX]) -> list[ca.SX]:
        """All wrenches that balance a load, from their free components."""
        units = ca.vertcat(*[self.units(i, *sizes) for i in range(len(self.patches))])
        given = ca.mtimes(number(self.numbers.free_to_left), units[self._free.tolist()] * free)
        left = ca.mtimes(number(self.numbers.load_to_left), load) - given
        whole = ca.SX(units.shape[0], 1)
        whole[self._free.tolist()] = free
        whole[self._left.tolist()] = left * reciprocal(units[self._left.tolist()])
        wrenches: list[ca.SX] = ca.vertsplit(whole, self._wrench_ends)
        return wrenches

    def effort(self, wrenches: list[ca.SX], cell: list[ca.SX]) -> ca.SX:
        """Half the sum of all squared forces."""
        friction, total = cell[1], 0.0
        for wrench, robot in zip(wrenches, self.robots, strict=True):
            total += wrench[0] ** 2 + friction[robot] ** 2 * ca.sumsqr(wrench[1:3])
        return 0.5 * total

    def start(self, cell: list[ca.SX]) -> tuple[list[ca.SX], ca.SX]:
        """For loads like that at rest what to first order lies on their central path, else the
        least states that balance them; and as much of the squeeze as takes that into the cones."""
        load, *sizes = cell[: 1 + len(SCALING_INPUTS)]
        given, rest = self.squeezed(*sizes), ca.SX(number(self.numbers.load_at_rest))
        states, slopes = self._at_rest
        times = ca.fmax(ca.dot(rest, load) / ca.sumsqr(rest), 0.0)
        near = self._at(times * states, *sizes)
        moves = self._at(ca.mtimes(slopes, load - times * rest), *sizes)
        inside = [p.slack(state) for p, state in zip(self.patches, near, strict=True)]
        taken = [p.lowest(s, move) for p, s, move in zip(self.patches, near, moves, strict=True)]
        # With much less friction than the cell's, what is held at rest lies beyond the cones.
        within = least(inside) > 0.0
        stays = ca.logic_and(within, least(taken) > -REST_SHARE)
        part = [move + REST_SHARE * s for s, move in zip(near, moves, strict=True)]
        press = ca.if_else(stays, START_FLOOR, self._pressed(given, part))
        asked, alike = self.asked(load, *sizes), ca.logic_and(within, press < ALIKE)
        press = ca.if_else(alike, press, self._pressed(given, asked))
        pairs = zip(near, moves, asked, strict=True)
        chosen = [ca.if_else(alike, s + move, a) for s, move, a in pairs]
        share = ca.if_else(alike, REST_WEIGHT + press, START_WEIGHT)
        return [c + press * s for c, s in zip(chosen, given, strict=True)], share

    def _pressed(self, given: list[ca.SX], asked: list[ca.SX]) -> ca.SX:
        """How much of the squeeze takes states into the cones."""
        shares = [p.lowest(s, a) for p, s, a in zip(self.patches, given, asked, strict=True)]
        return ca.fmax(-least(shares), 0.0) / START_SHARE + START_FLOOR

    @cached_property
    def _at_rest(self) -> tuple[ca.SX, ca.SX]:
        """States (n,) on the central path under the load at rest, and their slopes (n, 6) by it."""
        numbers = self.numbers if self.numbers.rest is not None else self.complete()
        return ca.SX(number(numbers.rest)), ca.SX(number(numbers.rest_slopes))

    def complete(self) -> GraspNumbers:
        """The numbers with those of the central path's place under the load at rest, of a grasp
        without symbols."""
        inputs = [self.numbers.load_at_rest, *map(np.array, self._nominal())]
        load, *sizes = [ca.SX(ca.DM(value)) for value in inputs][: 1 + len(SCALING_INPUTS)]
        asked, given = self.asked(load, *sizes), self.squeezed(*sizes)
        held = ca.vertcat(*asked) + self._pressed(given, asked) * ca.vertcat(*given)
        rest, slopes = central_point(self, np.array(ca.evalf(held)), inputs, REST_WEIGHT)
        return replace(self.numbers, rest=rest, rest_slopes=slopes)

    def _nominal(self) -> tuple[list[float], ...]:
        """The cell's own numbers for the inputs after the load."""
        return (np.array(ca.evalf(self.friction)).ravel().tolist(),)

    def asked(self, load: ca.SX, friction: ca.SX, reach: ca.SX = WHOLE) -> list[ca.SX]:
        """The least states that balance a load (6,), whether they lie within the cones or not."""
        return self._at(ca.mtimes(number(self.numbers.spread), load), friction, reach)

    def squeezed(self, friction: ca.SX, reach: ca.SX = WHOLE) -> list[ca.SX]:
        """The squeeze to start from, as states at friction coefficients (2,) of the robots; it may
        lie beyond the cones where they are far below the nominal ones.

        Args:
            reach: (2,) sizes of the robots' patches over their own.
        """
        return self._at(ca.SX(number(self.numbers.squeeze)), friction, reach)

    def squeeze_normals(self) -> Array:
        """As `normals`, of a grasp without symbols."""
        return np.array(ca.evalf(self.normals)).ravel()

    @property
    def normals(self) -> ca.SX:
        """(2,) what each robot's pads press with in the squeeze."""
        squeeze, found = number(self.numbers.squeeze), ca.SX(2, 1)
        for at, robot in zip(self._ends, self.robots, strict=False):
            found[robot] += squeeze[at]
        return found

    def squeeze_wrenches(self) -> Array:
        """(k, 6) of all pads in the squeeze, see `grasp_wrenches`; without symbols."""
        states = ca.vertsplit(ca.SX(number(self.numbers.squeeze)), self._ends)
        parts = [
            whole_wrench(self.units(i, self.friction) * state) for i, state in enumerate(states)
        ]
        return np.array(ca.evalf(ca.horzcat(*parts))).T

    def solved(
        self, cell: list[ca.MX], given: Sequence[ca.MX], differentiable: bool = False
    ) -> ca.MX:
        """What is `told` of the least effort [N, N m], beyond any limit where friction does not
        close the grasp.

        Args:
            cell: the inputs, the load in newtons first.
        """
        load, *others = cell
        size = ca.sqrt(ca.sumsqr(load[:3]) + ca.sumsqr(load[3:] / MOMENT_ARM) + SCALE_FLOOR**2)
        found = least_effort(self, load / size, *others, *given, differentiable=differentiable)
        return self._in_newtons()(found, size, *others[: len(SCALING_INPUTS)], *given)

    def _in_newtons(self) -> ca.Function:
        found, size = ca.SX.sym("w", self._wrench_ends[-1]), ca.SX.sym("s")
        names = [name for name, _ in self.cell_sizes if name in SCALING_INPUTS]
        sizes = [ca.SX.sym(name, 2) for name in names]
        told, beyond = self.told(ca.vertsplit(found, self._wrench_ends), sizes)
        squeezed = zip(self.patches, self.squeezed(*sizes), strict=True)
        closes = least([patch.slack(state) for patch, state in squeezed]) > 0.0
        held = size * ca.if_else(closes, told, beyond)
        return ca.Function("in_newtons", [found, size, *sizes, *self.given.values()], [held])

    def told(
        self, wrenches: list[ca.SX], sizes: list[ca.SX]
    ) -> tuple[ca.SX, ca.SX | ca.DM | float]:
        """What is asked for, over the load's scale, and what stands for it beyond any limit: all
        pads' wrenches, see `grasp_wrenches`.

        Args:
            wrenches: scaled ones.
            sizes: `SCALING_INPUTS` as far as they are inputs.
        """
        whole = [whole_wrench(self.units(i, *sizes) * own) for i, own in enumerate(wrenches)]
        beyond = ca.DM([BEYOND, 0, 0, 0, 0, 0])
        return ca.vertcat(*whole), ca.repmat(beyond, len(wrenches), 1)

    def units(self, i: int, friction: ca.SX, reach: ca.SX = WHOLE) -> ca.SX:
        """(m,) what the entries of pad i's scaled wrench are multiples of."""
        robot = self.robots[i]
        radius = self.numbers.reach * self._pads[i].patch_radius
        mu = friction[robot]
        return ca.vertcat(1.0, mu, mu, mu * (reach[robot] * radius))

    def _at(self, states: ca.SX, friction: ca.SX, reach: ca.SX = WHOLE) -> list[ca.SX]:
        """States (n,) at the nominal friction and size with what they carry, at others."""
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
    """Per pad (6,) side by side: N, T (2,) [N], the first moment N d (2,) and M [N m], of least
    effort, in its pad's axes. Friction that does not close the grasp gives normal forces beyond
    any limit.

    Args:
        load: (6,) force and moment about the box frame's origin, along the box's axes.
        friction: (2,) Coulomb coefficients of the robots' pads.
        given: the grasp's given numbers, where they are symbols.
    """
    return grasp.solved([load, friction], given)


def whole_wrench(wrench: ca.SX) -> ca.SX:
    """All six entries of a pad's wrench (4,)."""
    whole = ca.SX(WRENCH_SIZE, wrench.shape[1])
    whole[list(EVEN), :] = wrench
    return ca.densify(whole)


def _patch(contact: Contact, shape: Any) -> Patch:
    if contact.half_sides is None:
        return EvenPatch(scaled_patch(contact))
    twist, *spread = ca.vertsplit(ca.SX(number(shape)))
    return EvenPatch(SoftPatch(twist, ca.diagcat(*spread)))
