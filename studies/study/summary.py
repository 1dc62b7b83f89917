"""The stage that turns a finished search into figures, fronts and selected trajectories."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.campaign import CampaignFolder, Stage
from hybrid_opt.campaign.results import CampaignResults, Replica, read_campaign
from hybrid_opt.campaign.settings import (
    FRONTS,
    HAND_MADE,
    SELECTED,
    SUMMARY,
    polished_selected_file,
    reference_front_file,
    selected_file,
)
from hybrid_opt.campaign.summary import (
    AlgorithmFigures,
    Bounds,
    CampaignSummary,
    FrontFigures,
    NoRecommendation,
    PolishedFigures,
    PolishedStatistics,
    ReplicaFigures,
    SelectedEntry,
    StoredFront,
)
from hybrid_opt.carry import Carry
from hybrid_opt.indicators import metrics
from hybrid_opt.indicators.metrics import binding_bounds
from hybrid_opt.indicators.selection import Selected, select
from hybrid_opt.indicators.statistics import (
    RankTest,
    Summary,
    attainment_surfaces,
    corrected,
    rank_test,
    summarise,
)
from hybrid_opt.progress import Progress
from hybrid_opt.static_hold import StaticHold
from hybrid_opt.store.files import csv_text, storing, write_atomically, write_json
from hybrid_opt.store.json_records import to_json
from hybrid_opt.store.trajectory_file import write_trajectory
from studies.study.recommendation import read_recommendation
from symbolic.array import Array

FIGURES = (
    "feasible",
    "feasible_share",
    "non_dominated",
    "hypervolume",
    "igd",
    "igd_plus",
    "spacing",
    "seconds",
    "mean_excess_above_static",
    "payload_limit",
)
"""Figures of a replica that are summarised over the replicas."""

TESTED = tuple(name for name in FIGURES if name not in ("feasible", "seconds"))
"""Figures that the algorithms are compared by; the count says the same as its share."""

POLISHED_FIGURES = (
    "non_dominated",
    "hypervolume",
    "igd",
    "igd_plus",
    "spacing",
    "seconds",
    "equivalent_evaluations",
    "widest_gap",
    "mean_excess_above_static",
    "payload_limit",
)
"""Figures of a polished front that are summarised over the replicas."""

LEAST_TESTED = 5
"""Replicas from which on algorithms are compared by tests: with fewer, the least p-value that an
exact test can reach, 2 / binomial(2 n, n), is 0.028 or more before any correction."""


def reference_front(fronts: Sequence[Array]) -> Array:
    """(k, n_obj) non-dominated union of fronts; of all of a campaign, its reference for IGD."""
    return metrics.front_of(np.concatenate(fronts))


def front_indicators(
    front: Array, reference: Array, selected: Selected | None, file: str | None
) -> dict[str, Any]:
    """The fields of `FrontFigures` for a front's objectives (k, n_obj)."""
    carry = None if selected is None else selected.carry
    return {
        "non_dominated": len(front),
        "hypervolume": metrics.hypervolume(front, metrics.reference_point(reference.shape[1])),
        "igd": metrics.igd(front, reference),
        "igd_plus": metrics.igd_plus(front, reference),
        "spacing": metrics.spacing(front),
        "mean_excess_above_static": math.nan if carry is None else carry.mean_excess_above_static,
        "payload_limit": math.nan if carry is None else carry.payload_limit,
        "selected": None
        if selected is None
        else carry_entry(selected.carry, selected.row + 1, file),
    }


def replica_figures(
    replica: Replica, reference: Array, selected: Selected | None, file: str | None
) -> ReplicaFigures:
    """One replica's entry in the summary; figures that do not exist are NaN or infinite."""
    found = replica.evaluations
    feasible = found.feasible
    return ReplicaFigures(
        **front_indicators(replica.front, reference, selected, file),
        replica=replica.replica,
        evaluations=len(found),
        feasible=metrics.feasible_count(feasible),
        feasible_share=metrics.feasible_share(feasible),
        seconds=replica.seconds,
        infeasible_by_reason=found.infeasible_by_reason,
        best_so_far=best_steps(metrics.best_so_far(found.objectives, feasible)),
    )


