"""Rows at places of the path, with exact derivatives, by batches over the places.

`symbolic.smooth.closure` has the formulas. The joints of every place that needs them are solved
once, rows of one kind are evaluated together, and the second derivatives of all rows are summed
place by place before they are carried over to the waypoints: poses are linear in these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import get_args

import numpy as np

from codegen.function import NumericFunction
from hybrid_opt.polishing.functions import RowFunctions
from hybrid_opt.polishing.layout import PlaceRow
from hybrid_opt.polishing.place_groups import ArmRows, CurvatureSums, Indices, Pull, RowGroup
from hybrid_opt.polishing.sample_values import NEGLIGIBLE
from symbolic.array import Array
from symbolic.records import POSE_SIZE
from symbolic.smooth.keys import ClosureKey, Order
from symbolic.smooth.place import PlaceConstraint


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


class PlaceValues:
    """Rows at places, from the waypoints. Inside, rows stand group by group.

    Attributes:
        order: (n,) the row that stands where.
        at: (n,) its place.
        shared: arrays (n, ...) of what its functions take and of its value.
        groups, arms: what evaluates them.
        whole: (n, n_waypoints) bases of poses and rates at its place.
        by_variable: (m, n_path) the same of each place by the path's variables.
        size: entries of an extended pose.
    """

    def __init__(
        self,
        rows: tuple[PlaceRow, ...],
        places: Places,
        closures: Mapping[ClosureKey, NumericFunction],
        functions: RowFunctions,
    ) -> None:
        """Rows' places are indices into `places`."""
        members: dict[str, list[int]] = {}
        for k, row in enumerate(rows):
            members.setdefault(row.constraint.family, []).append(k)
        self.order = np.array([k for own in members.values() for k in own], dtype=np.intp)
        self._position = np.argsort(self.order)
        self._places, n = places, len(rows)
        self.at = np.array([rows[k].place for k in self.order.tolist()], dtype=np.intp)
        self.size = functions.model.workcell.task.extended_size
        self._joints = [q.shape[1] for q in places.q]
        self.shared = {
            "pose": np.zeros((n, POSE_SIZE)),
            "rate": np.zeros((n, POSE_SIZE)),
            "q_1": np.zeros((n, self._joints[0])),
            "q_2": np.zeros((n, self._joints[1])),
            "value": np.zeros(n),
        }
        self.groups, start = list[RowGroup](), 0
        for own in members.values():
            constraints = [rows[k].constraint for k in own]
            self.groups.append(self._group(constraints, start, functions))
            start += len(own)
        self._starts = [group.rows.start for group in self.groups] + [n]
        self.arms = [self._arm(arm, closures) for arm in range(len(places.q))]
        self._index_variables()

    def _index_variables(self) -> None:
        """How rows follow the variables: by their places' rows of the bases."""
        free_rows, self._columns = self._places.free
        moved, free_rows = np.unique(free_rows, return_inverse=True)
        basis, rate = self._places.basis, self._places.rate_basis
        self.whole = basis[self.at], rate[self.at]
        self._moved = basis[:, moved], rate[:, moved]
        self.by_variable = tuple(part[:, free_rows] for part in self._moved)
        self._free = tuple(part[self.at] for part in self.by_variable)
        self._by_pose, self._by_rate = np.zeros((2, len(self.at), self.size))
        n, size = len(moved), self.size
        outer = free_rows[:, None] * n + free_rows
        self._entries = (outer * size + self._columns[:, None]) * size + self._columns

    def _group(
        self, constraints: Sequence[PlaceConstraint], start: int, functions: RowFunctions
    ) -> RowGroup:
        one, rows = constraints[0], slice(start, start + len(constraints))
        given = {name: array[rows] for name, array in self.shared.items()}
        first = functions.of(one, "first").prepared(len(constraints), given=given)
        if "numbers" in first.inputs:
            first.inputs["numbers"][...] = row_numbers(constraints, functions)[0]
        second = partial(functions.of, one, "second")
        return RowGroup(rows, first, second, one.moving, one.arms(functions.model))

    def _arm(self, arm: int, closures: Mapping[ClosureKey, NumericFunction]) -> ArmRows:
        n, chosen = len(self.at), [g for g in self.groups if arm in g.arms]
        empty = np.empty(0, dtype=np.intp)
        rows = np.concatenate([empty, *(np.arange(n)[group.rows] for group in chosen)])
        places = np.unique(self.at[rows])
        position = np.zeros(len(self._places.basis), dtype=np.intp)
        position[places] = np.arange(len(places))
        first, second = (closures[ClosureKey(arm, order)] for order in get_args(Order))
        batch = first.prepared(max(1, len(places)))
        batch.inputs["q_reference"][: len(places)] = self._places.q[arm][places]
        slopes, pulls, start = np.empty((len(rows), self._joints[arm])), dict[int, Pull](), 0
        for k, group in enumerate(self.groups):
            if arm not in group.arms:
                continue
            begin = 12 if group.moving else 6
            begin += sum(self._joints[other] for other in group.arms[: group.arms.index(arm)])
            columns = slice(begin, begin + self._joints[arm])
            count = group.rows.stop - group.rows.start
            own = slopes[start : start + count]
            pulls[k] = Pull(group.first.outputs["gradient"], columns, own)
            start += count
        basis = self._places.basis[places]
        return ArmRows(
            places, position, position[self.at], basis, batch, second, rows, slopes, pulls
        )

    def first(self, waypoints: Array) -> tuple[Array, Array]:
        """Values (rows,) and gradients (rows, variables) by the path's variables.

        Args:
            waypoints: (n_waypoints, 6 + m), extended.

        What is found on the way is kept for `second` at the same waypoints.
        """
        return self.values(waypoints), self.gradients()

    def values(self, waypoints: Array) -> Array:
        """(rows,) at extended waypoints (n_waypoints, 6 + m)."""
        path = np.ascontiguousarray(waypoints[:, :POSE_SIZE])
        for name, basis in zip(("pose", "rate"), self.whole, strict=True):
            np.matmul(basis, path, out=self.shared[name])
        for arm, joints in zip(self.arms, ("q_1", "q_2"), strict=True):
            if len(arm.places):
                np.matmul(arm.basis, waypoints, out=arm.first.inputs["pose"])
                q = arm.first()["q"]
                np.take(q, arm.at, axis=0, out=self.shared[joints], mode="clip")
        for group in self.groups:
            group.first()
        return self.shared["value"][self._position]

    def gradients(self) -> Array:
        """(rows, variables) by the path's variables, where `values` was called last."""
        by_pose, by_rate = self._by_pose, self._by_rate
        for group in self.groups:
            gradient = group.first.outputs["gradient"]
            by_pose[group.rows, :POSE_SIZE] = gradient[:, :POSE_SIZE]
            if group.moving:
                by_rate[group.rows, :POSE_SIZE] = gradient[:, POSE_SIZE : 2 * POSE_SIZE]
        by_pose[:, POSE_SIZE:] = 0.0
        for arm in self.arms:
            if not len(arm.rows):
                continue
            for pull in arm.pulls.values():
                pull.slopes[...] = pull.gradient[:, pull.columns]
            # The interface's arrays are transposed matrices (`codegen.function`).
            follow = arm.first.outputs["follow"].take(arm.at[arm.rows], axis=0)
            by_pose[arm.rows] += np.einsum("rij,rj->ri", follow, arm.slopes)
        total = self._free[0] * by_pose.take(self._columns, axis=1)
        for group in self.groups:
            if group.moving:
                rate = by_rate[group.rows].take(self._columns, axis=1)
                total[group.rows] += self._free[1][group.rows] * rate
        return np.asarray(total.take(self._position, axis=0))

    def second(self, weight: Array) -> Array:
        """Second derivatives (variables, variables) of the values weighted by (rows,), where
        `gradients` was called last."""
        weight = weight[self.order]
        size = np.abs(weight)
        chosen = (size > NEGLIGIBLE * size.max(initial=0.0)).nonzero()[0]
        bounds = chosen.searchsorted(self._starts).tolist()
        pulls = [
            np.zeros((len(arm.places), n)) for arm, n in zip(self.arms, self._joints, strict=True)
        ]
        sums = CurvatureSums(*self._moved, self.size)
        for k, group in enumerate(self.groups):
            rows = chosen[bounds[k] : bounds[k + 1]]
            if not len(rows):
                continue
            own, at, local = weight[rows], self.at[rows], rows - group.rows.start
            hessian = group.curvatures(local, own)
            for index in group.arms:
                arm = self.arms[index]
                slopes = own[:, None] * arm.pulls[k].slopes[local]
                np.add.at(pulls[index], arm.at[rows], slopes)
            if group.moving:
                sums.add_moving(at, hessian)
            else:
                sums.add(at, self._reduced(hessian, group.arms, at, POSE_SIZE))
        for index, arm in enumerate(self.arms):
            active = np.flatnonzero(pulls[index].any(axis=1))
            if len(active):
                hessian, at = arm.curvatures(active, pulls[index][active]), arm.places[active]
                sums.add(at, self._reduced(hessian, (index,), at, self.size))
        return sums.total().take(self._entries)

    def _reduced(self, hessian: Array, arms: tuple[int, ...], at: Indices, own: int) -> Array:
        """T^T H T: by extended pose (rows, 6 + m, 6 + m), the joints of some arms following it.

        Args:
            hessian: by the first `own` entries of the extended pose and by the joints.
        """
        if not arms and own == self.size:
            return hessian
        reduced = np.zeros((len(at), self.size, self.size))
        reduced[:, :own, :own] = hessian[:, :own, :own]
        if not arms:
            return reduced
        follows = [self.arms[k].first.outputs["follow"][self.arms[k].position[at]] for k in arms]
        follow = follows[0] if len(arms) == 1 else np.concatenate(follows, axis=2)
        mixed = np.matmul(follow, hessian[:, own:, :own])
        reduced[:, :, :own] += mixed
        reduced[:, :own, :] += np.swapaxes(mixed, 1, 2)
        turned = np.swapaxes(follow, 1, 2)
        reduced += np.matmul(np.matmul(follow, hessian[:, own:, own:]), turned)
        return reduced


def row_numbers(
    constraints: Sequence[PlaceConstraint], functions: RowFunctions
) -> tuple[Array, ...]:
    """(rows, n) numbers of constraints of one family, in a tuple; an empty one without any."""
    numbers = np.array([functions.numbers(constraint) for constraint in constraints])
    return (numbers,) if numbers.shape[1] else ()
