"""Payloads that cannot be held still: found before any work, with what would do, by every door."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.static_hold import static_hold_error
from hybrid_opt.timing.model import TimingModel
from studies import propose, run
from studies.program import BAD_INPUT
from studies.programs.inspection import inspected
from symbolic.errors import WorkcellError
from symbolic.read.cell import load
from symbolic.records import Workcell
from tests.hybrid_opt.cells import shipped
from tests.hybrid_opt.extras.proposing.problems import shipped_problem
from tests.refusals import ended_by, refused
from tests.symbolic.cells import RACK

GRAVITY = 9.81
CELLS = sorted(RACK.parent.glob("*.toml"))


def changed(name: str, folder: Path, **values: float) -> Path:
    """A shipped cell with other values of some keys, its uncertainty as it is."""
    path = RACK.with_name(f"{name}.toml")
    text = path.read_text().replace("../robots", str(RACK.parents[1] / "robots"))
    tables = re.split(r"^(?=\[)", text, flags=re.MULTILINE)
    for key, value in values.items():
        pattern = re.compile(rf"^{key} = .*$", flags=re.MULTILINE)
        assert any(map(pattern.search, tables))
        tables = [
            table if table.startswith("[uncertainty]") else pattern.sub(f"{key} = {value}", table)
            for table in tables
        ]
    other = folder / path.name
    other.write_text("".join(tables))
    return other


def number(text: str, unit: str, before: str = "") -> float:
    """A number of the remedy."""
    found = re.search(rf"{before}\b([\d.]+){unit}", text)
    assert found is not None, text
    return float(found[1])


@pytest.fixture
def slippery(tmp_path: Path) -> Path:
    """20 kg at friction 0.1: 981 N at rest, eight times the reference force."""
    return changed("rack", tmp_path, mass=20.0, friction=0.1)


@pytest.mark.parametrize("path", CELLS, ids=[path.stem for path in CELLS])
def test_every_cell_that_ships_can_be_held(path: Path) -> None:
    assert static_hold_error(load(path)) == ""


def test_needed_allowed_and_remedies_are_told(slippery: Path, tmp_path: Path) -> None:
    why = static_hold_error(load(slippery))
    assert re.search(r"left .* 981 N .* 117\.7 N.* right ", why)
    mass, friction = number(why, " kg"), number(why, "", "friction .*?")
    for lighter in (mass, 1.01 * mass):
        enough = (
            static_hold_error(load(changed("rack", tmp_path, mass=lighter, friction=0.1))) == ""
        )
        assert enough is (lighter == mass)
    for rougher in (friction, 0.99 * friction):
        enough = (
            static_hold_error(load(changed("rack", tmp_path, mass=20.0, friction=rougher))) == ""
        )
        assert enough is (rougher == friction)


def test_the_whole_force_is_the_arms_payload(tmp_path: Path) -> None:
    """At mu = 1 a robot bears 12 kgf in all at 16.97 kg, though it presses with less."""
    assert static_hold_error(load(changed("rack", tmp_path, mass=16.9))) == ""
    why = static_hold_error(load(changed("rack", tmp_path, mass=17.0)))
    assert "left" in why
    assert number(why, " kg") == pytest.approx(16.97, abs=0.01)


def test_a_patch_that_would_do_is_told(tmp_path: Path) -> None:
    why = static_hold_error(load(changed("transfer", tmp_path, patch_radius=0.005)))
    assert " 10 mm" in why
    radius = 1e-3 * number(why, " mm radius")
    assert static_hold_error(load(changed("transfer", tmp_path, patch_radius=1.001 * radius))) == ""
    assert static_hold_error(load(changed("transfer", tmp_path, patch_radius=0.98 * radius))) != ""


def test_a_joint_that_is_too_weak_is_told() -> None:
    """Held against the timing model's own torques of standing still."""
    cell = shipped("rack")
    model = TimingModel(cell.compiled)
    still = model.still(model.path_motion(cell.initial))
    ends = np.abs(still.torque)[[0, -1]]
    limit = np.concatenate([robot.torque_max for robot in cell.workcell.robots])
    share = float((ends / limit).max())
    assert cell.static_hold_error == ""

    def limited(factor: float) -> Workcell:
        robots = [replace(r, torque_max=factor * r.torque_max) for r in cell.workcell.robots]
        return replace(cell.workcell, robots=(robots[0], robots[1]))

    assert static_hold_error(limited(1.001 * share), cell.evaluator.outputs) == ""
    why = static_hold_error(limited(0.999 * share), cell.evaluator.outputs)
    end, joint = np.unravel_index(int((ends / limit).argmax()), ends.shape)
    assert "joint torque" in why
    assert re.search(rf" {ends[end, joint]:.4g} N m .*{('start', 'goal')[end]}", why)
    assert static_hold_error(limited(0.999 * share)) == ""  # postures are not known


def test_no_search_begins(slippery: Path) -> None:
    cell = ho.Cell.load(slippery)
    with refused(WorkcellError, "workcell", "payload: ", static_hold_error(cell.workcell)):
        ho.search(cell, "random", evaluations=1, rng=np.random.default_rng(1))


def test_no_study_begins(
    slippery: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "results"
    with ended_by("workcell", static_hold_error(load(slippery))):
        given = [str(slippery), "--output", str(output), "--quick", "--jobs", "1"]
        assert run.main(given) == BAD_INPUT
    said = capsys.readouterr()
    assert "compiling" not in said.err
    assert said.out == ""
    assert not output.exists()


def test_the_inspection_says_infeasible(slippery: Path) -> None:
    parts = inspected(load(slippery), 1, 1)
    part = next(part for part in parts if "unheld" in part.values)
    static_hold_error = part.values["unheld"]
    assert any(static_hold_error in line for line in part.lines)
    assert "981 N" in static_hold_error


def test_no_workcell_is_proposed(tmp_path: Path) -> None:
    path = shipped_problem("rack", tmp_path)
    text = path.read_text()
    path.write_text(re.sub(r"^friction = .*$", "friction = 0.1", text, flags=re.MULTILINE))
    with ended_by("workcell", "payload: "):
        assert propose.main([str(path), "--quiet"]) == BAD_INPUT
    assert not list(tmp_path.glob("*proposed*"))
