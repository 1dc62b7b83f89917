"""Records of the timing: limits, statuses, places on the path, and a carry with its loads."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.workcell.records import Workcell


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
    """

    force: float | None = None
    torque: bool = True
    pressure: bool = True
    reference_speed: bool = False

    def __post_init__(self) -> None:
        if self.force is not None and not 0.0 < self.force < float("inf"):
            raise SettingsError(f"force limit {self.force:g} N: give a finite positive force")


@dataclass(frozen=True)
class Excess:
    """How far a limit is used: the largest value over its limit, and where."""

    ratio: float
    place: Place


@dataclass(frozen=True)
class TimedCarry:
    """A carry with its timing and every physical quantity; n samples, world frame.

    At the joint between two pieces of constant path acceleration a sample stands twice, once for
    each side. The second arm's joints follow the first's.

    Attributes:
        parameter: (n,) path parameter u.
        time: (n,) [s].
        pose, rate, second_rate: (n, 6) box pose and its time derivatives.
        q, q_rate, q_second: (n, 12) joints and their time derivatives [rad, s].
        angular_velocity, angular_acceleration: (n, 3) of the box [rad/s, rad/s^2].
        normal_force, tangential_force: (n, 2) [N].
        contact_force: (n, 2, 3) force of each robot on the box [N].
        pressure_shift: (n, 2) [m].
        point_moment_residual: (n, 3) moment missing with the forces at the nominal points [N m].
        moment_residual: (n, 3) moment missing with the pressure shifted [N m].
        contact_torque: (n, 12) joint torques of the contact wrench alone [N m].
        own_torque: (n, 12) joint torques of the bare arm's motion and weight [N m].
    """

    parameter: Array
    time: Array
    pose: Array
    rate: Array
    second_rate: Array
    q: Array
    q_rate: Array
    q_second: Array
    angular_velocity: Array
    angular_acceleration: Array
    normal_force: Array
    tangential_force: Array
    contact_force: Array
    pressure_shift: Array
    point_moment_residual: Array
    moment_residual: Array
    contact_torque: Array
    own_torque: Array

    @property
    def duration(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.time[-1] - self.time[0])

    @property
    def torque(self) -> Array:
        """(n, 12) joint torques of the arm and the contact wrench together [N m]."""
        return self.contact_torque + self.own_torque

    def objectives(self, workcell: Workcell) -> Array:
        """(2,) peak normal forces over the reference forces, the paper's objectives (Eq. 60)."""
        peaks: Array = self.normal_force.max(axis=0) / workcell.task.reference_force
        return peaks

    def friction_margin(self, workcell: Workcell) -> Array:
        """(n, 2) friction left at each contact, mu N - F_t [N]; zero where a cone is tight."""
        friction = [contact.friction for contact in workcell.contacts]
        margin: Array = self.normal_force * friction - self.tangential_force
        return margin


@dataclass(frozen=True)
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
    carry: TimedCarry | None
    use: dict[str, Excess] = field(default_factory=dict)
    grid_speed: Array | None = None
    iterations: int = 0
    slowed: float = 1.0
    seconds: float = 0.0

    @property
    def ok(self) -> bool:
        """Whether the timing respects every limit."""
        return self.status is TimingStatus.OK

    @property
    def duration(self) -> float:
        """Duration [s], infinite without a timing."""
        return self.carry.duration if self.carry is not None else float("inf")
