"""Results compared, those of two campaigns, and damaged ones refused by every program."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_opt.campaign import CampaignSettings, ExecutionSettings, open_folder
from hybrid_opt.campaign.results import read_campaign
from hybrid_opt.campaign.search_stage import search_stage
from hybrid_opt.campaign.stages import run_stages
from hybrid_opt.indicators import metrics
from hybrid_opt.progress import Progress
from studies import compare as comparing
from studies.programs.comparison import compare
from studies.report import __main__ as report
from studies.research import control
from studies.study.summary import summary_stage
from symbolic.read.cell import load
from tests.refusals import ended_by
from tests.studies.conftest import TRANSFER


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign with another seed and another set of algorithms."""
    root = tmp_path_factory.mktemp("other") / "results"
    settings = CampaignSettings({"nsga2": {}, "random": {}}, evaluations=80, replicas=5, seed=9)
    execution = ExecutionSettings(root, jobs=1)
    with open_folder(settings, execution, load(TRANSFER)) as folder:
        run_stages(folder, (search_stage(), summary_stage()), Progress(shown=False))
    return root


def test_a_study_tells_its_fronts_instead_of_its_candidates(study: Path) -> None:
    found = read_campaign(study)
    lines = repr(found).splitlines()
    assert str(study) in lines[0]
    assert re.search(r"\b2 .*\b120 ", lines[0])
    for front in found.fronts:
        (line,) = (line for line in lines if line.startswith(f"  {front.title}  "))
        least, most = map(int, line.split(": ")[1].split(" to "))
        assert least <= len(front) <= most
    assert "array(" not in repr(found)
    assert lines[1].split("  ")[1] in found._repr_html_()


def test_five_replicas_are_tested(other: Path) -> None:
    tests = {f.figure: f.test for f in compare(other, other).figures if f.algorithm == "nsga2"}
    hypervolume = tests["hypervolume"]
    assert hypervolume is not None
    assert (hypervolume.count_first, hypervolume.count_second) == (5, 5)
    assert (hypervolume.a12, hypervolume.p) == (0.5, 1.0)


def test_figures_are_those_of_the_stored_candidates(study: Path, other: Path) -> None:
    found = compare(study, other)
    figures = {figure.figure: figure for figure in found.figures}
    runs = (read_campaign(study).of("nsga2"), read_campaign(other).of("nsga2"))
    for side, replicas in zip(("first", "second"), runs, strict=True):
        volumes = [metrics.hypervolume(replica.front) for replica in replicas]
        assert getattr(figures["hypervolume"], side).median == pytest.approx(np.median(volumes))
        shares = [replica.evaluations.feasible.mean() for replica in replicas]
        assert getattr(figures["feasible_share"], side).mean == pytest.approx(np.mean(shares))
    # One of the two has two replicas only, whose effects say nothing.
    assert all(figure.test is None for figure in found.figures)
    assert {figure.algorithm for figure in found.figures} == {"nsga2"}
    assert found.only == (("mopso",), ("random",))
    differences = {name: (a, b) for name, a, b in found.differences}
    assert differences["settings.seed"] == ("3", "9")
    assert differences["settings.evaluations"] == ("120", "80")


def test_a_campaign_equals_itself_and_so_does_its_drivable_experiment(
    study: Path, other: Path
) -> None:
    found = compare(study, study)
    assert found.same_workcell
    assert found.differences == ()
    for figure in found.figures:
        assert figure.first == figure.second or not np.isfinite(figure.first.mean)
    driven = found.drivable
    assert driven is not None
    assert driven.runs == (str(study / "drivable"),) * 2
    figures = {figure.figure: figure for figure in driven.figures if figure.algorithm == "nsga2"}
    fronts = [replica.front for replica in read_campaign(study / "drivable").of("nsga2")]
    volumes = [metrics.hypervolume(front) for front in fronts]
    assert figures["hypervolume"].first.median == pytest.approx(np.median(volumes))
    assert compare(study, other).drivable is None


def test_polished_fronts_are_compared_too(polished_study: Path, study: Path) -> None:
    """A folder with polished fronts, beside itself and beside one without."""
    found = compare(polished_study, polished_study)
    figures = {f.figure: f for f in found.figures if f.algorithm == "nsga2"}
    run = read_campaign(polished_study)
    fronts = [front for front in run.fronts if front.polished and front.algorithm == "nsga2"]
    volumes = [metrics.hypervolume(front.objectives) for front in fronts]
    assert len(volumes) == 2
    assert figures["polished_hypervolume"].first.median == pytest.approx(np.median(volumes))
    assert figures["polished_hypervolume"].first.mean >= figures["hypervolume"].first.mean
    assert np.isfinite(figures["polished_payload_limit"].second.median)
    names = {figure.figure for figure in compare(study, polished_study).figures}
    assert not any(name.startswith("polished_") for name in names)


def test_prints_text_and_json(study: Path, other: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert comparing.main([str(study), str(other)]) == 0
    text = capsys.readouterr().out
    assert "NSGA-II, hypervolume" in text
    assert comparing.main([str(study), str(study)]) == 0
    assert "drivable" in capsys.readouterr().out
    assert "B: random search" in text
    assert comparing.main([str(study), str(other), "--json"]) == 0
    document = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert document["same_workcell"] is True
    with ended_by("no-results-folder", study / "figures"):
        assert comparing.main([str(study), str(study / "figures")]) == 2


PROGRAMS: tuple[Callable[[Path, Path], int], ...] = (
    lambda damaged, whole: report.main([str(damaged), "--quiet"]),
    lambda damaged, whole: comparing.main([str(whole), str(damaged)]),
    lambda damaged, whole: control.main([str(damaged), "--evaluations", "200"]),
)


def put(path: str, value: Any) -> Callable[[Any], Any]:
    """Puts a value at a dotted path of a document."""

    def change(document: Any) -> Any:
        *parents, last = path.split(".")
        place = document
        for name in parents:
            place = place[int(name) if isinstance(place, list) else name]
        place[int(last) if isinstance(place, list) else last] = value
        return document

    return change


FIRST = "algorithms.nsga2.replicas.0"

FAULTS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "a list": ("summary.json", lambda document: []),
    "text for a number": ("summary.json", put(f"{FIRST}.hypervolume", "0.4")),
    "no replicas": ("summary.json", put("algorithms.nsga2.replicas", [])),
    "a huge whole number": ("summary.json", put(f"{FIRST}.hypervolume", 10**400)),
    "half a letter": ("summary.json", put("workcell.name", "\ud800")),
    "three robots": ("summary.json", put("static_hold.normal_force", [1.0, 2.0, 3.0])),
    "of another campaign": ("summary.json", put("settings.seed", 99)),
    "numbers for algorithms": ("configuration.json", put("settings.algorithms", [1, 2])),
    "unknown handling": ("configuration.json", put("settings.constraint_handling", "prayer")),
    "no workcell": ("configuration.json", put("workcell", None)),
}
"""What is damaged, and how; random damage to every file is that of tests/fuzz."""


@pytest.mark.parametrize("fault", FAULTS)
def test_every_program_tells_what_is_damaged(
    study: Path, own_study: Path, fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file, change = FAULTS[fault]
    path = own_study / file
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    for program in PROGRAMS:
        assert program(own_study, study) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.count("\n") == 1
        assert file in printed.err
