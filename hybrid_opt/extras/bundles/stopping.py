"""Stops during a job: of both arms together along the path, and of one arm by itself."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybrid_opt.errors import JobError
from hybrid_opt.job.records import HELD_PHASES, Job
from hybrid_opt.timing.model import TimingModel
from symbolic.array import interpolated
from symbolic.contact.registry import contact_model

STOP_TIMES = (0.1, 0.15, 0.2, 0.3, 0.45, 0.7, 1.0, 1.5, 2.0, 3.0)
"""Durations of a stop along the path that are tried, the shortest first [s]."""

STOP_STRIDE = 5
"""A stop is tried at every sample of the job with this stride."""

INSTANTS = 9
"""Number of instants during a stop at which forces and accelerations are computed."""

JOINT_USE = 1.1
"""Largest joint acceleration of a stop over its limit, if a stop with so little exists. It exceeds
1 because timings use the limits fully."""


@dataclass(frozen=True)
class Stop:
    """A stop of both arms together along the path of a job.

    Attributes:
        time: duration from the planned speed to rest [s].
        force_use: largest normal force that the box needs during the stop, over the commanded
            force.
        joint_use: largest joint acceleration during the stop, over its limit.
        quick: shortest duration of a stop that the commanded forces allow if joint limits are
            ignored [s]. Programs stop so fast if an arm does not follow its commands.
    """

    time: float
    force_use: float
    joint_use: float
    quick: float


def stop_of(job: Job, model: TimingModel) -> Stop:
    """Find the shortest stop along the path that the commanded forces allow at every point of a
    job.

    If one of the stops that they allow also keeps joint accelerations low enough, the shortest such
    stop is the usual one, and the shortest of all is the quick one.

    Args:
        job: the job.
        model: timing model of the job's workcell.

    Raises:
        JobError: the commanded forces allow no stop of the tried durations.
    """
    motions = [phase.motion for phase in job.phases]
    time = np.concatenate([phase.begin + phase.motion.time for phase in job.phases])
    held = np.concatenate(
        [np.full(len(p.motion.time), float(p.name in HELD_PHASES)) for p in job.phases]
    )
    columns = {
        name: np.concatenate([getattr(motion, name) for motion in motions])
        for name in ("pose", "rate", "second_rate", "q_rate", "q_second")
    }
    commanded = np.concatenate([phase.force.normal for phase in job.phases])
    columns["force"] = contact_model(job.workcell).held_with(commanded)
    places, x = time[::STOP_STRIDE], np.linspace(0.0, 1.0, INSTANTS)

    def stop(duration: float) -> Stop:
        """Simulate stops of a given duration [s] that begin at many points of the path.

        Returns:
            Record with the largest values over all these stops: normal force over commanded force,
            and joint acceleration over its limit.
        """
        rate = 1.0 - x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        slope = -30.0 * x**2 * (1.0 - x) ** 2 / duration
        passed = duration * (x - 2.5 * x**4 + 3.0 * x**5 - x**6)
        s = np.minimum(places[:, None] + passed, time[-1]).ravel()
        r, change = (np.tile(each, len(places))[:, None] for each in (rate, slope))
        at = {name: interpolated(s, time, values) for name, values in columns.items()}
        second = at["q_second"] * r**2 + at["q_rate"] * change
        joint_use = float(
            (np.abs(second) / job.workcell.stack_joint_limits("acceleration_max")).max()
        )
        # Between two samples of phases that hold the box, pads alone hold it.
        alone = np.interp(s, time, held) == 1.0
        box = (at["pose"], at["rate"] * r, at["second_rate"] * r**2 + at["rate"] * change)
        load = model.load(*(np.ascontiguousarray(values[alone]) for values in box))
        return Stop(
            duration, float((load["normal_force"] / at["force"][alone]).max()), joint_use, duration
        )

    found = [stop(duration) for duration in STOP_TIMES]
    bearing = [each for each in found if each.force_use <= 1.0]
    if not bearing:
        raise JobError(
            f"a stop along the path within {STOP_TIMES[-1]:g} s asks for "
            f"{100.0 * found[-1].force_use:.1f} % of the commanded forces: press more (squeeze), "
            "or choose a slower timing",
            code="command-changes-too-fast",
        )
    gentle = [each for each in bearing if each.joint_use <= JOINT_USE]
    return replace(gentle[0] if gentle else bearing[-1], quick=bearing[0].time)


REACTION = 0.12
"""From when an arm is wrong to when the other one leaves its course [s]: three looks, the time of a
message (`STRIKES` of carry_machine.py, `PERIOD` and `LEAD_OF_STOP` of run_job.py), and late news on
a loaded machine. At a load of 10 on two cores the pads of the rack's job moved apart by what 0.28 s
give at full speed; with this value its bundle states 0.3 s."""


@dataclass(frozen=True)
class PartnerStop:
    """Effect of one arm's unplanned stop at the worst moment of a job, when the other arm has to
    stop too.

    Attributes:
        time: duration of a motion at the planned speed that is as long as the other arm's motion
            until it is at rest [s].
        distance: largest displacement of the pads from their relative position that this causes
            [m].
        survived: displacement up to which friction holds the box, at most `distance` [m]; None if
            the stiffness is unknown.
        allowed: largest displacement that the cell allows, `handling.partner_stop` [m]; None for
            any.
    """

    time: float
    distance: float
    survived: float | None
    allowed: float | None

    def __str__(self) -> str:
        friction = ""
        if self.survived is not None:
            friction = f"; friction holds the box up to {1e3 * self.survived:.0f} mm"
        return (
            "If one arm stops by itself, the other one stops as well, and the pads are up to "
            f"{1e3 * self.distance:.0f} mm off their places{friction}"
        )

    @property
    def warning(self) -> str:
        """Warning and remedy if friction may not hold the box when one arm stops by itself, else
        ''.
        """
        if self.survived is None or self.distance <= self.survived:
            return ""
        return (
            f"one arm's own stop may lose the box: it moves the pads {1e3 * self.distance:.0f} mm "
            f"apart, friction holds up to {1e3 * self.survived:.0f} mm; time the carry with "
            f"[handling] partner_stop = {self.survived:.3f}"
        )
