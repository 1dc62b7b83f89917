"""The functions that the joint program of path and timing is put together from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from codegen.function import NumericFunction
from hybrid_opt.compiled_cell import CompiledCell
from symbolic.cell_model import CellModel
from symbolic.smooth.closure import closure_functions
from symbolic.smooth.driven import DRIVEN_FIRST, DRIVEN_SECOND, driven_functions
from symbolic.smooth.keys import ClosureKey, Order

ORDERS: tuple[Order, ...] = ("first", "second")

CLOSURE_LEVELS = {ClosureKey(arm, order).name: 1 for arm in (0, 1) for order in ORDERS}
"""Optimisation levels of the compiler: as for the rows at places of the same cell, whose libraries
then serve both."""


@dataclass(frozen=True)
class DrivenFunctions:
    """See `symbolic.smooth.driven` and `symbolic.smooth.closure`.

    Attributes:
        first, second: limited quantities at a driven point, their slopes and curvature.
        closures: how the joints follow the box.
    """

    first: NumericFunction
    second: NumericFunction
    closures: Mapping[ClosureKey, NumericFunction]


def driven_functions_of(compiled: CompiledCell) -> DrivenFunctions:
    """Load or build the functions of a cell, several points side by side.

    Raises:
        DualArmError: the cell's model cannot be built, or its functions not be compiled.
    """

    def make(model: CellModel) -> dict[str, ca.Function]:
        functions = driven_functions(model)
        for arm in (0, 1):
            functions |= {key.name: f for key, f in closure_functions(model, arm).items()}
        return functions

    built = compiled.functions("driven", make, str(CLOSURE_LEVELS), levels=CLOSURE_LEVELS, lanes=0)
    keys = [ClosureKey(arm, order) for arm in (0, 1) for order in ORDERS]
    return DrivenFunctions(
        built[DRIVEN_FIRST], built[DRIVEN_SECOND], {key: built[key.name] for key in keys}
    )
