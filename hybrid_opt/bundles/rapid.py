"""Two synchronised RAPID tasks (ABB MultiMove) that drive a job. docs/export.md has limits.

Syntax after ABB's technical reference manual for RAPID instructions (MoveAbsJ, SyncMoveOn,
SyncMoveOff, GripLoad) and the MultiMove application manual: every move between SyncMoveOn and
SyncMoveOff carries an ID, the same in both tasks, ascending.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles.arms import ABB, SEVEN, SIX, comment, require_axes, require_maker
from hybrid_opt.bundles.manifest import BundleOptions
from hybrid_opt.job.records import SampledJob
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records.poses import inverse

TASKS = ("T_ROB1", "T_ROB2")
TWO_ARMED_TASKS = ("T_ROB_L", "T_ROB_R")
"""Task names of two robots, and of the two seven-axis arms of a YuMi."""

EXTRA = 2
"""Along the chain, the joint of a seven-axis arm that ABB counts as the seventh, `eax_a`."""

MAX_MOVES = 2000
"""A module beyond this many moves is refused: controllers load them slowly or not at all."""

LEAST_MOVE_TIME = 0.02
"""Shortest time of one move [s]: below it a controller cannot plan ahead."""

ZONE = "z1"
START_TOLERANCE = 1.0
"""How far an arm may be from the first position [degrees]; farther, the program stops."""

UNKNOWN_TOOL_MASS = 0.1
"""[kg] where the workcell gives no `tool_load`; RAPID wants more than none."""

FORCE_EVERY = 5
"""Moves between two force references."""

REFERENCES = 100
"""Entries of the table of force references."""


def rapid_files(sampled: SampledJob, options: BundleOptions) -> dict[str, str | bytes]:
    """The modules of both tasks.

    Raises:
        SettingsError: an arm is not ABB's or has neither six nor seven turning joints, or the time
            step is too short or the job too long.
    """
    require_maker(sampled.job.workcell, ABB, "RAPID", options.any_arm)
    require_axes(sampled.job.workcell, "RAPID", (SIX, SEVEN))
    moves = len(sampled.time) - 1
    step = float(np.diff(sampled.time).min())
    if step < LEAST_MOVE_TIME or moves > MAX_MOVES:
        raise SettingsError(
            f"{moves} moves of {step:g} s are too many or too short for RAPID; choose a time "
            f"step of at least {LEAST_MOVE_TIME:g} s that gives at most {MAX_MOVES} moves"
        )
    tasks = _tasks(sampled)
    # RAPID files have Windows line ends.
    return {
        f"{tasks[arm]}/Carry{arm + 1}.mod": "\r\n".join(_module(sampled, arm)) + "\r\n"
        for arm in (0, 1)
    }


def _tasks(sampled: SampledJob) -> tuple[str, str]:
    """Names of both tasks."""
    two_armed = all(len(joints) == SEVEN for joints in sampled.job.joint_names)
    return TWO_ARMED_TASKS if two_armed else TASKS


def _module(sampled: SampledJob, arm: int) -> Iterator[str]:
    job, robot, tasks = sampled.job, sampled.job.workcell.robots[arm], _tasks(sampled)
    degrees = np.rad2deg(sampled.arm(arm, sampled.q))
    yield f"MODULE Carry{arm + 1}"
    yield f"  ! {comment(job.workcell.name)}"
    yield f"  ! Robot {comment(robot.name)} in task {tasks[arm]}"
    yield f"  ! {len(degrees)} positions, {float(sampled.time[-1]):.3f} s"
    yield "  ! Positions alone do not squeeze: CarryForce has to make this arm press."
    yield f'  PERS tasks carryTasks{{2}} := [["{tasks[0]}"],["{tasks[1]}"]];'
    yield f"  PERS tooldata carryPad := {_tool_data(sampled, arm)};"
    yield f"  PERS loaddata carryHalfBox := {_load_data(sampled, arm)};"
    yield "  ! Set to TRUE when CarryForce does what it says."
    yield "  PERS bool carryForceReady := FALSE;"
    yield from _force_references(sampled, arm)
    yield "  VAR syncident carryStart;"
    yield "  VAR syncident carryEnd;"
    yield f"  CONST jointtarget carryFirst := {_target(degrees[0])};"
    yield ""
    yield from _main(sampled)
    yield from _start_check(degrees.shape[1])
    yield from _force_hook(sampled, arm)
    for index, phase in enumerate(job.phases):
        yield f"  PROC Carry_{phase.name}()"
        yield f"    ! {phase.duration:.3f} s"
        span = sampled.span(index)
        for k in range(span.start + 1, span.stop):
            zone = ZONE if k < span.stop - 1 else "fine"
            time = float(sampled.time[k] - sampled.time[k - 1])
            if k % FORCE_EVERY == 0 or k == span.stop - 1:
                # Until the next reference, no move may get less than it needs.
                needed = sampled.normal_force[k - 1 : min(k + FORCE_EVERY, span.stop), arm].max()
                yield f"    CarryForce {needed:.3f};"
            yield (
                f"    MoveAbsJ {_target(degrees[k])} \\ID:={10 * k} \\NoEOffs, "
                f"v1000 \\T:={time:.6f}, {zone}, carryPad;"
            )
        yield "  ENDPROC"
        yield ""
    yield "ENDMODULE"


def _main(sampled: SampledJob) -> Iterator[str]:
    yield "  PROC Carry()"
    yield "    CarryCheckStart;"
    yield "    SyncMoveOn carryStart, carryTasks;"
    for phase in sampled.job.phases:
        yield f"    Carry_{phase.name};"
        if phase.name == "press":
            yield "    GripLoad carryHalfBox;"
        if phase.name == "release":
            yield "    GripLoad load0;"
    yield "    SyncMoveOff carryEnd;"
    yield "  ENDPROC"
    yield ""


def _start_check(joints: int) -> Iterator[str]:
    """No move to the first position: the way there is not checked for collisions."""
    axes = [f"robax.rax_{axis}" for axis in range(1, SIX + 1)]
    axes += ["extax.eax_a"] if joints == SEVEN else []
    yield "  PROC CarryCheckStart()"
    yield "    VAR jointtarget here;"
    yield "    here := CJointT();"
    for joint in axes:
        yield f"    IF Abs(here.{joint} - carryFirst.{joint}) > {START_TOLERANCE:g} THEN"
        yield '      TPWrite "Carry: jog the robot to carryFirst, pads away from the box.";'
        yield "      Stop;"
        yield "    ENDIF"
    yield "  ENDPROC"
    yield ""


def _force_hook(sampled: SampledJob, arm: int) -> Iterator[str]:
    leads = arm == sampled.job.squeeze.leader
    yield "  PROC CarryForce(num newton)"
    if leads:
        yield "    ! This arm keeps its place; the other one presses. Nothing to do here."
    else:
        yield "    ! Here the force controller gets its reference, along z of carryPad,"
        yield "    ! e.g. that of the Force Control option, or a value for an EGM stream."
        yield "    IF carryForceReady = FALSE THEN"
        yield '      TPWrite "Carry: CarryForce is not connected; nothing would squeeze.";'
        yield "      Stop;"
        yield "    ENDIF"
    yield "  ENDPROC"
    yield ""


def _force_references(sampled: SampledJob, arm: int) -> Iterator[str]:
    """Normal forces at even times, for force controllers that take a table: interpolated between
    them, nowhere less than is needed."""
    time = np.linspace(0.0, float(sampled.time[-1]), REFERENCES)
    needed = sampled.normal_force[:, arm]
    force = np.interp(time, sampled.time, needed)
    cell = np.clip(np.searchsorted(time, sampled.time, side="right") - 1, 0, REFERENCES - 2)
    np.maximum.at(force, cell, needed)
    np.maximum.at(force, cell + 1, needed)
    for name, values in (("carryForceTime", time), ("carryForceNewton", force)):
        listed = ",".join(f"{value:.3f}" for value in values)
        yield f"  PERS num {name}{{{REFERENCES}}} := [{listed}];"


def _tool_data(sampled: SampledJob, arm: int) -> str:
    """A tooldata: the pad's frame on the flange, and the tool's load where it is known."""
    robot = sampled.job.workcell.robots[arm]
    frame = _frame(robot.T_flange_pad)
    if robot.tool_load is None:
        middle = 500.0 * robot.T_flange_pad[:3, 3]
        return f"[TRUE,{frame},{_load(UNKNOWN_TOOL_MASS, middle, np.zeros(3))}]"
    load = robot.tool_load
    return f"[TRUE,{frame},{_load(load.mass, 1e3 * load.centre_of_mass, np.diag(load.inertia))}]"


def _load_data(sampled: SampledJob, arm: int) -> str:
    """A loaddata: half of the box about its centre of mass, in the pad's frame."""
    payload, contact = sampled.job.workcell.payload, sampled.job.workcell.contacts[arm]
    centre = inverse(contact.T_box_pad) @ np.append(payload.centre_of_mass, 1.0)
    return _load(payload.mass / 2.0, 1e3 * centre[:3], np.zeros(3))


def _load(mass: float, centre: Array, inertia: Array) -> str:
    """A loaddata from a mass [kg], a centre of mass (3,) [mm] and moments (3,) [kg m^2]."""
    return f"[{mass:.4f},{_numbers(centre)},[1,0,0,0],{_numbers(inertia)[1:-1]}]"


def _frame(pose: Array) -> str:
    """A RAPID pose: position [mm] and quaternion, real part first."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return f"[{_numbers(1e3 * pose[:3, 3])},{_numbers(np.array([w, x, y, z]))}]"


def _target(degrees: Array) -> str:
    """A jointtarget; a seventh axis is an external one to RAPID, other external axes are unused."""
    if len(degrees) == SIX:
        return f"[{_numbers(degrees)},[9E9,9E9,9E9,9E9,9E9,9E9]]"
    robot = np.delete(degrees, EXTRA)
    return f"[{_numbers(robot)},[{degrees[EXTRA]:.6f},9E9,9E9,9E9,9E9,9E9]]"


def _numbers(values: Array) -> str:
    return f"[{','.join(f'{value:.6f}' for value in values)}]"
