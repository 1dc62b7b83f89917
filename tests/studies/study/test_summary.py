"""The summary's figures against hand-made replicas and independent computations."""

from __future__ import annotations

import json
import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_opt.campaign import CampaignFolder, ExecutionSettings
from hybrid_opt.campaign.results import CampaignResults, Replica, read_campaign
from hybrid_opt.campaign.settings import (
    SIMULATED,
    CampaignSettings,
    Configuration,
    StoredCell,
)
from hybrid_opt.cell import Cell
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.evaluation import FEASIBLE, REASONS, Evaluations
from hybrid_opt.indicators.statistics import rank_test
from hybrid_opt.progress import Progress
from hybrid_opt.static_hold import StaticHold
from hybrid_opt.store.files import from_json, to_json, write_json
from hybrid_opt.timing.analysis import closest_to_reference_timing, read_timing
from hybrid_opt.timing.solve import time_path
from hybrid_opt.workers import LocalWorkers
from studies import run
from studies.study import simulation as stage
from studies.study.recommendation import known_paths, least_force
from studies.study.simulation import (
    SimulationRequest,
    StoredSimulation,
    is_done,
    read_simulations,
    simulation_stage,
    wanted_carries,
)
from studies.study.summary import (
    SUMMARISED_FIGURES,
    TESTED,
    CampaignSummary,
    ReplicaFigures,
    SelectedEntry,
    best_steps,
    campaign_summary,
    replica_figures,
)
from studies.study.tables import PAPER, simulated, study_tables
from symbolic.read.cell import load
from symbolic.read.cell_files import collect_cell
from tests.hybrid_opt.campaign.fake import OBJECTIVES
from tests.refusals import ended_by
from tests.studies.conftest import simulation
from tests.symbolic.cells import RACK

NAN = math.nan
STATIC = StaticHold(np.array([49.05, 49.05]), np.array([69.4, 69.4]), 16.965)


def replica(objectives: list[list[float]], reasons: list[str], number: int = 0) -> Replica:
    """A replica with given objectives; an empty reason is a feasible candidate."""
    n = len(objectives)
    values = np.array(objectives)
    reason = np.array([REASONS.index(r) if r else FEASIBLE for r in reasons], dtype=np.int8)
    feasible = reason == FEASIBLE
    violation = np.zeros((n, len(REASONS)))
    violation[~feasible, reason[~feasible]] = 1.0
    found = Evaluations(
        np.zeros((n, 4)),
        values,
        np.where(feasible[:, None], values, 2.0),
        feasible,
        reason,
        np.where(feasible, np.nan, 0.5),
        violation,
        violation,
    )
    return Replica("nsga2", number, found, 1.5 + number)


FRONT = [[0.6, 0.4], [0.5, 0.5], [0.3, 0.3], [0.4, 0.7]]


def test_figures_of_a_replica_by_hand() -> None:
    mine = replica(FRONT, ["", "", "collision", ""])
    figures = replica_figures(mine, np.array([[0.4, 0.4]]), None, None)
    assert (figures.evaluations, figures.feasible, figures.feasible_share) == (4, 3, 0.75)
    assert figures.non_dominated == 3
    # Columns from the left, up to the corner (1.1, 1.1).
    area = 0.1 * (1.1 - 0.7) + 0.1 * (1.1 - 0.5) + 0.5 * (1.1 - 0.4)
    assert figures.hypervolume == pytest.approx(area)
    assert figures.igd == pytest.approx(math.sqrt(0.02))
    assert figures.igd_plus == pytest.approx(0.1414213562)
    # L1 distances to the nearest neighbour: 0.3, 0.2, 0.2.
    assert figures.spacing == pytest.approx(np.std([0.3, 0.2, 0.2], ddof=1))
    assert figures.infeasible_by_reason == {"collision": 1}
    assert [step.tolist() for step in figures.best_so_far] == [
        [1, 0.6, 0.4],
        [2, 0.5, 0.4],
        [4, 0.4, 0.4],
    ]
    assert figures.seconds == 1.5
    assert figures.selected is None
    assert math.isnan(figures.payload_limit)


def test_best_steps_begin_with_the_first_feasible_candidate() -> None:
    history = np.array([[NAN, NAN], [0.5, 0.6], [0.5, 0.6], [0.5, 0.4]])
    assert [step.tolist() for step in best_steps(history)] == [[2, 0.5, 0.6], [4, 0.5, 0.4]]
    assert best_steps(history[:1]) == ()


PAIR = np.array([50.0, 51.25])
LEAST = np.array([40.0, 41.0])
SELECTED = SelectedEntry(1, None, np.array([0.4, 0.6]), PAIR, LEAST, PAIR - 50.0, 16.5, 3.0)
PLAIN = ReplicaFigures(
    **dict.fromkeys(SUMMARISED_FIGURES, 0.5) | {"feasible": 5, "non_dominated": 2},  # type: ignore[arg-type]
    selected=SELECTED,
    replica=0,
    evaluations=10,
    infeasible_by_reason={"collision": 3, "reach_1": 1},
    best_so_far=(),
)


