"""The report's tables: what stands in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybrid_opt.campaign.summary import FrontFigures
from hybrid_opt.indicators.statistics import summarise
from studies.report.records import AlgorithmRuns, DrawnCarry, ReportData
from studies.report.table_text import NOTHING, Table, number
from studies.report.tables_drive import (
    limits_on_jerk,
    margins,
    robust_price,
    time_against_force,
    timings,
)
from studies.report.tables_job import phases
from studies.study.drivable import is_drivable
from studies.study.simulation import HEADINGS, MEANING, simulation_rows
from studies.study.terminal import PAPER, counted

MOST_BOUNDS = 8
"""Bounds of one experiment that are listed."""


def report_tables(data: ReportData, with_paper: bool) -> tuple[Table, ...]:
    """All tables of a report.

    Args:
        with_paper: whether figures that the paper states of its own rack stand beside ours.
    """
    tables = [quality(data, with_paper), selected(data, with_paper)]
    if data.summary.recommendation is not None:
        tables.append(time_against_force(data.summary.recommendation))
        if data.summary.recommendation.price is not None:
            tables.append(robust_price(data, data.summary.recommendation.price))
    if data.drivable is not None and data.drivable.jerk:
        tables.append(limits_on_jerk(data.drivable.jerk))
    if data.simulations:
        tables.append(simulation(data))
    tables.append(bounds(data))
    if data.summary.tests:
        tables.append(rank_tests(data))
    if data.timings:
        tables.append(timings(data))
    if data.jobs:
        left, right = (robot.name for robot in data.workcell.robots)
        tables.append(phases(data.jobs, (left, right)))
    if any(selection.margins for selection in data.timings):
        tables.append(margins(data))
    return tuple(tables)


_QUALITY = (
    ("feasible", "feasible", 0, 1.0),
    ("feasible_share", "feasible [%]", 1, 100.0),
    ("non_dominated", "non-dominated", 1, 1.0),
    ("hypervolume", "hypervolume", 4, 1.0),
    ("igd", "IGD", 5, 1.0),
    ("spacing", "spacing", 5, 1.0),
)


def quality(data: ReportData, with_paper: bool) -> Table:
    """Indicators over the replicas (paper Table 1)."""
    rows = []
    for algorithm in data.algorithms:
        rows.append((algorithm.title, *_means([run.figures for run in algorithm.runs])))
        polished = [run.hybrid_figures for run in algorithm.runs if run.hybrid_figures is not None]
        if polished:
            rows.append((f"{algorithm.title} + polish", *_means(polished)))
        if with_paper and algorithm.name in PAPER:
            stated = PAPER[algorithm.name]
            cells = [str(stated.feasible), f"{stated.feasible / 10.0:.1f}"]
            rows.append((f"{algorithm.title}, paper", *cells, *[NOTHING] * 4))
    settings = data.summary.settings
    return Table(
        "table1_quality",
        "Table 1. Quality of the search.",
        ("algorithm", *(heading for _, heading, _, _ in _QUALITY)),
        tuple(rows),
        f"Mean ± standard deviation of {counted(settings.replicas, 'replica')} of "
        f"{settings.evaluations} evaluations. Hypervolume: reference 1.1 in every objective. "
        "IGD: mean distance to the non-dominated union of the campaign. Spacing: Schott's."
        + (" The paper's rows hold what its text states." if with_paper else ""),
    )


def _means(figures: Sequence[FrontFigures]) -> list[str]:
    cells = []
    for name, _, digits, scale in _QUALITY:
        known = [getattr(row, name) for row in figures if hasattr(row, name)]
        if not known:
            cells.append(NOTHING)
            continue
        summary = summarise(np.array(known, dtype=float) * scale)
        cells.append(f"{number(summary.mean, digits)} ± {number(summary.std, digits)}")
    return cells


def selected(data: ReportData, with_paper: bool) -> Table:
    """Normal forces of the selected trajectories (paper Table 2)."""
    rows = [_forces(data, data.initial, data.initial.label)]
    for algorithm in data.algorithms:
        rows += [_forces(data, carry, label) for label, carry in _selections(algorithm)]
        if with_paper and algorithm.name in PAPER:
            limit = f"{PAPER[algorithm.name].payload_limit:.2f}"
            rows.append((f"{algorithm.title}, paper", *[NOTHING] * 6, limit))
    still = data.summary.static_hold
    force = [number(value, 2) for value in still.normal_force]
    rows.append(
        ("level payload at rest", *force, *force, "0.00", NOTHING, number(still.payload_limit))
    )
    left, right = (robot.name for robot in data.workcell.robots)
    return Table(
        "table2_selected",
        "Table 2. Normal contact forces of the selected trajectories.",
        (
            "trajectory",
            f"least, {left} [N]",
            f"least, {right} [N]",
            f"peak, {left} [N]",
            f"peak, {right} [N]",
            "above rest [%]",
            "duration [s]",
            "payload at the limit [kg]",
        ),
        tuple(rows),
        "Selected: least mean peak force of the replica with the largest hypervolume. Above rest: "
        "mean of both peaks over that of the level payload at rest. Payload: at which the first "
        "robot's whole contact force reaches its reference force.",
    )


def _selections(algorithm: AlgorithmRuns) -> list[tuple[str, DrawnCarry]]:
    found = []
    if algorithm.selected is not None:
        found.append((algorithm.title, algorithm.selected))
    if algorithm.hybrid_selected is not None:
        found.append((f"{algorithm.title} + polish", algorithm.hybrid_selected))
    return found


def _forces(data: ReportData, carry: DrawnCarry, label: str) -> tuple[str, ...]:
    normal = carry.timed.normal_force
    least, peak = normal.min(axis=0), normal.max(axis=0)
    still = float(np.mean(data.summary.static_hold.normal_force))
    excess = 100.0 * (float(peak.mean()) / still - 1.0)
    name = label if carry.feasible else f"{label} (infeasible)"
    return (
        name,
        *(number(value) for value in least),
        *(number(value) for value in peak),
        number(excess),
        number(carry.timed.duration),
        number(carry.sensitivity.payload_limit),
    )


def rank_tests(data: ReportData) -> Table:
    """Mann-Whitney tests between algorithms."""
    titles = {algorithm.name: algorithm.title for algorithm in data.algorithms}
    rows = tuple(
        (
            f"{titles[test.first]} / {titles[test.second]}",
            test.figure.replace("_", " "),
            number(test.a12),
            test.magnitude,
            number(test.p, 5),
            number(test.p_holm, 5),
        )
        for test in data.summary.tests
    )
    return Table(
        "tests",
        "Comparison over replicas.",
        ("pair", "figure", "A12", "effect", "p", "p (Holm)"),
        rows,
        "Exact Mann-Whitney tests. A12: chance that the first of the pair has the larger figure.",
    )


def simulation(data: ReportData) -> Table:
    """The selected carries in the simulated cell."""
    return Table(
        "simulation",
        "The selected carries in the simulated cell.",
        HEADINGS,
        tuple(simulation_rows(data.simulations)),
        f"MuJoCo, both arms with their links' masses, controller "
        f"{data.simulations[0].controller!r}. {MEANING}",
    )


def bounds(data: ReportData) -> Table:
    """The bounds of the variables that the best fronts lie on."""
    experiments = [("search", data.summary.bounds)]
    if data.drivable is not None and not is_drivable(data.workcell, data.objectives):
        experiments.append(("drivable", data.drivable.summary.bounds))
    rows = []
    for name, found in experiments:
        if not found.binding:
            rows.append((name, "none", NOTHING, f"0 of {found.solutions}"))
        often = sorted(found.binding, key=lambda bound: -bound.solutions)
        rows += [
            (
                name,
                f"{bound.side}, {bound.variable}",
                f"{bound.value:g}",
                f"{bound.solutions} of {found.solutions}",
            )
            for bound in often[:MOST_BOUNDS]
        ]
        if left := often[MOST_BOUNDS:]:
            fewer = f"at most {left[0].solutions} of {found.solutions}"
            rows.append((name, f"and {counted(len(left), 'further bound')}", NOTHING, fewer))
    return Table(
        "bounds",
        "Bounds of the variables that members of the best fronts lie on.",
        ("experiment", "bound", "value [m, rad]", "members"),
        tuple(rows),
        "All replicas, polished fronts where there are any; most members first, all bounds are in "
        "summary.json. A bound that many lie on may have "
        "decided them: wider ones might allow better carries.",
    )
