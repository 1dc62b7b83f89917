"""The two kinds of constraints that the smooth problem is assembled from, with their derivatives.

What samples ask (forces, pressure) and what has to be kept at single places of the path
(clearances, joints) are evaluated by maps over small functions, and their derivatives by the chain
rule with the path's constant basis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import casadi as ca
import numpy as np

from symbolic.physics.path import waypoint_matrix
from symbolic.smooth.forces import SampleBlock
from symbolic.smooth.rows import RowFunctions, RowKind
from symbolic.workcell.records import Workcell

PlaceRow = tuple[RowKind, int]
"""What is kept, and at which place."""


class SampleValues:
    """Two values of each of some samples, in the order of the blocks, from the decision vector x:
    F_n and F_t, or what is left of both patches."""

    def __init__(
        self,
        blocks: tuple[SampleBlock, ...],
        functions: Mapping[str, ca.Function],
        quantity: str,
        x: ca.MX,
    ) -> None:
        self._blocks, self._functions, self._quantity, self._x = blocks, functions, quantity, x
        order = [block.samples.ravel() for block in blocks]
        self.order = np.concatenate([np.empty(0, dtype=np.int64), *order])

    def chosen(self, rows: Sequence[tuple[int, int]]) -> ca.DM:
        """Sparse (rows, 2 samples) selection of one of the two values of a sample by each row."""
        column = {int(sample): k for k, sample in enumerate(self.order)}
        columns = [2 * column[sample] + which for which, sample in rows]
        return ca.DM.triplet(
            list(range(len(rows))), columns, ca.DM.ones(len(rows)), len(rows), 2 * len(self.order)
        )

    def _call(self, block: SampleBlock, what: str, *further: ca.MX) -> ca.MX:
        calls = len(block.samples)
        basis = ca.DM(np.hstack([window.T for window in block.basis]))
        function = self._functions[f"{self._quantity}_{block.name}_{what}"]
        return function.map(calls)(ca.repmat(self._x, 1, calls), basis, *further)

    def values(self) -> ca.MX:
        """(2 samples,), both values of each sample."""
        return ca.vertcat(
            ca.MX(0, 1), *[ca.vec(self._call(block, "value")) for block in self._blocks]
        )

    def jacobian(self) -> ca.MX:
        """(2 samples, n_var)."""
        none = ca.MX(self._x.shape[0], 0)
        return ca.horzcat(none, *[self._call(block, "gradient") for block in self._blocks]).T

    def hessian(self, weight: ca.MX) -> ca.MX:
        """(n_var, n_var) of weight . values."""
        n = self._x.shape[0]
        total, start = ca.MX(ca.DM.zeros(n, n)), 0
        for block in self._blocks:
            calls, served = block.samples.shape
            own = ca.reshape(weight[start : start + 2 * calls * served], 2 * served, calls)
            start += 2 * calls * served
            each = self._call(block, "hessian", own)
            total += ca.reshape(ca.sum2(ca.reshape(each, n * n, calls)), n, n)
        return total


class PlaceValues:
    """Rows at places of the path, from the decision vector x."""

    def __init__(
        self,
        workcell: Workcell,
        solve: tuple[ca.Function, ca.Function],
        rows: RowFunctions,
        place_rows: tuple[PlaceRow, ...],
        n_places: int,
        x: ca.MX,
        p: ca.MX,
    ) -> None:
        task = workcell.task
        n_waypoints = len(task.waypoints)
        self._rows, self._place_rows, self._n = rows, place_rows, x.shape[0]
        # Alike rows are evaluated by one map; moving ones come last.
        self._groups: dict[RowKind, list[int]] = {}
        for row in sorted(range(len(place_rows)), key=lambda row: rows.moving(place_rows[row][0])):
            self._groups.setdefault(place_rows[row][0], []).append(row)
        self._order = [row for members in self._groups.values() for row in members]
        if not place_rows:
            return
        size = n_places * n_waypoints
        start = 2 * size
        waypoints = waypoint_matrix(task, x)
        self._path, self._free = [], []
        for basis in (p[:size], p[size:start]):
            columns = ca.reshape(basis, n_waypoints, n_places)
            self._path.append(ca.mtimes(waypoints, columns))
            self._free.append(columns[list(task.free_indices), :])
        self._q = []
        for arm in (0, 1):
            reference = ca.reshape(p[start : start + 6 * n_places], 6, n_places)
            start += 6 * n_places
            needed = sorted({at for kind, at in place_rows if arm in rows.arms(kind)})
            joints = ca.MX(6, n_places)
            if needed:
                inputs = (self._path[0][:, needed], reference[:, needed])
                joints[:, needed] = solve[arm].map(len(needed))(*inputs)
            self._q.append(ca.densify(joints))
        self._inputs = {
            kind: self._inputs_of(kind, members) for kind, members in self._groups.items()
        }
        at = [place_rows[row][1] for row in self._order]
        self._bases = [basis[:, at] for basis in self._free]

    def _inputs_of(self, kind: RowKind, members: list[int]) -> list[ca.MX]:
        """Pose, rate and joints of a group's rows; none where they do not matter."""
        at = [self._place_rows[row][1] for row in members]
        arms, none = self._rows.arms(kind), ca.MX(6, len(at))
        rate = self._path[1][:, at] if self._rows.moving(kind) else none
        joints = [self._q[arm][:, at] if arm in arms else none for arm in (0, 1)]
        return [self._path[0][:, at], rate, *joints]

    def _call(
        self, make: Callable[[RowKind], ca.Function], weight: ca.MX | None = None
    ) -> list[ca.MX]:
        """The function of every group, mapped over its rows."""
        results, start = [], 0
        for kind, members in self._groups.items():
            at = [self._place_rows[row][1] for row in members]
            inputs = list(self._inputs[kind])
            if weight is not None:
                inputs.append(weight[self._order[start : start + len(at)]].T)
            start += len(at)
            results.append(make(kind).map(len(at))(*inputs))
        return results

    def _restored(self, grouped: ca.MX) -> ca.MX:
        """Rows from the groups' order back into their own."""
        position = np.argsort(self._order)
        return grouped[[int(k) for k in position], :]

    def values(self) -> ca.MX:
        """(rows,), in the order they were asked for."""
        if not self._place_rows:
            return ca.MX(0, 1)
        return self._restored(ca.horzcat(*self._call(self._rows.value)).T)

    def jacobian(self) -> ca.MX:
        """(rows, n_var), likewise."""
        if not self._place_rows:
            return ca.MX(0, self._n)
        gradients = self._call(self._rows.gradient)
        total = self._by_waypoint([each[:6, :] for each in gradients], 0)
        moving = [each[6:, :] for each in gradients if each.shape[0] == 12]
        if moving:
            still = len(self._order) - sum(each.shape[1] for each in moving)
            total += self._by_waypoint([ca.MX(6, still), *moving], 1)
        return self._restored(total.T)

    def _by_waypoint(self, gradients: list[ca.MX], part: int) -> ca.MX:
        """Gradients (6, rows) with respect to the pose or the rate as those (n_var, rows) with
        respect to the free waypoints, in the groups' order."""
        each, basis = ca.horzcat(*gradients), self._bases[part]
        return ca.vertcat(*[each * ca.repmat(basis[k, :], 6, 1) for k in range(basis.shape[0])])

    def hessian(self, weight: ca.MX) -> ca.MX:
        """(n_var, n_var) of weight . values."""
        if not self._place_rows:
            return ca.MX(ca.DM.zeros(self._n, self._n))
        each = self._call(self._rows.hessian, weight)
        sizes = [hessian.shape[0] for hessian in each]
        flat = [
            ca.reshape(hessian, size * size, hessian.shape[1] // size)
            for hessian, size in zip(each, sizes, strict=True)
        ]
        total = ca.MX(ca.DM.zeros(self._n, self._n))
        for first, second in ((0, 0), (0, 1), (1, 0), (1, 1)):
            chosen = [
                _block(hessian, size, first, second)
                for hessian, size in zip(flat, sizes, strict=True)
                if size > 6 * max(first, second)
            ]
            if chosen:
                total += self._curvature(ca.horzcat(*chosen), first, second)
        return total

    def _curvature(self, flat: ca.MX, first: int, second: int) -> ca.MX:
        """Second derivatives (36, rows) by pose or rate, of the last rows in the groups' order, as
        one (n_var, n_var) of their sum by the free waypoints."""
        rows = flat.shape[1]
        left, right = (self._bases[part][:, -rows:] for part in (first, second))
        free = range(left.shape[0])
        blocks = [
            [ca.reshape(ca.mtimes(flat, (left[k, :] * right[m, :]).T), 6, 6) for m in free]
            for k in free
        ]
        return ca.vertcat(*[ca.horzcat(*row) for row in blocks])


def _block(flat: ca.MX, size: int, first: int, second: int) -> ca.MX:
    """The (6, 6) blocks (36, n) of square matrices (size^2, n), both stacked by column."""
    if size == 6:
        return flat
    columns = range(6 * second, 6 * second + 6)
    return flat[[6 * first + i + size * j for j in columns for i in range(6)], :]
