"""Time steps by what they do to the gap between the pads.

Between two samples a controller makes up the motion: along straight lines of the joints, cubic or
quintic ones. Each arm's pad then misses its path a little, not both alike, and the gap between the
pads changes. Arms of a stiffness k at their pads turn a change d of the gap into a force k d / 2.

Beside them: what holds a job still at every sample, and how fast it may stop along its path.
Controllers differ in who makes up for gravity: efforts are therefore given with gravity, the whole
torque of a joint, and without it, for controllers that add what bears arm and tool themselves.
What the pads exert on the box is part of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pinocchio as pin
from scipy.interpolate import BPoly, CubicHermiteSpline

from hybrid_opt.errors import JobError
from hybrid_opt.job.compliance import HELD, TRACKED
from hybrid_opt.job.motions import unit_squeeze
from hybrid_opt.job.records import Job, SampledJob, sample_job
from hybrid_opt.static_hold import kept_per_workcell
from hybrid_opt.timing.model import TimingModel
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell
from symbolic.robot.model import build_robot_model

Interpolation = Literal["linear", "cubic", "quintic"]

BETWEEN = (0.25, 0.5, 0.75)
"""Shares of a step at which the pads are looked at."""

MOST_INTERVALS = 1500
"""Steps that are looked at, evenly spread."""


@dataclass(frozen=True)
class Gap:
    """What a time step does to the pads while they hold the box.

    Attributes:
        step: [s].
        interpolation: between two samples.
        along: largest change of the distance between the pads along the normal [m].
        across: largest displacement of one against the other across it [m].
        force: error of the normal forces that the change along the normal makes [N].
        share: the same, of the least commanded normal force.
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
    """The longest of the steps whose force error stays within the tracking share.

    Args:
        steps: that the target can have, the longest first [s].
        stiffness: of each arm at its pad [N/m].

    Raises:
        SettingsError: none does.
    """
    for step in steps:
        found = gap_of(sample_job(job, step), interpolation, stiffness)
        if found.share <= TRACKED:
            return step
    raise SettingsError(
        f"with {interpolation} motion between samples {1e3 * steps[-1]:g} ms apart the gap of the "
        f"pads is wrong by {1e3 * found.along:.2f} mm; arms of {stiffness:g} N/m then miss their "
        f"force by {found.force:.1f} N, {100.0 * found.share:.0f} %: choose a slower timing, "
        "another target, or state the stiffness that your arms have (--stiffness)"
    )


