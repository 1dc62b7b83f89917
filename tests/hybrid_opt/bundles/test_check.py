"""The judgement of foreign trajectories: our own job passes in every form, spoilt ones do not."""

from __future__ import annotations

import csv
import io
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hybrid_opt.bundles.check import Finding, check, read_trajectory
from hybrid_opt.bundles.job_file import Interpolation
from hybrid_opt.errors import ResultsError
from hybrid_opt.store.trajectory_file import FORMAT
from symbolic.errors import SettingsError
from tests.hybrid_opt.bundles.bundles import exported, text_of
from tests.hybrid_opt.job.jobs import rack, rack_job


def carry() -> tuple[float, float]:
    found = rack_job().phase("carry")
    return found.begin, found.begin + found.duration


@cache
def message() -> dict[str, Any]:
    """The carry as ROS 2's JointTrajectory, at 50 ms."""
    job = exported("json", 0.05).sampled
    begin, end = carry()
    rows = np.flatnonzero((job.time >= begin - 1e-9) & (job.time <= end + 1e-9))
    points = []
    for k in rows:
        nanoseconds = round(1e9 * (job.time[k] - begin))
        points.append(
            {
                "positions": job.q[k].tolist(),
                "velocities": job.q_rate[k].tolist(),
                "time_from_start": {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9},
            }
        )
    names = [f"{arm}_joint_{j}" for arm in ("left", "right") for j in range(1, 7)]
    return {"joint_names": names, "points": points}


def judged(
    path: Path,
    content: str,
    held: tuple[float, float] | None = None,
    interpolation: Interpolation | None = None,
) -> Finding:
    path.write_text(content)
    return check(rack(), read_trajectory(path, rack().workcell), held, interpolation)


def test_our_own_job_passes(tmp_path: Path) -> None:
    whole = judged(tmp_path / "job.json", text_of("json", "job.json"))
    again = judged(tmp_path / "job.csv", text_of("csv", "job.csv"))
    ros = judged(tmp_path / "job.yaml", yaml.safe_dump(message()))
    for found in (whole, again, ros):
        assert not found.problems, found
        assert max(found.along, found.across) < 1e-4
        assert "it can be driven" in repr(found)
    np.testing.assert_allclose(again.held.mean(), whole.held.mean(), atol=0.01)
    phase = rack_job().phase("carry")
    np.testing.assert_allclose(whole.normal_force, phase.force.least.max(axis=0), rtol=0.02)
    np.testing.assert_allclose(ros.normal_force, whole.normal_force, rtol=0.05)


def spoilt(change: Any) -> str:
    document = json.loads(json.dumps(message()))
    change(document)
    return yaml.safe_dump(document)


def late(document: dict[str, Any]) -> None:
    """The second arm is 30 ms late."""
    rows = np.array([point["positions"] for point in document["points"]])
    time = np.arange(len(rows)) * 0.05
    for j in range(6, 12):
        rows[:, j] = np.interp(time - 0.03, time, rows[:, j])
    for point, row in zip(document["points"], rows, strict=True):
        point["positions"] = row.tolist()
        point.pop("velocities")


def fast(document: dict[str, Any]) -> None:
    for point in document["points"]:
        stamp = point["time_from_start"]
        nanoseconds = (stamp["sec"] * 10**9 + stamp["nanosec"]) // 8
        point["time_from_start"] = {
            "sec": nanoseconds // 10**9,
            "nanosec": nanoseconds % 10**9,
        }
        point["velocities"] = [8.0 * v for v in point["velocities"]]


def test_what_cannot_be_driven_is_told(tmp_path: Path) -> None:
    found = judged(tmp_path / "a.yaml", spoilt(late), (0.0, 5.0))
    assert any("the chain is not closed" in problem for problem in found.problems)
    found = judged(tmp_path / "b.yaml", spoilt(fast))
    text = "; ".join(found.problems)
    assert "limit on joint velocity" in text
    assert "reference force" in text

    def through(document: dict[str, Any]) -> None:
        """A straight line of the joints from start to goal: through the rack."""
        first, last = (np.array(document["points"][k]["positions"]) for k in (0, -1))
        for k, point in enumerate(document["points"]):
            share = k / (len(document["points"]) - 1)
            point["positions"] = (first + share * (last - first)).tolist()
            point.pop("velocities")

    found = judged(tmp_path / "c.yaml", spoilt(through), (0.0, 6.0))
    assert found.collides
    assert any(problem.startswith("collisions") for problem in found.problems)


