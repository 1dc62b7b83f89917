"""Jobs in controllers' own languages: two RAPID tasks with Force Control, or a program that streams
both arms (EGM), for ABB; two URScript programs for a pair of e-series arms.

Under RAPID, moves synchronised by MultiMove (SyncMoveOn) and Force Control exclude one another, so
that the tasks plan by themselves and meet before every phase (WaitSyncTask). The pressing arm
follows its path with FCPress1LStart, FCPressL and FCPressEnd, each move with its own force; the
leader with MoveAbsJ. Forces are along z of a work object whose axes are those of the pad where it
grips.

After ABB's manuals: technical reference of RAPID instructions; application manuals MultiMove and
Force Control Standard (FC Pressure; its limitations name MultiMove's coordinated mode).
docs/export.md tells what nobody has tried.

Externally Guided Motion follows positions alone. The arm that presses is therefore moved along its
pad's normal by the program: by the force over the stiffness, and an integral of the force's error.
With arms of stiffness k at their pads, k / 2 for both in series, and a lag T between a correction
and its effect, the gain 2 c / (k T) puts the crossover of the loop at c / T. With c = 0.3 the lag
costs 17 of its 90 degrees of phase.

URScript's functions are those of Universal Robots' script manual: servoj, force_mode,
force_mode_set_damping, force_mode_set_gain_scaling, end_force_mode, zero_ftsensor, set_tcp,
set_target_payload, force, get_actual_joint_positions, set_standard_digital_out, threads;
docs/export.md says how to wire and run them. Each point of the path is one call of `go`. Where the
job has to stop, `go` stretches the time of the points until the arm stands: on the path, under
force. `programs/carry.script` has all but the numbers of a job.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles.arms import SEVEN, SIX, comment, robot_prefix
from hybrid_opt.bundles.job_file import Export, job_text, pad_jacobians, pad_places
from hybrid_opt.bundles.programs import filled, program
from hybrid_opt.bundles.programs.carry_job import PRESSED
from hybrid_opt.job.motions import TICK
from hybrid_opt.job.records import HELD, Job
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records.poses import box_rotation, inverse

TASKS = ("T_ROB1", "T_ROB2")
TWO_ARMED_TASKS = ("T_ROB_L", "T_ROB_R")
"""Task names of two robots, and of the two seven-axis arms of a YuMi."""

EXTRA = 2
"""Index along the chain of the joint that ABB counts as a seven-axis arm's seventh, `eax_a`."""

MAX_MOVES = 2000
"""A module beyond this many moves is refused: controllers load them slowly or not at all."""

LEAST_MOVE_TIME = 0.02
"""Shortest time of one move [s]: below it a controller cannot plan ahead."""

ZONE = "z15"
"""A controller rounds corners off within a zone, and within half of the shorter move: so wide a one
makes a parabola of each corner, and the speed changes without jumps."""

START_TOLERANCE = 1.0
"""How far an arm may be from the first position [degrees]; farther, the program ends."""

UNKNOWN_TOOL_MASS = 0.1
"""[kg] where the workcell gives no `tool_load`; RAPID wants more than none."""

MEETING = 60
"""Longest wait of a task for the other [s]."""

THRESHOLD = 90
"""Share of the force at which the first move under force begins [%]."""

SUPERVISED = 30
"""Farthest of the pressing pad from its path [mm]."""

MOST_TURN = 15.0
"""Most that the box may turn while it is held [degrees]: the force keeps its direction in the work
object, and misses 3.4 % of the normal force there."""

LEAST_SPEED = 0.1
"""Least speed of a move under force [mm/s], [degrees/s]."""

LEFT_OUT = "\0"
"""Marks lines of the template that only the pressing arm has, in the other's module."""


BEFORE_THE_STUDY = "before the study: a stored trajectory keeps the cell that it was found in"
"""Where a driver's key may be stated."""