def best_steps(history: Array) -> tuple[Array, ...]:
    """The evaluations at which the best of an objective changed: [evaluation, best, ...]."""
    known = history[~np.isnan(history).any(axis=1)]
    first = len(history) - len(known)
    changes = np.flatnonzero((np.diff(known, axis=0) != 0.0).any(axis=1)) + 1
    rows = [0, *changes.tolist()] if len(known) else []
    return tuple(np.array([first + row + 1, *known[row]]) for row in rows)


def carry_entry(carry: Carry, evaluation: int, file: str | None) -> SelectedEntry:
    """The entry of a judged carry."""
    assert carry.judgement is not None, "selected carries are judged"
    return SelectedEntry(
        evaluation=evaluation,
        file=file,
        objectives=np.array(list(carry.judgement.objectives.values())),
        peak_normal_force=carry.peak_normal_force,
        minimum_normal_force=carry.normal_force.min(axis=0),
        excess_above_static=carry.excess_above_static,
        payload_limit=carry.payload_limit,
        duration=carry.duration,
        feasible=carry.judgement.feasible,
    )


def campaign_summary(
    results: CampaignResults,
    reference: Array,
    static: StaticHold,
    entries: Mapping[str, Sequence[ReplicaFigures]],
) -> CampaignSummary:
    """The figures of the search and of the polish.

    Args:
        results: the campaign.
        reference: its reference front.
        static: forces of the payload held still.
        entries: per algorithm those of `replica_figures`.
    """
    configuration = results.configuration
    corner = metrics.reference_point(len(results.objectives))
    return CampaignSummary(
        workcell=configuration.workcell,
        robots=tuple(robot.name for robot in results.workcell.robots),
        settings=configuration.settings,
        environment=configuration.environment,
        objectives=results.objectives,
        reference_force=results.workcell.task.reference_force,
        static_hold=static,
        reference_front=StoredFront(
            file=reference_front_file(results.root).relative_to(results.root).as_posix(),
            points=len(reference),
            hypervolume=metrics.hypervolume(reference, corner),
        ),
        algorithms={
            name: AlgorithmFigures(
                representative=_representative(rows),
                statistics=_statistics(rows, FIGURES),
                replicas=tuple(rows),
                polished=_polished_statistics(rows),
            )
            for name, rows in entries.items()
        },
        tests=_tests(entries),
    )


def _statistics(rows: Sequence[FrontFigures], names: Sequence[str]) -> dict[str, Summary]:
    return {name: summarise([getattr(row, name) for row in rows]) for name in names}


def _polished_statistics(rows: Sequence[ReplicaFigures]) -> PolishedStatistics | None:
    """Statistics of the polished fronts, and what they gained; None without a polish."""
    polished = [row.polished for row in rows if row.polished is not None]
    if len(polished) < len(rows):
        return None
    gains = [after.hypervolume - row.hypervolume for row, after in zip(rows, polished, strict=True)]
    return PolishedStatistics(
        statistics=_statistics(polished, POLISHED_FIGURES),
        hypervolume_gain=summarise(gains),
        replicas_improved=sum(gain > 0.0 for gain in gains),
    )


def _representative(rows: Sequence[ReplicaFigures]) -> int | None:
    """The replica with the largest hypervolume, the paper's 'best-performing run'."""
    best = max(rows, key=lambda row: row.hypervolume)
    return None if best.selected is None else best.replica


def _tests(entries: Mapping[str, Sequence[ReplicaFigures]]) -> tuple[RankTest, ...]:
    """Rank tests of every pair of algorithms in every figure, Holm-corrected as one family.

    None with few replicas, whose effects say nothing.
    """
    if any(len(rows) < LEAST_TESTED for rows in entries.values()):
        return ()
    pairs = [(figure, *pair) for pair in itertools.combinations(entries, 2) for figure in TESTED]
    tests = [
        rank_test(
            [getattr(row, figure) for row in entries[first]],
            [getattr(row, figure) for row in entries[second]],
            (first, second),
        )
        for figure, first, second in pairs
    ]
    return tuple(
        replace(test, figure=figure)
        for (figure, _, _), test in zip(pairs, corrected(tests), strict=True)
    )


PERCENTILES = (25.0, 50.0, 75.0, 100.0)
"""Percentiles of the attainment surfaces, in percent of the replicas."""


def summary_stage(not_asked: str = "") -> Stage:
    """The stage that computes the figures of a finished search.

    Args:
        not_asked: why the study recommends no carry, where it was not asked for one.
    """

    return Stage("summary", partial(_run, not_asked=not_asked))


