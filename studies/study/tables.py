"""The tables of a study, each once, from what the results folder holds.

The terminal shows some of them, the page all, and `tables/` has them as files.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from hybrid_opt.campaign.settings import UNION
from hybrid_opt.display.table import NOTHING, Quantity, Table, counted, number, torque_use
from hybrid_opt.indicators.statistics import summarise
from hybrid_opt.metaheuristics.run import title
from hybrid_opt.robust.price import RobustPrice
from hybrid_opt.timing.analysis import ForceCurve, StoredTiming, TimingDocument
from hybrid_opt.timing.robustness import KILOGRAM_FORCE
from studies.study.recommendation import StoredRecommendation
from studies.study.simulation import StoredSimulation
from studies.study.summary import (
    AlgorithmFigures,
    CampaignSummary,
    FrontFigures,
    NormalisationBounds,
    SelectedEntry,
)

FORCE_QUANTITY = Quantity("normal force", "N")
DURATION_QUANTITY = Quantity("duration", "s")
FINE_DURATION = Quantity("duration", "s", 3)
PAYLOAD_QUANTITY = Quantity("payload at the limit", "kg")
ABOVE_REST = Quantity("above rest", "%")
TORQUE_QUANTITY = Quantity("joint torque", "%", 1, 100.0)
SHIFT_QUANTITY = Quantity("pressure shift", "mm", 1, 1e3)

REPLICA_QUANTITIES = {
    "feasible": Quantity("feasible", digits=0),
    "feasible_share": Quantity("feasible", "%", 1, 100.0),
    "non_dominated": Quantity("non-dominated", digits=1),
    "hypervolume": Quantity("hypervolume", digits=4),
    "igd": Quantity("IGD", digits=5),
    "igd_plus": Quantity("IGD+", digits=5),
    "spacing": Quantity("spacing", digits=5),
    "mean_excess_above_static": ABOVE_REST,
    "payload_limit": PAYLOAD_QUANTITY,
    "seconds": Quantity("computing time", "s"),
    "widest_gap": Quantity("widest gap", "%", 0, 100.0),
    "equivalent_evaluations": Quantity("evaluations as long", digits=0),
}
"""How tables print a replica's figures, by their names in summary.json."""

MOST_BOUNDS = 8
"""Most bounds of one experiment that the table of bounds lists."""


PAPER = {"nsga2": ("694", "69.4", "16.71"), "mopso": ("296", "29.6", "16.06")}
"""Values that the text of the paper states for an algorithm on its rack: feasible candidates of
1000, their share [%] (Section 7), and the payload at which the selected trajectory reaches 12 kgf
[kg] (Section 6.3). The paper's tables are not reproduced."""


def study_tables(
    summary: CampaignSummary,
    drivable: CampaignSummary | None = None,
    jerk: Table | None = None,
    simulations: Sequence[StoredSimulation] = (),
    with_paper: bool = False,
) -> tuple[Table, ...]:
    """Return those tables of a study that need its stored documents only, not its workcell.

    Args:
        summary: summary of the study's first experiment.
        drivable: summary of a second, drivable experiment; None without one.
        jerk: table from `studies.study.simulation.limits_on_jerk`; None without one.
        simulations: results of carries in the simulated cell.
        with_paper: True to add rows with the paper's values.
    """
    found = summary.recommendation
    tables = [quality(summary, with_paper), selected(summary, with_paper)]
    if found is not None:
        tables.append(time_against_force(found))
        if found.price is not None:
            tables.append(robust_price(found.price, summary.robots))
    tables += [] if jerk is None else [jerk]
    tables += [simulated(simulations)] if simulations else []
    tables += [replicas(summary), infeasible(summary)]
    if drivable is not None:
        heading = "Quality of the drivable search."
        tables.append(quality(drivable, False, "drivable_quality", heading))
    tables.append(bounds(summary.bounds, None if drivable is None else drivable.bounds))
    tables += [rank_tests(summary)] if summary.tests else []
    return tuple(tables)


