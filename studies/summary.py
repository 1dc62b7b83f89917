"""The figures of a campaign as summary.json holds them."""

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
from hybrid_opt.evaluate.evaluation import REASONS
from hybrid_opt.evaluate.static_hold import StaticHold
from hybrid_opt.indicators import metrics
from hybrid_opt.indicators.selection import Selected
from hybrid_opt.indicators.statistics import corrected, rank_test, summarise
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
    "mean_excess_above_static",
    "payload_limit",
)
"""Figures of a polished front that are summarised over the replicas."""


def reference_front(fronts: Sequence[Array]) -> Array:
    """(k, n_obj) non-dominated union of fronts; of all of a campaign, its reference for IGD."""
    return metrics.front_of(np.concatenate(fronts))


def front_figures(front: Array, reference: Array) -> dict[str, Any]:
    """Indicators of a front's objectives (k, n_obj)."""
    return {
        "non_dominated": len(front),
        "hypervolume": metrics.hypervolume(front, metrics.reference_point(reference.shape[1])),
        "igd": metrics.igd(front, reference),
        "igd_plus": metrics.igd_plus(front, reference),
        "spacing": metrics.spacing(front),
    }


def polished_figures(
    polished: PolishedReplica, reference: Array, selected: Selected | None, file: str | None
) -> dict[str, Any]:
    """What the polish made of a replica: indicators, selected solution, and what it took."""
    return {
        **front_figures(polished.objectives, reference),
        "mean_excess_above_static": selected.mean_excess_above_static if selected else math.nan,
        "payload_limit": selected.figures["payload_limit"] if selected else math.nan,
        "selected": _selected_entry(selected, file),
        **polished.figures,
    }


def replica_figures(
    replica: Replica, reference: Array, selected: Selected | None, file: str | None
) -> dict[str, Any]:
    """One replica's entry in the summary; figures that do not exist are NaN or infinite."""
    found = replica.evaluations
    feasible = found.feasible
    reasons = {
        name: int(np.count_nonzero(found.reason == index)) for index, name in enumerate(REASONS)
    }
    return {
        "replica": replica.replica,
        "evaluations": len(found),
        "feasible": metrics.feasible_count(feasible),
        "feasible_share": metrics.feasible_share(feasible),
        **front_figures(replica.front, reference),
        "seconds": replica.seconds,
        "mean_excess_above_static": selected.mean_excess_above_static if selected else math.nan,
        "payload_limit": selected.figures["payload_limit"] if selected else math.nan,
        "infeasible_by_reason": {name: count for name, count in reasons.items() if count},
        "best_so_far": best_steps(metrics.best_so_far(found.objectives, feasible)),
        "selected": _selected_entry(selected, file),
    }


def best_steps(history: Array) -> list[list[float]]:
    """The evaluations at which the best of an objective changed: [evaluation, best, ...]."""
    known = history[~np.isnan(history).any(axis=1)]
    first = len(history) - len(known)
    changes = np.flatnonzero((np.diff(known, axis=0) != 0.0).any(axis=1)) + 1
    return [[first + row + 1, *known[row].tolist()] for row in [0, *changes.tolist()] if len(known)]


def _selected_entry(selected: Selected | None, file: str | None) -> dict[str, Any] | None:
    if selected is None:
        return None
    return {
        "evaluation": selected.row + 1,
        "file": file,
        "objectives": selected.objectives.tolist(),
        "peak_normal_force": selected.peak_normal_force.tolist(),
        "minimum_normal_force": selected.minimum_normal_force.tolist(),
        "excess_above_static": selected.excess_above_static.tolist(),
        "payload_limit": selected.figures["payload_limit"],
        "duration": selected.figures["duration"],
    }


def campaign_summary(
    results: CampaignResults,
    reference: Array,
    static: StaticHold,
    entries: Mapping[str, Sequence[Mapping[str, Any]]],
) -> dict[str, Any]:
    """The whole summary as JSON values; figures that are not finite become null.

    Args:
        results: the campaign.
        reference: its reference front.
        static: forces of the payload held still.
        entries: per algorithm those of `replica_figures`.
    """
    document = {
        "workcell": results.configuration["workcell"],
        "settings": results.configuration["settings"],
        "environment": results.configuration["environment"],
        "objectives": list(results.objectives),
        "reference_force": results.workcell.task.reference_force.tolist(),
        "static_hold": {
            "normal_force": static.normal_force.tolist(),
            "contact_force": static.contact_force.tolist(),
            "payload_limit": static.payload_limit,
        },
        "reference_front": {
            "file": reference_front_file(results.root).relative_to(results.root).as_posix(),
            "points": len(reference),
            "hypervolume": metrics.hypervolume(
                reference, metrics.reference_point(len(results.objectives))
            ),
        },
        "algorithms": {
            name: {
                "representative": _representative(rows),
                "statistics": _statistics(rows, FIGURES),
                **_polished_statistics(rows),
                "replicas": list(rows),
            }
            for name, rows in entries.items()
        },
        "tests": _tests(entries),
    }
    cleaned: dict[str, Any] = _without_nan(document)
    return cleaned


def _statistics(
    rows: Sequence[Mapping[str, Any]], names: Sequence[str]
) -> dict[str, dict[str, Any]]:
    return {name: asdict(summarise([row[name] for row in rows])) for name in names}


def _polished_statistics(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Statistics of the polished fronts, and what they gained; nothing without a polish."""
    if not all("polished" in row for row in rows):
        return {}
    polished = [row["polished"] for row in rows]
    gains = [
        after["hypervolume"] - row["hypervolume"] for row, after in zip(rows, polished, strict=True)
    ]
    return {
        "polished": {
            "statistics": _statistics(polished, POLISHED_FIGURES),
            "hypervolume_gain": asdict(summarise(gains)),
            "replicas_improved": sum(gain > 0.0 for gain in gains),
        }
    }


def _representative(rows: Sequence[Mapping[str, Any]]) -> int | None:
    """The replica with the largest hypervolume, the paper's 'best-performing run'."""
    best = max(rows, key=lambda row: row["hypervolume"])
    return int(best["replica"]) if best["selected"] else None


def _tests(entries: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Rank tests of every pair of algorithms in every figure, Holm-corrected as one family."""
    pairs = [(figure, *pair) for pair in itertools.combinations(entries, 2) for figure in TESTED]
    tests = [
        rank_test(
            [row[figure] for row in entries[first]],
            [row[figure] for row in entries[second]],
            (first, second),
        )
        for figure, first, second in pairs
    ]
    return [
        {"figure": figure, **asdict(test)}
        for (figure, _, _), test in zip(pairs, corrected(tests), strict=True)
    ]


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
