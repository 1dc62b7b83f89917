"""Rows of a smooth program: what they are, and their values, slopes and weighted curvature.

A row stands at a sample or at a place of the path. Forces and pressure at samples are functions of
the decision vector; what stands at a place depends on the box pose there, on its rate, which are
linear in the decision vector, and on the joints that hold the box (`symbolic.smooth.places` has the
formulas). Functions of CasADi give values and derivatives of many samples or places at a call; here
the arrays that they work on are laid out, and `rows.c` calls them and puts rows together: what
NumPy does between them, in many small arrays, takes longer than the functions themselves.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from codegen.cache import Cache
from codegen.errors import CodegenError
from hybrid_opt.polishing.cell import Indices, PolishFunctions, SmoothCell
from hybrid_opt.polishing.native import Native, Records, native
from symbolic.array import Array
from symbolic.records.task import POSE_SIZE
from symbolic.smooth.places import PlaceConstraint
from symbolic.smooth.samples import WIDTHS, Quantity, held_name, sample_name

HELD = 5
"""Branch of a force row that is the joint allocation's, after the paper's five."""

ROUNDING = 1e-3
"""Share of a step's duration by which the paper's time law is rounded where rotation takes over
from translation: the least forces at the ends of a path lie in that kink."""


@dataclass(frozen=True, order=True)
class ForceRow:
    """One branch of `normal_force_branches` of one robot at a sample, or `HELD`, to stay below its
    peak."""

    robot: int
    branch: int
    sample: int


@dataclass(frozen=True, order=True)
class PressureRow:
    """Margin of a robot's shift of the centre of pressure within its patch at a sample."""

    robot: int
    sample: int


@dataclass(frozen=True)
class PlaceRow:
    """One constraint at one place of the path."""

    constraint: PlaceConstraint
    place: int


Row = ForceRow | PressureRow | PlaceRow


@cache
def _name(constraint: PlaceConstraint) -> str:
    return repr(constraint)


class Layout:
    """The blocks of rows of one program, in their order, each in an order of its own: forces, the
    sides of objectives, patches, places.

    Attributes:
        force_rows, pressure_rows, place_rows: the rows of each block.
        forces, sides, patches, places: where the blocks are.
        n_rows: all of them.
    """

    def __init__(self, rows: Iterable[Row], sides: int = 0) -> None:
        listed = list(rows)
        self.force_rows = sorted(row for row in listed if isinstance(row, ForceRow))
        self.pressure_rows = sorted(row for row in listed if isinstance(row, PressureRow))
        places = [row for row in listed if isinstance(row, PlaceRow)]
        self.place_rows = sorted(places, key=lambda row: (_name(row.constraint), row.place))
        self.forces = slice(0, len(self.force_rows))
        self.sides = slice(self.forces.stop, self.forces.stop + sides)
        self.patches = slice(self.sides.stop, self.sides.stop + len(self.pressure_rows))
        self.places = slice(self.patches.stop, self.patches.stop + len(places))
        self.n_rows = int(self.places.stop)


NEGLIGIBLE = 1e-7
"""Share of the largest weight below which second derivatives are left out: those of rows that are
far from ruling, whose multipliers vanish. It changes steps by as much, no solution."""

INPUTS = ("pose", "rate", "q_1", "q_2", "numbers", "weight")
"""Inputs of functions of rows at places, in their order in a record."""

_FORCES, _LOADS, _PRESSURE, _ARMS, _GROUPS = 1, 51, 101, 201, 301
"""As in `rows.c`: from where what has to be prepared is counted."""


