"""Shared data of a cell's programs: compiled functions, points of the path, scaled variables."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import ROBUST_OBJECTIVES
from hybrid_opt.polishing.robust import RobustSamples
from symbolic.array import Array
from symbolic.cell_model import CellBodies, CellModel
from symbolic.contact.registry import contact_model
from symbolic.limit_coefficients import TIMING_BARRIER_WEIGHT
from symbolic.path.spline import extended_waypoints, path_basis
from symbolic.records.cell import Workcell
from symbolic.records.task import POSE_SIZE, Task
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
    sample_blocks,
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

POINT_SPACING = 0.0025
"""Approximate distance of neighbouring points in the path parameter. The clearance covers minima
between two points, and the final certification checks them."""

Indices = NDArray[np.intp]


class PolishFunctions:
    """Compiled functions for the polish of one workcell.

    Attributes:
        built: the functions by name, described in `symbolic.smooth`: forces and pressure at
            samples, inverse kinematics of both arms, in drivable cells limits along a driven path,
            and constraints at points of the path. Functions for other constraints are added on
            first use.
        closure: `closure(arm, order)` returns the function from the box pose to the joint positions
            of an arm, with first or second derivatives, see `symbolic.smooth.path_points`.
        row: `row(constraint, order)` returns the function of a constraint at a point, with first or
            second derivatives, see `symbolic.smooth.path_points.row_function`.
        numbers: `numbers(constraint)` returns the constraint's parameters (n,).
        arms: `arms(constraint)` returns the indices of the arms on whose joints the constraint
            depends.
        model: arms and bodies of the cell.
        separable: indices of the pairs of the payload and an obstacle that is a single box, for
            which `gaps` computes gaps.
    """

    def __init__(self, compiled: CompiledCell, built: Mapping[str, NumericFunction]) -> None:
        self.model, self.built, self._cell = compiled.bodies, dict(built), compiled
        self._point, self._symbols = PathPointSymbols(self.model), cache(PathPointSymbols)
        # Every iteration asks for all of its rows.
        self.row, self.closure = cache(self._row), cache(self._closure)
        self.numbers, self.arms = cache(self._numbers), cache(self._arms)
        self._obstacle = cache(self._point.obstacle)
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

    def gaps(self, pair: int, pose: Array) -> Array:
        """Compute the gaps between the payload and an obstacle box along several directions.

        A gap is the distance between the projections of both bodies onto the direction, negative if
        the projections overlap. The largest gap is a lower bound of the distance of the bodies.

        Args:
            pair: index of the pair of payload and obstacle, one of `separable`.
            pose: (n, 6) box poses [m, rad].

        Returns:
            (n, SEPARATING_DIRECTIONS) gaps [m].
        """
        return self.built[GAPS].batch(pose, self._obstacle(pair))["gaps"]


def sample_quantities(workcell: Workcell) -> tuple[Quantity, ...]:
    """Return what the polish of a cell evaluates at the samples of a carry, by name.

    The names are 'force' (normal forces) and, if it is limited, 'pressure' (shift of the centre of
    pressure). Pads whose forces have no closed form have 'load' instead: the force and moment that
    the box needs, from which a convex program computes the forces. Drivable cells have none,
    because their limits apply at the intervals of the timing.

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
    as long to compile and gain nothing (measured on the rack: every function within 5 %, one slower
    by 40 %). For the first and the last two samples, only second derivatives are evaluated in
    lanes. Functions of whole paths multiply sparse matrices and have no form for lanes.

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
    """Build the functions that compute the pads' forces by a convex program.

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


class Grid:
    """Points along a task's path: the task's samples, and equally many points between neighbours.

    Attributes:
        per_sample: number of points per interval between samples.
        parameter: (m,) path parameter of all points, in [0, 1].
        sample_parameter: (n,) path parameter of the samples.
        basis: (m, n_waypoints) matrix B: the poses at the points are B W for waypoints W, both box
            poses with redundant joints.
        rate_basis: (m, n_waypoints) like B, for the poses' first derivatives by the path parameter.
    """

    def __init__(self, task: Task) -> None:
        intervals = task.samples - 1
        self.per_sample = max(1, round(1.0 / (intervals * POINT_SPACING)))
        self.sample_parameter = np.linspace(0.0, 1.0, task.samples)
        self.parameter = np.linspace(0.0, 1.0, intervals * self.per_sample + 1)
        along = path_basis(len(task.waypoints), self.parameter)
        self.basis, self.rate_basis = along.position, along.first

    def points(self, width: float) -> int:
        """Convert a width in the path parameter to a number of intervals between points, at least
        one.
        """
        return max(1, round(width * (len(self.parameter) - 1)))

    def samples(self, width: float) -> int:
        """Convert a width in the path parameter to a number of intervals between samples, at least
        one.
        """
        return max(1, round(width * (len(self.sample_parameter) - 1)))

    def between(self, values: Array) -> Array:
        """Interpolate values at the n samples linearly to all m points.

        Args:
            values: (n, k) k values at each sample.

        Returns:
            (m, k) values at the points.
        """
        return np.column_stack(
            [np.interp(self.parameter, self.sample_parameter, column) for column in values.T]
        )

    def movable(self, point: int) -> bool:
        """Return True if a point, given by its index, is neither the first nor the last of the
        path, which are fixed.
        """
        return 0 < point < len(self.parameter) - 1


class SmoothCell:
    """Data that all programs of a cell's polish share.

    Attributes:
        evaluator: evaluator of candidates by the full model.
        functions: compiled functions of the polish.
        workcell, task: the evaluator's workcell and its task.
        grid: points along the task's path.
        clearance: distance that bodies keep beyond the collision tolerance [m].
        robust: computes robust forces at samples if these are minimised; None for planned forces.
        centre, half: (n_var,) middle and half range of each decision variable [m, rad, N]. Scaled
            variables xi in [-1, 1] follow from x = centre + half * xi; half is 1 for a fixed
            variable.
        free: row and column indices of the decision variables among the waypoints (n_waypoints, 6 +
            m), box poses with m redundant joints.
        blocks: groups of samples that one compiled function evaluates.
        coefficients: (2, branches, 2) coefficients of the linear functions of both
            `force_quantities` whose maximum is the normal force of each contact.
        has_pressure_limit: whether the contact model limits the shift of the pressure.
    """

    def __init__(
        self, evaluator: CandidateEvaluator, functions: PolishFunctions, clearance: float
    ) -> None:
        """Derive from a cell's task the half ranges and centre of the variables, the grid of points
        and the blocks of samples.

        Args:
            evaluator: evaluator of candidates by the full model.
            functions: compiled functions of the polish.
            clearance: distance that bodies keep beyond the collision tolerance [m].

        Raises:
            SettingsError: robust forces are to be minimised, but do not exist for the cell's pads.
        """
        self.evaluator, self.functions, self.clearance = evaluator, functions, clearance
        self.workcell, self.task = evaluator.workcell, evaluator.workcell.task
        is_robust = evaluator.objective_names == ROBUST_OBJECTIVES
        self.robust = RobustSamples(self.workcell) if is_robust else None
        self.grid = Grid(self.task)
        half = (self.task.upper - self.task.lower) / 2.0
        self.centre = (self.task.upper + self.task.lower) / 2.0
        self.half = np.where(half > 0.0, half, 1.0)
        self.blocks = sample_blocks(self.task)
        model = contact_model(self.workcell)
        self.coefficients = model.force_branches
        self.has_pressure_limit = model.has_pressure_limit
        self.free = self.task.free_entries
        self._n_path, self._fixed = self.task.n_path, self.task.fixed_waypoints

    def scaled(self, x: Array) -> Array:
        """Scale a decision vector x (n_var,) to variables xi (n_var,), in [-1, 1] within the
        bounds."""
        return (x - self.centre) / self.half

    def unscaled(self, xi: Array) -> Array:
        """Return the decision vector x (n_var,) of scaled variables xi (n_var,)."""
        return self.centre + self.half * xi

    def step(self, start: Array, end: Array) -> float:
        """Return the largest change of any scaled variable between two decision vectors.

        Args:
            start: (n_var,) decision vector.
            end: (n_var,) another decision vector.
        """
        return float(np.max(np.abs(end - start) / self.half))

    def waypoints(self, x: Array) -> Array:
        """Return the waypoints of a decision vector.

        They equal those of `extended_waypoints`, which is called only if an angle changes by more
        than pi between two waypoints; otherwise this method is faster.

        Args:
            x: (n_var,) decision vector.

        Returns:
            (n_waypoints, 6 + m) box poses [m, rad] followed by m redundant joints.
        """
        points = self._fixed.copy()
        points[self.free] = x[: self._n_path]
        turns = points[1:, 3:POSE_SIZE] - points[:-1, 3:POSE_SIZE]
        return extended_waypoints(self.task, x) if np.abs(turns).max() > np.pi else points