def require_force_control(job: Job, target: str) -> None:
    """Refuse a job whose pressing arm has no force control.

    Raises:
        SettingsError: with the reason.
    """
    leader, robots = job.squeeze.leader, job.workcell.robots
    robot, other = robots[1 - leader], robots[leader]
    if not robot.driver.force_control:
        remedy = (
            f"let {other.name!r} press, which has it (--leader {2 - leader})"
            if other.driver.force_control
            else "where it has the option and its sensor, write [robots.driver] with "
            f"force_control = true into its section of the workcell {BEFORE_THE_STUDY}"
        )
        raise SettingsError(
            f"{target} would not squeeze: positions alone do not press, and {robot.name!r} is not "
            f"said to have ABB's Force Control; {remedy}"
        )


def require_rapid(job: Job) -> None:
    """Refuse a job of arms without Force Control, or that turns the box."""
    require_force_control(job, "abb-rapid")
    poses = np.concatenate([phase.motion.pose for phase in job.held])
    rotation = Rotation.from_matrix(box_rotation(job.workcell.task.orientation, poses))
    turned = float(np.rad2deg((rotation[0].inv() * rotation).magnitude().max()))
    if turned > MOST_TURN:
        raise SettingsError(
            f"the box turns by {turned:.0f} degrees; under abb-rapid the force keeps its direction "
            f"in the room, at most {MOST_TURN:g} degrees are allowed: choose abb-egm"
        )


def rapid_files(export: Export) -> dict[str, str | bytes]:
    """The modules of both tasks.

    Raises:
        SettingsError: the time step is too short or the job too long.
    """
    moves = len(export.sampled.time) - 1
    step = float(np.diff(export.sampled.time).min())
    if step < LEAST_MOVE_TIME or moves > MAX_MOVES:
        raise SettingsError(
            f"{moves} moves of {step:g} s are too many or too short for RAPID; choose a time "
            f"step of at least {LEAST_MOVE_TIME:g} s that gives at most {MAX_MOVES} moves"
        )
    tasks = tasks_of(export)
    return {f"{tasks[arm]}/Carry{arm + 1}.mod": _module(export, arm) for arm in (0, 1)}


def tasks_of(export: Export) -> tuple[str, str]:
    """Names of both tasks."""
    two_armed = all(len(joints) == SEVEN for joints in export.job.joint_names)
    return TWO_ARMED_TASKS if two_armed else TASKS


def _module(export: Export, arm: int) -> str:
    job, sampled, robot = export.job, export.sampled, export.workcell.robots[arm]
    tasks, q = tasks_of(export), sampled.arm(arm, sampled.q)
    presses, places, grip = arm == export.follower, list[str](), ""
    if presses:
        pad = pad_places(export.workcell, arm, q)
        T_base_grip = inverse(robot.T_world_base) @ pad[sampled.span(1).start]
        grip = f"{_frame(T_base_grip)},{_frame(np.eye(4))}"
        places = _places(export, arm)
    calls, last = [], len(job.phases) + 1
    for number, phase in enumerate(job.phases, start=1):
        calls += [_meeting(number)]
        calls += ["    GripLoad load0;"] if phase.name == "release" else []
        calls += [f"    Carry_{phase.name};"]
        calls += ["    GripLoad carryHalfBox;"] if phase.name == "press" else []
    payload, T_pad_box = export.workcell.payload, inverse(export.workcell.contacts[arm].T_box_pad)
    # Half of the box about its centre of mass, in the pad's frame.
    centre = 1e3 * (T_pad_box @ np.append(payload.centre_of_mass, 1.0))[:3]
    return _filled_module(
        "carry.mod",
        export,
        arm,
        positions=len(q),
        duration=f"{float(sampled.time[-1]):.3f}",
        first_task=tasks[0],
        second_task=tasks[1],
        load=_load(payload.mass / 2.0, centre, np.zeros(3)),
        pressing="" if presses else LEFT_OUT,
        grip=grip,
        meetings="\n".join(f"  VAR syncident carryMeet{k};" for k in range(1, last + 1)),
        calls="\n".join([*calls, _meeting(last)]),
        phases="\n".join(line for k in range(last - 1) for line in _moves(export, arm, k, places)),
    )


