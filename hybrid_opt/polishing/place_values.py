"""Rows at places of the path, with exact derivatives, by batches over the places.

`symbolic.smooth.closure` has the formulas. The joints of every place that needs them are solved
once, rows of one kind are evaluated together, and the second derivatives of all rows are summed
place by place before they are carried over to the waypoints: poses are linear in these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codegen.function import NumericFunction
from hybrid_opt.polishing.functions import RowFunction, RowFunctions
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.sample_values import NEGLIGIBLE
from symbolic.array import Array
from symbolic.smooth.keys import ClosureKey
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
        numbers: (rows, n) what tells them from each other, if anything does.
        moving: whether the rate is among what they depend on.
        arms: whose joints are.
    """

    rows: Indices
    places: Indices
    numbers: tuple[Array, ...]
    first: RowFunction
    second: RowFunction
    moving: bool
    arms: tuple[int, ...]


@dataclass
class _Arm:
    """An arm where rows need it: which places, and what the last evaluation found there."""

    places: Indices
    position: Indices
    first: NumericFunction
    second: NumericFunction
    q: Array
    follow: Array
    pull: Array


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
            _Group(
                np.array(own, dtype=np.intp),
                self._at[own],
                row_numbers([rows[k].constraint for k in own], functions),
                functions.of(rows[own[0]].constraint, "first"),
                functions.of(rows[own[0]].constraint, "second"),
                rows[own[0]].constraint.moving,
                rows[own[0]].constraint.arms(functions.model),
            )
            for own in members.values()
        ]
        free_rows, self._columns = places.free
        moved, self._free_rows = np.unique(free_rows, return_inverse=True)
        self._basis, self._rate_basis = places.basis[:, moved], places.rate_basis[:, moved]
        self._size = functions.model.workcell.task.extended_size
        self._arms = [self._arm(arm, closures) for arm in range(len(places.q))]

    def _arm(self, arm: int, closures: Mapping[ClosureKey, NumericFunction]) -> _Arm:
        needed = [group.places for group in self._groups if arm in group.arms]
        at = np.unique(np.concatenate([np.empty(0, dtype=np.intp), *needed]))
        position = np.full(len(self._places.basis), -1, dtype=np.intp)
        position[at] = np.arange(len(at))
        q = self._places.q[arm]
        n = q.shape[1]
        return _Arm(
            places=at,
            position=position,
            first=closures[ClosureKey(arm, "first")],
            second=closures[ClosureKey(arm, "second")],
            q=q.copy(),
            follow=np.zeros((len(at), self._size, n)),
            pull=np.zeros((len(at), n, n)),
        )

    def first(self, waypoints: Array) -> tuple[Array, Array]:
        """Values (rows,) and gradients (rows, variables) by the path's variables.

        Args:
            waypoints: (n_waypoints, 6 + m), extended.

        What is found on the way is kept for `second` at the same waypoints.
        """
        self._extended = self._places.basis @ waypoints
        self._pose = self._extended[:, :POSE_SIZE]
        self._rate = (self._places.rate_basis @ waypoints)[:, :POSE_SIZE]
        for arm, reference in zip(self._arms, self._places.q, strict=True):
            if len(arm.places):
                found = arm.first.batch(self._extended[arm.places], reference[arm.places])
                # The interface's arrays are transposed matrices (`codegen.signature`).
                arm.q[arm.places], arm.follow, arm.pull = (
                    found["q"],
                    found["follow"],
                    found["pull"],
                )
        values = np.empty(self._count)
        by_pose, by_rate = np.zeros((2, self._count, self._size))
        self._by_joints: list[list[Array]] = []
        for group in self._groups:
            found = group.first.batch(*self._inputs(group))
            values[group.rows] = found["value"]
            gradient = found["gradient"]
            own, start = np.zeros((len(gradient), self._size)), 6
            own[:, :6] = gradient[:, :6]
            if group.moving:
                by_rate[group.rows, :6], start = gradient[:, 6:12], 12
            by_joints = []
            for index in group.arms:
                arm = self._arms[index]
                n = arm.q.shape[1]
                by_joints.append(gradient[:, start : start + n])
                start += n
                follow = arm.follow[arm.position[group.places]]
                own += np.matmul(follow, by_joints[-1][:, :, None])[:, :, 0]
            by_pose[group.rows] = own
            self._by_joints.append(by_joints)
        total = self._basis[self._at][:, :, None] * by_pose[:, None, :]
        total += self._rate_basis[self._at][:, :, None] * by_rate[:, None, :]
        return values, total[:, self._free_rows, self._columns]

    def _inputs(self, group: _Group, chosen: Indices | None = None) -> list[Array]:
        at, numbers = group.places, group.numbers
        if chosen is not None:
            at, numbers = at[chosen], tuple(array[chosen] for array in numbers)
        return [self._pose[at], self._rate[at], *[arm.q[at] for arm in self._arms], *numbers]

    def second(self, weight: Array) -> Array:
        """Second derivatives (variables, variables) of the values weighted by (rows,), where
        `first` was evaluated last."""
        sizes = [arm.q.shape[1] for arm in self._arms]
        starts = np.cumsum([2 * self._size, *sizes])
        # Per place by extended pose, its rate and the joints of both arms.
        curvature = np.zeros((len(self._pose), starts[-1], starts[-1]))
        pulls = [np.zeros((len(arm.places), n)) for arm, n in zip(self._arms, sizes, strict=True)]
        least = NEGLIGIBLE * np.abs(weight).max(initial=0.0)
        for group, by_joints in zip(self._groups, self._by_joints, strict=True):
            chosen = np.flatnonzero(np.abs(weight[group.rows]) > least)
            if not len(chosen):
                continue
            at, own = group.places[chosen], weight[group.rows[chosen]]
            hessian = group.second.batch(*self._inputs(group, chosen), own)["hessian"]
            ranges = [np.arange(6), *([self._size + np.arange(6)] if group.moving else [])]
            for index, slope in zip(group.arms, by_joints, strict=True):
                ranges.append(np.arange(starts[index], starts[index + 1]))
                where = self._arms[index].position[at]
                np.add.at(pulls[index], where, own[:, None] * slope[chosen])
            y = np.concatenate(ranges)
            np.add.at(curvature, (at[:, None, None], y[None, :, None], y[None, None, :]), hessian)
        for index, arm in enumerate(self._arms):
            self._close(arm, pulls[index], curvature, starts[index])
        return self._by_waypoints(self._reduced(curvature, starts))

    def _close(self, arm: _Arm, slopes: Array, curvature: Array, start: int) -> None:
        """Add the closure's curvature at all places of an arm, its joints from `start` on."""
        active = np.flatnonzero(np.abs(slopes).max(axis=1, initial=0.0) > 0.0)
        if not len(active):
            return
        nu = np.matmul(arm.pull[active], slopes[active, :, None])[:, :, 0]
        at = arm.places[active]
        hessian = arm.second.batch(self._extended[at], arm.q[at], nu)["hessian"]
        y = np.concatenate([np.arange(self._size), np.arange(start, start + arm.q.shape[1])])
        curvature[at[:, None, None], y[None, :, None], y[None, None, :]] += hessian

    def _reduced(self, curvature: Array, starts: Array) -> Array:
        """T^T H T: by extended pose and rate (places, 12 + 2 m, 12 + 2 m), the joints following."""
        size, box = self._size, 2 * self._size
        total = curvature[:, :box, :box].copy()
        at = np.unique(np.concatenate([arm.places for arm in self._arms]))
        if not len(at):
            return total
        # T^T (places, 6 + m, joints), both arms side by side.
        T = np.zeros((len(self._pose), size, starts[-1] - box))
        for index, arm in enumerate(self._arms):
            T[arm.places, :, starts[index] - box : starts[index + 1] - box] = arm.follow
        T, H = T[at], curvature[at]
        mixed = np.matmul(T, H[:, box:, :box])
        total[at, :size] += mixed
        total[at, :, :size] += np.swapaxes(mixed, 1, 2)
        total[at, :size, :size] += np.matmul(np.matmul(T, H[:, box:, box:]), np.swapaxes(T, 1, 2))
        return total

    def _by_waypoints(self, curvature: Array) -> Array:
        """Carry second derivatives by extended pose and rate over to the variables, and sum
        them."""
        n, size = self._basis.shape[1], self._size
        total = np.zeros((n * n, size * size))
        bases = (self._basis, self._rate_basis)
        for i, left in enumerate(bases):
            for j, right in enumerate(bases):
                rows = slice(size * i, size * (i + 1))
                columns = slice(size * j, size * (j + 1))
                block = curvature[:, rows, columns].reshape(-1, size * size)
                outer = (left[:, :, None] * right[:, None, :]).reshape(-1, n * n)
                total += outer.T @ block
        at = self._free_rows * size + self._columns
        whole = total.reshape(n, n, size, size).transpose(0, 2, 1, 3).reshape(size * n, size * n)
        return np.asarray(whole[np.ix_(at, at)])


def row_numbers(
    constraints: Sequence[PlaceConstraint], functions: RowFunctions
) -> tuple[Array, ...]:
    """(rows, n) numbers of constraints of one family, in a tuple; an empty one without any."""
    numbers = np.array([functions.numbers(constraint) for constraint in constraints])
    return (numbers,) if numbers.shape[1] else ()
