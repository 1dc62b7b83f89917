"""The draft for Universal Robots without ROS: one URScript program per arm.

The programs use functions of Universal Robots' script manual: servoj, force_mode,
force_mode_set_damping, force_mode_set_gain_scaling, end_force_mode, zero_ftsensor, set_tcp,
set_target_payload, force, get_actual_joint_positions, set_standard_digital_out, threads. Each point
of the path is one call of `go`. If the job has to stop, `go` stretches the time of the points until
the arm is at rest, on the path and under force. `programs/carry.script` contains everything except
the numbers of a job.

Force mode does not execute motion along its compliant axis (ur_robot_driver main,
doc/usage/force_torque_control.rst): along the normals the pressing arm follows the other arm only
by the error of its force. Gripping hands are switched and read over standard digital lines
(set_standard_digital_out, get_standard_digital_in); neither arm is force controlled then.
set_target_payload zeroes the force sensor (script manual): the programs state the tool's load once,
before the first contact, and the box is never part of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.extras.bundles.arms import comment, robot_prefix
from hybrid_opt.extras.bundles.job_file import Export
from hybrid_opt.extras.bundles.programs import filled
from hybrid_opt.extras.bundles.programs.carry_job import PRESSED
from hybrid_opt.job.motions import TICK
from hybrid_opt.job.records import HELD_PHASES, SWITCHES, Job
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records.poses import box_rotation

CYCLE = 0.002
"""Cycle time of an e-series controller [s]."""

MAX_POINTS = 20_000

FORCE_EVERY = 0.04
"""Time between two force references [s]."""

FOLLOWED = 0.05
"""Largest speed along its normal with which force mode may move the pressing pad [m/s]. The program
gives this limit to force_mode."""


def require_followed(job: Job) -> None:
    """Check that URScript's force mode can follow the motion of the pressing pad along its normal.

    Raises:
        SettingsError: the carry is too fast; the message states the speed and remedies.
    """
    if job.follower is None:
        return
    speeds = [normal_speed(job, arm) for arm in (0, 1)]
    leader = job.squeeze.leader
    found, other = speeds[1 - leader], speeds[leader]
    if found <= FOLLOWED:
        return
    remedy = f"slow the carry down {found / FOLLOWED:.1f} times"
    if other <= FOLLOWED:
        remedy = f"let the other arm press (--leader {2 - leader}), or {remedy}"
    raise SettingsError(
        f"the pad of {job.workcell.robots[1 - leader].name!r} moves at up to {found:.3f} m/s along "
        f"its normal while it presses; force mode does not execute motion along it, and may follow "
        f"the other arm at {FOLLOWED:g} m/s: {remedy}, or choose the target torque"
    )


def normal_speed(job: Job, arm: int) -> float:
    """Return the largest speed of an arm's pad along its normal while the box is held [m/s]."""
    contact, orientation = job.workcell.contacts[arm], job.workcell.task.orientation
    fastest = 0.0
    for phase in job.held:
        motion = phase.motion
        rotation = box_rotation(orientation, motion.pose)
        pad = motion.pose[:, :3] + rotation @ contact.T_box_pad[:3, 3]
        keep = np.concatenate([[True], np.diff(motion.time) > 0.0])
        speed = np.gradient(pad[keep], motion.time[keep], axis=0)
        normal = (rotation @ contact.T_box_pad[:3, 2])[keep]
        fastest = max(fastest, float(np.abs(np.einsum("ni,ni->n", speed, normal)).max()))
    return fastest


