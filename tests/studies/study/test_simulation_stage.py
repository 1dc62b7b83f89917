"""Simulated carries of a study: what is stored, what is told, and what is asked for first."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.campaign.settings import SIMULATED
from hybrid_opt.errors import ResultsError
from hybrid_opt.store.files import write_json
from hybrid_opt.store.json_records import to_json
from hybrid_opt.work.service import SerialExecutor, Service
from studies import run
from studies.study.simulation import (
    Simulated,
    StoredSimulation,
    Written,
    is_done,
    read_simulations,
    wanted_carries,
)
from studies.study.tables import simulated
from tests.studies.conftest import simulation
from tests.symbolic.cells import RACK


def same(_: None, one: Simulated, emit: object) -> StoredSimulation:
    return replace(simulation(one.label), trajectory=one.digest)


def test_every_answer_is_kept_and_not_asked_for_again(own_study: Path) -> None:
    wanted = wanted_carries(own_study)
    assert [one.label for one in wanted] == ["hand-made", "NSGA-II", "MOPSO", "recommended"]
    assert not any(is_done(own_study, one) for one in wanted)
    told: list[int] = []
    ledger = Written(wanted[:3], own_study, lambda: told.append(1))
    SerialExecutor().run(Service(lambda: None, same), ledger)
    assert len(told) == 3
    assert [is_done(own_study, one) for one in wanted] == [True, True, True, False]
    changed = replace(wanted[0], digest="another trajectory")
    assert not is_done(own_study, changed)
    found = read_simulations(own_study)
    assert [one.label for one in found] == [one.label for one in wanted[:3]]
    np.testing.assert_array_equal(found[0].simulated, simulation("").simulated)


def test_a_damaged_file_is_told_and_simulated_anew(own_study: Path) -> None:
    one = wanted_carries(own_study)[0]
    (own_study / SIMULATED).mkdir()
    path = own_study / SIMULATED / f"{one.name}.json"
    document = to_json(replace(simulation(one.label), trajectory=one.digest))
    write_json(path, document)
    assert is_done(own_study, one)
    write_json(path, document | {"time": [0.0]})
    assert not is_done(own_study, one)
    with pytest.raises(ResultsError, match="different lengths"):
        read_simulations(own_study)


def test_the_table_tells_threshold_forces_and_what_became_of_the_box() -> None:
    nan, lost = float("nan"), "the box slips at 1.5 times the force; give other factors"
    slips = replace(
        simulation("slippery"), slips=nan, holds=nan, problem=lost, pad=0, arrives=False
    )
    first, second = simulated((simulation("good"), slips)).text().splitlines()[3:5]
    assert "1.000 to 1.004" in first
    assert "pad 2 at 0.50 s" in first
    assert "50.50 / 50.00" in first
    assert first.split()[-1] == "yes"
    assert lost in second
    assert second.split()[-1] == "NO"


def test_what_cannot_be_simulated_is_told_and_kept(own_study: Path) -> None:
    one = wanted_carries(own_study)[0]
    lost = StoredSimulation(one.label, one.digest, "leader", "joint 'lift' moves both arms")
    (own_study / SIMULATED).mkdir()
    write_json(own_study / SIMULATED / f"{one.name}.json", to_json(lost))
    assert is_done(own_study, one)
    (row,) = simulated(read_simulations(own_study)).text().splitlines()[3:4]
    assert "joint 'lift' moves both arms" in row
    assert row.split()[-1] == "NO"


def test_without_the_simulator_it_is_told_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    output = tmp_path / "results"
    assert run.main([str(RACK), "--simulate", "--output", str(output)]) == 2
    assert "MuJoCo is not installed" in capsys.readouterr().err
    assert not output.exists()
