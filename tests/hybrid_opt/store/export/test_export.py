"""Every export read back by other means than it was written with."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml

from hybrid_opt.errors import ResultsError
from hybrid_opt.store.export import FORMATS, SampledTrajectory, export_trajectory, sample_trajectory
from hybrid_opt.timing import Timing, TimingLimits, closest_to_reference_timing, time_path
from symbolic.errors import SettingsError
from tests.hybrid_opt.store.export.rapid_parser import Call, RapidError, parse
from tests.hybrid_opt.timing.cells import hand_timing, initial


@cache
def timing() -> Timing:
    return closest_to_reference_timing(hand_timing(), initial())


@cache
def sampled(step: float = 0.05) -> SampledTrajectory:
    return sample_trajectory(hand_timing(), timing(), step)


def test_samples_lie_on_the_path_and_respect_the_timing() -> None:
    trajectory, carry = sampled(), timing().carry
    assert carry is not None
    assert trajectory.time[0] == 0.0
    assert trajectory.time[-1] == pytest.approx(carry.duration)
    steps = np.diff(trajectory.time)
    assert steps.max() <= 0.05 + 1e-12
    np.testing.assert_allclose(steps, steps[0])
    for k, time in enumerate(trajectory.time):
        near = int(np.argmin(np.abs(carry.time - time)))
        offset = time - carry.time[near]
        expected = carry.q[near] + offset * carry.q_rate[near]
        np.testing.assert_allclose(trajectory.position[k].reshape(-1), expected, atol=5e-5)
    np.testing.assert_allclose(trajectory.velocity[[0, -1]], 0.0, atol=1e-9)


def test_samples_are_consistent_with_their_derivatives() -> None:
    trajectory = sampled(0.002)
    q, h = trajectory.position, trajectory.time[1]
    np.testing.assert_allclose((q[2:] - q[:-2]) / (2 * h), trajectory.velocity[1:-1], atol=2e-3)


def test_csv_read_back(tmp_path: Path) -> None:
    (path,) = export_trajectory(sampled(), "csv", tmp_path / "new")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    trajectory = sampled()
    assert len(rows) == len(trajectory.time)
    assert len(rows[0]) == 1 + 6 + 36 + 2
    for k, row in enumerate(rows):
        assert float(row["time [s]"]) == trajectory.time[k]
        assert float(row["second/joint_4 position [rad]"]) == trajectory.position[k, 1, 3]
        assert float(row["first/joint_1 velocity [rad/s]"]) == trajectory.velocity[k, 0, 0]
        assert (
            float(row["second/joint_6 acceleration [rad/s^2]"])
            == (trajectory.acceleration[k, 1, 5])
        )
        assert float(row["box z [m]"]) == trajectory.pose[k, 2]
        assert float(row["first normal force [N]"]) == trajectory.normal_force[k, 0]


def test_json_read_back(tmp_path: Path) -> None:
    (path,) = export_trajectory(sampled(), "json", tmp_path)
    document, trajectory = json.loads(path.read_text(encoding="utf-8")), sampled()
    assert document["format"] == "dual-arm-carry timed trajectory"
    np.testing.assert_array_equal(document["time"], trajectory.time)
    np.testing.assert_array_equal(document["box"]["pose"], trajectory.pose)
    for i, robot in enumerate(document["robots"]):
        assert robot["name"] == trajectory.robots[i]
        assert tuple(robot["joints"]) == trajectory.joints[i]
        for name in ("position", "velocity", "acceleration", "normal_force"):
            np.testing.assert_array_equal(robot[name], getattr(trajectory, name)[:, i])


def test_ros2_message_read_back(tmp_path: Path) -> None:
    paths = export_trajectory(sampled(), "ros2", tmp_path)
    assert [path.name for path in paths] == ["trajectory_arm1.yaml", "trajectory_arm2.yaml"]
    trajectory = sampled()
    for arm, path in enumerate(paths):
        message = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert set(message) == {"header", "joint_names", "points"}
        assert message["joint_names"] == list(trajectory.joints[arm])
        assert len(message["points"]) == len(trajectory.time)
        last = -1.0
        for k, point in enumerate(message["points"]):
            assert set(point) == {
                "positions",
                "velocities",
                "accelerations",
                "effort",
                "time_from_start",
            }
            stamp = point["time_from_start"]
            assert isinstance(stamp["sec"], int)
            assert isinstance(stamp["nanosec"], int)
            assert 0 <= stamp["nanosec"] < 10**9
            time = stamp["sec"] + 1e-9 * stamp["nanosec"]
            assert time > last
            last = time
            assert time == pytest.approx(trajectory.time[k], abs=1e-9)
            np.testing.assert_array_equal(point["positions"], trajectory.position[k, arm])
            np.testing.assert_array_equal(point["velocities"], trajectory.velocity[k, arm])
            np.testing.assert_array_equal(point["accelerations"], trajectory.acceleration[k, arm])


def moves(calls: list[Call]) -> list[Call]:
    return [call for call in calls if call.name == "MoveAbsJ"]


def test_rapid_parses_and_reads_back(tmp_path: Path) -> None:
    trajectory = sampled(0.1)
    paths = export_trajectory(trajectory, "rapid", tmp_path, "carry")
    assert [path.name for path in paths] == ["carry_T_ROB1.mod", "carry_T_ROB2.mod"]
    modules = [parse(path.read_text(encoding="ascii")) for path in paths]
    synchronised = []
    for arm, module in enumerate(modules):
        kinds = {kind: (storage, value) for storage, kind, _, value in module.declarations}
        assert kinds["tasks"] == ("PERS", [["T_ROB1"], ["T_ROB2"]])
        (calls,) = module.procedures.values()
        names = [call.name for call in calls]
        assert names[:2] == ["MoveAbsJ", "SyncMoveOn"]
        assert names[-1] == "SyncMoveOff"
        assert set(names[2:-1]) == {"MoveAbsJ"}
        assert "ID" not in calls[0].optional
        inside = calls[2:-1]
        synchronised.append([call.optional["ID"] for call in inside])
        assert all(call.arguments[3] == "tool0" for call in moves(calls))
        assert calls[0].arguments[2] == "fine"
        assert inside[-1].arguments[2] == "fine"
        total = sum(float(str(call.optional["T"])) for call in inside)
        assert total == pytest.approx(trajectory.time[-1], abs=1e-4)
        for k, call in enumerate(moves(calls)):
            target = call.arguments[0]
            assert isinstance(target, list)
            robot, external = target
            assert external == [9e9] * 6
            np.testing.assert_allclose(
                np.deg2rad(np.array(robot, dtype=float)), trajectory.position[k, arm], atol=1e-8
            )
    assert synchronised[0] == synchronised[1]
    assert (np.diff(np.array(synchronised[0], dtype=float)) > 0.0).all()
    assert len(set(map(str, synchronised[0]))) == len(synchronised[0])


def test_names_cannot_leave_a_rapid_comment(tmp_path: Path) -> None:
    evil = replace(sampled(0.1), name="x\r\n  EXIT;\n", robots=("räbot \n", "b"))
    first, _ = export_trajectory(evil, "rapid", tmp_path)
    (calls,) = parse(first.read_bytes().decode("ascii")).procedures.values()
    assert {call.name for call in calls} == {"MoveAbsJ", "SyncMoveOn", "SyncMoveOff"}


@pytest.mark.parametrize(
    "text",
    [
        "MODULE A PROC B() MoveAbsJ [[1]] v50; ENDPROC ENDMODULE",
        "MODULE A PROC B() MoveAbsJ [[1], v50; ENDPROC ENDMODULE",
        "MODULE A PROC B() MoveAbsJ x \\ID:=1 \\ID:=2; ENDPROC ENDMODULE",
        "MODULE A PROC B() ENDPROC",
        "MODULE 1A ENDMODULE",
    ],
)
def test_the_parser_refuses_wrong_rapid(text: str) -> None:
    with pytest.raises((RapidError, IndexError)):
        parse(text)


def test_rapid_refuses_steps_that_no_controller_plans() -> None:
    with pytest.raises(SettingsError, match="RAPID"):
        FORMATS["rapid"](sampled(0.005))


@pytest.mark.parametrize("step", [0.0, -1.0, math.nan, math.inf, 2.0])
def test_time_steps_are_checked(step: float) -> None:
    with pytest.raises(SettingsError, match="time step"):
        sample_trajectory(hand_timing(), timing(), step)


def test_nothing_is_exported_without_a_timing(tmp_path: Path) -> None:
    failed = time_path(hand_timing(), initial(), TimingLimits(force=30.0))
    with pytest.raises(SettingsError, match="no timing to export"):
        sample_trajectory(hand_timing(), failed, 0.1)
    with pytest.raises(SettingsError, match="unknown format"):
        export_trajectory(sampled(), "xml", tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="cannot be written"):
        export_trajectory(sampled(), "csv", tmp_path / "file")
