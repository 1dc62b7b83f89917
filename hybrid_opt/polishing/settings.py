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

DRIVABLE_ATTEMPTS = 10
"""At a drivable front. With seven, replicas of the rack differ by 1.1 % at 55 N, with ten by 0.4 %
(docs/measured/drivable-rack.md)."""


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
        rounds: steps of one point, unless it ends before.
        worth: gain of the later half of them, as a share of what is minimised, with which a point
            goes on for two turns more, and again.
        most_rounds: with such gains.
        turn: rounds of each start in a turn of a tournament of starts.
        rough: attempts at most that move the stated waypoints in tasks with more of them.
        refined: force limits at which points are moved by all waypoints after the others, in tasks
            with more than the stated ones.
        refining: rounds of each of them.
        members: gaps of the front, the widest first, that get a point in the end where a known path
            or one between both neighbours' wins one.
    """

    rounds: Number = 24
    worth: Small = 5e-4
    most_rounds: Number = 48
    turn: Number = 3
    rough: NumberOrNone = 3
    refined: NumberOrNone = 16
    refining: Number = 5
    members: NumberOrNone = 36

    def __post_init__(self) -> None:
        require_allowed(self, "polish drivable.")


@dataclass(frozen=True)
class PolishSettings:
    """What decides the results of a polish.

    Attributes:
        attempts: that one front may take at its points, ends and middle; probes and
            those that fill it between them come on top.
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


def usual_settings(time_law: str) -> PolishSettings:
    """The settings where nothing else is asked for."""
    return PolishSettings(attempts=DRIVABLE_ATTEMPTS) if time_law == "optimal" else PolishSettings()


def quick_settings() -> PolishSettings:
    """Settings of a small study: a third as many points from fewer attempts, and a shorter
    tournament, after which one replica of eight stayed in a slower basin."""
    return PolishSettings(
        attempts=2,
        fill=FillSettings(solved=16, members=16),
        drivable=DrivableSettings(turn=1, members=10),
    )
