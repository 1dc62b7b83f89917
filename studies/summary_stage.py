"""The stage that turns a finished search into figures, fronts and selected trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hybrid_opt.campaign import CampaignFolder, Progress, Stage
from hybrid_opt.campaign.layout import (
    FRONTS,
    HAND_MADE,
    SELECTED,
    SUMMARY,
    polished_selected_file,
    reference_front_file,
    selected_file,
)
from hybrid_opt.campaign.polish_stage import read_polished
from hybrid_opt.campaign.recommended import NoRecommendation
from hybrid_opt.campaign.results import CampaignResults, read_campaign
from hybrid_opt.campaign.summary import ReplicaFigures
from hybrid_opt.indicators.selection import Selected, select
from hybrid_opt.indicators.statistics import attainment_surfaces
from hybrid_opt.store.files import storing, write_atomically, write_json
from hybrid_opt.store.json_records import to_json
from hybrid_opt.store.trajectory_file import write_trajectory
from studies.recommendation_stage import read_recommendation
from studies.summary import (
    bounds_of,
    campaign_summary,
    polished_figures,
    reference_front,
    replica_figures,
)
from symbolic.array import Array

PERCENTILES = (25.0, 50.0, 75.0, 100.0)
"""Percentiles of the attainment surfaces, in percent of the replicas."""


def summary_stage(not_asked: str = "") -> Stage:
    """The stage that computes the figures of a finished search.

    Args:
        not_asked: why the study recommends no carry, where it was not asked for one.
    """

    def run(folder: CampaignFolder, progress: Progress) -> None:
        _run(folder, progress, not_asked)

    return Stage("summary", run)


def _run(folder: CampaignFolder, progress: Progress, not_asked: str) -> None:
    results = read_campaign(folder.root)
    evaluator = folder.cell.evaluator
    polished = {
        (replica.algorithm, replica.replica): read_polished(results.root, replica, results.workcell)
        for replica in results.replicas
    }
    fronts = [replica.front for replica in results.replicas]
    fronts += [found.objectives for found in polished.values() if found is not None]
    reference = reference_front(fronts)
    entries: dict[str, list[ReplicaFigures]] = {name: [] for name in results.algorithms}
    with progress.stage("summary", len(results.replicas), "replicas") as advance:
        for replica in results.replicas:
            key = replica.algorithm, replica.replica
            selected = select(evaluator, replica.front_x, replica.front_rows)
            file = _store_selected(folder, selected_file(folder.root, *key), key, selected)
            entry = replica_figures(replica, reference, selected, file)
            front = polished[key]
            if front is not None:
                chosen = select(evaluator, front.x)
                path = polished_selected_file(folder.root, *key)
                file = _store_selected(folder, path, key, chosen)
                figures = polished_figures(front, reference, chosen, file)
                entry = replace(entry, polished=figures)
            entries[replica.algorithm].append(entry)
            advance(1)
    _write_points(folder, "reference", results.objectives, reference)
    for name in results.algorithms:
        union = reference_front([replica.front for replica in results.of(name)])
        _write_points(folder, name, results.objectives, union)
        if len(results.objectives) in (2, 3):
            _write_attainment(folder, name, results)
    best = [
        replica.front_x if front is None else front.x
        for replica in results.replicas
        for front in [polished[replica.algorithm, replica.replica]]
    ]
    _store_hand_made(folder)
    found = read_recommendation(folder.root)
    reason = found.reason if isinstance(found, NoRecommendation) else ""
    summary = replace(
        campaign_summary(results, reference, folder.cell.static_hold, entries),
        bounds=bounds_of(folder.workcell, np.concatenate(best)),
        recommendation=None if isinstance(found, NoRecommendation) else found,
        no_recommendation=reason if found else not_asked,
    )
    write_json(folder.root / SUMMARY, to_json(summary))


def _store_hand_made(folder: CampaignFolder) -> None:
    """Write the workcell file's own trajectory, feasible or not, beside the selected ones."""
    carry = folder.cell.carry(folder.cell.initial)
    path = folder.root / SELECTED / HAND_MADE
    with storing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    provenance = {"source": "the workcell file's initial trajectory"}
    # An infeasible one may be without some of its figures.
    figures = carry.figures.items()
    known = {name: value for name, value in figures if np.isfinite(value)}
    write_trajectory(path, folder.cell.compiled, carry.x, known, provenance)


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
        "settings": folder.settings.effective(),
    }
    carry = selected.carry
    write_trajectory(path, folder.cell.compiled, carry.x, carry.figures, provenance)
    return path.relative_to(folder.root).as_posix()


def _write_points(
    folder: CampaignFolder, name: str, objectives: Sequence[str], points: Array
) -> None:
    lines = [",".join(objectives), *(",".join(map(repr, row)) for row in points.tolist())]
    path = reference_front_file(folder.root).with_name(f"{name}.csv")
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _write_attainment(folder: CampaignFolder, name: str, results: CampaignResults) -> None:
    surfaces = attainment_surfaces([replica.front for replica in results.of(name)], PERCENTILES)
    lines = [",".join(["percentile", *results.objectives])]
    lines += [
        ",".join([f"{surface.percentile:g}", *map(repr, row)])
        for surface in surfaces
        for row in surface.points.tolist()
    ]
    path = folder.root / FRONTS / f"{name}-attainment.csv"
    write_atomically(path, ("\n".join(lines) + "\n").encode())
