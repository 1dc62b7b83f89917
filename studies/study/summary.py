"""The figures of a campaign: the records of `summary.json` (docs/reference/results.md), and the
stage that makes them of a finished search, with fronts and selected trajectories."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from hybrid_opt.campaign import CampaignFolder, Stage
from hybrid_opt.campaign.results import CampaignResults, Replica, read_campaign, read_configuration
from hybrid_opt.campaign.settings import (
    FRONTS,
    HAND_MADE_FILE,
    SELECTED,
    STAGES,
    SUMMARY,
    UNION,
    CampaignSettings,
    Seconds,
    StoredCell,
    polished_selected_file,
    reference_front_file,
    selected_file,
)
from hybrid_opt.carry import Carry
from hybrid_opt.errors import ResultsError
from hybrid_opt.front import Front, SelectedCarry, select
from hybrid_opt.indicators import metrics
from hybrid_opt.indicators.metrics import BindingBound, binding_bounds
from hybrid_opt.indicators.statistics import (
    RankTest,
    Summary,
    attainment_surfaces,
    corrected,
    rank_test,
    summarise,
)
from hybrid_opt.polishing.records import PolishEffort
from hybrid_opt.progress import Progress
from hybrid_opt.static_hold import StaticHold
from hybrid_opt.store.files import (
    csv_text,
    read_record,
    storing,
    to_json,
    write_atomically,
    write_json,
)
from hybrid_opt.store.trajectory_file import write_trajectory
from studies.study.answer import Fact, StudyAnswer, answer
from studies.study.recommendation import (
    NoRecommendation,
    StoredRecommendation,
    read_recommendation,
)
from symbolic.array import Array, Count, Figure, Pair, Range, Row

Share = Annotated[float, Range(0.0, 1.0)]


@dataclass(frozen=True)
class SelectedEntry:
    """The solution selected from a front, or the hand-made trajectory.

    Attributes:
        evaluation: its number, from 1; 0 for the hand-made one.
        file: its trajectory file, relative to the folder.
        objectives: (n_obj,).
        peak_normal_force, minimum_normal_force: per robot [N].
        excess_above_static: per robot [%].
        payload_limit: [kg].
        duration: [s].
        feasible: the evaluator's verdict.
    """

    evaluation: Count
    file: str | None
    objectives: Row
    peak_normal_force: Pair
    minimum_normal_force: Pair
    excess_above_static: Pair
    payload_limit: float
    duration: float
    feasible: bool = True

    @property
    def mean_excess_above_static(self) -> float:
        """Mean of both robots' [%]."""
        return float(self.excess_above_static.mean())


@dataclass(frozen=True)
class FrontFigures:
    """Indicators of a front, and of the solution selected from it.

    Attributes:
        non_dominated: points.
        hypervolume, igd, igd_plus, spacing: see `hybrid_opt.indicators.metrics`.
        mean_excess_above_static: of the selected solution [%].
        payload_limit: of the selected solution [kg].
        selected: None where no candidate is feasible.
    """

    non_dominated: Count
    hypervolume: float
    igd: Figure
    igd_plus: Figure
    spacing: Figure
    mean_excess_above_static: Figure
    payload_limit: Figure
    selected: SelectedEntry | None


@dataclass(frozen=True)
class PolishedFigures(PolishEffort, FrontFigures):
    """A polished front, and the effort."""


@dataclass(frozen=True)
class ReplicaFigures(FrontFigures):
    """One replica.

    Attributes:
        replica: its number, from 0.
        evaluations, feasible, feasible_share: candidates.
        seconds: duration of the search.
        infeasible_by_reason: candidates by what made them infeasible.
        best_so_far: evaluations at which the best of an objective changed: number, then the best.
        polished: None where the replica's front was not polished.
    """

    replica: Count
    evaluations: Annotated[int, Range(1, 10**12)]
    feasible: Count
    feasible_share: Share
    seconds: Seconds
    infeasible_by_reason: Mapping[str, Count]
    best_so_far: tuple[Row, ...]
    polished: PolishedFigures | None = None