def entry(number: int, **figures: Any) -> ReplicaFigures:
    return replace(PLAIN, replica=number, **figures)


def results(entries: dict[str, list[ReplicaFigures]]) -> CampaignResults:
    settings = CampaignSettings(
        algorithms={name: {} for name in entries},
        evaluations=10,
        replicas=len(next(iter(entries.values()))),
        seed=1,
        objectives=OBJECTIVES,
    )
    configuration = Configuration("", 1, StoredCell("Rack", "", ""), settings, {})
    return CampaignResults(Path("results"), configuration, Cell(load(RACK)), ())


VOLUMES = {"nsga2": [0.4, 0.6, 0.5, 0.45, 0.55], "mopso": [0.1, 0.2, 0.15, 0.12, 0.18]}


def summary(entries: dict[str, list[ReplicaFigures]] | None = None) -> CampaignSummary:
    made = entries or {
        name: [entry(k, hypervolume=value) for k, value in enumerate(values)]
        for name, values in VOLUMES.items()
    }
    return campaign_summary(results(made), np.array([[0.4, 0.6]]), STATIC, made)


def test_statistics_and_tests_of_a_campaign() -> None:
    made = summary()
    statistics = made.algorithms["nsga2"].statistics["hypervolume"]
    assert statistics.mean == pytest.approx(0.5)
    assert statistics.std == pytest.approx(math.sqrt(0.00625))
    assert (statistics.quartile1, statistics.median, statistics.quartile3) == (0.45, 0.5, 0.55)
    assert made.algorithms["nsga2"].representative == 1
    tests = {test.figure: test for test in made.tests}
    assert set(tests) == set(TESTED)
    expected = rank_test(VOLUMES["nsga2"], VOLUMES["mopso"])
    # Two orders of the ranks of ten are as far apart: 2 of 252.
    assert tests["hypervolume"].p == expected.p == pytest.approx(2.0 / 252.0)
    assert tests["hypervolume"].a12 == 1.0
    assert tests["hypervolume"].p_holm == pytest.approx(len(TESTED) * 2.0 / 252.0)
    assert made.reference_front.hypervolume == pytest.approx(0.7 * 0.5)
    # It comes back from its file.
    document = to_json(made)
    again = from_json(CampaignSummary, json.loads(json.dumps(document)), Path(), "do it again")
    assert to_json(again) == document


def test_few_replicas_are_not_tested() -> None:
    few = {
        name: [entry(k, hypervolume=v) for k, v in enumerate(VOLUMES[name][:4])] for name in VOLUMES
    }
    made = summary(few)
    assert made.tests == ()
    assert "tests" not in {table.name for table in study_tables(made)}
    assert "tests" in {table.name for table in study_tables(summary())}


def test_figures_that_do_not_exist_become_null() -> None:
    none = {name: [entry(0, igd=math.inf, spacing=NAN, selected=None)] for name in VOLUMES}
    made = summary(none)
    stored = to_json(made)["algorithms"]["mopso"]["replicas"][0]
    assert stored["igd"] is None
    assert stored["spacing"] is None
    assert made.algorithms["mopso"].representative is None
    text = told(made)
    assert re.search("^ *MOPSO: ", text, re.MULTILINE)
    assert "nan" not in text
    assert "None" not in text


def told(made: CampaignSummary, with_paper: bool = True) -> str:
    return "\n".join(table.text() for table in study_tables(made, with_paper=with_paper))


def test_the_terminal_shows_the_tables() -> None:
    text = told(summary())
    assert max(map(len, text.splitlines())) <= 150
    lines = {line.split("  ")[0]: line for line in text.splitlines()}
    assert "0.5000 ± 0.0791" in text
    chosen = next(
        line for line in text.splitlines() if line.startswith("NSGA-II") and "51.25" in line
    )
    figures = ["40.00", "41.00", "50.00", "51.25", "0.62", "3.00", "16.50"]
    assert chosen.split()[1:] == figures
    assert lines["collision"].split()[1:] == ["30.0", "30.0"]
    assert lines["reach, left"].split()[2:] == ["10.0", "10.0"]
    held = ["49.05"] * 4 + ["0.00", "–", "16.96"]
    assert lines["level payload at rest"].split()[4:] == held


def test_the_papers_figures_stand_beside_ours_only_where_it_states_them() -> None:
    with_paper, without = (told(summary(), on) for on in (True, False))
    for stated in ("69.4", "16.71", "29.6", "16.06"):
        assert stated in with_paper
        assert stated not in without
    assert ", paper" not in told(summary({"random": [entry(0)]}))
    assert set(PAPER) == {"nsga2", "mopso"}