_QUALITY = ("feasible", "feasible_share", "non_dominated", "hypervolume", "igd", "spacing")


def quality(
    summary: CampaignSummary,
    with_paper: bool,
    name: str = "table1_quality",
    heading: str = "Table 1. Quality of the search.",
) -> Table:
    """Return the table of the indicators of fronts, for each algorithm over its replicas (paper
    Table 1).

    Args:
        summary: summary of the experiment.
        with_paper: True to add rows with the paper's values.
        name: name of the table's file, without suffix.
        heading: sentence above the table.
    """
    rows = []
    for algorithm, entry in summary.algorithms.items():
        for label, figures in _variants(algorithm, entry):
            rows.append((label, *(_over_replicas(figures, key, mean=True) for key in _QUALITY)))
        if with_paper and algorithm in PAPER:
            rows.append((f"{title(algorithm)}, paper", *PAPER[algorithm][:2], *[NOTHING] * 4))
    for label, figures in _polished_union(summary):
        rows.append((label, *(_over_replicas(figures, key) for key in _QUALITY)))
    settings = summary.settings
    return Table(
        name,
        heading,
        ("algorithm", *(REPLICA_QUANTITIES[key].heading() for key in _QUALITY)),
        tuple(rows),
        f"Mean ± standard deviation of {counted(settings.replicas, 'replica')} of "
        f"{settings.evaluations} evaluations. Hypervolume: reference 1.1 in every objective. "
        "IGD: mean distance to the non-dominated union of the campaign. Spacing: Schott's."
        + ("" if summary.union is None else f" {_OF_UNION}")
        + (" The paper's rows hold what its text states." if with_paper else ""),
    )


def _variants(name: str, entry: AlgorithmFigures) -> list[tuple[str, list[FrontFigures]]]:
    """Return the rows of one algorithm in a table: the fronts of its search and, if they were
    polished, the polished fronts.

    Args:
        name: name of the algorithm.
        entry: figures of the algorithm.

    Returns:
        For each row its label, and the figures of the front of each replica.
    """
    found: list[tuple[str, list[FrontFigures]]] = [(title(name), list(entry.replicas))]
    polished = [row.polished for row in entry.replicas if row.polished is not None]
    return found + ([(f"{title(name)} + polish", list(polished))] if polished else [])


_OF_UNION = "Union: the non-dominated candidates of all replicas, polished as one front."


def _polished_union(summary: CampaignSummary) -> list[tuple[str, list[FrontFigures]]]:
    """Return a row for the union of a drivable experiment's fronts that was polished as one front.

    Returns:
        One label with the figures of the union; empty without such a union.
    """
    return [] if summary.union is None else [(f"{UNION} + polish", [summary.union])]


def _over_replicas(figures: Sequence[FrontFigures], key: str, mean: bool = False) -> str:
    """Format a figure over replicas: median and quartiles, or mean and standard deviation.

    Args:
        figures: figures of each replica.
        key: name of the figure; a dash is returned if the records lack it.
        mean: True for mean and standard deviation.
    """
    if not hasattr(figures[0], key):
        return NOTHING
    found, quantity = summarise([getattr(row, key) for row in figures]), REPLICA_QUANTITIES[key]
    if mean:
        return quantity.mean(found.mean, found.std)
    return quantity.spread(found.median, found.quartile1, found.quartile3)


def _table(
    name: str,
    heading: str,
    columns: Mapping[str, Callable[[Any], str]],
    of: Iterable[Any],
    note: str,
) -> Table:
    """Build a table with one row per record.

    Args:
        name: name of the table's file, without suffix.
        heading: sentence above the table.
        columns: function that makes the text of a cell from a record, by the heading of the column.
        of: the records.
        note: text below the table.
    """
    rows = tuple(tuple(told(one) for told in columns.values()) for one in of)
    return Table(name, heading, tuple(columns), rows, note)


