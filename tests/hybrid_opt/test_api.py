"""The front door: a cell is searched, polished, timed, exported and stored with a few calls."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

import hybrid_opt as ho
from hybrid_opt.campaign.candidates import decode
from hybrid_opt.campaign.search_stage import SearchRequest, search_replica
from hybrid_opt.campaign.settings import CampaignSettings
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.objectives import non_dominated
from hybrid_opt.polishing.settings import FillSettings, ProbeSettings
from hybrid_opt.store.bundle_file import read_manifest
from hybrid_opt.store.files import sha256
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.read.cell_files import collect_cell
from symbolic.records import Workcell
from tests.hybrid_opt.campaign.fake import RACK
from tests.hybrid_opt.cells import shipped
from tests.refusals import refused

EVALUATIONS = 120


def cell() -> ho.Cell:
    return shipped("rack")


@cache
def front() -> ho.Front:
    rng = CampaignSettings().replica_rng("nsga2", 0)
    return ho.search(cell(), "nsga2", evaluations=EVALUATIONS, rng=rng)


@cache
def polished() -> ho.Front:
    fill = FillSettings(solved=8, members=16, attempts=1)
    probe = ProbeSettings(starts=2, middle_starts=2)
    settings = ho.PolishSettings(attempts=2, rounds=3, fill=fill, probe=probe)
    return ho.polish(front(), rng=np.random.default_rng(1), settings=settings)


def test_an_unknown_objective_is_refused_where_a_cell_is_loaded() -> None:
    with refused(SettingsError, "unknown-objective", "'speed'", "peak_force_1"):
        ho.Cell.load(RACK, ["speed"])
    with refused(SettingsError, "repeated"):
        ho.Cell(ho.Cell.load(RACK).workcell, ["duration", "duration"])


def test_an_unknown_algorithm_is_told_before_anything_is_compiled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ho.Cell, "evaluator", property(lambda cell: pytest.fail("compiled")))
    with refused(SettingsError, "unknown-algorithm"):
        ho.search(ho.example("rack"), "simplex", rng=np.random.default_rng(1))


def test_known_paths_are_refused_where_they_take_no_part() -> None:
    with pytest.raises(SettingsError, match=r"Cell\.drivable\(\)"):
        ho.polish(front(), rng=np.random.default_rng(1), paths=[cell().initial])


def test_everything_that_is_promised_is_there() -> None:
    assert set(ho.__all__) <= set(dir(ho))
    for name in ho.__all__:
        assert getattr(ho, name).__name__ == name
    with pytest.raises(AttributeError, match="'Front2'"):
        _ = ho.Front2


def test_importing_it_imports_nothing_slow() -> None:
    program = "import sys, hybrid_opt; print(*sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    slow = {"numpy", "casadi", "pinocchio", "fcl", "pymoo", "scipy", "toppra", "matplotlib"}
    assert not slow & set(run.stdout.split())


def test_a_search_is_the_one_that_a_campaign_runs() -> None:
    settings = CampaignSettings(algorithms={"nsga2": {}}, evaluations=EVALUATIONS)
    request = SearchRequest(collect_cell(cell().workcell), settings, "nsga2", 0)
    found = decode(search_replica(request), Path()).evaluations
    assert len(front()) > 1
    for field in fields(found):
        own = getattr(front().evaluations, field.name)
        np.testing.assert_array_equal(getattr(found, field.name), own)
    assert len(found) == EVALUATIONS


def test_a_front_is_proven_and_not_dominated() -> None:
    assert non_dominated(front().objectives).all()
    assert (np.diff(front().objectives[:, 0]) > 0.0).all()
    for carry in front():
        assert carry.judgement is not None
        assert carry.judgement.feasible
        assert cell().certify(carry).is_free
    counts = front().evaluations.infeasible_by_reason
    assert sum(counts.values()) == np.sum(~front().evaluations.feasible)


def test_selections() -> None:
    peaks = np.array([carry.peak_normal_force for carry in front()])
    mean = front().balanced().peak_normal_force.mean()
    assert mean == pytest.approx(peaks.mean(axis=1).min(), rel=3e-4)
    for robot in (0, 1):
        assert front().lowest_force(robot).peak_normal_force[robot] == peaks[:, robot].min()
    np.testing.assert_array_equal(front().lowest("peak_force_2").x, front().lowest_force(1).x)
    with refused(SettingsError, "robot", 2):
        front().lowest_force(2)
    with refused(SettingsError, "unknown-objective", "peak_force_1"):
        front().lowest("duration")


def test_an_empty_front_says_so() -> None:
    empty = ho.search(
        cell(),
        "random",
        evaluations=1,
        rng=np.random.default_rng(0),
    )
    if len(empty):
        pytest.fail("this candidate was to be infeasible")
    assert "0 carries" in repr(empty)
    assert "<svg" not in empty._repr_html_()
    with refused(SettingsError, "empty-front"):
        empty.balanced()


def test_another_process_can_be_given_a_front() -> None:
    cell().evaluator.evaluate(front().x)
    given = pickle.loads(pickle.dumps(front()))
    np.testing.assert_array_equal(given.objectives, front().objectives)
    assert (given.title, given.objective_names) == (front().title, front().objective_names)


def test_a_polish_makes_it_better() -> None:
    assert polished().hypervolume() > front().hypervolume()
    assert polished().title == "NSGA-II, polished"
    done = polished().polished
    assert done is not None
    accepted = sum(outcome.status == "accepted" for outcome in done.outcomes)
    text = repr(polished())
    assert f"{accepted} accepted" in text
    assert f"of {len(done.outcomes)} attempts" in text


def test_a_front_prints_and_draws_itself() -> None:
    assert f"{len(front())} carries" in repr(front())
    page = front()._repr_html_()
    assert page.count("<use") > len(front())


def test_a_carry_is_timed_and_exported(tmp_path: Path) -> None:
    carry = front().balanced()
    timing = ho.time_path(cell(), carry, ho.TimingLimits(force=52.0))
    assert timing.ok
    assert timing.carry is not None
    assert timing.carry.peak_normal_force.max() <= 52.0 * 1.005
    np.testing.assert_array_equal(timing.carry.x, carry.x)
    assert "joint acceleration" in repr(timing)
    assert "<table" in timing._repr_html_()
    files = ho.export(timing, "torque", tmp_path)
    assert {"manifest.json", "job.json"} <= {file.name for file in files}
    (folder,) = {file.parent for file in files if file.name == "manifest.json"}
    told = read_manifest(folder)["files"]
    assert {folder / name for name in told} == set(files) - {folder / "manifest.json"}
    assert told == {name: sha256((folder / name).read_bytes()) for name in told}
    every = ho.compare_timings(cell(), carry.x, force_limit=52.0)
    assert every.timings["force limited"].duration == pytest.approx(timing.duration)


def _height(outputs: Mapping[str, Array], _: Workcell) -> Array:
    return np.asarray(outputs["pose"][:, :, 2].max(axis=1) / 2.0)


def test_objectives_of_ones_own() -> None:
    tall = ho.Objective("height", "largest height / 2 m", _height)
    mine = ho.Cell.load(RACK, objectives=("peak_force_1", tall))
    assert mine.objective_names == ("peak_force_1", "height")
    carry = mine.carry(mine.initial)
    assert carry.judgement is not None
    assert carry.judgement.objectives["height"] == carry.pose[:, 2].max() / 2


def test_what_there_is_to_choose_from() -> None:
    assert ho.algorithms()["nsga2"] == "NSGA-II"
    assert set(cell().objective_names) <= set(ho.objectives())
    assert {"torque", "data"} <= set(ho.targets())
    assert repr(ho.example("rack")) == repr(ho.Cell.load(RACK))
    with refused(SettingsError, "unknown-cell", "'shelf'", "drum"):
        ho.example("shelf")
    assert ho.__version__ == version("dual-arm-carry")


def test_what_was_stored_is_read_back(tmp_path: Path) -> None:
    carry = cell().carry(cell().initial)
    ho.save(carry, tmp_path / "carry.json")
    again = ho.load(tmp_path / "carry.json")
    assert isinstance(again, ho.Carry)
    np.testing.assert_array_equal(again.normal_force, carry.normal_force)
    ho.save(again, tmp_path / "again.json")  # its cell's files are still there
    ho.export(ho.time_path(cell(), carry), "data", tmp_path)
    (bundle,) = tmp_path.glob("*/data")
    manifest = ho.load(bundle)
    assert isinstance(manifest, Mapping)
    assert manifest["written_by"].endswith(ho.__version__)
    assert isinstance(ho.load(RACK), ho.Cell)
    with refused(ResultsError, "no-results-folder"):
        ho.load(tmp_path)


def test_calls_tell_how_far_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    told: list[tuple[int, int]] = []
    ho.search(
        cell(),
        "mopso",
        evaluations=50,
        rng=np.random.default_rng(1),
        settings=ho.SearchSettings(algorithm=ho.MopsoSettings(swarm=20)),
        progress=lambda done, total: told.append((done, total)),
    )
    assert told == [(20, 50), (40, 50), (50, 50)]
    ho.search(cell(), evaluations=60, rng=np.random.default_rng(1), progress=True)
    assert "nsga2: 100%" in capsys.readouterr().err
