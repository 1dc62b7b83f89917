"""Records of a whole job, from the approach of the pads to their retreat, and its samples at even
time steps, as robot controllers need them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from hybrid_opt.collision.certify import Certificate
from hybrid_opt.display.table import text_table
from hybrid_opt.display_protocol import Displayable
from hybrid_opt.robust.squeeze import Squeeze
from hybrid_opt.timing.model import contact_torque
from hybrid_opt.timing.records import Timing
from symbolic.array import Array, interpolated, set_read_only
from symbolic.contact.registry import contact_model
from symbolic.errors import SettingsError
from symbolic.records import Workcell

PHASES = ("approach", "press", "lift", "carry", "set_down", "release", "retreat")
"""Names of the phases of a job of pads, in order. If the box is not lifted or lowered, there is no
lift or no set-down. For gripping hands, `ContactModel.closing` and `opening` replace press and
release."""

SWITCHES = {"grip_on": True, "grip_off": False}
"""Phases at whose beginning the outputs of hands are switched, with the new state. At the end of
the phase the inputs of the hands have to show this state."""

HELD_PHASES = ("lift", "carry", "set_down")
"""Names of the phases in which the box is held and moves."""

_STATIC = ("friction", "path speed", "joint position", "least normal force")
"""Names of utilisations that are not considered for the most used limit of a phase."""

LEAST_STEP = 1e-3

LARGEST_STEP = 1.0
"""Largest time step of a sampled job [s]."""


@dataclass(frozen=True, eq=False)
class PhaseMotion:
    """Motion of box and arms in one phase of a job at n samples, world frame.

    Joint arrays have the columns of both arms, the first arm's first. Where an acceleration jumps
    there are two samples of the same time, with the values before and after the jump.

    Attributes:
        first: number of joints of the first arm.
        time: (n,) times from the beginning of the phase [s].
        pose: (n, 6) box poses [m, rad].
        rate, second_rate: (n, 6) first and second time derivative of the pose.
        q: (n, joints) joint positions [rad].
        q_rate, q_second: (n, joints) first and second time derivative of the joint positions.
        own_torque: (n, joints) joint torques of the arms' motion and weight without contacts [N m].
        wrench_torque: (n, joints, 6) matrix that maps a robot's wrench on the box (force [N] and
            moment [N m] about the robot's nominal contact point, world axes) to the robot's joint
            torques [N m].
    """

    first: int
    time: Array
    pose: Array
    rate: Array
    second_rate: Array
    q: Array
    q_rate: Array
    q_second: Array
    own_torque: Array
    wrench_torque: Array

    @property
    def duration(self) -> float:
        """Duration of the phase [s]."""
        return float(self.time[-1])

    def contact_effort(self, wrench: Array) -> Array:
        """Compute the joint torques (n, joints) [N m] with which the robots exert wrenches on the
        box.

        Args:
            wrench: (n, 2, 6) wrench of each robot, force [N] and moment about the robot's nominal
                contact point [N m], world axes.
        """
        return contact_torque(self.first, self.wrench_torque, np.swapaxes(wrench, 0, 1))


@dataclass(frozen=True, eq=False)
class Force:
    """Forces of the robots in a phase at n samples, in the world frame.

    Attributes:
        normal: (n, 2) commanded normal force of each robot [N].
        least: (n, 2) planned normal force, the least that holds the box [N].
        wrench: (n, 2, 6) wrench of each robot on the box about the robot's nominal contact point,
            with the commanded normal forces [N, N m].
    """

    normal: Array
    least: Array
    wrench: Array


@dataclass(frozen=True, eq=False)
class Phase:
    """One phase of a job.

    Attributes:
        name: one of `PHASES`, or the name of a phase that the contact model adds.
        begin: time at which the phase begins, from the beginning of the job [s].
        motion: motion of box and arms in the phase.
        force: forces of the robots in the phase.
        certificate: verdict on collisions along the whole path of the phase.
        use: largest ratio of value to limit with the commanded forces, by name of the limit.
    """

    name: str
    begin: float
    motion: PhaseMotion
    force: Force
    certificate: Certificate
    use: dict[str, float]

    @property
    def duration(self) -> float:
        """Duration of the phase [s]."""
        return self.motion.duration

    @property
    def most_used(self) -> str:
        """Name of the limit with the largest ratio of value to limit. Friction, path speed, joint
        positions and the least normal force are not considered.
        """
        use = {name: ratio for name, ratio in self.use.items() if name not in _STATIC}
        return max(use, key=lambda name: use[name])

    @property
    def effort(self) -> Array:
        """Joint torques (n, joints) of the arms' motion, weight and commanded wrenches [N m]."""
        return self.motion.own_torque + self.motion.contact_effort(self.force.wrench)

    def __post_init__(self) -> None:
        set_read_only(self.motion)
        set_read_only(self.force)