class _SampleRows:
    """Some values of each of some samples, from the decision vector.

    Attributes:
        column: (n_samples,) position of a sample among the values, -1 where it has none.
        x: (n_var,) where they are evaluated.
        found, gradients: (count, width), (count, width, n_var) there.
        record: for C.
    """

    def __init__(
        self,
        cell: SmoothCell,
        quantity: Quantity,
        wanted: Collection[int],
        memory: Records,
        beyond: int = 0,
    ) -> None:
        """A program's samples.

        Args:
            wanted: samples without which a call is left out.
            beyond: samples whose values follow, which others find.
        """
        self._memory, self._quantity, self._functions = memory, quantity, cell.functions
        chosen = [
            block.samples[np.isin(block.samples, list(wanted)).any(axis=1)] for block in cell.blocks
        ]
        served = np.concatenate([samples.ravel() for samples in chosen])
        count, width, n_var = len(served) + beyond, WIDTHS[quantity], cell.task.n_var
        last = max(int(block.samples.max(initial=0)) for block in cell.blocks)
        self.column = np.full(1 + last, -1)
        self.column[served] = np.arange(len(served))
        self.x, self.found = np.zeros(n_var), np.zeros((count, width))
        self.gradients = np.zeros((count, width, n_var))
        self._names, records, start = list[str](), list[Any](), 0
        for block, samples in zip(cell.blocks, chosen, strict=True):
            if not len(samples):
                continue
            rows, n = slice(start, start + samples.size), len(samples)
            given = {
                "x": self.x,
                "values": self.found[rows].reshape(n, -1),
                "gradient": self.gradients[rows].reshape(n, -1, n_var),
            }
            first = cell.functions.built[sample_name(quantity, block.block, "first")]
            batch = first.prepared(n, ("x", "rounding"), given)
            basis = block.basis[np.isin(block.samples, samples).all(axis=1)]
            batch.inputs["basis"][...] = basis
            batch.inputs["rounding"][...] = ROUNDING
            records.append(
                memory.new(
                    "Block",
                    served=samples.shape[1],
                    n=n,
                    start=start,
                    window=basis[0].size,
                    first=memory.call(batch),
                    basis=basis,
                )
            )
            self._names.append(sample_name(quantity, block.block, "second"))
            start = rows.stop
        self._blocks = memory.array("Block", records)
        self.record = memory.new(
            "Samples",
            count=count,
            blocks=len(records),
            width=width,
            block=self._blocks,
            x=self.x,
            values=self.found,
            gradients=self.gradients,
            weight=np.empty((count, width)),
        )

    def prepare(self, k: int) -> None:
        """The second derivatives of a function along every direction of x: each of its samples is
        evaluated n_var times. Most programs need those of few."""
        block, n_var = self._blocks + k, len(self.x)
        second = self._functions.built[self._names[k]]
        batch = second.prepared(block.n * n_var, ("x", "rounding"))
        batch.inputs["rounding"][...] = ROUNDING
        batch.inputs["along"][...] = np.tile(np.eye(n_var), (block.n, 1))
        self._memory.fill(
            block,
            second=self._memory.call(batch),
            x=batch.inputs["x"],
            columns=batch.inputs["basis"],
            weight=batch.inputs["weight"],
            curvature=batch.outputs["curvature"],
        )