@dataclass(frozen=True)
class PolishedStatistics:
    """An algorithm's polished fronts, over the replicas."""

    statistics: Mapping[str, Summary]
    hypervolume_gain: Summary
    replicas_improved: Count


@dataclass(frozen=True)
class AlgorithmFigures:
    """One algorithm.

    Attributes:
        representative: the replica with the largest hypervolume, None if it found nothing.
        statistics: by figure, over the replicas.
        replicas: in order.
        polished: None where the replicas' fronts were not polished.
    """

    representative: int | None
    statistics: Mapping[str, Summary]
    replicas: tuple[ReplicaFigures, ...]
    polished: PolishedStatistics | None = None

    def __post_init__(self) -> None:
        """Refuse what does not belong together."""
        if not self.replicas:
            raise ValueError("has no replicas")
        if self.representative is not None and not (
            0 <= self.representative < len(self.replicas)
            and self.replicas[self.representative].selected is not None
        ):
            raise ValueError("its representative replica selected no solution")


@dataclass(frozen=True)
class StoredFront:
    """The campaign's reference front: its file, points and hypervolume."""

    file: str
    points: Count
    hypervolume: float


@dataclass(frozen=True)
class NormalisationBounds:
    """Bounds of the decision variables on which members of the best fronts lie.

    Attributes:
        solutions: members of these fronts: of the polished union, else of all replicas' fronts,
            polished where they were.
        binding: the bounds that some of them lie on.
    """

    solutions: Count
    binding: tuple[BindingBound, ...]


@dataclass(frozen=True)
class CampaignSummary:
    """summary.json.

    Attributes:
        robots: their names, in the order of all pairs.
        hand_made: the workcell file's own trajectory, None where it has no forces.
        union: of a drivable experiment the polished union of all fronts, None without a polish.
        recommendation: the carry to run, None where the study has none.
        no_recommendation: why it has none, '' where it has one or where the study is part of
            another, which recommends.
    """

    workcell: StoredCell
    robots: tuple[str, ...]
    settings: CampaignSettings
    environment: Mapping[str, str]
    objectives: tuple[str, ...]
    reference_force: Pair
    static_hold: StaticHold
    reference_front: StoredFront
    algorithms: Mapping[str, AlgorithmFigures]
    tests: tuple[RankTest, ...]
    hand_made: SelectedEntry | None = None
    union: PolishedFigures | None = None
    bounds: NormalisationBounds = NormalisationBounds(0, ())
    recommendation: StoredRecommendation | None = None
    no_recommendation: str = ""

    def __post_init__(self) -> None:
        """Refuse what does not belong together."""
        if len(self.robots) != 2:
            raise ValueError("does not name two robots")
        if list(self.algorithms) != list(self.settings.algorithms):
            raise ValueError("its algorithms are not those of its settings")
        for name, entry in self.algorithms.items():
            if len(entry.replicas) != self.settings.replicas:
                raise ValueError(f"algorithms.{name} has not as many replicas as the settings say")
        strays = {name for test in self.tests for name in (test.first, test.second)}
        if not strays <= self.algorithms.keys():
            raise ValueError("its tests name unknown algorithms")

    @property
    def shown_files(self) -> dict[str, Path]:
        """Files of the trajectories that a report shows, in the folders of selected ones and of
        their timings: the hand-made one's by '', the best of every algorithm that has one by its
        name."""
        best = {
            name: entry.replicas[entry.representative]
            for name, entry in self.algorithms.items()
            if entry.representative is not None
        }
        files = {"": Path(HAND_MADE_FILE)}
        for name, found in best.items():
            polished = found.polished is not None and found.polished.selected is not None
            file_of = polished_selected_file if polished else selected_file
            files[name] = file_of(Path(), name, found.replica).relative_to(SELECTED)
        return files

    def answer(self, folder: str) -> StudyAnswer | None:
        """Return what a study opens with: the carry to run, or why there is none; None where
        neither is known.

        Args:
            folder: of the results, as for `studies.study.answer.answer`.
        """
        if self.recommendation is not None:
            return answer(self.recommendation, folder)
        if not self.no_recommendation:
            return None
        why = Fact("why", self.no_recommendation)
        return StudyAnswer("bad", "No carry is recommended", details=(why,))


