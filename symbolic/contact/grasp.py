"""The least contact forces of pads on a payload: any normals, any of the patches.

    minimise the sum of all |f_i|^2  subject to  the wrenches balance what the motion needs,
                                                 each lies within its patch's cone

(`symbolic.contact.central_path`), where the paper (Eqs. 38-42, 51-59) takes the least forces first
and asks for the moment afterwards. The method starts from an internal squeeze
(`symbolic.contact.force_closure`), pressed as hard as the load asks.

Two round pads that face one another have a start without such a squeeze, because pressing harder
carries anything: `OppositePads`, whose geometry may vary. Its coordinates are tangents a, b and
normal n = a x b of contact 1. Shifts and arms in m, forces in N.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import accumulate
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.contact.central_path import (
    START_WEIGHT,
    central_point,
    differentiable_least_effort,
    least_effort,
)
from symbolic.contact.even_patch import EvenPatch
from symbolic.contact.force_closure import (
    EVEN,
    WRENCH_SIZE,
    balance_maps,
    closing_squeeze,
    presses_evenly,
    scaled_patch,
    size_powers,
    tangential,
)
from symbolic.contact.patches import Patch, least
from symbolic.contact.rectangular_patch import RectangularPatch
from symbolic.contact.round_patch import RoundPatch, cross_2, patch_slack
from symbolic.errors import SettingsError
from symbolic.expression import Expression, reciprocal
from symbolic.path.rotation import rotation_matrix
from symbolic.records import Contact, Workcell
from symbolic.records.quantities import GRAVITY

LOAD_SIZE = 6
"""Force and moment about the box frame's origin, along the box's axes [N, N m]."""

SCALE_FLOOR = 1e-9
"""Force scale [N] where nothing has to be carried."""

START_FLOOR = 1e-3
"""Squeeze over the scale to start from where nothing has to be carried."""

START_SHARE = 0.97
"""Of the way to the cones' boundary that the load takes a start from the squeeze."""

BEYOND = 1e12
"""Normal force over the load's scale that says that friction does not close the grasp."""

REST_WEIGHT = 0.02
"""Weight, over the effort per degree, of the central path's place that is known at rest."""

REST_SHARE = 0.95
"""Of the way from there to the cones' boundary that the slope by the load is followed."""

ALIKE = 0.1
"""Squeeze, over the scale, up to which a load counts as like that at rest."""

MOMENT_ARM = 0.1
"""Of moments in the load's scale [m]: about half a payload, so that they count like forces."""


SIZES = ("friction", "reach")
"""Inputs after the load that scale states; others may follow."""

WHOLE = ca.SX.ones(2)
"""Patches of their own size."""


