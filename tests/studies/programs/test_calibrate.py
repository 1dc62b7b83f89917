"""The program reads recordings, says what they show, and writes a cell that has it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.extras.calibrating.recording import Recording
from studies.calibrate import main
from symbolic.read.cell import load
from symbolic.records.cell import USUAL_UNCERTAINTY
from tests.hybrid_opt.extras.calibrating.generator import (
    CELL,
    LEVEL,
    SQUEEZES,
    run,
    side_file,
    write,
    write_bag,
)
from tests.refusals import ended_by
from tests.symbolic.cells import RACK, standing_text


def test_a_written_cell_loads_and_has_the_values(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, out = write(run(0), tmp_path), tmp_path / "cell.toml"
    assert main([str(RACK), str(recording), "--out", str(out)]) == 0
    assert "payload.mass" in capsys.readouterr().out
    assert main([str(RACK), str(recording), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["changes"]
    found = load(out)
    assert found.payload.mass == said["payload"]["mass"] == pytest.approx(4.4, rel=0.02)
    assert found.payload.centre_of_mass.tolist() == said["payload"]["centre_of_mass"]
    doubt = found.uncertainty
    assert doubt.stated
    assert doubt.mass == said["uncertainty"]["mass"]
    assert doubt.centre_of_mass.tolist() == said["uncertainty"]["centre_of_mass"]
    assert doubt.tracking == said["uncertainty"]["tracking"]
    assert (doubt.tilt, doubt.friction) == (CELL.uncertainty.tilt, CELL.uncertainty.friction)
    text = out.read_text()
    assert "run.csv" in text.splitlines()[0]
    assert "crosstalk" in text
    (line,) = [line for line in text.splitlines() if line.startswith("tracking = ")]
    assert re.search("# .*arm 1: .*; .*arm 2: ", line)
    for line in RACK.read_text().splitlines():
        if line.startswith("#"):
            assert line in text
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(CELL.payload.centre_of_mass, found.payload.centre_of_mass)


def test_a_file_per_arm_and_columns_by_name(tmp_path: Path) -> None:
    """As RTDE records: blanks between columns, a clock's own start, each arm in its file."""
    made = run(0, LEVEL, SQUEEZES, weighed=4.4)
    for i in range(2):
        words = [*(f"actual_q_{k}" for k in range(6)), *(f"force_{k}" for k in range(6))]
        values = np.column_stack([made.time + 1e6, made.joints[i], made.wrench[:, i]])
        header = " ".join(["timestamp", *words])
        np.savetxt(tmp_path / f"arm{i + 1}.csv", values, header=header, comments="", fmt="%.10g")
    labels = made.labels
    later = tuple((begin + 1e6, end + 1e6) for begin, end in labels.held)
    made = replace(made, labels=replace(labels, tare=(1e6 + 0.5,), held=later))
    common = side_file(made).partition("[[arms]]")[0]
    arms = [
        f'[[arms]]\nfile = "arm{i}.csv"\ntime = "timestamp"\njoints = "actual_q_"\n'
        f"wrench = {[f'force_{k}' for k in range(6)]}\n"
        for i in (1, 2)
    ]
    (tmp_path / "both.toml").write_text(common + "".join(arms))
    out = tmp_path / "cell.toml"
    assert main([str(RACK), str(tmp_path / "both.csv"), "--out", str(out)]) == 0
    assert load(out).payload.mass == pytest.approx(4.4, abs=0.03)


def test_a_cell_without_ranges_gets_them_all(tmp_path: Path) -> None:
    before, _, after = standing_text().partition("[uncertainty]")
    cell, out = tmp_path / "plain.toml", tmp_path / "cell.toml"
    cell.write_text(before + after[after.find("\n[") :] if "\n[" in after else before)
    assert not load(cell).uncertainty.stated
    assert main([str(cell), str(write(run(0), tmp_path)), "--out", str(out)]) == 0
    found = load(out).uncertainty
    assert found.stated
    assert (found.friction, found.tilt) == (USUAL_UNCERTAINTY.friction, USUAL_UNCERTAINTY.tilt)
    assert found.mass < USUAL_UNCERTAINTY.mass


