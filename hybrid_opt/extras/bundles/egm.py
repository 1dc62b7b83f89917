"""The target of ABB: a program that streams both arms by Externally Guided Motion (EGM).

EGM follows positions alone. The program therefore moves the arm that presses along its pad's
normal: by the force over the stiffness, and an integral of the force's error. Arms of stiffness k
at their pads are k / 2 in series. With a lag T between a correction and its effect, the gain
2 c / (k T) puts the crossover of the loop at c / T; with c = 0.3 the lag costs 17 of its 90 degrees
of phase.

After ABB's manuals: technical reference of RAPID instructions, application manual EGM.
"""

from __future__ import annotations

import json
import math

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.extras.bundles.arms import SECTION_OF_EACH, SEVEN, SIX, comment, plan_of
from hybrid_opt.extras.bundles.job_file import Export, job_text, pad_jacobians
from hybrid_opt.extras.bundles.programs import filled, programs
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell

TASKS = ("T_ROB1", "T_ROB2")
TWO_ARMED_TASKS = ("T_ROB_L", "T_ROB_R")
"""Names of the controller's tasks for the two seven-axis arms of a YuMi."""

EXTRA = 2
"""Index, along the kinematic chain, of the joint of a seven-axis arm that ABB calls the seventh,
`eax_a`."""

START_TOLERANCE = 1.0
"""Largest distance of a joint from the first position [degrees]; if it is larger, the program
ends."""

UNKNOWN_TOOL_MASS = 0.1
"""Mass of the tool if the workcell has no `tool_load` [kg]; RAPID does not accept zero."""


def require_egm(workcell: Workcell, leader: int) -> None:
    """Check that a cell states the delay of each arm, and that the controller of its
    force-controlled arm has ABB's Force Control.

    Args:
        workcell: the cell.
        leader: index of the position-controlled arm.

    Raises:
        SettingsError: a delay is not stated, or force control is missing.
    """
    robots = workcell.robots
    robot, other = robots[1 - leader], robots[leader]
    if not robot.driver.force_control:
        remedy = (
            f"let {other.name!r} press, which has it (--leader {2 - leader})"
            if other.driver.force_control
            else "where it has the option and its sensor, write [robots.driver] with "
            f"force_control = true into {SECTION_OF_EACH}"
        )
        raise SettingsError(
            f"abb-egm would not squeeze: positions alone do not press, and {robot.name!r} is not "
            f"said to have ABB's Force Control; {remedy}",
            code="no-force-control",
        )
    for robot in robots:
        if not robot.driver.lag > 0.0:
            raise SettingsError(
                f"abb-egm compensates the lag of {robot.name!r}, 0.01 to 0.08 s by what others "
                f"measured: write [robots.driver] with lag = ... in seconds into {SECTION_OF_EACH}",
                code="no-lag",
            )


def tasks_of(export: Export) -> tuple[str, str]:
    """Return the name of each arm's RAPID task on the controller."""
    two_armed = all(len(joints) == SEVEN for joints in export.job.joint_names)
    return TWO_ARMED_TASKS if two_armed else TASKS


def _tool(export: Export, arm: int) -> str:
    """Return RAPID's tooldata of an arm: the pad's frame on the flange, and the tool's load."""
    robot = export.workcell.robots[arm]
    frame = _frame(robot.T_flange_pad)
    if robot.tool_load is None:
        middle = 500.0 * robot.T_flange_pad[:3, 3]
        return f"[TRUE,{frame},{_load(UNKNOWN_TOOL_MASS, middle, np.zeros(3))}]"
    load = robot.tool_load
    return f"[TRUE,{frame},{_load(load.mass, 1e3 * load.centre_of_mass, np.diag(load.inertia))}]"


def _load(mass: float, centre: Array, inertia: Array) -> str:
    """Return RAPID's loaddata: mass [kg], centre (3,) [mm], principal moments of inertia (3,) [kg
    m^2]."""
    return f"[{mass:.4f},{_numbers(centre)},[1,0,0,0],{_numbers(inertia)[1:-1]}]"


def _frame(pose: Array) -> str:
    """Return RAPID's pose of a transform (4, 4): position [mm] and quaternion with the real part
    first."""
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
    return f"[{_numbers(1e3 * pose[:3, 3])},{_numbers(turn)}]"


