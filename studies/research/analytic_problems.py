"""Analytic test problems with reference fronts computed here.

ZDT1 to ZDT3 (Zitzler, Deb and Thiele 2000), TNK (Tanaka et al. 1995), SRN (Srinivas and Deb 1994)
and OSY (Osyczka and Kundu 1995) are evaluated by pymoo. Its own reference fronts are fetched
from a network (TNK, OSY) or truncated (SRN), so all fronts come from the optimality conditions
of each problem instead, resampled at equal distances.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import moocore
import numpy as np
from pymoo.core.problem import Problem
from pymoo.problems.multi.osy import OSY
from pymoo.problems.multi.srn import SRN
from pymoo.problems.multi.tnk import TNK
from pymoo.problems.multi.zdt import ZDT, ZDT1, ZDT2, ZDT3

from hybrid_opt.indicators.metrics import normalise
from symbolic.array import Array
from symbolic.errors import SettingsError

_FRONT_POINTS = 1000
_DENSE = 200_001


class ShiftedZdt1(ZDT):  # type: ignore[misc]
    """ZDT1 with its optimum inside the bounds.

    x_i* for i >= 2 runs evenly from 0.2 to 0.5, and the distance function g uses |x_i - x_i*|.
    ZDT's optimum on the bounds favours algorithms that clamp to them.
    """

    def _evaluate(self, x: Array, out: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        optimum = np.linspace(0.2, 0.5, self.n_var - 1)
        first = x[:, 0]
        distance = 1.0 + 9.0 * np.abs(x[:, 1:] - optimum).mean(axis=1)
        out["F"] = np.column_stack([first, distance * (1.0 - np.sqrt(first / distance))])


@dataclass(frozen=True)
class AnalyticProblem:
    """A test problem and its true front.

    Attributes:
        name: as in `names()`.
        problem: for pymoo.
        front: (n, 2) reference front, evenly spaced.
        ideal, nadir: (2,) least and greatest value of each objective on the front; they
            normalise objectives for hypervolume and IGD.
    """

    name: str
    problem: Problem
    front: Array
    ideal: Array
    nadir: Array

    def normalise(self, objectives: Array) -> Array:
        """Map the front's range onto the unit square."""
        return normalise(objectives, self.ideal, self.nadir)


def names() -> tuple[str, ...]:
    """The problems that `make` knows."""
    return tuple(PROBLEMS)


def make(name: str) -> AnalyticProblem:
    """Build a test problem with its reference front.

    Raises:
        SettingsError: the name is unknown.
    """
    if name not in PROBLEMS:
        raise SettingsError(f"unknown test problem '{name}'; known are {', '.join(PROBLEMS)}")
    problem, curve = PROBLEMS[name]
    front = _evenly(curve())
    front.setflags(write=False)
    return AnalyticProblem(name, problem(), front, front.min(axis=0), front.max(axis=0))


def _evenly(curve: Array) -> Array:
    """Non-dominated part of a dense curve, resampled at equal arc lengths of its pieces."""
    front = moocore.filter_dominated(curve)
    front = front[np.argsort(front[:, 0], kind="stable")]
    step = np.linalg.norm(np.diff(front / np.ptp(front, axis=0), axis=0), axis=1)
    # A jump between two pieces of a disconnected front has no length of its own.
    step[step > 1e-3] = 0.0
    length = np.concatenate([[0.0], np.cumsum(step)])
    chosen = np.searchsorted(length, np.linspace(0.0, length[-1], _FRONT_POINTS))
    return np.asarray(front[np.minimum(chosen, len(front) - 1)])


def _zdt1_front() -> Array:
    # Quadratic spacing: the slope is unbounded at f1 = 0.
    f1 = np.linspace(0.0, 1.0, _DENSE) ** 2
    return np.column_stack([f1, 1.0 - np.sqrt(f1)])


def _zdt2_front() -> Array:
    f1 = np.linspace(0.0, 1.0, _DENSE)
    return np.column_stack([f1, 1.0 - f1**2])


def _zdt3_front() -> Array:
    f1 = np.linspace(0.0, 1.0, _DENSE) ** 2
    return np.column_stack([f1, 1.0 - np.sqrt(f1) - f1 * np.sin(10.0 * np.pi * f1)])


def _tnk_front() -> Array:
    """The curved constraint is active; the circular one cuts pieces out."""
    angle = np.linspace(0.0, 0.5 * np.pi, _DENSE)
    # arctan(x1 / x2) is the angle from the x2 axis.
    radius = np.sqrt(1.0 + 0.1 * np.cos(16.0 * angle))
    points = np.column_stack([radius * np.sin(angle), radius * np.cos(angle)])
    return np.asarray(points[((points - 0.5) ** 2).sum(axis=1) <= 0.5])


def _srn_front() -> Array:
    """From the point nearest to (2, 1) on the line, up x1 = -2.5, then along the circle."""
    line_x2 = np.linspace(2.5, 3.7, _DENSE)
    line = np.column_stack([3.0 * line_x2 - 10.0, line_x2])
    column_x2 = np.linspace(2.5, np.sqrt(225.0 - 2.5**2), _DENSE)
    column = np.column_stack([np.full(_DENSE, -2.5), column_x2])
    angle = np.linspace(np.arccos(-2.5 / 15.0), np.pi, _DENSE)
    circle = 15.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    x1, x2 = np.concatenate([line, column, circle]).T
    return np.column_stack([2.0 + (x1 - 2.0) ** 2 + (x2 - 1.0) ** 2, 9.0 * x1 - (x2 - 1.0) ** 2])


def _osy_front() -> Array:
    """Five pieces with x4 = x6 = 0 (Deb 2001, Multi-objective optimization, section 8.3.3)."""
    s = np.linspace(0.0, 1.0, _DENSE // 5)
    one, zero = np.ones_like(s), np.zeros_like(s)
    bend = np.linspace(37.0 / 9.0 - 1.0 / 18.0, 5.0, len(s))
    pieces = (
        (5.0 * one, one, 1.0 + 4.0 * s, 5.0 * one),
        (5.0 * one, one, 1.0 + 4.0 * s, one),
        (bend, (bend - 2.0) / 3.0, one, one),
        (zero, 2.0 * one, 1.0 + (np.sqrt(3.0) + 1.0) * s, one),
        (s, 2.0 - s, one, one),
    )
    x1, x2, x3, x5 = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    x = np.column_stack([x1, x2, x3, zero.repeat(len(pieces)), x5, zero.repeat(len(pieces))])
    x4 = x[:, 3]
    f1 = -(
        25.0 * (x1 - 2.0) ** 2
        + (x2 - 2.0) ** 2
        + (x3 - 1.0) ** 2
        + (x4 - 4.0) ** 2
        + (x5 - 1.0) ** 2
    )
    return np.column_stack([f1, (x**2).sum(axis=1)])


PROBLEMS: dict[str, tuple[Callable[[], Problem], Callable[[], Array]]] = {
    "zdt1": (ZDT1, _zdt1_front),
    "zdt2": (ZDT2, _zdt2_front),
    "zdt3": (ZDT3, _zdt3_front),
    "tnk": (TNK, _tnk_front),
    "srn": (SRN, _srn_front),
    "osy": (OSY, _osy_front),
    "shifted-zdt1": (ShiftedZdt1, _zdt1_front),
}
