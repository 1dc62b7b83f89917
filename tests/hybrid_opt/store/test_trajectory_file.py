"""Stored trajectories: round trip, checks, and nothing executed on reading."""

from __future__ import annotations

import json
import pickle
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_opt.errors import ResultsError
from hybrid_opt.store.trajectory_file import read_trajectory, write_trajectory
from symbolic.array import Array
from tests.refusals import refused
from tests.symbolic.cells import rack_cell

FIGURES = {"duration": 5.25, "objective_peak_force_1": 0.43}
PROVENANCE = {"algorithm": "nsga2", "seed": 7, "versions": {"numpy": "2"}}


def initial() -> Array:
    return rack_cell().task.initial.reshape(-1)


@cache
def document() -> str:
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        path = Path(folder) / "trajectory.json"
        write_trajectory(path, rack_cell(), initial(), FIGURES, PROVENANCE)
        assert [entry.name for entry in path.parent.iterdir()] == [path.name]
        return path.read_text(encoding="utf-8")


def changed(tmp_path: Path, **changes: Any) -> Path:
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(json.loads(document()) | changes), encoding="utf-8")
    return path


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "t.json"
    path.write_text(document(), encoding="utf-8")
    stored = read_trajectory(path)
    np.testing.assert_array_equal(stored.x, initial())
    assert stored.figures == FIGURES
    assert stored.provenance == PROVENANCE
    assert [start.shape for start in stored.start] == [(6,), (6,)]
    assert stored.unpack(tmp_path / "cell").digest == rack_cell().digest


def test_what_it_was_searched_for_is_read_from_its_figures(tmp_path: Path) -> None:
    figures = {"objective_duration": 0.5, "objective_robust_force": 0.6, "objective_own": 0.1}
    for stored, objectives, robust in (
        (figures, ("duration", "robust_force"), True),
        ({"objective_own": 0.1, "duration": 2.0}, ("peak_force_1", "peak_force_2"), False),
    ):
        found = read_trajectory(changed(tmp_path, figures=stored))
        assert found.objectives == objectives
        assert found.open_cell(tmp_path / f"cell{robust}").force_kind.robust is robust


def test_the_start_posture_holds_the_box(tmp_path: Path) -> None:
    import pinocchio as pin

    cell = rack_cell()
    start = json.loads(document())["start"]
    for robot, contact, q in zip(cell.robots, cell.contacts, start, strict=True):
        model = pin.buildModelFromUrdf(str(robot.urdf))
        data = model.createData()
        pin.framesForwardKinematics(model, data, np.array(q))
        flange = data.oMf[model.getFrameId(robot.flange)].homogeneous
        pad = robot.T_world_base @ flange @ robot.T_flange_pad
        box = cell.task.waypoints[0].lower
        np.testing.assert_allclose(pad[:3, 3] - box[:3], contact.T_box_pad[:3, 3], atol=1e-6)


def test_writing_replaces_in_one_step_and_refuses_bad_values(tmp_path: Path) -> None:
    path, cell = tmp_path / "t.json", rack_cell()
    write_trajectory(path, cell, initial(), FIGURES, {})
    write_trajectory(path, cell, initial(), {"duration": 1.0}, {})
    assert read_trajectory(path).figures == {"duration": 1.0}
    for figures, provenance, match in (
        ({"a": float("nan")}, {}, "finite"),
        ({"a": "1"}, {}, "finite"),
        ({"a": True}, {}, "finite"),
        ({}, {"f": object()}, "JSON"),
        ({}, {"f": float("inf")}, "JSON"),
    ):
        with pytest.raises(ResultsError, match=match):
            write_trajectory(path, cell, initial(), figures, provenance)  # type: ignore[arg-type]
    with refused(ResultsError, "shape"):
        write_trajectory(path, cell, initial()[:-1], {}, {})
    with refused(ResultsError, "not-writable"):
        write_trajectory(tmp_path / "missing" / "t.json", cell, initial(), {}, {})
    assert read_trajectory(path).figures == {"duration": 1.0}
    assert [entry.name for entry in tmp_path.iterdir()] == ["t.json"]


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"format": "other"}, "`format`"),
        ({"version": 2}, "version"),
        ({"more": 1}, "more"),
        ({"decision": [1.0, None]}, "decision"),
        ({"decision": [10**400]}, "finite"),
        ({"decision": [1e308]}, r"decision\[0\]: found 1e\+308"),
        ({"decision": [0.0] * 10_001}, "decision: 10001 numbers"),
        ({"figures": {"a\u001b": 1.0}}, "figures"),
        ({"figures": {"a" * 5000: 1.0}}, "5000 characters"),
        ({"provenance": {"a\ud800": 1}}, "surrogate"),
        ({"start": [[0.0] * 6]}, "start"),
        ({"figures": []}, "figures"),
        ({"cell": 1}, "cell"),
    ],
)
def test_wrong_fields_are_refused(changes: dict[str, Any], match: str, tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match=match):
        read_trajectory(changed(tmp_path, **changes))


def test_a_start_of_another_arm_is_refused(tmp_path: Path) -> None:
    stored = read_trajectory(changed(tmp_path, start=[[0.0] * 6, [0.0] * 5]))
    with pytest.raises(ResultsError, match=r"start\[1\]: expected 6 numbers"):
        stored.unpack(tmp_path / "cell")


def test_a_decision_vector_of_another_cell_is_refused(tmp_path: Path) -> None:
    stored = read_trajectory(changed(tmp_path, decision=[0.0] * 6))
    with pytest.raises(ResultsError, match="decision"):
        stored.unpack(tmp_path / "cell")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe",
        b"[1, 2]",
        b"[" * 100_000,
        pickle.dumps({"format": "dual-arm-carry trajectory"}),
        b'{"a": ' + b"9" * 10_000 + b"}",
        b"[" + b"1," * 1_000_001 + b"1]",
    ],
)
def test_other_files_are_refused_with_their_name(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "odd.json"
    path.write_bytes(content)
    with pytest.raises(ResultsError, match=r"odd\.json"):
        read_trajectory(path)


def test_a_missing_file_and_a_folder_are_told(tmp_path: Path) -> None:
    for path, code in ((tmp_path / "missing.json", "unreadable"), (tmp_path, "no-regular-file")):
        with refused(ResultsError, code):
            read_trajectory(path)


def test_enormous_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("symbolic.safe_io.MOST_BYTES", 100)
    path = tmp_path / "t.json"
    path.write_text(document(), encoding="utf-8")
    with refused(ResultsError, "too-large"):
        read_trajectory(path)
