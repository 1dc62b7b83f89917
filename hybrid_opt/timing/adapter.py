"""The one place that talks to toppra.

toppra logs its failures and returns None or NaN. Here a failure is a record with the reason and
the interval, and everything that comes back is checked.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from symbolic.array import Array

SPEED_CEILING = 1e4
"""Largest squared path speed that toppra's solver admits, in its scaled path coordinate."""


RESCALINGS = (1.0, 0.4, 2.5)
"""Factors on the path coordinate, tried in turn: toppra's linear programs use absolute tolerances
and now and then call a feasible interval infeasible."""


@dataclass(frozen=True)
class IntervalRows:
    """Linear limits on a path's timing: by interval i and row k, a u'' + b u'^2 <= bound.

    u'' is constant on an interval, u'^2 is that at the interval's beginning.

    Attributes:
        a, b, bound: (intervals, k).
    """

    a: Array
    b: Array
    bound: Array


@dataclass(frozen=True)
class SolverFailure:
    """A failure of toppra: what it could not do, and the interval at which."""

    reason: str
    interval: int


def fastest_speed(rows: IntervalRows, grid: Array) -> Array | SolverFailure:
    """The fastest motion from rest to rest within linear limits.

    Args:
        rows: the limits.
        grid: (intervals + 1,) increasing path coordinate, scaled so that speeds are around one.

    Returns:
        (intervals + 1,) squared path speed at the grid points, zero at both ends, or a failure.
    """
    found: Array | SolverFailure = SolverFailure("not tried", 0)
    for factor in RESCALINGS:
        scaled = IntervalRows(rows.a / factor, rows.b / factor**2, rows.bound)
        found = _solve(scaled, factor * grid)
        if not isinstance(found, SolverFailure):
            return found / factor**2
    return found


def _solve(rows: IntervalRows, grid: Array) -> Array | SolverFailure:
    # Imported late: toppra pulls in plotting.
    from toppra.algorithm import TOPPRA
    from toppra.constraint import LinearConstraint
    from toppra.interpolator import AbstractGeometricPath

    class Line(AbstractGeometricPath):  # type: ignore[misc]
        """The path coordinate itself; the limits carry all geometry."""

        @property
        def dof(self) -> int:
            return 1

        @property
        def path_interval(self) -> Array:
            return grid[[0, -1]]

        def __call__(self, path_positions: Any, order: int = 0) -> Any:
            raise NotImplementedError

    class Rows(LinearConstraint):  # type: ignore[misc]
        """All limits as rows F w <= g with w = (u'', u'^2)."""

        def compute_constraint_params(self, *_: Any) -> tuple[Any, ...]:
            n = len(grid)
            f = np.zeros((n, rows.a.shape[1], 2))
            g = np.ones((n, rows.a.shape[1]))
            f[:-1, :, 0], f[:-1, :, 1], g[:-1] = rows.a, rows.b, rows.bound
            ceiling = np.tile([0.0, SPEED_CEILING], (n, 1))
            unit = np.tile([1.0, 0.0], (n, 1))
            return unit, unit[:, ::-1].copy(), np.zeros((n, 2)), f, g, None, ceiling

    with _quiet():
        algorithm = TOPPRA(
            [Rows()],
            Line(),
            gridpoints=grid,
            solver_wrapper="seidel",
            parametrizer="ParametrizeConstAccel",
        )
        _, speed, _, controllable = algorithm.compute_parameterization(0.0, 0.0, return_data=True)
    if np.isnan(controllable).any():
        interval = int(np.flatnonzero(np.isnan(controllable).any(axis=1))[-1])
        return SolverFailure("no speed at this place lets the path be finished", interval)
    if speed is None:
        return SolverFailure("the path cannot be started from rest", 0)
    if not np.isfinite(speed).all():
        interval = int(np.argmin(np.isfinite(speed)))
        return SolverFailure("the forward pass broke down", min(interval, len(grid) - 2))
    squared: Array = np.asarray(speed, dtype=float) ** 2
    if np.any(squared[:-1] + squared[1:] <= 0.0):
        interval = int(np.argmax(squared[:-1] + squared[1:] <= 0.0))
        return SolverFailure("the motion comes to a standstill", interval)
    return squared


@contextmanager
def _quiet() -> Iterator[None]:
    """toppra's log lines become statuses; nothing is printed."""
    logger = logging.getLogger("toppra")
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)
