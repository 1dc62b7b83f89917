"""The rows of a smooth program in C: `rows.c`, `row_curvatures.c` and `held.c`.

What NumPy does between the functions of CasADi, in many small arrays, takes longer than the
functions themselves. Here C calls them, on the arrays that were prepared for them.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache as remembered
from pathlib import Path

import numpy as np

from codegen.build import c_text, load_or_build_library
from codegen.cache import Cache
from codegen.errors import CodegenError
from hybrid_opt.polishing.decision import UnitBox
from hybrid_opt.polishing.force_values import ForceValues
from hybrid_opt.polishing.place_groups import ArmRows, Indices
from hybrid_opt.polishing.place_values import PlaceValues
from hybrid_opt.polishing.row_records import (
    INPUTS,
    ArmRecord,
    BlockRecord,
    GroupRecord,
    Memory,
    ProgramRecord,
    SamplesRecord,
    call_of,
    group_record,
    held_record,
)
from hybrid_opt.polishing.sample_values import NEGLIGIBLE, SampleValues
from symbolic.array import Array

_DONE, _UNWRAP = 0, -2
_FORCES, _LOADS, _PRESSURE, _ARMS, _GROUPS = 1, 51, 101, 201, 301
"""As in `row_curvatures.c`: from where what has to be prepared is counted."""


@dataclass(frozen=True)
class RowParts:
    """What a program's rows are put together from; see `hybrid_opt.polishing.program`.

    Attributes:
        unit: scales the decision vector.
        fixed: (n_rows, n_var + 3) the Jacobian's constant columns.
        offset: (n_rows,) of the values.
        first_patch, first_place: first rows of the pressure and at places.
        forces, patches, places: what is evaluated.
        mix: (n_forces, 2) what force rows take of `forces`.
        pressed_column, pressed: (n_patches,) likewise of `patches`: column and robot.
        scale: (n_places,).
        slope: (n_forces, n_var) what is added to slopes of forces, and x (n_var,) where nothing is
            added to values for it; None without.
        still, free: waypoints (n_waypoints, 6 + m) without variables, and these's rows and columns.
    """

    unit: UnitBox
    fixed: Array
    offset: Array
    first_patch: int
    first_place: int
    forces: ForceValues
    patches: SampleValues
    places: PlaceValues
    mix: Array
    pressed_column: Indices
    pressed: Indices
    scale: Array
    slope: tuple[Array, Array] | None
    still: Array
    free: tuple[Indices, Indices]


Binder = Callable[[RowParts], "CompiledRows | None"]
"""From a program's parts to its rows in C; None where a function is interpreted."""


def row_binder(cache: Cache | None = None) -> Binder:
    """What puts programs' rows together in C.

    Args:
        cache: where the library is kept; by default the user's.

    Raises:
        CodegenError: there is no C compiler; or it cannot be compiled, cached or loaded.
    """
    return _binder((cache or Cache()).folder)


@remembered
def _binder(folder: Path) -> Binder:
    text = c_text("hybrid_opt.polishing", ["rows.c", "row_curvatures.c", "held.c"])
    library = load_or_build_library("rows", text, Cache(folder))
    values, curvature = library.dual_arm_rows_values, library.dual_arm_rows_curvature
    values.argtypes = [ctypes.c_void_p, ctypes.c_longlong]
    curvature.argtypes = library.dual_arm_rows_slopes.argtypes = [ctypes.c_void_p]
    values.restype = curvature.restype = ctypes.c_longlong
    library.dual_arm_rows_slopes.restype = None

    def bind(parts: RowParts) -> CompiledRows | None:
        sampled = *parts.forces.parts, parts.patches
        batches = [call.first for part in sampled for call in part.calls]
        batches += [group.first for group in parts.places.groups]
        batches += [arm.first for arm in parts.places.arms]
        return None if any(b.native is None for b in batches) else CompiledRows(library, parts)

    return bind


