"""The compiled functions of a polish: loaded or built once per cell, and on first use."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial

import casadi as ca

from codegen.function import NumericFunction
from hybrid_opt.compiled_cell import CompiledCell
from symbolic.array import Array
from symbolic.cell_model import CellBodies, CellModel
from symbolic.contact.registry import contact_model
from symbolic.limit_coefficients import TIMING_BARRIER_WEIGHT
from symbolic.records.cell import Workcell
from symbolic.smooth.driven import driven_functions
from symbolic.smooth.passage import GAPS, AxisSwitchGap, SeparatingAxisGap, gap_function
from symbolic.smooth.path_points import (
    ORDERS,
    JointLimit,
    ManipulabilityLimit,
    Order,
    PathConstraint,
    PathPointSymbols,
    closure_functions,
    closure_name,
    row_function,
    row_name,
)
from symbolic.smooth.samples import (
    Quantity,
    grasp_force_functions,
    grasp_force_name,
    sample_functions,
)

PRECOMPILED = (
    ManipulabilityLimit(0),
    ManipulabilityLimit(1),
    SeparatingAxisGap(0, 0),
    AxisSwitchGap(0, 0, 1),
    JointLimit(0, 0, "lower"),
    JointLimit(1, 0, "lower"),
)
"""One member of each family of constraints whose functions are made at once, because nearly
every solve needs them. Each clearance is a family of its own; a cell has hundreds and a solve needs
few, so their functions are made on first use and cached."""

ARMS = (0, 1)


class PolishFunctions:
    """Compiled functions for the polish of one workcell.

    Attributes:
        built: the functions by name, described in `symbolic.smooth`: forces and pressure at
            samples, inverse kinematics of both arms, in drivable cells (carries are timed from rest
            to rest within all limits) limits along a driven path, and constraints at points of the
            path. Functions for other constraints are added on first use.
        closure: `closure(arm, order)` returns the function from the box pose to the joint positions
            of an arm, with first or second derivatives, see `symbolic.smooth.path_points`.
        row: `row(constraint, order)` returns the function of a constraint at a point, with first or
            second derivatives, see `symbolic.smooth.path_points.row_function`.
        numbers: `numbers(constraint)` returns the constraint's parameters (n,).
        arms: `arms(constraint)` returns the indices of the arms on whose joints the constraint
            depends.
        model: arms and bodies of the cell.
        separable: indices of the pairs of the payload and an obstacle that is a single box, for
            which the function `GAPS` computes gaps.
        obstacle: `obstacle(pair)` returns the parameters of the obstacle of such a pair, the last
            input of the function `GAPS`.
    """

    def __init__(self, compiled: CompiledCell, built: Mapping[str, NumericFunction]) -> None:
        self.model, self.built, self._cell = compiled.bodies, dict(built), compiled
        self._point, self._symbols = PathPointSymbols(self.model), cache(PathPointSymbols)
        # Every iteration asks for all of its rows.
        self.row, self.closure = cache(self._row), cache(self._closure)
        self.numbers, self.arms = cache(self._numbers), cache(self._arms)
        self.obstacle = cache(self._point.obstacle)
        self.separable = frozenset(self._point.separable())

    def _closure(self, arm: int, order: Order) -> NumericFunction:
        return self.built[closure_name(arm, order)]

    def _row(self, constraint: PathConstraint, order: Order) -> NumericFunction:
        name = row_name(constraint.family, order)
        if name not in self.built:

            def make(model: CellBodies) -> dict[str, ca.Function]:
                return {name: row_function(self._symbols(model), constraint, order)}

            self.built |= self._cell.functions(f"polish {name}", make, lanes=0, taped=True)
        return self.built[name]

    def _numbers(self, constraint: PathConstraint) -> Array:
        return constraint.numbers(self._point)

    def _arms(self, constraint: PathConstraint) -> tuple[int, ...]:
        return constraint.arms(self.model)


def sample_quantities(workcell: Workcell) -> tuple[Quantity, ...]:
    """Return the names of the quantities that the polish of a cell evaluates at the samples of a
    carry.

    - 'force': normal forces.
    - 'pressure': shift of the centre of pressure, if it is limited.
    - 'load': force and moment that the box needs. Pads whose forces have no closed form have it in
      place of the others; a convex program computes their forces from it.

    Drivable cells, whose carries are timed from rest to rest within all limits, have none: their
    limits apply at the intervals of the timing.

    Args:
        workcell: the cell.
    """
    if workcell.task.law.is_drivable:
        return ()
    model = contact_model(workcell)
    if model.has_closed_form:
        return ("force", "pressure") if model.has_pressure_limit else ("force",)
    return ("load",)


def polish_functions(compiled: CompiledCell) -> PolishFunctions:
    """Load the compiled functions for the polish of a workcell, or build them.

    Functions of many samples or points per call are compiled for evaluation in lanes (several
    evaluations by one vector instruction) at optimisation level 1. Higher levels take three times
    as long to compile, without faster functions: in a measurement all run times changed by less
    than 5 %, except one, which rose by 40 %. For the first and the last two samples, only second
    derivatives are evaluated in lanes. Functions of whole paths multiply sparse matrices and have
    no form for lanes.

    Raises:
        DualArmError: the cell's model cannot be built, or its functions cannot be compiled.
    """
    quantities = sample_quantities(compiled.workcell)
    ends = {f"{q}_{block}_first" for q in quantities for block in ("first", "last", "path")}
    levels = dict.fromkeys(sorted(_names(quantities) - ends), 1)
    wide = levels.keys() - {f"{q}_path_second" for q in quantities}

    @cache
    def samples(model: CellModel) -> dict[str, ca.Function]:
        found = [sample_functions(model.workcell, quantity) for quantity in quantities]
        found += [closure_functions(model, arm) for arm in ARMS]
        return {name: function for functions in found for name, function in functions.items()}

    def lane_functions(model: CellModel) -> dict[str, ca.Function]:
        return {name: f for name, f in samples(model).items() if name in wide}

    def scalar_functions(model: CellModel) -> dict[str, ca.Function]:
        return {name: f for name, f in samples(model).items() if name not in wide}

    def rows(model: CellModel) -> dict[str, ca.Function]:
        point = PathPointSymbols(model)
        found = {
            row_name(constraint.family, order): row_function(point, constraint, order)
            for constraint in PRECOMPILED
            for order in ORDERS
        }
        return found | {GAPS: gap_function(point)}

    details = str(levels)
    taped = partial(compiled.functions, levels=levels, lanes=0, taped=True)
    built = taped("polish in lanes", lane_functions, details, bodies=False)
    built |= compiled.functions("polish", scalar_functions, details, levels=levels, bodies=False)
    built |= taped("polish rows", rows, details)
    if "load" in quantities:
        built |= taped("held", _held, bodies=False)
    if compiled.workcell.task.law.is_drivable:
        built |= taped("driven", driven_functions, bodies=False)
        if not contact_model(compiled.workcell).has_closed_form:
            built |= taped("driven held", _driven_held, bodies=False)
    return PolishFunctions(compiled, built)


def _held(model: CellModel) -> dict[str, ca.Function]:
    return grasp_force_functions(model.workcell)


def _driven_held(model: CellModel) -> dict[str, ca.Function]:
    """Build the functions that compute the forces of pads without closed form by a convex program.

    The weight of the program's logarithmic barrier is that of the timing, so that polish and timing
    compute equal forces.

    Args:
        model: arms and bodies of the cell.

    Returns:
        CasADi functions by name.
    """
    return grasp_force_functions(model.workcell, TIMING_BARRIER_WEIGHT)


def _names(quantities: tuple[Quantity, ...]) -> set[str]:
    """Return the names of all functions that `polish_functions` builds.

    Args:
        quantities: what is evaluated at samples: 'force', 'pressure' or 'load', as far as the cell
            needs it.
    """
    blocks = ("inner", "first", "last", "path")
    return {
        GAPS,
        *(f"{q}_{block}_{order}" for q in quantities for block in blocks for order in ORDERS),
        *(grasp_force_name(order) for order in ORDERS),
        *(closure_name(arm, order) for arm in ARMS for order in ORDERS),
        *(row_name(constraint.family, order) for constraint in PRECOMPILED for order in ORDERS),
    }
