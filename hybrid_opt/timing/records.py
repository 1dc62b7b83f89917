"""Records of the timing: limits, statuses, places on the path, and a timing itself."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from hybrid_opt.carry import Carry
from symbolic.array import Array
from symbolic.errors import SettingsError


class TimingStatus(StrEnum):
    """What came out of timing a path."""

    OK = "ok"
    EXCEEDED = "limits exceeded"
    NO_MOTION = "no motion"
    OFF_PATH = "arm off the path"
    JOINT_LIMITS = "beyond the joint limits"
    NEAR_SINGULAR = "near a singularity"
    INFEASIBLE_AT_REST = "infeasible at rest"
    SOLVER_FAILED = "solver failed"
    NOT_CONVERGED = "not converged"


@dataclass(frozen=True)
class Place:
    """Where on the path something happens.

    Attributes:
        constraint: which limit, one of `CONSTRAINTS` or a condition of the path itself.
        robot: name of the robot, '' for a limit of the box.
        joint: name of the joint, '' where none is concerned.
        sample: index of the sample, on the grid of whoever reports it.
        parameter: path parameter u in [0, 1].
    """

    constraint: str
    robot: str
    joint: str
    sample: int
    parameter: float

    def __str__(self) -> str:
        who = " ".join(part for part in (self.robot, self.joint) if part)
        return f"{self.constraint}{f' of {who}' if who else ''} at u = {self.parameter:.4f}"


CONSTRAINTS = (
    "joint velocity",
    "joint acceleration",
    "joint torque",
    "payload velocity",
    "payload acceleration",
    "payload angular velocity",
    "payload angular acceleration",
    "normal force",
    "friction",
    "pressure shift",
    "path speed",
)
"""Limits that a timing has to respect."""


@dataclass(frozen=True)
class TimingLimits:
    """Limits beyond the workcell's own speeds and accelerations, which always hold.

    Attributes:
        force: largest normal force of each robot [N], or None for no limit.
        torque: whether joint torques (arm and contact wrench together) are limited.
        pressure: whether the centres of pressure have to stay within their patches.
        reference_speed: whether the box stays at or below the task's reference speeds.
        robust: whether the force limit holds in every case of the workcell's uncertainty, the first
            arm leading (`hybrid_opt.robust`), and not only for the planned forces.
    """

    force: float | None = None
    torque: bool = True
    pressure: bool = True
    reference_speed: bool = False
    robust: bool = False

    def __post_init__(self) -> None:
        if self.robust and self.force is None:
            raise SettingsError("robust forces are limited by a force: give one")
        if self.force is not None and not 0.0 < self.force < float("inf"):
            raise SettingsError(f"force limit {self.force:g} N: give a finite positive force")


@dataclass(frozen=True)
class Excess:
    """How far a limit is used: the largest value over its limit, and where."""

    ratio: float
    place: Place


@dataclass(frozen=True, eq=False, repr=False)
class Timing:
    """A timing of a path, or why there is none.

    Attributes:
        status: the outcome.
        reason: one sentence for people.
        place: where it fails, or the most used limit.
        carry: the carry under this timing, re-sampled; None without a timing.
        use: largest value over its limit, by constraint, recomputed on `carry`.
        grid_speed: (stages + 1,) path speed u' at the grid points [1/s]; empty without a timing.
        iterations: linear problems solved.
        slowed: uniform factor on the path speed that made recomputed limits hold, 1 normally.
        seconds: computing time.
    """

    status: TimingStatus
    reason: str
    place: Place | None
    carry: Carry | None
    use: dict[str, Excess] = field(default_factory=dict)
    grid_speed: Array | None = None
    iterations: int = 0
    slowed: float = 1.0
    seconds: float = 0.0

    @property
    def ok(self) -> bool:
        """Whether the timing respects every limit."""
        return self.status is TimingStatus.OK

    def __repr__(self) -> str:
        from hybrid_opt.display.timing import timing_text

        return timing_text(self)

    def _repr_html_(self) -> str:
        from hybrid_opt.display.timing import timing_html

        return timing_html(self)

    @property
    def duration(self) -> float:
        """Duration [s], infinite without a timing."""
        return self.carry.duration if self.carry is not None else float("inf")
