"""What programs command drives the simulated cell: the box arrives, or is held where it stops.

`run_job.py` and `run_egm.py` run unedited against their mocks, with faults; what they told the arms
is then what MuJoCo's arms are told.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")

from hybrid_opt.bundles import TARGETS, BundleOptions
from hybrid_opt.bundles.bundle import prepared
from hybrid_opt.bundles.job_file import Contents
from hybrid_opt.bundles.programs.carry_job import Job
from hybrid_opt.timing import TimingLimits, time_path
from hybrid_opt.witness.arms import ArmOutcome, CellWitness
from hybrid_opt.witness.reference import BoxJob, JointMotion, Reference, job_reference
from symbolic.array import Array
from tests.hybrid_opt.bundles import test_abb
from tests.hybrid_opt.bundles.bundles import contents
from tests.hybrid_opt.bundles.mock_ros import World, run
from tests.hybrid_opt.bundles.test_run_job import FAULTS, SETTLED, column
from tests.hybrid_opt.job.jobs import rack, rack_jobs

pytestmark = pytest.mark.slow

TRACKED = 0.05
SLIP = 5e-4
"""[m]; twice as much where an arm is late."""

MIDDLE_BOARD, LINER = 0.60, 1.012
"""Heights on which the rack's box stands before and after [m]."""


@cache
def files_of(force: float | None = None) -> Contents:
    """The bundle of the hand-made trajectory: closest to the reference speed, or below a force."""
    if force is None:
        return contents("ros2-control")
    model = rack().timing_model
    timing = time_path(model, rack().initial, TimingLimits(force=force))
    target = TARGETS["ros2-control"]
    return target.files(prepared(rack_jobs().plan(timing), target, BundleOptions()))


@cache
def job(force: float | None = None) -> Job:
    return Job(json.loads(files_of(force)["job.json"]))


@cache
def witness() -> CellWitness:
    """Pads that press evenly, as the drivable cell's model has them."""
    return CellWitness(rack().workcell)


def reference(
    time: Array, q: Array, effort: Array, goal: bool, carried: Job | None = None
) -> Reference:
    """What arms were told, at moments; forces are those of the places where they were sent."""
    carried = carried or job()
    rate = np.gradient(q, time, axis=0)
    where = coordinates(time, q, carried)
    force = np.array([[carried.force(arm, s) for arm in (0, 1)] for s in where])
    workcell = rack().workcell
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


def commanded(world: World) -> tuple[Array, Array, Array]:
    time, q, effort = (column(world, k) for k in range(3))
    return time - time[0], q, effort


def late(time: Array, rows: Array, delay: float) -> Array:
    """The second arm's columns a delay later [s]."""
    shifted = rows.copy()
    for k in range(rows.shape[1] // 2, rows.shape[1]):
        shifted[:, k] = np.interp(time - delay, time, rows[:, k])
    return shifted


@pytest.mark.parametrize("force", [None, 55.0])
@pytest.mark.parametrize("delay", [0.0, 0.01])
def test_the_ros2_program_carries_the_box(
    force: float | None, delay: float, tmp_path: Path
) -> None:
    code, world = run(dict(files_of(force)), tmp_path, lambda world: None, [])
    assert code == 0
    time, q, effort = commanded(world)
    carried = job(force)
    where = coordinates(time, q, carried)
    told = reference(time, late(time, q, delay), late(time, effort, delay), True, carried)
    found = witness().simulate(told, "leader")
    begin = float(np.interp(carried.begin("carry"), where, time))
    end = float(np.interp(carried.begin("set_down"), where, time))
    inside = (found.time > begin) & (found.time < end)
    ratio = found.normal_force[inside] / found.normal_force_reference[inside]
    print(f"{end - begin:.2f} s, {delay} s late: forces {ratio.min():.3f} to {ratio.max():.3f}")
    judged(found, arrives=True, slip=2.0 * SLIP if delay else SLIP)
    assert np.abs(ratio - 1.0).max() < TRACKED or delay


@pytest.mark.parametrize("name", ["Ctrl-C", "no news"])
def test_a_stopped_job_holds_the_box(name: str, tmp_path: Path) -> None:
    fault: Callable[[World], Any] = FAULTS[name][0]
    when = job().begin("carry") + 2.0

    def prepare(world: World) -> None:
        world.later(SETTLED + 0.5 + when, lambda: fault(world))
        for k in range(3):
            world.later(SETTLED + 0.5 + when + 4.0 + 0.2 * k, world.interrupt)

    code, world = run(dict(contents("ros2-control")), tmp_path, prepare, [])
    assert code == 1
    time, q, effort = commanded(world)
    judged(witness().simulate(reference(time, q, effort, goal=False), "leader"), arrives=False)


def test_the_egm_program_carries_the_box() -> None:
    cell = test_abb.Cell()
    cell.run(lambda cell: cell.stream.machine.state == "done")
    time = np.array([row[0] for row in cell.record])
    q = np.array([row[4] for row in cell.record])
    # The way into the box is the simulated force control's own business.
    s = np.array([row[1] for row in cell.record])
    q[:, 6:] = [job().position(1, each) for each in s]
    effort = [[job().effort(a, "with_gravity", each, 1.0) for a in (0, 1)] for each in s]
    rows = np.array(effort).reshape(len(s), -1)
    found = witness().simulate(reference(time - time[0], q, rows, goal=True), "leader")
    judged(found, arrives=True)


def test_half_the_force_does_not_hold_the_box(tmp_path: Path) -> None:
    _, world = run(dict(contents("ros2-control")), tmp_path, lambda world: None, [])
    time, q, effort = commanded(world)
    told = reference(time, q, effort, goal=True)
    assert not witness().simulate(told, "leader", 0.5).arrives
