"""Records of the timing: limits, statuses, points of the path, and timings."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.display_protocol import Displayable
from symbolic.array import Array, Count, Figure, Range
from symbolic.errors import SettingsError
from symbolic.limits import LIMITS
from symbolic.records import Workcell

FRICTION_RATIO = "friction"
"""Name of the friction ratio of a carry. It limits no timing, because the contact forces satisfy it
by construction."""

PER_JOINT = tuple(limit.name for limit in LIMITS if limit.scope == "joint")
PER_ROBOT = (FRICTION_RATIO, *(limit.name for limit in LIMITS if limit.scope == "robot"))


class TimingStatus(StrEnum):
    """Outcome of the computation of a path's timing."""

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
    """The limit and the point of the path that a failure or a largest utilisation concerns.

    Attributes:
        constraint: name of the limit, as `hybrid_opt.timing.model.CarryLimits.ratios` names it, or
            a condition of the path itself.
        robot: name of the robot, '' for a limit of the box.
        joint: name of the joint, '' if the limit has no joint.
        sample: index of the sample on the grid of the function that reports it.
        parameter: path parameter u in [0, 1].
    """

    constraint: str
    robot: str
    joint: str
    sample: Count
    parameter: Annotated[float, Range(0.0, 1.0)]

    def __str__(self) -> str:
        who = " ".join(part for part in (self.robot, self.joint) if part)
        return f"{self.constraint}{f' of {who}' if who else ''} at u = {self.parameter:.4f}"


@dataclass(frozen=True)
class TimingLimits:
    """Limits in addition to the workcell's speeds and accelerations, which always apply.

    Attributes:
        force: largest normal force of each robot [N], or None for no limit.
        torque: whether joint torques (arm and contact wrench together) are limited.
        pressure: whether the centres of pressure have to stay within their patches.
        reference_speed: whether the box stays at or below the task's reference speeds.
        robust: whether the force limit applies to every case of the workcell's uncertainty, the
            first arm leading (`hybrid_opt.robust`), not only to the planned forces.
    """

    force: float | None = None
    torque: bool = True
    pressure: bool = True
    reference_speed: bool = False
    robust: bool = False

    def __post_init__(self) -> None:
        if self.robust and self.force is None:
            raise SettingsError("robust forces are limited by a force: give one", code="no-force")
        if self.force is not None and not 0.0 < self.force < float("inf"):
            raise SettingsError(
                f"force limit {self.force:g} N: give a finite positive force", code="force"
            )


@dataclass(frozen=True)
class JerkLimits:
    """Largest allowed jerks of joints and payload.

    Attributes:
        joints: (all joints,) limits of both arms' joints in order [rad/s^3]; infinite if not
            limited.
        payload: limit of the box frame [m/s^3]; infinite if not limited.
    """

    joints: Array
    payload: float = float("inf")

    def __post_init__(self) -> None:
        """Check that all limits are positive.

        Raises:
            SettingsError: a limit is not positive.
        """
        if not (np.all(np.asarray(self.joints) > 0.0) and self.payload > 0.0):
            raise SettingsError("jerk limits: give positive ones [rad/s^3, m/s^3]", code="jerk")

    @classmethod
    def from_workcell(cls, workcell: Workcell) -> JerkLimits | None:
        """Return the jerk limits that a workcell states; None if it states none."""
        joints = [
            np.full(len(robot.torque_max), np.inf) if robot.jerk_max is None else robot.jerk_max
            for robot in workcell.robots
        ]
        payload = workcell.payload.jerk_max
        limits = cls(np.concatenate(joints), np.inf if payload is None else payload)
        return limits if np.isfinite([*limits.joints, limits.payload]).any() else None


@dataclass(frozen=True)
class Utilisation:
    """The largest value of a quantity over its limit along a carry.

    Attributes:
        ratio: the largest value over the limit; above 1 the limit is exceeded.
        place: the limit, and the point of the path where the ratio is largest.
    """

    ratio: Figure
    place: Place


