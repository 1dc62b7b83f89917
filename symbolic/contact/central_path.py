"""Least effort of contact patches that balance a load, by an interior-point method.

    minimise effort(w_1, ..., w_k)  subject to  the wrenches w_i balance the load,
                                                each lies within its patch's cone

The method is primal-dual with a predictor and a corrector (Mehrotra, SIAM J. Optim. 2, 1992). The
predictor is a first step to weight zero. The corrector aims at a point of the central path with a
smaller weight and includes the predictor's second-order terms. The start lies within the cones and
balances the load. Some six steps suffice; at most `CENTRAL_PATH_STEPS` are in the expression, each
skipped once the weight is small enough, so that the whole compiles. The load and the free
components determine the other six components of the wrenches. Starts from a neighbouring sample's
solution need more steps where several candidates run in lanes, and some do not converge.

A patch's state lies within its cone and begins with its scaled wrench, see
`symbolic.contact.force_closure`. The cone of a kind of patch is given by its barrier
(`symbolic.contact.even_patch`). An iterate holds a state X and multipliers S; their product is the
weight on the central path.
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
"""Final weight of the barriers over the effort. The relative excess of the effort over the least
effort is at most this times the sum of the patches' degrees."""

END_WEIGHT_FACTOR = 2.0
"""The steps end once the weight is below this multiple of the final weight."""

CENTRING, CENTRED = 30, 1e-8
"""Largest number of Newton steps on the barriers alone, from the final iterate onto the central
path; and the squared Newton decrement over the weight at which they end."""

NEWTON_STEPS = 100
"""Largest number of Newton steps on the barriers alone, from any states within the cones."""

CENTRAL_PATH_STEPS = 30
STEP_SHARE, LAST_SHARE, APPROACH = 0.97, 0.999, 100.0
"""Largest share of the way to the cones' boundary in one step; the same near the end; and the
factor that gives the share left near the end from the weight over the effort."""

START_WEIGHT = 0.5
"""Weight at a start with unknown multipliers, over the effort per degree at this start."""

BLOCK = 10
"""Number of steps that are skipped together after convergence: each skipped step copies the
iterate."""

PROGRAMS = 16
"""Number of programs whose functions are cached."""


AnyExpression = TypeVar("AnyExpression", ca.SX, ca.MX)


class ConvexProgram(Protocol):
    """Convex program: the contact wrenches of least cost that balance a load.

    Wrenches are scaled by friction and patch radius as in `symbolic.contact.force_closure`. The
    argument `cell` of every method lists the program's inputs in the order of `cell_sizes`.
    """

    @property
    def patches(self) -> tuple[Patch, ...]:
        """Contact patches, one per contact, in the order of the wrenches."""

    @property
    def cell_sizes(self) -> tuple[tuple[str, int], ...]:
        """(name, number of entries) of each input of the convex program, in order."""

    @property
    def given(self) -> dict[str, ca.SX]:
        """Symbolic parameters of the cell in the convex program's formulas, by name of the
        parameter group. Compiled functions take these parameters after the inputs `cell_sizes`."""

    def free(self, wrenches: list[ca.SX]) -> ca.SX:
        """Select those components of the scaled wrenches of all contacts that the load does not
        determine, as one column. The load and these free components determine the other
        components."""

    def balanced(self, free: ca.SX, cell: list[ca.SX]) -> list[ca.SX]:
        """Compute the scaled wrench of each contact such that all contacts together balance the
        load, the first of the inputs `cell`. The result is affine in the column `free` of the
        components that the load does not determine."""

    def effort(self, wrenches: list[ca.SX], cell: list[ca.SX]) -> ca.SX:
        """Compute the cost of the scaled wrenches of all contacts: a scalar, the sum over the
        contacts of convex terms of degree two at most. `cell` lists the convex program's inputs."""

    def start(self, cell: list[ca.SX]) -> tuple[list[ca.SX], ca.SX]:
        """Compute the start of the interior-point method for the inputs `cell`.

        Returns:
            The state (n,) of each patch, inside its cone and in balance with the load; and a scalar
            s: the initial weight of the barriers is s times the effort at this state, over the sum
            of `degree` of all patches.
        """

    def __hash__(self) -> int:
        """Hash by identity: compiled functions are cached by program."""


