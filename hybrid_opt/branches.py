"""Choice of a cell's start branches: pairs of branches, one for each arm, compete for evaluations.

The competition is successive halving (Karnin, Koren and Somekh, ICML 2013): in every round all
remaining pairs get the same number of evaluations, and the better half of them remains. A pair is
ranked by the hypervolume of the carries that it has found so far; a pair without a feasible carry,
by its least penalised objectives. All rounds of a pair form one search: each round begins with the
pair's best candidates.

In drivable cells, whose carries are timed from rest to rest within all limits, pairs are compared
under the time law 'ramped', from rest to rest. Which obstacles the arms hit and what they reach
does not depend on the time law, and 'ramped' candidates are evaluated faster, several at a time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from math import ceil, log2

import numpy as np

from hybrid_opt.cell import Cell
from hybrid_opt.evaluate.evaluation import CandidateEvaluator, Evaluations, concatenated
from hybrid_opt.evaluate.objectives import PAPER_OBJECTIVES, front_rows
from hybrid_opt.indicators.metrics import REFERENCE_POINT, hypervolume
from hybrid_opt.metaheuristics.run import SearchSettings, search_carries
from hybrid_opt.progress import ShowProgress, progress_bar
from symbolic.array import Array
from symbolic.errors import SettingsError, WorkcellError
from symbolic.functions import CONSTRAINTS
from symbolic.records import SEARCHED_BRANCH
from symbolic.records.time_law import RAMPED

SAMPLED = 32
"""Number of random candidates tried with each pair of start branches. A pair takes part only if
both arms can follow one of them, or the hand-made trajectory."""

LEAST_EVALUATIONS = 24
"""Least number of evaluations of a pair in one round; fewer would not allow a comparison."""

BEST = 10
"""Number of a pair's best candidates with which its next round starts."""

_HOLDING = [
    k
    for k, name in enumerate(CONSTRAINTS)
    if name.startswith(("reach", "joint_limits", "singularity"))
]


@dataclass(frozen=True)
class PairResult:
    """Result of one pair of start branches, one branch for each robot.

    Attributes:
        branches: for each robot, index of its branch in the ranked list of its branches.
        rounds: number of rounds in which the pair took part; 0 if the arms could follow none of the
            trajectories that were tried before the first round.
        evaluations: number of candidates evaluated with the pair.
        feasible_share: share of these candidates that are feasible.
        hypervolume: hypervolume of the front of these candidates; 0 if none is feasible.
        least_penalty: mean over the penalised objectives, the least of these candidates.
    """

    branches: tuple[int, int]
    rounds: int
    evaluations: int
    feasible_share: float
    hypervolume: float
    least_penalty: float


@dataclass(frozen=True)
class BranchCompetition:
    """Result of a competition between pairs of start branches.

    Attributes:
        pairs: results of all pairs, the best first: sorted by number of rounds, then hypervolume,
            then least penalised objectives.
        evaluations: number of candidates evaluated with all pairs together.
        law: name of the time law under which candidates were evaluated.
    """

    pairs: tuple[PairResult, ...]
    evaluations: int
    law: str

    @property
    def winner(self) -> tuple[int, int]:
        """(2,) index of each robot's start branch in the best pair, as in `PairResult.branches`."""
        return self.pairs[0].branches

    def __str__(self) -> str:
        first = self.pairs[0]
        tried = [pair for pair in self.pairs if pair.rounds]
        text = (
            f"start branches {first.branches[0]} and {first.branches[1]}, best of "
            f"{len(tried)} pairs in {self.evaluations} evaluations under the time law "
            f"{self.law}, those by which {len(self.pairs)} pairs were tried out included: "
        )
        if not first.hypervolume:
            return f"{text}no pair found a feasible carry, least penalty {first.least_penalty:.4f}"
        text = f"{text}hypervolume {first.hypervolume:.4f}"
        if len(tried) == 1:
            return text
        second = max(tried[1:], key=lambda pair: pair.hypervolume)
        if not second.hypervolume:
            return f"{text}; the others found no feasible carry"
        return (
            f"{text}, {first.hypervolume - second.hypervolume:.4f} more than branches "
            f"{second.branches[0]} and {second.branches[1]}"
        )


