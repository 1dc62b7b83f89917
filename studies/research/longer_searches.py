"""A polished study beside searches alone that may spend as much, or far more."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hybrid_opt.campaign import (
    CampaignSettings,
    ExecutionSettings,
    open_folder,
    run_stages,
    search_stage,
)
from hybrid_opt.campaign.results import CampaignResults, read_campaign
from hybrid_opt.campaign.settings import CONFIGURATION
from hybrid_opt.display.table import number, text_table
from hybrid_opt.errors import ResultsError
from hybrid_opt.indicators import metrics
from hybrid_opt.metaheuristics.run import title
from hybrid_opt.progress import Progress
from hybrid_opt.store.files import to_json
from studies.research.best_front import ReferenceFront, read_reference_front
from studies.research.control import LONG_SEARCH
from studies.study.summary import CampaignSummary, read_summary


@dataclass(frozen=True)
class LongerSearch:
    """Comparison of one algorithm's polished fronts with longer searches of the same or another
    algorithm.

    Attributes:
        algorithm: algorithm whose polished fronts are compared.
        rival: algorithm that searches longer.
        evaluations: budget of the longer search.
        polished_wins: number of replicas in which the polished front has the larger hypervolume.
        replicas: number of replicas.
        search, polished, longer: median hypervolumes of the algorithm's searched and polished
            fronts, and of the longer searches.
    """

    algorithm: str
    rival: str
    evaluations: int
    polished_wins: int
    replicas: int
    search: float
    polished: float
    longer: float


def controls(
    root: Path, evaluations: Sequence[int], jobs: int, progress: Progress
) -> list[LongerSearch]:
    """Search a polished study's cell with larger budgets, and compare the fronts with the study's.

    The results go to `ROOT/control/EVALUATIONS`.

    Args:
        root: results folder of the study.
        evaluations: budgets of the longer searches. Empty for two budgets: one that takes as long
            as the study's search and polish together, and `LONG_SEARCH`.
        jobs: number of worker processes.
        progress: receives messages on the progress.

    Returns:
        For each budget and algorithm of the study, a comparison of its polished fronts with a
        longer search of the same algorithm, and one with a longer search of NSGA-II if the study
        has it.

    Raises:
        ResultsError: the study is not complete, or was not polished.
    """
    study, summary = read_campaign(root), read_summary(root)
    settings = study.settings
    budgets = tuple(evaluations) or (
        settings.evaluations + _polish_cost(root, summary),
        LONG_SEARCH,
    )
    found = []
    for budget in budgets:
        longer = _search(study, replace(settings, evaluations=budget), root, jobs, progress)
        for name in study.algorithms:
            rivals = dict.fromkeys((name, "nsga2" if "nsga2" in study.algorithms else name))
            found += [_compare(summary, longer, name, rival, budget) for rival in rivals]
    return found


def _polish_cost(root: Path, summary: CampaignSummary) -> int:
    """Return how many evaluations take as long as the most expensive polish of one replica.

    Args:
        root: results folder, for messages.
        summary: summary of the study in this folder.

    Raises:
        ResultsError: the study was not polished.
    """
    costs = [
        row.polished.equivalent_evaluations
        for entry in summary.algorithms.values()
        for row in entry.replicas
        if row.polished is not None
    ]
    if not costs:
        raise ResultsError(
            f"{root}: its fronts were not polished; run the study with --polish",
            code="not-polished",
        )
    return int(max(costs))


def _search(
    study: CampaignResults,
    settings: CampaignSettings,
    root: Path,
    jobs: int,
    progress: Progress,
) -> CampaignResults:
    output = root / "control" / str(settings.evaluations)
    resume = (output / CONFIGURATION).exists()
    execution = ExecutionSettings(output, jobs=jobs, resume=resume)
    with open_folder(settings, execution, study.workcell) as folder:
        run_stages(folder, (search_stage(),), progress)
    return read_campaign(output)


def _compare(
    summary: CampaignSummary, longer: CampaignResults, name: str, rival: str, budget: int
) -> LongerSearch:
    rows = summary.algorithms[name].replicas
    before = [row.hypervolume for row in rows]
    after = [row.polished.hypervolume for row in rows if row.polished is not None]
    alone = [
        metrics.hypervolume(replica.front, metrics.REFERENCE_POINT) for replica in longer.of(rival)
    ]
    return LongerSearch(
        algorithm=name,
        rival=rival,
        evaluations=budget,
        polished_wins=sum(a > b for a, b in zip(after, alone, strict=True)),
        replicas=len(rows),
        search=float(np.median(before)),
        polished=float(np.median(after)),
        longer=float(np.median(alone)),
    )


@dataclass(frozen=True)
class PolishGap:
    """Distance of one algorithm's fronts from a reference front, medians over the replicas.

    Attributes:
        algorithm: name of the algorithm.
        search_gap, polished_gap: hypervolume of the reference front minus the hypervolume of the
            searched and of the polished front.
        search_igd, polished_igd: mean distance of the reference front's points from the searched
            and from the polished front.
        closed: share of the gap that the polish closes [%].
    """

    algorithm: str
    search_gap: float
    polished_gap: float
    search_igd: float
    polished_igd: float
    closed: float


def approaches(root: Path, reference: ReferenceFront) -> list[PolishGap]:
    """Compare how far a study's fronts are from a reference front before and after the polish.

    Args:
        root: results folder of the polished study.
        reference: the reference front of the same workcell.

    Returns:
        For each algorithm the medians over its replicas of the hypervolume gap and of IGD.

    Raises:
        ResultsError: the study is not complete, was not polished, or is of another workcell.
    """
    study = read_campaign(root)
    if study.workcell.digest != reference.digest:
        raise ResultsError(
            f"{root}: is a study of another workcell than the reference front's",
            code="another-workcell",
        )
    best = metrics.hypervolume(reference.objectives)
    found = []
    for name in study.algorithms:
        searched, polished = [], []
        for replica in study.of(name):
            front = study.polished(name, replica.replica)
            if front is None:
                raise ResultsError(f"{root}: replica {replica.replica} of {name} is not polished")
            searched.append(replica.front)
            polished.append(front.objectives)
        both = (searched, polished)
        volumes = ([metrics.hypervolume(one) for one in fronts] for fronts in both)
        igds = ([metrics.igd(one, reference.objectives) for one in fronts] for fronts in both)
        before, after = (float(np.median(best - np.array(each))) for each in volumes)
        closed = 100.0 * (1.0 - after / before) if before else math.nan
        far, near = (float(np.median(each)) for each in igds)
        found.append(PolishGap(name, before, after, far, near, closed))
    return found


def approaches_text(found: Sequence[PolishGap]) -> str:
    """Format the results of `approaches` as a table."""
    head = ["medians over the replicas", "HV gap", "polished", "closed %", "IGD", "polished"]
    rows = [
        [
            title(a.algorithm),
            number(a.search_gap, 6),
            number(a.polished_gap, 6),
            number(a.closed, 1),
            number(a.search_igd, 6),
            number(a.polished_igd, 6),
        ]
        for a in found
    ]
    return f"Distance to the reference front\n{text_table([head, *rows])}"


def as_text(found: Sequence[LongerSearch]) -> str:
    """Format the results of `controls` as a table."""
    rows = [["polished front of", "search", "polished", "longer search", "HV", "wins"]]
    rows += [
        [
            title(entry.algorithm),
            number(entry.search, 5),
            number(entry.polished, 5),
            f"{title(entry.rival)}, {entry.evaluations} evaluations",
            number(entry.longer, 5),
            f"{entry.polished_wins}/{entry.replicas}",
        ]
        for entry in found
    ]
    return (
        "Median hypervolumes; wins: replicas in which the polished front is ahead\n"
        + text_table(rows, left=(0, 3))
    )


def control(options: argparse.Namespace) -> int:
    """Compare the study in the options with longer searches or a reference front. Return the exit
    code."""
    found: Sequence[LongerSearch | PolishGap]
    if options.reference is not None:
        found = near = approaches(options.results, read_reference_front(options.reference))
        text = approaches_text(near)
    else:
        progress = Progress(True)
        found = run = controls(options.results, options.evaluations, options.jobs, progress)
        text = as_text(run)
    print(json.dumps(to_json(found), indent=1) if options.json else text)
    return 0