class Rows:
    """The rows of one program as functions of the decision vector x (n_var,), and of further
    variables on which they depend linearly. A resource of one thread.

    value_r = offset_r + fixed_r . tail + what the row asks for: mix_r . (the two values of its
    sample), what is left of a patch, or what a constraint is at its place, over its scale.

    Attributes:
        offset: (n_rows,) to be written.
    """

    def __init__(
        self,
        cell: SmoothCell,
        layout: Layout,
        q: tuple[Array, Array],
        mix: Array | None = None,
        fixed: Array | None = None,
    ) -> None:
        """Lay out all arrays.

        Args:
            q: both arms' joints at all places (m, n) near those that hold the box [rad].
            mix: (n_forces, 2) what each force row takes of its sample's values: F_n and F_t for
                the paper's branches, both normal forces for joint allocation.
            fixed: (n_rows, k) the columns of the further variables.

        Raises:
            DualArmError: a function cannot be built.
        """
        library, n_var = row_library(cell.evaluator.compiled.cache), cell.task.n_var
        self._cell, self._c, self._memory = cell, library.functions, Records(library)
        n_rows = layout.n_rows
        mix = np.zeros((0, 2)) if mix is None else mix
        fixed = np.zeros((n_rows, 0)) if fixed is None else fixed
        self._x, self._tail = np.empty(n_var), np.empty(fixed.shape[1])
        self.offset, self._values = np.zeros(n_rows), np.empty(n_rows)
        self._jacobian = np.hstack([np.zeros((n_rows, n_var)), fixed])
        self._points, self._multipliers = cell.still.copy(), np.empty(n_rows)
        self._curvature = np.empty((n_var, n_var))
        sampled = self._lay_out_samples(layout)
        self._program = self._memory.new(
            "Program",
            n_var=n_var,
            n_path=len(cell.free[0]),
            n_rows=n_rows,
            width=self._jacobian.shape[1],
            first_patch=layout.patches.start,
            first_place=layout.places.start,
            waypoints=len(cell.still),
            negligible=NEGLIGIBLE,
            **sampled,
            **self._lay_out_places(layout.place_rows, q),
            x=self._x,
            tail=self._tail,
            fixed=fixed,
            offset=self.offset,
            mix=mix,
            free_row=cell.free[0],
            free_column=cell.free[1],
            still=cell.still,
            points=self._points,
            values=self._values,
            jacobian=self._jacobian,
            curvature=self._curvature,
            multipliers=self._multipliers,
        )

    def _lay_out_samples(self, layout: Layout) -> dict[str, Any]:
        """Forces and pressure. Where forces are no branches, they come from what a sample's load
        asks of the pads (`symbolic.smooth.samples.held_functions`); derivatives by the decision
        vector follow by the chain rule, so that no load is solved for twice at a place."""
        cell, memory = self._cell, self._memory
        rows = layout.force_rows
        held = sorted({row.sample for row in rows if row.branch == HELD})
        split = {row.sample for row in rows if row.branch != HELD}
        forces = _SampleRows(cell, "force", split, memory, beyond=len(held))
        pressed = {row.sample for row in layout.pressure_rows}
        patches = _SampleRows(cell, "pressure", pressed, memory)
        self._sampled = {_FORCES: forces, _PRESSURE: patches}
        record = dict[str, Any]()
        column = forces.column
        by_load = np.full(len(column), -1)
        if held:
            start = len(forces.found) - len(held)
            by_load[held] = start + np.arange(len(held))
            loads = self._sampled[_LOADS] = _SampleRows(cell, "load", set(held), memory)
            record["held"] = self._lay_out_held(loads, held, forces.found[start:])
        self._column = np.array(
            [(by_load if row.branch == HELD else column)[row.sample] for row in rows], dtype=np.intp
        )
        self._pressed = np.array([row.robot for row in layout.pressure_rows], dtype=np.intp)
        sample = np.array([row.sample for row in layout.pressure_rows], dtype=np.intp)
        self._pressed_column = patches.column[sample]
        return {
            "forces": len(rows),
            "pressed": len(self._pressed),
            "samples": forces.record,
            "patches": patches.record,
            "force_column": self._column,
            "pressed_column": self._pressed_column,
            "pressed_robot": self._pressed,
            **record,
        }

    def _lay_out_held(self, loads: _SampleRows, held: list[int], normal: Array) -> Any:
        """Samples whose normal forces (n, 2) come from their loads."""
        memory, built, at = self._memory, self._cell.functions.built, loads.column[held]
        first = built[held_name("first")].prepared(len(held), given={"normal": normal})
        second = built[held_name("second")].prepared(len(held))
        return memory.new(
            "Held",
            count=len(held),
            start=len(self._sampled[_FORCES].found) - len(held),
            size=first.outputs["state"].shape[1],
            loads=loads.record,
            first=memory.call(first),
            second=memory.call(second),
            at=at,
            active=np.empty(len(held), dtype=np.intp),
            load=first.inputs["load"],
            slope=first.outputs["slope"],
            state=first.outputs["state"],
            states=second.inputs["state"],
            weight=second.inputs["weight"],
            curvature=second.outputs["curvature"],
        )

    def _lay_out_places(self, rows: Sequence[PlaceRow], q: tuple[Array, Array]) -> dict[str, Any]:
        """Inside, rows at places stand family by family; the joints of every place that needs them
        are solved once."""
        cell, memory = self._cell, self._memory
        members: dict[str, list[int]] = {}
        for k, row in enumerate(rows):
            members.setdefault(row.constraint.family, []).append(k)
        order = np.array([k for own in members.values() for k in own], dtype=np.intp)
        there = np.unique(np.array([row.place for row in rows], dtype=np.intp))
        at = np.searchsorted(there, np.array([rows[k].place for k in order], dtype=np.intp))
        n, (free_row, _) = len(rows), cell.free
        basis, rate_basis = cell.grid.basis[there], cell.grid.rate_basis[there]
        shared = {
            "pose": np.zeros((n, POSE_SIZE)),
            "rate": np.zeros((n, POSE_SIZE)),
            "q_1": np.zeros((n, q[0].shape[1])),
            "q_2": np.zeros((n, q[1].shape[1])),
            "value": np.zeros(n),
        }
        groups, start = [], 0
        needed: tuple[list[Indices], list[Indices]] = ([], [])
        self._families = list[PlaceConstraint]()
        for own in members.values():
            constraints, stop = [rows[k].constraint for k in own], start + len(own)
            group = self._lay_out_group(constraints, slice(start, stop), shared)
            for arm in constraints[0].arms(cell.functions.model):
                needed[arm].append(at[start:stop])
            groups.append(group)
            start = stop
        self._groups = memory.array("Group", groups)
        arms = []
        for arm, own_places in enumerate(needed):
            places = np.unique(np.concatenate([np.empty(0, dtype=np.intp), *own_places]))
            arms.append(self._lay_out_arm(arm, places, at, basis, q[arm][there]))
            memory.fill(arms[-1], rows=shared[f"q_{arm + 1}"])
        self._arms = memory.array("Arm", arms)
        scale = np.array([row.constraint.scale for row in rows], dtype=float)
        return {
            "n": n,
            "size": cell.task.extended_size,
            "groups": len(groups),
            "group": self._groups,
            "arm": self._arms,
            "order": order,
            "place": at,
            "scale": scale,
            "whole": basis[at],
            "whole_rate": rate_basis[at],
            "free": basis[:, free_row],
            "free_rate": rate_basis[:, free_row],
            **{name: shared[name] for name in ("pose", "rate", "value")},
        }

    def _lay_out_group(
        self, constraints: Sequence[PlaceConstraint], rows: slice, shared: dict[str, Array]
    ) -> Any:
        """Rows of one family; what second derivatives need is filled in when they are asked for:
        most rows never rule."""
        functions, one, memory = self._cell.functions, constraints[0], self._memory
        given = {name: array[rows] for name, array in shared.items()}
        first = functions.row(one, "first").prepared(len(constraints), given=given)
        if "numbers" in first.inputs:
            first.inputs["numbers"][...] = row_numbers(constraints, functions)[0]
        self._families.append(one)
        gradient = first.outputs["gradient"]
        record = memory.new(
            "Group",
            start=rows.start,
            stop=rows.stop,
            moving=one.moving,
            arms=sum(1 << arm for arm in one.arms(functions.model)),
            width=gradient.shape[1],
            first=memory.call(first),
            gradient=gradient,
        )
        for k, name in enumerate(INPUTS):
            if name in first.inputs:
                memory.point(record.given, k, first.inputs[name])
                record.sizes[k] = first.inputs[name][0].size
        return record

    def _lay_out_arm(self, arm: int, places: Indices, at: Indices, basis: Array, q: Array) -> Any:
        """An arm at the places where rows need it."""
        memory, position = self._memory, np.zeros(len(basis), dtype=np.intp)
        position[places] = np.arange(len(places))
        first = self._cell.functions.closure(arm, "first").prepared(max(1, len(places)))
        first.inputs["q_reference"][: len(places)] = q[places]
        found = first.outputs
        return memory.new(
            "Arm",
            places=len(places),
            joints=q.shape[1],
            first=memory.call(first),
            place=places,
            at=position[at],
            active=np.empty(len(places), dtype=np.intp),
            basis=basis[places],
            pose=first.inputs["pose"],
            q=found["q"],
            follow=found["follow"],
            pull=found["pull"],
            pulls=np.empty((len(places), q.shape[1])),
        )

    def values(self, x: Array, tail: Array | None = None) -> Array:
        """(n_rows,) at x and the further variables.

        Raises:
            CodegenError: a function failed.
        """
        self._x[...] = x
        if tail is not None:
            self._tail[...] = tail
        status = self._c.dual_arm_rows_values(self._program, 0)
        if status == self._c.UNWRAP:
            # Angles that go the long way.
            self._points[...] = self._cell.waypoints(x)
            status = self._c.dual_arm_rows_values(self._program, 1)
        self._require_done(status)
        return self._values.copy()

    def slopes(self) -> Array:
        """(n_rows, n_var + k) by all variables where the values were found last."""
        self._c.dual_arm_rows_slopes(self._program)
        return self._jacobian.copy()

    def curvature(self, multipliers: Array) -> Array:
        """(n_var, n_var) second derivatives of (n_rows,) multipliers . values by x where the slopes
        were found last; overwritten.

        Raises:
            CodegenError: a function failed.
        """
        self._multipliers[...] = multipliers
        while (status := self._c.dual_arm_rows_curvature(self._program)) > 0:
            self._prepare(status)
        self._require_done(status)
        return self._curvature

    @property
    def forces(self) -> Array:
        """(n_forces, 2) both values of each force row's sample where they were found last."""
        return self._sampled[_FORCES].found[self._column]

    @property
    def force_slopes(self) -> Array:
        """(n_forces, 2, n_var) of these by x; not of joint allocation's."""
        return self._sampled[_FORCES].gradients[self._column]

    @property
    def left(self) -> Array:
        """(n_patches,) what is left of the patches where it was found last."""
        return np.asarray(self._sampled[_PRESSURE].found[self._pressed_column, self._pressed])

    def correct(self, slope: Array, x: Array) -> None:
        """Add (n_forces, n_var) to the slopes of forces, and to values what that makes beside x."""
        self._memory.fill(self._program, lacking_slope=slope, x_0=x)

    def _prepare(self, which: int) -> None:
        """The second derivatives that are asked for the first time."""
        memory, functions = self._memory, self._cell.functions
        if which >= _GROUPS:
            group = self._groups + which - _GROUPS
            second = functions.row(self._families[which - _GROUPS], "second")
            batch = second.prepared(group.stop - group.start)
            for k, name in enumerate(INPUTS):
                if name in batch.inputs:
                    memory.point(group.inputs, k, batch.inputs[name])
            memory.fill(group, second=memory.call(batch), hessian=batch.outputs["hessian"])
        elif which >= _ARMS:
            arm = self._arms + which - _ARMS
            batch = functions.closure(which - _ARMS, "second").prepared(arm.places)
            memory.fill(
                arm,
                second=memory.call(batch),
                hessian=batch.outputs["hessian"],
                poses=batch.inputs["pose"],
                joint=batch.inputs["q"],
                nu=batch.inputs["nu"],
            )
        else:
            first = max(first for first in self._sampled if first <= which)
            self._sampled[first].prepare(which - first)

    def _require_done(self, status: int) -> None:
        if status != self._c.DONE:
            raise CodegenError("a function of the polish's rows failed")


def row_library(kept: Cache | None = None) -> Native:
    """`rows.c`, from a cache where it was built before.

    Raises:
        CodegenError: it cannot be compiled, cached or loaded.
    """
    return native("rows.c", kept)


def row_numbers(
    constraints: Sequence[PlaceConstraint], functions: PolishFunctions
) -> tuple[Array, ...]:
    """(rows, n) numbers of constraints of one family, in a tuple; an empty one without any."""
    numbers = np.array([functions.numbers(constraint) for constraint in constraints])
    return (numbers,) if numbers.shape[1] else ()
