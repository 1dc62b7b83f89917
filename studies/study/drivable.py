"""Fronts of a drivable experiment, read back, and what limits on jerk cost its carries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybrid_opt.campaign.layout import DRIVABLE, POLISHED_SUFFIX
from hybrid_opt.campaign.polish_stage import read_polished
from hybrid_opt.campaign.results import CampaignResults, read_campaign
from hybrid_opt.display.table import text_table
from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.objectives import DRIVABLE_PAIRS
from hybrid_opt.indicators import metrics
from hybrid_opt.indicators.selection import select
from hybrid_opt.timing.document import StoredJerk, read_timing
from hybrid_opt.timing.records import TimingStatus
from studies.study.terminal import number, title
from studies.study.timing import TIMING
from symbolic.array import Array
from symbolic.records import Workcell

POLISHED = ", polished"
"""After an algorithm's title."""

LEAST_FORCE = "least-force"
"""The path that the other experiment ends with, beside which the recommended carry stands."""


@dataclass(frozen=True)
class ReplicaFront:
    """One replica's front, as searched or as polished; arrays are read-only.

    Attributes:
        algorithm, replica: whose it is; replicas count from 0.
        polished: whether it is the polished one.
        x, objectives: (k, n_var) and (k, 2).
    """

    algorithm: str
    replica: int
    polished: bool
    x: Array
    objectives: Array

    @property
    def label(self) -> str:
        """Title of the algorithm, and whether polished."""
        return title(self.algorithm) + (POLISHED if self.polished else "")

    @property
    def source(self) -> str:
        """The label with the number of the replica, as its files have it."""
        return f"{self.label}, replica {self.replica}"


@dataclass(frozen=True)
class DrivableFronts:
    """All fronts of a drivable experiment, and their non-dominated union.

    Attributes:
        results: of the experiment.
        fronts: of all replicas, searched and polished.
        x: (k, n_var) of the union, by increasing duration.
        sources: whose each of the union is.
    """

    results: CampaignResults
    fronts: tuple[ReplicaFront, ...]
    x: Array
    sources: tuple[str, ...]

    def labelled(self) -> dict[str, list[ReplicaFront]]:
        """The fronts by label."""
        found: dict[str, list[ReplicaFront]] = {}
        for front in self.fronts:
            found.setdefault(front.label, []).append(front)
        return found


def known_paths(root: Path) -> Array:
    """Paths (m, n_path) that another experiment ends with: of all polished fronts together the
    balanced one, of each of them both ends and the middle.

    Args:
        root: its results folder.

    Raises:
        ResultsError: the folder is not complete or damaged.
    """
    campaign = read_campaign(root)
    n = campaign.workcell.task.n_path
    found = [path[None] for path in least_force(campaign).values()]
    for replica in campaign.replicas:
        polished = read_polished(root, replica, campaign.workcell)
        if polished is not None and len(polished.x):
            found.append(polished.x[[0, len(polished.x) // 2, -1], :n])
    return np.unique(np.concatenate(found), axis=0) if found else np.empty((0, n))


def least_force(campaign: CampaignResults) -> dict[str, Array]:
    """The balanced path (n_path,) of all fronts of an experiment, by its label; empty where no
    carry was found."""
    fronts = [replica.front_x for replica in campaign.replicas]
    for replica in campaign.replicas:
        polished = read_polished(campaign.root, replica, campaign.workcell)
        if polished is not None:
            fronts.append(polished.x)
    evaluator = CandidateEvaluator(campaign.workcell, campaign.objectives)
    chosen = select(evaluator, np.concatenate(fronts))
    return {} if chosen is None else {LEAST_FORCE: chosen.carry.x[: campaign.workcell.task.n_path]}


def is_drivable(workcell: Workcell, objectives: Sequence[str]) -> bool:
    """Whether an experiment already is the search for carries as robots drive them."""
    return workcell.task.time_law == "optimal" and tuple(objectives) in DRIVABLE_PAIRS


def drivable_root(root: Path, workcell: Workcell, objectives: Sequence[str]) -> Path:
    """Folder of a study's drivable experiment: one inside, unless it is the only experiment.

    Args:
        root: the study's results folder.
        workcell, objectives: of its first experiment.
    """
    return root if is_drivable(workcell, objectives) else root / DRIVABLE


def drivable_fronts(root: Path) -> DrivableFronts:
    """The fronts of a drivable experiment.

    Args:
        root: its own results folder, see `drivable_root`.

    Raises:
        ResultsError: the folder is not complete or damaged.
    """
    results = read_campaign(root)
    fronts = []
    for replica in results.replicas:
        key = replica.algorithm, replica.replica
        fronts.append(ReplicaFront(*key, False, replica.front_x, replica.front))
        polished = read_polished(results.root, replica, results.workcell)
        if polished is not None:
            fronts.append(ReplicaFront(*key, True, polished.x, polished.objectives))
    x = np.concatenate([front.x for front in fronts])
    objectives = np.concatenate([front.objectives for front in fronts])
    sources = [front.source for front in fronts for _ in front.x]
    rows = metrics.front_rows(objectives, np.ones(len(objectives), dtype=bool))
    return DrivableFronts(results, tuple(fronts), x[rows], tuple(sources[row] for row in rows))


NOTE = (
    "Joints and payload within their largest jerk, at rest without acceleration at both ends. "
    "Medians over the carries."
)


@dataclass(frozen=True)
class JerkCosts:
    """Cost of limits on jerk for several carries.

    Attributes:
        label: whose they are.
        carries: how many.
        without, within: median durations without and within the limits [s].
        cost, most: median and largest share of the duration that the limits add.
    """

    label: str
    carries: int
    without: float
    within: float
    cost: float
    most: float

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of a row of the table with `HEAD`."""
        return (
            self.label,
            str(self.carries),
            number(self.without, 3),
            number(self.within, 3),
            number(self.cost, 1, 100.0),
            number(self.most, 1, 100.0),
        )


HEAD = ("limits on jerk", "carries", "without [s]", "within [s]", "cost %", "at most %")


def jerk_costs(root: Path) -> tuple[JerkCosts, ...]:
    """The costs by algorithm, the hand-made carry's first; none where no jerk is limited.

    Args:
        root: results folder of the drivable experiment.

    Raises:
        ResultsError: a timing is damaged.
    """
    found: dict[str, list[StoredJerk]] = {}
    for path in sorted((root / TIMING).rglob("*.json")):
        jerk = read_timing(path).jerk
        if jerk is not None and jerk.status == TimingStatus.OK:
            found.setdefault(_label(path.relative_to(root / TIMING)), []).append(jerk)
    return tuple(_costs(label, timings) for label, timings in found.items())


def jerk_text(costs: Sequence[JerkCosts]) -> str:
    """The costs for a terminal, '' without any."""
    if not costs:
        return ""
    return f"{text_table([HEAD, *(each.cells for each in costs)])}\n{NOTE}"


def _label(path: Path) -> str:
    if len(path.parts) == 1:
        return path.stem
    folder = path.parts[0]
    name = title(folder.removesuffix(POLISHED_SUFFIX))
    return f"{name}, polished" if folder.endswith(POLISHED_SUFFIX) else name


def _costs(label: str, found: Sequence[StoredJerk]) -> JerkCosts:
    within, without = (
        np.array([getattr(jerk, name) for jerk in found]) for name in ("duration", "without")
    )
    cost = within / without - 1.0
    return JerkCosts(
        label,
        len(found),
        float(np.median(without)),
        float(np.median(within)),
        float(np.median(cost)),
        float(cost.max()),
    )