@dataclass(frozen=True, eq=False, repr=False)
class Job(Displayable):
    """A carry with everything that happens before and after it.

    Attributes:
        workcell: the cell.
        timing: timing of the carry.
        phases: phases of the job in order of time.
        squeeze: record of how the commanded normal forces were computed.
        stands_on: names of the bodies that support the box before and after the job, two tuples;
            empty if the box is in the air there.
        joint_names: names of each arm's joints, two tuples.
    """

    workcell: Workcell
    timing: Timing
    phases: tuple[Phase, ...]
    squeeze: Squeeze
    stands_on: tuple[tuple[str, ...], tuple[str, ...]]
    joint_names: tuple[tuple[str, ...], tuple[str, ...]]

    @property
    def duration(self) -> float:
        """Duration of the whole job [s]."""
        return self.phases[-1].begin + self.phases[-1].duration

    def phase(self, name: str) -> Phase:
        """Return the phase of the job with a given name."""
        return next(phase for phase in self.phases if phase.name == name)

    @property
    def held(self) -> tuple[Phase, ...]:
        """The phases in which the box is held and moves, in order of time."""
        return tuple(phase for phase in self.phases if phase.name in HELD_PHASES)

    @property
    def follower(self) -> int | None:
        """Index of the force-controlled arm; None if hands grip the box without a squeeze."""
        return contact_model(self.workcell).follower(self.squeeze.leader)

    @property
    def control(self) -> str:
        """Sentence that names the force-controlled arm while the box is held."""
        if self.follower is None:
            return "both arms keep their places"
        return f"robot {self.workcell.robots[self.follower].name!r} is force-controlled"

    @property
    def peak_normal_force(self) -> Array:
        """Largest commanded normal force (2,) of each robot in the job [N]."""
        peaks = [phase.force.normal.max(axis=0) for phase in self.phases]
        return np.asarray(np.max(peaks, axis=0))

    def __repr__(self) -> str:
        rows = [
            [
                phase.name.replace("_", " "),
                f"{phase.begin:.3f}",
                f"{phase.duration:.3f}",
                f"{phase.force.normal.max():.1f}",
                f"{100.0 * phase.use[phase.most_used]:.1f} % {phase.most_used}",
            ]
            for phase in self.phases
        ]
        head = ["phase", "begins [s]", "takes [s]", "force [N]", "most used"]
        stands = [" and ".join(names) or "nothing" for names in self.stands_on]
        return "\n".join(
            [
                f"Job, {self.duration:.3f} s; the box stands on {stands[0]}, then on {stands[1]}",
                text_table([head, *rows], left=(0, 4)),
                f"commanded: {self.squeeze}; {self.control}",
                f"  {self.squeeze.breakdown}",
            ]
        )


