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

from hybrid_opt.carry import Carry
from hybrid_opt.errors import ResultsError
from hybrid_opt.store.export import FORMATS, export, sample_timing
from hybrid_opt.timing import Timing, TimingLimits, closest_to_reference_timing, time_path
from symbolic.errors import SettingsError
from tests.hybrid_opt.store.export.rapid_parser import Call, RapidError, parse
from tests.hybrid_opt.timing.cells import hand_timing, initial


@cache
def timing() -> Timing:
    return closest_to_reference_timing(hand_timing(), initial())


@cache
def sampled(step: float = 0.05) -> Carry:
    return sample_timing(timing(), step)


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
        expected = carry.q[near] + offset * carry.side_by_side("q_rate")[near]
        np.testing.assert_allclose(trajectory.q[k], expected, atol=5e-5)
    np.testing.assert_allclose(trajectory.side_by_side("q_rate")[[0, -1]], 0.0, atol=1e-9)


def test_samples_are_consistent_with_their_derivatives() -> None:
    trajectory = sampled(0.002)
    h = trajectory.time[1]
    for arm in trajectory.arms:
        slope = (arm.q[2:] - arm.q[:-2]) / (2 * h)
        np.testing.assert_allclose(slope, arm.q_rate[1:-1], atol=2e-3)


def test_everything_else_is_interpolated() -> None:
    trajectory, carry = sampled(0.002), timing().carry
    assert carry is not None
    for k in (0, 100, len(trajectory) - 1):
        near = int(np.argmin(np.abs(carry.time - trajectory.time[k])))
        np.testing.assert_allclose(trajectory.contact_force[k], carry.contact_force[near], atol=0.2)
        np.testing.assert_allclose(trajectory.torque[k], carry.torque[near], atol=0.3)


def test_csv_read_back(tmp_path: Path) -> None:
    (path,) = export(timing(), "csv", tmp_path / "new", step=0.05)
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    trajectory = sampled()
    assert len(rows) == len(trajectory.time)
    assert len(rows[0]) == 1 + 6 + 36 + 2
    for k, row in enumerate(rows):
        assert float(row["time [s]"]) == trajectory.time[k]
        assert float(row["second/joint_4 position [rad]"]) == trajectory.arms[1].q[k, 3]
        assert float(row["first/joint_1 velocity [rad/s]"]) == trajectory.arms[0].q_rate[k, 0]
        assert (
            float(row["second/joint_6 acceleration [rad/s^2]"])
            == (trajectory.arms[1].q_second[k, 5])
        )
        assert float(row["box z [m]"]) == trajectory.pose[k, 2]
        assert float(row["first normal force [N]"]) == trajectory.normal_force[k, 0]


def test_json_read_back(tmp_path: Path) -> None:
    (path,) = export(timing(), "json", tmp_path, step=0.05)
    document, trajectory = json.loads(path.read_text(encoding="utf-8")), sampled()
    assert document["format"] == "dual-arm-carry timed trajectory"
    np.testing.assert_array_equal(document["time"], trajectory.time)
    np.testing.assert_array_equal(document["box"]["pose"], trajectory.pose)
    for i, robot in enumerate(document["robots"]):
        assert robot["name"] == trajectory.workcell.robots[i].name
        assert robot["joints"] == [f"joint_{k}" for k in range(1, 7)]
        arm = trajectory.arms[i]
        np.testing.assert_array_equal(robot["position"], arm.q)
        np.testing.assert_array_equal(robot["velocity"], arm.q_rate)
        np.testing.assert_array_equal(robot["acceleration"], arm.q_second)
        np.testing.assert_array_equal(robot["normal_force"], trajectory.normal_force[:, i])


def test_ros2_message_read_back(tmp_path: Path) -> None:
    paths = export(timing(), "ros2", tmp_path, step=0.05)
    assert [path.name for path in paths] == ["trajectory_arm1.yaml", "trajectory_arm2.yaml"]
    trajectory = sampled()
    for arm, path in enumerate(paths):
        message = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert set(message) == {"header", "joint_names", "points"}
        assert message["joint_names"] == [f"joint_{k}" for k in range(1, 7)]
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
            np.testing.assert_array_equal(point["positions"], trajectory.arms[arm].q[k])
            np.testing.assert_array_equal(point["velocities"], trajectory.arms[arm].q_rate[k])
            np.testing.assert_array_equal(point["accelerations"], trajectory.arms[arm].q_second[k])


def moves(calls: list[Call]) -> list[Call]:
    return [call for call in calls if call.name == "MoveAbsJ"]


def test_rapid_parses_and_reads_back(tmp_path: Path) -> None:
    trajectory = sampled(0.1)
    paths = export(timing(), "rapid", tmp_path, "carry", 0.1)
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
                np.deg2rad(np.array(robot, dtype=float)), trajectory.arms[arm].q[k], atol=1e-8
            )
    assert synchronised[0] == synchronised[1]
    assert (np.diff(np.array(synchronised[0], dtype=float)) > 0.0).all()
    assert len(set(map(str, synchronised[0]))) == len(synchronised[0])


def test_names_cannot_leave_a_rapid_comment() -> None:
    carry = sampled(0.1)
    robot, other = carry.workcell.robots
    robots = (replace(robot, name="räbot \n"), other)
    evil = replace(carry.workcell, name="x\r\n  EXIT;\n", robots=robots)
    first = FORMATS["rapid"](replace(carry, workcell=evil))["_T_ROB1.mod"]
    (calls,) = parse(first.encode("ascii").decode("ascii")).procedures.values()
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
        sample_timing(timing(), step)


def test_nothing_is_exported_without_a_timing(tmp_path: Path) -> None:
    failed = time_path(hand_timing(), initial(), TimingLimits(force=30.0))
    with pytest.raises(SettingsError, match="no timing to export"):
        sample_timing(failed, 0.1)
    with pytest.raises(SettingsError, match="unknown format"):
        export(timing(), "xml", tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="cannot be written"):
        export(timing(), "csv", tmp_path / "file")


def test_an_export_never_replaces_a_stored_trajectory(tmp_path: Path) -> None:
    """As `replay 00.json --export json` in the trajectory's own folder would."""
    stored = tmp_path / "00.json"
    text = json.dumps({"format": "dual-arm-carry trajectory", "version": 1}, indent=1)
    stored.write_text(text)
    with pytest.raises(ResultsError, match="stored trajectory"):
        export(timing(), "json", tmp_path, "00")
    assert stored.read_text() == text
    (path,) = export(timing(), "json", tmp_path, "01")
    assert export(timing(), "json", tmp_path, "01") == (path,)