def _target(degrees: Array) -> str:
    """Return RAPID's jointtarget for joint positions (joints,) [degrees]. Of seven joints, the
    third counts as an external axis; other external axes are unused."""
    if len(degrees) == SIX:
        return f"[{_numbers(degrees)},[9E9,9E9,9E9,9E9,9E9,9E9]]"
    robot = np.delete(degrees, EXTRA)
    return f"[{_numbers(robot)},[{degrees[EXTRA]:.6f},9E9,9E9,9E9,9E9,9E9]]"


def _numbers(values: Array) -> str:
    return f"[{','.join(f'{value:.6f}' for value in values)}]"


PORTS = (6511, 6512)
"""Ports of this computer to which the controller writes, one per arm."""

CROSSOVER = 0.3
"""Crossover of the force loop: its gain times its lag."""

LEAST_LAG = 0.01
"""Least lag that the design of the force loop assumes [s]."""

MOST_WAY, PRESS_SPEED = 1.5, 2.0
"""Largest travel of the pressing pad beyond its plan, over the travel for its largest force; and
largest speed of this travel, over the speed for the fastest planned change of the force."""

DEVIATION = 1.2
"""`MaxSpeedDeviation` over the fastest joint of an arm: abb_robot_driver's README says that it
seems to limit the speed itself."""


def egm_files(export: Export) -> dict[str, str | bytes]:
    """Return the files of the target `abb-egm` by path: the program that streams the job, and the
    RAPID code that starts EGM in the tasks of both arms."""
    robots, follower, q = export.workcell.robots, export.follower, export.sampled.q
    J = pad_jacobians(export.workcell, follower, export.sampled.arm(follower, q))
    # Along the pad's normal, without turning it.
    way = np.concatenate([robots[follower].T_flange_pad[:3, 2], np.zeros(3)])
    lags = [robot.driver.lag for robot in robots]
    lag = max(LEAST_LAG, lags[follower])
    assert export.stiffness is not None, "the target requires it"
    compliance = 2.0 / export.stiffness
    time, force = export.sampled.time, export.sampled.normal_force[:, follower]
    force_rate = float((np.abs(np.diff(force)) / np.diff(time)).max())
    config = {
        "plan": plan_of(export.workcell, "abb-egm", "run_egm.py", lags, export.stiffness, True),
        "ports": list(PORTS),
        "addresses": [robot.driver.address for robot in robots],
        "lags": lags,
        "sensors": [robot.driver.force_control for robot in robots],
        "press": {
            "arm": follower,
            "gain": CROSSOVER * compliance / lag,
            "compliance": compliance,
            "most": MOST_WAY * compliance * float(export.job.peak_normal_force[follower]),
            "speed": PRESS_SPEED * compliance * force_rate,
        },
        "inward": np.array([np.linalg.pinv(each) @ way for each in J]).round(9).tolist(),
    }
    tasks = tasks_of(export)
    modules = {f"{tasks[arm]}/CarryEgm{arm + 1}.mod": _egm_module(export, arm) for arm in (0, 1)}
    return {
        "config/egm.json": json.dumps(config, allow_nan=False) + "\n",
        "job.json": job_text(export),
        **programs("run_egm.py"),
        **modules,
    }


def _egm_module(export: Export, arm: int) -> str:
    robot, q = export.workcell.robots[arm], export.sampled.arm(arm, export.sampled.q)
    axes = range(1, SIX + 1)
    joints = [f"robax.rax_{axis}" for axis in axes]
    joints += ["extax.eax_a"] if q.shape[1] == SEVEN else []
    fastest = float(np.rad2deg(np.abs(export.sampled.arm(arm, export.sampled.q_rate)).max()))
    text = filled(
        "carry_egm.mod",
        number=arm + 1,
        cell=comment(export.workcell.name),
        robot=comment(robot.name),
        task=tasks_of(export)[arm],
        tool=_tool(export, arm),
        first=_target(np.rad2deg(q[0])),
        away="\n        OR ".join(
            f"Abs(here.{joint} - carryFirst.{joint}) > {START_TOLERANCE:g}" for joint in joints
        ),
        criteria=" ".join(f"\\J{axis}:=carryClose" for axis in axes),
        moved=" ".join(f"\\J{axis}" for axis in axes),
        deviation=math.ceil(DEVIATION * fastest),
    )
    # RAPID files have Windows line ends.
    return "\r\n".join(text.split("\n"))