class Grasp:
    """The pads of one workcell, as the allocation's program. Compared by identity.

    Attributes:
        robots: per pad the index of its robot.
        patches, cell_sizes: see `symbolic.contact.central_path.Program`.
        nominal: the cell's own numbers for the inputs after the load.
    """

    def __init__(self, workcell: Workcell) -> None:
        """Find the squeeze to start from.

        Raises:
            SettingsError: no squeeze holds the payload whatever is asked.
        """
        pads, even = workcell.pads, presses_evenly(workcell)
        squeeze = closing_squeeze(workcell)
        if squeeze is None:
            raise SettingsError(
                "the pads do not close their grasp: no internal squeeze lies within their friction "
                "cones; raise the friction or turn them towards one another"
            )
        self.robots = workcell.pad_robots
        self.patches = tuple(_patch(pad, even) for pad in pads)
        self.cell_sizes: tuple[tuple[str, int], ...] = (("load", LOAD_SIZE), ("friction", 2))
        self.nominal: tuple[list[float], ...] = ([c.friction for c in workcell.contacts],)
        self._load_at_rest = _load_at_rest(workcell)
        self._pads = pads
        self._squeeze = squeeze.states
        # The least states that balance a load, whether they lie within the cones or not.
        whole, in_units = (np.hstack(balance_maps(workcell, units)) for units in (False, True))
        spread = np.linalg.pinv(whole)[:, :LOAD_SIZE]
        ends = np.cumsum([len(state) for state in squeeze.states])[:-1]
        self._spread = tuple(np.split(spread, ends))
        # Which components are what the others leave: all of the last pad's, or those that the load
        # reaches best.
        n = in_units.shape[1]
        self._left = _reached_best(whole) if even else np.arange(n - 6, n)
        self._free = np.setdiff1d(np.arange(n), self._left)
        to_left = np.asarray(np.linalg.inv(in_units[:, self._left]), dtype=float)
        self._load_to_left = _sparse(to_left[:, :LOAD_SIZE])
        self._free_to_left = _sparse(to_left @ in_units[:, self._free])

    @property
    def free_size(self) -> int:
        """Components of the wrenches that are free."""
        return len(self._free)

    def free(self, wrenches: list[ca.SX]) -> ca.SX:
        """See `symbolic.contact.central_path.Program`."""
        return ca.vertcat(*wrenches)[self._free.tolist()]

    def balanced(self, free: ca.SX, cell: list[ca.SX]) -> list[ca.SX]:
        """See `symbolic.contact.central_path.Program`."""
        load, *sizes = cell
        return self._left_by(load, free, sizes)

    def _left_by(self, load: ca.SX, free: ca.SX, sizes: list[ca.SX]) -> list[ca.SX]:
        """All wrenches that balance a load, from their free components."""
        units = ca.vertcat(*[self.units(i, *sizes) for i in range(len(self.patches))])
        given = ca.mtimes(self._free_to_left, units[self._free.tolist()] * free)
        left = ca.mtimes(self._load_to_left, load) - given
        whole = ca.SX(units.shape[0], 1)
        whole[self._free.tolist()] = free
        whole[self._left.tolist()] = left * reciprocal(units[self._left.tolist()])
        ends = [0, *accumulate(patch.wrench_size for patch in self.patches)]
        wrenches: list[ca.SX] = ca.vertsplit(whole, ends)
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
        load, *sizes = cell[: 1 + len(SIZES)]
        given, rest = self.squeezed(*sizes), ca.DM(self._load_at_rest)
        states, slopes = self._at_rest
        times = ca.fmax(ca.dot(rest, load) / ca.sumsqr(rest), 0.0)
        near = self._at([times * ca.DM(state) for state in states], *sizes)
        moves = self._at([ca.mtimes(ca.DM(by), load - times * rest) for by in slopes], *sizes)
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
    def _at_rest(self) -> tuple[list[Array], list[Array]]:
        """States (n,) on the central path under `_load_at_rest`, and their slopes (n, 6) by it."""
        inputs = [self._load_at_rest, *[np.array(value) for value in self.nominal]]
        cell = [ca.SX(ca.DM(value)) for value in inputs]
        load, *sizes = cell[: 1 + len(SIZES)]
        asked, given = self.asked(load, *sizes), self.squeezed(*sizes)
        press = self._pressed(given, asked)
        pairs = zip(asked, given, strict=True)
        states = [np.array(ca.evalf(a + press * s)).ravel() for a, s in pairs]
        iterate, slope = central_point(self, states, inputs, REST_WEIGHT)
        starts = np.cumsum([0, *[patch.iterate_size for patch in self.patches]])
        places = [slice(at, at + len(own)) for at, own in zip(starts, states, strict=False)]
        return [iterate[at] for at in places], [slope[at] for at in places]

    def asked(self, load: ca.SX, friction: ca.SX, reach: ca.SX = WHOLE) -> list[ca.SX]:
        """The least states that balance a load (6,), whether they lie within the cones or not."""
        states = [ca.mtimes(ca.DM(spread), load) for spread in self._spread]
        return self._at(states, friction, reach)

    def squeezed(self, friction: ca.SX, reach: ca.SX = WHOLE) -> list[ca.SX]:
        """The squeeze to start from, as states at friction coefficients (2,) of the robots; it may
        lie beyond the cones where they are far below the nominal ones.

        Args:
            reach: (2,) sizes of the robots' patches over their own.
        """
        return self._at([ca.SX(ca.DM(state)) for state in self._squeeze], friction, reach)

    def squeeze_normals(self) -> Array:
        """(2,) what each robot's pads press with in the squeeze."""
        normals = np.array([state[0] for state in self._squeeze])
        return np.bincount(np.array(self.robots), normals, 2).astype(float)

    def squeeze_wrenches(self) -> Array:
        """(k, 6) of all pads in the squeeze, see `grasp_wrenches`."""
        friction, states = ca.SX(ca.DM(self.nominal[0])), self._squeeze
        sizes = [patch.wrench_size for patch in self.patches]
        parts = [
            whole_wrench(self.units(i, friction) * ca.SX(ca.DM(state[:size])))
            for i, (state, size) in enumerate(zip(states, sizes, strict=True))
        ]
        return np.array(ca.evalf(ca.horzcat(*parts))).T

    def units(self, i: int, friction: ca.SX, reach: ca.SX = WHOLE) -> ca.SX:
        """(m,) what the entries of pad i's scaled wrench are multiples of."""
        robot = self.robots[i]
        units = _units(friction[robot], reach[robot] * self._pads[i].patch_radius)
        return units[list(EVEN)] if self.patches[i].wrench_size == len(EVEN) else units

    def _at(self, states: list[ca.SX], friction: ca.SX, reach: ca.SX = WHOLE) -> list[ca.SX]:
        """States at the nominal friction and size with what they carry, at others: each corner's
        force is shared among those of the other size."""
        moved = []
        for pad, robot, state in zip(self._pads, self.robots, states, strict=True):
            by_friction, by_reach = pad.friction / friction[robot], 1.0 / reach[robot]
            size = state.shape[0]
            held, by_size = tangential(size), size_powers(size)
            factors = [
                (by_friction if k in held else 1.0) * by_reach ** by_size[k] for k in range(size)
            ]
            moved.append(state * ca.vertcat(*factors))
        return moved