def _filled_module(name: str, export: Export, arm: int, **values: object) -> str:
    """A module from a template, with values of its own beside those of all."""
    robot, q = export.workcell.robots[arm], export.sampled.arm(arm, export.sampled.q)
    text = filled(
        name,
        number=arm + 1,
        cell=comment(export.workcell.name),
        robot=comment(robot.name),
        task=tasks_of(export)[arm],
        tool=_tool(export, arm),
        first=_target(np.rad2deg(q[0])),
        check="\n".join(_checked_start(q.shape[1])),
        **values,
    )
    # RAPID files have Windows line ends.
    return "\r\n".join(line for line in text.split("\n") if LEFT_OUT not in line)


def _meeting(number: int) -> str:
    return f"    WaitSyncTask \\InPos, carryMeet{number}, carryTasks \\TimeOut:={MEETING};"


def _moves(export: Export, arm: int, index: int, places: Sequence[str]) -> Iterator[str]:
    """The procedure of a phase; under force control where the pressing arm has `places`."""
    sampled, phase = export.sampled, export.job.phases[index]
    span, force, q = sampled.span(index), sampled.normal_force, sampled.arm(arm, sampled.q)
    steps, last = np.diff(sampled.time), span.stop - 1
    tool = "carryPad \\WObj:=carryGrip"
    yield f"  PROC Carry_{phase.name}()"
    yield f"    ! {phase.duration:.3f} s"
    if phase.name in ("press", "release") and not places:
        yield f"    WaitTime {phase.duration:.3f};"
    elif phase.name == "press":
        yield (
            f"    FCPress1LStart {places[last]}, v5, \\Fz:=carrySign*{force[last, arm]:.3f}, "
            f"{THRESHOLD} \\PosSupvDist:={SUPERVISED}, fine, {tool};"
        )
    elif phase.name == "release":
        yield f"    FCPressEnd {places[last]}, v5, \\DeactOnly, {tool};"
    elif phase.name in HELD and places:
        pad = pad_places(export.workcell, arm, q[span])
        way = 1e3 * np.linalg.norm(np.diff(pad[:, :3, 3], axis=0), axis=1)
        rotation = Rotation.from_matrix(pad[:, :3, :3])
        turn = np.rad2deg((rotation[:-1].inv() * rotation[1:]).magnitude())
        for j, k in enumerate(range(span.start + 1, span.stop)):
            speed, spin = (max(each[j] / steps[k - 1], LEAST_SPEED) for each in (way, turn))
            # Until the next move no less than is needed.
            newton = force[k - 1 : k + 1, arm].max()
            yield (
                f"    FCPressL {places[k]}, [{speed:.3f},{spin:.3f},5000,1000], {newton:.3f}, "
                f"{ZONE if k < last else 'fine'}, {tool};"
            )
    else:
        for k in range(span.start + 1, span.stop):
            yield (
                f"    MoveAbsJ {_target(np.rad2deg(q[k]))} \\NoEOffs, v1000 "
                f"\\T:={steps[k - 1]:.6f}, {ZONE if k < last else 'fine'}, carryPad;"
            )
    yield "  ENDPROC"
    yield ""


def _places(export: Export, arm: int) -> list[str]:
    """The pad's places as robtargets in the work object in which it grips."""
    sampled, robot = export.sampled, export.workcell.robots[arm]
    q = sampled.arm(arm, sampled.q)
    pad = pad_places(export.workcell, arm, q)
    grip = inverse(pad[sampled.span(1).start]) @ pad
    quadrant = np.floor(np.rad2deg(q) / 90.0).astype(int)
    first, fourth, sixth = (0, 3, 5) if len(robot.torque_max) == SIX else (0, 4, 6)
    found = []
    for T, turns, degrees in zip(grip, quadrant, np.rad2deg(q), strict=True):
        further = "9E9" if len(degrees) == SIX else f"{degrees[EXTRA]:.6f}"
        found.append(
            f"[{_frame(T)[1:-1]},[{turns[first]},{turns[fourth]},{turns[sixth]},0],"
            f"[{further},9E9,9E9,9E9,9E9,9E9]]"
        )
    return found


