"""The judgement of foreign trajectories: our own job passes in every form, spoilt ones do not."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hybrid_opt.cell import Cell
from hybrid_opt.compiled_cell import InterpretedCell
from hybrid_opt.errors import ResultsError
from hybrid_opt.extras.bundles.check import (
    CLOSED_CHAIN_CHANGE,
    EXCESS,
    Finding,
    check,
    read_trajectory,
)
from hybrid_opt.extras.bundles.job_file import Interpolation
from hybrid_opt.store.trajectory_file import TRAJECTORY_FORMAT
from symbolic.array import Array
from symbolic.errors import SettingsError
from tests.hybrid_opt.extras.bundles.bundles import exported, text_of
from tests.hybrid_opt.job.jobs import rack, rack_job
from tests.refusals import refused

JOINTS = [f"{arm}_joint_{j}" for arm in ("left", "right") for j in range(1, 7)]


def carried() -> tuple[Array, Array, Array, Array]:
    """Of the carry, at 50 ms: times (n,) [s], joints, rates (n, joints), poses (n, 6)."""
    job = exported("torque").sampled
    span = job.span(rack_job().phases.index(rack_job().phase("carry")))
    return job.time[span] - job.time[span.start], job.q[span], job.q_rate[span], job.pose[span]


def ros(time: Array, q: Array, rate: Array | None = None, names: Sequence[str] = JOINTS) -> str:
    """ROS 2's JointTrajectory."""
    points: list[dict[str, Any]] = []
    for k, stamp in enumerate(np.round(1e9 * time).astype(int).tolist()):
        seconds, nanoseconds = divmod(stamp, 10**9)
        points.append({"positions": q[k].tolist()})
        points[-1]["time_from_start"] = {"sec": seconds, "nanosec": nanoseconds}
        if rate is not None:
            points[-1]["velocities"] = rate[k].tolist()
    return yaml.safe_dump({"joint_names": list(names), "points": points})


def judged(
    path: Path,
    content: str,
    held: tuple[float, float] | None = None,
    interpolation: Interpolation | None = None,
) -> Finding:
    path.write_text(content)
    return check(rack(), read_trajectory(path, rack().workcell), held, interpolation)


def test_our_own_job_passes(tmp_path: Path) -> None:
    whole = judged(tmp_path / "job.json", text_of("data", "job.json"))
    again = judged(tmp_path / "job.csv", text_of("data", "job.csv"))
    told = judged(tmp_path / "job.yaml", ros(*carried()[:3]))
    for found in (whole, again, told):
        assert not found.problems, found
        assert max(found.along, found.across) < 1e-4
    np.testing.assert_allclose(again.held.mean(), whole.held.mean(), atol=0.01)
    phase = rack_job().phase("carry")
    np.testing.assert_allclose(whole.normal_force, phase.force.least.max(axis=0), rtol=0.02)
    np.testing.assert_allclose(told.normal_force, whole.normal_force, rtol=0.05)


def test_the_interpreter_says_what_compiled_functions_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = ros(*carried()[:3])
    compiled = judged(tmp_path / "job.yaml", content)
    monkeypatch.setenv("CC", "no-such-compiler")
    workcell = rack().workcell
    cell = Cell(workcell, compiled=InterpretedCell(workcell))
    found = check(cell, read_trajectory(tmp_path / "job.yaml", workcell))
    assert repr(found) == repr(compiled)


