"""A job on its way into a bundle, and the file that all programs read: job.json.

`job.schema.json` describes the file for others; its version rises with every change that breaks a
reader.

Its time steps are chosen by what they do to the gap between the pads. Between two samples a
controller makes up the motion: along straight lines of the joints, cubic or quintic ones. Each
arm's pad then misses its path a little, not both alike, and the gap between the pads changes. Arms
of a stiffness k at their pads turn a change d of the gap into a force k d / 2.

Controllers differ in who makes up for gravity: efforts are therefore given with gravity, the whole
torque of a joint, and without it, for controllers that add what bears arm and tool themselves.
What the pads exert on the box is part of both.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np
import pinocchio as pin
from scipy.interpolate import BPoly

from hybrid_opt.carry import joints_of
from hybrid_opt.compiled_cell import CACHED_WORKCELLS
from hybrid_opt.errors import JobError
from hybrid_opt.extras.bundles.arms import prefixes
from hybrid_opt.extras.bundles.programs.carry_job import FORMAT, VERSION, Limits
from hybrid_opt.extras.bundles.stopping import REACTION, PartnerStop, Stop
from hybrid_opt.job.compliance import (
    TRACKED,
    largest_skew,
    require_delay,
    require_stiffness,
    separation,
)
from hybrid_opt.job.motions import unit_squeeze
from hybrid_opt.job.records import SWITCHES, Job, SampledJob, sample_job
from hybrid_opt.timing.model import TimingModel, contact_torque
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.errors import SettingsError
from symbolic.read.arms import common_joints
from symbolic.records import Workcell
from symbolic.robot.model import build_robot_model

Interpolation = Literal["linear", "cubic", "quintic"]

DERIVATIVES: Mapping[Interpolation, int] = {"linear": 1, "cubic": 2, "quintic": 3}
"""Number of values that each kind of interpolation takes from a sample: position; also velocity;
also acceleration."""

BETWEEN = (0.25, 0.5, 0.75)
"""Shares of a time step at which the error of the pads between two samples is computed."""

MOST_INTERVALS = 1500
"""Largest number of time steps for which this error is computed, evenly spread over the job."""


@dataclass(frozen=True)
class Gap:
    """Error of the pads between two samples of a job while both pads hold the box.

    Attributes:
        step: longest time between two samples [s].
        interpolation: kind of interpolation between two samples.
        along: largest change of the distance between the pads along the first pad's normal [m].
        across: largest displacement of one pad against the other across this normal [m].
        force: change of the normal forces that follows from `along` [N].
        share: `force` over the least commanded normal force.
    """

    step: float
    interpolation: Interpolation
    along: float
    across: float
    force: float
    share: float


def chosen_step(
    job: Job, steps: Sequence[float], interpolation: Interpolation, stiffness: float
) -> float:
    """Return the longest time step [s] with which the normal forces between samples stay close to
    the commanded ones.

    Between two samples the distance of the pads changes, and with it the normal forces. A step is
    accepted if this error is at most the share `TRACKED` of the least commanded force.

    Args:
        job: the job.
        steps: steps to choose from, the longest first [s].
        interpolation: how the controller interpolates between samples.
        stiffness: stiffness of each arm at its pad along the normal [N/m].

    Raises:
        SettingsError: the error is too large with every step.
    """
    for step in steps:
        found = gap_of(sample_job(job, step), interpolation, stiffness)
        if found.share <= TRACKED:
            return step
    raise SettingsError(
        f"with {interpolation} motion between samples {1e3 * steps[-1]:g} ms apart the gap of the "
        f"pads is wrong by {1e3 * found.along:.2f} mm; arms of {stiffness:g} N/m then miss their "
        f"force by {found.force:.1f} N, {100.0 * found.share:.0f} %: choose a slower timing, "
        "or another target",
        code="gap-between-samples",
    )


def gap_of(sampled: SampledJob, interpolation: Interpolation, stiffness: float) -> Gap:
    """Compute how far the pads deviate from their planned relative position between the samples of
    a job, while they hold the box, and the force error that follows.

    Args:
        sampled: the job at the time steps of a bundle.
        interpolation: how the controller interpolates between samples.
        stiffness: stiffness of each arm at its pad along the normal [N/m].
    """
    job, time = sampled.job, sampled.time
    spans = [sampled.span(job.phases.index(phase)) for phase in job.held]
    starts = np.concatenate([np.arange(span.start, span.stop - 1) for span in spans])
    starts = starts[:: -(-len(starts) // MOST_INTERVALS)]
    steps = np.diff(time)[starts]
    places = np.concatenate([time[starts] + share * steps for share in BETWEEN])
    joints = between(time, (sampled.q, sampled.q_rate, sampled.q_second), interpolation)
    along, across = pad_errors(job.workcell, joints(places))
    held = contact_model(job.workcell).held_with(sampled.normal_force)
    least = min(float(held[span].min()) for span in spans)
    force = stiffness / 2.0 * float(np.abs(along).max())
    return Gap(
        step=float(np.diff(time).max()),
        interpolation=interpolation,
        along=float(np.abs(along).max()),
        across=float(across.max()),
        force=force,
        share=force / least,
    )


def between(time: Array, known: Sequence[Array], interpolation: Interpolation) -> BPoly:
    """Interpolate joint positions between samples as a controller does: by the polynomial of least
    degree that has the given positions and derivatives at both ends of a time step.

    Args:
        time: (n,) ascending times [s].
        known: arrays (n, joints) of positions [rad or m], then velocities, then accelerations [per
            s, per s^2]. Arrays that the interpolation does not use are ignored.
        interpolation: kind of interpolation.
    """
    taken = np.stack(known[: DERIVATIVES[interpolation]], axis=1)
    return BPoly.from_derivatives(time, taken)


def pad_errors(workcell: Workcell, q: Array) -> tuple[Array, Array]:
    """Compute how far the second pad is from its planned position relative to the first pad.

    Args:
        q: (n, joints) joint positions of both arms side by side [rad or m].

    Returns:
        Distance (n,) between the pads along the first pad's normal, minus the planned distance [m];
        and displacement (n,) across this normal, at least zero [m].
    """
    T = [pad_places(workcell, arm, own) for arm, own in enumerate(joints_of(workcell, q))]
    apart = np.einsum("nji,nj->ni", T[0][:, :3, :3], T[1][:, :3, 3] - T[0][:, :3, 3])
    one, other = (contact.T_box_pad for contact in workcell.contacts)
    missed = apart - one[:3, :3].T @ (other[:3, 3] - one[:3, 3])
    return missed[:, 2], np.linalg.norm(missed[:, :2], axis=1)


def pad_places(workcell: Workcell, arm: int, q: Array) -> Array:
    """Compute the poses (n, 4, 4) of an arm's pad in the world at joint positions q (n, n_joints)
    of this arm [rad or m].
    """
    robot = workcell.robots[arm]
    model = build_robot_model(robot)
    data, found = model.model.createData(), np.empty((len(q), 4, 4))
    for k, row in enumerate(q):
        pin.framesForwardKinematics(model.model, data, row)
        found[k] = data.oMf[model.flange_id].homogeneous
    return np.asarray(robot.T_world_base @ found @ robot.T_flange_pad)


def pad_jacobians(workcell: Workcell, arm: int, q: Array) -> Array:
    """Compute the Jacobians (n, 6, n_joints) of an arm's pad with respect to its joint positions.

    Linear velocity comes first [m/rad], then angular velocity [1], both along the flange's axes.

    Args:
        workcell: the cell.
        arm: index of the arm.
        q: (n, n_joints) joint positions of this arm [rad or m].
    """
    robot, found = workcell.robots[arm], np.empty((len(q), 6, q.shape[1]))
    model = build_robot_model(robot)
    data = model.model.createData()
    for k, row in enumerate(q):
        J = pin.computeFrameJacobian(model.model, data, row, model.flange_id, pin.LOCAL)
        J[:3] += np.cross(J[3:].T, robot.T_flange_pad[:3, 3]).T
        found[k] = J
    return found


timing_model = lru_cache(maxsize=CACHED_WORKCELLS)(TimingModel)

START, PATH = 0.005, 0.02
"""Largest distance of a pad from its first position, and from its path [m]."""

BEHIND, LAGS = 0.05, 3.0
"""Largest time that an arm may lag behind its reference [s], and the least multiple of its usual
lag for this time."""

LEAST_SKEW, MOST_SKEW = 0.008, 0.05
"""Range of the difference between both arms along the path above which a program stops the job [s].
Less could not be detected from measured postures."""

LEAST_BAND, MOST_BAND = 0.05, 0.3
"""Range of the largest deviation of a measured force from its reference, as a share of the
reference."""

SILENCE = 0.1
"""Longest time without a message from an arm [s]."""


Contents = Mapping[str, str | bytes]
"""File contents by path within a bundle."""


@dataclass(frozen=True)
class BundleOptions:
    """Options of a bundle.

    Attributes:
        step: time between samples [s]; None for the longest with a small enough error of the
            forces.
        any_arm: True to write a maker's own language also for arms that do not look like this
            maker's.
        stiffness: stiffness of each arm at its pad along the normal [N/m]; None for the value that
            the workcell states, or that follows from the gains of the bundle's target (a driver or
            language of robots, such as `ur-script`).
        skew: delay between the starts of both arms during which friction has to hold the box [s];
            None for the usual delay of the target.
        addresses: host names or IP addresses of both controllers; None for those in the workcell.
    """

    step: float | None = None
    any_arm: bool = False
    stiffness: float | None = None
    skew: float | None = None
    addresses: tuple[str, str] | None = None

    def __post_init__(self) -> None:
        if self.stiffness is not None:
            require_stiffness(self.stiffness)
        if self.skew is not None:
            require_delay(self.skew)


@dataclass(frozen=True, eq=False)
class Export:
    """A job with all data from which the files of a bundle are written.

    Attributes:
        sampled: the job at the time steps of the bundle.
        stiffness: stiffness of each arm at its pad along the normal [N/m]; None if nothing depends
            on it.
        gap: error of the pads between samples; None without a stiffness.
        stop: shortest stop of both arms along the path.
    """

    sampled: SampledJob
    stiffness: float | None
    gap: Gap | None
    stop: Stop

    @property
    def job(self) -> Job:
        """The job, from approach to retreat."""
        return self.sampled.job

    @property
    def workcell(self) -> Workcell:
        """The cell."""
        return self.sampled.job.workcell

    @property
    def follower(self) -> int:
        """Index of the force-controlled arm, for pads that press the box between them."""
        return 1 - self.job.squeeze.leader

    @property
    def lag(self) -> float:
        """Larger of both arms' delays behind their commands [s]."""
        return max(robot.driver.lag for robot in self.workcell.robots)

    @property
    def step(self) -> float:
        """Longest time between two samples [s]."""
        return float(np.diff(self.sampled.time).max())

    @cached_property
    def gravity(self) -> Array:
        """(n, joints) joint torques that balance the weight of arms and tools, both arms side by
        side [N m, for sliding joints N]."""
        found = []
        for arm, robot in enumerate(self.workcell.robots):
            numeric = build_robot_model(robot).model
            data, rows = numeric.createData(), self.sampled.arm(arm, self.sampled.q)
            found.append(np.array([pin.computeGeneralizedGravity(numeric, data, q) for q in rows]))
        return np.concatenate(found, axis=1)

    @cached_property
    def holding(self) -> Array:
        """(n, joints) joint torques with arms at rest that exert the commanded forces on the box,
        gravity included, both arms side by side [N m, for sliding joints N]."""
        sampled, model = self.sampled, timing_model(self.workcell)
        wrench = sampled.wrench.copy()
        for phase in self.job.held:
            span = sampled.span(self.job.phases.index(phase))
            pose = np.ascontiguousarray(sampled.pose[span])
            load = model.load(pose, np.zeros_like(pose), np.zeros_like(pose))
            # The leader's force differs from the other's by what the box needs: the mean is
            # squeezed.
            extra = (sampled.normal_force[span] - load["normal_force"]).mean(axis=1)
            both = np.stack([load["wrench_1"], load["wrench_2"]], axis=1)
            wrench[span] = both + extra[:, None, None] * unit_squeeze(self.workcell, pose)
        contact = self._contact(wrench)
        return self.gravity + contact + self._of_other(contact)

    @cached_property
    def effort(self) -> Array:
        """(n, joints) joint torques of the planned motion with the commanded forces, gravity
        included, both arms side by side [N m, for sliding joints N]. A joint that moves both arms
        balances the contact forces of both arms.
        """
        return self.sampled.effort + self._of_other(self._contact(self.sampled.wrench))

    def _contact(self, wrench: Array) -> Array:
        """Compute the joint torques (n, joints) with which both arms exert their wrenches (n, 2, 6)
        on the box [N m, for sliding joints N]."""
        sampled, model = self.sampled, timing_model(self.workcell)
        matrices = model.wrench_torque(np.ascontiguousarray(sampled.q), sampled.pose)
        first = len(self.job.joint_names[0])
        return contact_torque(first, matrices, np.swapaxes(wrench, 0, 1))

    def _of_other(self, contact: Array) -> Array:
        """Return the torques (n, joints) in joints that move both arms, such as a torso, that the
        contact of the other arm causes; zero in all other joints.

        Args:
            contact: (n, joints) torques of each arm's own contact. A joint that moves both arms has
                one column per arm.
        """
        found, (own, other) = np.zeros_like(contact), self.job.joint_names
        for name in common_joints(self.workcell.robots):
            both = [own.index(name), len(own) + other.index(name)]
            found[:, both] = contact[:, both[::-1]]
        return found

    @property
    def joint_columns(self) -> dict[str, Array]:
        """Arrays (n, joints) of both arms side by side, by name: joint positions [rad or m],
        velocities and accelerations [per s, per s^2], and torques with and without gravity [N m,
        for sliding joints N].
        """
        sampled = self.sampled
        return {
            "position": sampled.q,
            "velocity": sampled.q_rate,
            "acceleration": sampled.q_second,
            "effort_with_gravity": self.effort,
            "effort_without_gravity": self.effort - self.gravity,
        }

    @cached_property
    def gripped(self) -> Array:
        """(n,) 1 at samples at which hands (cups, magnets, grippers) are switched on, else 0."""
        found = np.zeros(len(self.sampled.time))
        for index, phase in enumerate(self.job.phases):
            if phase.name in SWITCHES:
                found[self.sampled.span(index).start :] = SWITCHES[phase.name]
        return found

    @cached_property
    def limits(self) -> Limits:
        """Deviations from the plan at which the programs stop the job."""
        held = [phase.force for phase in self.job.held]
        spare = min(float(((f.normal - f.least) / f.normal).min()) for f in held)
        k, behind = self.stiffness, max(BEHIND, LAGS * self.lag)
        survived = LEAST_SKEW if k is None else largest_skew(self.job, k)
        return Limits(
            stop_time=self.stop.time,
            quick_stop=self.stop.quick,
            start=START,
            path=PATH,
            behind=behind,
            skew=float(np.clip(survived, LEAST_SKEW, MOST_SKEW)),
            force=float(np.clip(spare, LEAST_BAND, MOST_BAND)),
            silence=SILENCE,
            grip=self.workcell.handling.grip_limit,
            # An arm that stands is noticed where it is `behind`; one that has no link any more,
            # where it is silent. Half of a stop's time passes at the planned speed.
            partner_stop_time=max(behind, SILENCE) + REACTION + self.lag + self.stop.quick / 2.0,
        )

    @cached_property
    def partner_stop(self) -> PartnerStop:
        """Effect of an unplanned stop of one arm on the distance of the pads.

        Raises:
            JobError: the pads would move farther apart than the cell allows.
        """
        job, k, time = self.job, self.stiffness, self.limits.partner_stop_time
        survived = None if k is None else separation(job, largest_skew(job, k, time))
        allowed = self.workcell.handling.partner_stop
        found = PartnerStop(time, separation(job, time), survived, allowed)
        if allowed is not None and found.distance > allowed:
            raise JobError(
                f"when one arm stops, the pads end {1e3 * found.distance:.0f} mm apart after "
                f"{time:.2f} s; handling.partner_stop allows {1e3 * allowed:.0f} mm: time the "
                f"carry with partner_stop = {allowed**2 / found.distance:.3f}, or press more, "
                "which shortens the stop",
                code="partner-stop",
            )
        return found

    def reach(self, arm: int) -> Array:
        """Compute for each joint of an arm the largest speed of the pad per speed of this joint,
        over all samples: (n_joints,) [m/rad, for sliding joints 1].
        """
        J = pad_jacobians(self.workcell, arm, self.sampled.arm(arm, self.sampled.q))
        return np.asarray(np.linalg.norm(J[:, :3], axis=1).max(axis=0))

    def ros_joints(self, arm: int) -> list[str]:
        """Return the names of an arm's joints in ROS, with its robot's prefix, base first."""
        prefix = prefixes(self.workcell)[arm]
        return [f"{prefix}{joint}" for joint in self.job.joint_names[arm]]

    @cached_property
    def document(self) -> dict[str, Any]:
        """Content of job.json as JSON values, as `job.schema.json` describes it."""
        sampled, job = self.sampled, self.job
        orientation = self.workcell.task.orientation
        spans = map(sampled.span, range(len(job.phases)))
        return {
            "format": FORMAT,
            "version": VERSION,
            "workcell": self.workcell.name,
            "time": sampled.time.tolist(),
            "phases": [
                {"name": phase.name, "first": span.start, "last": span.stop - 1}
                | ({"grip": SWITCHES[phase.name]} if phase.name in SWITCHES else {})
                for phase, span in zip(job.phases, spans, strict=True)
            ],
            "box": {
                "pose": sampled.pose.tolist(),
                "rotation": orientation.rotation,
                "reference": orientation.reference.tolist(),
            },
            "machine": {"limits": asdict(self.limits)},
            "robots": [self._robot(arm) for arm in (0, 1)],
        }

    def _robot(self, arm: int) -> dict[str, Any]:
        sampled = self.sampled
        robot = self.workcell.robots[arm]
        rows = self.joint_columns | {
            "hold_effort_with_gravity": self.holding,
            "hold_effort_without_gravity": self.holding - self.gravity,
        }
        return {
            "name": robot.name,
            "joints": list(self.job.joint_names[arm]),
            "ros_joints": self.ros_joints(arm),
            "force_controlled": arm == self.job.follower,
            "reach": self.reach(arm).tolist(),
            **{name: sampled.arm(arm, values).tolist() for name, values in rows.items()},
            "normal_force": sampled.normal_force[:, arm].tolist(),
            "wrench": sampled.wrench[:, arm].tolist(),
        }

    def tool_load(self, arm: int) -> tuple[float, Array]:
        """Return the mass [kg] and the centre of mass (3,) in the flange frame [m] of an arm's
        tool; zeros if unknown."""
        load = self.workcell.robots[arm].tool_load
        return (0.0, np.zeros(3)) if load is None else (load.mass, load.centre_of_mass)


def job_text(export: Export) -> str:
    """Return the text of job.json."""
    return json.dumps(export.document, allow_nan=False, separators=(",", ":")) + "\n"