def grasp_wrenches(
    grasp: Grasp, load: ca.MX, friction: ca.MX, differentiable: bool = False
) -> ca.MX:
    """Per pad (6,) side by side: N, T (2,) [N], the first moment N d (2,) and M [N m], of least
    effort, in its pad's axes. Friction that does not close the grasp gives normal forces beyond
    any limit.

    Args:
        load: (6,) force and moment about the box frame's origin, along the box's axes.
        friction: (2,) Coulomb coefficients of the robots' pads.
        differentiable: whether first derivatives are wanted.
    """
    size = ca.sqrt(ca.sumsqr(load[:3]) + ca.sumsqr(load[3:] / MOMENT_ARM) + SCALE_FLOOR**2)
    solve = differentiable_least_effort if differentiable else least_effort
    found = solve(grasp, load / size, friction)
    return _in_newtons(grasp)(found, size, friction)


def _reached_best(to_box: Array) -> NDArray[np.intp]:
    """Components (m,) of states that what is balanced (m,) reaches best, by a QR decomposition
    with pivots."""
    # Not imported at the top: a warm start makes no grasp.
    from scipy.linalg import qr

    return np.sort(qr(to_box, pivoting=True)[2][: len(to_box)])


def _in_newtons(grasp: Grasp) -> ca.Function:
    ends = [0, *accumulate(patch.wrench_size for patch in grasp.patches)]
    found, size, friction = ca.SX.sym("w", ends[-1]), ca.SX.sym("s"), ca.SX.sym("mu", 2)
    wrenches = [
        whole_wrench(grasp.units(i, friction) * own)
        for i, own in enumerate(ca.vertsplit(found, ends))
    ]
    squeezed = zip(grasp.patches, grasp.squeezed(friction), strict=True)
    closes = least([patch.slack(state) for patch, state in squeezed]) > 0.0
    beyond = ca.repmat(ca.DM([BEYOND, 0, 0, 0, 0, 0]), len(wrenches), 1)
    held = size * ca.if_else(closes, ca.vertcat(*wrenches), beyond)
    return ca.Function("in_newtons", [found, size, friction], [held])


def whole_wrench(wrench: ca.SX) -> ca.SX:
    """All six entries of a pad's wrench (m,)."""
    if wrench.shape[0] == WRENCH_SIZE:
        return wrench
    whole = ca.SX(WRENCH_SIZE, wrench.shape[1])
    whole[list(EVEN), :] = wrench
    return ca.densify(whole)


def _load_at_rest(workcell: Workcell) -> Array:
    """(6,) of the payload as it stands at the start, as a direction that is scaled like loads."""
    start = ca.SX(ca.DM(workcell.start_turn))
    turn = ca.evalf(rotation_matrix(workcell.task.orientation, start))
    force = -np.array(turn).T @ np.array(GRAVITY)
    moment = np.cross(workcell.payload.centre_of_mass, force)
    load = np.concatenate([force, moment])
    return np.asarray(load / np.hypot(np.linalg.norm(force), np.linalg.norm(moment) / MOMENT_ARM))


