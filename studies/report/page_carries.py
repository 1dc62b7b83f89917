"""The trajectories of a report, and the whole jobs around the recommended and the hand-made one.

Each trajectory is computed independently, in any process: its timing, commanded forces, the
assumptions of the search, and its saved file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hybrid_opt as ho
from hybrid_opt.campaign.stages import ReadyCell
from hybrid_opt.carry import BoxMotion, box_motion
from hybrid_opt.display.scene import packed
from hybrid_opt.display.table import NOTHING, Table, number, torque_use
from hybrid_opt.evaluate.objectives import PAPER_OBJECTIVES
from hybrid_opt.job.motions import TICK
from hybrid_opt.job.plan import JobModel
from hybrid_opt.job.records import Job, Phase
from hybrid_opt.robust.cases import LEADER
from hybrid_opt.robust.force import robust_model
from hybrid_opt.robust.squeeze import SqueezeSettings, commanded_forces
from hybrid_opt.timing.analysis import drivable_timing
from hybrid_opt.timing.jerk import driven_timing
from hybrid_opt.timing.records import JerkLimits, Timing, TimingLimits
from hybrid_opt.timing.robustness import Margin, robustness_margins
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array
from symbolic.contact.registry import contact_model
from symbolic.errors import DualArmError
from symbolic.path.spline import resample_decisions
from symbolic.records import Workcell

RECOMMENDED_LABEL = "recommended"
RECOMMENDED_TITLE = "Recommended"
"""Name of the recommended carry in lists and pictures of the page."""

CARRY_SAMPLES = 40
PAGE_PHASE_SAMPLES = 7
"""Number of samples that the page gets of the carry of a job, and of each other phase."""

WITHOUT_JERK = "; its carry without the limits on jerk, which an export keeps"

HELD = ("lift", "carry", "set_down")
"""Names of the phases in which the pads alone hold the box."""


@dataclass(frozen=True)
class DrawnJob:
    """The job around a trajectory, or the reason why there is none.

    Attributes:
        label: name of the trajectory.
        problem: reason why no job can be planned, else ''.
        job: the planned job, None if there is none.
        remark: how the commanded forces were chosen, and which limits the timing does not keep.
        timing: timing of the trajectory, None if that failed.
        margins: largest errors of the cell's description that the commanded forces tolerate, for
            the recommended carry only.
    """

    label: str
    problem: str = ""
    job: Job | None = None
    remark: str = ""
    timing: Timing | None = None
    margins: tuple[Margin, ...] = ()


def recommended_job(x: Array, cells: Sequence[ReadyCell]) -> DrawnJob:
    """Time the recommended carry as robots drive it, plan the job around it, and compute its
    robustness margins.

    Args:
        x: (n_var,) decision vector of the carry, in the last of the cells.
        cells: cells of the report; the last one has the drivable time law.
    """
    model = cells[-1].jobs
    found = drawn(model, RECOMMENDED_LABEL, lambda: driven_timing(model.timing, x), True)
    if found.timing is None or found.timing.carry is None:
        return found
    return replace(found, margins=robustness_margins(model.timing, found.timing.carry))


def drawn_job(label: str, x: Array, limits: TimingLimits, cells: Sequence[ReadyCell]) -> DrawnJob:
    """Time a path as fast as its limits allow, limits on jerk included, and plan the job around it
    with the default forces of an export. This is slow.

    Args:
        label: name of the trajectory.
        x: (n_var,) decision vector of the path in the first cell.
        limits: limits of the timing in addition to those of the cell.
        cells: cells of the report: the path belongs to the first one; timing and job are computed
            in the last one, which has the drivable time law.
    """
    model = cells[-1].jobs
    (path,) = resample_decisions(x, cells[0].cell.workcell.task, model.workcell.task)
    return drawn(model, label, lambda: time_path(model.timing, path, limits), True)


def drawn(
    model: JobModel, label: str, timed: Callable[[], Timing], within_jerk: bool = False
) -> DrawnJob:
    """Time a trajectory and plan the job around it. If either fails, the result holds the message
    of the error.

    Args:
        model: planner of jobs in the cell.
        label: name of the trajectory.
        timed: function that computes the timing.
        within_jerk: True if the carry keeps the cell's limits on jerk.
    """
    timing = None
    try:
        timing = timed()
        job = model.plan(timing, within_jerk=within_jerk)
    except DualArmError as error:
        return DrawnJob(label, str(error), timing=timing)
    bounded = within_jerk or JerkLimits.from_workcell(job.workcell) is None
    remark = str(job.squeeze) + ("" if bounded else WITHOUT_JERK)
    return DrawnJob(label, "", job, remark, timing)


def job_samples(job: Job) -> Array:
    """Return samples of a job for the page: some evenly spread in each phase, and those with the
    largest forces.

    The columns are: time [s]; pose of the box (6) [m, rad]; joint positions of both arms [rad or
    m]; commanded normal force of each arm [N]; and the two forces of `needed_forces` [N], in every
    case of the uncertainty and in the nominal case. The last two are NaN except in the phases
    `HELD`, in which the arms bear the box.

    Returns:
        (k, 11 + joints) samples.
    """
    parts = []
    for phase in job.phases:
        motion, force = phase.motion, phase.force.normal
        count = CARRY_SAMPLES if phase.name == "carry" else PAGE_PHASE_SAMPLES
        rows = _rows(motion.time, count, force.argmax(axis=0))
        needed = np.full((len(rows), 2), np.nan)
        if phase.name in HELD:
            held = BoxMotion(motion.pose, motion.rate, motion.second_rate).at(rows)
            needed = needed_forces(job.workcell, held)
        time = phase.begin + motion.time
        table = np.column_stack([time, motion.pose, motion.q, force])[rows]
        parts.append(np.column_stack([table, needed]))
    return _once(np.concatenate(parts))


def needed_forces(workcell: Workcell, motion: BoxMotion) -> Array:
    """Compute the least normal force of the force-controlled arm that holds the box during a
    motion.

    Args:
        workcell: the cell, with its uncertainty.
        motion: motion of the box at n samples.

    Returns:
        (n, 2) force that is enough in every case of the uncertainty, and in the nominal case [N].
    """
    model = robust_model(workcell)
    every = model.commanded(motion, workcell.uncertainty, LEADER)
    return np.column_stack([every, model.nominal(motion, LEADER)[:, 1 - LEADER]])


def _rows(time: Array, count: int, peaks: Iterable[int]) -> NDArray[np.intp]:
    """Choose samples for the page: some evenly spread in time, given ones, the first and the last.

    Args:
        time: (n,) ascending times [s].
        count: largest number of evenly spread samples.
        peaks: indices of samples to include.

    Returns:
        Indices in ascending order, without repetition.
    """
    moments = np.linspace(time[0], time[-1], min(len(time), count))
    even = np.searchsorted(time, moments).clip(max=len(time) - 1)
    return np.unique([0, *even, *peaks, len(time) - 1])


def _once(table: Array) -> Array:
    """Remove rows of a table (n, k) whose time, in the first column, equals that of the row before.
    They occur where phases meet or an acceleration jumps."""
    return np.asarray(table[np.concatenate([[True], np.diff(table[:, 0]) > 1e-9])])


PHASE_LIMITS = (
    "joint velocity",
    "joint acceleration",
    "joint torque",
    "payload velocity",
    "payload acceleration",
)
"""Names of the limits for which the table of phases shows how much of each a phase uses."""


def phases(jobs: Sequence[DrawnJob], robots: Sequence[str]) -> Table:
    """Return the table of the phases of jobs: times, largest forces, and used shares of the limits.

    Args:
        jobs: jobs around trajectories, some of which may have failed.
        robots: names of both robots.
    """
    rows: list[tuple[str, ...]] = []

    def add(
        name: str, begin: float | None, takes: float, force: Array, use: Iterable[float]
    ) -> None:
        forces = (number(each, 1) for each in force)
        uses = (
            torque_use(value) if limit == "joint torque" else number(value, 1, 100.0)
            for limit, value in zip(PHASE_LIMITS, use, strict=True)
        )
        rows.append((name, number(begin), number(takes), *forces, *uses))

    for found in jobs:
        if found.job is None:
            rows.append((f"{found.label}: {found.problem}", *[NOTHING] * (4 + len(PHASE_LIMITS))))
            continue
        used = np.array([[phase.use[name] for name in PHASE_LIMITS] for phase in found.job.phases])
        for phase, use in zip(found.job.phases, used, strict=True):
            name = f"{found.label}: {phase.name.replace('_', ' ')}"
            add(name, phase.begin, phase.duration, phase.force.normal.max(axis=0), use)
        name, peak = f"{found.label}: all, {found.remark}", found.job.peak_normal_force
        add(name, None, found.job.duration, peak, used.max(axis=0))
    return Table(
        "phases",
        "Phases of the whole jobs.",
        (
            "trajectory and phase",
            "begins [s]",
            "takes [s]",
            *(f"force, {robot} [N]" for robot in robots),
            *(f"{name} [%]" for name in PHASE_LIMITS),
        ),
        tuple(rows),
        "Largest commanded normal forces, and largest uses of the limits with them. The "
        "recommended carry within its force, the others closest to the reference speed, as an "
        "export plans them by default; every phase is certified free of collisions. A carry ends "
        f"with rest until a cycle of {1e3 * TICK:g} ms is over.",
    )


PAGE_SAMPLES = 60
"""Number of evenly spread samples that the page gets of a trajectory, to which those with extreme
forces are added."""

DRIVEN_TITLE = "as robots drive it"
ASSUMED = "as the search assumed"
WHOLE_JOB = "the whole job"

NO_JOB = "shown of the recommended and the hand-made carry only; an export plans any"
"""Text in place of the whole job of a trajectory for which none is planned."""


@dataclass(frozen=True)
class PageTrajectory:
    """One trajectory that the page shows.

    Attributes:
        source: text on the search that found the trajectory; it is stored in a file that is saved
            from the page.
        x: (n_var,) decision vector.
        cell: index of the trajectory's cell among those of the page.
        recommended: whether it is the recommended carry.
        job: the job around the trajectory; None if none is shown.
    """

    source: str
    x: Array
    cell: int = 0
    recommended: bool = False
    job: DrawnJob | None = None


def _with_job(trajectory: dict[str, Any], found: DrawnJob) -> None:
    """Add a job to the JSON values of a trajectory, as a further entry of its list 'motions'. If
    there is no job, add the reason as 'jobProblem'.

    Args:
        trajectory: JSON values from `page_trajectory`, which are changed.
        found: the job, or the reason why there is none.
    """
    job, motions = found.job, trajectory["motions"]
    if job is None:
        trajectory["jobProblem"] = found.problem
        return
    contact = [phase.motion.contact_effort(phase.force.wrench) for phase in job.phases]
    motion = {
        "name": WHOLE_JOB,
        "peaks": _rounded(job.peak_normal_force, 4),
        "duration": round(job.duration, 5),
        "payloadLimit": motions[0]["payloadLimit"],
        **_uses(job.workcell, np.concatenate([p.effort for p in job.phases]), contact),
        "data": packed(job_samples(job), np.float32),
        "isCommanded": True,
        "remark": found.remark,
        "phases": [_phase(phase) for phase in job.phases],
    }
    motions.insert(1, motion)
    # In whole cycles of the controllers.
    trajectory["duration"] = round(job.phase("carry").duration, 5)
    trajectory["commanded"] = round(float(job.peak_normal_force[1 - LEADER]), 4)


def _phase(phase: Phase) -> dict[str, Any]:
    return {
        "name": phase.name.replace("_", " "),
        "begin": round(phase.begin, 5),
        "duration": round(phase.duration, 5),
        "peaks": _rounded(phase.force.normal.max(axis=0), 4),
        "most": phase.most_used,
        "use": round(100.0 * phase.use[phase.most_used], 2),
    }


def _rounded(values: Array, digits: int) -> list[float | None]:
    """Round values (n,) to `digits` decimals, as a list for JSON in which None stands for NaN."""
    return [None if np.isnan(value) else round(value, digits) for value in values.tolist()]


def page_trajectory(cells: Sequence[ReadyCell], shown: PageTrajectory) -> dict[str, Any]:
    """Return a trajectory of the page as JSON values: its motions, figures and texts.

    A drivable carry is timed as a job drives it, within its force limit and the limits on jerk, and
    shown with the forces to command. Other carries are timed as close to the reference speeds as
    the limits allow, and shown with planned forces.

    Args:
        cells: cells of the page; the last one has the drivable time law.
        shown: the trajectory.
    """
    cell, driving = cells[shown.cell].cell, cells[-1]
    law = cell.workcell.task.law
    judged = cell.carry(shown.x)
    assert judged.judgement is not None, "carries of a cell are judged"
    timing, problem = _timed(cell, driving, shown)
    driven, commanded, motions = None if timing is None else timing.carry, None, []
    if driven is not None and law.is_drivable:
        try:
            commanded, _ = commanded_forces(
                driven.workcell, driven, SqueezeSettings(), itemised=False
            )
        except DualArmError as error:
            problem = str(error)
    if driven is not None:
        motions.append(_motion(DRIVEN_TITLE, driven, commanded))
    if not law.is_drivable:
        motions.append(_motion(f"{ASSUMED}: {law.title}", judged))
    if not motions:
        motions.append(_motion(ASSUMED, judged))
    name = shown.source
    if shown.recommended:
        name = f"{RECOMMENDED_TITLE} ({name})"
    if not judged.judgement.feasible:
        name = f"{name} (infeasible)"
    figures = judged.figures.items()
    found = {
        "objectives": [float(value) for value in judged.judgement.objectives.values()],
        "problem": problem,
        "duration": motions[0]["duration"],
        "planned": round(float((driven or judged).peak_normal_force.max()), 4),
        "commanded": None if commanded is None else round(float(commanded[:, 1 - LEADER].max()), 4),
        "motions": motions,
        "cell": shown.cell,
        "decision": shown.x.tolist(),
        "start": [arm.q[0].tolist() for arm in judged.arms],
        "figures": {key: float(value) for key, value in figures if np.isfinite(value)},
        "provenance": {"source": shown.source},
    }
    if shown.job is not None:
        _with_job(found, shown.job)
    else:
        found["jobProblem"] = NO_JOB
    most = float(driving.cell.workcell.task.reference_force[1 - LEADER])
    found["beyond"] = found["commanded"] is not None and found["commanded"] > most * ROUNDED
    found["label"] = f"{name}: {_values(cell, judged, found)}"
    if found["beyond"]:
        found["label"] += f", above the reference force of {most:.1f} N"
    return found


ROUNDED = 1.001
"""Factor above a force limit that still counts as within it: two timings of one path agree only
that closely."""


def _timed(cell: ho.Cell, driving: ReadyCell, shown: PageTrajectory) -> tuple[Timing | None, str]:
    """Compute the timing of a trajectory as robots drive it.

    Args:
        cell: the cell of the trajectory.
        driving: the page's cell with the drivable time law, in which paths of other cells are
            timed.
        shown: the trajectory.

    Returns:
        The timing and '' on success. Otherwise the failed timing, or None if an error was raised,
        and the reason why robots cannot drive the trajectory.
    """
    task = driving.cell.workcell.task
    try:
        if not cell.workcell.task.law.is_drivable:
            path = resample_decisions(shown.x, cell.workcell.task, task)[0, : task.n_path]
            timing = time_path(driving.jobs.timing, path, ho.TimingLimits(reference_speed=True))
        elif cell.force_kind.robust and not shown.recommended:
            # Anew, robust forces take long: as the search found it.
            timing = drivable_timing(cell.timing_model, shown.x)
        else:
            timing = driven_timing(cell.timing_model, shown.x)
    except DualArmError as error:
        return None, f"robots cannot drive it: {error}"
    return timing, "" if timing.ok else f"robots cannot drive it: {timing.reason}"


def _motion(name: str, carry: ho.Carry, commanded: Array | None = None) -> dict[str, Any]:
    force = carry.normal_force if commanded is None else commanded
    found = {
        "name": name,
        "peaks": _rounded(force.max(axis=0), 4),
        "duration": round(carry.duration, 5),
        "payloadLimit": round(carry.payload_limit, 4),
        **_uses(carry.workcell, carry.torque, [carry.contact_torque]),
        "data": packed(_samples(carry, commanded), np.float32),
    }
    return found if commanded is None else {**found, "isCommanded": True}


def _uses(
    workcell: Workcell, whole: Array, contact: Sequence[Array]
) -> dict[str, list[float | None]]:
    """Return the largest share of its torque limit that each joint uses [%].

    Args:
        workcell: the cell.
        whole: (n, joints) torques of all loads [N m].
        contact: arrays (n, joints) of torques of the contact wrenches, one per phase [N m].

    Returns:
        Two lists with one share per joint, None for a joint without limit: `torqueUse` for all
        loads, `contactTorqueUse` for the contact wrenches alone.
    """
    torques = {"torqueUse": whole, "contactTorqueUse": np.concatenate(contact)}
    return {name: _rounded(joint_torque_use(workcell, each), 3) for name, each in torques.items()}


def joint_torque_use(workcell: Workcell, torque: Array) -> Array:
    """Compute the largest use of each joint's torque limit.

    Args:
        workcell: the cell.
        torque: (n, joints) joint torques of both arms side by side [N m].

    Returns:
        (joints,) uses [%]; NaN for joints without a limit.
    """
    limit = workcell.stack_joint_limits("torque_max")
    use = 100.0 * np.abs(torque).max(axis=0) / limit
    return np.where(np.isfinite(limit), use, np.nan)


def _values(cell: ho.Cell, judged: ho.Carry, found: dict[str, Any]) -> str:
    """Return the figures in the title of a trajectory as text.

    With a commanded force these are duration and commanded force. Without one, a drivable carry has
    duration and largest planned force; any other carry has both robots' planned forces, or its
    objectives if these are not the paper's.

    Args:
        cell: the cell of the trajectory.
        judged: the carry, with planned forces and objectives.
        found: JSON values of the trajectory with the keys 'duration', 'commanded' and 'planned'.
    """
    if found["commanded"] is not None:
        order = contact_model(cell.workcell).order
        return f"{found['duration']:.2f} s, {order} {found['commanded']:.1f} N"
    assert judged.judgement is not None, "carries of a cell are judged"
    values = judged.judgement.objectives
    if cell.workcell.task.law.is_drivable:
        return f"{found['duration']:.2f} s, {found['planned']:.1f} N planned"
    if tuple(values) != PAPER_OBJECTIVES:
        return ", ".join(f"{name.replace('_', ' ')} {values[name]:.4f}" for name in values)
    forces = ", ".join(
        f"{robot.name} {force:.2f} N"
        for robot, force in zip(cell.workcell.robots, judged.peak_normal_force, strict=True)
    )
    return f"{forces} planned"


def _samples(carry: ho.Carry, commanded: Array | None) -> Array:
    """Return samples of a carry for the page, with the columns that `job_samples` describes.

    Args:
        carry: the carry at n samples.
        commanded: (n, 2) commanded normal force of each arm [N]. If None, the planned forces take
            their place, and the last two columns are NaN.

    Returns:
        (k, 11 + joints) samples.
    """
    force = carry.normal_force if commanded is None else commanded
    peaks = np.concatenate([force.argmax(axis=0), force.argmin(axis=0)])
    time = carry.time - carry.time[0]
    rows = _rows(time, PAGE_SAMPLES, peaks)
    needed = np.full((len(rows), 2), np.nan)
    if commanded is not None:
        needed = needed_forces(carry.workcell, box_motion(carry).at(rows))
    table = np.column_stack([time, carry.pose, carry.q, force])[rows]
    return _once(np.column_stack([table, needed]))
