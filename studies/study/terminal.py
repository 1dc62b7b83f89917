"""A campaign's figures as text: the paper's Tables 1 and 2, and beside them what it states."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from hybrid_opt.campaign.recommended import StoredRecommendation
from hybrid_opt.campaign.summary import AlgorithmFigures, Bounds, CampaignSummary, StoredTest
from hybrid_opt.display.table import text_table

TITLES = {
    "nsga2": "NSGA-II",
    "mopso": "MOPSO",
    "mopso-turbulent": "MOPSO, turbulent",
    "sms-emoa": "SMS-EMOA",
    "random": "random search",
}
"""How the algorithms are called in print."""


@dataclass(frozen=True)
class PaperFigures:
    """Figures of the paper's text for an algorithm on its rack; its tables are not reproduced.

    Attributes:
        feasible: feasible candidates of 1000 (Section 7).
        payload_limit: payload at which the selected trajectory reaches 12 kgf [kg] (Section 6.3).
    """

    feasible: int
    payload_limit: float


PAPER = {"nsga2": PaperFigures(694, 16.71), "mopso": PaperFigures(296, 16.06)}

_TABLE_1 = (
    ("feasible", "feasible", 0),
    ("feasible_share", "feasible %", 1),
    ("non_dominated", "front", 1),
    ("hypervolume", "HV", 4),
    ("igd", "IGD", 4),
    ("spacing", "spacing", 4),
)
_SELECTED = (
    ("mean_excess_above_static", "above static %", 2),
    ("payload_limit", "payload kg", 3),
    ("seconds", "seconds", 2),
)


def title(algorithm: str) -> str:
    """An algorithm's name in print."""
    return TITLES.get(algorithm, algorithm)


def counted(count: int, noun: str) -> str:
    """A number of things, whose plural ends in s."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def number(value: float | None, digits: int, scale: float = 1.0) -> str:
    """A figure in print; '-' where there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value * scale:z.{digits}f}"


def terminal_summary(
    summary: CampaignSummary,
    with_paper: bool,
    recommendation: str = "",
    drivable: CampaignSummary | None = None,
    jerk: str = "",
) -> str:
    """The figures of a summary.json as text.

    Args:
        summary: as from `hybrid_opt.campaign.results.read_summary`.
        with_paper: whether to print what the paper states, which is of its rack cell.
        recommendation: the words about the carry to run, which come first.
        drivable: figures of the drivable experiment beside this one.
        jerk: the words about what limits on jerk cost.
    """
    settings = summary.settings
    parts = [
        recommendation,
        f"{summary.workcell.name}: {counted(settings.replicas, 'replica')} of "
        f"{settings.evaluations} evaluations, seed {settings.seed}",
        _table_1(summary.algorithms),
        _reasons(summary.algorithms),
        _table_2(summary),
        _over_replicas(summary.algorithms),
        _polish(summary.algorithms),
        _tests(summary.tests),
        bounds_sentence(summary.bounds),
    ]
    if summary.recommendation is not None:
        parts.append(_durations(summary.recommendation))
    if drivable is not None:
        parts += [
            f"The drivable experiment\n{_drivable(drivable)}",
            bounds_sentence(drivable.bounds),
        ]
    parts.append(jerk)
    if with_paper:
        parts.append(_paper(summary.algorithms))
    return "\n\n".join(part for part in parts if part)


def bounds_sentence(bounds: Bounds) -> str:
    """Bounds of the variables that the best fronts lie on, and the consequence."""
    if not bounds.solutions:
        return ""
    head = f"Bounds of the variables at the {bounds.solutions} members of the best fronts"
    if not bounds.binding:
        return f"{head}: none binds"
    listed = "\n".join(
        f"  {bound.side} bound of {bound.variable} ({bound.value:g}): {bound.solutions}"
        for bound in bounds.binding
    )
    return f"{head}; these bind, wider ones may allow better carries\n{listed}"


def _durations(found: StoredRecommendation) -> str:
    """How long all fronts take at the same forces."""
    table = found.durations
    rows = [["duration [s] at", *(f"{force:.2f} N" for force in table.forces)]]
    for row in table.rows:
        cells = [
            _spread_of(*values) for values in zip(row.median, row.least, row.largest, strict=True)
        ]
        rows.append([row.label, *cells])
    note = "Every path timed anew at the force; of fronts the fastest member, median [least, most]."
    return f"Time against {found.force_kind.name}\n{text_table(rows)}\n{note}"


def _spread_of(median: float, least: float, largest: float) -> str:
    if not math.isfinite(median):
        return number(None, 3)
    if least == largest:
        return number(median, 3)
    return f"{number(median, 3)} [{number(least, 3)}, {number(largest, 3)}]"


def _drivable(summary: CampaignSummary) -> str:
    """Hypervolume in duration and force, searched and polished, over the replicas."""
    rows = [["median", "feasible %", "front", "HV", "HV polished", "better in", "seconds"]]
    for name, entry in summary.algorithms.items():
        found, after = entry.statistics, entry.polished
        rows.append(
            [
                title(name),
                number(found["feasible_share"].median, 1, 100.0),
                number(found["non_dominated"].median, 0),
                number(found["hypervolume"].median, 5),
                number(None if after is None else after.statistics["hypervolume"].median, 5),
                "-" if after is None else f"{after.replicas_improved} of {len(entry.replicas)}",
                number(found["seconds"].median, 2),
            ]
        )
    return text_table(rows)