def _checked_start(joints: int) -> Iterator[str]:
    """No move to the first position: the way there is not checked for collisions."""
    axes = [f"robax.rax_{axis}" for axis in range(1, SIX + 1)]
    axes += ["extax.eax_a"] if joints == SEVEN else []
    yield "  PROC CarryCheckStart()"
    yield "    VAR jointtarget here;"
    yield "    here := CJointT();"
    for joint in axes:
        yield f"    IF Abs(here.{joint} - carryFirst.{joint}) > {START_TOLERANCE:g} THEN"
        yield '      TPWrite "Carry: jog the robot to carryFirst, pads away from the box.";'
        # After Stop, a press of Start would go on behind the check.
        yield "      EXIT;"
        yield "    ENDIF"
    yield "  ENDPROC"
    yield ""


def _tool(export: Export, arm: int) -> str:
    """A tooldata: the pad's frame on the flange, and the tool's load where it is known."""
    robot = export.workcell.robots[arm]
    frame = _frame(robot.T_flange_pad)
    if robot.tool_load is None:
        middle = 500.0 * robot.T_flange_pad[:3, 3]
        return f"[TRUE,{frame},{_load(UNKNOWN_TOOL_MASS, middle, np.zeros(3))}]"
    load = robot.tool_load
    return f"[TRUE,{frame},{_load(load.mass, 1e3 * load.centre_of_mass, np.diag(load.inertia))}]"


def _load(mass: float, centre: Array, inertia: Array) -> str:
    """A loaddata from a mass [kg], a centre of mass (3,) [mm] and moments (3,) [kg m^2]."""
    return f"[{mass:.4f},{_numbers(centre)},[1,0,0,0],{_numbers(inertia)[1:-1]}]"


def _frame(pose: Array) -> str:
    """A RAPID pose: position [mm] and quaternion, real part first."""
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
    return f"[{_numbers(1e3 * pose[:3, 3])},{_numbers(turn)}]"


def _target(degrees: Array) -> str:
    """A jointtarget; a seventh axis is an external one to RAPID, other external axes are unused."""
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
"""Least lag that the force loop reckons with [s]."""

MOST_WAY, PRESS_SPEED = 1.5, 0.05
"""Most travel of the pressing pad beyond its plan, over that of its largest force; speed [m/s]."""


def require_egm(job: Job) -> None:
    """Refuse a job of arms whose lag nobody states, or without a sensor."""
    require_force_control(job, "abb-egm")
    for robot in job.workcell.robots:
        if not robot.driver.lag > 0.0:
            raise SettingsError(
                f"abb-egm compensates the lag of {robot.name!r}, 0.01 to 0.08 s by what others "
                "measured: write [robots.driver] with lag = ... in seconds into its section of "
                f"the workcell {BEFORE_THE_STUDY}"
            )


def egm_files(export: Export) -> dict[str, str | bytes]:
    """The stream's program, and what starts EGM in both tasks."""
    robots, follower, q = export.workcell.robots, export.follower, export.sampled.q
    J = pad_jacobians(export.workcell, follower, export.sampled.arm(follower, q))
    # Along the pad's normal, without turning it.
    way = np.concatenate([robots[follower].T_flange_pad[:3, 2], np.zeros(3)])
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
        "inward": np.array([np.linalg.pinv(each) @ way for each in J]).round(9).tolist(),
    }
    tasks = tasks_of(export)
    modules = {f"{tasks[arm]}/CarryEgm{arm + 1}.mod": _egm_module(export, arm) for arm in (0, 1)}
    return {
        "job.json": job_text(export),
        "config/egm.json": json.dumps(config, allow_nan=False) + "\n",
        **{name: program(name) for name in ("run_egm.py", "carry_job.py")},
        **modules,
    }


def _egm_module(export: Export, arm: int) -> str:
    axes = range(1, SIX + 1)
    return _filled_module(
        "carry_egm.mod",
        export,
        arm,
        criteria=" ".join(f"\\J{axis}:=carryClose" for axis in axes),
        moved=" ".join(f"\\J{axis}" for axis in axes),
    )


CYCLE = 0.002
"""Cycle of an e-series controller [s]."""

MAX_POINTS = 20_000

FORCE_EVERY = 0.04
"""Time between two force references [s]."""


