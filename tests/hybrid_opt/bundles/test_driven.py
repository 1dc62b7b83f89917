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

from hybrid_opt.bundles.manifest import phase_documents
from hybrid_opt.bundles.programs.carry_job import Job
from hybrid_opt.witness.arms import ArmOutcome, CellWitness
from hybrid_opt.witness.reference import BoxJob, JointMotion, Reference, job_reference
from hybrid_opt.witness.scene import ArmSettings
from symbolic.array import Array
from tests.hybrid_opt.bundles import test_egm
from tests.hybrid_opt.bundles.bundles import contents
from tests.hybrid_opt.bundles.mock_ros import STEP, World, run
from tests.hybrid_opt.bundles.test_run_job import FAULTS, SETTLED, column
from tests.hybrid_opt.job.jobs import rack, rack_job

pytestmark = pytest.mark.slow

TRACKED = 0.05
SLIP = 5e-4
MIDDLE_BOARD, LINER = 0.60, 1.012
"""Heights on which the rack's box stands before and after [m]."""


@cache
def job() -> Job:
    return Job(json.loads(contents("ros2-control")["job.json"]))


@cache
def witness() -> CellWitness:
    """Pads that press evenly, as the drivable cell's model has them."""
    return CellWitness(rack().workcell, ArmSettings(pads="even"))


def reference(time: Array, q: Array, effort: Array | None, goal: bool) -> Reference:
    """What arms were told, at moments; forces are those of the places where they were sent."""
    rate = np.gradient(q, time, axis=0)
    force = np.array([[job().force(arm, s) for arm in (0, 1)] for s in coordinates(q)])
    workcell = rack().workcell
    start, end = (workcell.task.waypoints[k].lower.copy() for k in (0, -1))
    for pose, board in ((start, MIDDLE_BOARD), (end, LINER)):
        pose[2] = board + workcell.payload.size[2] / 2.0
    lifted = np.flatnonzero(coordinates(q) > job().begin("lift"))
    down = np.flatnonzero(coordinates(q) > job().begin("release"))
    held = (float(time[lifted[0]]), float(time[down[0]] if len(down) else time[-1]))
    box = BoxJob(start, end[:3] if goal else None, held)
    motion = JointMotion(time, q, rate, np.gradient(rate, time, axis=0))
    return job_reference(workcell, motion, force, box, effort)


def coordinates(q: Array) -> Array:
    """(n,) where along the path rows (n, joints) are; in rests, as far as time has passed."""
    samples = np.array([[job().position(a, s) for a in (0, 1)] for s in job().time])
    rows = samples.reshape(len(samples), -1)
    found, k = np.empty(len(q)), 0
    times = np.array(job().time)
    for i, row in enumerate(q):
        window = slice(k, min(k + 40, len(rows)))
        away = np.abs(rows[window] - row).max(axis=1)
        k += int(np.argmin(away))
        resting = np.abs(rows[min(k + 1, len(rows) - 1)] - rows[k]).max() < 1e-6
        if resting and i and np.abs(q[i] - q[i - 1]).max() < 1e-9 and k < len(rows) - 1:
            step = times[k + 1] - times[k]
            k += int(i % max(1, round(step / STEP)) == 0)
        found[i] = times[k]
    return found


def judged(found: ArmOutcome, arrives: bool) -> None:
    print(f"slip {1e3 * found.slip.max():.2f} mm, misses {1e3 * found.misses:.2f} mm")
    assert found.holds
    assert found.arrives or not arrives
    assert found.slip.max() < SLIP


def commanded(world: World) -> tuple[Array, Array, Array]:
    time, q, effort = (column(world, k) for k in range(3))
    return time - time[0], q, effort


def test_the_ros2_program_carries_the_box(tmp_path: Path) -> None:
    code, world = run(dict(contents("ros2-control")), tmp_path, lambda world: None, [])
    assert code == 0
    time, q, effort = commanded(world)
    found = witness().simulate(reference(time, q, effort, goal=True), "leader")
    judged(found, arrives=True)
    (carry,) = (p for p in phase_documents(rack_job()) if p["name"] == "carry")
    begin = float(np.interp(carry["begin"], coordinates(q), time))
    inside = (found.time > begin + 0.2) & (found.time < begin + carry["duration"] - 0.2)
    ratio = found.normal_force[inside] / found.normal_force_reference[inside]
    assert np.abs(ratio - 1.0).max() < TRACKED


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
    cell = test_egm.Cell()
    cell.run(lambda cell: cell.stream.machine.state == "done")
    time = np.array([row[0] for row in cell.record])
    q = np.array([row[4] for row in cell.record])
    # The way into the box is the simulated force control's own business.
    s = np.array([row[1] for row in cell.record])
    q[:, 6:] = [job().position(1, each) for each in s]
    found = witness().simulate(reference(time - time[0], q, None, goal=True), "leader")
    judged(found, arrives=True)


def test_half_the_force_does_not_hold_the_box(tmp_path: Path) -> None:
    _, world = run(dict(contents("ros2-control")), tmp_path, lambda world: None, [])
    time, q, effort = commanded(world)
    told = reference(time, q, effort, goal=True)
    assert not witness().simulate(told, "leader", 0.5).arrives
