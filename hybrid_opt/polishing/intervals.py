"""Limits at both ends of every interval of a path, by its waypoints and squared speeds.

An interval is a piece of the path with constant u''. Its two ends are two points, so that n
intervals have 2 n points, both of one interval in a row. What is limited at a point depends on the
waypoints, which are linear in pose and derivatives, and on the squared speeds at both ends of the
interval: u'' = (w_end - w_begin) n / 2, u'^2 = w.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from hybrid_opt.polishing.cell import PolishFunctions
from hybrid_opt.polishing.robust import ROBUST_ROWS, RobustForces
from symbolic.array import Array
from symbolic.path.spline import path_basis
from symbolic.records.cell import Workcell
from symbolic.records.task import extended_waypoints
from symbolic.smooth.driven import (
    DRIVEN_FIRST,
    DRIVEN_SECOND,
    driven_layout,
    planned_branches,
)
from symbolic.smooth.samples import held_name

GRASP_ROWS = 2
"""Forces that a program finds, those of both robots."""


@dataclass(frozen=True)
class RowKinds:
    """Inequalities of one point, mix . quantities <= bound, as (k, ...) arrays.

    Attributes:
        mix: (k, quantities) coefficients.
        is_force: (k,) whether the bound is the force limit; it is 1 otherwise.
        where, weight: (k, terms) the coefficients that are not zero.
    """

    mix: Array
    is_force: NDArray[np.bool_]
    where: NDArray[np.intp]
    weight: Array

    @classmethod
    def of(cls, workcell: Workcell, robust: int = 0) -> RowKinds:
        """Rows of a workcell: both signs where a quantity has one, all branches of the forces.

        Args:
            robust: further forces behind the quantities, each with a row of its own, as both of a
                program have.
        """
        layout = driven_layout(workcell)
        eye = np.eye(layout.size)
        forces = planned_branches(workcell)
        further = robust + (GRASP_ROWS if layout.by_program else 0)
        blocks = [
            eye[layout.block("speed")],
            eye[layout.block("acceleration")],
            -eye[layout.block("acceleration")],
            eye[layout.block("cone")],
            eye[layout.block("torque")],
            -eye[layout.block("torque")],
            eye[layout.block("pressure")],
            forces.reshape(-1, layout.size),
        ]
        planned = np.concatenate(blocks)
        mix = block_diag(planned, np.eye(further))
        is_force = np.arange(len(mix)) >= len(planned) - forces.shape[0] * forces.shape[1]
        terms = int(np.count_nonzero(mix, axis=1).max())
        where = np.argsort(mix == 0.0, axis=1, kind="stable")[:, :terms]
        return cls(mix, is_force, where, np.take_along_axis(mix, where, axis=1))

    def slopes(self, slope: Array, point: NDArray[np.intp], kind: NDArray[np.intp]) -> Array:
        """(rows, ...) of some inequalities at some points, from those of the quantities
        (points, quantities, ...)."""
        terms = zip(self.where.T, self.weight.T, strict=True)
        return sum(
            (slope[point, where[kind]] * weight[kind, None] for where, weight in terms),
            start=np.zeros((len(point), slope.shape[2])),
        )


class IntervalGrid:
    """What all paths of a workcell share.

    Attributes:
        workcell: the cell.
        intervals: pieces of constant u''.
        sample: (points,) grid point of each point.
        moving: entries of the extended pose and its two derivatives, 3 (6 + m).
        carry_over: (points, moving, n_path) from the path's variables to them.
        kinds: the inequalities of a point.
        robust: robust forces, None where planned ones are limited.
        layout: of the quantities.
        load: place of the load among them.
    """

    def __init__(self, workcell: Workcell, intervals: int, robust: bool = False) -> None:
        self.workcell, self.intervals = workcell, intervals
        task = workcell.task
        basis = path_basis(len(task.waypoints), np.linspace(0.0, 1.0, intervals + 1))
        self.sample = (np.arange(intervals)[:, None] + np.array([0, 1])).reshape(-1)
        self._bases = (basis.position, basis.first, basis.second)
        rows, columns = task.free_entries
        self.pose, self.moving = task.extended_size, 3 * task.extended_size
        self.carry_over = np.zeros((len(self.sample), self.moving, task.n_path))
        for k, basis_of in enumerate(self._bases):
            at = (k * self.pose + columns, np.arange(task.n_path))
            self.carry_over[:, at[0], at[1]] = basis_of[self.sample][:, rows]
        self.robust = RobustForces(workcell, self.pose) if robust else None
        self.kinds = RowKinds.of(workcell, 0 if self.robust is None else ROBUST_ROWS)
        self.layout = driven_layout(workcell)
        self.load = self.layout.block("load")

    def by_path(self, slope: Array, points: NDArray[np.intp]) -> Array:
        """(rows, n_path) slopes by the path's variables of slopes (rows, moving) at points."""
        rows, columns = self.workcell.task.free_entries
        at = self.sample[points]
        return sum(
            (
                basis[at][:, rows] * slope[:, k * self.pose + columns]
                for k, basis in enumerate(self._bases)
            ),
            start=np.zeros((len(points), len(rows))),
        )

    def moved(self, step: Array) -> Array:
        """(points, moving) how a step (n_path,) of the path's variables moves the points."""
        return np.asarray(self.carry_over @ step)

    def path(self, x: Array) -> tuple[Array, Array, Array]:
        """Extended pose and both derivatives (intervals + 1, 6 + m) of a decision vector."""
        waypoints = extended_waypoints(self.workcell.task, x)
        first, second, third = (np.ascontiguousarray(b @ waypoints) for b in self._bases)
        return first, second, third


