"""The figures of a campaign, computed from its results."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from hybrid_opt.campaign.layout import reference_front_file
from hybrid_opt.campaign.polish_stage import PolishedReplica
from hybrid_opt.campaign.results import CampaignResults, Replica
from hybrid_opt.campaign.summary import (
    AlgorithmFigures,
    Bounds,
    CampaignSummary,
    FrontFigures,
    PolishedFigures,
    PolishedStatistics,
    ReplicaFigures,
    SelectedEntry,
    StaticForces,
    Statistics,
    StoredBound,
    StoredFront,
    StoredTest,
)
from hybrid_opt.indicators import metrics
from hybrid_opt.indicators.metrics import binding_bounds
from hybrid_opt.indicators.selection import Selected
from hybrid_opt.indicators.statistics import corrected, rank_test, summarise
from hybrid_opt.static_hold import StaticHold
from symbolic.array import Array
from symbolic.records import Workcell

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
        "selected": _selected_entry(selected, file),
    }


def polished_figures(
    polished: PolishedReplica, reference: Array, selected: Selected | None, file: str | None
) -> PolishedFigures:
    """A polished replica: indicators, selected solution, and effort."""
    indicators = front_indicators(polished.objectives, reference, selected, file)
    return PolishedFigures(**indicators, **vars(polished.figures))


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


def _selected_entry(selected: Selected | None, file: str | None) -> SelectedEntry | None:
    if selected is None:
        return None
    carry = selected.carry
    return SelectedEntry(
        evaluation=selected.row + 1,
        file=file,
        objectives=selected.objectives,
        peak_normal_force=carry.peak_normal_force,
        minimum_normal_force=carry.normal_force.min(axis=0),
        excess_above_static=carry.excess_above_static,
        payload_limit=carry.payload_limit,
        duration=carry.duration,
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
        static_hold=StaticForces(static.normal_force, static.contact_force, static.payload_limit),
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


def bounds_of(workcell: Workcell, x: Array) -> Bounds:
    """Bounds that solutions (k, n_var) of the best fronts lie on."""
    found = binding_bounds(workcell.task, x)
    return Bounds(len(x), tuple(StoredBound(**vars(bound)) for bound in found))


def _statistics(rows: Sequence[FrontFigures], names: Sequence[str]) -> dict[str, Statistics]:
    return {name: _over([getattr(row, name) for row in rows]) for name in names}


def _over(values: Sequence[float]) -> Statistics:
    return Statistics(**asdict(summarise(values)))


def _polished_statistics(rows: Sequence[ReplicaFigures]) -> PolishedStatistics | None:
    """Statistics of the polished fronts, and what they gained; None without a polish."""
    polished = [row.polished for row in rows if row.polished is not None]
    if len(polished) < len(rows):
        return None
    gains = [after.hypervolume - row.hypervolume for row, after in zip(rows, polished, strict=True)]
    return PolishedStatistics(
        statistics=_statistics(polished, POLISHED_FIGURES),
        hypervolume_gain=_over(gains),
        replicas_improved=sum(gain > 0.0 for gain in gains),
    )


def _representative(rows: Sequence[ReplicaFigures]) -> int | None:
    """The replica with the largest hypervolume, the paper's 'best-performing run'."""
    best = max(rows, key=lambda row: row.hypervolume)
    return None if best.selected is None else best.replica


def _tests(entries: Mapping[str, Sequence[ReplicaFigures]]) -> tuple[StoredTest, ...]:
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
        StoredTest(figure=figure, **asdict(test))
        for (figure, _, _), test in zip(pairs, corrected(tests), strict=True)
    )
