"""Rows at places group by group, and the sums of their second derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction, PreparedBatch
from symbolic.array import Array
from symbolic.records import POSE_SIZE

Indices = NDArray[np.intp]


@dataclass
class RowGroup:
    """Rows of one family: which they are in the order of groups, and their functions.

    Attributes:
        rows: a slice.
        first: values and gradients; its inputs and values are parts of all rows' arrays.
        function: builds that of the second derivatives, which is prepared when it is first needed:
            most rows never rule.
        moving: whether the rate is among what they depend on.
        arms: whose joints are.
    """

    rows: slice
    first: PreparedBatch
    function: Callable[[], NumericFunction]
    moving: bool
    arms: tuple[int, ...]
    _second: PreparedBatch | None = None

    def curvatures(self, chosen: Indices, weight: Array) -> Array:
        """(k, n, n) weighted Hessians of chosen rows (k,), counted from the group's first."""
        inputs, count = self.second.inputs, len(chosen)
        for name, values in self.first.inputs.items():
            np.take(values, chosen, axis=0, out=inputs[name][:count], mode="clip")
        inputs["weight"][:count] = weight
        return self.second(count)["hessian"][:count]

    @property
    def second(self) -> PreparedBatch:
        """The second derivatives' evaluations."""
        if self._second is None:
            self._second = self.function().prepared(self.rows.stop - self.rows.start)
        return self._second


@dataclass(frozen=True)
class Pull:
    """How a group's rows depend on an arm's joints.

    Attributes:
        gradient: of the group's rows; `columns` are by the arm's joints.
        slopes: (rows, n) the gradients by the joints, where the arm keeps them.
    """

    gradient: Array
    columns: slice
    slopes: Array


@dataclass
class ArmRows:
    """An arm where rows need it.

    Attributes:
        places: which ones.
        position: of each place among them; 0 where it is none.
        at: (all rows,) positions of their places.
        basis: (places, n_waypoints).
        first: joints and what follows them at the places.
        function: of the closure's second derivatives; prepared when they are first needed.
        rows: those that depend on its joints.
        slopes: (rows, n) their gradients by the joints.
        pulls: of these rows group by group.
    """

    places: Indices
    position: Indices
    at: Indices
    basis: Array
    first: PreparedBatch
    function: NumericFunction
    rows: Indices
    slopes: Array
    pulls: dict[int, Pull]
    _second: PreparedBatch | None = None

    def curvatures(self, active: Indices, pull: Array) -> Array:
        """(k, n, n) Hessians of the closure at active places (k,), by what pulls at the joints
        there (k, joints)."""
        found, inputs, count = self.first.outputs, self.second.inputs, len(active)
        inputs["pose"][:count] = self.first.inputs["pose"][active]
        inputs["q"][:count] = found["q"][active]
        inputs["nu"][:count] = np.einsum("kij,kj->ki", found["pull"][active], pull)
        return self.second(count)["hessian"][:count]

    @property
    def second(self) -> PreparedBatch:
        """The evaluations of the closure's second derivatives."""
        if self._second is None:
            self._second = self.function.prepared(len(self.places))
        return self._second


class CurvatureSums:
    """Second derivatives at places, carried over to the waypoints that move in one product."""

    def __init__(self, basis: Array, rate_basis: Array, size: int) -> None:
        """Of bases (m, n), and extended poses of some size."""
        self._basis, self._rate_basis, self._size = basis, rate_basis, size
        self._left, self._right, self._blocks = (list[Array]() for _ in range(3))

    def add(self, at: Indices, blocks: Array) -> None:
        """(rows, size, size) by the extended pose."""
        basis = self._basis[at]
        self._left.append(basis)
        self._right.append(basis)
        self._blocks.append(blocks.reshape(len(at), -1))

    def add_moving(self, at: Indices, hessian: Array) -> None:
        """(rows, 12, 12) by pose and rate."""
        bases, n, rows = (self._basis[at], self._rate_basis[at]), POSE_SIZE, len(at)
        for i, left in enumerate(bases):
            for j, right in enumerate(bases):
                blocks = np.zeros((rows, self._size, self._size))
                blocks[:, :n, :n] = hessian[:, n * i : n * i + n, n * j : n * j + n]
                self._left.append(left)
                self._right.append(right)
                self._blocks.append(blocks.reshape(rows, -1))

    def total(self) -> Array:
        """(n n, size size) by pairs of waypoints and of entries of their poses."""
        n = self._basis.shape[1]
        if not self._blocks:
            return np.zeros((n * n, self._size**2))
        left, right = np.concatenate(self._left), np.concatenate(self._right)
        outer = (left[:, :, None] * right[:, None, :]).reshape(-1, n * n)
        return np.asarray(outer.T @ np.concatenate(self._blocks))
