"""Rows of a smooth program: the kinds of constraints that choose them; their values, slopes and
weighted curvature.

A row belongs to a sample or to a point of the path. Forces and pressure at samples are functions of
the decision vector; rows at a point depend on the box pose and its rate there, which are linear in
the decision vector, and on the joints that hold the box (`symbolic.smooth.path_points` has the
formulas). CasADi functions give values and derivatives of many samples or points per call. Here
their arrays are laid out; `rows.cpp` calls the functions and assembles the rows: in NumPy, with
many small arrays, the assembly takes longer than the functions themselves.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction, PreparedBatch
from hybrid_opt.polishing.cell import PlacedCarry, SmoothCell
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.solvers.base import native
from symbolic.array import Array
from symbolic.records.task import POSE_SIZE
from symbolic.smooth.path_points import ORDERS, PathConstraint
from symbolic.smooth.samples import QUANTITY_WIDTHS, Quantity, grasp_force_name, sample_name

PATCH_MARGIN = 1e-6
"""Margin to the rim of a patch, in the square of shift over radius."""

PROGRAM_BRANCH = 5
"""Number of the branch of a force row if a convex program computes the force; the paper's five
branches have the numbers 0 to 4."""

TIME_LAW_ROUNDING = 1e-3
"""Share of a step's duration by which the paper's time law is rounded where rotation takes over
from translation: the least forces at the ends of a path are in that kink."""


@dataclass(frozen=True, order=True)
class ForceRow:
    """The inequality that keeps a robot's normal force at a sample below its peak force.

    Attributes:
        robot: index of the robot.
        branch: index of one of the linear functions whose maximum is the normal force;
            `PROGRAM_BRANCH` if a convex program computes the force.
        sample: index of the sample.
    """

    robot: int
    branch: int
    sample: int


@dataclass(frozen=True, order=True)
class PressureRow:
    """The inequality that keeps a robot's centre of pressure within its patch at a sample.

    Attributes:
        robot: index of the robot.
        sample: index of the sample.
    """

    robot: int
    sample: int


@dataclass(frozen=True)
class PathRow:
    """The inequality of one geometric constraint at one point of the path.

    Attributes:
        constraint: the constraint.
        point: index of the point.
    """

    constraint: PathConstraint
    point: int


Row = ForceRow | PressureRow | PathRow


@cache
def _sort_key(constraint: PathConstraint) -> tuple[str, str]:
    """Return the sort key of a constraint: its kind, then the text of its fields."""
    return constraint.family.rstrip("_0123456789"), repr(constraint)


class RowLayout:
    """Order of a program's rows (scalar inequalities): blocks of forces, objectives, patches and
    points, each sorted.

    Attributes:
        force_rows, pressure_rows, point_rows: rows of the blocks of forces, patches and points.
        forces, sides, patches, points: position of each block among all rows, as a slice; `sides`
            is the block of objectives.
        n_rows: number of all rows.
    """

    def __init__(self, rows: Iterable[Row], sides: int = 0) -> None:
        listed = list(rows)
        self.force_rows = sorted(row for row in listed if isinstance(row, ForceRow))
        self.pressure_rows = sorted(row for row in listed if isinstance(row, PressureRow))
        points = [row for row in listed if isinstance(row, PathRow)]
        self.point_rows = sorted(points, key=lambda row: (_sort_key(row.constraint), row.point))
        self.forces = slice(0, len(self.force_rows))
        self.sides = slice(self.forces.stop, self.forces.stop + sides)
        self.patches = slice(self.sides.stop, self.sides.stop + len(self.pressure_rows))
        self.points = slice(self.patches.stop, self.patches.stop + len(points))
        self.n_rows = int(self.points.stop)


class _SampleRows:
    """Values of a quantity at samples, as functions of the decision vector.

    Attributes:
        column: (n_samples,) position of each sample among the values, -1 if it is not evaluated.
        found, gradients: (count, width) values and (count, width, n_var) gradients of the last
            evaluation, for `count` evaluated samples and `width` numbers per sample.
        given: arguments for `rows.cpp`.
    """

    def __init__(
        self, cell: SmoothCell, quantity: Quantity, wanted: Collection[int], beyond: int = 0
    ) -> None:
        """Allocate the arrays of a quantity at the samples that an optimisation step needs.

        Args:
            cell: shared data of the polish.
            quantity: name of the quantity: force, pressure or load.
            wanted: indices of the needed samples. A function that serves several samples is called
                if any of them is needed.
            beyond: number of rows that are appended to the arrays `found` and `gradients`, for
                values that a convex program computes.
        """
        built = cell.functions.built
        chosen = [
            block.samples[np.isin(block.samples, list(wanted)).any(axis=1)] for block in cell.blocks
        ]
        served = np.concatenate([samples.ravel() for samples in chosen])
        count, width, n_var = len(served) + beyond, QUANTITY_WIDTHS[quantity], cell.task.n_var
        last = max(int(block.samples.max(initial=0)) for block in cell.blocks)
        self.column = np.full(1 + last, -1)
        self.column[served] = np.arange(len(served))
        x, self.found = np.zeros(n_var), np.zeros((count, width))
        self.gradients = np.zeros((count, width, n_var))
        blocks, start = list[dict[str, Any]](), 0
        for block, samples in zip(cell.blocks, chosen, strict=True):
            if not len(samples):
                continue
            rows, n = slice(start, start + samples.size), len(samples)
            given = {
                "x": x,
                "values": self.found[rows].reshape(n, -1),
                "gradient": self.gradients[rows].reshape(n, -1, n_var),
            }
            orders = (built[sample_name(quantity, block.block, order)] for order in ORDERS)
            function, second = orders
            first = function.prepared(n, ("x", "rounding"), given)
            basis = block.basis[np.isin(block.samples, samples).all(axis=1)]
            first.inputs["basis"][...] = basis
            first.inputs["rounding"][...] = TIME_LAW_ROUNDING
            along = partial(_all_directions, second, n, n_var)
            blocks.append(
                {"start": start, "served": samples.shape[1], "basis": basis}
                | {"first": first, "second": along}
            )
            start = rows.stop
        self.given = {"x": x, "values": self.found, "gradients": self.gradients, "blocks": blocks}


def _all_directions(second: NumericFunction, n: int, n_var: int) -> PreparedBatch:
    """Prepare a call that computes second derivatives at n samples: a function of one direction of
    x is evaluated for all `n_var` directions.

    Args:
        second: function that evaluates second derivatives along one direction.
        n: number of samples; each takes `n_var` evaluations.
        n_var: number of decision variables.
    """
    batch = second.prepared(n * n_var, ("x", "rounding"))
    batch.inputs["rounding"][...] = TIME_LAW_ROUNDING
    batch.inputs["along"][...] = np.tile(np.eye(n_var), (n, 1))
    return batch


class ConstraintRows:
    """Values of a program's rows (scalar inequalities), and their derivatives by x (n_var,) and by
    k further variables, the tail.

    The value of row r is offset_r + fixed_r . tail + own_r(x). For a force row own_r is mix_r times
    the two force quantities of its sample; for a pressure row the unused share of the patch; for a
    point row the constraint over its scale. Use an object in one thread only.

    Attributes:
        offset: (n_rows,) offsets, to be set by the caller.
    """

    def __init__(
        self,
        cell: SmoothCell,
        layout: RowLayout,
        q: tuple[Array, Array],
        mix: Array | None = None,
        fixed: Array | None = None,
    ) -> None:
        """Prepare the functions and arrays of all rows.

        Args:
            cell: shared data of the polish.
            layout: order of the rows.
            q: joint positions of each arm, (m, n) for m points and n joints [rad]. They are close
                to the positions that hold the box.
            mix: (n_forces, 2) two coefficients of each force row; None without force rows. With the
                paper's contact model they multiply the normal and the tangential part of the
                required force. If a convex program computes the forces, they multiply both normal
                forces.
            fixed: (n_rows, k) coefficients of the k further variables; None for k = 0.

        Raises:
            DualArmError: a function cannot be built.
        """
        self._cell, self.offset = cell, np.zeros(layout.n_rows)
        self._native = native().Rows(
            mix=np.zeros((0, 2)) if mix is None else mix,
            fixed=np.zeros((layout.n_rows, 0)) if fixed is None else fixed,
            **self._lay_out_samples(layout),
            **self._lay_out_points(layout, q),
        )

    def _lay_out_samples(self, layout: RowLayout) -> dict[str, Any]:
        """Build the arguments of the C++ class `Rows` (rows.cpp) that describe force and pressure
        rows.

        Forces without closed form follow by a convex program
        (`symbolic.smooth.samples.grasp_force_functions`) from the force and moment that the box
        needs at a sample. The convex program is solved once per sample. Derivatives follow by the
        chain rule.

        Args:
            layout: order of the rows.

        Returns:
            Arguments by the names that rows.cpp gives them.
        """
        cell, rows = self._cell, layout.force_rows
        own = sorted({row.sample for row in rows if row.branch == PROGRAM_BRANCH})
        split = {row.sample for row in rows if row.branch != PROGRAM_BRANCH}
        self._forces = _SampleRows(cell, "force", split, beyond=len(own))
        pressed = {row.sample for row in layout.pressure_rows}
        self._patches = _SampleRows(cell, "pressure", pressed)
        by_load, held = np.full(len(self._forces.column), -1), None
        if own:
            start = len(self._forces.found) - len(own)
            by_load[own] = start + np.arange(len(own))
            loads = _SampleRows(cell, "load", set(own))
            function, second = (cell.functions.built[grasp_force_name(order)] for order in ORDERS)
            held = {
                "start": start,
                "at": loads.column[own],
                "loads": loads.given,
                "first": function.prepared(len(own), given={"normal": self._forces.found[start:]}),
                "second": partial(second.prepared, len(own)),
            }
        columns = (
            (by_load if row.branch == PROGRAM_BRANCH else self._forces.column) for row in rows
        )
        self._column = np.array(
            [column[row.sample] for column, row in zip(columns, rows, strict=True)], dtype=np.intp
        )
        robot, sample = (
            np.array([getattr(row, name) for row in layout.pressure_rows], dtype=np.intp)
            for name in ("robot", "sample")
        )
        self._pressed = 2 * self._patches.column[sample] + robot
        return {
            "samples": self._forces.given,
            "patches": self._patches.given,
            "held": held,
            "column": self._column,
            "pressed": self._pressed,
            "first_patch": layout.patches.start,
        }

    def _lay_out_points(self, layout: RowLayout, q: tuple[Array, Array]) -> dict[str, Any]:
        """Build the arguments of the C++ class `Rows` (rows.cpp) that describe the rows at points
        of the path.

        Rows with the same compiled function form a group. Joint positions are solved for once per
        point, also if several rows need them.

        Args:
            layout: order of the rows.
            q: joint positions of each arm, (m, n) for m points and n joints [rad]. They are close
                to the positions that hold the box.

        Returns:
            Arguments by the names that rows.cpp gives them.
        """
        cell, rows = self._cell, layout.point_rows
        members: dict[NumericFunction, list[int]] = {}
        for k, row in enumerate(rows):
            members.setdefault(cell.functions.row(row.constraint, "first"), []).append(k)
        order = np.array([k for own in members.values() for k in own], dtype=np.intp)
        there = np.unique(np.array([row.point for row in rows], dtype=np.intp))
        at = np.searchsorted(there, np.array([rows[k].point for k in order], dtype=np.intp))
        n, (free_row, free_column) = len(rows), cell.free
        basis, rate_basis = cell.grid.basis[there], cell.grid.rate_basis[there]
        shared = {
            "pose": np.zeros((n, POSE_SIZE)),
            "rate": np.zeros((n, POSE_SIZE)),
            "q_1": np.zeros((n, q[0].shape[1])),
            "q_2": np.zeros((n, q[1].shape[1])),
            "value": np.zeros(n),
        }
        groups, start = list[dict[str, Any]](), 0
        needed: tuple[list[NDArray[np.intp]], list[NDArray[np.intp]]] = ([at[:0]], [at[:0]])
        for own in members.values():
            stop = start + len(own)
            given = {name: array[start:stop] for name, array in shared.items()}
            group = self._lay_out_group([rows[k].constraint for k in own], given)
            for arm in group["arms"]:
                needed[arm].append(at[start:stop])
            groups.append({"start": start, **group})
            start = stop
        arms = []
        for arm, own_points in enumerate(needed):
            points = np.unique(np.concatenate(own_points))
            position = np.zeros(len(there), dtype=np.intp)
            position[points] = np.arange(len(points))
            function, second = (cell.functions.closure(arm, order) for order in ORDERS)
            first = function.prepared(max(1, len(points)))
            first.inputs["q_reference"][: len(points)] = q[arm][there[points]]
            arms.append(
                {
                    "place": points,
                    "at": position[at],
                    "basis": basis[points],
                    "rows": shared[f"q_{arm + 1}"],
                    "first": first,
                    "second": partial(second.prepared, len(points)),
                }
            )
        scale = np.array([row.constraint.scale for row in rows], dtype=float)
        return {
            "size": cell.task.extended_size,
            "groups": groups,
            "arms": arms,
            "order": layout.points.start + order,
            "place": at,
            "scale": scale[order],
            "whole": basis[at],
            "whole_rate": rate_basis[at],
            "free": basis[:, free_row],
            "free_rate": rate_basis[:, free_row],
            "free_column": free_column,
            **{name: shared[name] for name in ("pose", "rate", "value")},
        }

    def _lay_out_group(
        self, constraints: Sequence[PathConstraint], given: dict[str, Array]
    ) -> dict[str, Any]:
        functions, one = self._cell.functions, constraints[0]
        first = functions.row(one, "first").prepared(len(constraints), given=given)
        if "numbers" in first.inputs:
            first.inputs["numbers"][...] = row_numbers(constraints, functions)[0]
        return {
            "moving": one.moving,
            "arms": np.array(functions.arms(one), dtype=np.intp),
            "first": first,
            # Not even compiled before: most rows never rule.
            "second": lambda: functions.row(one, "second").prepared(len(constraints)),
        }

    def values(self, x: Array, tail: Array | None = None) -> Array:
        """Compute the values (n_rows,) of all rows.

        Args:
            x: (n_var,) decision vector.
            tail: (k,) further variables; None for k = 0.

        Raises:
            CodegenError: a function failed.
        """
        further = np.empty(0) if tail is None else tail
        found = self._native.values(x, further, self._cell.waypoints(x))
        return np.asarray(self.offset + found)

    def slopes(self) -> Array:
        """Return the derivatives (n_rows, n_var + k) of all rows by x and the k further variables,
        at the x for which `values` was called last.
        """
        return np.asarray(self._native.slopes())

    def curvature(self, multipliers: Array) -> Array:
        """Compute the Hessian (n_var, n_var) by x of multipliers . values.

        It belongs to the x at which `slopes` was called last.

        Args:
            multipliers: (n_rows,) weights of the rows.

        Raises:
            CodegenError: a function failed.
        """
        return np.asarray(self._native.curvature(multipliers))

    @property
    def forces(self) -> Array:
        """The two force quantities (n_forces, 2) [N] of each force row, at the last evaluated x.
        They are the normal and the tangential part of the required force or, if a convex program
        computes the forces, both normal forces.
        """
        return self._forces.found[self._column]

    @property
    def force_slopes(self) -> Array:
        """The derivatives (n_forces, 2, n_var) of `forces` by x; undefined if a convex program
        computes the forces.
        """
        return self._forces.gradients[self._column]

    @property
    def left(self) -> Array:
        """The unused share (n_patches,) of the patch for each pressure row, at the last evaluated
        x: one less the square of the pressure shift over the patch radius.
        """
        return self._patches.found.ravel()[self._pressed]

    def correct_forces(self, slope: Array, x: Array) -> None:
        """Add a linear function slope_r . (x' - x) of the decision vector x' to each force row r.

        Args:
            slope: (n_forces, n_var) slopes of the function.
            x: (n_var,) decision vector at which the function is zero.
        """
        self._native.correct(slope, x)


def row_numbers(
    constraints: Sequence[PathConstraint], functions: PolishFunctions
) -> tuple[Array, ...]:
    """Collect the parameters of constraints that share one compiled function.

    Args:
        constraints: the constraints.
        functions: compiled functions of the polish.

    Returns:
        A tuple with one array (n constraints, n parameters); an empty tuple if the constraints have
        no parameters.
    """
    numbers = np.array([functions.numbers(constraint) for constraint in constraints])
    return (numbers,) if numbers.shape[1] else ()


# --- kinds of constraints ---


MinimisedForces = tuple[bool, bool]
"""For each robot, True if its force is minimised, False if it is only used to break ties."""

AnyRow = TypeVar("AnyRow", ForceRow, PressureRow, PathRow)


class ConstraintKind(ABC, Generic[AnyRow]):
    """One kind of constraint: selects its rows (scalar inequalities) near a candidate, and sets
    their bounds.

    Attributes:
        cell: shared data of the polish of a workcell.
        grid: points along the path.
        persists: True if tightened bounds stay valid at other candidates. If False, they are
            relative to the candidate at which they were measured.
    """

    persists: bool = False

    def __init__(self, cell: SmoothCell) -> None:
        self.cell, self.grid = cell, cell.grid

    @abstractmethod
    def near_rows(self, carry: PlacedCarry, limits: MinimisedForces) -> Iterable[AnyRow]:
        """Return the rows (scalar inequalities) of this kind that are near their bounds at a
        candidate.

        Args:
            carry: the candidate, evaluated at points of the path.
            limits: for each robot, True if its normal force is minimised.
        """

    @abstractmethod
    def violated_rows(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[AnyRow]:
        """Return the rows (scalar inequalities) of this kind that are violated after a step.

        Args:
            carry: candidate after the step.
            known: candidate before the step.
        """

    def required_values(
        self, carry: PlacedCarry, rows: Sequence[AnyRow], is_relaxed: bool = False
    ) -> list[float]:
        """Return the value that each row (scalar inequality) has to exceed in the optimisation
        problem of a step.

        Args:
            carry: the candidate from which the step starts, evaluated at points of the path.
            rows: the rows.
            is_relaxed: True to require no larger distance between bodies than the candidate has.
        """
        return [PATCH_MARGIN] * len(rows)

    def tightened_bounds(
        self, carry: PlacedCarry, known: PlacedCarry, rows: Sequence[AnyRow], before: list[float]
    ) -> list[float]:
        """Return the new, stricter bound of each row (scalar inequality) that a step violated.

        Args:
            carry: candidate after the step.
            known: candidate before the step.
            rows: the violated rows.
            before: bound of each row in the last quadratic program, 0 for a row that was not in it.
        """
        return self.required_values(carry, rows)


def smooth_values(cell: SmoothCell, carry: PlacedCarry, rows: Sequence[PathRow]) -> Array:
    """Compute the values of rows (scalar inequalities) by the smooth model at a candidate.

    Args:
        cell: shared data of the polish.
        carry: the candidate, evaluated at points of the path.
        rows: n rows at points that both arms reach.

    Returns:
        (n,) values in the units of their constraints [m, rad or none].
    """
    values = np.empty(len(rows))
    functions, groups = cell.functions, dict[NumericFunction, list[int]]()
    for k, row in enumerate(rows):
        groups.setdefault(functions.row(row.constraint, "first"), []).append(k)
    for function, members in groups.items():
        at = [rows[k].point for k in members]
        inputs = [array[at] for array in (carry.pose, carry.rate, *carry.q)]
        inputs += row_numbers([rows[k].constraint for k in members], functions)
        values[members] = function.batch(*inputs)["value"]
    return values
