"""The program writes the bundle of a stored trajectory, and says what is in the way."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import hybrid_opt as ho
from studies.check import main as check_main
from studies.export import main
from tests.hybrid_opt.job.jobs import rack
from tests.symbolic.cells import RACK


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trajectory where a results folder of a study has it."""
    path = tmp_path_factory.mktemp("r") / "rack" / "selected" / "nsga2" / "02.json"
    path.parent.mkdir(parents=True)
    provenance = {"algorithm": "nsga2", "replica": 2, "row": 17}
    ho.save(rack().carry(rack().initial), path, provenance)
    return path


def test_a_bundle_is_written(
    stored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(stored), "--target", "csv", "--output", str(tmp_path)]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    for part in ("approach", "set down", "Position control", "Either arm late", "warning"):
        assert part in text
    (folder,) = tmp_path.iterdir()
    assert folder.name.startswith("rack-nsga2-r02-p0017-")
    manifest = json.loads((folder / "csv" / "manifest.json").read_text())
    assert manifest["trajectory"]["file"] == "02.json"
    assert manifest["trajectory"]["replica"] == 2
    assert main([*arguments, "--squeeze", "1.6", "--force-limit", "60"]) == 0
    assert len(list(tmp_path.iterdir())) == 2
    (folder / "csv" / "mine.txt").write_text("mine")
    assert main(arguments) == 2
    assert "mine.txt" in capsys.readouterr().err
    assert (folder / "csv" / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--target", "csv", "--step", "0"], "time step"),
        (["--target", "csv", "--use", "force"], "--force-limit"),
        (["--target", "csv", "--force-limit", "1"], "no timing to export"),
        (["--target", "csv", "--squeeze", "0.5"], "allowed is 1 to 10"),
        (["--target", "csv", "--stiffness", "0"], "stiffness"),
        (["--target", "csv", "--smoothing", "-1"], "smoothing"),
        (["--target", "csv", "--smoothing", "nan"], "smoothing"),
        (["--target", "ur-script"], "--any-arm"),
        (["--target", "csv", "--skew", "0.02", "--stiffness", "50000"], "a skew of 20 ms"),
        (["--target", "csv", "--skew", "-1"], "skew"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(
    stored: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    assert main([str(stored), "--output", str(tmp_path), *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_job_is_judged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The door of the check; what it finds is tested in tests/hybrid_opt/bundles."""
    path = tmp_path / "job.csv"
    path.write_text("time,left_joint_1\n0,0\n")
    assert check_main([str(RACK), str(path)]) == 2
    assert "no joint trajectory of both arms" in capsys.readouterr().err
