"""Values at chosen samples, with exact derivatives, by batches over the samples."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import get_args

import numpy as np

from codegen.function import NumericFunction, PreparedBatch
from symbolic.array import Array
from symbolic.smooth.keys import WIDTHS, Order, Quantity, SampleKey
from symbolic.smooth.samples import SampleBlock

NEGLIGIBLE = 1e-7
"""Share of the largest weight below which second derivatives are left out: those of rows that are
far from ruling, whose multipliers vanish. It changes steps by as much, no solution."""


SHARED = ["x", "rounding"]
"""Inputs that all samples have in common."""


@dataclass(frozen=True)
class SampleCall:
    """One function over some of its samples.

    Attributes:
        first: all values of each sample, with gradients.
        second: the function of second derivatives, of one direction each.
        basis: (calls, ., .) the samples' windows.
        served: samples that each call serves.
    """

    first: PreparedBatch
    second: NumericFunction
    basis: Array
    served: int


@dataclass(frozen=True)
class Columns:
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
    """Some values of each of some samples, from the decision vector.

    Attributes:
        column: (n_samples,) position of a sample among the values, -1 where it has none.
        count: of samples with values.
        width: values of each.
        calls, starts: functions with values, and the first sample of each; all samples follow.
        x: (n_var,) where they are evaluated.
        found, gradients: (count, width), (count, width, n_var) there.
    """

    def __init__(
        self,
        quantity: Quantity,
        blocks: tuple[SampleBlock, ...],
        functions: Mapping[SampleKey, NumericFunction],
        wanted: Collection[int],
        rounding: float,
        beyond: int = 0,
    ) -> None:
        """A program's samples.

        Args:
            wanted: samples without which a call is left out.
            rounding: of the time law's kinks, see `symbolic.smooth.samples.sample_functions`.
            beyond: samples whose values follow, which others find.
        """
        self._rounding, self._columns = rounding, dict[int, Columns]()
        chosen = [
            block.samples[np.isin(block.samples, list(wanted)).any(axis=1)] for block in blocks
        ]
        served = np.concatenate([samples.ravel() for samples in chosen])
        self.count, self.width = len(served) + beyond, WIDTHS[quantity]
        self.column = np.full(1 + max(int(block.samples.max(initial=0)) for block in blocks), -1)
        self.column[served] = np.arange(len(served))
        n_var = next(iter(functions.values())).input_shapes[0][0]
        self.x, self.found = np.zeros(n_var), np.zeros((self.count, self.width))
        self.gradients = np.zeros((self.count, self.width, n_var))
        self.calls, self.starts = list[SampleCall](), [0]
        for block, samples in zip(blocks, chosen, strict=True):
            if not len(samples):
                continue
            rows = slice(self.starts[-1], self.starts[-1] + samples.size)
            first, second = (
                functions[SampleKey(quantity, block.block, o)] for o in get_args(Order)
            )
            n, served_each = samples.shape
            given = {
                "x": self.x,
                "values": self.found[rows].reshape(n, -1),
                "gradient": self.gradients[rows].reshape(n, -1, n_var),
            }
            batch = first.prepared(n, SHARED, given)
            basis = block.basis[np.isin(block.samples, samples).all(axis=1)]
            batch.inputs["basis"][...] = basis
            batch.inputs["rounding"][...] = rounding
            self.calls.append(SampleCall(batch, second, basis, served_each))
            self.starts.append(rows.stop)

    def values(self, x: Array) -> Array:
        """(count, width) at x, overwritten by the next call, as are `gradients`."""
        self.x[...] = x
        for call in self.calls:
            call.first()
        return self.found

    def second(self, x: Array, weight: Array) -> Array:
        """(n_var, n_var) second derivatives of the values weighted by (count, width)."""
        total = np.zeros((len(x), len(x)))
        size = np.abs(weight).max(axis=1, initial=0.0)
        matter = (size > NEGLIGIBLE * size.max(initial=0.0)).nonzero()[0]
        bounds = matter.searchsorted(self.starts).tolist()
        for k, call in enumerate(self.calls):
            rows = matter[bounds[k] : bounds[k + 1]] - self.starts[k]
            if not len(rows):
                continue
            at = np.unique(rows // call.served) if call.served > 1 else rows
            own = weight[self.starts[k] : self.starts[k + 1]].reshape(len(call.basis), -1)
            columns, count = self.columns_of(k, len(x)), len(at)
            columns.batch.inputs["x"][...] = x
            columns.basis[:count] = call.basis[at][:, None]
            columns.weight[:count] = own[at][:, None]
            columns.batch(count * len(x))
            total += columns.curvature[:count].sum(axis=0)
        return total

    def columns_of(self, k: int, n_var: int) -> Columns:
        """Of a call; most programs need those of few."""
        if k not in self._columns:
            call = self.calls[k]
            n = len(call.basis)
            batch = call.second.prepared(n * n_var, SHARED)
            batch.inputs["rounding"][...] = self._rounding
            batch.inputs["along"][...] = np.tile(np.eye(n_var), (n, 1))
            inputs = (batch.inputs[name] for name in ("basis", "weight"))
            basis, weight = (array.reshape(n, n_var, *array.shape[1:]) for array in inputs)
            curvature = batch.outputs["curvature"].reshape(n, n_var, n_var)
            self._columns[k] = Columns(batch, basis, weight, curvature)
        return self._columns[k]
