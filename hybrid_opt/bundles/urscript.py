"""Two URScript programs for a pair of e-series arms: servoj streams, force mode, digital lines.

Functions after Universal Robots' script manual: servoj, force_mode, end_force_mode, zero_ftsensor,
set_tcp, set_target_payload, get_actual_joint_positions, set_standard_digital_out. docs/export.md
says how to wire and run them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles.arms import UR, comment, require_axes, require_maker, robot_prefix
from hybrid_opt.bundles.manifest import BundleOptions
from hybrid_opt.job.motions import TICK
from hybrid_opt.job.records import SampledJob
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records.poses import inverse

CYCLE = 0.002
"""Cycle of an e-series controller [s]."""

MAX_POINTS = 20_000
START_TOLERANCE = 0.02
"""How far an arm may be from the first position [rad]; farther, the program ends."""

LOOKAHEAD, GAIN = 0.1, 300
"""Look-ahead time [s] and proportional gain of servoj."""

FORCE_EVERY = 0.04
"""Time between two force references [s]."""

COMPLIANCE_SPEED = 0.05
"""Largest speed of force mode along the normal [m/s]."""

DEVIATION = 0.02
"""Largest deviation across it [m], [rad]."""

READY_OUT, READY_IN = 0, 0
"""Standard digital lines: each arm's output goes to the other's input."""

_PRESSED = ("press", "lift", "carry", "set_down", "release")


def urscript_files(sampled: SampledJob, options: BundleOptions) -> dict[str, str | bytes]:
    """The programs of both arms.

    Raises:
        SettingsError: an arm is no e-series one, or the time step is no multiple of the
            controller's cycle that fills every phase.
    """
    require_maker(sampled.job.workcell, UR, "URScript for e-series", options.any_arm)
    require_axes(sampled.job.workcell, "URScript")
    steps = np.diff(sampled.time)
    cycles = float(steps.mean()) / CYCLE
    if np.ptp(steps) > 1e-9 or abs(cycles - round(cycles)) > 1e-6:
        raise SettingsError(
            f"time step {float(steps.mean()):g} s; URScript needs one that divides {TICK:g} s and "
            f"is a multiple of {CYCLE:g} s"
        )
    if len(sampled.time) > MAX_POINTS:
        raise SettingsError(
            f"{len(sampled.time)} points are too many for a program; choose a longer time step"
        )
    names = [robot_prefix(robot.name).rstrip("_") for robot in sampled.job.workcell.robots]
    return {
        f"arm_{arm + 1}_{names[arm]}.script": "\n".join(_program(sampled, arm)) for arm in (0, 1)
    }


def _program(sampled: SampledJob, arm: int) -> Iterator[str]:
    job = sampled.job
    robot, first = job.workcell.robots[arm], sampled.arm(arm, sampled.q)[0]
    yield "def carry_job():"
    yield f"  # {comment(job.workcell.name)}: robot {comment(robot.name)}"
    yield "  # Both programs wait for one another before each phase, over a digital line each way."
    yield f"  set_tcp({_pose(robot.T_flange_pad)})"
    yield f"  set_target_payload({_payload(sampled, arm, loaded=False)})"
    yield from _helpers(sampled, arm)
    for index, phase in enumerate(job.phases):
        yield from _phase(sampled, arm, index, phase.name)
    yield f"  if not at_start({_list(first)}):"
    yield '    popup("Move the arm to the first position, pad off the box.", blocking=True)'
    yield "    halt"
    yield "  end"
    yield "  zero_ftsensor()"
    for phase in job.phases:
        yield "  meet()"
        if phase.name == "press":
            yield f"  set_target_payload({_payload(sampled, arm, loaded=True)})"
        if phase.name == "retreat":
            yield "  end_force_mode()"
            yield f"  set_target_payload({_payload(sampled, arm, loaded=False)})"
        yield f"  {phase.name}()"
    yield "  stopj(2.0)"
    yield "end"
    yield ""


def _helpers(sampled: SampledJob, arm: int) -> Iterator[str]:
    yield "  def at_start(target):"
    yield "    here = get_actual_joint_positions()"
    for joint in range(6):
        distance = f"norm(here[{joint}] - target[{joint}])"
        yield f"    if {distance} > {START_TOLERANCE}:"
        yield "      return False"
        yield "    end"
    yield "    return True"
    yield "  end"
    yield "  def meet():"
    yield "    # Raised by both when ready, taken back by both when met."
    for level in ("True", "False"):
        yield f"    set_standard_digital_out({READY_OUT}, {level})"
        wait = "not " if level == "True" else ""
        yield f"    while {wait}get_standard_digital_in({READY_IN}):"
        yield "      sync()"
        yield "    end"
    yield "  end"
    if arm != sampled.job.squeeze.leader:
        speed = f"{COMPLIANCE_SPEED}"
        limits = f"[{DEVIATION}, {DEVIATION}, {speed}, {DEVIATION}, {DEVIATION}, {DEVIATION}]"
        yield "  def push(newton):"
        yield "    # Along z of the pad, into the box; the servoj stream decides everything else."
        yield "    wrench = [0.0, 0.0, newton, 0.0, 0.0, 0.0]"
        yield f"    limits = {limits}"
        yield "    force_mode(get_actual_tcp_pose(), [0, 0, 1, 0, 0, 0], wrench, 2, limits)"
        yield "  end"


def _phase(sampled: SampledJob, arm: int, index: int, name: str) -> Iterator[str]:
    q, span = sampled.arm(arm, sampled.q), sampled.span(index)
    step = float(np.diff(sampled.time).mean())
    every = max(1, math.floor(FORCE_EVERY / step + 1e-9))
    presses = arm != sampled.job.squeeze.leader and name in _PRESSED
    yield f"  def {name}():"
    for count, k in enumerate(range(span.start + 1, span.stop)):
        if presses and (count % every == 0 or k == span.stop - 1):
            yield f"    push({sampled.normal_force[k, arm]:.3f})"
        yield f"    servoj({_list(q[k])}, t={step:.6g}, lookahead_time={LOOKAHEAD}, gain={GAIN})"
    yield "  end"


def _payload(sampled: SampledJob, arm: int, loaded: bool) -> str:
    """Arguments of set_target_payload: mass [kg] and centre of mass in the flange's frame [m]."""
    cell = sampled.job.workcell
    robot, payload = cell.robots[arm], cell.payload
    mass, moment = 0.0, np.zeros(3)
    if robot.tool_load is not None:
        mass = robot.tool_load.mass
        moment = mass * robot.tool_load.centre_of_mass
    if loaded:
        T_flange_box = robot.T_flange_pad @ inverse(cell.contacts[arm].T_box_pad)
        centre = (T_flange_box @ np.append(payload.centre_of_mass, 1.0))[:3]
        mass, moment = mass + payload.mass / 2.0, moment + payload.mass / 2.0 * centre
    return f"{mass:.4f}, {_list(moment / mass if mass else moment)}"


def _pose(T: Array) -> str:
    """A URScript pose: position [m] and rotation vector [rad]."""
    turn = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    return f"p{_list(np.concatenate([T[:3, 3], turn]))}"


def _list(values: Array) -> str:
    return f"[{', '.join(f'{value:.7f}' for value in values)}]"