def urscript_files(export: Export) -> dict[str, str | bytes]:
    """The programs of both arms.

    Raises:
        SettingsError: the time step is no multiple of the controller's cycle that fills every
            phase.
    """
    steps = np.diff(export.sampled.time)
    cycles = float(steps.mean()) / CYCLE
    if np.ptp(steps) > 1e-9 or abs(cycles - round(cycles)) > 1e-6:
        raise SettingsError(
            f"time step {float(steps.mean()):g} s; URScript needs one that divides {TICK:g} s and "
            f"is a multiple of {CYCLE:g} s"
        )
    if len(export.sampled.time) > MAX_POINTS:
        raise SettingsError(
            f"{len(export.sampled.time)} points are too many for a program; choose a longer step"
        )
    names = [robot_prefix(robot.name).rstrip("_") for robot in export.workcell.robots]
    return {f"arm_{arm + 1}_{names[arm]}.script": _program(export, arm) for arm in (0, 1)}


def _program(export: Export, arm: int) -> str:
    job, robot = export.job, export.workcell.robots[arm]
    step, phases = float(np.diff(export.sampled.time).mean()), enumerate(job.phases)
    reach = enumerate(export.document["robots"][arm]["reach"])
    calls = [f"  {phase.name}()" for phase in job.phases]
    release = [phase.name for phase in job.phases].index("release")
    calls.insert(release + 1, "  end_force_mode()")
    return filled(
        "carry.script",
        title=f"{comment(job.workcell.name)}: robot {comment(robot.name)}",
        first=_list(export.sampled.arm(arm, export.sampled.q)[0]),
        tcp=_pose(robot.T_flange_pad),
        payload=_payload(export, arm, 0.0),
        away="\n".join(
            f"    away = away + {way:.4f} * norm(here[{joint}] - target[{joint}])"
            for joint, way in reach
        ),
        start=export.limits.start,
        change=f"{step / export.stop.quick:.7f}",
        step=f"{step:.6g}",
        presses=arm == export.follower,
        every=max(1, math.floor(FORCE_EVERY / step + 1e-9)),
        band=f"{export.limits.force:.3f}",
        phases="\n".join(line for k, p in phases for line in _phase(export, arm, k, p.name)),
        calls="\n".join(calls),
    )


def _phase(export: Export, arm: int, index: int, name: str) -> Iterator[str]:
    sampled = export.sampled
    q, span = sampled.arm(arm, sampled.q), sampled.span(index)
    force = sampled.normal_force[:, arm]
    most = float(force[span].max())
    every = math.ceil(FORCE_EVERY / float(np.diff(sampled.time).mean()) - 1e-9)
    yield f"  def {name}():"
    for k in range(span.start + 1, span.stop):
        # Until the next reference no less than is needed.
        ahead = k + every + 3
        newton = float(force[k:ahead].max()) if name in HELD else float(force[k])
        yield f"    go({_list(q[k])}, {newton:.3f})"
        # Before the box is lifted the pads have to press.
        if name in HELD or (name == "press" and newton >= PRESSED * most > 0.0):
            yield f"    feel({newton:.3f})"
        elif most > 0.0 and (k - span.start) % 5 == 0:
            # The box's weight goes over with the squeeze.
            yield f"    set_target_payload({_payload(export, arm, float(force[k]) / most)})"
    if name == "release":
        yield f"    set_target_payload({_payload(export, arm, 0.0)})"
    yield "  end"


def _payload(export: Export, arm: int, share: float) -> str:
    """Arguments of set_target_payload: mass [kg] and centre of mass in the flange's frame [m].

    Args:
        share: of half of the box that is part of it.
    """
    (empty, first), (loaded, second) = (export.carried(arm, each) for each in (False, True))
    mass = (1.0 - share) * empty + share * loaded
    moment = (1.0 - share) * empty * first + share * loaded * second
    return f"{mass:.4f}, {_list(moment / mass if mass else moment)}"


def _pose(T: Array) -> str:
    """A URScript pose: position [m] and rotation vector [rad]."""
    turn = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    return f"p{_list(np.concatenate([T[:3, 3], turn]))}"


def _list(values: Array) -> str:
    return f"[{', '.join(f'{value:.7f}' for value in values)}]"