def urscript_files(export: Export) -> dict[str, str | bytes]:
    """Return the URScript programs of both arms, as texts by path.

    Raises:
        SettingsError: the time steps are unequal or no multiple of the controller's cycle, or there
            are too many points.
    """
    steps = np.diff(export.sampled.time)
    cycles = float(steps.mean()) / CYCLE
    if np.ptp(steps) > 1e-9 or abs(cycles - round(cycles)) > 1e-6:
        raise SettingsError(
            f"time step {float(steps.mean()):g} s; URScript needs one that divides {TICK:g} s and "
            f"is a multiple of {CYCLE:g} s",
            code="time-step",
        )
    if len(export.sampled.time) > MAX_POINTS:
        raise SettingsError(
            f"{len(export.sampled.time)} points are too many for a program; choose a longer step"
        )
    names = [robot_prefix(robot.name).rstrip("_") for robot in export.workcell.robots]
    return {f"arm_{arm + 1}_{names[arm]}.script": _program(export, arm) for arm in (0, 1)}


def _program(export: Export, arm: int) -> str:
    job, robot, (mass, centre) = export.job, export.workcell.robots[arm], export.tool_load(arm)
    step, phases = float(np.diff(export.sampled.time).mean()), enumerate(job.phases)
    reach = enumerate(export.document["robots"][arm]["reach"])
    names = [phase.name for phase in job.phases]
    calls, hands = [f"  {name}()" for name in names], ""
    if job.follower is None:
        calls = ["  gripping = run watch_hands()", *calls, "  kill gripping"]
        hands = filled(
            "hands.script",
            output=robot.driver.grip_output,
            input=robot.driver.grip_input or 0,
            hears=bool(robot.driver.grip_input),
            most=math.ceil(export.limits.grip / CYCLE),
        )
    else:
        calls.insert(names.index("release") + 1, "  end_force_mode()")
    return filled(
        "carry.script",
        title=f"{comment(job.workcell.name)}: robot {comment(robot.name)}",
        first=_list(export.sampled.arm(arm, export.sampled.q)[0]),
        tcp=_pose(robot.T_flange_pad),
        payload=f"{mass:.4f}, {_list(centre)}",
        away="\n".join(
            f"    away = away + {way:.4f} * norm(here[{joint}] - target[{joint}])"
            for joint, way in reach
        ),
        start=export.limits.start,
        change=f"{step / export.stop.quick:.7f}",
        step=f"{step:.6g}",
        presses=arm == job.follower,
        followed=FOLLOWED,
        every=max(1, math.floor(FORCE_EVERY / step + 1e-9)),
        band=f"{export.limits.force:.3f}",
        hands=hands,
        phases="\n".join(line for k, p in phases for line in _phase(export, arm, k, p.name)),
        calls="\n".join(calls),
    )


def _phase(export: Export, arm: int, index: int, name: str) -> Iterator[str]:
    sampled = export.sampled
    q, span = sampled.arm(arm, sampled.q), sampled.span(index)
    force = sampled.normal_force[:, arm]
    most, presses = float(force[span].max()), export.job.follower is not None
    every = math.ceil(FORCE_EVERY / float(np.diff(sampled.time).mean()) - 1e-9)
    yield f"  def {name}():"
    if name in SWITCHES:
        yield f"    grip({SWITCHES[name]})"
    for k in range(span.start + 1, span.stop):
        newton = float(force[k]) if presses else 0.0
        if presses and name in HELD_PHASES:
            # Until the next reference no less than is needed.
            newton = float(force[k : k + every + 3].max())
        yield f"    go({_list(q[k])}, {newton:.3f})"
        # Before the box is lifted the pads have to press.
        if presses and (
            name in HELD_PHASES or (name == "press" and newton >= PRESSED * most > 0.0)
        ):
            yield f"    feel({newton:.3f})"
    if name in SWITCHES:
        yield f"    wait_for_hands({SWITCHES[name]})"
    yield "  end"


def _pose(T: Array) -> str:
    """Return a transform T (4, 4) as a pose in URScript: position [m] and rotation vector [rad]."""
    turn = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    return f"p{_list(np.concatenate([T[:3, 3], turn]))}"


def _list(values: Array) -> str:
    return f"[{', '.join(f'{value:.7f}' for value in values)}]"
