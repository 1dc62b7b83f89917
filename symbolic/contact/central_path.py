"""Least effort of contact patches that balance a load, by an interior-point method.

    minimise effort(w_1, ..., w_k)  subject to  the wrenches w_i balance the load,
                                                each lies within its patch's cone

The method is primal-dual with a predictor and a corrector (Mehrotra, SIAM J. Optim. 2, 1992): each
step aims at the central path's place of a smaller weight, to second order by what a first step
to weight zero leaves out. It starts within the cones, the load balanced, and takes some six steps;
at most `CENTRAL_PATH_STEPS`, each of which is skipped once the weight is small enough, so that the
whole is one expression and compiles. Six components of the wrenches are what the others leave.
Starts from a neighbouring sample's solution take more steps where several candidates run in lanes,
and some never arrive.

A patch's state lies within its cone and begins with its scaled wrench, see
`symbolic.contact.force_closure`. The cone is one of positive semidefinite matrices X: those of a
rectangle's corners are real 2 by 2 (`symbolic.contact.rectangular_patch`), a disc's is complex 3 by
3 (`symbolic.contact.round_patch`). An iterate of the method has such an X and as large a matrix S
of multipliers, both positive definite, whose product is a multiple of one on the central path.
Newton's step takes S + dS = weight / X - sym(X^-1 dX S) - correction: the direction of Helmberg,
Rendl, Vanderbei and Wolkowicz (SIAM J. Optim. 6, 1996), seen from X.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, product
from typing import ClassVar, Protocol, TypeVar

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.expression import reciprocal

FINAL_WEIGHT = 1e-8
"""Last weight of the barriers over the effort, which ends above the least by at most the sum of
the patches' degrees times this: 6e-8 of it for two round ones."""

END_WEIGHT_FACTOR = 2.0
"""Multiple of the final weight at which the steps end."""

CENTRING, CENTRED = 30, 1e-8
"""Newton steps of the barriers alone, at most, from there onto the central path; the square of
Newton's decrement, over the weight, that counts as being there."""

NEWTON_STEPS = 100
"""The same from states that may be far from it, at most."""

CENTRAL_PATH_STEPS = 30
STEP_SHARE, LAST_SHARE, APPROACH = 0.97, 0.999, 100.0
"""Largest share of the way to the cones' boundary in one step; the same near the end; and how many
times the weight, over the effort, what is left near the end may be."""

START_WEIGHT = 0.5
"""Weight of a start whose multipliers are not known, over the effort there per degree."""

BLOCK = 10
"""Steps that are passed over at once where nothing goes on: each costs a copy of the iterate."""

PROGRAMS = 16
"""How many programs' functions are kept."""


AnyExpression = TypeVar("AnyExpression", ca.SX, ca.MX)


class ConvexProgram(Protocol):
    """What a set of contacts has to balance, and at what cost.

    Its scaled wrenches are those of `symbolic.contact.force_closure`; `cell` are its inputs, in
    order.
    """

    @property
    def patches(self) -> tuple[Patch, ...]:
        """Patches of all contacts."""

    @property
    def cell_sizes(self) -> tuple[tuple[str, int], ...]:
        """Names and sizes of the inputs."""

    @property
    def given(self) -> dict[str, ca.SX]:
        """Numbers in its formulas that are symbols, by group: inputs behind the cell."""

    def free(self, wrenches: list[ca.SX]) -> ca.SX:
        """The components that are free."""

    def balanced(self, free: ca.SX, cell: list[ca.SX]) -> list[ca.SX]:
        """All wrenches from these: six other components are what they leave; affine."""

    def effort(self, wrenches: list[ca.SX], cell: list[ca.SX]) -> ca.SX:
        """What is minimised: a sum over the contacts, each convex and at most quadratic."""

    def start(self, cell: list[ca.SX]) -> tuple[list[ca.SX], ca.SX]:
        """States of all patches, well within their cones, that balance the load, and the weight to
        begin with, over the effort there per degree."""

    def __hash__(self) -> int:
        """Functions are kept by program."""