class _Pair:
    """A pair of start branches, one for each arm, with all candidates evaluated so far."""

    def __init__(self, branches: tuple[int, int], evaluator: CandidateEvaluator) -> None:
        self.branches, self.evaluator = branches, evaluator
        self.rounds = 0
        self._parts: list[Evaluations] = []

    def search(self, algorithm: str, evaluations: int, rng: np.random.Generator) -> None:
        """Search with this pair of start branches, as one more round of the competition.

        The first generation contains the pair's best candidates of earlier rounds.

        Args:
            algorithm: name of the search algorithm.
            evaluations: number of candidates to evaluate.
            rng: random generator.
        """
        known = concatenated(self._parts)
        order = np.argsort(known.penalised.mean(axis=1), kind="stable")
        settings = SearchSettings(initial=known.x[order[: min(BEST, evaluations)]])
        found, _ = search_carries(self.evaluator, algorithm, evaluations, rng, settings)
        self._parts.append(found)
        self.rounds += 1

    def try_out(self, x: Array) -> bool:
        """Evaluate candidates with this pair of start branches; return True if both arms can follow
        at least one of them.

        Args:
            x: (n, n_var) decision vectors.
        """
        found = self.evaluator.evaluate(x)
        self._parts.append(found)
        return bool(np.any(np.all(found.violation[:, _HOLDING] <= 0.0, axis=1)))

    def result(self) -> PairResult:
        """Return the result of this pair of start branches: number of evaluations, share of
        feasible candidates, hypervolume of their front and least penalty."""
        known = concatenated(self._parts)
        rows = front_rows(known.objectives, known.feasible)
        volume = hypervolume(known.objectives[rows], REFERENCE_POINT) if len(rows) else 0.0
        return PairResult(
            self.branches,
            self.rounds,
            len(known),
            float(known.feasible.mean()),
            float(volume),
            float(known.penalised.mean(axis=1).min()),
        )


def search_branches(
    cell: Cell,
    *,
    evaluations: int = 2000,
    rng: np.random.Generator,
    algorithm: str = "nsga2",
    progress: ShowProgress = False,
) -> BranchCompetition:
    """Find the best pair of start branches, one for each arm, by a competition.

    In each round every remaining pair gets a search, and the worse half of the pairs is eliminated.
    A pair takes part if the arms can follow at least one trajectory with it: the hand-made one or
    one of some random ones. If a robot's `start_branch` in the workcell file is a number, only this
    branch of the robot takes part.

    Args:
        cell: the cell.
        evaluations: approximate number of evaluations in all. Each pair gets at least
            `LEAST_EVALUATIONS` per round; the random trajectories tried first come in addition.
        rng: random generator; the same state gives the same result.
        algorithm: name of the search algorithm.
        progress: True for a progress bar, or a function that is called with the number of searches
            done and their total.

    Raises:
        SettingsError: the compiled kernel, which a change of start branches needs, is not available
            for this cell; or the cell does not have two objectives.
        WorkcellError: the arms cannot follow any tried trajectory with any pair.
    """
    if cell.workcell.task.law.is_drivable:
        cell = _from_rest_to_rest(cell)
    if len(cell.objective_names) != len(REFERENCE_POINT):
        raise SettingsError(
            "start branches compete by the hypervolume of two objectives", code="objectives"
        )
    model, wanted = cell.compiled.model, cell.workcell.start_branch
    choices = [
        range(len(found)) if branch == SEARCHED_BRANCH else (max(branch, 0),)
        for found, branch in zip(model.branches, wanted, strict=True)
    ]
    tried = np.vstack([cell.initial, cell.random(SAMPLED, rng)])
    pairs: list[_Pair] = []
    out: list[_Pair] = []
    for first, second in product(*choices):
        start = (model.branches[0][first].q, model.branches[1][second].q)
        pair = _Pair((first, second), cell.evaluator.beginning_at(*start))
        (pairs if pair.try_out(tried) else out).append(pair)
    if not pairs:
        raise WorkcellError(
            str(cell.workcell.source),
            (
                "start_branch: no pair of start branches holds the hand-made trajectory or any of "
                f"{SAMPLED} random ones; look at it with studies.inspect",
            ),
        )
    rounds = max(ceil(log2(len(pairs))), 1)
    left, standing = pairs, [len(pairs)]
    while len(standing) < rounds:
        standing.append(ceil(standing[-1] / 2))
    with progress_bar(progress, "start branches", sum(standing)) as advance:
        for _ in range(rounds):
            each = max(evaluations // (rounds * len(left)), LEAST_EVALUATIONS)
            for pair in left:
                pair.search(algorithm, each, rng)
                advance(1)
            left = sorted(left, key=_standing)[: ceil(len(left) / 2)]
    ranked = sorted([*pairs, *out], key=_standing)
    results = tuple(pair.result() for pair in ranked)
    spent = sum(pair.evaluations for pair in results)
    return BranchCompetition(results, spent, cell.workcell.task.law.name)


def _from_rest_to_rest(cell: Cell) -> Cell:
    """Return a drivable cell with the time law 'ramped' and both peak normal forces as objectives.

    Candidates of this cell are evaluated faster, and reach and collide in the same way.
    """
    task = replace(cell.workcell.task, time_law=RAMPED)
    return Cell(replace(cell.workcell, task=task), PAPER_OBJECTIVES, cell.threads)


def _standing(pair: _Pair) -> tuple[float, float, float]:
    result = pair.result()
    return (-float(result.rounds), -result.hypervolume, result.least_penalty)
