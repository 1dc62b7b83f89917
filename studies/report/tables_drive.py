"""The report's tables of how carries are driven: durations, forces, jerk and margins."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hybrid_opt.campaign.recommended import StoredPrice, StoredRecommendation
from studies.report.records import ReportData
from studies.report.table_text import Table, number
from studies.study.drivable import HEAD, NOTE, JerkCosts


def time_against_force(found: StoredRecommendation) -> Table:
    """How long paths and fronts take at the same forces."""
    table, rows = found.durations, []
    for row in table.rows:
        cells = [
            number(median, 3)
            if least == largest or not math.isfinite(median)
            else f"{number(median, 3)} [{number(least, 3)}, {number(largest, 3)}]"
            for median, least, largest in zip(row.median, row.least, row.largest, strict=True)
        ]
        rows.append((row.label, *cells))
    return Table(
        "time_against_force",
        f"Time against {found.force_kind.name}: shortest drivable durations [s].",
        ("path or front", *(f"{force:.2f} N" for force in table.forces)),
        tuple(rows),
        "Every path timed anew at the force. Of fronts the fastest member: median over the "
        "replicas [least, most].",
    )


def robust_price(data: ReportData, price: StoredPrice) -> Table:
    """Forces of the recommended carry that hold for multiples of a set of cases."""
    rows = tuple(
        (number(factor), *(number(force) for force in peak))
        for factor, peak in zip(price.factors, price.peak, strict=True)
    )
    left, right = (robot.name for robot in data.workcell.robots)
    return Table(
        "robust_price",
        "The price of robustness of the recommended carry.",
        ("times the set", f"peak, {left} [N]", f"peak, {right} [N]"),
        rows,
        f"The set{'' if price.stated else ', the usual one'}: {price.uncertainty}. The first robot "
        "leads, the force of the second is commanded. The reference forces allow "
        f"{number(price.largest_factor)} times the set. Of {price.cases} random cases of the set "
        f"{price.failing} slip under its forces; the hardest needs {100.0 * price.closest:.2f} % "
        "of them.",
    )


def limits_on_jerk(costs: Sequence[JerkCosts]) -> Table:
    """Cost of the cell's limits on jerk for the selected drivable carries."""
    rows = tuple(each.cells for each in costs)
    return Table(
        "jerk", "What limits on jerk cost the selected drivable carries.", HEAD, rows, NOTE
    )


def timings(data: ReportData) -> Table:
    """Durations and forces under the search's timing and under drivable ones."""
    rows = []
    for selection in data.timings:
        report = selection.report
        for name, timing in (
            ("search's own", report.judged.timing),
            ("closest to the reference speed", report.closest),
            ("fastest", report.fastest),
        ):
            peak = timing.carry.normal_force.max(axis=0) if timing.carry else np.full(2, np.nan)
            rows.append(
                (
                    f"{selection.label}: {name}",
                    number(timing.duration),
                    *(number(value) for value in peak),
                    str(timing.status),
                    timing.reason,
                )
            )
    left, right = (robot.name for robot in data.workcell.robots)
    return Table(
        "timing",
        "What real timing makes of the selected trajectories.",
        (
            "trajectory and timing",
            "duration [s]",
            f"peak, {left} [N]",
            f"peak, {right} [N]",
            "status",
            "why",
        ),
        tuple(rows),
        "Judged against joint speed, acceleration and torque, payload speed and acceleration, "
        "friction and pressure shift; drivable timings start and end at rest.",
    )


def margins(data: ReportData) -> Table:
    """How wrong the model's assumptions may be, under the drivable timing."""
    judged = [selection for selection in data.timings if selection.margins]
    rows = []
    for k, margin in enumerate(judged[0].margins):
        unit = f" [{margin.unit}]" if margin.unit else ""
        cells = [
            f"{found.limit:.4g}" + (f" ({found.fails})" if found.fails else "")
            for found in (selection.margins[k] for selection in judged)
        ]
        rows.append((f"{margin.quantity}{unit}", f"{margin.nominal:.4g}", *cells))
    return Table(
        "margins",
        "How far assumptions may be off before a carry fails.",
        ("assumption", "nominal", *(selection.label for selection in judged)),
        tuple(rows),
        "Under the timing closest to the reference speed. In brackets: what fails beyond that.",
    )
