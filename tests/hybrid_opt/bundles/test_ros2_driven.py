"""The ROS 2 bundle's numbers, read from its files, drive the simulated cell: the box arrives."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("mujoco")

from hybrid_opt.bundles import FORMATS, BundleOptions
from hybrid_opt.bundles.manifest import phase_documents
from hybrid_opt.job.records import sample_job
from hybrid_opt.store.files import sha256
from hybrid_opt.timing import TimingLimits, time_path
from hybrid_opt.witness.arms import ArmOutcome, CellWitness
from hybrid_opt.witness.reference import BoxJob, JointMotion, Reference, job_reference
from symbolic.array import Array
from tests.hybrid_opt.job.jobs import rack, rack_job, rack_jobs
from tests.symbolic.cells import ROOT

pytestmark = pytest.mark.slow

TRACKED = 0.05
SLIP = 1e-3
MIDDLE_BOARD, LINER = 0.60, 1.012
"""Heights on which the rack's box stands before and after [m]."""

Files = Mapping[str, str | bytes]
Phases = list[dict[str, Any]]


def read(files: Files, name: str) -> dict[str, Any]:
    found: dict[str, Any] = yaml.load(files[name], Loader=yaml.CSafeLoader)
    return found


def seconds(stamp: dict[str, int]) -> float:
    return stamp["sec"] + 1e-9 * stamp["nanosec"]


def span(phases: Phases, name: str) -> tuple[float, float]:
    """From when to when a phase lasts [s]."""
    (phase,) = (phase for phase in phases if phase["name"] == name)
    return phase["begin"], phase["begin"] + phase["duration"]


def reference_of(files: Files, phases: Phases, delay: float = 0.0) -> Reference:
    """What the files tell the rack's cell; the second arm late by a delay [s]."""
    points = read(files, "dual_arm_joint_trajectory.yaml")["points"]
    time = np.array([seconds(point["time_from_start"]) for point in points])

    def column(name: str) -> Array:
        return np.array([point[name] for point in points])

    robots = read(files, "wrench_references.yaml")["robots"]
    force = np.array(
        [[message["wrench"]["force"]["z"] for message in robot["messages"]] for robot in robots]
    ).T
    rows = [column(name) for name in ("positions", "velocities", "accelerations", "effort")]
    for values in (*rows, force):
        half = values.shape[1] // 2
        late = np.column_stack([np.interp(time - delay, time, c) for c in values.T[half:]])
        values[:, half:] = late
    workcell = rack().workcell
    start, goal = (workcell.task.waypoints[k].lower.copy() for k in (0, -1))
    for pose, board in ((start, MIDDLE_BOARD), (goal, LINER)):
        pose[2] = board + workcell.payload.size[2] / 2.0
    box = BoxJob(start, goal[:3], (span(phases, "lift")[0], span(phases, "set_down")[1]))
    return job_reference(workcell, JointMotion(time, *rows[:3]), force, box, rows[3])


def hand_made(force: float | None) -> tuple[Files, Phases]:
    """The hand-made trajectory's job: closest to the reference speed, or below a force [N]."""
    job = rack_job()
    if force is not None:
        limits = TimingLimits(force=force)
        job = rack_jobs().plan(time_path(rack().timing_model, rack().initial, limits))
    files = FORMATS["ros2"].files(sample_job(job, 0.02), BundleOptions())
    return files, phase_documents(job)


@pytest.fixture(scope="module")
def recommended(tmp_path_factory: pytest.TempPathFactory) -> tuple[Files, Phases, float]:
    """The bundle of the carry that a small study recommends, made by the command that it tells, and
    how late an arm may be by its manifest [s]."""
    root = tmp_path_factory.mktemp("study") / "rack"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}

    def run(command: str, folder: Path) -> None:
        words = shlex.split(command)
        assert words[0] == "python"
        subprocess.run([sys.executable, *words[1:]], cwd=folder, env=environment, check=True)

    run(f"python -m studies.rack --quick --no-report --quiet --output {root}", ROOT)
    run(json.loads((root / "summary.json").read_text())["recommendation"]["export"], root)
    (path,) = root.glob("recommended-ros2/**/manifest.json")
    manifest = json.loads(path.read_text())
    files = {name: (path.parent / name).read_bytes() for name in manifest["files"]}
    assert {name: sha256(content) for name, content in files.items()} == manifest["files"]
    return files, manifest["phases"], manifest["start_skew"]["survived"]


@cache
def witness() -> CellWitness:
    return CellWitness(rack().workcell)


def judged(found: ArmOutcome, phases: Phases) -> None:
    """The box is lifted, carried and set down, and hardly slips."""
    begin, end = span(phases, "carry")
    inside = (found.time > begin) & (found.time < end)
    ratio = found.normal_force[inside] / found.normal_force_reference[inside]
    print(
        f"slip {1e3 * found.slip.max():.2f} mm, misses {1e3 * found.misses:.2f} mm, forces "
        f"{ratio.min():.3f} to {ratio.max():.3f}, torques {found.torque_use.max():.2f}"
    )
    assert found.holds
    assert found.arrives
    assert found.slip.max() < SLIP
    assert found.torque_use.max() <= 1.0


def tracks(found: ArmOutcome, phases: Phases) -> bool:
    """Whether the normal forces keep to their references in the carry."""
    begin, end = span(phases, "carry")
    inside = (found.time > begin) & (found.time < end)
    ratio = found.normal_force[inside] / found.normal_force_reference[inside]
    return bool(np.abs(ratio - 1.0).max() < TRACKED)


@pytest.mark.parametrize("force", [None, 55.0])
@pytest.mark.parametrize("delay", [0.0, 0.01])
def test_the_hand_made_bundle_drives_the_cell(force: float | None, delay: float) -> None:
    files, phases = hand_made(force)
    found = witness().simulate(reference_of(files, phases, delay), "leader")
    judged(found, phases)
    assert tracks(found, phases) or delay


@pytest.mark.parametrize("delay", [0.0, 0.01])
def test_the_recommended_bundle_drives_the_cell(
    recommended: tuple[Files, Phases, float], delay: float
) -> None:
    files, phases, survived = recommended
    assert survived > 0.0
    # A longer delay than the manifest allows is refused where it is required.
    delay = min(delay, survived)
    found = witness().simulate(reference_of(files, phases, delay), "leader")
    judged(found, phases)
    assert tracks(found, phases) or delay


def test_half_the_force_does_not_hold_the_box() -> None:
    files, phases = hand_made(None)
    assert not witness().simulate(reference_of(files, phases), "leader", 0.5).arrives