def test_what_cannot_be_driven_is_told(tmp_path: Path) -> None:
    """A second arm that is 30 ms late; eight times the speed; a straight line of the joints from
    start to goal, through the rack."""
    time, q, rate, _ = carried()
    second = [np.interp(time - 0.03, time, column) for column in q[:, 6:].T]
    found = judged(tmp_path / "a.yaml", ros(time, np.column_stack([q[:, :6], *second])), (0.0, 5.0))
    assert max(found.along, found.across) > CLOSED_CHAIN_CHANGE
    assert found.problems
    found = judged(tmp_path / "b.yaml", ros(time / 8.0, q, 8.0 * rate))
    assert found.use["joint velocity"] > EXCESS
    assert np.any(found.normal_force > found.rated)
    exceeded = sum(use > EXCESS for use in found.use.values())
    assert len(found.problems) == exceeded + np.sum(found.normal_force > found.rated)
    straight = np.linspace(q[0], q[-1], len(q))
    found = judged(tmp_path / "c.yaml", ros(time, straight), (0.0, 6.0))
    assert found.collides
    assert any(found.collides in problem for problem in found.problems)


def test_what_lies_between_samples_counts(tmp_path: Path) -> None:
    """The same samples, all of them on the carry, under other interpolations: each 0.2 s; with a
    velocity that is not its own; two at either end, so that all that lies between is made up."""
    time, q, rate, pose = carried()
    rows = [*range(0, len(time), 4)[:-1], len(time) - 1]
    thinned = ros(time[rows], q[rows], rate[rows])
    smooth = judged(tmp_path / "a.yaml", thinned, interpolation="cubic")
    assert not smooth.problems, smooth
    straight = judged(tmp_path / "a.yaml", thinned, interpolation="linear")
    assert max(straight.along, straight.across) > CLOSED_CHAIN_CHANGE
    assert len(straight.problems) == 1
    assert "linear" in repr(straight)
    assert (smooth.interpolation, straight.interpolation) == ("cubic", "linear")
    swung = rate.copy()
    swung[40, 1] += 1.5
    swings = judged(tmp_path / "b.yaml", ros(time, q, swung))
    assert max(swings.along, swings.across) > CLOSED_CHAIN_CHANGE
    assert swings.problems
    ends = [0, 1, -2, -1]
    through = judged(tmp_path / "c.yaml", ros(time[ends], q[ends]), (0.0, 9.0))
    samples = (pose[ends], q[ends, :6].copy(), q[ends, 6:].copy())
    assert rack().evaluator.checker.check(*samples).is_free
    assert through.collides


@pytest.mark.parametrize(
    ("name", "content", "quoted"),
    [
        ("c.yaml", "a: [", "c.yaml: "),
        ("d.json", "{}", "d.json: "),
        (
            "carry.json",
            json.dumps({"format": TRAJECTORY_FORMAT, "version": 1}),
            "dual-arm-carry export",
        ),
        ("e.csv", "a,b\n1,2\n", "e.csv: "),
        ("f.csv", "", "f.csv: "),
    ],
)
def test_what_is_no_trajectory_is_told(
    name: str, content: str, quoted: str, tmp_path: Path
) -> None:
    with refused(ResultsError, "no-trajectory", quoted):
        judged(tmp_path / name, content)


def test_what_cannot_be_judged_is_told(tmp_path: Path) -> None:
    """A joint of another name, times that stand still, a while without samples."""
    time, q, _, _ = carried()
    renamed = [*JOINTS[:3], "elbow", *JOINTS[4:]]
    with pytest.raises(ResultsError, match="'left_joint_4'"):
        judged(tmp_path / "a.yaml", ros(time, q, names=renamed))
    with pytest.raises(ResultsError, match=r"a\.yaml"):
        judged(tmp_path / "a.yaml", ros(0.0 * time, q))
    with refused(SettingsError, "too-few"):
        judged(tmp_path / "a.yaml", ros(time, q), (90.0, 99.0))


def test_plain_columns_are_read(tmp_path: Path) -> None:
    """A table of others: a time and a column per joint."""
    time, q, _, _ = carried()
    path = tmp_path / "t.csv"
    table, header = np.column_stack([time, q]), ",".join(["time", *JOINTS])
    np.savetxt(path, table, "%.17g", ",", header=header, comments="")
    found = read_trajectory(path, rack().workcell)
    np.testing.assert_array_equal(found.q, q)
    assert len(found.known) == 1
