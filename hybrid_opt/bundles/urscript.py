"""Two URScript programs for a pair of e-series arms: servoj streams, force mode, digital lines.

Functions after Universal Robots' script manual: servoj, force_mode, force_mode_set_damping,
force_mode_set_gain_scaling, end_force_mode, zero_ftsensor, set_tcp, set_target_payload, force,
get_actual_joint_positions, set_standard_digital_out, threads. docs/export.md says how to wire and
run them.

Each point of the path is one call of `go`. Where the job has to stop, `go` stretches the time of
the points until the arm stands: on the path, under force.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles.arms import UR, comment, require_axes, require_maker, robot_prefix
from hybrid_opt.bundles.job_file import BundleOptions, Export
from hybrid_opt.job.compliance import HELD
from hybrid_opt.job.motions import TICK
from hybrid_opt.job.records import Job
from symbolic.array import Array
from symbolic.errors import SettingsError

CYCLE = 0.002
"""Cycle of an e-series controller [s]."""

MAX_POINTS = 20_000

LOOKAHEAD, GAIN = 0.1, 300
"""Look-ahead time [s] and proportional gain of servoj."""

FORCE_EVERY = 0.04
"""Time between two force references [s]."""

FORCE_DAMPING, FORCE_GAIN = 0.1, 0.5
"""Of force mode: more damping than its default of 0.025, half the nominal gain."""

COMPLIANCE_SPEED = 0.05
"""Largest speed of force mode along the normal [m/s]."""

DEVIATION = 0.02
"""Largest deviation across it [m], [rad]."""

READY, BEAT, STOP, GO_ON = 0, 1, 2, 3
"""Standard digital lines: outputs READY and BEAT of each arm go to the same inputs of the other;
inputs STOP and GO_ON are for buttons."""

BEAT_TIME, BEAT_LOST = 0.02, 0.1
"""Time of one level of the heartbeat, and without a change after which the partner is lost [s]."""

MEETING = 30.0
"""Longest wait for the partner [s]."""

SEEN = 0.05
"""For so long a line stays up that the other arm has to see [s]."""

CREEP = 0.05
"""Share of the planned speed below which an arm that stops stands."""

STRIKES = 25
"""Points in a row at which the force has to be wrong."""


def require_urscript(job: Job, options: BundleOptions) -> None:
    """Refuse a job for arms that are not UR's e-series."""
    require_maker(job.workcell, UR, "URScript for e-series", options.any_arm)
    require_axes(job.workcell, "URScript")


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
    return {
        f"arm_{arm + 1}_{names[arm]}.script": "\n".join(_program(export, arm)) for arm in (0, 1)
    }


def _program(export: Export, arm: int) -> Iterator[str]:
    job, sampled, robot = export.job, export.sampled, export.workcell.robots[arm]
    first = sampled.arm(arm, sampled.q)[0]
    yield "def carry_job():"
    yield f"  # {comment(job.workcell.name)}: robot {comment(robot.name)}"
    yield "  # The programs meet before the job; a heartbeat each way tells that they live."
    yield "  global carry_stop = False"
    yield "  global carry_alive = True"
    yield "  global carry_watching = False"
    yield "  global carry_rate = 1.0"
    yield f"  global carry_q = {_list(first)}"
    yield "  global carry_newton = 0.0"
    yield "  global carry_wrong = 0"
    yield "  global carry_count = 0"
    yield f"  set_tcp({_pose(robot.T_flange_pad)})"
    yield f"  set_target_payload({_payload(export, arm, 0.0)})"
    yield from _helpers(export, arm)
    for index, phase in enumerate(job.phases):
        yield from _phase(export, arm, index, phase.name)
    yield f"  if not at_start({_list(first)}):"
    yield '    popup("Move the arm to the first position, pad off the box.", blocking=True)'
    yield "    halt"
    yield "  end"
    yield "  zero_ftsensor()"
    if arm == export.follower:
        yield f"  force_mode_set_damping({FORCE_DAMPING})"
        yield f"  force_mode_set_gain_scaling({FORCE_GAIN})"
    yield "  beating = run beat()"
    yield "  watching = run watch()"
    yield "  if not meet():"
    yield '    popup("The other arm\'s program is not there.", blocking=True)'
    yield "    halt"
    yield "  end"
    for phase in job.phases:
        yield f"  {phase.name}()"
        if phase.name == "release":
            yield "  end_force_mode()"
    yield "  global carry_watching = False"
    yield "  stopj(2.0)"
    yield "  kill watching"
    yield "  kill beating"
    yield "end"
    yield ""