def gap_of(sampled: SampledJob, interpolation: Interpolation, stiffness: float) -> Gap:
    """What the samples of a job do to the pads, under an interpolation.

    Args:
        stiffness: of each arm at its pad [N/m].
    """
    job, time = sampled.job, sampled.time
    spans = [sampled.span(k) for k, phase in enumerate(job.phases) if phase.name in HELD]
    starts = np.concatenate([np.arange(span.start, span.stop - 1) for span in spans])
    starts = starts[:: -(-len(starts) // MOST_INTERVALS)]
    steps = np.diff(time)[starts]
    places = np.concatenate([time[starts] + share * steps for share in BETWEEN])
    q = between(sampled, interpolation, places)
    along, across = pad_errors(job.workcell, q)
    least = min(float(sampled.normal_force[span].min()) for span in spans)
    force = stiffness / 2.0 * float(np.abs(along).max())
    return Gap(
        step=float(np.diff(time).max()),
        interpolation=interpolation,
        along=float(np.abs(along).max()),
        across=float(across.max()),
        force=force,
        share=force / least,
    )


def between(sampled: SampledJob, interpolation: Interpolation, places: Array) -> Array:
    """(m, joints) joints at times (m,) as a controller makes them up between the samples."""
    if interpolation == "linear":
        columns = sampled.q.T
        return np.column_stack([np.interp(places, sampled.time, each) for each in columns])
    if interpolation == "cubic":
        return np.asarray(CubicHermiteSpline(sampled.time, sampled.q, sampled.q_rate)(places))
    known = np.stack([sampled.q, sampled.q_rate, sampled.q_second], axis=1)
    return np.asarray(BPoly.from_derivatives(sampled.time, known)(places))


def pad_errors(workcell: Workcell, q: Array) -> tuple[Array, Array]:
    """How the pads of postures stand to one another against how they hold the box.

    Args:
        q: (n, joints) both arms side by side [rad].

    Returns:
        (n,) the distance between the pads along the first one's normal less the planned one [m],
        and (n,) their displacement across it [m].
    """
    first = len(workcell.robots[0].torque_max)
    T = [pad_places(workcell, arm, own) for arm, own in enumerate((q[:, :first], q[:, first:]))]
    apart = np.einsum("nji,nj->ni", T[0][:, :3, :3], T[1][:, :3, 3] - T[0][:, :3, 3])
    one, other = (contact.T_box_pad for contact in workcell.contacts)
    missed = apart - one[:3, :3].T @ (other[:3, 3] - one[:3, 3])
    return missed[:, 2], np.linalg.norm(missed[:, :2], axis=1)


def pad_places(workcell: Workcell, arm: int, q: Array) -> Array:
    """(n, 4, 4) of an arm's pad in the world, at its joints (n, joints) [rad]."""
    robot = workcell.robots[arm]
    model = build_robot_model(robot)
    data, found = model.model.createData(), np.empty((len(q), 4, 4))
    for k, row in enumerate(q):
        pin.framesForwardKinematics(model.model, data, row)
        found[k] = data.oMf[model.flange_id].homogeneous
    return np.asarray(robot.T_world_base @ found @ robot.T_flange_pad)


STOP_TIMES = (0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0, 1.5, 2.0, 3.0)
"""Times of a stop that are tried, the shortest first [s]."""

EVERY = 5
"""Of the job's own samples, one in so many is where a stop is tried."""

INSTANTS = 9
"""Instants at which a stop is looked at."""

JOINT_USE = 1.1
"""Joint acceleration of a stop over its limit, if it can be had: timings use the limits whole."""

_model = kept_per_workcell(TimingModel)


@dataclass(frozen=True, eq=False)
class Efforts:
    """Joint torques at n samples, both arms' joints side by side [N m, N].

    Attributes:
        moving: (n, joints) of the job as planned, with gravity.
        holding: (n, joints) that stand still there and press as commanded, with gravity.
        gravity: (n, joints) that bear the arms and their tools alone.
    """

    moving: Array
    holding: Array
    gravity: Array


@dataclass(frozen=True)
class Stop:
    """How a job stops along its path.

    Attributes:
        time: from the planned speed to rest [s].
        force_use: largest normal force that holds the box in a stop, over the commanded one.
        joint_use: largest joint acceleration of a stop over its limit.
        quick: the shortest time that the commanded forces bear, whatever the joints' limits, for
            arms that have lost one another [s].
    """

    time: float
    force_use: float
    joint_use: float
    quick: float


def efforts(sampled: SampledJob) -> Efforts:
    """The torques of a sampled job, of holding it at each sample, and of gravity."""
    model, gravity = _model(sampled.job.workcell), []
    for arm, robot in enumerate(sampled.job.workcell.robots):
        numeric = build_robot_model(robot).model
        data = numeric.createData()
        rows = sampled.arm(arm, sampled.q)
        gravity.append(np.array([pin.computeGeneralizedGravity(numeric, data, q) for q in rows]))
    own = np.concatenate(gravity, axis=1)
    matrices = model.wrench_torque(np.ascontiguousarray(sampled.q), sampled.pose)
    first, wrench = gravity[0].shape[1], _still_wrench(model, sampled)
    parts = (matrices[:, :first], matrices[:, first:])
    pressing = [np.einsum("njk,nk->nj", part, wrench[:, i]) for i, part in enumerate(parts)]
    return Efforts(sampled.effort, own + np.concatenate(pressing, axis=1), own)


def _still_wrench(model: TimingModel, sampled: SampledJob) -> Array:
    """(n, 2, 6) wrenches on the box that hold it still and press as commanded [N, N m]."""
    wrench = sampled.wrench.copy()
    for index, phase in enumerate(sampled.job.phases):
        if phase.name not in HELD:
            continue
        span = sampled.span(index)
        pose = np.ascontiguousarray(sampled.pose[span])
        load = model.load(pose, np.zeros_like(pose), np.zeros_like(pose))
        # The leader's force differs from the other's by what the box needs: the mean is squeezed.
        extra = (sampled.normal_force[span] - load["normal_force"]).mean(axis=1)
        both = np.stack([load["wrench_1"], load["wrench_2"]], axis=1)
        squeezed = extra[:, None, None] * unit_squeeze(model.workcell, pose)
        wrench[span] = both + squeezed
    return wrench


def stop_of(job: Job) -> Stop:
    """The shortest stop along the path that the commanded forces bear.

    Raises:
        JobError: none does.
    """
    path = _Path(job)
    found = [path.stop(time) for time in STOP_TIMES]
    bearing = [stop for stop in found if stop.force_use <= 1.0]
    if not bearing:
        raise JobError(
            f"a stop along the path within {STOP_TIMES[-1]:g} s asks for "
            f"{100.0 * found[-1].force_use:.1f} % of the commanded forces: press more (squeeze), "
            "or choose a slower timing"
        )
    gentle = [stop for stop in bearing if stop.joint_use <= JOINT_USE]
    return replace(gentle[0] if gentle else bearing[-1], quick=bearing[0].time)


class _Path:
    """The whole job over its planned time, at its own samples."""

    def __init__(self, job: Job) -> None:
        motions = [phase.motion for phase in job.phases]

        def joined(parts: list[Array]) -> Array:
            return np.concatenate(parts)

        self._job = job
        self._model = _model(job.workcell)
        begins = [phase.begin for phase in job.phases]
        self._time = joined([m.time + at for m, at in zip(motions, begins, strict=True)])
        held = [np.full(len(p.motion.time), p.name in HELD) for p in job.phases]
        self._held = joined(held)
        self._columns = {
            name: joined([getattr(motion, name) for motion in motions])
            for name in ("pose", "rate", "second_rate", "q_rate", "q_second")
        }
        self._columns["force"] = joined([phase.force.normal for phase in job.phases])
        self._limit = np.concatenate([r.acceleration_max for r in job.workcell.robots])

    def stop(self, duration: float) -> Stop:
        """A stop of a duration [s], tried all along the path."""
        x = np.linspace(0.0, 1.0, INSTANTS)
        rate = 1.0 - x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        slope = -30.0 * x**2 * (1.0 - x) ** 2 / duration
        passed = duration * (x - 2.5 * x**4 + 3.0 * x**5 - x**6)
        places = self._time[::EVERY]
        s = np.minimum(places[:, None] + passed, self._time[-1]).ravel()
        r = np.tile(rate, len(places))[:, None]
        change = np.tile(slope, len(places))[:, None]
        at = {name: self._at(values, s) for name, values in self._columns.items()}
        second = at["q_second"] * r**2 + at["q_rate"] * change
        joint_use = float((np.abs(second) / self._limit).max())
        # Between two samples of phases that hold the box, pads alone hold it.
        held = np.interp(s, self._time, self._held.astype(float)) == 1.0
        box = (at["rate"] * r, at["second_rate"] * r**2 + at["rate"] * change)
        load = self._model.load(*(np.ascontiguousarray(v[held]) for v in (at["pose"], *box)))
        use = load["normal_force"] / at["force"][held]
        return Stop(duration, float(use.max()), joint_use, duration)

    def _at(self, values: Array, s: Array) -> Array:
        return np.column_stack([np.interp(s, self._time, column) for column in values.T])