@pytest.mark.parametrize("frozen", [False, True])
def test_a_dropout_in_a_file_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], frozen: bool
) -> None:
    """Rows that are missing, and a sensor that shows the same for half a second."""
    made = run(0)
    begin, _ = made.labels.held[3]
    inside = made.within(begin + 0.3, begin + 0.8)
    if frozen:
        wrench = made.wrench.copy()
        wrench[inside, 1] = wrench[inside, 1][0]
        made = replace(made, wrench=wrench)
    recording = write(made, tmp_path)
    if not frozen:
        rows = recording.read_text().splitlines()
        kept = [row for row, gone in zip(rows[1:], inside, strict=True) if not gone]
        recording.write_text("\n".join([rows[0], *kept]))
    assert main([str(RACK), str(recording)]) == 0
    said = capsys.readouterr().out
    assert re.search(r"warning: run\.csv: dropout: .* 0\.5", said)
    assert "from 14 holds" in said


@pytest.mark.parametrize("alone", [False, True])
def test_a_recording_of_ros_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], alone: bool
) -> None:
    """rosbag2's folder, and its MCAP file alone."""
    made = run(0, LEVEL, SQUEEZES, weighed=4.4)
    recording = write_bag(made, tmp_path)
    if alone:
        (file,) = recording.glob("*.mcap")
        file.with_suffix(".toml").write_text(recording.with_suffix(".toml").read_text())
        recording = file
    assert main([str(RACK), str(recording), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["changes"]["payload"]["mass"] == pytest.approx(4.4, abs=0.03)
    names = {entry["name"]: entry["found"] for entry in found["entries"]}
    assert float(names["lag of the force, arm 2"].split()[0]) == pytest.approx(0.11, abs=0.02)
    assert not any(name.startswith("lag") and name.endswith("1") for name in names)


def test_refusals_end_with_code_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made, short = run(0), run(0, LEVEL, SQUEEZES[:1])
    out = tmp_path / "cell.toml"
    untared = replace(made, labels=replace(made.labels, tare=()))
    static_hold_error = replace(short, labels=replace(short.labels, held=((900.0, 902.0),)))
    for recorded, said in ((untared, "run.csv: missing tare"), (static_hold_error, "dropout: ")):
        assert main([str(RACK), str(write(recorded, tmp_path)), "--out", str(out)]) == 1
        told = capsys.readouterr()
        assert said in told.out
        assert not out.exists()
    assert str(out) in told.err


Edit = Callable[[str], str]


def put(old: str, new: str) -> Edit:
    return lambda text: text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("write", "change", "code", "quoted"),
    [
        (write, put("tare", "tara"), "workcell", "'tare'"),
        (write, lambda text: text.replace('"w1_"', '"f1_"'), "no-column", "'f1_0'"),
        (write, lambda text: "mass = -1\n" + text, "workcell", "mass: found -1"),
        (write, lambda text: text.replace('"pad"', '"tool"'), "workcell", "frame: found 'tool'"),
        (write, lambda text: text.rpartition("[[arms]]")[0], "workcell", "arms: found 1 "),
        (write, put("held = [[", "held = [[9e9, 1], ["), "workcell", "[begin, end]"),
        (write, put('joints = "q1_"', "joints = [1, 2]"), "workcell", "6 columns"),
        (write_bag, put("/1/wrench", "/3/wrench"), "no-topic", "/1/wrench"),
        (
            write_bag,
            put('"/1/wrench"', '"/1/wrench"\njoints = ["a", "b", "c", "d", "e", "f"]'),
            "no-joint",
            "'a'",
        ),
        (write_bag, put('"/1/wrench"', '"/1/wrench"\njoints = ["a"]'), "workcell", "6 joints"),
    ],
)
def test_what_is_wrong_with_a_side_file_is_told(
    tmp_path: Path,
    write: Callable[[Recording, Path], Path],
    change: Edit,
    code: str,
    quoted: str,
) -> None:
    recording = write(run(0, LEVEL, SQUEEZES[:1]), tmp_path)
    side = recording.with_suffix(".toml")
    side.write_text(change(side.read_text()))
    with ended_by(code, quoted):
        assert main([str(RACK), str(recording)]) == 2


def test_damaged_recordings_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = run(0, LEVEL, SQUEEZES[:1])
    (tmp_path / "bag").mkdir()
    table, bag = write(made, tmp_path), write_bag(made, tmp_path / "bag")
    table.write_text("time,a\n1,b\n")
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:5000])
    for arguments, message in (
        ([table], "no table of numbers"),
        ([bag], "no recording that can be read"),
        ([table, "--out", RACK], "workcell itself"),
    ):
        assert main([str(RACK), *map(str, arguments)]) == 2
        assert message in capsys.readouterr().err
