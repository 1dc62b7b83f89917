"""Settings of a polish. All other numbers are constants beside their use;
docs/explanation/polish.md explains the polish.

Widths along the path are in the path parameter (the whole path is 1), distances in metres, steps in
half ranges of the decision variables. None of them changes its meaning with the number of samples.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

from symbolic.array import Range, require_allowed

SolverName = Literal["dense", "ipopt"]
SOLVERS: tuple[SolverName, ...] = get_args(SolverName)

Number = Annotated[int, Range(1, 10**6)]
NumberOrNone = Annotated[int, Range(0, 10**6)]
Small = Annotated[float, Range(1e-12, 1.0)]

DRIVABLE_ATTEMPTS = 14
"""Number of force limits on a drivable front."""

QUICK_ATTEMPTS, QUICK_DRIVABLE_ATTEMPTS = 2, 6
"""Number of attempts, and of force limits, in a small study."""


@dataclass(frozen=True)
class ProbeSettings:
    """Settings of the search for basins far from the front (`hybrid_opt.polishing.starts`).

    Attributes:
        starts: number of starts at the ends of the front. Both ends share them, unless one end is
            the mirror image of the other.
        middle_starts: number of starts at the balanced middle of the front.
        rounds: trust-region iterations of each short solve.
    """

    starts: NumberOrNone = 8
    middle_starts: NumberOrNone = 10
    rounds: Number = 2

    def __post_init__(self) -> None:
        require_allowed(self, "polish probe.")


@dataclass(frozen=True)
class FillSettings:
    """Settings of the filling of a front between its ends (`hybrid_opt.polishing.force_front`).

    Attributes:
        solved: number of points up to which gaps are filled by solves.
        members: wanted number of points of the front. Those beyond `solved` lie on chords, straight
            lines between neighbours' decision vectors.
        attempts: largest number of attempts in gaps for each of `PolishSettings.attempts`; twice as
            many if the front stays short.
    """

    solved: NumberOrNone = 32
    members: NumberOrNone = 56
    attempts: NumberOrNone = 5

    def __post_init__(self) -> None:
        require_allowed(self, "polish fill.")


@dataclass(frozen=True)
class DrivableSettings:
    """Settings of the polish of drivable cells (`hybrid_opt.polishing.drive_front`). Their carries
    are timed from rest to rest within all limits.

    Attributes:
        first_rounds: largest number of trust-region iterations for the first path.
        rounds: trust-region iterations at each force limit.
        members: number of gaps, the widest first, that get a point in the end, if a path between
            both neighbours improves the front.
    """

    first_rounds: Number = 16
    rounds: Number = 6
    members: NumberOrNone = 36

    def __post_init__(self) -> None:
        require_allowed(self, "polish drivable.")


@dataclass(frozen=True)
class PolishSettings:
    """All settings that decide the results of a polish.

    Attributes:
        attempts: number of attempts at points, ends and middle of a front; probes (short solves far
            from the front) and attempts in gaps are extra. For drivable carries the number of force
            limits of the sweep.
        solver: solver of the programs that minimise both peak forces: the dense
            interior-point method of `hybrid_opt.polishing.solvers.dense`, or IPOPT.
        rounds: largest number of trust-region iterations at one point.
        max_iterations: largest number of solver iterations per program.
        clearance: distance to obstacles beyond the tolerance [m]; it allows certification between
            samples.
        probe: settings of the search for basins far from the front.
        fill: settings of the filling of the front between its ends.
        drivable: settings of the polish of drivable cells, whose carries are timed from rest to
            rest within all limits.
    """

    attempts: NumberOrNone = 8
    solver: SolverName = "dense"
    rounds: Number = 7
    max_iterations: Number = 20
    clearance: Small = 8e-4
    probe: ProbeSettings = field(default_factory=ProbeSettings)
    fill: FillSettings = field(default_factory=FillSettings)
    drivable: DrivableSettings = field(default_factory=DrivableSettings)

    def __post_init__(self) -> None:
        require_allowed(self, "polish ")


def default_settings(is_drivable: bool) -> PolishSettings:
    """Return the settings of a full study.

    Args:
        is_drivable: True for a drivable cell: its carries are timed from rest to rest within all
            limits.
    """
    return PolishSettings(attempts=DRIVABLE_ATTEMPTS) if is_drivable else PolishSettings()


def quick_settings(is_drivable: bool) -> PolishSettings:
    """Return the settings of a small study: a third as many points from fewer attempts.

    Args:
        is_drivable: True for a drivable cell: its carries are timed from rest to rest within all
            limits.
    """
    if is_drivable:
        return PolishSettings(
            attempts=QUICK_DRIVABLE_ATTEMPTS, drivable=DrivableSettings(members=10)
        )
    return PolishSettings(attempts=QUICK_ATTEMPTS, fill=FillSettings(solved=16, members=16))
