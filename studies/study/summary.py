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
from hybrid_opt.evaluate.objectives import front_of
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
from hybrid_opt.polishing.front import PolishEffort
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
    """Figures of the carry selected from a front, or of the hand-made trajectory.

    Attributes:
        evaluation: number of the candidate in the order of evaluation, from 1; 0 for the hand-made
            trajectory.
        file: path of the trajectory file, relative to the results folder; None without a file.
        objectives: (n_obj,) values of the objectives.
        peak_normal_force, minimum_normal_force: largest and least normal force of each robot [N].
        excess_above_static: (2,) largest normal force of each robot above its force for the level
            payload at rest [%].
        payload_limit: largest payload that both robots can carry on the same motion [kg].
        duration: duration of the carry [s].
        feasible: whether the trajectory satisfies all constraints.
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
        """Mean of `excess_above_static` over both robots [%]."""
        return float(self.excess_above_static.mean())


@dataclass(frozen=True)
class FrontFigures:
    """Indicators of a front, and the carry selected from it.

    Attributes:
        non_dominated: number of points of the front.
        hypervolume, igd, igd_plus, spacing: indicators as defined in
            `hybrid_opt.indicators.metrics`.
        mean_excess_above_static: excess of the selected carry's largest normal forces over the
            forces at rest, mean of both robots [%].
        payload_limit: largest payload on the motion of the selected carry [kg].
        selected: the selected carry; None without a feasible candidate.
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
    """Indicators of a polished front, and the effort of the polish."""


@dataclass(frozen=True)
class ReplicaFigures(FrontFigures):
    """Figures of one replica: one search with its own random seed.

    Attributes:
        replica: number of the replica, from 0.
        evaluations, feasible, feasible_share: number of candidates, and number and share of
            feasible ones.
        seconds: duration of the search [s].
        infeasible_by_reason: number of candidates by the constraint violated first.
        best_so_far: rows of `best_steps`: number of an evaluation, then best values up to it.
        polished: figures of the polished front; None without a polish.
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
    """Statistics of an algorithm's polished fronts over its replicas: `statistics` of each figure
    by name, the gain in hypervolume by the polish, and the number of replicas with a gain."""

    statistics: Mapping[str, Summary]
    hypervolume_gain: Summary
    replicas_improved: Count


@dataclass(frozen=True)
class AlgorithmFigures:
    """Figures of one algorithm.

    Attributes:
        representative: number of the replica with the largest hypervolume; None without a feasible
            candidate.
        statistics: statistics over the replicas by the name of the figure.
        replicas: the replicas in order.
        polished: statistics of the polished fronts, None where they were not all polished.
    """

    representative: int | None
    statistics: Mapping[str, Summary]
    replicas: tuple[ReplicaFigures, ...]
    polished: PolishedStatistics | None = None

    def __post_init__(self) -> None:
        """Raise a ValueError without replicas, or if the representative replica has no selected
        solution."""
        if not self.replicas:
            raise ValueError("has no replicas")
        if self.representative is not None and not (
            0 <= self.representative < len(self.replicas)
            and self.replicas[self.representative].selected is not None
        ):
            raise ValueError("its representative replica selected no solution")


@dataclass(frozen=True)
class StoredFront:
    """File and figures of a campaign's reference front: path, number of points, and hypervolume."""

    file: str
    points: Count
    hypervolume: float


@dataclass(frozen=True)
class NormalisationBounds:
    """Bounds of the decision variables on which points of the best fronts lie.

    Attributes:
        solutions: number of points: of the polished union if there is one, else of the final fronts
            of all replicas.
        binding: bounds on which at least one point lies.
    """

    solutions: Count
    binding: tuple[BindingBound, ...]


@dataclass(frozen=True)
class CampaignSummary:
    """summary.json: all figures of a campaign.

    Attributes:
        robots: names of both robots, in the order of all pairs of values.
        hand_made: the workcell file's initial trajectory, None if not all its figures are finite.
        union: polished union of all fronts of a drivable experiment; None without one.
        recommendation: the recommended carry; None without one.
        no_recommendation: the reason why none is recommended; '' if one is, or if the experiment is
            the drivable part of another study, which recommends.
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
        """Raise a ValueError unless there are two robots, the algorithms and replicas are those of
        the settings, and the tests name known algorithms."""
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
        """File paths of the trajectories that a report shows, by algorithm.

        These are the best trajectory of each algorithm that has one and, under the key '', the
        hand-made trajectory. Each path is relative: it names the trajectory in `selected/` and its
        timing in `timing/`.
        """
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
        """Return the study's result in words: the recommended carry, or the reason why there is
        none; None if neither is stored.

        Args:
            folder: path of the results, put in front of the files' names; '' if it is the working
                folder.
        """
        if self.recommendation is not None:
            return answer(self.recommendation, folder)
        if not self.no_recommendation:
            return None
        why = Fact("why", self.no_recommendation)
        return StudyAnswer("bad", "No carry is recommended", details=(why,))


def read_summary(root: str | Path) -> CampaignSummary:
    """Read summary.json from the results folder `root`.

    Raises:
        ResultsError: the file is missing, damaged, or that of a campaign with other settings.
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
"""Names of a replica's figures whose statistics over the replicas are computed."""

