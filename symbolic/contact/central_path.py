"""Least effort of contact patches that balance a load, by an interior-point method.

    minimise effort(w_1, ..., w_k)  subject to  the wrenches w_i balance the load,
                                                each lies within its patch's cone

The method is primal-dual with a predictor and a corrector (Mehrotra, SIAM J. Optim. 2, 1992): each
step aims at the central path's place of a smaller weight, to second order by what a first step
to weight zero leaves out. It starts within the cones, the load balanced, and takes some six steps;
at most `STEPS`, each of which is passed over once the weight is small enough, so that the whole is
one expression and compiles. Six components of the wrenches are what the others leave. Starts from a
neighbouring sample's solution take more steps where several candidates run in lanes, and some never
arrive.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import accumulate
from typing import Protocol, TypeVar

import casadi as ca
import numpy as np

from symbolic.array import Array
from symbolic.contact.patches import Elimination, Patch, Step, least

FINAL_WEIGHT = 1e-8
"""Last weight of the barriers over the effort, which ends above the least by at most the sum of
the patches' degrees times this: 6e-8 of it for two round ones."""

NEAR = 2.0
"""Multiple of the final weight at which the steps end."""

CENTRING, CENTRED = 30, 1e-8
"""Newton steps of the barriers alone, at most, from there onto the central path; the square of
Newton's decrement, over the weight, that counts as being there."""

STEPS = 30
STEP_SHARE, LAST_SHARE, APPROACH = 0.97, 0.999, 100.0
"""Largest share of the way to the cones' boundary in one step; the same near the end; and how many
times the weight, over the effort, what is left near the end may be."""

START_WEIGHT = 0.5
"""Weight of a start whose multipliers are not known, over the effort there per degree."""

NEWTON_STEPS, NEWTON_CHANGE = 100, 1e-9
"""Newton steps to a point on the central path, at most, and the change, over the iterate, that
counts as none."""

BLOCK = 10
"""Steps that are passed over at once where nothing goes on: each costs a copy of the iterate."""

PROGRAMS = 16
"""How many programs' functions are kept."""


AnyExpression = TypeVar("AnyExpression", ca.SX, ca.MX)


class Program(Protocol):
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


def least_effort(program: Program, *cell: ca.MX, differentiable: bool = False) -> ca.MX:
    """Scaled wrenches of least effort side by side, in the order of the program's patches.

    Args:
        cell: the program's inputs, its given numbers behind them.
        differentiable: whether first derivatives are wanted. They are those of the central path, on
            which the wrenches then lie after some more steps: the last one is differentiated, the
            iterate it starts from is not. Second ones are not to be had so.
    """
    if differentiable:
        iterate, _ = _barrier_step(program)(centred(program)(*cell), 1.0, *cell)
    else:
        iterate = central_path(program)(*cell)
    return ca.vertcat(*wrenches_of(program, ca.vertsplit(iterate, ends_of(program))))


@lru_cache(PROGRAMS)
def central_path(program: Program, final_weight: float = FINAL_WEIGHT) -> ca.Function:
    """The cell to an iterate of all patches near the central path's place of a last weight."""
    cell = _handed(program)
    step = _step(program, final_weight)
    iterate = _repeated(program, step, STEPS, _start(program)(*cell), cell)
    return ca.Function("central_path", cell, [iterate])


@lru_cache(PROGRAMS)
def centred(program: Program, final_weight: float = FINAL_WEIGHT) -> ca.Function:
    """The cell to an iterate on the central path. Its derivatives count as zero."""
    cell = _handed(program)
    near = central_path(program, final_weight)(*cell)
    iterate = _repeated(program, _barrier_step(program, final_weight), CENTRING, near, cell)
    constant = {"is_diff_in": [False] * len(cell), "is_diff_out": [False]}
    return ca.Function("centred", cell, [iterate], constant)


def _repeated(
    program: Program, step: ca.Function, most: int, iterate: ca.MX, cell: list[ca.MX]
) -> ca.MX:
    """The iterate after at most that many steps, in whole blocks, as long as they go on."""
    held = [ca.MX.sym("iterate", ends_of(program)[-1]), ca.MX.sym("goes_on")]
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
def _step(program: Program, final_weight: float = FINAL_WEIGHT) -> ca.Function:
    """An iterate, a flag that does not matter and the cell to the next one and whether to go on."""
    iterate, cell = iterate_and_cell(program)
    owns = zip(program.patches, ca.vertsplit(iterate, ends_of(program)), strict=True)
    local = [patch.local(own) for patch, own in owns]
    degree = degree_of(program)
    weight = sum(own.gap for own in local) / degree
    equations = Equations(program, cell, [(own.wrench, own.stiffness) for own in local])

    def steps(aimed: ca.SX, corrections: list[ca.SX]) -> list[Step]:
        pairs = zip(local, corrections, strict=True)
        aims = [own.aim(aimed, correction) for own, correction in pairs]
        changes = equations.changes([aim.pull for aim in aims])
        return [aim.step(change) for aim, change in zip(aims, changes, strict=True)]

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
        ca.cse([iterate + length * change, gap > NEAR * degree * final]),
    )


