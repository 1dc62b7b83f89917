"""What programs command drives the simulated cell: the box arrives, or is held where it stops.

Every target's program runs unedited against its mock, with faults; what it told the arms is then
what MuJoCo's arms are told, and the force that it told is what the pressing arm controls.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

pytest.importorskip("mujoco")

from hybrid_opt.extras.bundles import BundleOptions
from hybrid_opt.extras.bundles.bundle import prepared
from hybrid_opt.extras.bundles.job_file import Contents, pad_errors
from hybrid_opt.extras.bundles.programs.carry_job import Job
from hybrid_opt.extras.bundles.targets import CYCLE_SKEW, SKEW, target_for
from hybrid_opt.extras.simulation.arms import ArmOutcome, CellSimulation
from hybrid_opt.extras.simulation.reference import (
    BoxJob,
    Control,
    JointMotion,
    Reference,
    job_reference,
    press_torque,
)
from hybrid_opt.timing.records import TimingLimits
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array
from symbolic.robot.model import build_robot_model
from tests.hybrid_opt.extras.bundles import test_abb, test_urscript
from tests.hybrid_opt.extras.bundles.bundles import read_job as job
from tests.hybrid_opt.extras.bundles.mock_ros import World, run
from tests.hybrid_opt.extras.bundles.test_run_job import begins, column, sound, with_fault
from tests.hybrid_opt.job.jobs import rack, rack_jobs

pytestmark = pytest.mark.slow

TRACKED = 0.05
STIFFNESS = 1e4
SLIP = 5e-4
"""[m]."""

MIDDLE_BOARD, LINER = 0.60, 1.012
"""Heights on which the rack's box stands before and after [m]."""


def fast_files() -> Contents:
    """The bundle of the hand-made trajectory below 55 N planned."""
    timing = time_path(rack().timing_model, rack().initial, TimingLimits(force=55.0))
    job = rack_jobs().plan(timing)
    return target_for("torque", job.workcell).files(prepared(job, "torque", BundleOptions()))


@cache
def witness() -> CellSimulation:
    """Pads that press evenly, as the drivable cell's model has them."""
    return CellSimulation(rack().workcell)


@dataclass(frozen=True, eq=False)
class Commands:
    """What a program told the arms at n moments.

    Attributes:
        time: (n,) [s].
        q: (n, joints) both arms side by side [rad].
        effort: (n, joints) whole torques; None where the arms make them up themselves, for what
            they know to carry [N m].
        force: (n,) that the second arm is told to press with; None where it follows from the
            efforts [N].
    """

    time: Array
    q: Array
    effort: Array | None = None
    force: Array | None = None


def reference(told: Commands, goal: bool, carried: Job, delay: float = 0.0) -> Reference:
    """What the simulated arms are told, the second one a delay later [s]."""
    workcell, time = rack().workcell, told.time
    where = coordinates(time, told.q, carried)
    force = np.array([[carried.force(arm, s) for arm in (0, 1)] for s in where])
    effort = told.effort
    if effort is None:
        rows = [[carried.effort(a, "with_gravity", s, 1.0) for a in (0, 1)] for s in where]
        effort = np.array(rows).reshape(len(where), -1)
    if told.force is not None:
        more = np.repeat((told.force - force[:, 1])[:, None], effort.shape[1], axis=1)
        effort = effort + more * press_torque(workcell, told.q)
        force[:, 1] = told.force
    q, effort = late(time, told.q, delay), late(time, effort, delay)
    rate = np.gradient(q, time, axis=0)
    start, end = (workcell.task.waypoints[k].lower.copy() for k in (0, -1))
    for pose, board in ((start, MIDDLE_BOARD), (end, LINER)):
        pose[2] = board + workcell.payload.size[2] / 2.0
    lifted = np.flatnonzero(where > carried.begin("lift"))
    down = np.flatnonzero(where > carried.begin("release"))
    held = (float(time[lifted[0]]), float(time[down[0]] if len(down) else time[-1]))
    box = BoxJob(start, end[:3] if goal else None, held)
    motion = JointMotion(time, q, rate, np.gradient(rate, time, axis=0))
    return job_reference(workcell, motion, force, box, effort)


def coordinates(time: Array, q: Array, carried: Job) -> Array:
    """(n,) where along the path rows (n, joints) are: as far as time has passed since it began,
    or, where the job stopped, where the arms are."""
    grid = np.arange(0.0, carried.end, 0.01)
    rows = np.array([[carried.position(a, s) for a in (0, 1)] for s in grid]).reshape(len(grid), -1)
    middle = int(np.searchsorted(grid, carried.begin("carry") + 1.0))
    begin = time[int(np.argmin(np.abs(q - rows[middle]).max(axis=1)))] - grid[middle]
    found = np.clip(time - begin, 0.0, carried.end)
    for k, s in enumerate(found):
        away = np.abs(rows[min(int(s / 0.01), len(rows) - 1)] - q[k]).max()
        if away > 0.05:
            found[k] = grid[int(np.argmin(np.abs(rows - q[k]).max(axis=1)))]
    return np.asarray(found)


def judged(found: ArmOutcome, arrives: bool, slip: float = SLIP) -> None:
    print(f"slip {1e3 * found.slip.max():.2f} mm, misses {1e3 * found.misses:.2f} mm")
    assert found.holds
    assert found.arrives or not arrives
    assert found.slip.max() < slip


