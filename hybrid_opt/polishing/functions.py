"""The functions that a cell's smooth problems are assembled from, each found by a typed key."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import get_args

import casadi as ca
import numpy as np

from codegen.function import NumericFunction
from hybrid_opt.compiled_cell import CompiledCell
from symbolic.array import Array
from symbolic.cell_model import CellModel
from symbolic.errors import SettingsError
from symbolic.smooth.closure import closure_functions
from symbolic.smooth.joint_limit import JointLimit
from symbolic.smooth.keys import Block, ClosureKey, Order, Quantity, RowKey, SampleKey
from symbolic.smooth.passage import GAPS, Passing, Separation, gap_function
from symbolic.smooth.place import Place, PlaceConstraint, row_function
from symbolic.smooth.reach import Reach
from symbolic.smooth.samples import sample_functions

COMPILED = (
    Reach(0),
    Reach(1),
    Separation(0, 0),
    Passing(0, 0, 1),
    JointLimit(0, 0, "lower"),
    JointLimit(1, 0, "lower"),
)
"""Members of the families whose functions are compiled: they are in nearly every solve. Every
clearance of an arm is a family of its own, of which a solve needs a few: these are interpreted."""

ARMS = (0, 1)
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
BLOCKS: tuple[Block, ...] = get_args(Block)
ORDERS: tuple[Order, ...] = get_args(Order)

_LEVELS = {
    "pressure_inner_second": 1,
    "pressure_first_second": 0,
    "pressure_last_second": 0,
    "force_first_second": 0,
    "force_last_second": 0,
}
"""Optimisation levels of the compiler where size alone would choose too high a one: these are
straight-line code of half a megabyte and more, called once per iteration or seldom."""


_Prepared = tuple[list[Array], dict[str, Array], Callable[[], None], ca.FunctionBuffer]
"""Inputs and outputs, what fills the outputs, and the buffer that has to live as long."""


class Mapped:
    """A CasADi function of SX over n rows at once, by the interpreter.

    What a compiled function does in `batch`, for functions that are too many to compile.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._shapes = [function.size_in(k) for k in range(function.n_in())]
        self._prepared = lru_cache(maxsize=64)(self._prepare)

    def batch(self, *inputs: Array) -> dict[str, Array]:
        """The outputs by name, with a leading axis of rows, of inputs likewise."""
        given, results, evaluate, _ = self._prepared(len(inputs[0]))
        for array, value in zip(given, inputs, strict=True):
            array[...] = value
        evaluate()
        return {name: result.copy() for name, result in results.items()}

    def _prepare(self, n: int) -> _Prepared:
        function = self._function.map(n)
        buffer, evaluate = function.buffer()
        given = [np.zeros((n, rows) if rows > 1 else (n,)) for rows, _ in self._shapes]
        results = {}
        for k in range(function.n_out()):
            rows, columns = self._function.size_out(k)
            shape = (n, columns, rows) if columns > 1 else (n, rows) if rows > 1 else (n,)
            results[self._function.name_out(k)] = np.zeros(shape)
        for k, array in enumerate(given):
            buffer.set_arg(k, array.data)
        for k, array in enumerate(results.values()):
            buffer.set_res(k, array.data)
        return given, results, evaluate, buffer


RowFunction = NumericFunction | Mapped
"""Anything with `batch`."""


class RowFunctions:
    """The functions of rows at places; what was not compiled is built when first asked for."""

    def __init__(
        self,
        model: CellModel,
        compiled: Mapping[RowKey, NumericFunction],
        gaps: NumericFunction,
    ) -> None:
        self.model, self._compiled = model, compiled
        self._gaps, self._place = gaps, Place(model)
        self._interpreted: dict[RowKey, Mapped] = {}
        self.numbers = lru_cache(maxsize=None)(self._numbers)
        self.obstacle = lru_cache(maxsize=None)(self._place.obstacle)
        self.separable = frozenset(self._place.separable())

    def of(self, constraint: PlaceConstraint, order: Order) -> RowFunction:
        """See `symbolic.smooth.place.row_function`."""
        key = RowKey(constraint.family, order)
        if key in self._compiled:
            return self._compiled[key]
        if key not in self._interpreted:
            self._interpreted[key] = Mapped(row_function(self._place, constraint, order))
        return self._interpreted[key]

    def _numbers(self, constraint: PlaceConstraint) -> Array:
        """See `PlaceConstraint.numbers`."""
        return constraint.numbers(self._place)

    def gaps(self, pair: int, pose: Array) -> Array:
        """(n, DIRECTIONS) gaps [m] of a separable pair at box poses (n, 6)."""
        return self._gaps.batch(pose, self.obstacle(pair))["gaps"]


@dataclass(frozen=True)
class PolishFunctions:
    """What the smooth problems of a workcell are assembled from.

    Attributes:
        samples: forces and pressure, see `symbolic.smooth.samples`.
        closures: inverse kinematics of both arms, see `symbolic.smooth.closure`.
        rows: constraints at places of the path.
    """

    samples: Mapping[SampleKey, NumericFunction]
    closures: Mapping[ClosureKey, NumericFunction]
    rows: RowFunctions = field(repr=False)


def polish_functions(compiled: CompiledCell) -> PolishFunctions:
    """Load or build the functions of a workcell's smooth problem.

    Raises:
        SettingsError: the time law is 'optimal', which is no smooth function of the path.
        DualArmError: the cell's model cannot be built, or its functions not be compiled.
    """
    if compiled.workcell.task.time_law == "optimal":
        raise SettingsError(
            "the polish does not know the time law 'optimal'; search without it (--no-polish), or "
            "polish under 'constant' or 'ramped'"
        )

    def make(model: CellModel) -> dict[str, ca.Function]:
        place, functions = Place(model), dict[str, ca.Function]()
        for quantity in QUANTITIES:
            functions |= _named(sample_functions(model.workcell, quantity))
        for arm in ARMS:
            functions |= _named(closure_functions(model, arm))
        for constraint in COMPILED:
            for order in ORDERS:
                name = RowKey(constraint.family, order).name
                functions[name] = row_function(place, constraint, order)
        return functions | {GAPS: gap_function(place)}

    built = compiled.functions("polish", make, str(_LEVELS), levels=_LEVELS)
    sample_keys = [
        SampleKey(q, block, order) for q in QUANTITIES for block in BLOCKS for order in ORDERS
    ]
    closure_keys = [ClosureKey(arm, order) for arm in ARMS for order in ORDERS]
    row_keys = [RowKey(constraint.family, order) for constraint in COMPILED for order in ORDERS]
    return PolishFunctions(
        samples={key: built[key.name] for key in sample_keys if key.name in built},
        closures={key: built[key.name] for key in closure_keys},
        rows=RowFunctions(compiled.model, {key: built[key.name] for key in row_keys}, built[GAPS]),
    )


def _named(
    functions: Mapping[SampleKey, ca.Function] | Mapping[ClosureKey, ca.Function],
) -> dict[str, ca.Function]:
    return {key.name: function for key, function in functions.items()}
