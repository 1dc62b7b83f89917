"""What holds a job still at every sample, and how fast it may stop along its path.

Controllers differ in who makes up for gravity: efforts are therefore given with gravity, the whole
torque of a joint, and without it, for controllers that add what bears arm and tool themselves.
What the pads exert on the box is part of both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from hybrid_opt.errors import JobError
from hybrid_opt.job.compliance import HELD
from hybrid_opt.job.forces import unit_squeeze
from hybrid_opt.job.records import Job, SampledJob
from hybrid_opt.static_hold import kept_per_workcell
from hybrid_opt.timing.model import TimingModel
from symbolic.array import Array
from symbolic.robot.model import build_robot_model

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
