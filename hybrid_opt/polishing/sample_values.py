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
    """One function over some of its samples, which each evaluation serves `served` of: both its
    orders, and its windows (calls, ., .)."""

    first: PreparedBatch
    second: PreparedBatch
    basis: Array
    served: int


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
        order: list[NDArray[np.int64]] = [np.empty(0, dtype=np.int64)]
        for block in blocks:
            chosen = np.isin(block.samples, list(wanted)).any(axis=1)
            if not chosen.any():
                continue
            order.append(block.samples[chosen].ravel())
            basis = block.basis[chosen]
            first, second = (
                functions[SampleKey(quantity, block.block, o)].prepared(len(basis), SHARED)
                for o in get_args(Order)
            )
            first.inputs["basis"][...] = basis
            for prepared in (first, second):
                prepared.inputs["rounding"][...] = rounding
            self._calls.append(_Call(first, second, basis, block.samples.shape[1]))
        served = np.concatenate(order)
        self.count = len(served)
        self.column = np.full(1 + max(int(block.samples.max(initial=0)) for block in blocks), -1)
        self.column[served] = np.arange(len(served))

    def first(self, x: Array) -> tuple[Array, Array]:
        """Values (count, 2) and their gradients (count, 2, n_var)."""
        values, gradients = [np.empty((0, 2))], [np.empty((0, 2, len(x)))]
        for call in self._calls:
            call.first.inputs["x"][...] = x
            found = call.first()
            values.append(found["values"].reshape(-1, 2))
            gradients.append(found["gradient"].reshape(-1, 2, len(x)))
        return np.concatenate(values), np.concatenate(gradients)

    def second(self, x: Array, weight: Array) -> Array:
        """(n_var, n_var) second derivatives of the values weighted by (count, 2)."""
        total, start = np.zeros((len(x), len(x))), 0
        least = NEGLIGIBLE * np.abs(weight).max(initial=0.0)
        for call in self._calls:
            n = len(call.basis)
            own = weight[start : start + n * call.served].reshape(n, -1)
            start += n * call.served
            matter = np.flatnonzero(np.abs(own).max(axis=1) > least)
            if count := len(matter):
                inputs = call.second.inputs
                inputs["x"][...] = x
                inputs["basis"][:count] = call.basis[matter]
                inputs["weight"][:count] = own[matter]
                total += call.second(count)["hessian"][:count].sum(axis=0)
        return total
