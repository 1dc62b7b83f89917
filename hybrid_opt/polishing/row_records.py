"""What `rows.c`, `row_curvatures.c` and `held.c` read, as records of ctypes."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.function import PreparedBatch
from hybrid_opt.polishing.force_values import HeldValues
from hybrid_opt.polishing.place_groups import RowGroup
from symbolic.array import Array

INPUTS = ("pose", "rate", "q_1", "q_2", "numbers", "weight")
"""Of functions of rows at places, in their order in a record."""


def _integers(*names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_longlong) for name in names]


def _pointers(*names: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_void_p) for name in names]


class CallRecord(ctypes.Structure):
    """A function on prepared arrays."""

    _fields_ = _pointers("one", "lanes", "ports", "work", "lane_work")


class BlockRecord(ctypes.Structure):
    """Samples that one function gives."""

    _fields_ = (
        *_integers("served", "n", "start", "window"),
        *_pointers("basis"),
        ("first", CallRecord),
        ("second", CallRecord),
        *_pointers("x", "columns", "weight", "curvature"),
    )


class SamplesRecord(ctypes.Structure):
    """All samples of one quantity."""

    _fields_ = (
        *_integers("count", "blocks", "width"),
        *_pointers("block", "x", "values", "gradients", "weight"),
    )


class HeldRecord(ctypes.Structure):
    """Samples whose forces are allocated jointly."""

    _fields_ = (
        *_integers("count", "start", "size"),
        *_pointers("at", "loads"),
        ("first", CallRecord),
        ("second", CallRecord),
        *_pointers("load", "slope", "state", "states", "weight", "curvature", "active"),
    )


class GroupRecord(ctypes.Structure):
    """Rows of one family at places."""

    _fields_ = (
        *_integers("start", "stop", "moving", "arms", "width"),
        ("first", CallRecord),
        ("second", CallRecord),
        *_pointers("gradient"),
        ("given", ctypes.c_void_p * len(INPUTS)),
        ("inputs", ctypes.c_void_p * len(INPUTS)),
        ("sizes", ctypes.c_longlong * len(INPUTS)),
        *_pointers("hessian"),
    )


class ArmRecord(ctypes.Structure):
    """An arm where rows need it."""

    _fields_ = (
        *_integers("places", "joints"),
        *_pointers("place", "at", "basis"),
        ("first", CallRecord),
        ("second", CallRecord),
        *_pointers("pose", "q", "follow", "pull", "rows", "pulls", "active"),
        *_pointers("poses", "joint", "nu", "hessian"),
    )


class ProgramRecord(ctypes.Structure):
    """A program's rows."""

    _fields_ = (
        *_integers("n_var", "n_path", "n_rows", "forces", "pressed", "first_patch"),
        *_integers("n", "first_place", "waypoints", "size", "groups"),
        *_pointers("z", "centre", "half", "fixed", "offset"),
        *_pointers("force_column", "pressed_column", "pressed_robot"),
        *_pointers("mix", "lacking_slope", "x_0", "samples", "patches", "held"),
        *_pointers("order", "place", "scale"),
        *_pointers("free_row", "free_column", "whole", "whole_rate", "free", "free_rate", "still"),
        *_pointers("group", "arm", "pose", "rate", "value", "points", "x"),
        *_pointers("values", "jacobian", "curvature", "multipliers"),
        ("negligible", ctypes.c_double),
    )


class Memory:
    """Addresses of arrays, which it keeps alive."""

    def __init__(self) -> None:
        self._kept: list[object] = []

    def of(self, array: NDArray[Any] | ctypes.Array[Any]) -> int:
        """Of an array that C reads or writes where it is."""
        self._kept.append(array)
        return ctypes.addressof(array) if isinstance(array, ctypes.Array) else array.ctypes.data

    def reals(self, **arrays: Array | None) -> dict[str, int | None]:
        """Of numbers; of those that are not contiguous, copies."""
        return {
            name: None if array is None else self.of(np.ascontiguousarray(array, dtype=float))
            for name, array in arrays.items()
        }

    def indices(self, **arrays: NDArray[np.intp]) -> dict[str, int]:
        """Of indices, likewise."""
        return {
            name: self.of(np.ascontiguousarray(array, dtype=np.int64))
            for name, array in arrays.items()
        }


def call_of(batch: PreparedBatch) -> CallRecord:
    """How C evaluates a batch of a compiled function."""
    native = batch.native
    assert native is not None, "interpreted functions have no address"
    return CallRecord(native.one, native.lanes, native.ports, native.work, native.lane_work)


def held_record(held: HeldValues, loads: int, memory: Memory) -> HeldRecord:
    """loads: address of the loads' record."""
    first, second = held.first, held.second
    return HeldRecord(
        count=len(held.at),
        start=held.start,
        size=first.outputs["state"].shape[1],
        loads=loads,
        first=call_of(first),
        second=call_of(second),
        **memory.reals(
            load=first.inputs["load"],
            slope=first.outputs["slope"],
            state=first.outputs["state"],
            states=second.inputs["state"],
            weight=second.inputs["weight"],
            curvature=second.outputs["curvature"],
        ),
        **memory.indices(at=held.at, active=np.empty(len(held.at), dtype=np.intp)),
    )


def group_record(group: RowGroup, memory: Memory) -> GroupRecord:
    """Of rows of one family; what second derivatives need is filled in when they are asked for."""
    gradient, inputs = group.first.outputs["gradient"], group.first.inputs
    record = GroupRecord(
        start=group.rows.start,
        stop=group.rows.stop,
        moving=group.moving,
        arms=sum(1 << arm for arm in group.arms),
        width=gradient.shape[1],
        first=call_of(group.first),
        **memory.reals(gradient=gradient),
    )
    for k, name in enumerate(INPUTS):
        if name in inputs:
            record.given[k] = memory.of(inputs[name])
            record.sizes[k] = inputs[name][0].size
    return record