def _table_1(algorithms: Mapping[str, AlgorithmFigures]) -> str:
    rows = [["mean ± std", *(heading for _, heading, _ in _TABLE_1)]]
    for name, entry in algorithms.items():
        cells = []
        for figure, _, digits in _TABLE_1:
            scale = 100.0 if figure == "feasible_share" else 1.0
            found = entry.statistics[figure]
            mean, std = (number(value, digits, scale) for value in (found.mean, found.std))
            cells.append(f"{mean} ± {std}")
        rows.append([title(name), *cells])
    note = (
        "Over replicas; fronts of all evaluated candidates. HV: hypervolume to 1.1 in every\n"
        "objective. IGD: to the non-dominated union of the campaign. Spacing: Schott's."
    )
    return f"Table 1. Quality of the search\n{text_table(rows)}\n{note}"


def _reasons(algorithms: Mapping[str, AlgorithmFigures]) -> str:
    lines = ["What made candidates infeasible, in percent of all"]
    for name, entry in algorithms.items():
        total = sum(row.evaluations for row in entry.replicas)
        counts: dict[str, int] = {}
        for row in entry.replicas:
            for reason, count in row.infeasible_by_reason.items():
                counts[reason] = counts.get(reason, 0) + count
        ranked = sorted(counts.items(), key=lambda item: -item[1])
        shares = [f"{reason} {100.0 * count / total:.1f}" for reason, count in ranked]
        lines.append(f"  {title(name)}: {', '.join(shares) or 'nothing'}")
    return "\n".join(lines)


def _table_2(summary: CampaignSummary) -> str:
    left, right = summary.robots
    of_robots = [f"least, {left}", f"least, {right}", f"peak, {left}", f"peak, {right}"]
    heading = ["N", *of_robots, "above static %", "payload kg"]
    rows = [heading]
    static = summary.static_hold
    still = [number(force, 2) for force in static.normal_force]
    for name, entry in summary.algorithms.items():
        row = entry.replicas[entry.representative or 0]
        selected = row.selected
        if entry.representative is None or selected is None:
            rows.append([f"{title(name)}: no feasible candidate", *[""] * (len(heading) - 1)])
            continue
        forces = [*selected.minimum_normal_force, *selected.peak_normal_force]
        rows.append(
            [
                f"{title(name)}, replica {entry.representative}",
                *(number(force, 2) for force in forces),
                number(row.mean_excess_above_static, 2),
                number(selected.payload_limit, 2),
            ]
        )
    rows.append(["held still", *still, *still, "0.00", number(static.payload_limit, 2)])
    return (
        "Table 2. Normal forces along the selected trajectories (least mean "
        f"peak\nforce of the replica with the largest hypervolume)\n{text_table(rows)}"
    )


def _over_replicas(algorithms: Mapping[str, AlgorithmFigures]) -> str:
    rows = [["median [quartiles]", *(heading for _, heading, _ in _SELECTED)]]
    for name, entry in algorithms.items():
        cells = []
        for figure, _, digits in _SELECTED:
            found = entry.statistics[figure]
            three = (found.median, found.quartile1, found.quartile3)
            values = [number(value, digits) for value in three]
            cells.append("{} [{}, {}]".format(*values))
        rows.append([title(name), *cells])
    return f"Selected solutions of all replicas, and what a replica took\n{text_table(rows)}"


def _polish(algorithms: Mapping[str, AlgorithmFigures]) -> str:
    """Table of the polished fronts; nothing without a polish."""
    head = ["median", "HV before", "HV after", "better in", "points", "widest gap %"]
    rows = [[*head, "above static %", "payload kg", "seconds", "= evaluations"]]
    solvers = set[str]()
    for name, entry in algorithms.items():
        if entry.polished is None:
            continue
        solvers |= {one.polished.solver for one in entry.replicas if one.polished is not None}
        after = entry.polished.statistics
        rows.append(
            [
                title(name),
                number(entry.statistics["hypervolume"].median, 5),
                number(after["hypervolume"].median, 5),
                f"{entry.polished.replicas_improved} of {len(entry.replicas)}",
                number(after["non_dominated"].median, 0),
                number(100.0 * after["widest_gap"].median, 0),
                number(after["mean_excess_above_static"].median, 2),
                number(after["payload_limit"].median, 3),
                number(after["seconds"].median, 2),
                number(after["equivalent_evaluations"].median, 0),
            ]
        )
    if len(rows) == 1:
        return ""
    by = " and ".join(sorted(solvers))
    return f"Fronts after the polish (solver: {by}), and what it took\n{text_table(rows)}"


def _tests(tests: Sequence[StoredTest]) -> str:
    if not tests:
        return ""
    rows = [["exact Mann-Whitney", "figure", "A12", "effect", "p", "p (Holm)"]]
    rows += [
        [
            f"{title(test.first)} / {title(test.second)}",
            test.figure,
            number(test.a12, 2),
            test.magnitude,
            number(test.p, 5),
            number(test.p_holm, 5),
        ]
        for test in tests
    ]
    return (
        "Comparison over replicas. A12: chance that the first algorithm has the larger figure\n"
        + text_table(rows)
    )


def _paper(algorithms: Mapping[str, AlgorithmFigures]) -> str:
    rows = [["median of ours / stated by the paper", "feasible %", "payload kg"]]
    for name, stated in PAPER.items():
        if name in algorithms:
            statistics = algorithms[name].statistics
            share = number(statistics["feasible_share"].median, 1, 100.0)
            payload = number(statistics["payload_limit"].median, 2)
            rows.append(
                [
                    title(name),
                    f"{share} / {stated.feasible / 10.0:.1f}",
                    f"{payload} / {stated.payload_limit:.2f}",
                ]
            )
    if len(rows) == 1:
        return ""
    return (
        "Beside the paper, whose rack has the same boards and robots, but unstated details\n"
        + text_table(rows)
    )