class Patch(ABC):
    """A kind of patch.

    Attributes:
        wrench_size: entries of a scaled wrench: all six, or those that the patch can bear.
        state_size: entries of a program's state.
        iterate_size: entries of an iterate: all that X is made of, the state first; multipliers.
        correction_size: entries of a correction.
        degree: pairing of X with S over the weight on the central path.
    """

    wrench_size: ClassVar[int]
    state_size: ClassVar[int]
    iterate_size: ClassVar[int]
    correction_size: ClassVar[int]
    degree: ClassVar[float]

    @abstractmethod
    def centred(self, state: ca.SX, weight: ca.SX) -> ca.SX:
        """An iterate whose X S is the weight, from a program's state."""

    @abstractmethod
    def local(self, iterate: ca.SX) -> LocalPatch:
        """What steps from an iterate need."""

    @abstractmethod
    def potential(self, state: ca.SX) -> ca.SX:
        """The barrier at a program's state, of which `centred` has the multipliers."""

    @abstractmethod
    def lowest(self, state: ca.SX, change: ca.SX) -> ca.SX:
        """Bound from below of what a change of a program's state adds to the eigenvalues of X, over
        them."""

    @abstractmethod
    def slack(self, state: ca.SX) -> ca.SX:
        """Positive within the cone, not so beyond its boundary; of a program's state."""

    def barrier(self, state: ca.SX) -> tuple[ca.SX, ca.SX]:
        """The barrier's gradient (n,) and Hessian (n, n) at a program's state."""
        symbol = ca.SX.sym("state", self.state_size)
        curvature, slope = ca.hessian(self.potential(symbol), symbol)
        found = ca.substitute([ca.densify(slope), curvature], [symbol], [state])
        return found[0], found[1]

    def third(self, state: ca.SX, along: ca.SX, columns: ca.SX) -> ca.SX:
        """The barrier's third derivative at a program's state, along a direction (n,) and each of
        some columns (n, k)."""
        sizes = (1, 1, columns.shape[1])
        symbol, one, others = symbols = [ca.SX.sym("s", self.state_size, k) for k in sizes]
        slope = ca.gradient(self.potential(symbol), symbol)
        bent = ca.jtimes(ca.jtimes(slope, symbol, one), symbol, others)
        return ca.substitute([bent], symbols, [state, along, ca.densify(columns)])[0]


@dataclass(frozen=True)
class NewtonStep:
    """A step of X and multipliers.

    Attributes:
        change: (iterate_size,) of the iterate.
        lowest_of_state: bound from below of what it adds to the eigenvalues of X, over them.
        lowest: the bound for both X and S.
        second_order: () to (correction_size,) what the whole step leaves out: sym(X^-1 dX dS).
        gap_after: a share of the step to the pairing of X with S after it.
    """

    change: ca.SX
    lowest_of_state: ca.SX
    lowest: ca.SX
    second_order: Callable[[], ca.SX]
    gap_after: Callable[[ca.SX], ca.SX]


class LocalPatch(Protocol):
    """A patch at an iterate.

    Attributes:
        state: (n,) all that X is made of, the wrench first.
        stiffness: (n, n) what the multipliers give less for a change of it.
        gap: pairing of X with S.
    """

    state: ca.SX
    stiffness: ca.SX
    gap: ca.SX

    def pull(self, weight: ca.SX, correction: ca.SX) -> ca.SX:
        """(n,) what multipliers of a weight and a correction give to X where that stays."""

    def step(self, weight: ca.SX, correction: ca.SX, change: ca.SX) -> NewtonStep:
        """The step to these multipliers that changes X by (n,)."""


# --- the method ---