def _patch(contact: Contact, even: bool) -> Patch:
    if even:
        return EvenPatch(scaled_patch(contact))
    return RoundPatch() if contact.half_sides is None else RectangularPatch(*contact.half_sides)


def _sparse(matrix: Array) -> ca.DM:
    """Without what is zero but for rounding."""
    small = np.abs(matrix) < 1e-14 * np.abs(matrix).max()
    return ca.sparsify(ca.DM(np.where(small, 0.0, matrix)))


def _units(mu: ca.SX, r: ca.SX) -> ca.SX:
    return ca.vertcat(1.0, mu, mu, r, r, mu * r)


# --- two round pads that face one another ---


Objective = Literal["effort", "squeeze"]
"""|f_1|^2 + |f_2|^2 or N_1 + N_2."""

LOWEST = (4.0 / 3.0) ** 0.5
"""Bound of what a wrench without normal force takes from a patch's eigenvalues, over its length:
their sum is zero and that of their squares is twice its square (Samuelson)."""

BALANCE_SIZE = 9
CELL_SIZES = (("balance", BALANCE_SIZE), ("friction", 2), ("radius", 2))


def balance_of(
    force: Expression, moment: Expression, arms: tuple[Expression, Expression]
) -> Expression:
    """What the contacts have to balance (9,), see `BALANCE_SIZE`.

    Args:
        force: (3,) resultant force.
        moment: (3,) required moment about the centre of mass.
        arms: (3,) each, from the centre of mass to the nominal contact points.
    """
    rest = moment - ca.cross(arms[1], force)
    return ca.vertcat(force[2], force[:2], -rest[1], rest[0], rest[2], arms[0] - arms[1])


def facing_wrenches(
    balance: ca.MX,
    friction: ca.MX,
    radius: ca.MX,
    objective: Objective = "effort",
    differentiable: bool = False,
) -> ca.MX:
    """Wrenches (12,) of two round pads that face one another: of each N, T (2,) [N], the first
    moment N d (2,) and M [N m] about n, all along a and b of contact 1.

    There always are some, because pressing harder carries everything, if the patches overlap when
    seen along the normal. Those of the least N_1 + N_2 in place of the least effort: the balance
    fixes N_1 - N_2, so that both are as small as they can be; with less of either no pressure on
    the patches carries what is asked, with more of both some does.

    Args:
        balance: (9,), see `balance_of`.
        friction: (2,) Coulomb coefficients of the contacts.
        radius: (2,) radii of the patches [m].
        objective: what is least.
        differentiable: whether first derivatives are wanted
            (`symbolic.contact.central_path.differentiable_least_effort`).
    """
    scale = ca.sqrt(ca.sumsqr(balance[:3]) + ca.sumsqr(balance[3:5] / balance[8]) + SCALE_FLOOR**2)
    scaled = (ca.vertcat(balance[:6] / scale, balance[6:]), friction, radius)
    solve = differentiable_least_effort if differentiable else least_effort
    return _facing_in_newtons()(solve(OppositePads(objective), *scaled), scale, friction, radius)


@cache
def _facing_in_newtons() -> ca.Function:
    found, scale = ca.SX.sym("w", 2 * WRENCH_SIZE), ca.SX.sym("s")
    mu, r = ca.SX.sym("mu", 2), ca.SX.sym("r", 2)
    units = ca.vertcat(*[_units(mu[i], r[i]) for i in (0, 1)])
    return ca.Function("in_newtons", [found, scale, mu, r], [scale * units * found])