def _helpers(export: Export, arm: int) -> Iterator[str]:
    step = float(np.diff(export.sampled.time).mean())
    robot = export.document["robots"][arm]
    yield "  def at_start(target):"
    yield "    # At most so far the pad is from its place: [m]"
    yield "    here = get_actual_joint_positions()"
    yield "    away = 0.0"
    for joint, way in enumerate(robot["reach"]):
        yield f"    away = away + {way:.4f} * norm(here[{joint}] - target[{joint}])"
    yield f"    return away <= {export.limits.start}"
    yield "  end"
    yield "  thread beat():"
    yield "    level = False"
    yield "    count = 0"
    yield "    while True:"
    yield "      count = count + 1"
    yield f"      if carry_alive and count >= {round(BEAT_TIME / CYCLE)}:"
    yield "        count = 0"
    yield "        level = not level"
    yield f"        set_standard_digital_out({BEAT}, level)"
    yield "      end"
    yield "      sync()"
    yield "    end"
    yield "  end"
    yield "  thread watch():"
    yield "    level = False"
    yield "    count = 0"
    yield "    while True:"
    yield "      count = count + 1"
    yield f"      if level != get_standard_digital_in({BEAT}):"
    yield "        level = not level"
    yield "        count = 0"
    yield "      end"
    yield f"      if carry_watching and count > {round(BEAT_LOST / CYCLE)}:"
    yield '        stop_job("the other arm is silent")'
    yield "      end"
    yield f"      if carry_watching and get_standard_digital_in({STOP}):"
    yield '        stop_job("stopped by hand")'
    yield "      end"
    yield "      sync()"
    yield "    end"
    yield "  end"
    yield "  def stop_job(reason):"
    yield "    # Silence stops the other arm as well."
    yield "    if not carry_stop:"
    yield "      textmsg(reason)"
    yield "    end"
    yield "    global carry_stop = True"
    yield "    global carry_alive = False"
    yield "  end"
    yield "  def meet():"
    yield "    # Raised by both when ready, taken back by both when met."
    yield "    waited = 0"
    for level in ("True", "False"):
        yield f"    set_standard_digital_out({READY}, {level})"
        wait = "not " if level == "True" else ""
        yield f"    while {wait}get_standard_digital_in({READY}):"
        yield "      waited = waited + 1"
        yield f"      if waited > {round(MEETING / CYCLE)}:"
        yield f"        set_standard_digital_out({READY}, False)"
        yield "        return False"
        yield "      end"
        yield "      keep()"
        yield "    end"
        if level == "True":
            yield "    # The other arm has to see the line before it falls."
            yield "    seen = 0"
            yield f"    while seen < {round(SEEN / CYCLE)}:"
            yield "      seen = seen + 1"
            yield "      keep()"
            yield "    end"
    yield "    global carry_watching = True"
    yield "    return True"
    yield "  end"
    yield "  def keep():"
    yield "    # One cycle at rest, under the force that was commanded last."
    yield "    push(carry_newton)"
    yield f"    servoj(carry_q, t={CYCLE}, lookahead_time={LOOKAHEAD}, gain={GAIN})"
    yield "  end"
    yield "  def hold():"
    yield "    # Both arms keep their places and press; the button GO_ON continues."
    yield "    while carry_stop:"
    yield "      keep()"
    yield f"      if get_standard_digital_in({GO_ON}):"
    yield "        global carry_alive = True"
    yield "        global carry_watching = False"
    yield "        if meet():"
    yield "          global carry_stop = False"
    yield "        else:"
    yield "          global carry_alive = False"
    yield "        end"
    yield "      end"
    yield "    end"
    yield "  end"
    yield "  def go(q, newton):"
    change = step / export.stop.quick
    yield "    if carry_stop:"
    yield f"      global carry_rate = carry_rate - {change:.7f} / carry_rate"
    yield f"      if carry_rate < {CREEP}:"
    yield f"        global carry_rate = {CREEP}"
    yield "        hold()"
    yield "      end"
    yield "    elif carry_rate < 1.0:"
    yield f"      global carry_rate = min(1.0, carry_rate + {change:.7f} / carry_rate)"
    yield "    end"
    yield "    global carry_q = q"
    yield "    global carry_newton = newton"
    yield "    push(newton)"
    yield (f"    servoj(q, t={step:.6g} / carry_rate, lookahead_time={LOOKAHEAD}, gain={GAIN})")
    yield "  end"
    yield from _forces(export, arm, step)


def _forces(export: Export, arm: int, step: float) -> Iterator[str]:
    every = max(1, math.floor(FORCE_EVERY / step + 1e-9))
    yield "  def push(newton):"
    if arm == export.follower:
        limits = [DEVIATION, DEVIATION, COMPLIANCE_SPEED, DEVIATION, DEVIATION, DEVIATION]
        yield "    # Along z of the pad, into the box; the servoj stream decides everything else."
        yield "    global carry_count = carry_count + 1"
        yield f"    if newton > 0.0 and carry_count >= {every}:"
        yield "      global carry_count = 0"
        yield "      wrench = [0.0, 0.0, newton, 0.0, 0.0, 0.0]"
        yield f"      limits = {limits}"
        yield "      force_mode(get_actual_tcp_pose(), [0, 0, 1, 0, 0, 0], wrench, 2, limits)"
        yield "    end"
    else:
        yield "    # This arm keeps its place, the other one presses."
        yield "    return True"
    yield "  end"
    yield "  def feel(newton):"
    yield f"    if norm(force() - newton) > {export.limits.force:.3f} * newton:"
    yield "      global carry_wrong = carry_wrong + 1"
    yield "    else:"
    yield "      global carry_wrong = 0"
    yield "    end"
    yield f"    if carry_wrong > {STRIKES}:"
    yield '      stop_job("the force is out of its band")'
    yield "    end"
    yield "  end"


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
        if name in HELD:
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