def read_summary(root: str | Path) -> CampaignSummary:
    """Read the figures of summary.json.

    Raises:
        ResultsError: it is missing, damaged, or not that of the campaign.
    """
    path = Path(root) / SUMMARY
    remedy = f"delete {STAGES}/summary.json in its folder and continue the study with --resume"
    summary = read_record(CampaignSummary, path, remedy)
    if summary.settings != read_configuration(root).settings:
        raise ResultsError(f"{path}: damaged: is that of another campaign; {remedy}")
    return summary


_OF_FRONT = ("non_dominated", "hypervolume", "igd", "igd_plus", "spacing")
_OF_CARRY = ("mean_excess_above_static", "payload_limit")

SUMMARISED_FIGURES = ("feasible", "feasible_share", *_OF_FRONT, "seconds", *_OF_CARRY)
"""Figures of a replica that are summarised over the replicas."""

TESTED = tuple(name for name in SUMMARISED_FIGURES if name not in ("feasible", "seconds"))
"""Figures that the algorithms are compared by; the count says the same as its share."""

POLISHED_FIGURES = (*_OF_FRONT, "seconds", "equivalent_evaluations", "widest_gap", *_OF_CARRY)
"""Figures of a polished front that are summarised over the replicas."""

LEAST_TESTED = 5
"""Replicas from which on algorithms are compared by tests: with fewer, the least p-value that an
exact test can reach, 2 / binomial(2 n, n), is 0.028 or more before any correction."""


def reference_front(fronts: Sequence[Array]) -> Array:
    """Return (k, n_obj) non-dominated union of fronts; of all of a campaign, its reference for
    IGD."""
    return metrics.front_of(np.concatenate(fronts))


def front_indicators(
    front: Array, reference: Array, selected: SelectedCarry | None, file: str | None
) -> dict[str, Any]:
    """Compute the fields of `FrontFigures` for a front's objectives (k, n_obj)."""
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
    replica: Replica, reference: Array, selected: SelectedCarry | None, file: str | None
) -> ReplicaFigures:
    """Return one replica's entry in the summary; figures that do not exist are NaN or infinite."""
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
    """Return the evaluations at which the best of an objective changed: [evaluation, best, ...]."""
    known = history[~np.isnan(history).any(axis=1)]
    first = len(history) - len(known)
    changes = np.flatnonzero((np.diff(known, axis=0) != 0.0).any(axis=1)) + 1
    rows = [0, *changes.tolist()] if len(known) else []
    return tuple(np.array([first + row + 1, *known[row]]) for row in rows)


def carry_entry(carry: Carry, evaluation: int, file: str | None) -> SelectedEntry:
    """Return the entry of an evaluated carry."""
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
    """Compute the figures of the search and of the polish, with the reference front (k, n_obj) and
    per algorithm the entries of `replica_figures`."""
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
        algorithms={name: _algorithm_figures(rows) for name, rows in entries.items()},
        tests=_tests(entries),
    )