@dataclass(frozen=True)
class IntervalValues:
    """The limited quantities of one driven path with their derivatives.

    Attributes:
        grid: what the path shares with others.
        value: (points, quantities), robust forces or those of a program behind them.
        slope: (points, quantities, moving + 2) by the extended pose and its derivatives, u'' and
            u'^2, the joints following.
    """

    grid: IntervalGrid
    value: Array
    slope: Array
    _inputs: tuple[Array, ...]
    _full: Array
    _follow: tuple[Array, Array]
    _pull: tuple[Array, Array]
    _functions: PolishFunctions
    _held: Mapping[str, Array] | None

    @classmethod
    def at(
        cls,
        grid: IntervalGrid,
        functions: PolishFunctions,
        x: Array,
        squared: Array,
        near: tuple[Array, Array],
    ) -> IntervalValues:
        """Evaluate.

        Args:
            x: (n_var,) decision vector.
            squared: (intervals + 1,) u'^2 at the grid points.
            near: joints of both arms (intervals + 1, n) near those that hold the box.
        """
        path, s = grid.path(x), grid.sample
        held = [functions.closure(arm, "first").batch(path[0], near[arm]) for arm in (0, 1)]
        a = np.repeat(np.diff(squared) * grid.intervals / 2.0, 2)
        inputs = (*(part[s] for part in path), *(found["q"][s] for found in held), a, squared[s])
        out = functions.built[DRIVEN_FIRST].batch(*inputs)
        full = out["slope"]
        follow = tuple(found["follow"][s] for found in held)
        slope, value = _followed(grid, full, follow), out["value"]
        if grid.robust is not None:
            force, by_motion = grid.robust.at(inputs[:3], a, squared[s])
            value = np.hstack([value, force])
            slope = np.concatenate([slope, by_motion], axis=1)
        pressed = None
        if grid.layout.by_program:
            pressed = functions.built[held_name("first")].batch(value[:, grid.load])
            value = np.hstack([value, pressed["normal"]])
            slope = np.concatenate([slope, _by_load(pressed, slope[:, grid.load])], axis=1)
        pull = tuple(found["pull"][s] for found in held)
        return cls(
            grid,
            value,
            slope,
            inputs,
            full,
            (follow[0], follow[1]),
            (pull[0], pull[1]),
            functions,
            pressed,
        )

    def at_rest(self, force: float) -> tuple[Array, Array]:
        """Shares (rows,) of what standing still uses at every interval's beginning: of the patches,
        or of a force limit [N] where pads press evenly; and their slopes (rows, moving) by the
        extended pose."""
        begins = [values[::2] for values in self._inputs]
        still, grid = np.zeros(len(begins[-1])), self.grid
        out = self._functions.built[DRIVEN_FIRST].batch(*begins[:-2], still, still)
        follow = tuple(along[::2] for along in self._follow)
        paper, by_program = grid.workcell.task.allocation == "paper", grid.layout.by_program
        block = grid.layout.block("pressure" if paper else "load" if by_program else "force")
        value, slope = out["value"][:, block], out["slope"][:, block]
        slope = _followed(grid, slope, follow)[:, :, : grid.moving]
        if by_program:
            pressed = self._functions.built[held_name("first")].batch(value)
            value, slope = pressed["normal"], _by_load(pressed, slope)
        whole = 1.0 if paper else force
        return value.reshape(-1) / whole, slope.reshape(-1, grid.moving) / whole

    def rows(self) -> Array:
        """(points, kinds) mix . quantities of every inequality."""
        return self.value @ self.grid.kinds.mix.T

    def curvature(self, weight: Array) -> tuple[NDArray[np.intp], Array]:
        """Second derivatives of weight . value.

        Args:
            weight: (points, quantities and further forces); robust ones bend as planned ones do.

        Returns:
            The points (m,) with any weight, and (m, moving + 2, moving + 2) of each.
        """
        if self.grid.robust is not None:
            weight = self.grid.robust.as_planned(weight, self.value)
        pressing = np.zeros((len(weight), 0))
        if self._held is not None:
            weight, pressing = np.hsplit(weight, [self.grid.layout.size])
            weight = weight.copy()
            weight[:, self.grid.load] += np.einsum("prl,pr->pl", self._held["slope"], pressing)
        at = np.flatnonzero(np.abs(weight).max(axis=1) > 0.0)
        n, variables = len(at), self.grid.layout.variables
        pose, moving = self.grid.pose, self.grid.moving
        local = moving + 2
        spread = np.zeros((n, local, variables))
        spread[:, np.arange(moving), np.arange(moving)] = 1.0
        spread[:, [moving, moving + 1], [variables - 2, variables - 1]] = 1.0
        start = moving
        for along in self._follow:
            stop = start + along.shape[2]
            spread[:, :pose, start:stop] = along[at]
            start = stop
        repeated = [np.repeat(values[at], local, axis=0) for values in self._inputs]
        change = (
            self._functions.built[DRIVEN_SECOND]
            .batch(*repeated, np.repeat(weight[at], local, axis=0), spread.reshape(-1, variables))[
                "change"
            ]
            .reshape(n, local, variables)
        )
        total = change @ np.swapaxes(spread, 1, 2)
        # How the joints' own curvature along the path adds to it, see `symbolic.smooth.places`.
        slope = np.einsum("pk,pkv->pv", weight[at], self._full[at])
        start = moving
        for arm, along in enumerate(self._follow):
            n_joints = along.shape[2]
            by_joints = slope[:, start : start + n_joints]
            nu = np.matmul(self._pull[arm][at], by_joints[:, :, None])[:, :, 0]
            closed = self._functions.closure(arm, "second").batch(
                self._inputs[0][at], self._inputs[3 + arm][at], nu
            )["hessian"]
            follow = np.concatenate([np.tile(np.eye(pose), (n, 1, 1)), along[at]], axis=2)
            total[:, :pose, :pose] += follow @ closed @ np.swapaxes(follow, 1, 2)
            start += n_joints
        if self._held is not None:
            second = self._functions.built[held_name("second")]
            bent = second.batch(self._held["state"][at], pressing[at])["curvature"]
            by_motion = self.slope[at][:, self.grid.load]
            total += np.swapaxes(by_motion, 1, 2) @ bent @ by_motion
        return at, (total + np.swapaxes(total, 1, 2)) / 2.0


def _by_load(pressed: Mapping[str, Array], slope: Array) -> Array:
    """Slopes (points, 2, ...) of a program's forces, from those of their load (points, 6, ...)."""
    return np.asarray(pressed["slope"] @ slope)


def _followed(grid: IntervalGrid, full: Array, follow: tuple[Array, ...]) -> Array:
    """Slopes by pose, derivatives, u'' and u'^2 where the joints follow the pose."""
    slope = np.concatenate([full[:, :, : grid.moving], full[:, :, -2:]], axis=2)
    start = grid.moving
    for along in follow:
        n = along.shape[2]
        slope[:, :, : grid.pose] += full[:, :, start : start + n] @ np.swapaxes(along, 1, 2)
        start += n
    return slope
