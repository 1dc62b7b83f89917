"""Proposals of whole cells; the oracle is the cell's own evaluator, compiled, from the file."""

from __future__ import annotations

import time
import tomllib
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.errors import ProposalError
from hybrid_opt.proposing.document import completed
from symbolic.errors import SettingsError, WorkcellError
from symbolic.read.cell import load
from tests.hybrid_opt.proposing.generated import write_problem
from tests.hybrid_opt.proposing.problems import (
    BAXTER,
    shipped_problem,
    tiago_problem,
    turned_problem,
)

RACK = Path("studies/workcells/rack.toml")


def rack_problem(folder: Path, changes: dict[str, object] | None = None) -> Path:
    """The rack without its hand-made trajectory, spins and waypoints."""
    text = RACK.read_text(encoding="utf-8")
    data = tomllib.loads(text)
    urdf = str(RACK.resolve().parent / data["robots"][0]["urdf"])
    stripped = {
        "robots": [{"urdf": urdf}, {"urdf": urdf}],
        "contacts": [{"spin": None}, {"spin": None}],
        "task": {"initial": None, "waypoints": None, **(changes or {})},
    }
    path = folder / "rack.toml"
    path.write_text(completed(text, data, stripped), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def proposal(tmp_path_factory: pytest.TempPathFactory) -> ho.Proposal:
    path = rack_problem(tmp_path_factory.mktemp("rack"))
    settings = ho.ProposeSettings(clock=time.process_time)  # other work does not count
    return ho.propose(path, rng=np.random.default_rng(1), settings=settings)


def test_the_rack_gets_a_certified_carry(proposal: ho.Proposal, tmp_path: Path) -> None:
    path = tmp_path / "proposed.toml"
    path.write_text(proposal.text(tmp_path), encoding="utf-8")
    cell = ho.Cell.load(path)
    judged = cell.carry(cell.initial).judgement
    assert judged is not None
    assert judged.feasible
    assert judged.objectives == pytest.approx(proposal.judgement.objectives, abs=1e-6)
    assert cell.certify(cell.initial).is_free
    found = cell.evaluate(cell.random(2000, np.random.default_rng(5)))
    assert 0.02 <= found.feasible.mean() <= 0.20
    assert proposal.feasible_share == pytest.approx(found.feasible.mean(), abs=0.06)


def test_comments_of_the_problem_stay(proposal: ho.Proposal, tmp_path: Path) -> None:
    assert "# Two GoFa 12 carry a box" in proposal.text(tmp_path)
    assert "certified" in str(proposal)


def test_missing_reach_is_told_in_metres(tmp_path: Path) -> None:
    path = rack_problem(tmp_path, {"goal": [0.0, 0.0, 1.65, 0.0, 0.0, 0.0]})
    with pytest.raises(ProposalError, match=r"(left|right) lacks 0\.\d+ m to its contact"):
        ho.propose(path, rng=np.random.default_rng(1))


def test_what_the_start_collides_with_is_named(tmp_path: Path) -> None:
    path = rack_problem(tmp_path, {"start": [0.0, 0.0, 0.72, 0.0, 0.0, 0.0]})
    with pytest.raises(ProposalError, match="payload meets middle board at the start"):
        ho.propose(path, rng=np.random.default_rng(1))


def test_a_wrong_problem_is_told_with_its_key(tmp_path: Path) -> None:
    path = rack_problem(tmp_path, {"goal": [0.0, 0.0]})
    with pytest.raises(WorkcellError, match=r"task\.goal"):
        ho.propose(path, rng=np.random.default_rng(1))
    path = rack_problem(tmp_path, {"reference_speed": -1.0})
    with pytest.raises(WorkcellError, match=r"task\.reference_speed") as told:
        ho.propose(path, rng=np.random.default_rng(1))
    assert str(path) in str(told.value)


@pytest.mark.slow
def test_generated_cells_get_carries(tmp_path: Path) -> None:
    """Of twenty at least sixteen, each within a minute of one core."""
    settings = ho.ProposeSettings(seconds=60.0, clock=time.process_time)
    solved = 0
    for seed in range(20):
        path = write_problem(seed, tmp_path)
        try:
            found = ho.propose(path, rng=np.random.default_rng(1), settings=settings)
        except ProposalError:
            continue
        assert found.judgement.feasible
        assert 0.02 <= found.feasible_share <= 0.20
        solved += found.seconds <= 60.0
    assert solved >= 16


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tiago", "baxter", "pandas", "drum", "fork", "turned", "pitched"])
@pytest.mark.filterwarnings("ignore::symbolic.geometry.hulls.CollisionModelWarning")
def test_cells_of_every_kind_get_carries(name: str, tmp_path: Path) -> None:
    """Machines with both arms in one file, portals, other payloads and pads, a box turned over."""
    path = tmp_path / "problem.toml"
    if name == "tiago":
        path = tiago_problem(tmp_path)
    elif name == "baxter":
        path.write_text(BAXTER, encoding="utf-8")
    elif name in ("turned", "pitched"):
        rotation = "quaternion" if name == "turned" else "roll-pitch-yaw"
        path = turned_problem(tmp_path, rotation)
    else:
        path = shipped_problem(name, tmp_path)
    settings = ho.ProposeSettings(clock=time.process_time)
    found = ho.propose(path, rng=np.random.default_rng(1), settings=settings)
    assert found.judgement.feasible
    assert 0.02 <= found.feasible_share <= 0.20
    assert found.seconds <= settings.seconds
    proposed = tmp_path / "proposed.toml"
    proposed.write_text(found.text(tmp_path), encoding="utf-8")
    contacts = load(proposed).contacts
    if name == "fork":  # its pads stand rigidly beside one another
        np.testing.assert_allclose(contacts[0].T_box_pad, load(path).contacts[0].T_box_pad)


def test_settings_are_checked() -> None:
    with pytest.raises(SettingsError, match="seconds"):
        ho.ProposeSettings(seconds=0.0)
    with pytest.raises(SettingsError, match="feasible"):
        ho.ProposeSettings(feasible=(0.3, 0.2))
