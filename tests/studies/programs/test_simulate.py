"""`studies.simulate` and `studies.research.thresholds`: the witness's programs."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image, ImageSequence

from studies import simulate
from studies.research import thresholds
from tests.studies.programs.test_robust import TABLE, stored

pytest.importorskip("mujoco")

import mujoco


@pytest.mark.slow
def test_threshold_and_cases_of_a_stored_trajectory_without_arms(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = stored(tmp_path, TABLE)
    arguments = [str(path), "--controller", "pads", "--timing", "fastest", "--runs", "2"]
    assert simulate.main(arguments) == 0
    out = capsys.readouterr().out
    factor = float(out.split("holds from ")[1].split()[0])
    assert factor == pytest.approx(1.0, abs=0.03)
    assert "2 of 2 random cases hold" in out
    assert "least forces with the set's worst friction: slip" in out


@pytest.mark.slow
def test_arms_carry_a_stored_trajectory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, film, cell = stored(tmp_path, TABLE), tmp_path / "film.gif", tmp_path / "cell.xml"
    arguments = [str(path), "--force-limit", "55", "--runs", "2", "--film", str(film)]
    assert simulate.main([*arguments, "--mjcf", str(cell)]) == 0
    out = capsys.readouterr().out
    factor = float(out.split("holds from ")[1].split()[0])
    assert 1.0 < factor < 1.1
    assert "the box arrives" in out
    assert "2 of 2 random cases arrive" in out
    assert "least forces with the set's worst friction: slip" in out
    assert len(list(ImageSequence.Iterator(Image.open(film)))) > 20
    assert mujoco.MjModel.from_xml_path(str(cell)).nv == 18


@pytest.mark.slow
def test_thresholds_of_many_carries(capsys: pytest.CaptureFixture[str]) -> None:
    assert thresholds.main(["--carries", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert float(lines[1].split()[5]) == pytest.approx(1.0, abs=0.03)
    assert lines[-1].startswith("1 carries: median ")


def test_wrong_input_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simulate.main([str(tmp_path / "none.json")]) == 2
    assert "none.json" in capsys.readouterr().err
    path = stored(tmp_path, "")
    assert simulate.main([str(path), "--time-step", "0.1"]) == 2
    assert "time step" in capsys.readouterr().err
    assert simulate.main([str(path), "--controller", "pads", "--film", "film.gif"]) == 2
    assert "another --controller" in capsys.readouterr().err
