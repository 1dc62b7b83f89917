"""Forces at chosen samples: what the paper's branches are made of, and those of joint allocation.

The latter come from what a sample's load asks of the pads (`symbolic.smooth.held`); derivatives by
the decision vector follow by the chain rule, so that no load is solved for twice at a place.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codegen.function import PreparedBatch
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.layout import HELD, ForceRow
from hybrid_opt.polishing.sample_values import NEGLIGIBLE, SampleValues
from symbolic.array import Array
from symbolic.smooth.keys import HeldKey
from symbolic.smooth.samples import SampleBlock


@dataclass(frozen=True)
class HeldValues:
    """The joint allocation's forces at n samples.

    Attributes:
        start: the first of them among all values of forces.
        loads: what the samples have to hold.
        at: (n,) each sample's among these.
        first, second: see `symbolic.smooth.held`; over the n samples.
    """

    start: int
    loads: SampleValues
    at: NDArray[np.intp]
    first: PreparedBatch
    second: PreparedBatch

    def find(self, x: Array) -> None:
        """Forces at x, written where `first` was prepared for."""
        self.first.inputs["load"][...] = self.loads.values(x)[self.at]
        self.first()

    def gradients(self) -> Array:
        """(n, 2, n_var) there."""
        slope = self.first.outputs["slope"]
        return np.asarray(np.matmul(slope, self.loads.gradients[self.at]))

    def second_of(self, x: Array, weight: Array, least: float) -> Array:
        """(n_var, n_var) second derivatives of the forces weighted by (n, 2), where a weight is
        beyond the least that matters."""
        (matter,) = (np.abs(weight).max(axis=1, initial=0.0) > least).nonzero()
        on_loads = np.zeros((self.loads.count, self.loads.width))
        slope = self.first.outputs["slope"][matter]
        on_loads[self.at[matter]] = np.einsum("ki,kij->kj", weight[matter], slope)
        total = self.loads.second(x, on_loads)
        if len(matter):
            self.second.inputs["state"][: len(matter)] = self.first.outputs["state"][matter]
            self.second.inputs["weight"][: len(matter)] = weight[matter]
            self.second(len(matter))
            bent = self.second.outputs["curvature"][: len(matter)]
            by = self.loads.gradients[self.at[matter]]
            total += np.einsum("kix,kij,kjy->xy", by, bent, by, optimize=True)
        return total


class ForceValues:
    """Two values of each sample of some force rows: F_n and F_t for the paper's branches, both
    normal forces for joint allocation.

    Attributes:
        count: of samples, counted twice where rows of both kinds stand.
        column: (rows,) the position of each row's sample among the values.
        split, held: of either kind.
    """

    def __init__(
        self,
        rows: Collection[ForceRow],
        blocks: tuple[SampleBlock, ...],
        functions: PolishFunctions,
        rounding: float,
    ) -> None:
        """rounding: of the time law's kinks."""
        given = blocks, functions.samples
        split = {row.sample for row in rows if row.branch != HELD}
        held = sorted({row.sample for row in rows if row.branch == HELD})
        self.split = SampleValues("force", *given, split, rounding, beyond=len(held))
        self.count, start = self.split.count, self.split.count - len(held)
        self.held: HeldValues | None = None
        column = np.full(len(self.split.column), -1)
        if held:
            loads = SampleValues("load", *given, set(held), rounding)
            column[held] = start + np.arange(len(held))
            first, second = (functions.held[HeldKey(o)] for o in ("first", "second"))
            self.held = HeldValues(
                start=start,
                loads=loads,
                at=loads.column[held],
                first=first.prepared(len(held), given={"normal": self.split.found[start:]}),
                second=second.prepared(len(held)),
            )
        where = [(column if row.branch == HELD else self.split.column)[row.sample] for row in rows]
        self.column = np.array(where, dtype=np.intp)

    @property
    def gradients(self) -> Array:
        """(count, 2, n_var) where the values were found last."""
        if self.held is not None:
            self.split.gradients[self.held.start :] = self.held.gradients()
        return self.split.gradients

    @property
    def parts(self) -> tuple[SampleValues, ...]:
        """What is evaluated at samples."""
        return (self.split,) if self.held is None else (self.split, self.held.loads)

    def values(self, x: Array) -> Array:
        """(count, 2) at x, overwritten by the next call."""
        if self.held is not None:
            self.held.find(x)
        return self.split.values(x)

    def second(self, x: Array, weight: Array) -> Array:
        """(n_var, n_var) second derivatives of the values weighted by (count, 2)."""
        total = self.split.second(x, weight)
        if self.held is not None:
            least = NEGLIGIBLE * float(np.abs(weight).max(initial=0.0))
            total += self.held.second_of(x, weight[self.held.start :], least)
        return total