def test_ends_and_middle_of_polished_fronts_and_the_balanced_path_are_known(
    study: Path, polished_study: Path
) -> None:
    for root, fronts in ((study, 0), (polished_study, 2)):
        campaign = read_campaign(root)
        task, n = campaign.workcell.task, campaign.workcell.task.n_path
        (balanced,) = least_force(campaign, task).values()
        polished = [front.x for front in campaign.fronts if front.polished]
        assert len(polished) == fronts
        ends = [x[[0, len(x) // 2, -1], :n] for x in polished]
        expected = np.unique(np.vstack([balanced, *ends]), axis=0)
        np.testing.assert_array_equal(known_paths(root, task), expected)


def test_paths_are_timed_in_the_cell_that_robots_drive(study: Path) -> None:
    """Its pads press otherwise than the experiment's; the search's own timing stays its own."""
    document = read_timing(study / "timing" / "hand-made.json")
    own, driven = (read_campaign(root).cell for root in (study, study / "drivable"))
    assert own.workcell.task.allocation != driven.workcell.task.allocation
    found, curve = document.timings, document.force_curve
    assert found["search"].duration == pytest.approx(own.carry(own.initial).duration, rel=1e-12)
    assert curve is not None
    k = len(curve.force) // 2
    limits = driven.timing_model.drive_limits(float(curve.force[k]))
    timing = time_path(driven.timing_model, own.initial, limits)
    assert curve.duration[k] == pytest.approx(timing.duration, rel=1e-9)
    closest = closest_to_reference_timing(driven.timing_model, own.initial)
    assert found["closest to reference"].duration == pytest.approx(closest.duration, rel=1e-9)


def test_every_answer_is_kept_and_not_asked_for_again(
    own_study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = wanted_carries(own_study)
    assert [one.label for one in wanted] == ["hand-made", "NSGA-II", "MOPSO", "recommended"]
    assert not any(is_done(own_study, one) for one in wanted)
    asked: list[str] = []

    def few(one: SimulationRequest) -> StoredSimulation:
        asked.append(one.label)
        if one.label == "recommended" and len(asked) == 4:
            raise KeyboardInterrupt
        return replace(simulation(one.label), trajectory=one.digest)

    monkeypatch.setattr(stage, "_simulated", few)
    results, silent = read_campaign(own_study), Progress(shown=False)
    execution, files = ExecutionSettings(own_study, jobs=1), collect_cell(results.workcell)
    workers = LocalWorkers(1)
    folder = CampaignFolder(own_study, results.settings, execution, results.cell, files, workers)
    with pytest.raises(KeyboardInterrupt):
        simulation_stage().run(folder, silent)
    assert [is_done(own_study, one) for one in wanted] == [True, True, True, False]
    simulation_stage().run(folder, silent)
    assert asked[4:] == ["recommended"]
    (own_study / SIMULATED / f"{wanted[3].name}.json").unlink()
    changed = replace(wanted[0], digest="another trajectory")
    assert not is_done(own_study, changed)
    found = read_simulations(own_study)
    assert [one.label for one in found] == [one.label for one in wanted[:3]]
    np.testing.assert_array_equal(found[0].simulated, simulation("").simulated)


def test_a_damaged_file_is_simulated_anew_and_what_cannot_be_simulated_is_kept(
    own_study: Path,
) -> None:
    one = wanted_carries(own_study)[0]
    path = own_study / SIMULATED / f"{one.name}.json"
    path.parent.mkdir()
    document = to_json(replace(simulation(one.label), trajectory=one.digest))
    write_json(path, document)
    assert is_done(own_study, one)
    write_json(path, document | {"time": [0.0]})
    assert not is_done(own_study, one)
    with pytest.raises(ResultsError, match=f"{one.name}.json"):
        read_simulations(own_study)
    lost = StoredSimulation(one.label, one.digest, "leader", "joint 'lift'")
    write_json(path, to_json(lost))
    assert is_done(own_study, one)
    assert "joint 'lift'" in simulated(read_simulations(own_study)).text()


def test_the_table_tells_threshold_forces_and_what_became_of_the_box() -> None:
    lost = "the box slips at 1.5 times the force; give other factors"
    slips = replace(simulation("slippery"), slips=NAN, holds=NAN, problem=lost, pad=0)
    slips = replace(slips, arrives=False)
    first, second = simulated((simulation("good"), slips)).text().splitlines()[3:5]
    assert "1.000 to 1.004" in first
    assert "pad 2 at 0.50 s" in first
    assert "50.50 / 50.00" in first
    assert first.split()[-1] == "yes"
    assert lost in second
    assert second.split()[-1] == "NO"


def test_without_the_simulator_it_is_told_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    output = tmp_path / "results"
    with ended_by("missing-extra", "--simulate", "mujoco"):
        assert run.main([str(RACK), "--simulate", "--output", str(output)]) == 2
    assert not output.exists()