class Patch(ABC):
    """Kind of contact patch, with a barrier function of its friction cone.

    X is the state and S its multipliers; on the central path X S equals the barrier's weight.

    Attributes:
        wrench_size: number of entries of a scaled wrench: six, or fewer if the patch bears fewer.
        state_size: number n of entries of a state; the scaled wrench comes first.
        iterate_size: number of entries of an iterate: state, further entries of X, multipliers.
        correction_size: number of entries of a second-order correction.
        degree: trace of X S over the weight, on the central path.
    """

    wrench_size: ClassVar[int]
    state_size: ClassVar[int]
    iterate_size: ClassVar[int]
    correction_size: ClassVar[int]
    degree: ClassVar[float]

    @abstractmethod
    def centred(self, state: ca.SX, weight: ca.SX) -> ca.SX:
        """Build the iterate (iterate_size,) of a state (n,). It holds the state and the multipliers
        that belong to the state on the central path: -`weight` times the gradient of the
        barrier."""

    @abstractmethod
    def local(self, iterate: ca.SX) -> LocalPatch:
        """Compute the derivatives of the barrier at an iterate (iterate_size,), the state with its
        multipliers, for a Newton step."""

    @abstractmethod
    def potential(self, state: ca.SX) -> ca.SX:
        """Compute the barrier function (scalar) of the patch's friction cone at a state (n,). It
        grows without limit towards the cone's boundary."""

    @abstractmethod
    def lowest(self, state: ca.SX, change: ca.SX) -> ca.SX:
        """Compute -1 / t, where t > 0 is a step length with which `state` + t `change`, both (n,),
        lies inside the cone; t is nearly the largest such length. The result is near zero if no
        step leaves the cone.
        """

    @abstractmethod
    def slack(self, state: ca.SX) -> ca.SX:
        """Compute a scalar that is positive if a state (n,) lies inside the cone, and zero or
        negative outside."""

    def barrier(self, state: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Compute gradient (n,) and Hessian (n, n) of the cone's barrier function at a
        state (n,)."""
        symbol = ca.SX.sym("state", self.state_size)
        curvature, slope = ca.hessian(self.potential(symbol), symbol)
        found = ca.substitute([ca.densify(slope), curvature], [symbol], [state])
        return found[0], found[1]

    def third(self, state: ca.SX, along: ca.SX, columns: ca.SX) -> ca.SX:
        """Compute the third derivative (n, k) of the barrier at a state (n,): the change of its
        Hessian along the direction `along` (n,), times the matrix `columns` (n, k)."""
        sizes = (1, 1, columns.shape[1])
        symbol, one, others = symbols = [ca.SX.sym("s", self.state_size, k) for k in sizes]
        slope = ca.gradient(self.potential(symbol), symbol)
        bent = ca.jtimes(ca.jtimes(slope, symbol, one), symbol, others)
        return ca.substitute([bent], symbols, [state, along, ca.densify(columns)])[0]


@dataclass(frozen=True)
class NewtonStep:
    """Newton step of one patch: changes of its state and its multipliers.

    Attributes:
        change: (iterate_size,) change of the iterate in a full step.
        lowest_of_state: -1 / t for a step length t within the cone of the state (`Patch.lowest`).
        lowest: -1 / t for a step length t within the cones of state and multipliers.
        second_order: returns the second-order correction (correction_size,) of a full step,
            sym(X^-1 dX dS).
        gap_after: maps a step length to the trace of X S after the step.
    """

    change: ca.SX
    lowest_of_state: ca.SX
    lowest: ca.SX
    second_order: Callable[[], ca.SX]
    gap_after: Callable[[ca.SX], ca.SX]


class LocalPatch(Protocol):
    """Derivatives of one patch's barrier at an iterate.

    Attributes:
        state: (n,) state, the scaled wrench first.
        stiffness: (n, n) decrease of the multipliers per change of the state.
        gap: trace of X S.
    """

    state: ca.SX
    stiffness: ca.SX
    gap: ca.SX

    def pull(self, weight: ca.SX, correction: ca.SX) -> ca.SX:
        """Compute the multipliers (n,) that a Newton step would give if it left the state
        unchanged. A change of the state lowers them by `stiffness` times the change.

        Args:
            weight: weight of the barrier after the step.
            correction: (correction_size,) second-order correction of the multipliers; zero in a
                predictor step.
        """

    def step(self, weight: ca.SX, correction: ca.SX, change: ca.SX) -> NewtonStep:
        """Compute the Newton step of state and multipliers in which the state changes by `change`.

        Args:
            weight: weight of the barrier after the step.
            correction: (correction_size,) second-order correction of the multipliers; zero in a
                predictor step.
            change: (n,) change of the state in a full step.
        """


# --- the method ---


def least_effort(program: ConvexProgram, *cell: ca.MX, differentiable: bool = False) -> ca.MX:
    """Build the expression of the contact wrenches of least effort.

    It is one column with the wrenches of all patches, in their order, each in the scaled units of
    the program.

    Args:
        program: the convex program, which defines the effort.
        cell: the program's inputs, then its symbolic parameters.
        differentiable: True for exact first derivatives. The solution then gets additional steps
            onto the central path, and only the last of them is differentiated. Second derivatives
            are not exact.
    """
    if differentiable:
        states, _ = barrier_step(program)(centred(program)(*cell), 1.0, *cell)
        owns = ca.vertsplit(states, state_ends(program))
    else:
        owns = ca.vertsplit(central_path(program)(*cell), ends_of(program))
    return ca.vertcat(*wrenches_of(program, owns))


@lru_cache(PROGRAMS)
def central_path(program: ConvexProgram, final_weight: float = FINAL_WEIGHT) -> ca.Function:
    """Build the function that solves a convex program by the interior-point method.

    Inputs: the program's inputs, then its symbolic parameters. Output: one column with the iterates
    of all patches, each a state with its multipliers. They are near the point of the central path
    at which the weight of the barriers is `final_weight` times the effort.
    """
    cell = _mx_inputs(program)
    step = _step(program, final_weight)
    iterate = _repeated(program, step, CENTRAL_PATH_STEPS, _start(program)(*cell), cell)
    return ca.Function("central_path", cell, [iterate])


@lru_cache(PROGRAMS)
def centred(program: ConvexProgram, final_weight: float = FINAL_WEIGHT) -> ca.Function:
    """Build the function that solves a convex program and moves the solution onto the central path.

    Inputs: the program's inputs, then its symbolic parameters. Output: one column with the states
    of all patches, at the point of the central path at which the weight of the barriers is
    `final_weight` times the effort. CasADi treats this output as constant: its derivatives are
    zero.
    """
    cell = _mx_inputs(program)
    owns = ca.vertsplit(central_path(program, final_weight)(*cell), ends_of(program))
    near = [own[: patch.state_size] for patch, own in zip(program.patches, owns, strict=True)]
    step = barrier_step(program, final_weight)
    states = _repeated(program, step, CENTRING, ca.vertcat(*near), cell)
    constant = {"is_diff_in": [False] * len(cell), "is_diff_out": [False]}
    return ca.Function("centred", cell, [states], constant)


def _repeated(
    program: ConvexProgram, step: ca.Function, most: int, iterate: ca.MX, cell: list[ca.MX]
) -> ca.MX:
    """Build the expression of the iterate after at most `most` steps. Steps after the last needed
    one are skipped in blocks of `BLOCK`.

    Args:
        program: the convex program.
        step: function of one step. It takes an iterate, a flag, and `cell`; it returns the next
            iterate, and a flag that is 0 if no further step is needed.
        most: largest number of steps, a multiple of `BLOCK`.
        iterate: the first iterate, one column for all patches.
        cell: the program's inputs, then its symbolic parameters.
    """
    held = [ca.MX.sym("iterate", iterate.shape[0]), ca.MX.sym("goes_on")]
    inputs = [*held, *_mx_inputs(program)]
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
    """Build the function of one step of the interior-point method.

    Inputs: the iterates of all patches, one column; a flag that is not read; the program's inputs
    and symbolic parameters. Outputs: the next iterates, and a flag that is 1 if a further step is
    needed. The step lowers the weight of the barriers, but not below `final_weight` times the
    effort.
    """
    iterate, cell = ca.SX.sym("iterate", ends_of(program)[-1]), _sx_inputs(program)
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
    """Build the function of one Newton step of all patches' states towards the point of the central
    path at which the weight of the barriers is `final_weight` times the effort.

    Inputs: the states, one column; a flag that is not read; the program's inputs and symbolic
    parameters. Outputs: the new states, and a flag that is 1 if a further step is needed. At states
    on the central path, the derivatives of the new states by the inputs are those of the central
    path.
    """
    states, cell = ca.SX.sym("states", state_ends(program)[-1]), _sx_inputs(program)
    owns = ca.vertsplit(states, state_ends(program))
    weight, pulls, equations = barrier_equations(program, owns, cell, final_weight)
    changes = equations.changes(pulls)
    moves = zip(program.patches, owns, changes, strict=True)
    length = _length([patch.lowest(*move) for patch, *move in moves], STEP_SHARE)
    goes_on = equations.decrement(pulls, changes) > CENTRED * weight
    inputs = [states, ca.SX.sym("goes_on"), *cell, *program.given.values()]
    found = states + length * ca.vertcat(*changes)
    return ca.Function("barrier_step", inputs, ca.cse([found, goes_on]))


def barrier_equations(
    program: ConvexProgram, states: list[ca.SX], cell: list[ca.SX], final_weight: float
) -> tuple[ca.SX, list[ca.SX], Equations]:
    """Build Newton's equations for the minimum of effort plus barriers.

    Args:
        program: the convex program.
        states: state (n,) of each patch.
        cell: the program's inputs.
        final_weight: weight of the barriers over the effort.

    Returns:
        The barriers' weight; the multipliers (n,) of each patch, -weight times the gradient of its
        barrier; and Newton's equations.
    """
    weight = final_weight * program.effort(wrenches_of(program, states), cell)
    patches = zip(program.patches, states, strict=True)
    slopes, curvatures = zip(*[patch.barrier(own) for patch, own in patches], strict=True)
    equations = Equations(program, cell, states, [weight * own for own in curvatures])
    return weight, [-weight * slope for slope in slopes], equations


def central_point(
    program: ConvexProgram, states: Array, cell: list[Array], share: float
) -> tuple[Array, Array]:
    """Compute the point of the central path for given inputs, with NumPy.

    Args:
        program: the convex program.
        states: (n,) initial states of all patches, inside the cones and in balance with the load.
        cell: values of the program's inputs; the first is the load (m,).
        share: relative weight of the barriers: the weight times the sum of the patches' degrees,
            over the effort.

    Returns:
        States (n,) of all patches on the central path, and their derivatives (n, m) by the load.
    """
    final_weight = share / degree_of(program)
    step = barrier_step(program, final_weight)
    for _ in range(NEWTON_STEPS):
        states, goes_on = step(states, 1.0, *cell)
        if not goes_on:
            break
    load, at = ca.SX.sym("load", len(cell[0])), ca.vertsplit(ca.SX(states), state_ends(program))
    known = [load, *[ca.SX(ca.DM(value)) for value in cell[1:]]]
    equations = barrier_equations(program, at, known, final_weight)[-1]
    slopes = equations.constrained(ca.jacobian(equations.missing, load))
    return np.array(states).ravel(), np.array(ca.evalf(slopes))


def _length(lowest: list[ca.SX], share: ca.SX | float) -> ca.SX:
    """Compute the length of a Newton step: `share` of the way to the boundary of the first cone
    that the step would leave, at most 1.

    Args:
        lowest: for each patch -1 / t, where t is the step length at which the patch's state reaches
            the boundary of its cone (`Patch.lowest`).
        share: part of the smallest t that the step may go, at most 1.
    """
    return ca.fmin(1.0, share / ca.fmax(-minimum(lowest), share))


@lru_cache(PROGRAMS)
def _start(program: ConvexProgram) -> ca.Function:
    """Build the function from a convex program's inputs to the first iterate of all patches: the
    states of `ConvexProgram.start`, with multipliers as on the central path."""
    cell = _sx_inputs(program)
    states, share = program.start(cell)
    effort = program.effort(wrenches_of(program, states), cell)
    weight = effort * (share / degree_of(program))
    pairs = zip(program.patches, states, strict=True)
    iterate = ca.vertcat(*[patch.centred(own, weight) for patch, own in pairs])
    return ca.Function("start", [*cell, *program.given.values()], ca.cse([iterate]))


# --- Newton's equations ---


def minimum(values: list[ca.SX]) -> ca.SX:
    """Return the expression of the smallest of several scalar values."""
    found = values[0]
    for value in values[1:]:
        found = ca.fmin(found, value)
    return found


def symmetric(rows: Sequence[Sequence[ca.SX]]) -> ca.SX:
    """Build a symmetric matrix (n, n) from the n rows of its lower triangle; row i has i + 1
    entries."""
    n = range(len(rows))
    columns = [ca.vertcat(*[rows[max(i, j)][min(i, j)] for i in n]) for j in n]
    return ca.horzcat(ca.SX(len(rows), 0), *columns)


class Factors:
    """Factorisation L D L' of a symmetric matrix (n, n), complete or stopped after k columns.
    Structural zeros are skipped.

    Stopped after k columns, it eliminates the first k unknowns of a linear system with this matrix.

    Attributes:
        schur_complement: (n - k, n - k) matrix that remains for the other n - k unknowns.
    """

    def __init__(self, matrix: ca.SX, k: int | None = None) -> None:
        """Factorise a symmetric matrix.

        Args:
            matrix: (n, n) matrix; only its lower triangle is read.
            k: number of columns to eliminate; None for all n.
        """
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
        self.schur_complement = symmetric([rows[i][rest.start :] for i in rest])

    def forward(self, right: ca.SX) -> ca.SX:
        """Eliminate the first k unknowns from a right side `right` (n,); return the reduced right
        side (n,)."""
        found = ca.vertsplit(right)
        for p, below in enumerate(self._below):
            for i, share in below.items():
                found[i] = found[i] - share * found[p]
        return ca.vertcat(*found)

    def backward(self, reduced: ca.SX, others: ca.SX | None = None) -> ca.SX:
        """Compute all unknowns (n,) from the reduced right side (n,) of `forward` and from the n -
        k unknowns `others` that were not eliminated; None if k = n."""
        first = ca.vertsplit(reduced)[: len(self._below)]
        found = [value * over for value, over in zip(first, self._over_pivot, strict=True)]
        found += [] if others is None else ca.vertsplit(others)
        for p in reversed(range(len(first))):
            for i, share in self._below[p].items():
                found[p] = found[p] - share * found[i]
        return ca.vertcat(*found)


class Equations:
    """Newton's equations of a convex program at given states of all patches, n entries together.

    Entries of a state that are not part of the wrench are eliminated first, patch by patch. Then
    the equations are solved for the free components of the wrenches.

    Attributes:
        effort: effort at the states, a scalar.
        missing: (n,) change of the dependent components that balances the load.
        slope, curvature: gradient (n,) and Hessian (n, n) of the effort by the states.
    """

    def __init__(
        self, program: ConvexProgram, cell: list[ca.SX], states: list[ca.SX], stiffness: list[ca.SX]
    ) -> None:
        """Build Newton's equations of effort plus barriers at given states, and factor them.

        Args:
            program: the convex program.
            cell: the program's inputs.
            states: state (m,) of each patch.
            stiffness: for each patch the matrix (m, m), weight times the Hessian of its barrier.
        """
        self._ends = [0, *accumulate(state.shape[0] for state in states)]
        starts = zip(self._ends, program.patches, strict=False)
        self._wrench = [at + k for at, patch in starts for k in range(patch.wrench_size)]
        beside = [k for k in range(self._ends[-1]) if k not in self._wrench]
        self._order = [*beside, *self._wrench]
        self.effort, self.slope, self.curvature = effort_derivatives(program, states, cell)
        wrenches = wrenches_of(program, states)
        at, self.missing = program.free(wrenches), ca.SX(self._ends[-1], 1)
        self.missing[self._wrench] = ca.vertcat(*program.balanced(at, cell)) - ca.vertcat(*wrenches)
        free = ca.SX.sym("free", at.shape[0])
        self._by_free = ca.jacobian(ca.vertcat(*program.balanced(free, cell)), free)
        self._stiff = self.curvature + ca.diagcat(*stiffness)
        self._first = Factors(self._stiff[self._order, self._order], len(beside))
        self._last = Factors(
            ca.mtimes([self._by_free.T, self._first.schur_complement, self._by_free])
        )

    def decrement(self, pulls: list[ca.SX], changes: list[ca.SX]) -> ca.SX:
        """Compute the squared Newton decrement times the weight of the barriers, a scalar. It
        measures the distance from the central path.

        Args:
            pulls: multipliers (m,) of each patch, -weight times the gradient of its barrier.
            changes: change (m,) of each patch's state in the Newton step.
        """
        return ca.dot(ca.vertcat(*pulls) - self.slope, ca.vertcat(*changes))

    def changes(self, pulls: list[ca.SX]) -> list[ca.SX]:
        """Compute the change (m,) of each patch's state in a Newton step, after which the states
        balance the load.

        Args:
            pulls: multipliers (m,) of each patch, as `LocalPatch.pull` returns them.
        """
        pull = ca.vertcat(*pulls) - self.slope - ca.mtimes(self._stiff, self.missing)
        found: list[ca.SX] = ca.vertsplit(self.missing + self.balanced_change(pull), self._ends)
        return found

    def constrained(self, moved: ca.SX) -> ca.SX:
        """Compute how the states on the central path change if the load changes.

        Args:
            moved: (n, k) for each of k changes of the load, a change of all states that balances
                it: the components that the load determines change, the free components do not.

        Returns:
            (n, k) changes of all states: `moved`, plus a change without effect on the load that
            minimises effort plus barriers again.
        """
        pulls = ca.horzsplit(-ca.mtimes(self._stiff, moved))
        return moved + ca.horzcat(*map(self.balanced_change, pulls))

    def balanced_change(self, pull: ca.SX) -> ca.SX:
        """Solve Newton's equations for a change of the states that leaves the balance of the load
        unchanged.

        Args:
            pull: (n,) right side of the equations, one number per entry of all patches' states.

        Returns:
            Change (n,) of the states of all patches.
        """
        reduced, found = self._first.forward(pull[self._order]), ca.SX(*pull.shape)
        left = self._last.forward(ca.mtimes(self._by_free.T, reduced[-len(self._wrench) :]))
        wrenches = ca.mtimes(self._by_free, self._last.backward(left))
        found[self._order] = self._first.backward(reduced, wrenches)
        return found


def effort_derivatives(
    program: ConvexProgram, states: list[ca.SX], cell: list[ca.SX]
) -> list[ca.SX]:
    """Compute the effort (scalar), and its gradient (n,) and Hessian (n, n) by the n entries of all
    states. `states` has the state of each patch, `cell` the program's inputs."""
    symbols = [ca.SX.sym("state", state.shape[0]) for state in states]
    effort, whole = program.effort(wrenches_of(program, symbols), cell), ca.vertcat(*symbols)
    by = [effort, *ca.hessian(effort, whole)[::-1]]
    found: list[ca.SX] = ca.substitute(by, [whole], [ca.vertcat(*states)])
    return found


def _mx_inputs(program: ConvexProgram) -> list[ca.MX]:
    """Return one MX column per input of the program, then one per group of its parameters."""
    given = ((name, numbers.numel()) for name, numbers in program.given.items())
    return [ca.MX.sym(name, size) for name, size in (*program.cell_sizes, *given)]


def _sx_inputs(program: ConvexProgram) -> list[ca.SX]:
    """Return one SX column per input of the program, without the symbolic parameters."""
    return [ca.SX.sym(name, size) for name, size in program.cell_sizes]


def wrenches_of(program: ConvexProgram, owns: list[AnyExpression]) -> list[AnyExpression]:
    """Select the scaled wrench (wrench_size,) of each patch of a convex program from the patches'
    states or iterates `owns`."""
    return [own[: patch.wrench_size] for patch, own in zip(program.patches, owns, strict=True)]


def degree_of(program: ConvexProgram) -> float:
    """Return the sum of the degrees of the barriers of a convex program's patches. A barrier of
    degree d falls by d log t if the state is multiplied by t."""
    return sum(patch.degree for patch in program.patches)


def ends_of(program: ConvexProgram) -> list[int]:
    """Return the index at which each patch's iterate begins in the column of all iterates, and last
    the size of the column."""
    return [0, *accumulate(patch.iterate_size for patch in program.patches)]


def state_ends(program: ConvexProgram) -> list[int]:
    """Return the index at which each patch's state begins in the column of all states, and last the
    size of the column."""
    return [0, *accumulate(patch.state_size for patch in program.patches)]
