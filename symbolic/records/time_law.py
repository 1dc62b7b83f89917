"""The time laws that workcell files can name.

`symbolic.path.time_law` has the expressions of the laws whose times follow from the path.
"""

from __future__ import annotations

from dataclasses import dataclass

CONSTANT, RAMPED, OPTIMAL = "constant", "ramped", "optimal"


@dataclass(frozen=True)
class TimeLaw:
    """Rule that assigns times to the samples of a path.

    Attributes:
        name: name in workcell files.
        title: name in sentences.
        is_drivable: True if a solver finds the fastest timing of each path, from rest to rest
            within all limits and a force limit, which is then the last decision variable. False if
            the times follow from the path by an expression.
        has_differences: True if velocity and acceleration at a sample are finite differences of
            neighbouring samples.
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
"""Time laws by their name in `task.time_law` of a workcell file."""
