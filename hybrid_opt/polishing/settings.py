"""What a user may decide of a polish. Everything else is a constant beside its use; docs/polish.md
explains it.

Wherever widths along the path are given, they are in its parameter (the whole path is 1), distances
in metres, steps in halves of the decision variables' ranges: none of them changes its meaning with
the samples.
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
"""Force limits at a drivable front."""

QUICK_ATTEMPTS, QUICK_DRIVABLE_ATTEMPTS = 2, 6
"""The same of a small study: attempts, and force limits."""


@dataclass(frozen=True)
class ProbeSettings:
    """How basins far from the front are looked for, see `hybrid_opt.polishing.starts`.

    Attributes:
        starts: of an end of the front; both ends share them unless one is the other's mirror image.
        middle_starts: of its balanced middle.
        rounds: of each short solve.
    """

    starts: NumberOrNone = 8
    middle_starts: NumberOrNone = 10
    rounds: Number = 2

    def __post_init__(self) -> None:
        require_allowed(self, "polish probe.")


@dataclass(frozen=True)
class FillSettings:
    """How a front is filled once its ends are known, see `hybrid_opt.polishing.force_front`.

    Attributes:
        solved: points up to which gaps are filled by solves.
        members: points that the front is to have; beyond those, the rest lies on chords between
            neighbours.
        attempts: at most, for each of `PolishSettings.attempts`; twice as many where the front
            stays short.
    """

    solved: NumberOrNone = 32
    members: NumberOrNone = 56
    attempts: NumberOrNone = 5

    def __post_init__(self) -> None:
        require_allowed(self, "polish fill.")


@dataclass(frozen=True)
class DrivableSettings:
    """The polish under the time law 'optimal', see `hybrid_opt.polishing.drive_front`.

    Attributes:
        first_rounds: steps of the first path, unless it ends before.
        rounds: of each force limit's.
        members: gaps of the front, the widest first, that get a point in the end where a path
            between both neighbours' wins one.
    """

    first_rounds: Number = 16
    rounds: Number = 6
    members: NumberOrNone = 36

    def __post_init__(self) -> None:
        require_allowed(self, "polish drivable.")


@dataclass(frozen=True)
class PolishSettings:
    """What decides the results of a polish.

    Attributes:
        attempts: that one front may take at its points, ends and middle; probes and
            those that fill it between them come on top. Of drivable carries the force limits of the
            sweep.
        solver: of the programs of both peak forces: the dense interior-point method of
            `hybrid_opt.polishing.solvers.dense`, or IPOPT.
        rounds: of one point at most; see `hybrid_opt.polishing.point`.
        max_iterations: of the solver in one round; see `PATIENCE` of `solvers.base`.
        clearance: distance kept from obstacles [m]; lets the motion between samples be certified.
        probe, fill, drivable: the parts' own.
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


def default_settings(time_law: str) -> PolishSettings:
    """The settings where nothing else is asked for."""
    return PolishSettings(attempts=DRIVABLE_ATTEMPTS) if time_law == "optimal" else PolishSettings()


def quick_settings(time_law: str) -> PolishSettings:
    """Settings of a small study: a third as many points from fewer attempts."""
    if time_law == "optimal":
        return PolishSettings(
            attempts=QUICK_DRIVABLE_ATTEMPTS, drivable=DrivableSettings(members=10)
        )
    return PolishSettings(attempts=QUICK_ATTEMPTS, fill=FillSettings(solved=16, members=16))
