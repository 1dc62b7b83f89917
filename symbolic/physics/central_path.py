"""Least effort of contact patches that balance a load, by a fixed number of Newton steps.

    minimise effort(w_1, ..., w_k)  subject to  the wrenches w_i balance the load,
                                                each lies within its patch's cone

A barrier method follows the central path with a fixed number of Newton steps, so that the whole is
one expression and compiles. Each step aims at a lower barrier with the curvature of the present
one, which takes the tangent of the path and the correction towards it in one solve, and goes at
most `STEP_SHARE` of the way to a bound of the cones' boundary. The wrench of the last contact is
what the others leave, so that 6 (k - 1) components are free.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import Protocol

import casadi as ca

from symbolic.physics.closure import WRENCH_SIZE
from symbolic.physics.patches import Patch, least

FINAL_BARRIER = 1e-8
"""Last weight of the barriers over the effort, which ends above the least by at most the sum of
the patches' degrees times this: 6e-8 of it for two round ones."""

STEP_SHARE = 0.9

PROGRAMS = 16
"""How many programs' functions are kept."""


@dataclass(frozen=True)
class Pace:
    """How fast the barriers' weight falls.

    Attributes:
        steps: Newton steps before the one that is differentiated.
        shrink: of the weight per step.
    """

    steps: int
    shrink: float


class Program(Protocol):
    """What a set of contacts has to balance, and at what cost.

    Its scaled wrenches are those of `symbolic.physics.patches`; `cell` are its inputs, in order.
    """

    @property
    def patches(self) -> tuple[Patch, ...]:
        """Of every contact."""

    @property
    def cell_sizes(self) -> tuple[tuple[str, int], ...]:
        """Names and sizes of the inputs."""

    @property
    def pace(self) -> Pace:
        """Of the path."""

    def left(self, wrenches: list[ca.SX], cell: list[ca.SX]) -> ca.SX:
        """(6,) of the last contact: what the others leave; affine."""

    def effort(self, wrenches: list[ca.SX], cell: list[ca.SX]) -> ca.SX:
        """What is minimised: a sum over the contacts, each convex and at most quadratic."""

    def start(self, cell: list[ca.SX]) -> list[ca.SX]:
        """States of all patches, well within their cones, that balance the load."""

    def __hash__(self) -> int:
        """Functions are kept by program."""


def least_effort(program: Program, *cell: ca.MX) -> ca.MX:
    """Scaled wrenches (6 k,) of least effort, in the order of the program's patches.

    First derivatives are those of the central path's point: the last Newton step is differentiated,
    the point it starts from is not. Second ones are not to be had so.
    """
    state, _ = newton_step(program)(*central_path(program)(*cell), *cell)
    return ca.vertcat(*[own[:WRENCH_SIZE] for own in ca.vertsplit(state, _ends(program))])


@lru_cache(PROGRAMS)
def central_path(program: Program) -> ca.Function:
    """States of all patches and the barriers' weight near the end of the central path.

    Its derivatives count as zero.
    """
    cell = [ca.MX.sym(name, size) for name, size in program.cell_sizes]
    state, barrier = _start(program)(*cell)
    for _ in range(program.pace.steps):
        state, barrier = newton_step(program)(state, barrier, *cell)
    constant = {"is_diff_in": [False] * len(cell), "is_diff_out": [False, False]}
    return ca.Function("central_path", cell, [state, barrier], constant)


@lru_cache(PROGRAMS)
def newton_step(program: Program) -> ca.Function:
    """State, barriers' weight and the cell to the next state and weight."""
    patches, n = program.patches, len(program.patches)
    state, barrier = ca.SX.sym("state", _ends(program)[-1]), ca.SX.sym("barrier")
    cell = [ca.SX.sym(name, size) for name, size in program.cell_sizes]
    states = ca.vertsplit(state, _ends(program))
    wrenches = [own[:WRENCH_SIZE] for own in states]
    symbols = [ca.SX.sym(f"w_{i}", WRENCH_SIZE) for i in range(n)]
    passed = ca.Function(
        "effort",
        [*symbols, *cell],
        [
            program.effort(symbols, cell),
            *(ca.gradient(program.effort(symbols, cell), w) for w in symbols),
            *(ca.hessian(program.effort(symbols, cell), w)[0] for w in symbols),
        ],
    ).call([*wrenches, *cell])
    effort, gradients, hessians = passed[0], list(passed[1 : n + 1]), list(passed[n + 1 :])
    target = ca.fmax(program.pace.shrink * barrier, FINAL_BARRIER * effort)
    for i, (patch, own) in enumerate(zip(patches, states, strict=True)):
        slope, curvature = patch.local(own)
        gradients[i] += target * slope
        hessians[i] += barrier * curvature
    missing = program.left(wrenches[:-1], cell) - wrenches[-1]
    passes = [ca.jacobian(program.left(symbols[:-1], cell), w) for w in symbols[:-1]]
    on_last = gradients[-1] + ca.mtimes(hessians[-1], missing)
    change = ca.horzcat(*passes)
    gradient = ca.vertcat(*gradients[:-1]) + ca.mtimes(change.T, on_last)
    hessian = ca.diagcat(*hessians[:-1]) + ca.mtimes([change.T, hessians[-1], change])
    free = -ca.ldl_solve(gradient, *ca.ldl(hessian, False))
    changes = [*ca.vertsplit(free, WRENCH_SIZE), missing + ca.mtimes(change, free)]
    share = target / barrier
    steps = [
        patch.step(own, moved, share)
        for patch, own, moved in zip(patches, states, changes, strict=True)
    ]
    lowest = [
        patch.lowest(own, step) for patch, own, step in zip(patches, states, steps, strict=True)
    ]
    length = ca.fmin(1.0, STEP_SHARE / ca.fmax(-least(lowest), STEP_SHARE))
    return ca.Function(
        "newton_step",
        [state, barrier, *cell],
        ca.cse([state + length * ca.vertcat(*steps), barrier + length * (target - barrier)]),
    )


@lru_cache(PROGRAMS)
def _start(program: Program) -> ca.Function:
    """The program's start and the weight of its barriers there."""
    cell = [ca.SX.sym(name, size) for name, size in program.cell_sizes]
    states = program.start(cell)
    wrenches = [own[:WRENCH_SIZE] for own in states]
    degree = sum(patch.degree for patch in program.patches)
    weight = program.effort(wrenches, cell) / degree
    return ca.Function("start", cell, ca.cse([ca.vertcat(*states), weight]))


def _ends(program: Program) -> list[int]:
    return [0, *accumulate(patch.state_size for patch in program.patches)]
