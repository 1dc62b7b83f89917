"""Values at chosen samples, with exact derivatives, by batches over the samples."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction, PreparedBatch
from symbolic.array import Array
from symbolic.smooth.keys import Order, Quantity, SampleKey
from symbolic.smooth.samples import SampleBlock

NEGLIGIBLE = 1e-7
"""Share of the largest weight below which second derivatives are left out: those of rows that are
far from ruling, whose multipliers vanish. It changes steps by as much, no solution."""


SHARED = ["x", "rounding"]
"""Inputs that all samples have in common."""


@dataclass(frozen=True)
class _Call:
    """One function over some of its samples.

    Attributes:
        first: both values of each sample, with gradients.
        second: the function of second derivatives, of one direction each.
        basis: (calls, ., .) the samples' windows.
        served: samples that each call serves.
    """

    first: PreparedBatch
    second: NumericFunction
    basis: Array
    served: int


@dataclass(frozen=True)
class _Columns:
    """The second derivatives of one function along every direction of x: each of its samples is
    evaluated n_var times.

    Attributes:
        batch: the evaluations, sample by sample.
        basis, weight: (calls, n_var, ...) its inputs.
        curvature: (calls, n_var, n_var) its output.
    """

    batch: PreparedBatch
    basis: Array
    weight: Array
    curvature: Array


class SampleValues:
    """Two values of each of some samples, from the decision vector.

    Attributes:
        column: (n_samples,) position of a sample among the values, -1 where it has none.
        count: of samples with values.
    """

    def __init__(
        self,
        quantity: Quantity,
        blocks: tuple[SampleBlock, ...],
        functions: Mapping[SampleKey, NumericFunction],
        wanted: Collection[int],
        rounding: float,
    ) -> None:
        """A program's samples.

        Args:
            wanted: samples without which a call is left out.
            rounding: of the time law's kinks, see `symbolic.smooth.samples.sample_functions`.
        """
        self._calls: list[_Call] = []
        self._rounding, self._columns = rounding, dict[int, _Columns]()
        order: list[NDArray[np.int64]] = [np.empty(0, dtype=np.int64)]
        for block in blocks:
            chosen = np.isin(block.samples, list(wanted)).any(axis=1)
            if not chosen.any():
                continue
            order.append(block.samples[chosen].ravel())
            basis = block.basis[chosen]
            first, second = (
                functions[SampleKey(quantity, block.block, o)] for o in get_args(Order)
            )
            batch = first.prepared(len(basis), SHARED)
            batch.inputs["basis"][...] = basis
            batch.inputs["rounding"][...] = rounding
            self._calls.append(_Call(batch, second, basis, block.samples.shape[1]))
        served = np.concatenate(order)
        self.count = len(served)
        self.column = np.full(1 + max(int(block.samples.max(initial=0)) for block in blocks), -1)
        self.column[served] = np.arange(len(served))

    def first(self, x: Array) -> tuple[Array, Array]:
        """Values (count, 2) and their gradients (count, 2, n_var)."""
        return self.values(x), self.gradients(len(x))

    def values(self, x: Array) -> Array:
        """(count, 2) at x."""
        values = [np.empty((0, 2))]
        for call in self._calls:
            call.first.inputs["x"][...] = x
            values.append(call.first()["values"].reshape(-1, 2))
        return np.concatenate(values)

    def gradients(self, n: int) -> Array:
        """(count, 2, n) where `values` was called last."""
        outputs = [call.first.outputs["gradient"].reshape(-1, 2, n) for call in self._calls]
        return np.concatenate([np.empty((0, 2, n)), *outputs])

    def second(self, x: Array, weight: Array) -> Array:
        """(n_var, n_var) second derivatives of the values weighted by (count, 2)."""
        total, start = np.zeros((len(x), len(x))), 0
        least = NEGLIGIBLE * np.abs(weight).max(initial=0.0)
        for k, call in enumerate(self._calls):
            n = len(call.basis)
            own = weight[start : start + n * call.served].reshape(n, -1)
            start += n * call.served
            matter = np.flatnonzero(np.abs(own).max(axis=1) > least)
            if count := len(matter):
                columns = self._columns_of(k, len(x))
                columns.batch.inputs["x"][...] = x
                columns.basis[:count] = call.basis[matter][:, None]
                columns.weight[:count] = own[matter][:, None]
                columns.batch(count * len(x))
                total += columns.curvature[:count].sum(axis=0)
        return total

    def _columns_of(self, k: int, n_var: int) -> _Columns:
        """Of a call; most programs need those of few."""
        if k not in self._columns:
            call = self._calls[k]
            n = len(call.basis)
            batch = call.second.prepared(n * n_var, SHARED)
            batch.inputs["rounding"][...] = self._rounding
            batch.inputs["along"][...] = np.tile(np.eye(n_var), (n, 1))
            inputs = (batch.inputs[name] for name in ("basis", "weight"))
            basis, weight = (array.reshape(n, n_var, *array.shape[1:]) for array in inputs)
            curvature = batch.outputs["curvature"].reshape(n, n_var, n_var)
            self._columns[k] = _Columns(batch, basis, weight, curvature)
        return self._columns[k]