@dataclass(frozen=True)
class OppositePads:
    """Two round pads that face one another, as a `symbolic.contact.central_path.Program`.

    Its inputs are `balance_of`, over the force's scale, the coefficients and the radii, so that all
    of these may vary.

    Attributes:
        objective: what is minimised.
    """

    objective: Objective
    patches: tuple[Patch, ...] = (RoundPatch(), RoundPatch())
    cell_sizes: tuple[tuple[str, int], ...] = CELL_SIZES

    def free(self, wrenches: list[ca.SX]) -> ca.SX:
        """That of contact 1."""
        return wrenches[0]

    def balanced(self, free: ca.SX, cell: list[ca.SX]) -> list[ca.SX]:
        """What contact 1 leaves to contact 2, its normal force along -n."""
        wrench, (balance, friction, radius) = free, cell
        tangent, moment = friction[0] * wrench[1:3], radius[0] * wrench[3:5]
        # Moments about pad 2: (p_1 - p_2) x f_1 and the contacts' own make up what is required.
        moment_2 = moment - balance[8] * tangent + wrench[0] * balance[6:8] - balance[3:5]
        about_n = balance[5] - cross_2(balance[6:8], tangent) - friction[0] * radius[0] * wrench[5]
        over_mu, over_r = reciprocal(friction[1]), reciprocal(radius[1])
        left = ca.vertcat(
            wrench[0] - balance[0],
            (balance[1:3] - tangent) * over_mu,
            moment_2 * over_r,
            about_n * (over_mu * over_r),
        )
        return [wrench, left]

    def effort(self, wrenches: list[ca.SX], cell: list[ca.SX]) -> ca.SX:
        """Half the sum of the squared forces, or the sum of the normal ones."""
        if self.objective == "squeeze":
            return wrenches[0][0] + wrenches[1][0]
        mu = cell[1]
        forces = [ca.vertcat(w[0], mu[i] * w[1:3]) for i, w in enumerate(wrenches)]
        return ca.sumsqr(ca.vertcat(*forces)) / 2.0

    def start(self, cell: list[ca.SX]) -> tuple[list[ca.SX], ca.SX]:
        """Wrenches within both cones, pressed as hard as what else they carry asks."""
        balance, friction, radius = cell
        # Tangential forces that leave little moment to be carried: least squares, scaled.
        over_mu_1, over_mu_2 = 1.0 / friction[0] ** 2, 1.0 / friction[1] ** 2
        lever = balance[8] / ca.sum1(radius)
        by_lever = lever / ca.sum1(radius)
        tangent = (over_mu_2 * balance[1:3] - by_lever * balance[3:5]) / (
            over_mu_1 + over_mu_2 + lever**2
        )
        lighter = ca.fmax(balance[0], 0.0)
        asked = [_length(wrench[1:]) for wrench in _shared(cell, tangent, lighter)]
        # The squeeze itself tilts the box where the pads do not face one another.
        overlap = 1.0 - _length(balance[6:8]) / ca.sum1(radius)
        pressed = LOWEST * ca.fmax(*asked) / (START_SHARE * overlap) + START_FLOOR
        return _shared(cell, tangent, pressed + lighter), ca.SX(START_WEIGHT)


def even_slack(balance: ca.SX, friction: ca.SX, radius: ca.SX, n_1: ca.SX) -> ca.SX:
    """Whether wrenches hold that share everything evenly, if contact 1 presses with n_1 [N].

    Positive where both lie within their cones: then the patches carry what is asked. Where it is
    not, another pressure still may.

    Args:
        balance, friction, radius: as in `facing_wrenches`.
    """
    left = []
    for wrench in _evenly([balance, friction, radius], n_1):
        normal = wrench[0]
        left += [
            normal,
            1.0 - ca.sumsqr(wrench[1:3]) / normal**2,
            1.0 - ca.sumsqr(wrench[3:5]) / normal**2,
            patch_slack(wrench) / normal**4,
        ]
    return ca.mmin(ca.vertcat(*left))


def _evenly(cell: list[ca.SX], n_1: ca.SX) -> list[ca.SX]:
    """`_shared` with tangential forces in proportion to friction."""
    balance, friction, _ = cell
    return _shared(cell, friction[0] / ca.sum1(friction) * balance[1:3], n_1)


def _shared(cell: list[ca.SX], tangent: ca.SX, n_1: ca.SX) -> list[ca.SX]:
    """Scaled wrenches (6,) of both contacts under a normal force and a tangential force (2,) of
    contact 1, moments in proportion to radii and torsion to friction times radius."""
    balance, friction, radius = cell
    tilt = balance[8] * tangent + balance[3:5]
    about_n = balance[5] - cross_2(balance[6:8], tangent)
    # A share over the contact's own friction or radius is the whole over the sum of both.
    first = ca.vertcat(
        n_1,
        tangent / friction[0],
        (tilt - n_1 * balance[6:8]) / ca.sum1(radius),
        about_n / ca.sum1(friction * radius),
    )
    return OppositePads("effort").balanced(first, cell)


def _length(vector: ca.SX) -> ca.SX:
    return ca.sqrt(ca.sumsqr(vector))