@dataclass(frozen=True, eq=False)
class SampledJob:
    """A job at n samples, evenly spaced within each phase, world frame, read-only.

    Joint arrays have the columns of both arms, the first arm's first. The last sample of a phase is
    also the first sample of the next phase.

    Attributes:
        job: the job.
        time: (n,) times from the beginning of the job [s].
        last: index of the last sample of each phase.
        pose: (n, 6) box poses [m, rad].
        q, q_rate, q_second: (n, joints) joint positions [rad], and their first and second time
            derivative.
        effort: (n, joints) joint torques of the arms' motion, weight and commanded wrenches [N m].
        normal_force: (n, 2) commanded normal force of each robot [N].
        wrench: (n, 2, 6) wrench of each robot on the box about the robot's nominal contact point
            [N, N m].
    """

    job: Job
    time: Array
    last: tuple[int, ...]
    pose: Array
    q: Array
    q_rate: Array
    q_second: Array
    effort: Array
    normal_force: Array
    wrench: Array

    def __post_init__(self) -> None:
        set_read_only(self)

    def span(self, index: int) -> slice:
        """Return the slice of the samples of one phase, its first and last sample included.

        Args:
            index: index of the phase in `job.phases`.
        """
        return slice(self.last[index - 1] if index else 0, self.last[index] + 1)

    @property
    def phase_names(self) -> tuple[str, ...]:
        """Names (n,) of the phase of each sample. A sample at the boundary of two phases belongs to
        the earlier one.
        """
        names: list[str] = []
        for phase, last in zip(self.job.phases, self.last, strict=True):
            names += [phase.name] * (last + 1 - len(names))
        return tuple(names)

    def arm(self, index: int, values: Array) -> Array:
        """Return the columns of one arm from an array of both arms.

        Args:
            index: index of the arm, 0 or 1.
            values: (n, joints) values of both arms side by side.
        """
        first = len(self.job.joint_names[0])
        return values[:, :first] if index == 0 else values[:, first:]


def sample_job(job: Job, step: float) -> SampledJob:
    """Sample a job at even time steps within each phase, from time 0.

    Joint positions and box pose are cubic Hermite interpolations of the samples of the job, which
    are usually denser than the result. Accelerations, torques and forces are interpolated linearly.

    Args:
        job: the job.
        step: time between samples [s], reduced such that whole steps fill each phase.

    Raises:
        SettingsError: the step is out of range.
    """
    if not LEAST_STEP <= step <= LARGEST_STEP:
        raise SettingsError(
            f"time step {step:g} s; allowed is {LEAST_STEP:g} to {LARGEST_STEP:g}", code="range"
        )
    parts = [_sampled(phase, step) for phase in job.phases]
    last = np.cumsum([len(part["time"]) for part in parts]) - 1
    # The sample where two phases meet is the earlier one's last.
    last -= np.arange(len(parts))
    joined = {
        name: np.concatenate(
            [part[name] if k == 0 else part[name][1:] for k, part in enumerate(parts)]
        )
        for name in parts[0]
    }
    return SampledJob(job, last=tuple(last.tolist()), **joined)


def _sampled(phase: Phase, step: float) -> dict[str, Array]:
    motion, force = phase.motion, phase.force
    keep = np.concatenate([[True], np.diff(motion.time) > 0.0])
    time = motion.time[keep]
    grid = np.linspace(0.0, motion.duration, math.ceil(motion.duration / step - 1e-9) + 1)

    def between(values: Array) -> Array:
        found = interpolated(grid, time, values[keep])
        found[-1] = values[-1]
        return found

    joints = CubicHermiteSpline(time, motion.q[keep], motion.q_rate[keep])
    box = CubicHermiteSpline(time, motion.pose[keep], motion.rate[keep])
    return {
        "time": phase.begin + grid,
        "pose": box(grid),
        "q": joints(grid),
        "q_rate": joints(grid, 1),
        "q_second": between(motion.q_second),
        "effort": between(phase.effort),
        "normal_force": between(force.normal),
        "wrench": between(force.wrench),
    }
