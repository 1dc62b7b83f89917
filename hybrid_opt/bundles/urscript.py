"""Two URScript programs for a pair of e-series arms: servoj streams, force mode, digital lines.

Functions after Universal Robots' script manual: servoj, force_mode, force_mode_set_damping,
force_mode_set_gain_scaling, end_force_mode, zero_ftsensor, set_tcp, set_target_payload, force,
get_actual_joint_positions, set_standard_digital_out, threads. docs/export.md says how to wire and
run them.

Each point of the path is one call of `go`. Where the job has to stop, `go` stretches the time of
the points until the arm stands: on the path, under force. `programs/carry.script` has all but the
numbers of a job.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from string import Template

import numpy as np
from scipy.spatial.transform import Rotation

from hybrid_opt.bundles.arms import comment, robot_prefix
from hybrid_opt.bundles.job_file import Export
from hybrid_opt.bundles.programs import program
from hybrid_opt.bundles.programs.carry_job import PRESSED
from hybrid_opt.job.motions import TICK
from hybrid_opt.job.records import HELD
from symbolic.array import Array
from symbolic.errors import SettingsError

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
    return Template(program("carry.script")).substitute(
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