@lru_cache(PROGRAMS)
def _barrier_step(program: Program, final_weight: float = FINAL_WEIGHT) -> ca.Function:
    """As `_step`, to the one whose state is of the final weight, by Newton's step of the barriers
    alone; where it has arrived there, its derivatives by the cell are those of the central path."""
    iterate, cell = iterate_and_cell(program)
    owns = ca.vertsplit(iterate, ends_of(program))
    wrenches = wrenches_of(program, owns)
    weight = final_weight * efforts(program, wrenches, cell)[0]
    patches = zip(program.patches, owns, strict=True)
    barriers = [patch.barrier(own, weight) for patch, own in patches]
    stiff = [own.stiffness for own in barriers]
    equations = Equations(program, cell, list(zip(wrenches, stiff, strict=True)))
    changes = equations.changes([own.pull for own in barriers])
    downhill = equations.downhill([own.pull for own in barriers], changes)
    steps = [own.step(change) for own, change in zip(barriers, changes, strict=True)]
    length = _length([step.lowest_of_state for step in steps], STEP_SHARE)
    found = iterate + length * ca.vertcat(*[step.change for step in steps])
    inputs = [iterate, ca.SX.sym("goes_on"), *cell, *program.given.values()]
    return ca.Function("barrier_step", inputs, ca.cse([found, downhill > CENTRED * weight]))


def _length(lowest: list[ca.SX], share: ca.SX | float) -> ca.SX:
    """Length of a step: at most whole, and at most a share of the way to the boundary."""
    return ca.fmin(1.0, share / ca.fmax(-least(lowest), share))


@lru_cache(PROGRAMS)
def _start(program: Program) -> ca.Function:
    """The program's start, as an iterate on the central path of a problem like it."""
    cell = [ca.SX.sym(name, size) for name, size in program.cell_sizes]
    states, share = program.start(cell)
    inputs = [*cell, *program.given.values()]
    return ca.Function("start", inputs, ca.cse([_centred_at(program, states, share, cell)]))


def _centred_at(
    program: Program, states: list[ca.SX], share: ca.SX | float, cell: list[ca.SX]
) -> ca.SX:
    """The iterate whose X S is a weight, given over the effort per degree."""
    effort = program.effort(wrenches_of(program, states), cell)
    weight = effort * (share / degree_of(program))
    pairs = zip(program.patches, states, strict=True)
    return ca.vertcat(*[patch.centred(own, weight) for patch, own in pairs])


def central_point(
    program: Program, states: list[Array], cell: list[Array], share: float
) -> tuple[Array, Array]:
    """An iterate (n,) on the central path, and its slope (n, m) by the program's first input (m,).

    Args:
        states: of all patches, within their cones, that balance the load.
        cell: the inputs.
        share: the weight, over the effort there per degree.
    """
    newton = _newton_step(program, share)
    start = _centred_at(program, [ca.SX(ca.DM(s)) for s in states], START_WEIGHT, cell)
    iterate = np.array(ca.evalf(start)).ravel()
    for _ in range(NEWTON_STEPS):
        change, length = (np.array(value).ravel() for value in newton(iterate, *cell))
        iterate = iterate + length * change
        if np.linalg.norm(change) < NEWTON_CHANGE * np.linalg.norm(iterate):
            break
    load, *others = cell
    # At one place the step is affine in what is to be balanced.
    along = [np.array(newton(iterate, load + e, *others)[0]).ravel() for e in np.eye(len(load))]
    return iterate, np.stack(along, axis=1) - np.array(newton(iterate, *cell)[0])