def selected(summary: CampaignSummary, with_paper: bool) -> Table:
    """Return the table of the normal forces of the selected trajectories (paper Table 2).

    Args:
        summary: summary of the experiment.
        with_paper: True to add rows with the paper's values.
    """
    rows = [_forces("hand-made", summary.hand_made)]
    for name, entry in summary.algorithms.items():
        if entry.representative is None:
            rows.append((f"{title(name)}: no feasible candidate", *[NOTHING] * 7))
        else:
            best = replace(
                entry, representative=0, replicas=(entry.replicas[entry.representative],)
            )
            rows += [_forces(label, row[0].selected) for label, row in _variants(name, best)]
        if with_paper and name in PAPER:
            rows.append((f"{title(name)}, paper", *[NOTHING] * 6, PAPER[name][2]))
    still, found = summary.static_hold, summary.recommendation
    if found is not None:
        excess = 100.0 * float((found.peak_force / still.normal_force).mean() - 1.0)
        driven = (found.peak_force, excess, found.duration, found.payload_limit)
        rows.append(_pressed("recommended, driven", (None, None), *driven))
    force, payload = still.normal_force, still.payload_limit
    rows.append(_pressed("level payload at rest", force, force, 0.0, None, payload))
    return Table(
        "table2_selected",
        "Table 2. Normal contact forces of the selected trajectories.",
        (
            "trajectory",
            *(f"{which}, {robot} [N]" for which in ("least", "peak") for robot in summary.robots),
            *(quantity.heading() for quantity in (ABOVE_REST, DURATION_QUANTITY, PAYLOAD_QUANTITY)),
        ),
        tuple(rows),
        "Selected: least mean peak force of the replica with the largest hypervolume. Above rest: "
        "mean of both peaks over that of the level payload at rest. Payload: the least at which a "
        "robot's whole contact force reaches its reference force. Recommended, driven: as robots "
        "drive it, planned forces.",
    )


def _forces(label: str, found: SelectedEntry | None) -> tuple[str, ...]:
    if found is None:
        return (f"{label} (infeasible)", *[NOTHING] * 7)
    label = label if found.feasible else f"{label} (infeasible)"
    forces = (found.minimum_normal_force, found.peak_normal_force)
    more = (found.mean_excess_above_static, found.duration, found.payload_limit)
    return _pressed(label, *forces, *more)


def _pressed(
    label: str,
    least: Iterable[float | None],
    peak: Iterable[float],
    above_rest: float,
    duration: float | None,
    payload: float,
) -> tuple[str, ...]:
    last = (ABOVE_REST(above_rest), DURATION_QUANTITY(duration), PAYLOAD_QUANTITY(payload))
    return (label, *map(FORCE_QUANTITY, (*least, *peak)), *last)


def replicas(summary: CampaignSummary) -> Table:
    """Return the table of the carries selected from each replica, before and after the polish."""
    rows, keys = [], ("mean_excess_above_static", "payload_limit")
    for name, entry in summary.algorithms.items():
        for label, figures in _variants(name, entry):
            better, gap, polished = NOTHING, NOTHING, entry.polished
            if polished is not None and label != title(name):
                better = f"{polished.replicas_improved} of {len(figures)}"
                gap = REPLICA_QUANTITIES["widest_gap"](polished.statistics["widest_gap"].median)
            rows.append((label, *(_over_replicas(figures, key) for key in keys), better, gap))
    for label, figures in _polished_union(summary):
        found = (_over_replicas(figures, key) for key in (*keys, "widest_gap"))
        mean, payload, gap = found
        rows.append((label, mean, payload, NOTHING, gap))
    headings = (ABOVE_REST.heading(), PAYLOAD_QUANTITY.heading(), "better in")
    return Table(
        "replicas",
        "Selected solutions of all replicas.",
        ("algorithm", *headings, REPLICA_QUANTITIES["widest_gap"].heading()),
        tuple(rows),
        "Median [quartiles]. Better in: replicas whose hypervolume the polish made larger. Widest "
        f"gap: between neighbours, as a share of the front's length.{_solvers(summary)}",
    )


