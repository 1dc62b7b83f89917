"""A job as CSV and as JSON."""

from __future__ import annotations

import csv
import io
import json

import numpy as np

from hybrid_opt.job.records import SampledJob
from symbolic.read.arms import arm_model, turning_joints
from symbolic.records.task import components

JSON_FORMAT = "dual-arm-carry job"
JSON_VERSION = 1
_POSE_UNITS = ("m",) * 3 + ("rad",) * 3
_WRENCH = ("fx [N]", "fy [N]", "fz [N]", "mx [N m]", "my [N m]", "mz [N m]")
_JOINT_QUANTITIES = (
    ("q", "position", "rad", "m"),
    ("q_rate", "velocity", "rad/s", "m/s"),
    ("q_second", "acceleration", "rad/s^2", "m/s^2"),
    ("effort", "effort", "N m", "N"),
)
"""Fields of `SampledJob`, the files' words for them, units of joints that turn and that slide."""


def csv_text(sampled: SampledJob) -> str:
    """One row per time step, one column per quantity, named with its unit."""
    job = sampled.job
    robots = [robot.name for robot in job.workcell.robots]
    names = zip(components(job.workcell.task.orientation), _POSE_UNITS, strict=True)
    header = ["time [s]", "phase", *(f"box {name} [{unit}]" for name, unit in names)]
    columns = [sampled.pose]
    for quantity, word, unit, sliding in _JOINT_QUANTITIES:
        for robot, joints in zip(job.workcell.robots, job.joint_names, strict=True):
            header += [
                f"{robot.name}/{joint} {word} [{unit if turns else sliding}]"
                for joint, turns in zip(joints, turning_joints(arm_model(robot)), strict=True)
            ]
        columns.append(getattr(sampled, quantity))
    header += [f"{robot} normal force [N]" for robot in robots]
    header += [f"{robot} wrench {name}" for robot in robots for name in _WRENCH]
    columns += [sampled.normal_force, sampled.wrench.reshape(len(sampled.time), -1)]
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(header)
    values = np.concatenate(columns, axis=1).tolist()
    for time, phase, row in zip(sampled.time.tolist(), sampled.phase_names, values, strict=True):
        writer.writerow([repr(time), phase, *map(repr, row)])
    return file.getvalue()


def json_text(sampled: SampledJob) -> str:
    """Everything in one object, numbers in full precision."""
    job = sampled.job
    orientation = job.workcell.task.orientation
    document = {
        "format": JSON_FORMAT,
        "version": JSON_VERSION,
        "workcell": job.workcell.name,
        "time": sampled.time.tolist(),
        "phases": [
            {"name": phase.name, "first": span.start, "last": span.stop - 1}
            for phase, span in zip(
                job.phases, map(sampled.span, range(len(job.phases))), strict=True
            )
        ],
        "box": {
            "pose": sampled.pose.tolist(),
            "rotation": orientation.rotation,
            "reference": orientation.reference.tolist(),
        },
        "robots": [
            {
                "name": robot.name,
                "joints": list(job.joint_names[i]),
                **{
                    word: sampled.arm(i, getattr(sampled, name)).tolist()
                    for name, word, *_ in _JOINT_QUANTITIES
                },
                "normal_force": sampled.normal_force[:, i].tolist(),
                "wrench": sampled.wrench[:, i].tolist(),
            }
            for i, robot in enumerate(job.workcell.robots)
        ],
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"
