"""A whole job: from the pads away from the box, through the carry, to the pads away again."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from hybrid_opt.collision.certify import Certificate
from hybrid_opt.robust.squeeze import Squeeze
from hybrid_opt.timing.records import Timing
from symbolic.array import Array
from symbolic.records import Workcell

PHASES = ("approach", "press", "lift", "carry", "set_down", "release", "retreat")
"""Every phase of a job in order; without a height there is no lift or no set-down."""


_STATIC = ("friction", "path speed", "joint position", "least normal force")
"""Uses that say nothing of how hard a phase drives the cell."""


@dataclass(frozen=True, eq=False)
class PhaseMotion:
    """How box and arms move in a phase at n samples; world frame, both arms' joints side by side.

    A sample may stand twice where an acceleration jumps, once for each side.

    Attributes:
        first: number of the first arm's joints.
        time: (n,) from the beginning of the phase [s].
        pose, rate, second_rate: (n, 6) box pose [m, rad] and its time derivatives.
        q, q_rate, q_second: (n, joints) [rad, s].
        own_torque: (n, joints) torques of the bare arms' motion and weight [N m].
        wrench_torque: (n, joints, 6) from each robot's wrench on the box (force and moment about
            the nominal contact point, world axes) to its joint torques.
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
        """[s]."""
        return float(self.time[-1])


@dataclass(frozen=True, eq=False)
class Force:
    """How the robots press in a phase at n samples, world frame.

    Attributes:
        normal: (n, 2) commanded normal force of each robot [N].
        least: (n, 2) least normal force that holds the box, the planned one [N].
        wrench: (n, 2, 6) of each robot on the box about its nominal contact point, with the
            commanded normal forces [N, N m].
    """

    normal: Array
    least: Array
    wrench: Array


@dataclass(frozen=True, eq=False)
class Phase:
    """One phase of a job.

    Attributes:
        name: one of `PHASES`.
        begin: when it begins, from the beginning of the job [s].
        motion, force: what happens in it.
        certificate: the continuous verdict on its collisions.
        use: largest value over its limit by constraint, with the commanded forces.
    """

    name: str
    begin: float
    motion: PhaseMotion
    force: Force
    certificate: Certificate
    use: dict[str, float]

    @property
    def duration(self) -> float:
        """[s]."""
        return self.motion.duration

    @property
    def most_used(self) -> str:
        """The limit of arms and box that its motion and its forces use most."""
        use = {name: ratio for name, ratio in self.use.items() if name not in _STATIC}
        return max(use, key=lambda name: use[name])

    @property
    def effort(self) -> Array:
        """(n, joints) joint torques of arms and commanded contact wrenches together [N m]."""
        return self.motion.own_torque + contact_effort(self.motion, self.force.wrench)

    def __post_init__(self) -> None:
        for record in (self.motion, self.force):
            for field in fields(record):
                value = getattr(record, field.name)
                if isinstance(value, np.ndarray):
                    value.setflags(write=False)


def contact_effort(motion: PhaseMotion, wrench: Array) -> Array:
    """(n, joints) joint torques that exert wrenches (n, 2, 6) on the box [N m]."""
    parts = (motion.wrench_torque[:, : motion.first], motion.wrench_torque[:, motion.first :])
    torques = [np.einsum("njk,nk->nj", part, wrench[:, arm]) for arm, part in enumerate(parts)]
    return np.concatenate(torques, axis=1)


@dataclass(frozen=True, eq=False)
class Job:
    """A carry with all that has to happen before and after it.

    Attributes:
        workcell: the cell.
        timing: of the carry.
        phases: in order.
        squeeze: how hard the robots press, and why.
        stands_on: (2,) names of the bodies that the box stands on before and after; empty where
            it is handed over in the air.
        joint_names: of both arms.
    """

    workcell: Workcell
    timing: Timing
    phases: tuple[Phase, ...]
    squeeze: Squeeze
    stands_on: tuple[tuple[str, ...], tuple[str, ...]]
    joint_names: tuple[tuple[str, ...], tuple[str, ...]]

    @property
    def duration(self) -> float:
        """[s]."""
        return self.phases[-1].begin + self.phases[-1].duration

    def phase(self, name: str) -> Phase:
        """The phase of a name."""
        return next(phase for phase in self.phases if phase.name == name)

    @property
    def peak_normal_force(self) -> Array:
        """(2,) largest commanded normal force of each robot [N]."""
        peaks = [phase.force.normal.max(axis=0) for phase in self.phases]
        return np.asarray(np.max(peaks, axis=0))

    @property
    def prefixed_joints(self) -> tuple[str, ...]:
        """Names of all joints, each behind its robot's."""
        return tuple(
            f"{robot_prefix(robot.name)}{joint}"
            for robot, joints in zip(self.workcell.robots, self.joint_names, strict=True)
            for joint in joints
        )

    def __repr__(self) -> str:
        from hybrid_opt.job.text import job_text

        return job_text(self)


def robot_prefix(name: str) -> str:
    """A robot's name as the beginning of names in ROS and RAPID: letters, digits, underscores."""
    plain = "".join(c if c.isascii() and c.isalnum() else "_" for c in name.lower())
    return f"{'r' if not plain[:1].isalpha() else ''}{plain}_"