def effort(summary: CampaignSummary) -> Table:
    """Return the table of computing times per replica. It is printed only and never stored, because
    times differ from run to run."""
    keys = ("seconds", "equivalent_evaluations")
    every = [each for name, entry in summary.algorithms.items() for each in _variants(name, entry)]
    every += _polished_union(summary)
    return Table(
        "effort",
        "What a replica took.",
        ("algorithm", *(REPLICA_QUANTITIES[key].heading() for key in keys)),
        tuple((label, *(_over_replicas(row, key) for key in keys)) for label, row in every),
        "Median [quartiles]. Evaluations as long: candidates that are evaluated in the time of a "
        f"polish.{_solvers(summary)}",
    )


def _solvers(summary: CampaignSummary) -> str:
    """Return a sentence that names the solvers of the polish, '' without a polish."""
    rows = [row.polished for entry in summary.algorithms.values() for row in entry.replicas]
    rows.append(summary.union)
    names = sorted({polished.solver for polished in rows if polished is not None})
    return f" Solver of the polish: {' and '.join(names)}." if names else ""


def infeasible(summary: CampaignSummary) -> Table:
    """Return the table of the constraints that infeasible candidates violated first, in percent of
    all candidates of each algorithm."""
    shares: dict[str, dict[str, float]] = {}
    for name, entry in summary.algorithms.items():
        counts = sum((Counter(row.infeasible_by_reason) for row in entry.replicas), Counter[str]())
        total = sum(row.evaluations for row in entry.replicas)
        for reason, count in counts.items():
            shares.setdefault(reason, {})[name] = count / total
    share, names = REPLICA_QUANTITIES["feasible_share"], summary.algorithms
    rows = [
        (constraint_title(reason, summary.robots), *(share(own.get(name, 0.0)) for name in names))
        for reason, own in sorted(shares.items(), key=lambda each: -max(each[1].values()))
    ]
    return Table(
        "infeasibility",
        "What made candidates infeasible.",
        ("constraint", *(f"{title(name)} [{share.unit}]" for name in names)),
        tuple(rows),
        "The constraint violated first along the path, in percent of all candidates.",
    )


def constraint_title(name: str, robots: Sequence[str]) -> str:
    """Return the name of a constraint for people.

    Args:
        name: name of the constraint; 'reach_1' becomes 'reach' with the name of the first robot.
        robots: names of both robots.
    """
    words = name.split("_")
    if words[-1].isdigit():
        return f"{' '.join(words[:-1])}, {robots[int(words[-1]) - 1]}"
    return " ".join(words)


def bounds(search: NormalisationBounds, drivable: NormalisationBounds | None = None) -> Table:
    """Return the table of the bounds of decision variables on which points of the best fronts lie.

    Args:
        search: bounds of the first experiment.
        drivable: bounds of a second, drivable experiment; None without one.
    """
    rows = []
    for name, found in (("search", search), ("drivable", drivable)):
        if found is None:
            continue
        of = f"of {found.solutions}"
        often = sorted(found.binding, key=lambda bound: -bound.solutions)
        shown, left = often[:MOST_BOUNDS], often[MOST_BOUNDS:]
        told = [(f"{b.side}, {b.variable}", f"{b.value:g}", f"{b.solutions} {of}") for b in shown]
        told += [] if often else [("none", NOTHING, f"0 {of}")]
        if left:
            further = f"and {counted(len(left), 'further bound')}"
            told.append((further, NOTHING, f"at most {left[0].solutions} {of}"))
        rows += [(name, *each) for each in told]
    return Table(
        "bounds",
        "Bounds of the variables that members of the best fronts lie on.",
        ("experiment", "bound", "value [m, rad]", "members"),
        tuple(rows),
        "All replicas, polished fronts where there are any; most members first, all bounds are in "
        "summary.json. A bound that many lie on may have "
        "decided them: wider ones might allow better carries.",
    )


