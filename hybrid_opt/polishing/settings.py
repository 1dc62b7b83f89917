"""Everything that decides what a polish finds. docs/polish.md explains it.

Widths along the path are in its parameter (the whole path is 1), distances in metres, steps in
halves of the decision variables' ranges: none of them changes its meaning with the samples.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from symbolic.errors import SettingsError

Method = Literal["pascoletti-serafini", "epsilon"]
SolverName = Literal["ipopt", "dense"]


@dataclass(frozen=True)
class NearSettings:
    """When a constraint is near enough to enter a program at once, and where along the path.

    Attributes:
        body_distance: pairs with an arm's body nearer than this get a row at their lowest [m].
        measured_below: bounds lower than this are compared with FCL's distance [m].
        beside_clearance: a violated clearance also gets rows this far to either side.
        gap_distance, gap_stride: the payload's gaps below the distance [m] get a row in every such
            stretch: they are cheap, because they need no joints, and decide where the path may go.
        far_gap_distance, far_gap_stride: the same farther away, less densely.
        kink_distance: kinks of the payload's clearance lower than this get a row [m].
        beside_kink: around a kink without rows of a gap: they would hold the kink in its place.
        kink_window: around a kink, where its height is measured.
        joint_distance: joints nearer than this to a limit get a row [rad].
        reach_share, reach_stride: where |det J| is below this share of its median along the path,
            every such stretch gets a row: it bounds the reach, beyond which nothing is defined.
        edge, edge_stride: the same below this multiple of the least |det J|, more densely.
        lost: this far after the loss of an arm, and twice as far, there are rows, too.
        force_stride: distance of force rows: forces are smooth along the path.
        tie_stride: the same for a robot whose force only breaks ties.
        peak_share: local maxima of the force above this share of the highest get rows.
        branch_share: branches within this share of the ruling one get rows.
        pressure_share: shifts of the centre of pressure beyond this share of the patch do.
        beside_pressure: this far beside the farthest shift there are rows, too.
    """

    body_distance: float = 0.03
    measured_below: float = 0.02
    beside_clearance: float = 0.015
    gap_distance: float = 0.03
    gap_stride: float = 0.02
    far_gap_distance: float = 0.08
    far_gap_stride: float = 0.04
    kink_distance: float = 0.06
    beside_kink: float = 0.03
    kink_window: float = 0.04
    joint_distance: float = 0.05
    reach_share: float = 0.9
    reach_stride: float = 0.02
    edge: float = 1.1
    edge_stride: float = 0.005
    lost: float = 0.04
    force_stride: float = 0.02
    tie_stride: float = 0.06
    peak_share: float = 0.98
    branch_share: float = 0.02
    pressure_share: float = 0.7
    beside_pressure: float = 0.04


@dataclass(frozen=True)
class TrustSettings:
    """The box of trust: half its width, in halves of the decision variables' ranges.

    Attributes:
        first, least, largest: of the radius; below the least a point is left.
        halved: factor after a step that violates something that was asked for already.
        quartered: factor after a step that brought nothing, or no answer.
        doubled: factor after two steps in a row that the box stopped.
        inside: steps shorter than this share of the radius were not stopped by the box.
        parts: evenly spaced parts of a step that violates something, which are judged in its place,
            the longest first.
    """

    first: float = 1.0
    least: float = 1e-3
    largest: float = 2.0
    halved: float = 0.5
    quartered: float = 0.25
    doubled: float = 2.0
    inside: float = 0.9
    parts: int = 3


@dataclass(frozen=True)
class SolveSettings:
    """How one program is solved.

    Attributes:
        solver: IPOPT, or the dense interior-point method of `hybrid_opt.polishing.interior`.
        barrier: at the start. A search's point is near the solution but has no multipliers.
        wide_barrier: at the start of solves that look for other basins: it leads to the middle of
            what is feasible first.
        tolerance: of the optimality conditions, in the program's scaled rows and variables.
        feasible: violation of a scaled row at which an iterate counts as feasible.
        rounding: share of a step's duration by which the paper's time law is rounded where rotation
            takes over from translation: the least forces at the ends of a path lie in that kink.
        settling: units of the target's scale by which an optimum that keeps all that is asked for
            may be worse than the best candidate, which may keep less, and is taken in its place.
        patience: times the wanted number of iterations that a solve may take to become feasible:
            cut off wherever it stands, it ends in an obstacle more often than not.
    """

    solver: SolverName = "dense"
    barrier: float = 3e-4
    wide_barrier: float = 3e-2
    tolerance: float = 1e-6
    feasible: float = 1e-3
    rounding: float = 1e-3
    settling: float = 5e-4
    patience: int = 3


@dataclass(frozen=True)
class FrontSettings:
    """What a front's attempts go to.

    Attributes:
        own_share: of the attempts that go to points of the given front.
        progress: least gain of an attempt that counts as coming further, in units of the
            reference force.
        middle_stalls: attempts at the balanced middle in a row that came no further, after which
            it is left.
        small_radius: first box of trust of an attempt that goes on where the last came no further.
        least_gap: gaps of a drivable front narrower than this are left, in units of its extent.
        optimal: residual of stationarity below which a point that could not be improved counts as
            optimal.
    """

    own_share: float = 1.0 / 8.0
    progress: float = 2e-5
    middle_stalls: int = 1
    small_radius: float = 0.1
    least_gap: float = 0.02
    optimal: float = 1e-3


@dataclass(frozen=True)
class KickSettings:
    """How another start is looked for, see `hybrid_opt.polishing.kick`.

    Attributes:
        candidates: that are drawn.
        share: of the decision variables that are drawn anew.
        distance: least change of the one that changes most, as a share of its range.
    """

    candidates: int = 1000
    share: float = 0.15
    distance: float = 0.3


@dataclass(frozen=True)
class ProbeSettings:
    """How basins far from the front are looked for, see `hybrid_opt.polishing.probing`.

    Attributes:
        starts: of an end of the front; both ends share them unless one is the other's mirror image.
        middle_starts: of its balanced middle.
        rounds: of each short solve.
        candidates: random ones among which feasible starts are looked for.
    """

    starts: int = 8
    middle_starts: int = 10
    rounds: int = 2
    candidates: int = 1000


@dataclass(frozen=True)
class FillSettings:
    """How a front is filled once its ends are known, see `hybrid_opt.polishing.filling`.

    Attributes:
        solved: points up to which gaps are filled by solves.
        members: points that the front is to have; beyond those, the rest lies on chords between
            neighbours, see `hybrid_opt.polishing.chords`.
        chord: points that are evaluated on each.
        attempts: at most, for each of `PolishSettings.attempts`; twice as many where the front
            stays short.
        stride: from the neighbour that an attempt starts from, along both objectives, at most, in
            units of the front's extent.
        far: width beyond which a gap that no neighbour leads into is looked at from afar.
        far_radius, radius: of the first box of trust from afar and from a neighbour, in halves of
            the decision variables' ranges.
        rounds, iterations, barrier, tolerance: of a solve from a neighbour on the front, in place
            of `PolishSettings.rounds`, `PolishSettings.max_iterations`, `SolveSettings.barrier` and
            `SolveSettings.tolerance`.
    """

    solved: int = 32
    members: int = 56
    chord: int = 16
    attempts: int = 5
    stride: float = 0.2
    far: float = 0.1
    far_radius: float = 1.0
    radius: float = 0.4
    rounds: int = 12
    iterations: int = 30
    barrier: float = 1e-5
    tolerance: float = 1e-6


@dataclass(frozen=True)
class DrivableSettings:
    """The polish under the time law 'optimal', see `hybrid_opt.polishing.drivable`.

    Attributes:
        first_radius: of the box of trust, in halves of the ranges of the waypoints.
        rounds: steps of one point, unless it ends before.
        worth: gain of the later half of them, as a share of what is minimised, with which a point
            goes on for two turns more, and again.
        most_rounds: with such gains.
        least_radius: of the box of trust, below which a point is left.
        stationary: residual of stationarity and of complementarity at which a point counts as
            optimal.
        feasible: the same of feasibility; what is asked of distances moves with the path.
        noise: relative change of a timing that counts as none: what the timing rounds off.
        newton: steps shorter than this keep the program's squared speeds, longer ones take those
            of the new timing.
        row_rounds: times that rows are added to one quadratic program.
        row_tolerance: predicted excess of a limit that adds its row.
        negligible: scaled multipliers below this count as none.
        steadiness: curvature by the path of the program that finds multipliers.
        corrections: of a step by how geometric rows bend along it, at most.
        bend: of a scaled geometric row that is left uncorrected.
        turn: rounds of each start in a turn of a tournament of starts.
        members: force limits, spread over their range, at which the front gets a point where the
            best known path wins one.
    """

    first_radius: float = 0.3
    rounds: int = 24
    worth: float = 5e-4
    most_rounds: int = 48
    least_radius: float = 1e-4
    stationary: float = 1e-4
    feasible: float = 5e-3
    noise: float = 5e-4
    newton: float = 0.05
    row_rounds: int = 3
    row_tolerance: float = 1e-6
    negligible: float = 1e-8
    steadiness: float = 1.0
    corrections: int = 3
    bend: float = 0.01
    turn: int = 3
    members: int = 24


@dataclass(frozen=True)
class PolishSettings:
    """What decides the results of a polish.

    Attributes:
        attempts: that one front may take at its points, ends and middle; probes and
            those that fill it between them come on top.
        method: how a point is improved: along the diagonal (Pascoletti and Serafini 1984), or by
            minimising one objective while the other is held (epsilon constraint).
        max_iterations: of the solver in one round; see `SolveSettings.patience`.
        rounds: of one point at most; see `hybrid_opt.polishing.point`.
        max_seconds: wall time after which a solve is given up. Generous, because a result that
            depends on it cannot be repeated.
        margin: kept from the rims of patches, in the square of the shift over the radius.
        between: kept from joint limits [rad] and, in the square of |det J| over its least value,
            from singularities: they are judged at places and hold between them as well.
        clearance: distance kept from obstacles [m]; lets the motion between samples be certified.
        stricter: least rise of a required value that counts as a new demand [m, rad, 1].
        tolerance: improvement of an objective below which a point counts as optimal already.
        near, trust, solve, front, kick, probe, fill, drivable: the parts' own.
    """

    attempts: int = 8
    method: Method = "pascoletti-serafini"
    max_iterations: int = 20
    rounds: int = 7
    max_seconds: float = 60.0
    margin: float = 1e-6
    between: float = 2e-3
    clearance: float = 8e-4
    stricter: float = 1e-4
    tolerance: float = 1e-6
    near: NearSettings = field(default_factory=NearSettings)
    trust: TrustSettings = field(default_factory=TrustSettings)
    solve: SolveSettings = field(default_factory=SolveSettings)
    front: FrontSettings = field(default_factory=FrontSettings)
    kick: KickSettings = field(default_factory=KickSettings)
    probe: ProbeSettings = field(default_factory=ProbeSettings)
    fill: FillSettings = field(default_factory=FillSettings)
    drivable: DrivableSettings = field(default_factory=DrivableSettings)

    def __post_init__(self) -> None:
        """Check every value.

        Raises:
            SettingsError: with the value, and what is allowed.
        """
        if self.method not in get_args(Method):
            raise SettingsError(
                f"polish method {self.method!r}; known are {', '.join(get_args(Method))}"
            )
        for name, least in (("attempts", 0), ("max_iterations", 1), ("rounds", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise SettingsError(
                    f"polish {name} is {value!r}; allowed are whole numbers from {least}"
                )
        for name in ("max_seconds", "margin", "between", "clearance", "stricter", "tolerance"):
            if not getattr(self, name) > 0.0:
                raise SettingsError(f"polish {name} is {getattr(self, name)!r}; it must exceed 0")
