"""The functions that a cell's smooth problems are assembled from, each found by a typed key."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import get_args

import casadi as ca

from codegen.function import NumericFunction
from codegen.interpreted import InterpretedFunction
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.polishing.drivable.functions import DrivenFunctions, driven_functions_of
from symbolic.array import Array
from symbolic.cell_model import CellBodies, CellModel
from symbolic.records import Workcell
from symbolic.smooth.closure import closure_functions
from symbolic.smooth.held import held_functions
from symbolic.smooth.joint_limit import JointLimit
from symbolic.smooth.keys import (
    Block,
    ClosureKey,
    HeldKey,
    Order,
    Quantity,
    RowKey,
    SampleKey,
)
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
"""Members of the families whose functions are compiled at once: nearly every solve has them. Every
clearance of an arm is a family of its own, of which a cell has hundreds and a solve needs a few:
these are compiled when a solve first asks for them, and kept."""

ARMS = (0, 1)
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
BLOCKS: tuple[Block, ...] = get_args(Block)
ORDERS: tuple[Order, ...] = get_args(Order)

_LANE_LEVELS = dict.fromkeys(
    [
        *(SampleKey(quantity, "inner", "first").name for quantity in QUANTITIES),
        *(SampleKey(quantity, block, "second").name for quantity in QUANTITIES for block in BLOCKS),
        *(HeldKey(order).name for order in ORDERS),
        *(ClosureKey(arm, order).name for arm in ARMS for order in ORDERS),
        *(RowKey(constraint.family, order).name for constraint in COMPILED for order in ORDERS),
        GAPS,
    ],
    1,
)
"""What is evaluated in lanes, because it serves many samples or places at a call, and its level:
higher ones compile three times as long and gain nothing (measured on the rack: every function
within 5 %, one slower by 40 %)."""


_LATER_LEVELS: dict[Order, int] = {"first": 1, "second": 0}
"""The same of what is compiled when it is asked for: 0.1 and 0.2 s each on the rack. Few second
derivatives of clearances are ever needed."""


class RowFunctions:
    """The functions of rows at places; what is not known is built when first asked for."""

    def __init__(
        self,
        model: CellBodies,
        known: Mapping[RowKey, NumericFunction],
        gaps: NumericFunction,
        compiled: CompiledCell | None = None,
    ) -> None:
        """compiled: what compiles others and keeps them; None interprets them."""
        self.model, self._known = model, dict(known)
        self._gaps, self._place, self._cell = gaps, Place(model), compiled
        self.numbers = lru_cache(maxsize=None)(self._numbers)
        self.obstacle = lru_cache(maxsize=None)(self._place.obstacle)
        self.separable = frozenset(self._place.separable())

    def of(self, constraint: PlaceConstraint, order: Order) -> NumericFunction:
        """See `symbolic.smooth.place.row_function`."""
        key = RowKey(constraint.family, order)
        if key not in self._known:
            self._known[key] = self._built(key, constraint)
        return self._known[key]

    def _built(self, key: RowKey, constraint: PlaceConstraint) -> NumericFunction:
        def make() -> dict[str, ca.Function]:
            return {key.name: row_function(self._place, constraint, key.order)}

        if self._cell is None:
            return InterpretedFunction(make()[key.name])
        level = _LATER_LEVELS[key.order]
        name, levels = f"polish {key.name}", {key.name: level}
        return self._cell.made(name, make, str(level), levels=levels)[key.name]

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
        held: forces that are allocated jointly, see `symbolic.smooth.held`; else none.
        closures: inverse kinematics of both arms, see `symbolic.smooth.closure`.
        rows: constraints at places of the path.
        driven: limits along a driven path, only under the time law 'optimal'.
    """

    samples: Mapping[SampleKey, NumericFunction]
    closures: Mapping[ClosureKey, NumericFunction]
    rows: RowFunctions = field(repr=False)
    held: Mapping[HeldKey, NumericFunction] = field(default_factory=dict)
    driven: DrivenFunctions | None = None


def quantities_of(workcell: Workcell) -> tuple[Quantity, ...]:
    """What a cell's programs ask at samples. What is driven has limits at the intervals of its
    timing, not at samples; pads that press jointly keep their pressure, and where they do not face
    one another nothing is in closed form."""
    if workcell.task.time_law == "optimal":
        return ()
    if workcell.task.allocation == "paper":
        return "force", "pressure"
    return ("force", "load") if workcell.has_facing_pads else ("load",)


def polish_functions(compiled: CompiledCell) -> PolishFunctions:
    """Load or build the functions of a workcell's smooth problem.

    Raises:
        DualArmError: the cell's model cannot be built, or its functions not be compiled.
    """
    driven = compiled.workcell.task.time_law == "optimal"
    quantities = quantities_of(compiled.workcell)

    @cache
    def make() -> dict[str, ca.Function]:
        model = compiled.model
        place, functions = Place(model), dict[str, ca.Function]()
        for quantity in quantities:
            functions |= _named(sample_functions(model.workcell, quantity))
        if "load" in quantities:
            functions |= _named(held_functions(model.workcell))
        for arm in ARMS:
            functions |= _named(closure_functions(model, arm))
        for constraint in COMPILED:
            for order in ORDERS:
                name = RowKey(constraint.family, order).name
                functions[name] = row_function(place, constraint, order)
        return functions | {GAPS: gap_function(place)}

    def in_lanes(_: CellModel) -> dict[str, ca.Function]:
        return {name: f for name, f in make().items() if name in _LANE_LEVELS}

    def one_by_one(_: CellModel) -> dict[str, ca.Function]:
        return {name: f for name, f in make().items() if name not in _LANE_LEVELS}

    details, levels = str(_LANE_LEVELS), _LANE_LEVELS
    built = compiled.functions("polish in lanes", in_lanes, details, levels=levels, lanes=0)
    built |= compiled.functions("polish", one_by_one, details)
    sample_keys = [
        SampleKey(q, block, order) for q in QUANTITIES for block in BLOCKS for order in ORDERS
    ]
    closure_keys = [ClosureKey(arm, order) for arm in ARMS for order in ORDERS]
    row_keys = [RowKey(constraint.family, order) for constraint in COMPILED for order in ORDERS]
    return PolishFunctions(
        samples={key: built[key.name] for key in sample_keys if key.name in built},
        held={key: built[key.name] for key in map(HeldKey, ORDERS) if key.name in built},
        closures={key: built[key.name] for key in closure_keys},
        rows=RowFunctions(
            compiled.bodies, {key: built[key.name] for key in row_keys}, built[GAPS], compiled
        ),
        driven=driven_functions_of(compiled) if driven else None,
    )


def _named(
    functions: Mapping[SampleKey, ca.Function]
    | Mapping[ClosureKey, ca.Function]
    | Mapping[HeldKey, ca.Function],
) -> dict[str, ca.Function]:
    return {key.name: function for key, function in functions.items()}