def rank_tests(summary: CampaignSummary) -> Table:
    """Return the table of the Mann-Whitney tests between algorithms."""
    return _table(
        "tests",
        "Comparison over replicas.",
        {
            "pair": lambda test: f"{title(test.first)} / {title(test.second)}",
            "figure": lambda test: test.figure.replace("_", " "),
            "A12": lambda test: number(test.a12),
            "effect": lambda test: test.magnitude,
            "p": lambda test: number(test.p, 5),
            "p (Holm)": lambda test: number(test.p_holm, 5),
        },
        summary.tests,
        "Exact Mann-Whitney tests. A12: chance that the first of the pair has the larger figure.",
    )


def time_against_force(found: StoredRecommendation) -> Table:
    """Return the table of the shortest durations of several paths, and of the whole front, at the
    same commanded forces."""
    table = found.durations
    return Table(
        "time_against_force",
        "Time against commanded force: shortest drivable durations [s].",
        ("path or front", *(f"{force:.1f} N" for force in table.forces)),
        tuple((row.label, *map(FINE_DURATION, row.durations)) for row in table.rows),
        "Every path timed anew with at most that force commanded, held in every case of the "
        "uncertainty, limits on jerk left out. The last force is the reference force. The front: "
        "all paths that the recommended carry was chosen from.",
    )


def robust_price(price: RobustPrice, robots: Sequence[str]) -> Table:
    """Return the table of the peak normal forces that hold the recommended carry in every case of
    the uncertainty, for several factors on the uncertainty.

    Args:
        price: the forces by factor.
        robots: names of both robots.
    """
    check, of = price.check, "" if price.uncertainty.stated else ", the usual one"
    return Table(
        "robust_price",
        "The price of robustness of the recommended carry.",
        ("multiple of the uncertainty", *(f"peak, {robot} [N]" for robot in robots)),
        tuple(
            (number(factor), *map(FORCE_QUANTITY, peak))
            for factor, peak in zip(price.factors, price.peak, strict=True)
        ),
        f"The uncertainty{of}: {price.uncertainty}. The first robot "
        "leads, the force of the second is commanded. The reference forces allow "
        f"{number(price.largest_factor)} times as much. Of {check.cases} random cases "
        f"{check.failing} slip under its forces; the hardest needs {check.hardest} of them.",
    )


def simulated(found: Sequence[StoredSimulation]) -> Table:
    """Return the table of the results of carries in the simulated cell."""

    def holds(one: StoredSimulation) -> str:
        return f"{one.slips:.3f} to {one.holds:.3f}" if math.isfinite(one.holds) else one.problem

    def pressed(one: StoredSimulation) -> str:
        return "robust forces" if one.robust else f"{number(one.factor, 1)} times the plan"

    return _table(
        "simulation",
        "The selected carries in the simulated cell.",
        {
            "carry": lambda one: one.label,
            DURATION_QUANTITY.heading(): lambda one: DURATION_QUANTITY(one.duration),
            "holds from": holds,
            "slips first": lambda one: (
                f"pad {one.pad} at {one.begins:.2f} s" if one.pad else NOTHING
            ),
            "pressed with": pressed,
            "peak predicted [N]": lambda one: " / ".join(map(FORCE_QUANTITY, one.peaks[0])),
            "peak simulated [N]": lambda one: " / ".join(map(FORCE_QUANTITY, one.peaks[1])),
            "largest error [%]": lambda one: number(100.0 * one.largest_error, 1),
            "slip [mm]": lambda one: number(1e3 * one.slip, 3),
            "arrives": lambda one: "yes" if one.arrives else "NO",
        },
        found,
        f"MuJoCo, both arms with their links' masses, controller {found[0].controller!r}. Holds "
        "from: multiple of the planned forces, between a run that slips and one that holds. The "
        "other columns: a run pressed as said, forces of both robots, their error over the "
        "reference.",
    )


LabelledTimings = Sequence[tuple[str, TimingDocument]]
"""Pairs of a trajectory's label and its timings; the label of a single trajectory may be ''."""


