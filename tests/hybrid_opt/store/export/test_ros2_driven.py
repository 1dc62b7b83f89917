"""The ROS 2 bundle's numbers, read from its files, drive the simulated cell: the box arrives."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import yaml

pytest.importorskip("mujoco")

from hybrid_opt.job.records import Job
from hybrid_opt.job.sampling import sample_job
from hybrid_opt.store.export import FORMATS, BundleOptions
from hybrid_opt.store.export.bundle import Contents
from hybrid_opt.timing import TimingLimits, time_path
from hybrid_opt.witness.arms import ArmOutcome, CellWitness
from hybrid_opt.witness.reference import BoxJob, JointMotion, Reference, job_reference
from symbolic.array import Array
from tests.hybrid_opt.job.jobs import rack, rack_job, rack_jobs

pytestmark = pytest.mark.slow


def read(contents: Contents, name: str) -> dict[str, list[dict[str, object]]]:
    text = contents[name]
    assert isinstance(text, str)
    found: dict[str, list[dict[str, object]]] = yaml.load(text, Loader=yaml.CSafeLoader)
    return found


def seconds(stamp: dict[str, int]) -> float:
    return stamp["sec"] + 1e-9 * stamp["nanosec"]


def reference_of(job: Job, contents: Contents, delay: float = 0.0) -> Reference:
    """What the files tell the cell; the second arm late by a delay [s]."""
    points = read(contents, "dual_arm_joint_trajectory.yaml")["points"]
    time = np.array([seconds(point["time_from_start"]) for point in points])  # type: ignore[arg-type]

    def column(name: str) -> Array:
        return np.array([point[name] for point in points])

    robots = read(contents, "wrench_references.yaml")["robots"]
    force = np.array(
        [
            [message["wrench"]["force"]["z"] for message in robot["messages"]]  # type: ignore[attr-defined]
            for robot in robots
        ]
    ).T
    rows = [column(name) for name in ("positions", "velocities", "accelerations", "effort")]
    for values in (*rows, force):
        half = values.shape[1] // 2
        late = np.column_stack([np.interp(time - delay, time, c) for c in values.T[half:]])
        values[:, half:] = late
    lift, down = job.phase("lift"), job.phase("set_down")
    box = BoxJob(
        start=job.phases[0].motion.pose[0],
        goal=job.phases[-1].motion.pose[-1, :3],
        held=(lift.begin, down.begin + down.duration),
    )
    return job_reference(job.workcell, JointMotion(time, *rows[:3]), force, box, rows[3])


@cache
def job_below(force: float | None) -> Job:
    """The hand-made trajectory's job: closest to the reference speed, or below a force [N]."""
    if force is None:
        return rack_job()
    limits = TimingLimits(force=force)
    return rack_jobs().plan(time_path(rack().timing_model, rack().initial, limits))


def driven(job: Job, delay: float = 0.0, factor: float = 1.0) -> ArmOutcome:
    contents = FORMATS["ros2"].files(sample_job(job, 0.02), BundleOptions())
    witness = CellWitness(rack().workcell)
    return witness.simulate(reference_of(job, contents, delay), "leader", factor)


@pytest.mark.parametrize("force", [None, 55.0])
def test_the_box_is_lifted_carried_and_set_down(force: float | None) -> None:
    job = job_below(force)
    found = driven(job)
    assert found.holds
    assert found.arrives
    assert found.slip.max() < 1e-3
    carry = job.phase("carry")
    inside = (found.time > carry.begin) & (found.time < carry.begin + carry.duration)
    ratio = found.normal_force[inside] / found.normal_force_reference[inside]
    assert np.abs(ratio - 1.0).max() < 0.05
    assert found.torque_use.max() <= 1.0


@pytest.mark.parametrize("force", [None, 55.0])
def test_a_skew_of_ten_milliseconds_is_survived(force: float | None) -> None:
    found = driven(job_below(force), delay=0.01)
    assert found.arrives
    assert found.slip.max() < 1e-3


def test_half_the_force_does_not_hold_the_box() -> None:
    assert not driven(rack_job(), factor=0.5).arrives