def least_effort(program: ConvexProgram, *cell: ca.MX, differentiable: bool = False) -> ca.MX:
    """Scaled wrenches of least effort side by side, in the order of the program's patches.

    Args:
        cell: the program's inputs, its given numbers behind them.
        differentiable: whether first derivatives are wanted. They are those of the central path, on
            which the wrenches then lie after some more steps: the last one is differentiated, the
            states it starts from are not. Second ones are not to be had so.
    """
    if differentiable:
        states, _ = barrier_step(program)(centred(program)(*cell), 1.0, *cell)
        owns = ca.vertsplit(states, state_ends(program))
    else:
        owns = ca.vertsplit(central_path(program)(*cell), ends_of(program))
    return ca.vertcat(*wrenches_of(program, owns))


@lru_cache(PROGRAMS)
def central_path(program: ConvexProgram, final_weight: float = FINAL_WEIGHT) -> ca.Function:
    """The cell to an iterate of all patches near the central path's place of a last weight."""
    cell = _handed(program)
    step = _step(program, final_weight)
    iterate = _repeated(program, step, CENTRAL_PATH_STEPS, _start(program)(*cell), cell)
    return ca.Function("central_path", cell, [iterate])


@lru_cache(PROGRAMS)
def centred(program: ConvexProgram, final_weight: float = FINAL_WEIGHT) -> ca.Function:
    """The cell to states of all patches on the central path. Their derivatives count as zero."""
    cell = _handed(program)
    owns = ca.vertsplit(central_path(program, final_weight)(*cell), ends_of(program))
    near = [own[: patch.state_size] for patch, own in zip(program.patches, owns, strict=True)]
    step = barrier_step(program, final_weight)
    states = _repeated(program, step, CENTRING, ca.vertcat(*near), cell)
    constant = {"is_diff_in": [False] * len(cell), "is_diff_out": [False]}
    return ca.Function("centred", cell, [states], constant)