def timings(timed: LabelledTimings, robots: Sequence[str]) -> Table:
    """Return the table of durations and forces of trajectories under each of the timings of
    `time_trajectory`.

    Args:
        timed: label and timings of each trajectory.
        robots: names of both robots.
    """
    return Table(
        "timing",
        "What real timing makes of the selected trajectories.",
        (
            "trajectory and timing",
            FINE_DURATION.heading(),
            *(f"peak, {robot} [N]" for robot in robots),
            *(
                quantity.heading()
                for quantity in (PAYLOAD_QUANTITY, TORQUE_QUANTITY, SHIFT_QUANTITY)
            ),
            "status",
            "why",
        ),
        tuple(
            (_of(label, name), *_timing_cells(timing), str(timing.status), timing.reason)
            for label, document in timed
            for name, timing in document.timings.items()
        ),
        "Judged against joint speed, acceleration and torque, payload speed and acceleration, "
        "friction and pressure shift; drivable timings start and end at rest, in the cell that "
        "robots drive. Along the path u goes from 0 to 1. At the reference speeds without ramps: "
        + ", ".join(
            f"{_of(label, '')}{FINE_DURATION(found.nominal_duration)} s"
            for label, found in timed
            if math.isfinite(found.nominal_duration)
        )
        + ".",
    )


def _of(label: str, name: str) -> str:
    return f"{label}: {name}" if label and name else label + " " * bool(label) or name


def _timing_cells(timing: StoredTiming) -> tuple[str, ...]:
    if timing.peak_normal_force is None or timing.peak_pressure_shift is None:
        return (NOTHING,) * 6
    torque = (timing.joint_use or {}).get("joint torque")
    return (
        FINE_DURATION(timing.duration),
        *map(FORCE_QUANTITY, timing.peak_normal_force),
        PAYLOAD_QUANTITY(timing.payload_limit),
        torque_use(None if torque is None else float(torque.max())),
        SHIFT_QUANTITY(timing.peak_pressure_shift.max()),
    )


def margins(timed: LabelledTimings) -> Table:
    """Return the table of how far single values of the model may be off before a carry fails.

    The margins are those of the timing closest to the reference speeds; for the recommended carry,
    those of its job's timing.

    Args:
        timed: label and timings of each trajectory, of which at least one has margins.
    """
    judged = [(label, document.margins) for label, document in timed if document.margins]
    rows = []
    for found in zip(*(margins for _, margins in judged), strict=True):
        unit, scale = ("mm", 1e3) if found[0].unit == "m" else (found[0].unit, 1.0)
        limits = [f"{scale * one.limit:.4g}" for one in found]
        cells = [
            limit + (f" ({one.fails})" if one.fails else "")
            for limit, one in zip(limits, found, strict=True)
        ]
        name = f"{found[0].quantity} [{unit}]" if unit else found[0].quantity
        rows.append((name, f"{scale * found[0].nominal:.4g}", *cells))
    return Table(
        "margins",
        "How far assumptions may be off before a carry fails.",
        ("assumption", "nominal", *(label or "limit" for label, _ in judged)),
        tuple(rows),
        "Under the timing closest to the reference speed, the recommended carry's as robots drive "
        "it; forces allocated anew, up to the reference forces. In brackets: what fails beyond "
        "that.",
    )


def force_curve(curve: ForceCurve) -> Table:
    """Return the table of the shortest duration of one path at each of several force limits."""
    rows = zip(curve.force, curve.duration, curve.status, strict=False)
    return Table(
        "force_curve",
        f"Duration against force limit (at rest {FORCE_QUANTITY(curve.static_force)} N).",
        ("limit [N]", "limit [kgf]", FINE_DURATION.heading(), "status"),
        tuple(
            (
                FORCE_QUANTITY(force),
                number(force / KILOGRAM_FORCE),
                FINE_DURATION(duration),
                str(status),
            )
            for force, duration, status in rows
        ),
    )
