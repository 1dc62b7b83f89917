"""A job on its way into a bundle, the file that all programs read: job.json, and a table of it.

`job.schema.json` describes the file for others; its version rises with every change that breaks a
reader.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from importlib.resources import files
from typing import Any

import numpy as np
import pinocchio as pin

from hybrid_opt.bundles.arms import prefixes
from hybrid_opt.bundles.programs.carry_job import Limits
from hybrid_opt.bundles.steps import Efforts, Gap, Stop, efforts
from hybrid_opt.job.compliance import HELD, largest_skew, require_delay, require_stiffness
from hybrid_opt.job.records import Job, SampledJob
from symbolic.array import Array
from symbolic.read.arms import arm_model, turning_joints
from symbolic.records import Workcell
from symbolic.records.poses import inverse
from symbolic.records.task import components
from symbolic.robot.model import build_robot_model

JSON_FORMAT = "dual-arm-carry job"
JSON_VERSION = 2
SCHEMA = "job.schema.json"

START, PATH = 0.005, 0.02
"""Largest distance of a pad from its first place and from its path [m]."""

BEHIND, LAGS = 0.05, 3.0
"""How far an arm may lag behind its reference [s]; at least so many times its usual lag."""

LEAST_SKEW, MOST_SKEW = 0.008, 0.05
"""Range of the distance of both arms along the path that a program watches for [s]: less cannot be
told from measured postures."""

LEAST_BAND, MOST_BAND = 0.05, 0.3
"""Range of the share by which a measured force may miss its reference."""

SILENCE = 0.1
"""Longest time without news from an arm [s]."""


Contents = Mapping[str, str | bytes]
"""File contents by path within a bundle."""


@dataclass(frozen=True)
class BundleOptions:
    """How a job is written.

    Attributes:
        step: time between samples [s]; None for the longest that keeps the forces.
        any_arm: write a maker's own language for arms that do not look like that maker's.
        stiffness: of each arm at its pad, for what a skew, a time step and position control do
            [N/m].
        skew: between the starts of both arms that the job has to survive [s]; None for what the
            target leaves to chance.
    """

    step: float | None = None
    any_arm: bool = False
    stiffness: float = 1e4
    skew: float | None = None

    def __post_init__(self) -> None:
        require_stiffness(self.stiffness)
        if self.skew is not None:
            require_delay(self.skew)


@dataclass(frozen=True, eq=False)
class Export:
    """A job on its way into a bundle.

    Attributes:
        sampled: the job at the target's time steps.
        options: how it is written.
        gap: what the time steps do to the pads.
        stop: how it stops along the path.
    """

    sampled: SampledJob
    options: BundleOptions
    gap: Gap
    stop: Stop

    @property
    def job(self) -> Job:
        """The whole job."""
        return self.sampled.job

    @property
    def workcell(self) -> Workcell:
        """The cell."""
        return self.sampled.job.workcell

    @property
    def follower(self) -> int:
        """The arm that is force-controlled."""
        return 1 - self.job.squeeze.leader

    @property
    def lag(self) -> float:
        """By which the slower of both arms follows what it is told [s]."""
        return max(robot.driver.lag for robot in self.workcell.robots)

    @property
    def step(self) -> float:
        """The longest time between two samples [s]."""
        return float(np.diff(self.sampled.time).max())

    @cached_property
    def efforts(self) -> Efforts:
        """Joint torques with and without gravity, moving and holding."""
        return efforts(self.sampled)

    @cached_property
    def limits(self) -> Limits:
        """When programs stop."""
        held = [phase.force for phase in self.job.phases if phase.name in HELD]
        spare = min(float(((f.normal - f.least) / f.normal).min()) for f in held)
        survived = largest_skew(self.job, self.options.stiffness)
        return Limits(
            stop_time=self.stop.time,
            quick_stop=self.stop.quick,
            start=START,
            path=PATH,
            behind=max(BEHIND, LAGS * self.lag),
            skew=float(np.clip(survived, LEAST_SKEW, MOST_SKEW)),
            force=float(np.clip(spare, LEAST_BAND, MOST_BAND)),
            silence=SILENCE,
        )

    def ros_joints(self, arm: int) -> list[str]:
        """Names of an arm's joints in ROS: each behind its robot's prefix."""
        prefix = prefixes(self.workcell)[arm]
        return [f"{prefix}{joint}" for joint in self.job.joint_names[arm]]

    @cached_property
    def document(self) -> dict[str, Any]:
        """The content of job.json."""
        sampled, job = self.sampled, self.job
        orientation = self.workcell.task.orientation
        spans = map(sampled.span, range(len(job.phases)))
        return {
            "format": JSON_FORMAT,
            "version": JSON_VERSION,
            "workcell": self.workcell.name,
            "time": sampled.time.tolist(),
            "phases": [
                {"name": phase.name, "first": span.start, "last": span.stop - 1}
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
        sampled, found = self.sampled, self.efforts
        robot = self.workcell.robots[arm]
        rows = {
            "position": sampled.q,
            "velocity": sampled.q_rate,
            "acceleration": sampled.q_second,
            "effort_with_gravity": found.moving,
            "effort_without_gravity": found.moving - found.gravity,
            "hold_effort_with_gravity": found.holding,
            "hold_effort_without_gravity": found.holding - found.gravity,
        }
        return {
            "name": robot.name,
            "joints": list(self.job.joint_names[arm]),
            "ros_joints": self.ros_joints(arm),
            "force_controlled": arm == self.follower,
            "reach": reach(self.workcell, arm, sampled.arm(arm, sampled.q)).tolist(),
            **{name: sampled.arm(arm, values).tolist() for name, values in rows.items()},
            "normal_force": sampled.normal_force[:, arm].tolist(),
            "wrench": sampled.wrench[:, arm].tolist(),
        }

    def carried(self, arm: int, loaded: bool) -> tuple[float, Array]:
        """What hangs on an arm's flange: mass [kg] and centre of mass (3,) in its frame [m].

        Args:
            loaded: whether half of the box is part of it.
        """
        robot, payload = self.workcell.robots[arm], self.workcell.payload
        mass, moment = 0.0, np.zeros(3)
        if robot.tool_load is not None:
            mass = robot.tool_load.mass
            moment = mass * robot.tool_load.centre_of_mass
        if loaded:
            T_flange_box = robot.T_flange_pad @ inverse(self.workcell.contacts[arm].T_box_pad)
            centre = (T_flange_box @ np.append(payload.centre_of_mass, 1.0))[:3]
            mass, moment = mass + payload.mass / 2.0, moment + payload.mass / 2.0 * centre
        return mass, moment / mass if mass else moment


def reach(workcell: Workcell, arm: int, q: Array) -> Array:
    """(n_joints,) largest way of the pad per way of each joint, at joints (n, n_joints) [m]."""
    robot = workcell.robots[arm]
    model = build_robot_model(robot)
    data, found = model.model.createData(), np.zeros(q.shape[1])
    for row in q:
        J = pin.computeFrameJacobian(model.model, data, row, model.flange_id, pin.LOCAL)
        across = np.cross(J[3:].T, robot.T_flange_pad[:3, 3])
        found = np.maximum(found, np.linalg.norm(J[:3].T + across, axis=1))
    return found


def json_files(export: Export) -> dict[str, str | bytes]:
    """The job in full precision, and its schema."""
    return {"job.json": job_text(export), SCHEMA: schema_text()}


def job_text(export: Export) -> str:
    """The text of job.json."""
    return json.dumps(export.document, allow_nan=False, separators=(",", ":")) + "\n"


def schema_text() -> str:
    """The published schema of job.json."""
    return (files("hybrid_opt.bundles") / SCHEMA).read_text("utf-8")


# --- the same as a table ---


_POSE_UNITS = ("m",) * 3 + ("rad",) * 3
_WRENCH = ("fx [N]", "fy [N]", "fz [N]", "mx [N m]", "my [N m]", "mz [N m]")
_JOINT_QUANTITIES = (
    ("position", "rad", "m"),
    ("velocity", "rad/s", "m/s"),
    ("acceleration", "rad/s^2", "m/s^2"),
    ("effort with gravity", "N m", "N"),
    ("effort without gravity", "N m", "N"),
)
"""Words for what joints do, units of those that turn and those that slide."""


def csv_text(export: Export) -> str:
    """One row per time step, one column per quantity, named with its unit."""
    job, sampled, torque = export.job, export.sampled, export.efforts
    rows = (
        sampled.q,
        sampled.q_rate,
        sampled.q_second,
        torque.moving,
        torque.moving - torque.gravity,
    )
    robots = [robot.name for robot in job.workcell.robots]
    names = zip(components(job.workcell.task.orientation), _POSE_UNITS, strict=True)
    header = ["time [s]", "phase", *(f"box {name} [{unit}]" for name, unit in names)]
    columns = [sampled.pose]
    for (word, unit, sliding), values in zip(_JOINT_QUANTITIES, rows, strict=True):
        for robot, joints in zip(job.workcell.robots, job.joint_names, strict=True):
            header += [
                f"{robot.name}/{joint} {word} [{unit if turns else sliding}]"
                for joint, turns in zip(joints, turning_joints(arm_model(robot)), strict=True)
            ]
        columns.append(values)
    header += [f"{robot} normal force [N]" for robot in robots]
    header += [f"{robot} wrench {name}" for robot in robots for name in _WRENCH]
    columns += [sampled.normal_force, sampled.wrench.reshape(len(sampled.time), -1)]
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(header)
    table = np.concatenate(columns, axis=1).tolist()
    for time, phase, row in zip(sampled.time.tolist(), sampled.phase_names, table, strict=True):
        writer.writerow([repr(time), phase, *map(repr, row)])
    return file.getvalue()
