"""Compare two campaigns: `python -m studies.compare RUN_A RUN_B`.

Prints, per algorithm that both ran, medians and quartiles of every figure over the replicas, an
exact Mann-Whitney test with its effect size, and what differs between the two configurations.
Indicators that depend on a reference front are computed anew against the union of both.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_opt.campaign.polish_stage import read_polished
from hybrid_opt.campaign.results import CampaignResults, Replica, read_campaign, read_summary
from hybrid_opt.campaign.summary import CampaignSummary
from hybrid_opt.errors import ResultsError
from hybrid_opt.indicators import metrics
from hybrid_opt.indicators.statistics import RankTest, Summary, corrected, rank_test, summarise
from hybrid_opt.store.json_records import to_json
from studies.program import add_verbose, carried_out, run_program
from studies.summary import LEAST_TESTED, reference_front
from studies.terminal_summary import title
from studies.text_table import number, text_table
from symbolic.array import Array

PROGRAM = "python -m studies.compare"

SEARCHED = ("feasible_share", "non_dominated", "hypervolume", "igd", "spacing")
"""Figures computed anew from the stored candidates."""

STORED = ("mean_excess_above_static", "payload_limit", "seconds")
"""Figures taken from summary.json."""


@dataclass(frozen=True)
class ComparedFigure:
    """One figure of one algorithm in both campaigns.

    Attributes:
        algorithm, figure: which one.
        first, second: its summary over each campaign's replicas.
        test: rank test between them, None with few replicas or where one of them has no value.
    """

    algorithm: str
    figure: str
    first: Summary
    second: Summary
    test: RankTest | None


@dataclass(frozen=True)
class CampaignComparison:
    """Two campaigns beside one another.

    Attributes:
        runs: the two folders.
        same_workcell: whether both searched the same cell; figures of different cells say
            little about the algorithms.
        differences: configuration key, first and second value.
        figures: of the algorithms that both ran.
        only: per campaign the algorithms that the other lacks.
    """

    runs: tuple[str, str]
    same_workcell: bool
    differences: tuple[tuple[str, str, str], ...]
    figures: tuple[ComparedFigure, ...]
    only: tuple[tuple[str, ...], tuple[str, ...]]


def compare(first: Path, second: Path) -> CampaignComparison:
    """Compare two results folders.

    Raises:
        ResultsError: a folder is not a finished campaign, they share no algorithm, or they
            minimise different objectives.
    """
    folders = (first, second)
    runs = tuple(read_campaign(folder) for folder in folders)
    summaries = tuple(read_summary(folder) for folder in folders)
    for run in runs:
        for replica in run.replicas:
            # Told if it is damaged, as a later look at the same results would.
            read_polished(run.root, replica, run.workcell)
    if runs[0].objectives != runs[1].objectives:
        raise ResultsError(
            f"{first} minimises {', '.join(runs[0].objectives)}, {second} "
            f"{', '.join(runs[1].objectives)}: such fronts cannot be compared"
        )
    shared = [name for name in runs[0].algorithms if name in runs[1].algorithms]
    if not shared:
        raise ResultsError(f"{first} and {second} have no algorithm in common")
    reference = reference_front([replica.front for run in runs for replica in run.replicas])
    figures = [
        figure
        for name in shared
        for figure in _algorithm_figures(name, (runs[0], runs[1]), summaries, reference)
    ]
    return CampaignComparison(
        (str(first), str(second)),
        runs[0].workcell.digest == runs[1].workcell.digest,
        tuple(_differences(*(to_json(run.configuration) for run in runs))),
        _with_holm(figures),
        tuple(  # type: ignore[arg-type]
            tuple(name for name in run.algorithms if name not in shared) for run in runs
        ),
    )


def _algorithm_figures(
    name: str,
    runs: tuple[CampaignResults, CampaignResults],
    summaries: Sequence[CampaignSummary],
    reference: Array,
) -> list[ComparedFigure]:
    columns = [[_searched(replica, reference) for replica in run.of(name)] for run in runs]
    stored = [list(map(vars, summary.algorithms[name].replicas)) for summary in summaries]
    compared = []
    for figure in (*SEARCHED, *STORED):
        rows = columns if figure in SEARCHED else stored
        values = [np.array([row[figure] for row in side], dtype=float) for side in rows]
        known = all(np.isfinite(side).any() and len(side) >= LEAST_TESTED for side in values)
        labels = ("first", "second")
        compared.append(
            ComparedFigure(
                name,
                figure,
                summarise(values[0]),
                summarise(values[1]),
                rank_test(values[0], values[1], labels) if known else None,
            )
        )
    return compared


def _searched(replica: Replica, reference: Array) -> dict[str, float]:
    front = replica.front
    return {
        "feasible_share": metrics.feasible_share(replica.evaluations.feasible),
        "non_dominated": float(len(front)),
        "hypervolume": metrics.hypervolume(front, metrics.reference_point(reference.shape[1])),
        "igd": metrics.igd(front, reference),
        "spacing": metrics.spacing(front),
    }


def _with_holm(figures: list[ComparedFigure]) -> tuple[ComparedFigure, ...]:
    """The figures with their tests corrected as one family."""
    tests = iter(corrected([figure.test for figure in figures if figure.test is not None]))
    return tuple(
        figure
        if figure.test is None
        else ComparedFigure(
            figure.algorithm, figure.figure, figure.first, figure.second, next(tests)
        )
        for figure in figures
    )


def _differences(
    first: Mapping[str, Any], second: Mapping[str, Any], prefix: str = ""
) -> list[tuple[str, str, str]]:
    found = []
    for key in sorted({*first, *second}):
        name = f"{prefix}{key}"
        a, b = first.get(key), second.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            found += _differences(a, b, f"{name}.")
        elif a != b:
            found.append((name, _short(a), _short(b)))
    return found


def _short(value: object) -> str:
    text = "-" if value is None else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."


def as_text(found: CampaignComparison) -> str:
    """A comparison for people."""
    lines = [f"A: {found.runs[0]}", f"B: {found.runs[1]}", ""]
    if not found.same_workcell:
        lines += ["The workcells differ: the figures say more about them than about the runs.", ""]
    lines += [f"{name}: A {a}, B {b}" for name, a, b in found.differences] or ["Same configuration"]
    rows = [["median [quartiles]", "A", "B", "A12", "p (Holm)"]]
    for figure in found.figures:
        test = figure.test
        rows.append(
            [
                f"{title(figure.algorithm)}, {figure.figure.replace('_', ' ')}",
                _spread(figure.first),
                _spread(figure.second),
                "-" if test is None else number(test.a12, 2),
                "-" if test is None else number(test.p_holm, 5),
            ]
        )
    lines += ["", text_table(rows)]
    for side, names in zip("AB", found.only, strict=True):
        if names:
            lines.append(f"only in {side}: {', '.join(title(name) for name in names)}")
    lines.append(
        "A12: chance that A has the larger figure. Exact Mann-Whitney tests from five replicas on."
    )
    return "\n".join(lines)


def _spread(summary: Summary) -> str:
    values = (summary.median, summary.quartile1, summary.quartile3)
    return "{:.4g} [{:.4g}, {:.4g}]".format(*values)


@carried_out(PROGRAM)
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    parser = argparse.ArgumentParser(prog=PROGRAM, description=__doc__, allow_abbrev=False)
    parser.add_argument("first", type=Path, metavar="RUN_A", help="a results folder")
    parser.add_argument("second", type=Path, metavar="RUN_B", help="another results folder")
    parser.add_argument("--json", action="store_true", help="print JSON instead of text")
    add_verbose(parser)
    options = parser.parse_args(arguments)
    found = compare(options.first, options.second)
    print(json.dumps(_json(asdict(found)), indent=2) if options.json else as_text(found))
    return 0


def _json(value: Any) -> Any:
    """JSON values; NaN and infinities become null."""
    if isinstance(value, dict):
        return {key: _json(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_json(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


if __name__ == "__main__":
    sys.exit(run_program(main))
