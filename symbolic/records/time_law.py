"""The time laws that workcell files can name.

`symbolic.path.time_law` has the expressions of those whose times follow from the path.
"""

from __future__ import annotations

from dataclasses import dataclass

CONSTANT, RAMPED, OPTIMAL = "constant", "ramped", "optimal"


@dataclass(frozen=True)
class TimeLaw:
    """How a path is driven.

    Attributes:
        name: in workcell files.
        title: in words.
        is_drivable: True if every path gets the fastest timing from rest to rest within all limits
            and a force limit, which then is the last decision variable; else times follow from the
            path by an expression.
        has_differences: True if velocity and acceleration at a sample are finite differences of
            its neighbours.
    """

    name: str
    title: str
    is_drivable: bool = False
    has_differences: bool = False


TIME_LAWS = {
    law.name: law
    for law in (
        TimeLaw(CONSTANT, "constant speed", has_differences=True),
        TimeLaw(RAMPED, "ramped speed"),
        TimeLaw(OPTIMAL, "fastest within limits", is_drivable=True),
    )
}
"""Time laws by the name that `task.time_law` of a workcell file has."""
