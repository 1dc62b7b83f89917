"""`python -m studies.simulate` and `python -m studies.thresholds`: the witness's programs."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies import simulate, thresholds
from tests.studies.test_robust import TABLE, stored

pytest.importorskip("mujoco")


@pytest.mark.slow
def test_threshold_and_cases_of_a_stored_trajectory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = stored(tmp_path, TABLE)
    assert simulate.main([str(path), "--timing", "fastest", "--runs", "2"]) == 0
    out = capsys.readouterr().out
    factor = float(out.split("holds from ")[1].split()[0])
    assert factor == pytest.approx(1.0, abs=0.03)
    assert "2 of 2 random cases hold" in out
    assert "least forces with the set's worst friction: slip" in out


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
    assert "two time steps" in capsys.readouterr().err