def _algorithm_figures(rows: Sequence[ReplicaFigures]) -> AlgorithmFigures:
    def statistics(found: Sequence[FrontFigures], names: Sequence[str]) -> dict[str, Summary]:
        return {name: summarise([getattr(row, name) for row in found]) for name in names}

    # The paper's 'best-performing run'.
    best = max(rows, key=lambda row: row.hypervolume)
    after = [row.polished for row in rows if row.polished is not None]
    polished = None
    if len(after) == len(rows):
        gains = [new.hypervolume - row.hypervolume for row, new in zip(rows, after, strict=True)]
        better = sum(gain > 0.0 for gain in gains)
        known = statistics(after, POLISHED_FIGURES)
        polished = PolishedStatistics(known, summarise(gains), better)
    representative = None if best.selected is None else best.replica
    return AlgorithmFigures(
        representative, statistics(rows, SUMMARISED_FIGURES), tuple(rows), polished
    )


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
    """Return the stage that computes the figures of a finished search; `not_asked` is the reason of
    a study without a recommendation."""

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
            polished = results.polished(*key)
            if polished is not None:
                entry = replace(entry, polished=_polished_figures(folder, polished, reference))
                best[-1] = polished.x
            entries[replica.algorithm].append(entry)
            advance(1)

    def write(name: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        write_atomically(folder.root / FRONTS / name, csv_text(header, rows).encode())

    names = results.objectives
    write(reference_front_file(folder.root).name, names, reference.tolist())
    for name in results.algorithms:
        fronts = [replica.front for replica in results.of(name)]
        write(f"{name}.csv", names, reference_front(fronts).tolist())
        if len(names) in (2, 3):
            surfaces = attainment_surfaces(fronts, PERCENTILES)
            levels = [[f"{p:g}", *row] for p, rows in surfaces.items() for row in rows.tolist()]
            write(f"{name}-attainment.csv", ["percentile", *names], levels)
    union = results.polished(UNION)
    hand_made = _store_hand_made(folder)
    members = np.concatenate(best) if union is None else union.x
    choice = read_recommendation(folder.root)
    reason = choice.reason if isinstance(choice, NoRecommendation) else ""
    summary = replace(
        campaign_summary(results, reference, folder.cell.static_hold, entries),
        hand_made=hand_made,
        union=None if union is None else _polished_figures(folder, union, reference),
        bounds=NormalisationBounds(len(members), binding_bounds(folder.workcell.task, members)),
        recommendation=None if isinstance(choice, NoRecommendation) else choice,
        no_recommendation=reason if choice else not_asked,
    )
    write_json(folder.root / SUMMARY, to_json(summary))


def _polished_figures(folder: CampaignFolder, front: Front, reference: Array) -> PolishedFigures:
    """Compute the figures of a polished front, and store its selected trajectory."""
    assert front.polished is not None
    chosen = select(folder.cell.evaluator, front.x)
    path = polished_selected_file(folder.root, *front.key)
    file = _store_selected(folder, path, front.key, chosen)
    found = front_indicators(front.objectives, reference, chosen, file)
    return PolishedFigures(**found, **vars(front.polished.effort))


def _store_hand_made(folder: CampaignFolder) -> SelectedEntry | None:
    """Write the workcell file's own trajectory, feasible or not, beside the selected ones; its
    figures, None where it has not all of them."""
    carry = folder.cell.carry(folder.cell.initial)
    source = {"source": "the workcell file's initial trajectory"}
    file = _store(folder, folder.root / SELECTED / HAND_MADE_FILE, carry, source)
    entry = carry_entry(carry, 0, file)
    numbers = [entry.objectives, entry.peak_normal_force, entry.minimum_normal_force]
    every = np.concatenate([*numbers, [entry.payload_limit, entry.duration]])
    return entry if np.isfinite(every).all() else None


def _store_selected(
    folder: CampaignFolder, path: Path, replica: tuple[str, int], selected: SelectedCarry | None
) -> str | None:
    """Write a selected trajectory; returns its path in the folder, None where there is none."""
    if selected is None:
        return None
    provenance = {
        "algorithm": replica[0],
        "replica": replica[1],
        "row": selected.row,
        "settings": to_json(folder.settings),
    }
    return _store(folder, path, selected.carry, provenance)


def _store(folder: CampaignFolder, path: Path, carry: Carry, provenance: Mapping[str, Any]) -> str:
    """Write a judged carry; returns its path in the folder."""
    with storing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    # An infeasible one may be without some of its figures.
    known = {name: value for name, value in carry.figures.items() if np.isfinite(value)}
    write_trajectory(path, folder.cell.compiled, carry.x, known, provenance)
    return path.relative_to(folder.root).as_posix()
