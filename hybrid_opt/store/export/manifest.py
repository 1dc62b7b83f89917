"""The manifest: a bundle's description of itself."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import Any

from hybrid_opt.job.compliance import (
    SKEWS,
    STIFFNESSES,
    PositionControl,
    Skew,
    largest_skew,
    position_control,
    skewed,
)
from hybrid_opt.job.records import Job, SampledJob
from hybrid_opt.job.smooth import RESTS, acceleration_at_ends
from hybrid_opt.store.export.options import BundleOptions
from hybrid_opt.store.export.origin import Origin, job_digest
from hybrid_opt.store.export.start import start_of

UNITS = {
    "length": "m",
    "angle": "rad (RAPID: degrees, mm)",
    "time": "s",
    "force": "N",
    "torque": "N m",
    "stiffness": "N/m",
}

HOW_TO_RUN = {
    "csv": "one row per time step; read it with anything",
    "json": "read it with anything; docs/export.md lists the keys",
    "ros2": "ros2 launch launch/bringup.launch.py, then python3 run_job.py; mock hardware until "
    "description/cell.urdf names your own",
    "rapid": "load Carry1.mod in T_ROB1 and Carry2.mod in T_ROB2, connect CarryForce, jog both "
    "robots to carryFirst, run Carry in both tasks; first without the box, and slowly",
    "urscript": "wire digital output 0 of each arm to input 0 of the other, move both arms to the "
    "first position, run one program on each; first without the box",
    "mcap": "open job.mcap in Foxglove, or play it: ros2 bag play job.mcap",
}


def manifest(
    sampled: SampledJob, form: str, origin: Origin, options: BundleOptions
) -> dict[str, Any]:
    """JSON values: what the bundle holds, from which trajectory, and what it keeps to."""
    job = sampled.job
    stiffness, start = options.stiffness, start_of(form, options)
    return {
        "form": form,
        "name": origin.name(job),
        "digest": job_digest(job),
        "workcell": {"name": job.workcell.name, "digest": job.workcell.digest},
        "trajectory": {
            "file": origin.file,
            "sha256": origin.sha256,
            "study": origin.study,
            "algorithm": origin.algorithm,
            "replica": origin.replica,
            "point": origin.point,
        },
        "timing": {"status": job.timing.status.value, "reason": job.timing.reason},
        "duration": job.duration,
        "samples": len(sampled.time),
        "robots": [
            {"name": robot.name, "joints": list(joints)}
            for robot, joints in zip(job.workcell.robots, job.joint_names, strict=True)
        ],
        "phases": phase_documents(job),
        "stands_on": [list(names) for names in job.stands_on],
        "squeeze": {
            "text": str(job.squeeze),
            "factor": job.squeeze.factor,
            "force_controlled": job.workcell.robots[1 - job.squeeze.leader].name,
            "peak_normal_force": job.peak_normal_force.tolist(),
        },
        "position_control": [_position(position_control(job, k)) for k in STIFFNESSES],
        "start_skew": {
            "how": start.how,
            "required": start.skew,
            "survived": largest_skew(job, stiffness),
            "stiffness": stiffness,
            "cases": [_skew(skewed(job, delay, stiffness)) for delay in SKEWS],
        },
        "warnings": warnings_of(job),
        "units": UNITS,
        "how_to_run": HOW_TO_RUN[form],
        "written_by": f"dual-arm-carry {_version()}",
    }


def phase_documents(job: Job) -> list[dict[str, Any]]:
    """The phases with times, forces, proof and limits, JSON values."""
    return [
        {
            "name": phase.name,
            "begin": phase.begin,
            "duration": phase.duration,
            "peak_normal_force": phase.force.normal.max(axis=0).tolist(),
            "free_of_collisions": phase.certificate.is_free,
            "most_used": phase.most_used,
            "limits": {name: float(use) for name, use in phase.use.items()},
        }
        for phase in job.phases
    ]


def warnings_of(job: Job) -> list[str]:
    """Warnings that an engineer should read before this job runs."""
    cell, found = job.workcell, []
    peak, rated = job.peak_normal_force, cell.task.reference_force
    for robot, force, most in zip(cell.robots, peak, rated, strict=True):
        if force > most:
            found.append(
                f"{robot.name} is commanded {force:.1f} N, more than its reference force of "
                f"{most:.1f} N"
            )
    jump = acceleration_at_ends(job.timing)
    if jump > RESTS:
        found.append(
            f"the carry begins or ends with {100.0 * jump:.0f} % of a joint's largest "
            "acceleration: its timing bounds no jerk, and a controller will lag behind it there"
        )
    for names, when in zip(job.stands_on, ("before", "after"), strict=True):
        if not names:
            found.append(f"nothing that the cell describes holds the box {when} the carry")
    found += [
        f"no tool_load is given for {robot.name}: torques and tool data leave out the pad's mass"
        for robot in cell.robots
        if robot.tool_load is None
    ]
    return found


def _position(found: PositionControl) -> dict[str, Any]:
    return {
        "stiffness": found.stiffness,
        "penetration": found.penetration.tolist(),
        "force_error_of_0.1_mm_each": found.force_error,
        "share_of_force": found.share,
        "margin": found.margin,
        "enough": found.verdict,
    }


def _skew(found: Skew) -> dict[str, Any]:
    return {
        "delay": found.delay,
        "displacement": found.displacement,
        "force_change": found.force_change,
        "share_of_force": found.share,
        "margin": found.margin,
        "holds": found.survived,
    }


def _version() -> str:
    try:
        return version("dual-arm-carry")
    except PackageNotFoundError:
        return "from a source folder"
