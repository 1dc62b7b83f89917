"""Newton's equations of a program of contact patches, for the wrenches of all but the last one.

Each patch gives its stiffness and what pulls at its wrench (`symbolic.physics.patches`), the
program the effort and how the load is balanced (`symbolic.physics.central_path.Program`).
"""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING

import casadi as ca

from symbolic.physics.closure import WRENCH_SIZE
from symbolic.physics.elimination import Elimination

if TYPE_CHECKING:
    from symbolic.physics.central_path import Program


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
            local: of each patch its wrench (6,) and stiffness (6, 6).
        """
        wrenches = [wrench for wrench, _ in local]
        self.effort, self._slopes, curvatures = efforts(program, wrenches, cell)
        stiff = [curve + own for curve, (_, own) in zip(curvatures, local, strict=True)]
        symbols = wrench_symbols(len(local) - 1)
        passed = ca.vertcat(*symbols)
        self._change = ca.jacobian(program.left(symbols, cell), passed)
        self._missing = program.left(wrenches[:-1], cell) - wrenches[-1]
        self._last = stiff[-1]
        whole = ca.diagcat(*stiff[:-1]) + ca.mtimes([self._change.T, self._last, self._change])
        size = range(whole.shape[0])
        self._system = Elimination([[whole[i, j] for j in size] for i in size], len(size))

    def downhill(self, pulls: list[ca.SX], changes: list[ca.SX]) -> ca.SX:
        """How fast effort and barriers fall along changes: the decrement's square, times the
        weight."""
        terms = zip(pulls, self._slopes, changes, strict=True)
        return sum(ca.dot(pull - slope, change) for pull, slope, change in terms)

    def changes(self, pulls: list[ca.SX]) -> list[ca.SX]:
        """(6,) of every wrench, where the patches' multipliers pull so (6,)."""
        right = [pull - slope for pull, slope in zip(pulls, self._slopes, strict=True)]
        on_last = right[-1] - ca.mtimes(self._last, self._missing)
        pulled = ca.vertcat(*right[:-1]) + ca.mtimes(self._change.T, on_last)
        reduced = self._system.reduced(ca.vertsplit(pulled))
        free = ca.vertcat(*self._system.first(reduced, []))
        return [*ca.vertsplit(free, WRENCH_SIZE), self._missing + ca.mtimes(self._change, free)]


def efforts(
    program: Program, wrenches: list[ca.SX], cell: list[ca.SX]
) -> tuple[ca.SX, list[ca.SX], list[ca.SX]]:
    """The effort at wrenches, its slopes (6,) and curvatures (6, 6) by each of them."""
    symbols = wrench_symbols(len(wrenches))
    effort = program.effort(symbols, cell)
    slopes = [ca.gradient(effort, w) for w in symbols]
    curvatures = [ca.hessian(effort, w)[0] for w in symbols]
    passed = ca.Function("effort", [*symbols, *cell], [effort, *slopes, *curvatures])
    found, k = passed.call([*wrenches, *cell]), len(wrenches)
    return found[0], list(found[1 : k + 1]), list(found[k + 1 :])


def iterate_and_cell(program: Program) -> tuple[ca.SX, list[ca.SX]]:
    """An iterate and the cell."""
    cell = [ca.SX.sym(name, size) for name, size in program.cell_sizes]
    return ca.SX.sym("iterate", ends_of(program)[-1]), cell


def wrench_symbols(count: int) -> list[ca.SX]:
    """Symbols (6,) of so many wrenches."""
    return [ca.SX.sym(f"w_{i}", WRENCH_SIZE) for i in range(count)]


def degree_of(program: Program) -> float:
    """Pairing of all X with S over the weight on the central path."""
    return sum(patch.degree for patch in program.patches)


def ends_of(program: Program) -> list[int]:
    """Where in an iterate the patches' own ones begin, and its size."""
    return [0, *accumulate(patch.iterate_size for patch in program.patches)]
