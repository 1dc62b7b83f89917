"""Bounds of the decision variables that solutions lie on.

A bound that an optimum lies on may have decided it: wider ones might allow better carries. One that
none lies on decided nothing but where the search looked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from symbolic.array import Array
from symbolic.records import Task
from symbolic.records.task import variable_names

ON_BOUND = 1e-3
"""Nearer to a bound than this share of the variable's range counts as on it: an interior-point
method stops a little inside."""


@dataclass(frozen=True)
class BindingBound:
    """A bound that solutions lie on.

    Attributes:
        variable: its name, as 'waypoint 2, yaw' or 'force limit'.
        side: which of its bounds.
        value: of the bound [m, rad, N].
        solutions: how many lie on it.
    """

    variable: str
    side: Literal["lower", "upper"]
    value: float
    solutions: int

    def __str__(self) -> str:
        return f"{self.side} bound of {self.variable}, {self.value:g}"


def binding_bounds(task: Task, x: Array) -> tuple[BindingBound, ...]:
    """The bounds that decision vectors (k, n_var) lie on, in the order of the variables.

    A variable whose bounds are equal has no range and is left out. So are the bounds of the force
    limit: they are where a front ends, the force at rest and the robots' own limit.
    """
    x = np.asarray(x, dtype=float).reshape(-1, task.n_var)
    width = task.upper - task.lower
    found = []
    for k, name in enumerate(variable_names(task)[: task.n_path]):
        if width[k] == 0.0:
            continue
        near = ON_BOUND * width[k]
        lower = int((x[:, k] <= task.lower[k] + near).sum())
        upper = int((x[:, k] >= task.upper[k] - near).sum())
        if lower:
            found.append(BindingBound(name, "lower", float(task.lower[k]), lower))
        if upper:
            found.append(BindingBound(name, "upper", float(task.upper[k]), upper))
    return tuple(found)
