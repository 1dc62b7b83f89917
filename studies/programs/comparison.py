"""Comparison of two campaigns, for `dual-arm-carry compare`."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hybrid_opt.campaign.folder import differences
from hybrid_opt.campaign.results import CampaignResults, read_campaign
from hybrid_opt.campaign.settings import DRIVABLE, SUMMARY
from hybrid_opt.display.table import NOTHING, Quantity, Table, number
from hybrid_opt.errors import ResultsError
from hybrid_opt.indicators.statistics import RankTest, Summary, corrected, rank_test, summarise
from hybrid_opt.metaheuristics.run import title
from hybrid_opt.store.files import to_json
from studies.study.summary import (
    LEAST_TESTED,
    CampaignSummary,
    front_indicators,
    read_summary,
    reference_front,
)
from studies.study.tables import REPLICA_QUANTITIES
from symbolic.array import Array

RECOMPUTED_FIGURES = ("non_dominated", "hypervolume", "igd", "spacing")
"""Figures of fronts that are computed again with the reference front of both campaigns."""

STORED = ("feasible_share", "mean_excess_above_static", "payload_limit", "seconds")
"""Figures that are taken from summary.json."""

POLISHED_PREFIX = "polished_"
"""Prefix of the figures of polished fronts."""


@dataclass(frozen=True)
class ComparedFigure:
    """One figure of merit of one algorithm in two campaigns.

    Attributes:
        algorithm, figure: names of the algorithm and of the figure.
        first, second: summary of the figure over the replicas of the first and of the second
            campaign.
        test: rank test between both campaigns; None with few replicas, or if one campaign lacks the
            figure.
    """

    algorithm: str
    figure: str
    first: Summary
    second: Summary
    test: RankTest | None


@dataclass(frozen=True)
class CampaignComparison:
    """Comparison of two campaigns.

    Attributes:
        runs: the two results folders.
        same_workcell: whether both campaigns searched the same cell. Figures of different cells say
            little about the algorithms.
        differences: settings in which the campaigns differ: key, first value and second value.
        figures: figures of the algorithms that both campaigns ran.
        only: algorithms that only the first campaign ran, and those that only the second ran.
        drivable: comparison of both studies' drivable experiments; None if a study has no separate
            one.
    """

    runs: tuple[str, str]
    same_workcell: bool
    differences: tuple[tuple[str, str, str], ...]
    figures: tuple[ComparedFigure, ...]
    only: tuple[tuple[str, ...], tuple[str, ...]]
    drivable: CampaignComparison | None


def compare(first: Path, second: Path) -> CampaignComparison:
    """Compare the finished campaigns in two results folders: settings, and every figure (indicator,
    duration and the like) of the algorithms that they share.

    Args:
        first, second: the folders.

    Raises:
        ResultsError: a folder is not a finished campaign, they share no algorithm, or they minimise
            different objectives.
    """
    folders = (first, second)
    runs = tuple(read_campaign(folder) for folder in folders)
    summaries = tuple(read_summary(folder) for folder in folders)
    if runs[0].objectives != runs[1].objectives:
        raise ResultsError(
            f"{first} minimises {', '.join(runs[0].objectives)}, {second} "
            f"{', '.join(runs[1].objectives)}: such fronts cannot be compared"
        )
    shared = [name for name in runs[0].algorithms if name in runs[1].algorithms]
    if not shared:
        raise ResultsError(f"{first} and {second} have no algorithm in common")
    reference = reference_front([front.objectives for run in runs for front in run.fronts])
    figures = [
        figure for name in shared for figure in _algorithm_figures(name, runs, summaries, reference)
    ]
    both = all((folder / DRIVABLE / SUMMARY).exists() for folder in folders)
    return CampaignComparison(
        (str(first), str(second)),
        runs[0].workcell.digest == runs[1].workcell.digest,
        tuple(
            (name, _short(a), _short(b))
            for name, a, b in differences(*(to_json(run.configuration) for run in runs))
        ),
        _with_holm(figures),
        tuple(  # type: ignore[arg-type]
            tuple(name for name in run.algorithms if name not in shared) for run in runs
        ),
        compare(first / DRIVABLE, second / DRIVABLE) if both else None,
    )


def _algorithm_figures(
    name: str,
    runs: Sequence[CampaignResults],
    summaries: Sequence[CampaignSummary],
    reference: Array,
) -> list[ComparedFigure]:
    sides = [
        _values(run, name, summary, reference) for run, summary in zip(runs, summaries, strict=True)
    ]
    return [
        _compared(name, figure, *(np.array(side[figure], dtype=float) for side in sides))
        for figure in sides[0]
        if figure in sides[1]
    ]


def _values(
    run: CampaignResults, name: str, summary: CampaignSummary, reference: Array
) -> dict[str, list[float]]:
    """Return the figures of one algorithm by name, each as a list with one value per replica.

    Some figures are stored in the summary. Those of `RECOMPUTED_FIGURES` depend on the reference
    front and are computed anew. Figures of polished fronts come last, with the prefix
    `POLISHED_PREFIX` in their names.

    Args:
        run: results of the campaign.
        name: name of the algorithm.
        summary: stored summary of the campaign.
        reference: points (k, n_obj) of the reference front of both campaigns.
    """
    stored = summary.algorithms[name].replicas
    better = [row.polished for row in stored if row.polished is not None]
    values: dict[str, list[float]] = {}
    for prefix, rows in (("", stored), (POLISHED_PREFIX, better)):
        own = [front for front in run.fronts if front.algorithm == name]
        fronts = [front for front in own if (front.polished is not None) == bool(prefix)]
        if not rows or not fronts:
            continue
        anew = [front_indicators(front.objectives, reference, None, None) for front in fronts]
        known = [figure for figure in STORED if hasattr(rows[0], figure)]
        values |= {prefix + figure: [getattr(row, figure) for row in rows] for figure in known}
        values |= {prefix + figure: [one[figure] for one in anew] for figure in RECOMPUTED_FIGURES}
    return values


def _compared(name: str, figure: str, first: Array, second: Array) -> ComparedFigure:
    known = all(np.isfinite(side).any() and len(side) >= LEAST_TESTED for side in (first, second))
    test = rank_test(first, second, ("first", "second")) if known else None
    return ComparedFigure(name, figure, summarise(first), summarise(second), test)


def _with_holm(figures: list[ComparedFigure]) -> tuple[ComparedFigure, ...]:
    """Return the figures with the p-values of their rank tests corrected by Holm's method for the
    number of tests.
    """
    tests = iter(corrected([figure.test for figure in figures if figure.test is not None]))
    return tuple(
        figure if figure.test is None else replace(figure, test=next(tests)) for figure in figures
    )


def _short(value: object) -> str:
    text = "-" if value is None else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."


def as_text(found: CampaignComparison) -> str:
    """Format the comparison of two campaigns as text for a terminal."""
    lines = [f"A: {found.runs[0]}", f"B: {found.runs[1]}", ""]
    if not found.same_workcell:
        lines += ["The workcells differ: the figures say more about them than about the runs.", ""]
    lines += [f"{name}: A {a}, B {b}" for name, a, b in found.differences] or ["Same configuration"]
    table = Table(
        "comparison",
        "",
        ("median [quartiles]", "A", "B", "A12", "p (Holm)"),
        tuple(
            (
                f"{title(figure.algorithm)}, {_quantity(figure.figure)[0]}",
                *(
                    _quantity(figure.figure)[1].spread(one.median, one.quartile1, one.quartile3)
                    for one in (figure.first, figure.second)
                ),
                NOTHING if figure.test is None else number(figure.test.a12),
                NOTHING if figure.test is None else number(figure.test.p_holm, 5),
            )
            for figure in found.figures
        ),
    )
    lines.append(table.text())
    for side, names in zip("AB", found.only, strict=True):
        if names:
            lines.append(f"only in {side}: {', '.join(title(name) for name in names)}")
    lines.append(
        "A12: chance that A has the larger figure. Exact Mann-Whitney tests from five replicas on."
    )
    if found.drivable is not None:
        lines += ["", "The drivable experiments", "", as_text(found.drivable)]
    return "\n".join(lines)


def _quantity(figure: str) -> tuple[str, Quantity]:
    """Return the heading of a figure in tables, and the quantity that formats its values."""
    quantity = REPLICA_QUANTITIES[figure.removeprefix(POLISHED_PREFIX)]
    of = "polished, " if figure.startswith(POLISHED_PREFIX) else ""
    return f"{of}{quantity.heading()}", quantity


def compare_folders(options: argparse.Namespace) -> int:
    """Compare the two results folders in the options, and print the comparison. Return the exit
    code."""
    found = compare(options.run_a, options.run_b)
    print(json.dumps(to_json(found), indent=2) if options.json else as_text(found))
    return 0