def _newton_step(program: Program, share: float) -> ca.Function:
    """An iterate and the cell to the whole step to a weight, over the effort per degree, and how
    much of it can be gone."""
    iterate, cell = iterate_and_cell(program)
    owns = zip(program.patches, ca.vertsplit(iterate, ends_of(program)), strict=True)
    local = [patch.local(own) for patch, own in owns]
    equations = Equations(program, cell, [(own.wrench, own.stiffness) for own in local])
    weight = equations.effort * (share / degree_of(program))
    pairs = zip(program.patches, local, strict=True)
    aims = [own.aim(weight, ca.SX.zeros(patch.correction_size)) for patch, own in pairs]
    changes = equations.changes([aim.pull for aim in aims])
    steps = [aim.step(change) for aim, change in zip(aims, changes, strict=True)]
    length = _length([step.lowest for step in steps], STEP_SHARE)
    return ca.Function(
        "newton_step", [iterate, *cell], [ca.vertcat(*[step.change for step in steps]), length]
    )


# --- Newton's equations ---


class Equations:
    """Newton's equations of a program, for the wrenches.

    Attributes:
        effort: at the iterate.
    """

    def __init__(
        self, program: Program, cell: list[ca.SX], local: list[tuple[ca.SX, ca.SX]]
    ) -> None:
        """Factors.

        Args:
            local: of each patch its wrench (m,) and stiffness (m, m).
        """
        wrenches = [wrench for wrench, _ in local]
        self.effort, self._slopes, curvatures = efforts(program, wrenches, cell)
        stiff = [curve + own for curve, (_, own) in zip(curvatures, local, strict=True)]
        at, own = program.free(wrenches), ca.vertcat(*wrenches)
        free = ca.SX.sym("free", at.shape[0])
        # All wrenches by the free components.
        self._by_free = ca.jacobian(ca.vertcat(*program.balanced(free, cell)), free)
        self._missing = ca.vertcat(*program.balanced(at, cell)) - own
        self._stiff, self._ends = ca.diagcat(*stiff), [0, *accumulate(w.shape[0] for w in wrenches)]
        whole = ca.mtimes([self._by_free.T, self._stiff, self._by_free])
        self._system = Elimination.whole(whole)

    def downhill(self, pulls: list[ca.SX], changes: list[ca.SX]) -> ca.SX:
        """How fast effort and barriers fall along changes: the decrement's square, times the
        weight."""
        terms = zip(pulls, self._slopes, changes, strict=True)
        return sum(ca.dot(pull - slope, change) for pull, slope, change in terms)

    def changes(self, pulls: list[ca.SX]) -> list[ca.SX]:
        """Changes of all wrenches (m,) under the pulls (m,) of the patches' multipliers."""
        right = (
            ca.vertcat(*pulls) - ca.vertcat(*self._slopes) - ca.mtimes(self._stiff, self._missing)
        )
        free = self._system.solved(ca.mtimes(self._by_free.T, right))
        found: list[ca.SX] = ca.vertsplit(
            self._missing + ca.mtimes(self._by_free, free), self._ends
        )
        return found


def efforts(
    program: Program, wrenches: list[ca.SX], cell: list[ca.SX]
) -> tuple[ca.SX, list[ca.SX], list[ca.SX]]:
    """The effort at wrenches, its slopes (m,) and curvatures (m, m) by each of them."""
    symbols = [ca.SX.sym(f"w_{i}", wrench.shape[0]) for i, wrench in enumerate(wrenches)]
    effort = program.effort(symbols, cell)
    slopes = [ca.gradient(effort, w) for w in symbols]
    curvatures = [ca.hessian(effort, w)[0] for w in symbols]
    passed = ca.Function("effort", [*symbols, *cell], [effort, *slopes, *curvatures])
    found, k = passed.call([*wrenches, *cell]), len(wrenches)
    return found[0], list(found[1 : k + 1]), list(found[k + 1 :])


def _handed(program: Program) -> list[ca.MX]:
    """The cell and the given numbers, as inputs of functions that hand them on."""
    given = ((name, numbers.numel()) for name, numbers in program.given.items())
    return [ca.MX.sym(name, size) for name, size in (*program.cell_sizes, *given)]


def iterate_and_cell(program: Program) -> tuple[ca.SX, list[ca.SX]]:
    """An iterate and the cell, without the given numbers."""
    cell = [ca.SX.sym(name, size) for name, size in program.cell_sizes]
    return ca.SX.sym("iterate", ends_of(program)[-1]), cell


def wrenches_of(program: Program, owns: list[AnyExpression]) -> list[AnyExpression]:
    """The wrenches with which the patches' states or iterates begin."""
    return [own[: patch.wrench_size] for patch, own in zip(program.patches, owns, strict=True)]


def degree_of(program: Program) -> float:
    """Pairing of all X with S over the weight on the central path."""
    return sum(patch.degree for patch in program.patches)


def ends_of(program: Program) -> list[int]:
    """Where in an iterate the patches' own ones begin, and its size."""
    return [0, *accumulate(patch.iterate_size for patch in program.patches)]