def thinned(document: dict[str, Any]) -> None:
    """A sample each 0.2 s."""
    document["points"] = document["points"][::4] + document["points"][-1:]
    del document["points"][-2:-1]


def ends(document: dict[str, Any]) -> None:
    """Two samples at either end, on the carry: all that lies between is made up."""
    document["points"] = document["points"][:2] + document["points"][-2:]
    for point in document["points"]:
        point.pop("velocities")


def swung(document: dict[str, Any]) -> None:
    """One sample bears a velocity that is not its own."""
    document["points"][40]["velocities"][1] += 1.5


def test_what_lies_between_samples_counts(tmp_path: Path) -> None:
    """The same samples, all of them on the carry, under other interpolations."""
    smooth = judged(tmp_path / "a.yaml", spoilt(thinned), interpolation="cubic")
    assert not smooth.problems, smooth
    assert smooth.interpolation == "cubic"
    straight = judged(tmp_path / "a.yaml", spoilt(thinned), interpolation="linear")
    (told,) = straight.problems
    assert "the chain is not closed" in told
    assert straight.interpolation == "linear"
    assert "linear" in repr(straight)
    swings = judged(tmp_path / "b.yaml", spoilt(swung))
    assert any("chain is not closed" in problem for problem in swings.problems), swings
    through = judged(tmp_path / "c.yaml", spoilt(ends), (0.0, 9.0))
    document = json.loads(json.dumps(message()))
    ends(document)
    q = np.array([point["positions"] for point in document["points"]])
    time = np.arange(len(q), dtype=float)
    at_samples = rack().evaluator.checker.check(*placed(q), time)
    assert at_samples.is_free
    assert through.collides
    with pytest.raises(SettingsError, match=r"quintic motion between samples takes .*acceleration"):
        judged(tmp_path / "a.yaml", spoilt(thinned), interpolation="quintic")


def placed(q: Any) -> tuple[Any, Any, Any]:
    """The box and both arms of postures, as the first pad holds it."""
    job = exported("json", 0.05).sampled
    rows = [int(np.abs(job.q - row).max(axis=1).argmin()) for row in q]
    return job.pose[rows], q[:, :6].copy(), q[:, 6:].copy()


def renamed(document: dict[str, Any]) -> None:
    document["joint_names"][3] = "elbow"


def without_times(document: dict[str, Any]) -> None:
    for point in document["points"]:
        point["time_from_start"] = {"sec": 0, "nanosec": 0}


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.yaml", lambda: spoilt(renamed), "there is no joint 'left_joint_4'"),
        ("b.yaml", lambda: spoilt(without_times), "times have to ascend"),
        ("c.yaml", lambda: "a: [", "no joint trajectory"),
        ("d.json", lambda: "{}", "no joint trajectory"),
        (
            "carry.json",
            lambda: json.dumps({"format": FORMAT, "version": 1}),
            r"it is a stored carry: export it first \(python -m studies.export\)",
        ),
        ("e.csv", lambda: "a,b\n1,2\n", "no joint trajectory"),
        ("f.csv", lambda: "", "no joint trajectory"),
    ],
)
def test_what_is_no_trajectory_is_told(name: str, content: Any, told: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(content())
    with pytest.raises(ResultsError, match=told):
        read_trajectory(path, rack().workcell)


def test_a_while_without_samples_is_told(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="samples lie between"):
        judged(tmp_path / "a.yaml", yaml.safe_dump(message()), (90.0, 99.0))


def test_plain_columns_are_read(tmp_path: Path) -> None:
    """A table of others: a time and a column per joint."""
    document = message()
    file = io.StringIO()
    writer = csv.writer(file)
    writer.writerow(["time", *document["joint_names"]])
    for k, point in enumerate(document["points"]):
        writer.writerow([0.05 * k, *point["positions"]])
    path = tmp_path / "t.csv"
    path.write_text(file.getvalue())
    found = read_trajectory(path, rack().workcell)
    np.testing.assert_allclose(found.q[3], document["points"][3]["positions"])
    assert len(found.known) == 1