@dataclass(frozen=True, eq=False, repr=False)
class Timing(Displayable):
    """A timing of a path, or the reason why there is none.

    Attributes:
        status: the outcome.
        reason: one sentence for people.
        place: limit and point of the path of the failure, or of the largest utilisation.
        carry: the carry under this timing, resampled; None if there is no timing.
        use: largest utilisation by name of the limit, recomputed on `carry`.
        grid_speed: (intervals + 1,) path speed u' at the grid points [1/s]; empty if there is no
            timing, or if u'' is not constant between grid points.
        iterations: iterations of the timing method.
        slowed: uniform factor on the path speed, below one if only this made the recomputed limits
            hold.
        seconds: computing time [s].
        limits: the limits in addition to the workcell's.
    """

    status: TimingStatus
    reason: str
    place: Place
    carry: Carry | None
    use: dict[str, Utilisation] = field(default_factory=dict)
    grid_speed: Array = field(default_factory=lambda: np.zeros(0))
    iterations: int = 0
    slowed: float = 1.0
    seconds: float = 0.0
    limits: TimingLimits = field(default_factory=TimingLimits)

    @property
    def ok(self) -> bool:
        """True if the timing respects every limit."""
        return self.status is TimingStatus.OK

    @property
    def driven(self) -> Carry:
        """The carry under this timing. Use it only if `carry` is not None."""
        assert self.carry is not None, self.reason
        return self.carry

    @property
    def duration(self) -> float:
        """Duration [s]; infinite if there is no timing."""
        return self.carry.duration if self.carry is not None else float("inf")

    @property
    def peak_force(self) -> float:
        """Largest normal force along the carry [N]: the robust force if robust forces are limited,
        else the planned one. NaN if there is no timing.
        """
        if self.carry is None:
            return float("nan")
        if self.limits.force is None:
            return float(self.carry.normal_force.max())
        return self.use["normal force"].ratio * self.limits.force


AGREEMENT = 5e-3
"""Largest difference between a timing and TOPP-RA's at which the timing is confirmed, as a share of
the duration."""


@dataclass(frozen=True)
class Validation:
    """Durations of one path by two methods within the same limits.

    Attributes:
        duration: duration of the timing [s].
        reference: duration by TOPP-RA [s]; infinite if TOPP-RA finds no timing.
    """

    duration: Figure
    reference: Figure

    @property
    def ratio(self) -> float:
        """Ratio of the timing's duration to the duration by TOPP-RA."""
        return self.duration / self.reference

    @property
    def is_confirmed(self) -> bool:
        """True if the duration of the timing differs from TOPP-RA's by at most the share
        `AGREEMENT`.
        """
        return abs(self.ratio - 1.0) <= AGREEMENT


@dataclass(frozen=True, eq=False, repr=False)
class JerkTiming:
    """A timing within jerk limits, and what the jerk limits cost.

    Attributes:
        timing: the timing within the jerk limits.
        limits: the jerk limits.
        jerk_use: largest joint jerk and largest payload jerk, each over its limit.
        without: duration of the fastest timing without jerk limits [s].
        rounds: number of programs solved.
    """

    timing: Timing
    limits: JerkLimits
    jerk_use: tuple[float, float]
    without: float
    rounds: int = 0

    @property
    def cost(self) -> float:
        """Increase of the duration by the jerk limits, as a share of the duration without them."""
        return self.timing.duration / self.without - 1.0

    def __repr__(self) -> str:
        return (
            f"{self.timing!r}\njerk of joints {100.0 * self.jerk_use[0]:.1f} %, of the payload "
            f"{100.0 * self.jerk_use[1]:.1f} % of their limits; without these {self.without:.3f} s "
            f"({100.0 * self.cost:+.1f} %)"
        )


@dataclass(frozen=True)
class PathTiming:
    """Fastest timing of one path within limits, or the error of the path.

    Attributes:
        status: the outcome.
        place: limit and point of the path of the failure, or of the largest utilisation.
        duration: [s], infinite if there is no timing.
        peak_force: (2,) largest normal forces [N]. If there is no timing, the forces at rest; NaN
            if the path itself fails.
        use: largest share of each limit by name. If there is no timing, the shares at rest; empty
            if the path itself fails.
        grid_speed: (intervals + 1,) path speed u' at the grid points [1/s]; zero if there is no
            timing.
        sweeps: iterations of the backward and forward pass.
        slowed: uniform factor on the path speed, below one if only this made the limits hold.
        robust_force: (2,) like `peak_force`, but over all cases of the workcell's uncertainty; None
            if robust forces are not limited.
    """

    status: TimingStatus
    place: Place
    duration: float
    peak_force: Array
    use: dict[str, float]
    grid_speed: Array
    sweeps: int = 0
    slowed: float = 1.0
    robust_force: Array | None = None

    @property
    def ok(self) -> bool:
        """True if the timing respects every limit."""
        return self.status is TimingStatus.OK

    @property
    def limited_force(self) -> float:
        """Largest normal force of both robots [N]: the robust force if robust forces are limited,
        else the planned one.
        """
        known = self.peak_force if self.robust_force is None else self.robust_force
        return float(known.max())