class CompiledRows:
    """One program's rows. A resource of one thread."""

    def __init__(self, library: ctypes.CDLL, parts: RowParts) -> None:
        self._parts, self._memory = parts, Memory()
        self._values_at = library.dual_arm_rows_values
        self._slopes, self._curvature_at = (
            library.dual_arm_rows_slopes,
            library.dual_arm_rows_curvature,
        )
        places, n_var = parts.places, len(parts.unit.half)
        n_rows, width = parts.fixed.shape
        self._values, self._jacobian = np.empty(n_rows), np.empty((n_rows, width))
        self._points = parts.still.copy()
        self._z, self._multipliers = np.empty(width), np.empty(n_rows)
        self._curvature = np.empty((n_var, n_var))
        self._blocks = list[ctypes.Array[BlockRecord]]()
        self._sampled = (parts.forces.split, parts.patches, *parts.forces.parts[1:])
        self._samples = [self._of_samples(part) for part in self._sampled]
        held = parts.forces.held
        loads = ctypes.addressof(self._samples[-1])
        self._held = None if held is None else held_record(held, loads, self._memory)
        groups = [group_record(group, self._memory) for group in places.groups]
        self._groups = (GroupRecord * len(groups))(*groups)
        self._arms = (ArmRecord * 2)(*map(self._of_arm, places.arms, ("q_1", "q_2")))
        slope, x_0 = parts.slope or (None, None)
        self._program = ProgramRecord(
            n_var=n_var,
            n_path=len(parts.free[0]),
            n_rows=n_rows,
            forces=len(parts.mix),
            pressed=len(parts.pressed),
            first_patch=parts.first_patch,
            n=len(places.order),
            first_place=parts.first_place,
            waypoints=len(parts.still),
            size=places.size,
            groups=len(places.groups),
            samples=ctypes.addressof(self._samples[0]),
            patches=ctypes.addressof(self._samples[1]),
            held=None if self._held is None else ctypes.addressof(self._held),
            group=ctypes.addressof(self._groups),
            arm=ctypes.addressof(self._arms),
            negligible=NEGLIGIBLE,
            **self._memory.reals(
                z=self._z,
                centre=parts.unit.centre,
                half=parts.unit.half,
                fixed=parts.fixed,
                offset=parts.offset,
                mix=parts.mix,
                lacking_slope=slope,
                x_0=x_0,
                scale=parts.scale,
                whole=places.whole[0],
                whole_rate=places.whole[1],
                free=places.by_variable[0],
                free_rate=places.by_variable[1],
                still=parts.still,
                **{name: places.shared[name] for name in ("pose", "rate", "value")},
                points=self._points,
                x=np.empty(n_var),
                values=self._values,
                jacobian=self._jacobian,
                curvature=self._curvature,
                multipliers=self._multipliers,
            ),
            **self._memory.indices(
                force_column=parts.forces.column,
                pressed_column=parts.pressed_column,
                pressed_robot=parts.pressed,
                order=places.order,
                place=places.at,
                free_row=parts.free[0],
                free_column=parts.free[1],
            ),
        )
        self._address = ctypes.addressof(self._program)

    def evaluate(self, z: Array, unwrapped: Callable[[Array], Array]) -> Array:
        """(n_rows,) the values at z (n_var + 3,).

        Args:
            unwrapped: gives the waypoints of a decision vector whose angles go the long way.

        Raises:
            CodegenError: a function failed.
        """
        self._z[...] = z
        status = self._values_at(self._address, 0)
        if status == _UNWRAP:
            self._points[...] = unwrapped(self._parts.unit.unscaled(z[: len(self._curvature)]))
            status = self._values_at(self._address, 1)
        _require_done(status)
        return self._values.copy()

    def slopes(self) -> Array:
        """(n_rows, n_var + 3) the Jacobian where the values were found last."""
        self._slopes(self._address)
        return self._jacobian.copy()

    def curvature(self, multipliers: Array) -> Array:
        """(n_var, n_var) second derivatives by the decision vector where the slopes were found
        last; overwritten.

        Raises:
            CodegenError: a function failed.
        """
        self._multipliers[...] = multipliers
        while (status := self._curvature_at(self._address)) > 0:
            self._prepare(status)
        _require_done(status)
        return self._curvature

    def _prepare(self, which: int) -> None:
        """The second derivatives that are asked for the first time."""
        places = self._parts.places
        if which >= _GROUPS:
            group, record = places.groups[which - _GROUPS], self._groups[which - _GROUPS]
            record.second = call_of(group.second)
            inputs = group.second.inputs
            for k, name in enumerate(INPUTS):
                if name in inputs:
                    record.inputs[k] = self._memory.of(inputs[name])
            record.hessian = self._memory.of(group.second.outputs["hessian"])
        elif which >= _ARMS:
            arm, held = places.arms[which - _ARMS], self._arms[which - _ARMS]
            held.second = call_of(arm.second)
            held.poses, held.joint, held.nu = (
                self._memory.of(arm.second.inputs[name]) for name in ("pose", "q", "nu")
            )
            held.hessian = self._memory.of(arm.second.outputs["hessian"])
        else:
            firsts = (_FORCES, _PRESSURE, _LOADS)
            of = 0 if which < _LOADS else 2 if which < _PRESSURE else 1
            samples, k = self._sampled[of], which - firsts[of]
            columns, block = samples.columns_of(k, len(samples.x)), self._blocks[of][k]
            block.second, batch = call_of(columns.batch), columns.batch
            block.x, block.columns, block.weight, block.curvature = map(
                self._memory.of,
                (batch.inputs["x"], columns.basis, columns.weight, columns.curvature),
            )

    def _of_samples(self, samples: SampleValues) -> SamplesRecord:
        blocks = (BlockRecord * len(samples.calls))(
            *(
                BlockRecord(
                    served=call.served,
                    n=len(call.basis),
                    start=start,
                    window=call.basis[0].size,
                    first=call_of(call.first),
                    **self._memory.reals(basis=call.basis),
                )
                for call, start in zip(samples.calls, samples.starts, strict=False)
            )
        )
        self._blocks.append(blocks)
        return SamplesRecord(
            count=samples.count,
            blocks=len(blocks),
            width=samples.width,
            block=self._memory.of(blocks),
            **self._memory.reals(
                x=samples.x,
                values=samples.found,
                gradients=samples.gradients,
                weight=np.empty((samples.count, samples.width)),
            ),
        )

    def _of_arm(self, arm: ArmRows, joints_of: str) -> ArmRecord:
        found = arm.first.outputs
        n_places, joints = len(arm.places), found["q"].shape[1]
        return ArmRecord(
            places=n_places,
            joints=joints,
            first=call_of(arm.first),
            **self._memory.reals(
                basis=arm.basis,
                pose=arm.first.inputs["pose"],
                q=found["q"],
                follow=found["follow"],
                pull=found["pull"],
                rows=self._parts.places.shared[joints_of],
                pulls=np.empty((n_places, joints)),
            ),
            **self._memory.indices(
                place=arm.places, at=arm.at, active=np.empty(n_places, dtype=np.intp)
            ),
        )


def _require_done(status: int) -> None:
    if status != _DONE:
        raise CodegenError("a function of the polish's rows failed")