def _run(folder: CampaignFolder, progress: Progress, not_asked: str) -> None:
    results = read_campaign(folder.root)
    evaluator = folder.cell.evaluator
    reference = reference_front([front.objectives for front in results.fronts])
    entries: dict[str, list[ReplicaFigures]] = {name: [] for name in results.algorithms}
    best = list[Array]()
    with progress.stage("summary", len(results.replicas), "replicas") as advance:
        for replica in results.replicas:
            key = replica.algorithm, replica.replica
            selected = select(evaluator, replica.front_x, replica.front_rows)
            file = _store_selected(folder, selected_file(folder.root, *key), key, selected)
            entry = replica_figures(replica, reference, selected, file)
            best.append(replica.front_x)
            front = results.polished(replica)
            if front is not None:
                chosen = select(evaluator, front.x)
                path = polished_selected_file(folder.root, *key)
                file = _store_selected(folder, path, key, chosen)
                found = front_indicators(front.objectives, reference, chosen, file)
                figures = PolishedFigures(**found, **vars(front.effort))
                entry, best[-1] = replace(entry, polished=figures), front.x
            entries[replica.algorithm].append(entry)
            advance(1)
    _write_points(folder, "reference", results.objectives, reference)
    for name in results.algorithms:
        union = reference_front([replica.front for replica in results.of(name)])
        _write_points(folder, name, results.objectives, union)
        if len(results.objectives) in (2, 3):
            _write_attainment(folder, name, results)
    hand_made, members = _store_hand_made(folder), np.concatenate(best)
    choice = read_recommendation(folder.root)
    reason = choice.reason if isinstance(choice, NoRecommendation) else ""
    summary = replace(
        campaign_summary(results, reference, folder.cell.static_hold, entries),
        hand_made=hand_made,
        bounds=Bounds(len(members), binding_bounds(folder.workcell.task, members)),
        recommendation=None if isinstance(choice, NoRecommendation) else choice,
        no_recommendation=reason if choice else not_asked,
    )
    write_json(folder.root / SUMMARY, to_json(summary))


def _store_hand_made(folder: CampaignFolder) -> SelectedEntry | None:
    """Write the workcell file's own trajectory, feasible or not, beside the selected ones; its
    figures, None where it has not all of them."""
    carry = folder.cell.carry(folder.cell.initial)
    path = folder.root / SELECTED / HAND_MADE
    with storing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    provenance = {"source": "the workcell file's initial trajectory"}
    # An infeasible one may be without some of its figures.
    figures = carry.figures.items()
    known = {name: value for name, value in figures if np.isfinite(value)}
    write_trajectory(path, folder.cell.compiled, carry.x, known, provenance)
    entry = carry_entry(carry, 0, path.relative_to(folder.root).as_posix())
    numbers = [entry.objectives, entry.peak_normal_force, entry.minimum_normal_force]
    every = np.concatenate([*numbers, [entry.payload_limit, entry.duration]])
    return entry if np.isfinite(every).all() else None


def _store_selected(
    folder: CampaignFolder, path: Path, replica: tuple[str, int], selected: Selected | None
) -> str | None:
    """Write a selected trajectory; returns its path in the folder, None where there is none."""
    if selected is None:
        return None
    with storing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    provenance = {
        "algorithm": replica[0],
        "replica": replica[1],
        "row": selected.row,
        "settings": to_json(folder.settings),
    }
    carry = selected.carry
    write_trajectory(path, folder.cell.compiled, carry.x, carry.figures, provenance)
    return path.relative_to(folder.root).as_posix()


def _write_points(
    folder: CampaignFolder, name: str, objectives: Sequence[str], points: Array
) -> None:
    path = reference_front_file(folder.root).with_name(f"{name}.csv")
    write_atomically(path, csv_text(objectives, points.tolist()).encode())


def _write_attainment(folder: CampaignFolder, name: str, results: CampaignResults) -> None:
    surfaces = attainment_surfaces([replica.front for replica in results.of(name)], PERCENTILES)
    rows = [
        [f"{percentile:g}", *row]
        for percentile, points in surfaces.items()
        for row in points.tolist()
    ]
    path = folder.root / FRONTS / f"{name}-attainment.csv"
    write_atomically(path, csv_text(["percentile", *results.objectives], rows).encode())