def _repeated(
    program: ConvexProgram, step: ca.Function, most: int, iterate: ca.MX, cell: list[ca.MX]
) -> ca.MX:
    """The iterate after at most that many steps, in whole blocks, as long as they go on."""
    held = [ca.MX.sym("iterate", iterate.shape[0]), ca.MX.sym("goes_on")]
    inputs = [*held, *_handed(program)]
    keep = ca.Function("keep", inputs, held)

    def after(count: int, one: ca.Function, state: list[ca.MX], cell: list[ca.MX]) -> list[ca.MX]:
        choice = ca.Function.if_else(f"{one.name()}_or_not", one, keep)
        for _ in range(count):
            state = choice(state[1], *state, *cell)
        return state

    name = f"{step.name()}s"
    block = ca.Function(name, inputs, after(BLOCK, step, held, inputs[2:]))
    return after(most // BLOCK, block, [iterate, ca.MX(1.0)], cell)[0]


@lru_cache(PROGRAMS)
def _step(program: ConvexProgram, final_weight: float = FINAL_WEIGHT) -> ca.Function:
    """An iterate, a flag that does not matter and the cell to the next one and whether to go on."""
    iterate, cell = ca.SX.sym("iterate", ends_of(program)[-1]), _cell(program)
    owns = zip(program.patches, ca.vertsplit(iterate, ends_of(program)), strict=True)
    local = [patch.local(own) for patch, own in owns]
    degree = degree_of(program)
    weight = sum(own.gap for own in local) / degree
    stiff = [own.stiffness for own in local]
    equations = Equations(program, cell, [own.state for own in local], stiff)

    def steps(aimed: ca.SX, corrections: list[ca.SX]) -> list[NewtonStep]:
        pairs = [*zip(local, corrections, strict=True)]
        changes = equations.changes([own.pull(aimed, correction) for own, correction in pairs])
        moves = zip(pairs, changes, strict=True)
        return [own.step(aimed, correction, change) for (own, correction), change in moves]

    none = [ca.SX.zeros(patch.correction_size) for patch in program.patches]
    first = steps(ca.SX(0.0), none)
    far = _length([step.lowest_of_state for step in first], 1.0)
    final = final_weight * equations.effort
    aimed = ca.fmax((1.0 - far) ** 2 * weight, final)
    second = steps(aimed, [step.second_order() for step in first])
    share = ca.fmin(ca.fmax(STEP_SHARE, 1.0 - APPROACH * weight / equations.effort), LAST_SHARE)
    length = _length([step.lowest for step in second], share)
    change = ca.vertcat(*[step.change for step in second])
    gap = sum(step.gap_after(length) for step in second)
    return ca.Function(
        "step",
        [iterate, ca.SX.sym("goes_on"), *cell, *program.given.values()],
        ca.cse([iterate + length * change, gap > END_WEIGHT_FACTOR * degree * final]),
    )


@lru_cache(PROGRAMS)
def barrier_step(program: ConvexProgram, final_weight: float = FINAL_WEIGHT) -> ca.Function:
    """As `_step`, from states to those of the final weight, by Newton's step of the barriers alone;
    where they have arrived there, its derivatives by the cell are those of the central path."""
    states, cell = ca.SX.sym("states", state_ends(program)[-1]), _cell(program)
    owns = ca.vertsplit(states, state_ends(program))
    weight, pulls, equations = against_barriers(program, owns, cell, final_weight)
    changes = equations.changes(pulls)
    moves = zip(program.patches, owns, changes, strict=True)
    length = _length([patch.lowest(*move) for patch, *move in moves], STEP_SHARE)
    goes_on = equations.downhill(pulls, changes) > CENTRED * weight
    inputs = [states, ca.SX.sym("goes_on"), *cell, *program.given.values()]
    found = states + length * ca.vertcat(*changes)
    return ca.Function("barrier_step", inputs, ca.cse([found, goes_on]))


def against_barriers(
    program: ConvexProgram, states: list[ca.SX], cell: list[ca.SX], final_weight: float
) -> tuple[ca.SX, list[ca.SX], Equations]:
    """The weight, the barriers' pulls at it, and Newton's equations of effort and barriers."""
    weight = final_weight * program.effort(wrenches_of(program, states), cell)
    patches = zip(program.patches, states, strict=True)
    slopes, curvatures = zip(*[patch.barrier(own) for patch, own in patches], strict=True)
    equations = Equations(program, cell, states, [weight * own for own in curvatures])
    return weight, [-weight * slope for slope in slopes], equations


def central_point(
    program: ConvexProgram, states: Array, cell: list[Array], share: float
) -> tuple[Array, Array]:
    """States (n,) on the central path, and their slopes (n, m) by the program's first input (m,).

    Args:
        states: (n,) of all patches, within their cones, that balance the load.
        cell: the inputs.
        share: the weight, over the effort there per degree.
    """
    final_weight = share / degree_of(program)
    step = barrier_step(program, final_weight)
    for _ in range(NEWTON_STEPS):
        states, goes_on = step(states, 1.0, *cell)
        if not goes_on:
            break
    load, at = ca.SX.sym("load", len(cell[0])), ca.vertsplit(ca.SX(states), state_ends(program))
    known = [load, *[ca.SX(ca.DM(value)) for value in cell[1:]]]
    equations = against_barriers(program, at, known, final_weight)[-1]
    slopes = equations.settled(ca.jacobian(equations.missing, load))
    return np.array(states).ravel(), np.array(ca.evalf(slopes))


def _length(lowest: list[ca.SX], share: ca.SX | float) -> ca.SX:
    """Length of a step: at most whole, and at most a share of the way to the boundary."""
    return ca.fmin(1.0, share / ca.fmax(-least(lowest), share))


@lru_cache(PROGRAMS)
def _start(program: ConvexProgram) -> ca.Function:
    """The program's start, as an iterate on the central path of a problem like it."""
    cell = _cell(program)
    states, share = program.start(cell)
    effort = program.effort(wrenches_of(program, states), cell)
    weight = effort * (share / degree_of(program))
    pairs = zip(program.patches, states, strict=True)
    iterate = ca.vertcat(*[patch.centred(own, weight) for patch, own in pairs])
    return ca.Function("start", [*cell, *program.given.values()], ca.cse([iterate]))


# --- Newton's equations ---


def least(values: list[ca.SX]) -> ca.SX:
    """The least of some values."""
    found = values[0]
    for value in values[1:]:
        found = ca.fmin(found, value)
    return found


def symmetric(rows: Sequence[Sequence[ca.SX]]) -> ca.SX:
    """A symmetric matrix (n, n) from its rows, each up to the diagonal."""
    n = range(len(rows))
    columns = [ca.vertcat(*[rows[max(i, j)][min(i, j)] for i in n]) for j in n]
    return ca.horzcat(ca.SX(len(rows), 0), *columns)


class Factors:
    """L D L' of the first k unknowns of a symmetric matrix, all by default; zeros cost nothing.

    Attributes:
        left: (n - k, n - k) matrix of the others, once these are eliminated.
    """

    def __init__(self, matrix: ca.SX, k: int | None = None) -> None:
        """Factor; what is above the diagonal is not read."""
        n = range(matrix.shape[0])
        rows = [[matrix[i, j] for j in range(i + 1)] for i in n]
        self._below: list[dict[int, ca.SX]] = []  # the columns of L, without zeros
        self._over_pivot: list[ca.SX] = []
        for p in n[:k]:
            over = reciprocal(rows[p][p])
            below = {i: rows[i][p] * over for i in n[p + 1 :] if rows[i][p].nnz()}
            for i, j in product(below, below):
                if j <= i:
                    rows[i][j] = rows[i][j] - below[i] * rows[j][p]
            self._below.append(below)
            self._over_pivot.append(over)
        rest = n[len(self._below) :]
        self.left = symmetric([rows[i][rest.start :] for i in rest])

    def reduced(self, right: ca.SX) -> ca.SX:
        """(n,) a right side; in the first unknowns' place what `first` takes, then what is left for
        the others."""
        found = ca.vertsplit(right)
        for p, below in enumerate(self._below):
            for i, share in below.items():
                found[i] = found[i] - share * found[p]
        return ca.vertcat(*found)

    def solved(self, reduced: ca.SX, others: ca.SX | None = None) -> ca.SX:
        """(n,) unknowns from `reduced` and the other unknowns (n - k,)."""
        first = ca.vertsplit(reduced)[: len(self._below)]
        found = [value * over for value, over in zip(first, self._over_pivot, strict=True)]
        found += [] if others is None else ca.vertsplit(others)
        for p in reversed(range(len(first))):
            for i, share in self._below[p].items():
                found[p] = found[p] - share * found[i]
        return ca.vertcat(*found)


class Equations:
    """Newton's equations of a program: what moves beside the wrenches is eliminated first, patch by
    patch, then the wrenches' components that are free are solved for.

    Attributes:
        effort: at the states.
        missing: (n,) what the states lack to balance the load.
        slope, curvature: (n,) and (n, n) of the effort.
    """

    def __init__(
        self, program: ConvexProgram, cell: list[ca.SX], states: list[ca.SX], stiffness: list[ca.SX]
    ) -> None:
        """Factors.

        Args:
            states: of each patch (m,) its wrench and what moves beside it.
            stiffness: of each patch (m, m).
        """
        self._ends = [0, *accumulate(state.shape[0] for state in states)]
        starts = zip(self._ends, program.patches, strict=False)
        self._wrench = [at + k for at, patch in starts for k in range(patch.wrench_size)]
        beside = [k for k in range(self._ends[-1]) if k not in self._wrench]
        self._order = [*beside, *self._wrench]
        self.effort, self.slope, self.curvature = efforts(program, states, cell)
        wrenches = wrenches_of(program, states)
        at, self.missing = program.free(wrenches), ca.SX(self._ends[-1], 1)
        self.missing[self._wrench] = ca.vertcat(*program.balanced(at, cell)) - ca.vertcat(*wrenches)
        free = ca.SX.sym("free", at.shape[0])
        self._by_free = ca.jacobian(ca.vertcat(*program.balanced(free, cell)), free)
        self._stiff = self.curvature + ca.diagcat(*stiffness)
        self._first = Factors(self._stiff[self._order, self._order], len(beside))
        self._last = Factors(ca.mtimes([self._by_free.T, self._first.left, self._by_free]))

    def downhill(self, pulls: list[ca.SX], changes: list[ca.SX]) -> ca.SX:
        """How fast effort and barriers fall along changes: the decrement's square, times the
        weight."""
        return ca.dot(ca.vertcat(*pulls) - self.slope, ca.vertcat(*changes))

    def changes(self, pulls: list[ca.SX]) -> list[ca.SX]:
        """Changes of all states (m,) under the pulls (m,) of the patches' multipliers."""
        pull = ca.vertcat(*pulls) - self.slope - ca.mtimes(self._stiff, self.missing)
        found: list[ca.SX] = ca.vertsplit(self.missing + self.pulled(pull), self._ends)
        return found

    def settled(self, moved: ca.SX) -> ca.SX:
        """Changes (n, k) of states that are moved (n, k), what is free following as is best."""
        pulls = ca.horzsplit(-ca.mtimes(self._stiff, moved))
        return moved + ca.horzcat(*map(self.pulled, pulls))

    def pulled(self, pull: ca.SX) -> ca.SX:
        """Changes (n,) under a pull (n,) that leave the load balanced."""
        reduced, found = self._first.reduced(pull[self._order]), ca.SX(*pull.shape)
        left = self._last.reduced(ca.mtimes(self._by_free.T, reduced[-len(self._wrench) :]))
        wrenches = ca.mtimes(self._by_free, self._last.solved(left))
        found[self._order] = self._first.solved(reduced, wrenches)
        return found


def efforts(program: ConvexProgram, states: list[ca.SX], cell: list[ca.SX]) -> list[ca.SX]:
    """The effort at states, its slope (n,) and curvature (n, n)."""
    symbols = [ca.SX.sym("state", state.shape[0]) for state in states]
    effort, whole = program.effort(wrenches_of(program, symbols), cell), ca.vertcat(*symbols)
    by = [effort, *ca.hessian(effort, whole)[::-1]]
    found: list[ca.SX] = ca.substitute(by, [whole], [ca.vertcat(*states)])
    return found


def _handed(program: ConvexProgram) -> list[ca.MX]:
    """The cell and the given numbers, as inputs of functions that hand them on."""
    given = ((name, numbers.numel()) for name, numbers in program.given.items())
    return [ca.MX.sym(name, size) for name, size in (*program.cell_sizes, *given)]


def _cell(program: ConvexProgram) -> list[ca.SX]:
    """The cell, without the given numbers."""
    return [ca.SX.sym(name, size) for name, size in program.cell_sizes]


def wrenches_of(program: ConvexProgram, owns: list[AnyExpression]) -> list[AnyExpression]:
    """The wrenches with which the patches' states or iterates begin."""
    return [own[: patch.wrench_size] for patch, own in zip(program.patches, owns, strict=True)]


def degree_of(program: ConvexProgram) -> float:
    """Pairing of all X with S over the weight on the central path."""
    return sum(patch.degree for patch in program.patches)


def ends_of(program: ConvexProgram) -> list[int]:
    """Where in an iterate the patches' own ones begin, and its size."""
    return [0, *accumulate(patch.iterate_size for patch in program.patches)]


def state_ends(program: ConvexProgram) -> list[int]:
    """Where in the states of all patches the patches' own ones begin, and their size."""
    return [0, *accumulate(patch.state_size for patch in program.patches)]