def late(time: Array, rows: Array, delay: float) -> Array:
    """The second arm's columns a delay later [s]."""
    shifted = rows.copy()
    for k in range(rows.shape[1] // 2, rows.shape[1]):
        shifted[:, k] = np.interp(time - delay, time, rows[:, k])
    return shifted


def by_torque(world: World) -> Commands:
    """Efforts without gravity: the arms bear themselves."""
    time, q, effort = (column(world, k) for k in range(3))
    own = np.zeros_like(q)
    for arm, robot in enumerate(rack().workcell.robots):
        model = build_robot_model(robot).model
        data, part = model.createData(), slice(6 * arm, 6 * arm + 6)
        own[:, part] = [pin.computeGeneralizedGravity(model, data, row) for row in q[:, part]]
    return Commands(time - time[0], q, effort + own)


def by_urscript() -> Commands:
    arms = test_urscript.pair().run().arms
    n = min(len(arm.record) for arm in arms)
    time, first, _ = zip(*arms[0].record[:n], strict=True)
    _, second, force = zip(*arms[1].record[:n], strict=True)
    return Commands(np.array(time), np.hstack([first, second]), force=np.array(force))


def by_egm() -> Commands:
    cell = test_abb.Cell()
    cell.run("done")
    time, s, _, wanted, q = (np.array(column) for column in zip(*cell.record, strict=True))
    # The way into the box is the simulated force control's own business.
    q[:, 6:] = [job().position(1, each) for each in s]
    return Commands(time - time[0], q, force=wanted)


PROGRAMS: dict[str, tuple[Callable[[], Commands], Control, float]] = {
    "torque": (lambda: by_torque(sound("simulation")), "impedance", 0.0),
    "torque of two drivers": (lambda: by_torque(sound("franka")), "impedance", CYCLE_SKEW),
    "ur-script": (by_urscript, "leader", SKEW),
    "abb-egm": (by_egm, "leader", 0.004),
}
"""What runs each target's program, what its arms control, and their largest skew [s]."""


@cache
def told_by(target: str) -> Commands:
    return PROGRAMS[target][0]()


@pytest.mark.parametrize(
    ("target", "delay"),
    [(target, delay) for target in PROGRAMS for delay in {0.0, PROGRAMS[target][2]}],
)
def test_every_program_carries_the_box(target: str, delay: float) -> None:
    """In step, and with the second arm as late as the target has to reckon with."""
    told = told_by(target)
    aims = reference(told, True, job(), delay)
    found = witness().simulate(aims, PROGRAMS[target][1])
    where = coordinates(told.time, told.q, job())
    within(found, told.time, where, job(), f"{target}, {1e3 * delay:g} ms late")
    judged(found, arrives=True)
    along = pad_errors(rack().workcell, told.q[held_rows(where)][::5])[0]
    print(f"  pads apart by up to {1e3 * np.abs(along).max():.3f} mm")
    least = min(job().force(1, s) for s in where[held_rows(where)])
    assert np.abs(along).max() * STIFFNESS / 2.0 < TRACKED * least


def held_rows(where: Array) -> Any:
    return np.flatnonzero((where > job().begin("lift")) & (where < job().begin("release")))


def within(found: ArmOutcome, time: Array, where: Array, carried: Job, name: str) -> None:
    """The forces of the carry are what was told in the last 0.1 s, and nowhere less than the job's,
    to the tracking share."""
    s = np.interp(found.time, time, where)
    inside = (s > carried.begin("carry")) & (s < carried.begin("set_down"))
    force, told = found.normal_force[:, 1], found.normal_force_reference[:, 1]
    last = np.lib.stride_tricks.sliding_window_view(
        np.pad(told, (round(0.1 / np.diff(found.time).mean()), 0), mode="edge"),
        round(0.1 / np.diff(found.time).mean()) + 1,
    )
    low, high = (force / last.min(axis=1))[inside], (force / last.max(axis=1))[inside]
    planned = np.array([carried.force(1, each) for each in s[inside]])
    print(
        f"{name}: over what was told {low.min():.3f} to {high.max():.3f}, "
        f"over the job {(force[inside] / planned).min():.3f} to "
        f"{(force[inside] / planned).max():.3f}"
    )
    assert low.min() > 1.0 - TRACKED
    assert high.max() < 1.0 + TRACKED
    assert (force[inside] / planned).min() > 1.0 - TRACKED


def test_a_fast_carry_is_carried_as_well(tmp_path: Path) -> None:
    """In 2.8 s."""
    files = fast_files()
    code, world = run(files, tmp_path)
    assert code == 0
    told, carried = by_torque(world), Job(json.loads(files["job.json"]))
    where = coordinates(told.time, told.q, carried)
    for delay in (0.0, 0.01):
        found = witness().simulate(reference(told, True, carried, delay), "impedance")
        within(found, told.time, where, carried, f"torque, fast, {delay} s late")
        judged(found, arrives=True)


STOPPED = (
    ("simulation", "Ctrl-C"),
    ("simulation", "no news"),
    ("simulation", "a controller gives up"),
    ("simulation", "one arm stops"),
    ("franka", "the other arm stops"),
)


@pytest.mark.parametrize(("driver", "name"), STOPPED)
def test_a_stopped_job_holds_the_box(driver: str, name: str, tmp_path: Path) -> None:
    """Also where one arm stands at once, and the other comes to rest 50 mm farther: arms give."""
    when = begins(driver) + job().begin("carry") + 2.5
    code, world = with_fault(driver, name, when, tmp_path, hold=4.0)
    assert code == 1
    aims = reference(by_torque(world), False, job())
    found = witness().simulate(aims, "impedance")
    judged(found, arrives=False, slip=2.0 * SLIP)
    apart = pad_errors(rack().workcell, column(world, 1)[-1:])[1]
    print(f"  {driver}, {name}: told to be {1e3 * apart[0]:.0f} mm apart")


def test_half_the_force_does_not_hold_the_box() -> None:
    aims = reference(told_by("torque"), True, job())
    assert not witness().simulate(aims, "impedance", 0.5).arrives
