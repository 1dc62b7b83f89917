"""Jobs for ABB's Externally Guided Motion: a program streams both arms from one clock.

EGM follows positions alone. The arm that presses is therefore moved along its pad's normal by the
program: by the force over the stiffness, and an integral of the force's error. With arms of
stiffness k at their pads, k / 2 for both in series, and a lag T between a correction and its
effect, the gain 2 c / (k T) puts the crossover of the loop at c / T. With c = 0.3 the lag costs 17
of its 90 degrees of phase.
"""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pinocchio as pin

from hybrid_opt.bundles.arms import ABB, SEVEN, SIX, comment, require_axes, require_maker
from hybrid_opt.bundles.job_file import BundleOptions, Export, job_text
from hybrid_opt.bundles.programs import program
from hybrid_opt.bundles.rapid import (
    checked_start,
    require_force_control,
    target_text,
    tasks_of,
    tool_data,
)
from hybrid_opt.job.records import Job
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell
from symbolic.robot.model import build_robot_model

PORTS = (6511, 6512)
"""Of this computer, that the controller writes to for each arm."""

SAMPLE_RATE = 4
"""Of EGM's messages [ms]."""

CROSSOVER = 0.3
"""Of the force loop: its gain times its lag."""

LEAST_LAG = 0.01
"""Least lag that the force loop reckons with [s]."""

MOST_WAY, PRESS_SPEED = 1.5, 0.05
"""Of the pressing pad beyond its plan: over what its largest force needs, and [m/s]."""

MOST_SPEED_DEVIATION = 20.0
"""By which EGM may exceed the speed of its references [degrees/s]."""


def require_egm(job: Job, options: BundleOptions) -> None:
    """Refuse a job for arms that are not ABB's, whose lag nobody states, or without a sensor."""
    require_maker(job.workcell, ABB, "EGM", options.any_arm)
    require_axes(job.workcell, "EGM", (SIX, SEVEN))
    require_force_control(job, "abb-egm")
    for robot in job.workcell.robots:
        if not robot.driver.lag > 0.0:
            raise SettingsError(
                f"abb-egm compensates the lag of {robot.name!r}, 0.01 to 0.08 s by what others "
                "measured: write it into the workcell, [robots.driver] with lag = ... in seconds"
            )


def egm_files(export: Export) -> dict[str, str | bytes]:
    """The stream's program, and what starts EGM in both tasks."""
    robots, follower = export.workcell.robots, export.follower
    lag = max(LEAST_LAG, robots[follower].driver.lag)
    compliance = 2.0 / export.options.stiffness
    config = {
        "ports": list(PORTS),
        "lags": [robot.driver.lag for robot in robots],
        "sensors": [robot.driver.force_control for robot in robots],
        "press": {
            "arm": follower,
            "gain": 2.0 * CROSSOVER / (export.options.stiffness * lag),
            "compliance": compliance,
            "most": MOST_WAY * compliance * float(export.job.peak_normal_force[follower]),
            "speed": PRESS_SPEED,
        },
        "inward": inward(export.workcell, follower, export.sampled.arm(follower, export.sampled.q))
        .round(9)
        .tolist(),
    }
    tasks = tasks_of(export)
    modules = {
        f"{tasks[arm]}/CarryEgm{arm + 1}.mod": "\r\n".join(_module(export, arm)) + "\r\n"
        for arm in (0, 1)
    }
    return {
        "job.json": job_text(export),
        "config/egm.json": json.dumps(config, allow_nan=False) + "\n",
        **{name: program(name) for name in ("run_egm.py", "egm_wire.py", "carry_job.py")},
        **modules,
    }


def inward(workcell: Workcell, arm: int, q: Array) -> Array:
    """(n, n_joints) joints per way of an arm's pad along its normal, without turning it [rad/m].

    Args:
        q: (n, n_joints) of the arm [rad].
    """
    robot, found = workcell.robots[arm], np.empty_like(q)
    model = build_robot_model(robot)
    data, T = model.model.createData(), robot.T_flange_pad
    for k, row in enumerate(q):
        J = pin.computeFrameJacobian(model.model, data, row, model.flange_id, pin.LOCAL)
        J[:3] += np.cross(J[3:].T, T[:3, 3]).T
        found[k] = np.linalg.pinv(J) @ np.concatenate([T[:3, 2], np.zeros(3)])
    return found


def _module(export: Export, arm: int) -> Iterator[str]:
    robot, tasks = export.workcell.robots[arm], tasks_of(export)
    first = np.rad2deg(export.sampled.arm(arm, export.sampled.q)[0])
    axes = range(1, SIX + 1)
    yield f"MODULE CarryEgm{arm + 1}"
    yield f"  ! {comment(export.workcell.name)}"
    yield f"  ! Robot {comment(robot.name)} in task {tasks[arm]}, UdpUc device CarryUc{arm + 1}"
    yield f"  PERS tooldata carryPad := {tool_data(export, arm)};"
    yield f"  CONST jointtarget carryFirst := {target_text(first)};"
    yield "  CONST egm_minmax carryClose := [-0.001,0.001];"
    yield "  VAR egmident carryEgm;"
    yield ""
    yield "  PROC CarryEgm()"
    yield "    CarryCheckStart;"
    yield "    EGMReset carryEgm;"
    yield "    EGMGetId carryEgm;"
    yield f'    EGMSetupUC ROB_{arm + 1}, carryEgm, "default", "CarryUc{arm + 1}" \\Joint'
    yield "      \\CommTimeout:=1;"
    criteria = " ".join(f"\\J{axis}:=carryClose" for axis in axes)
    yield f"    EGMActJoint carryEgm \\Tool:=carryPad {criteria}"
    yield f"      \\LpFilter:=0 \\SampleRate:={SAMPLE_RATE}"
    yield f"      \\MaxSpeedDeviation:={MOST_SPEED_DEVIATION:g};"
    moved = " ".join(f"\\J{axis}" for axis in axes)
    yield "    ! For a day: a job that is held stands still for as long as it takes."
    yield f"    EGMRunJoint carryEgm, EGM_STOP_HOLD {moved} \\CondTime:=86400;"
    yield "    EGMReset carryEgm;"
    yield "  ERROR"
    yield "    IF ERRNO = ERR_UDPUC_COMM THEN"
    yield '      TPWrite "Carry: run_egm.py is silent; the arm holds its place.";'
    yield "      EXIT;"
    yield "    ENDIF"
    yield "  ENDPROC"
    yield ""
    yield from checked_start(len(first))
    yield "ENDMODULE"