TESTED = tuple(name for name in SUMMARISED_FIGURES if name not in ("feasible", "seconds"))
"""Names of the figures that statistical tests compare between algorithms; the number of feasible
candidates is left out because the feasible share says the same."""

POLISHED_FIGURES = (*_OF_FRONT, "seconds", "equivalent_evaluations", "widest_gap", *_OF_CARRY)
"""Names of a polished front's figures whose statistics over the replicas are computed."""

LEAST_TESTED = 5
"""Least number of replicas for tests between algorithms. With fewer, the least p-value that an
exact test can reach, 2 / binomial(2 n, n), is 0.028 or more before any correction."""


def reference_front(fronts: Sequence[Array]) -> Array:
    """Return the non-dominated points (k, n_obj) of the union of fronts, each (n, n_obj). The union
    of all fronts of a campaign gives its reference front for the IGD."""
    return front_of(np.concatenate(fronts))


def front_indicators(
    front: Array, reference: Array, selected: SelectedCarry | None, file: str | None
) -> dict[str, Any]:
    """Return the attributes of `FrontFigures` by name.

    Args:
        front: (n, n_obj) objectives of the front.
        reference: (k, n_obj) reference front for the IGD.
        selected: the selected carry, None without a feasible candidate.
        file: path of its trajectory file, relative to the results folder; None without one.
    """
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
    """Return the figures of one replica. Without a feasible candidate, indicators of the front and
    figures of the selected carry are NaN or infinite.

    Args:
        replica: the stored search.
        reference: (k, n_obj) reference front for the IGD.
        selected: the selected carry, None without a feasible candidate.
        file: path of its trajectory file, relative to the results folder; None without one.
    """
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
    """Return one row for every evaluation that changed the best value of an objective: its number,
    from 1, then the best value of each objective.

    Args:
        history: (n, n_obj) best values after every evaluation, NaN before the first feasible one.
    """
    known = history[~np.isnan(history).any(axis=1)]
    first = len(history) - len(known)
    changes = np.flatnonzero((np.diff(known, axis=0) != 0.0).any(axis=1)) + 1
    rows = [0, *changes.tolist()] if len(known) else []
    return tuple(np.array([first + row + 1, *known[row]]) for row in rows)


def carry_entry(carry: Carry, evaluation: int, file: str | None) -> SelectedEntry:
    """Return the summary's record of an evaluated carry.

    Args:
        carry: the carry.
        evaluation: number of the candidate among all evaluated, from 1; 0 for the hand-made one.
        file: path of the carry's trajectory file, relative to the results folder; None without one.
    """
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
    """Return the summary of a campaign from the figures of its replicas.

    Args:
        results: the campaign's results folder.
        reference: (k, n_obj) reference front.
        static: forces and payload limit of the level payload at rest.
        entries: per algorithm the figures of its replicas.
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
    """Compare every pair of algorithms in every figure of `TESTED` by rank tests, with p-values
    corrected together by Holm's method. Empty with fewer than `LEAST_TESTED` replicas."""
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
"""Percentiles of the attainment surfaces that are written [% of the replicas]."""


def summary_stage(not_asked: str = "") -> Stage:
    """Return the stage of a study that computes summary.json of a finished search.

    Args:
        not_asked: sentence that the summary states in place of a recommendation if none was
            requested; '' if one was.
    """

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
    """Return the figures of a polished front, and write to `folder` the trajectory file of the
    carry selected from it. `reference` (k, n_obj) is the reference front for the IGD."""
    assert front.polished is not None
    chosen = select(folder.cell.evaluator, front.x)
    path = polished_selected_file(folder.root, *front.key)
    file = _store_selected(folder, path, front.key, chosen)
    found = front_indicators(front.objectives, reference, chosen, file)
    return PolishedFigures(**found, **vars(front.polished.effort))


def _store_hand_made(folder: CampaignFolder) -> SelectedEntry | None:
    """Write the trajectory file of the workcell file's initial trajectory, feasible or not. Return
    the record of the trajectory, None if one of its figures is not finite."""
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
    """Write the trajectory file of a carry selected from a `replica` (algorithm, number). Return
    its path relative to the results folder, None without a selected carry."""
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
    """Write the trajectory file of an evaluated carry to the path `path` in `folder`. `provenance`
    has JSON values on its origin. Return its path relative to the results folder."""
    with storing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    # An infeasible one may be without some of its figures.
    known = {name: value for name, value in carry.figures.items() if np.isfinite(value)}
    write_trajectory(path, folder.cell.compiled, carry.x, known, provenance)
    return path.relative_to(folder.root).as_posix()
