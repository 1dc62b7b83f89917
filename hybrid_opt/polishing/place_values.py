"""Rows at places of the path, with exact derivatives, by batches over the places.

`symbolic.smooth.closure` has the formulas. The joints of every place that needs them are solved
once, rows of one kind are evaluated together, and the second derivatives of all rows are summed
place by place before they are carried over to the waypoints: poses are linear in these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction, PreparedBatch
from hybrid_opt.polishing.functions import RowFunctions
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.sample_values import NEGLIGIBLE
from symbolic.array import Array
from symbolic.smooth.keys import ClosureKey, Order
from symbolic.smooth.place import PlaceConstraint
from symbolic.workcell.decision import POSE_SIZE

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Places:
    """Some places of the path, and joints near those that hold the box there.

    Attributes:
        basis, rate_basis: (m, n_waypoints): poses = basis @ waypoints, and their rates along the
            path parameter.
        free: rows and columns of the variables among the extended waypoints
            (`Task.free_entries`).
        q: both arms' joints (m, n) [rad].
    """

    basis: Array
    rate_basis: Array
    free: tuple[Indices, Indices]
    q: tuple[Array, Array]


@dataclass(frozen=True)
class _Group:
    """Rows of one family: their indices and places, and their functions.

    Attributes:
        moving: whether the rate is among what they depend on.
        arms: whose joints are.
    """

    rows: Indices
    places: Indices
    first: PreparedBatch
    second: PreparedBatch
    moving: bool
    arms: tuple[int, ...]


@dataclass(frozen=True)
class _Pull:
    """How a group's rows depend on an arm's joints.

    Attributes:
        group: which one.
        at: (rows,) positions of the rows' places among the arm's.
        columns: of the group's gradient that are by the arm's joints.
        q: the group's input.
        slopes: (rows, n) the gradients by the joints, where the arm keeps them.
    """

    group: int
    at: Indices
    columns: slice
    q: Array
    slopes: Array


@dataclass(frozen=True)
class _Arm:
    """An arm where rows need it.

    Attributes:
        places: which ones.
        position: of each place among them.
        rows, at: all rows that depend on its joints, and the positions of their places.
        slopes: (rows, n) their gradients by the joints.
        pulls: of these rows group by group.
    """

    places: Indices
    position: Indices
    first: PreparedBatch
    second: PreparedBatch
    rows: Indices
    at: Indices
    slopes: Array
    pulls: tuple[_Pull, ...]

    @property
    def joints(self) -> int:
        """How many it has."""
        return int(self.first.outputs["q"].shape[1])


class PlaceValues:
    """Rows at places, from the waypoints."""

    def __init__(
        self,
        rows: tuple[PlaceRow, ...],
        places: Places,
        closures: Mapping[ClosureKey, NumericFunction],
        functions: RowFunctions,
    ) -> None:
        """Rows' places are indices into `places`."""
        self._count, self._places = len(rows), places
        self._at = np.array([row.place for row in rows], dtype=np.intp)
        members: dict[str, list[int]] = {}
        for k, row in enumerate(rows):
            members.setdefault(row.constraint.family, []).append(k)
        self._groups = [
            self._group(rows, np.array(own, dtype=np.intp), functions) for own in members.values()
        ]
        free_rows, self._columns = places.free
        moved, self._free_rows = np.unique(free_rows, return_inverse=True)
        self._basis, self._rate_basis = places.basis[:, moved], places.rate_basis[:, moved]
        self._size = functions.model.workcell.task.extended_size
        self._arms = [self._arm(arm, closures) for arm in range(len(places.q))]
        self._row_basis = self._basis[self._at][:, self._free_rows]
        self._row_rate_basis = self._rate_basis[self._at][:, self._free_rows]
        self._moving = any(group.moving for group in self._groups)

    def _group(self, rows: tuple[PlaceRow, ...], own: Indices, functions: RowFunctions) -> _Group:
        constraints = [rows[k].constraint for k in own.tolist()]
        first, second = (
            functions.of(constraints[0], order).prepared(len(own)) for order in get_args(Order)
        )
        if "numbers" in first.inputs:
            first.inputs["numbers"][...] = row_numbers(constraints, functions)[0]
        arms = constraints[0].arms(functions.model)
        return _Group(own, self._at[own], first, second, constraints[0].moving, arms)

    def _arm(self, arm: int, closures: Mapping[ClosureKey, NumericFunction]) -> _Arm:
        needed = [group.places for group in self._groups if arm in group.arms]
        at = np.unique(np.concatenate([np.empty(0, dtype=np.intp), *needed]))
        position = np.full(len(self._places.basis), -1, dtype=np.intp)
        position[at] = np.arange(len(at))
        first, second = (
            closures[ClosureKey(arm, order)].prepared(max(1, len(at))) for order in get_args(Order)
        )
        first.inputs["q_reference"][: len(at)] = self._places.q[arm][at]
        chosen = [k for k, group in enumerate(self._groups) if arm in group.arms]
        rows = np.concatenate([np.empty(0, dtype=np.intp), *(self._groups[k].rows for k in chosen)])
        slopes, pulls, start = np.empty((len(rows), first.outputs["q"].shape[1])), list[_Pull](), 0
        for k in chosen:
            group = self._groups[k]
            own = slopes[start : start + len(group.rows)]
            begin = 12 if group.moving else 6
            for other in group.arms[: group.arms.index(arm)]:
                begin += self._places.q[other].shape[1]
            columns, q = slice(begin, begin + slopes.shape[1]), group.first.inputs[f"q_{arm + 1}"]
            pulls.append(_Pull(k, position[group.places], columns, q, own))
            start += len(group.rows)
        where = position[self._at[rows]]
        return _Arm(at, position, first, second, rows, where, slopes, tuple(pulls))

    def first(self, waypoints: Array) -> tuple[Array, Array]:
        """Values (rows,) and gradients (rows, variables) by the path's variables.

        Args:
            waypoints: (n_waypoints, 6 + m), extended.

        What is found on the way is kept for `second` at the same waypoints.
        """
        extended, rate = self._places.basis @ waypoints, self._places.rate_basis @ waypoints
        pose, rate = extended[:, :POSE_SIZE], rate[:, :POSE_SIZE]
        for arm in self._arms:
            count = len(arm.places)
            arm.first.inputs["pose"][:count] = extended[arm.places]
            q = arm.first(count)["q"]
            for pull in arm.pulls:
                np.take(q, pull.at, axis=0, out=pull.q, mode="clip")
        values = np.empty(self._count)
        by_pose, by_rate = np.zeros((2, self._count, self._size))
        for group in self._groups:
            inputs = group.first.inputs
            np.take(pose, group.places, axis=0, out=inputs["pose"], mode="clip")
            if group.moving:
                np.take(rate, group.places, axis=0, out=inputs["rate"], mode="clip")
            found = group.first()
            values[group.rows] = found["value"]
            by_pose[group.rows, :POSE_SIZE] = found["gradient"][:, :6]
            if group.moving:
                by_rate[group.rows, :POSE_SIZE] = found["gradient"][:, 6:12]
        for arm in self._arms:
            for pull in arm.pulls:
                gradient = self._groups[pull.group].first.outputs["gradient"]
                pull.slopes[...] = gradient[:, pull.columns]
            # The interface's arrays are transposed matrices (`codegen.signature`).
            follow = arm.first.outputs["follow"][arm.at]
            by_pose[arm.rows] += np.matmul(follow, arm.slopes[:, :, None])[:, :, 0]
        total = self._row_basis * by_pose[:, self._columns]
        if self._moving:
            total += self._row_rate_basis * by_rate[:, self._columns]
        return values, total

    def second(self, weight: Array) -> Array:
        """Second derivatives (variables, variables) of the values weighted by (rows,), where
        `first` was called last."""
        n, size = self._basis.shape[1], self._size
        total = np.zeros((n * n, size * size))
        least = NEGLIGIBLE * np.abs(weight).max(initial=0.0)
        pulls = [np.zeros((len(arm.places), arm.joints)) for arm in self._arms]
        for k, group in enumerate(self._groups):
            chosen = np.flatnonzero(np.abs(weight[group.rows]) > least)
            count = len(chosen)
            if not count:
                continue
            own, at = weight[group.rows[chosen]], group.places[chosen]
            inputs = group.second.inputs
            for name, values in group.first.inputs.items():
                inputs[name][:count] = values[chosen]
            inputs["weight"][:count] = own
            hessian = group.second(count)["hessian"][:count]
            for index in group.arms:
                arm = self._arms[index]
                (pull,) = (pull for pull in arm.pulls if pull.group == k)
                np.add.at(pulls[index], pull.at[chosen], own[:, None] * pull.slopes[chosen])
            if group.moving:
                self._add_moving(total, at, hessian)
            else:
                self._add(total, at, self._reduced(hessian, group.arms, at, POSE_SIZE))
        for index in range(len(self._arms)):
            self._close(total, index, pulls[index])
        at = self._free_rows * size + self._columns
        whole = total.reshape(n, n, size, size).transpose(0, 2, 1, 3).reshape(size * n, size * n)
        return np.asarray(whole[np.ix_(at, at)])

    def _close(self, total: Array, index: int, slopes: Array) -> None:
        """Add the closure's curvature at the places of an arm where rows pull at its joints."""
        arm = self._arms[index]
        active = np.flatnonzero(np.abs(slopes).max(axis=1, initial=0.0) > 0.0)
        count = len(active)
        if not count:
            return
        found, inputs = arm.first.outputs, arm.second.inputs
        inputs["pose"][:count] = arm.first.inputs["pose"][active]
        inputs["q"][:count] = found["q"][active]
        inputs["nu"][:count] = np.matmul(found["pull"][active], slopes[active, :, None])[:, :, 0]
        hessian, at = arm.second(count)["hessian"][:count], arm.places[active]
        self._add(total, at, self._reduced(hessian, (index,), at, self._size))

    def _reduced(self, hessian: Array, arms: tuple[int, ...], at: Indices, own: int) -> Array:
        """T^T H T: by extended pose (rows, 6 + m, 6 + m), the joints of some arms following it.

        Args:
            hessian: by the first `own` entries of the extended pose and by the joints.
        """
        reduced = np.zeros((len(at), self._size, self._size))
        reduced[:, :own, :own] = hessian[:, :own, :own]
        if not arms:
            return reduced
        follows = [self._arms[k].first.outputs["follow"][self._arms[k].position[at]] for k in arms]
        follow = np.concatenate(follows, axis=2)
        mixed = np.matmul(follow, hessian[:, own:, :own])
        reduced[:, :, :own] += mixed
        reduced[:, :own, :] += np.swapaxes(mixed, 1, 2)
        turned = np.swapaxes(follow, 1, 2)
        reduced += np.matmul(np.matmul(follow, hessian[:, own:, own:]), turned)
        return reduced

    def _add(self, total: Array, at: Indices, blocks: Array) -> None:
        """Carry second derivatives (rows, 6 + m, 6 + m) by the extended pose over to the
        waypoints."""
        basis = self._basis[at]
        _add_blocks(total, basis, basis, blocks)

    def _add_moving(self, total: Array, at: Indices, hessian: Array) -> None:
        """The same of second derivatives (rows, 12, 12) by pose and rate."""
        bases = (self._basis[at], self._rate_basis[at])
        blocks = np.zeros((len(at), self._size, self._size))
        for i, left in enumerate(bases):
            for j, right in enumerate(bases):
                part = hessian[:, 6 * i : 6 * i + 6, 6 * j : 6 * j + 6]
                blocks[:, :POSE_SIZE, :POSE_SIZE] = part
                _add_blocks(total, left, right, blocks)


def _add_blocks(total: Array, left: Array, right: Array, blocks: Array) -> None:
    n = left.shape[1]
    outer = (left[:, :, None] * right[:, None, :]).reshape(-1, n * n)
    total += outer.T @ blocks.reshape(len(blocks), -1)


def row_numbers(
    constraints: Sequence[PlaceConstraint], functions: RowFunctions
) -> tuple[Array, ...]:
    """(rows, n) numbers of constraints of one family, in a tuple; an empty one without any."""
    numbers = np.array([functions.numbers(constraint) for constraint in constraints])
    return (numbers,) if numbers.shape[1] else ()
