"""`studies.simulate` and `studies.research.thresholds`: the witness's programs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from PIL import Image, ImageSequence

from hybrid_opt import recommend, search
from hybrid_opt.cell import Cell
from hybrid_opt.compiled_cell import InterpretedCell
from hybrid_opt.extras.simulation.reference import Control
from hybrid_opt.store.trajectory_file import write_trajectory
from studies import simulate
from studies.research import thresholds
from tests.refusals import ended_by
from tests.studies.programs.test_carries import TABLE, stored
from tests.symbolic.cells import RACK

pytest.importorskip("mujoco")

import mujoco


@pytest.mark.slow
def test_threshold_and_cases_of_a_stored_trajectory_without_arms(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The paper's forces are the least of the pads that it assumes; what is commanded holds."""
    path = stored(tmp_path, TABLE)
    arguments = [str(path), "--controller", "pads-driven", "--timing", "fastest", "--runs", "2"]
    assert simulate.main(arguments) == 0
    out = capsys.readouterr().out
    factor = float(out.split("holds from ")[1].split()[0])
    assert factor == pytest.approx(1.0, abs=0.03)
    assert "2 of 2 " in out
    assert re.search("worst .*slip", out)


@pytest.mark.slow
def test_arms_carry_a_stored_trajectory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, film, cell = stored(tmp_path, TABLE), tmp_path / "film.gif", tmp_path / "cell.xml"
    arguments = [str(path), "--planned-limit", "55", "--runs", "2", "--film", str(film)]
    assert simulate.main([*arguments, "--mjcf", str(cell)]) == 0
    out = capsys.readouterr().out
    factor = float(out.split("holds from ")[1].split()[0])
    assert 1.1 < factor < 1.5, "the paper's forces do not hold pads that press evenly"
    assert "2 of 2 " in out
    assert re.search("worst .*slip", out)
    assert len(list(ImageSequence.Iterator(Image.open(film)))) > 20
    assert mujoco.MjModel.from_xml_path(str(cell)).nv == 18


@pytest.mark.slow
def test_thresholds_of_many_carries_go_on_from_what_is_stored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(RACK), "--output", str(tmp_path / "found.json"), "--carries"]
    assert thresholds.main([*arguments, "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert float(lines[1].split()[7]) == pytest.approx(1.0, abs=0.03)
    assert lines[1].endswith("1 of 1")
    assert lines[2].startswith("1 ")
    assert "1 of 1 " in lines[3]
    assert thresholds.main([*arguments, "1"]) == 0
    assert capsys.readouterr().out.splitlines()[1] == lines[1].removesuffix("  1 of 1").rstrip()
    with ended_by("another-seed"):
        assert thresholds.main([*arguments, "2", "--seed", "2"]) == 2


@pytest.fixture(scope="module")
def recommended(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A shipped cell's carry to run, of a small search."""
    name: str = request.param
    cell = Cell.load(RACK.with_name(f"{name}.toml")).drivable()
    front = search(cell, evaluations=300, rng=np.random.default_rng(1))
    path = tmp_path_factory.mktemp(name) / "recommended.json"
    write_trajectory(path, cell.workcell, recommend(front).x, {}, {"algorithm": "nsga2"})
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recommended", "controller"),
    [
        *(("rack", controller) for controller in [*get_args(Control), "pads"]),
        *((name, how) for name in ("transfer", "pandas") for how in ("leader", "pads")),
        ("uneven", "pads"),
    ],
    indirect=["recommended"],
)
def test_the_recommended_carry_is_held_over_the_whole_uncertainty(
    recommended: Path, controller: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pads that press evenly, no moments commanded, the forces of its job."""
    assert simulate.main([str(recommended), "--controller", controller, "--runs", "20"]) == 0
    out = capsys.readouterr().out
    assert "20 of 20 " in out
    assert float(out.split("it holds: slip up to ")[1].split()[0]) < 0.5
    assert re.search("worst .*slip", out)


@pytest.mark.slow
@pytest.mark.parametrize("recommended", ["palletising", "plate"], indirect=True)
def test_hands_hold_the_recommended_carry_over_the_whole_uncertainty(
    recommended: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of the recommended force does not hold all cases, nor the worst of the model."""
    assert simulate.main([str(recommended), "--runs", "20"]) == 0
    out = capsys.readouterr().out
    assert 0.8 <= float(out.split("holds from ")[1].split()[0]) <= 1.02
    assert "20 of 20 " in out
    assert int(re.search(r"(\d+) with half", out)[1]) < 20  # type: ignore[index]
    assert 0.5 < float(out.split("case holds from ")[1].split()[0]) <= 1.02


@pytest.mark.parametrize("name", ["palletising", "rack"])
def test_a_controller_of_other_hands_is_refused(tmp_path: Path, name: str) -> None:
    cell, path = Cell.load(RACK.with_name(f"{name}.toml")).drivable(), tmp_path / "carry.json"
    stored_by = InterpretedCell(cell.workcell)
    write_trajectory(path, stored_by, cell.initial, {}, {"algorithm": "nsga2"})
    controller = "hands" if name == "rack" else "leader"
    with ended_by("controller", f"--controller {controller}"):
        assert simulate.main([str(path), "--controller", controller]) == 2


def test_wrong_input_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simulate.main([str(tmp_path / "none.json")]) == 2
    assert "none.json" in capsys.readouterr().err
    path = stored(tmp_path, "")
    assert simulate.main([str(path), "--time-step", "0.1"]) == 2
    assert "time step" in capsys.readouterr().err
    with ended_by("controller"):
        assert simulate.main([str(path), "--controller", "pads", "--film", "film.gif"]) == 2
