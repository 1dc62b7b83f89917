"""Search algorithms on analytic problems, beside what a correct MOPSO reaches on them.

ZDT1 to ZDT3 (Zitzler, Deb and Thiele 2000), TNK (Tanaka et al. 1995), SRN (Srinivas and Deb 1994)
and OSY (Osyczka and Kundu 1995) are evaluated by pymoo. Its own reference fronts are fetched
from a network (TNK, OSY) or truncated (SRN), so all fronts come from the optimality conditions
of each problem instead, resampled at equal distances.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import moocore
import numpy as np
from pymoo.core.problem import Problem
from pymoo.problems.multi.osy import OSY
from pymoo.problems.multi.srn import SRN
from pymoo.problems.multi.tnk import TNK
from pymoo.problems.multi.zdt import ZDT, ZDT1, ZDT2, ZDT3

from hybrid_opt import metaheuristics
from hybrid_opt.campaign.settings import sized
from hybrid_opt.display.table import number, text_table
from hybrid_opt.evaluate.objectives import front_of
from hybrid_opt.indicators import metrics
from hybrid_opt.indicators.metrics import normalise
from hybrid_opt.indicators.statistics import RankTest, Summary, corrected, rank_test, summarise
from hybrid_opt.metaheuristics import Evaluated
from studies.research.algorithms import (
    BAND_POPULATION,
    SHIFTED,
    SHIFTED_EVALUATIONS,
    SHIFTED_POPULATION,
)
from symbolic.array import Array
from symbolic.errors import SettingsError

Verdict = Literal["inside", "better", "worse"]


@dataclass(frozen=True)
class Band:
    """Published mean figures of a correct MOPSO on one problem, see `BAND_SOURCE`.

    Attributes:
        hypervolume, igd: means over `BAND_SEEDS` seeds.
        igd_std: standard deviation of the IGD over the seeds; None if not published.
    """

    hypervolume: float
    igd: float
    igd_std: float | None = None


BAND_SEEDS = 10
BAND_SOURCE = (
    "reference runs of an independent implementation of the 2002/2004 algorithm, made when this "
    "program was specified: mean of 10 seeds, swarm and archive 100"
)
BANDS: dict[tuple[str, int], Band] = {
    ("zdt1", 1000): Band(0.00, 1.49),
    ("zdt2", 1000): Band(0.00, 2.34),
    ("zdt3", 1000): Band(0.00, 0.92),
    ("tnk", 1000): Band(0.465, 0.029),
    ("srn", 1000): Band(0.738, 0.0068),
    ("osy", 1000): Band(0.590, 0.241),
    ("zdt1", 10_000): Band(0.278, 0.452),
    ("zdt2", 10_000): Band(0.006, 0.871),
    ("zdt3", 10_000): Band(0.248, 0.335),
    ("tnk", 10_000): Band(0.507, 0.0072),
    ("srn", 10_000): Band(0.741, 0.0060),
    ("osy", 10_000): Band(0.846, 0.156),
    ("zdt1", 25_000): Band(0.628, 0.166, 0.021),
    ("zdt2", 25_000): Band(0.393, 0.091, 0.020),
    ("zdt3", 25_000): Band(0.501, 0.121, 0.026),
    ("tnk", 25_000): Band(0.509, 0.0061),
    ("srn", 25_000): Band(0.739, 0.0067),
    ("osy", 25_000): Band(0.892, 0.133),
}


def judge(
    ours: Summary, reference: float, *, higher_is_better: bool, std: float | None = None
) -> Verdict | None:
    """Compare the mean of an indicator over this project's runs with a published mean.

    Args:
        ours: mean, standard deviation and number of this project's values, one per seed.
        reference: published mean.
        higher_is_better: True if a larger value is better, as for the hypervolume.
        std: published standard deviation; None to use the standard deviation of `ours`.

    Returns:
        'inside' if the means differ by at most three standard errors of their difference, else
        'better' or 'worse'; None with fewer than two seeds.
    """
    if ours.count < 2:
        return None
    reference_std = ours.std if std is None else std
    error = math.sqrt(ours.std**2 / ours.count + reference_std**2 / BAND_SEEDS)
    gain = ours.mean - reference if higher_is_better else reference - ours.mean
    if abs(gain) <= 3.0 * error:
        return "inside"
    return "better" if gain > 0.0 else "worse"


@dataclass(frozen=True)
class Score:
    """Figures of one algorithm on one problem with one budget, over all seeds.

    Attributes:
        problem, algorithm: names of problem and algorithm.
        evaluations: budget of evaluations.
        population: size of the population.
        hypervolume, igd: indicators of the algorithm's final front, which has limited size.
        archive_hypervolume, archive_igd: indicators of all non-dominated points that the algorithm
            evaluated.
        overhead_us: the algorithm's own time per evaluation [us].
        infeasible_in_front: number of members of final fronts that violate a constraint.
        hypervolume_verdict, igd_verdict: verdicts of `judge` against the published band; None if
            there is no band.
    """

    problem: str
    evaluations: int
    algorithm: str
    population: int
    hypervolume: Summary
    igd: Summary
    archive_hypervolume: Summary
    archive_igd: Summary
    overhead_us: float
    infeasible_in_front: int
    hypervolume_verdict: Verdict | None
    igd_verdict: Verdict | None


@dataclass(frozen=True)
class _AlgorithmRun:
    hypervolume: float
    igd: float
    archive_hypervolume: float
    archive_igd: float
    overhead_us: float
    infeasible_in_front: int


def _indicators(target: AnalyticProblem, points: Evaluated) -> tuple[float, float]:
    front = target.normalise(front_of(points.objectives, points.feasible))
    return metrics.hypervolume(front), metrics.igd(front, target.normalise(target.front))


def _run(
    target: AnalyticProblem, name: str, evaluations: int, population: int, seed: int
) -> _AlgorithmRun:
    algorithm = metaheuristics.make(name, sized(name, population))
    result = metaheuristics.search(target.problem, algorithm, evaluations, seed)
    # Judged anew from the decisions: an algorithm's word for feasibility is not enough.
    constraints = target.problem.evaluate(result.front.decisions, return_values_of=["G"])
    return _AlgorithmRun(
        *_indicators(target, result.front),
        *_indicators(target, result.evaluated),
        1e6 * result.algorithm_seconds / evaluations,
        int((constraints > 0.0).any(axis=1).sum()) if target.problem.n_ieq_constr else 0,
    )


def _band(problem: str, evaluations: int, algorithm: str, population: int) -> Band | None:
    """Return the published mean and deviation ('band') with which an algorithm's results on a
    problem are compared, None if there are none.

    They exist for Coello's MOPSO and its variant with the population `BAND_POPULATION`.

    Args:
        problem: name of the test problem.
        evaluations: budget of evaluations.
        algorithm: name of the algorithm.
        population: size of the population.
    """
    applies = algorithm.startswith("mopso") and population == BAND_POPULATION
    return BANDS.get((problem, evaluations)) if applies else None


def _score(
    problem: str, evaluations: int, algorithm: str, population: int, runs: Sequence[_AlgorithmRun]
) -> Score:
    names = ("hypervolume", "igd", "archive_hypervolume", "archive_igd")
    found = {name: summarise([getattr(run, name) for run in runs]) for name in names}
    band = _band(problem, evaluations, algorithm, population)
    hypervolume = igd = None
    if band is not None:
        hypervolume = judge(found["hypervolume"], band.hypervolume, higher_is_better=True)
        igd = judge(found["igd"], band.igd, higher_is_better=False, std=band.igd_std)
    return Score(
        problem,
        evaluations,
        algorithm,
        population,
        **found,
        overhead_us=sum(run.overhead_us for run in runs) / len(runs),
        infeasible_in_front=sum(run.infeasible_in_front for run in runs),
        hypervolume_verdict=hypervolume,
        igd_verdict=igd,
    )


@dataclass(frozen=True)
class AlgorithmTest:
    """Result of a comparison of algorithms on test problems.

    Attributes:
        seeds: number of seeds.
        scores: figures of every algorithm, problem and budget.
        tests: rank tests between the first algorithm and each other one on `ShiftedZdt1`, first of
            the hypervolume, then of the IGD; p-values corrected by Holm's method.
    """

    seeds: int
    scores: tuple[Score, ...]
    tests: tuple[RankTest, ...]


def compare(
    problems: Sequence[str],
    budgets: Sequence[int],
    names: Sequence[str],
    seeds: int,
    population: int = BAND_POPULATION,
    progress: bool = False,
) -> AlgorithmTest:
    """Run every algorithm on every problem with every budget and the seeds 0, 1, ...

    The problem `SHIFTED`, whose optimum lies inside the bounds, is run once per algorithm with its
    own budget and population in place of the given ones.

    Args:
        problems: names of the problems.
        budgets: numbers of evaluations.
        names: names of the algorithms.
        seeds: number of seeds.
        population: size of the population.
        progress: True to print the progress.

    Raises:
        SettingsError: unknown names, no seeds, or a budget below the population.
    """
    for name in names:
        metaheuristics.settings_of(name)
    targets = [make(problem) for problem in problems]
    if seeds < 1 or min(budgets) < population:
        raise SettingsError(
            f"{seeds} seeds of {min(budgets)} evaluations; at least 1 seed and {population} "
            "evaluations (the population) are needed"
        )
    tasks = [
        (target, budget, name, population)
        for target in targets
        if target.name != SHIFTED
        for budget in budgets
        for name in names
    ] + [
        (target, SHIFTED_EVALUATIONS, name, SHIFTED_POPULATION)
        for target in targets
        if target.name == SHIFTED
        for name in names
    ]
    scores: list[Score] = []
    shifted: dict[str, list[_AlgorithmRun]] = {}
    start = time.perf_counter()
    for done, (target, budget, name, size) in enumerate(tasks, 1):
        runs = [_run(target, name, budget, size, seed) for seed in range(seeds)]
        scores.append(_score(target.name, budget, name, size, runs))
        if target.name == SHIFTED:
            shifted[name] = runs
        if progress:
            elapsed = time.perf_counter() - start
            print(
                f"{done}/{len(tasks)} {target.name} {budget} {name}, {elapsed:.0f} s",
                file=sys.stderr,
            )
    return AlgorithmTest(seeds, tuple(scores), _tests(shifted))


def _tests(shifted: dict[str, list[_AlgorithmRun]]) -> tuple[RankTest, ...]:
    tests = []
    for name in list(shifted)[1:]:
        first, others = next(iter(shifted)), shifted[name]
        for figure in ("hypervolume", "igd"):
            ours = [getattr(run, figure) for run in shifted[first]]
            theirs = [getattr(run, figure) for run in others]
            labels = (f"{first} {figure}", f"{name} {figure}")
            tests.append(rank_test(ours, theirs, labels))
    return corrected(tests)


def table(result: AlgorithmTest) -> str:
    """Return the results of `compare` as text, with their comparison with published values."""
    lines = [
        f"Mean over {result.seeds} seeds of the final front (limited size) and of all evaluated "
        "points",
        f"Bands: {BAND_SOURCE}",
        text_table([_HEADINGS, *map(_cells, result.scores)], left=(0, 3, 7, 11)),
    ]
    for name in dict.fromkeys(score.algorithm for score in result.scores):
        scores = [score for score in result.scores if score.algorithm == name]
        judged = ((score.hypervolume_verdict, score.igd_verdict) for score in scores)
        verdicts = [verdict for both in judged for verdict in both if verdict]
        if verdicts:
            counts = ", ".join(f"{verdicts.count(v)} {v}" for v in ("inside", "better", "worse"))
            lines.append(f"{name} against the bands: {counts}")
    infeasible = sum(score.infeasible_in_front for score in result.scores)
    lines.append(f"infeasible members of final fronts: {infeasible}")
    if result.tests:
        lines.append(
            f"{SHIFTED}, {SHIFTED_EVALUATIONS} evaluations, population {SHIFTED_POPULATION}:"
        )
    lines += [
        f"  {test.first} against {test.second}: A12 {test.a12:.2f} ({test.magnitude}), "
        f"exact Mann-Whitney p {test.p:.3g}, Holm {test.p_holm:.3g}"
        for test in result.tests
    ]
    return "\n".join(lines)


_HEADINGS = (
    *("problem", "evals", "pop", "algorithm"),
    *("HV", "sd", "band", "verdict", "IGD", "sd", "band", "verdict"),
    *("HV all", "IGD all", "us/eval"),
)


def _cells(score: Score) -> tuple[str, ...]:
    band = _band(score.problem, score.evaluations, score.algorithm, score.population)
    return (
        score.problem,
        str(score.evaluations),
        str(score.population),
        score.algorithm,
        number(score.hypervolume.mean, 3),
        number(score.hypervolume.std, 3),
        number(band.hypervolume, 3) if band else "",
        score.hypervolume_verdict or "",
        number(score.igd.mean, 4),
        number(score.igd.std, 4),
        number(band.igd, 4) if band else "",
        score.igd_verdict or "",
        number(score.archive_hypervolume.mean, 3),
        number(score.archive_igd.mean, 4),
        number(score.overhead_us, 1),
    )


def algorithms(options: argparse.Namespace) -> int:
    """Run the comparison that the options request, and print it. Return the exit code."""
    result = compare(
        options.problems,
        options.evaluations,
        options.algorithms,
        options.seeds,
        options.population,
        progress=True,
    )
    if options.json:
        document = asdict(result)
        print(json.dumps({"band_source": BAND_SOURCE, **document}, indent=2))
    else:
        print(table(result))
    return 0


_FRONT_POINTS = 1000
_DENSE = 200_001


class ShiftedZdt1(ZDT):  # type: ignore[misc]
    """ZDT1 with its optimum inside the bounds.

    x_i* for i >= 2 runs evenly from 0.2 to 0.5, and the distance function g uses |x_i - x_i*|.
    ZDT's optimum on the bounds favours algorithms that clamp to them.
    """

    def _evaluate(self, x: Array, out: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        optimum = np.linspace(0.2, 0.5, self.n_var - 1)
        first = x[:, 0]
        distance = 1.0 + 9.0 * np.abs(x[:, 1:] - optimum).mean(axis=1)
        out["F"] = np.column_stack([first, distance * (1.0 - np.sqrt(first / distance))])


@dataclass(frozen=True)
class AnalyticProblem:
    """A test problem and its true front.

    Attributes:
        name: name of the problem, as in `PROBLEMS`.
        problem: the problem as an object of pymoo.
        front: (n, 2) objectives of the reference front, evenly spaced.
        ideal, nadir: (2,) least and greatest value of each objective on the front; they normalise
            objectives for hypervolume and IGD.
    """

    name: str
    problem: Problem
    front: Array
    ideal: Array
    nadir: Array

    def normalise(self, objectives: Array) -> Array:
        """Scale objectives (n, 2) such that the range of the front becomes the unit square."""
        return normalise(objectives, self.ideal, self.nadir)


def make(name: str) -> AnalyticProblem:
    """Build a test problem with its reference front.

    Raises:
        SettingsError: the name is unknown.
    """
    if name not in PROBLEMS:
        raise SettingsError(f"unknown test problem '{name}'; known are {', '.join(PROBLEMS)}")
    problem, curve = PROBLEMS[name]
    front = _evenly(curve())
    front.setflags(write=False)
    return AnalyticProblem(name, problem(), front, front.min(axis=0), front.max(axis=0))


def _evenly(curve: Array) -> Array:
    """Return the non-dominated points (k, 2) of a dense curve, at equal arc lengths along each
    connected piece.
    """
    front = moocore.filter_dominated(curve)
    front = front[np.argsort(front[:, 0], kind="stable")]
    step = np.linalg.norm(np.diff(front / np.ptp(front, axis=0), axis=0), axis=1)
    # A jump between two pieces of a disconnected front has no length of its own.
    step[step > 1e-3] = 0.0
    length = np.concatenate([[0.0], np.cumsum(step)])
    chosen = np.searchsorted(length, np.linspace(0.0, length[-1], _FRONT_POINTS))
    return np.asarray(front[np.minimum(chosen, len(front) - 1)])


def _zdt1_front() -> Array:
    # Quadratic spacing: the slope is unbounded at f1 = 0.
    f1 = np.linspace(0.0, 1.0, _DENSE) ** 2
    return np.column_stack([f1, 1.0 - np.sqrt(f1)])


def _zdt2_front() -> Array:
    f1 = np.linspace(0.0, 1.0, _DENSE)
    return np.column_stack([f1, 1.0 - f1**2])


def _zdt3_front() -> Array:
    f1 = np.linspace(0.0, 1.0, _DENSE) ** 2
    return np.column_stack([f1, 1.0 - np.sqrt(f1) - f1 * np.sin(10.0 * np.pi * f1)])


def _tnk_front() -> Array:
    """Sample the reference front (k, 2) of the test problem TNK.

    The curved constraint is active on the front; the circular constraint cuts pieces out.
    """
    angle = np.linspace(0.0, 0.5 * np.pi, _DENSE)
    # arctan(x1 / x2) is the angle from the x2 axis.
    radius = np.sqrt(1.0 + 0.1 * np.cos(16.0 * angle))
    points = np.column_stack([radius * np.sin(angle), radius * np.cos(angle)])
    return np.asarray(points[((points - 0.5) ** 2).sum(axis=1) <= 0.5])


def _srn_front() -> Array:
    """Sample the reference front (k, 2) of the test problem SRN.

    Its decision variables run from the point nearest to (2, 1) on the constraint's line, up x1 =
    -2.5, then along the constraint's circle.
    """
    line_x2 = np.linspace(2.5, 3.7, _DENSE)
    line = np.column_stack([3.0 * line_x2 - 10.0, line_x2])
    column_x2 = np.linspace(2.5, np.sqrt(225.0 - 2.5**2), _DENSE)
    column = np.column_stack([np.full(_DENSE, -2.5), column_x2])
    angle = np.linspace(np.arccos(-2.5 / 15.0), np.pi, _DENSE)
    circle = 15.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    x1, x2 = np.concatenate([line, column, circle]).T
    return np.column_stack([2.0 + (x1 - 2.0) ** 2 + (x2 - 1.0) ** 2, 9.0 * x1 - (x2 - 1.0) ** 2])


def _osy_front() -> Array:
    """Sample the reference front (k, 2) of the test problem OSY: five pieces with x4 = x6 = 0.

    Source: Deb 2001, Multi-objective optimization, section 8.3.3.
    """
    s = np.linspace(0.0, 1.0, _DENSE // 5)
    one, zero = np.ones_like(s), np.zeros_like(s)
    bend = np.linspace(37.0 / 9.0 - 1.0 / 18.0, 5.0, len(s))
    pieces = (
        (5.0 * one, one, 1.0 + 4.0 * s, 5.0 * one),
        (5.0 * one, one, 1.0 + 4.0 * s, one),
        (bend, (bend - 2.0) / 3.0, one, one),
        (zero, 2.0 * one, 1.0 + (np.sqrt(3.0) + 1.0) * s, one),
        (s, 2.0 - s, one, one),
    )
    x1, x2, x3, x5 = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    x = np.column_stack([x1, x2, x3, zero.repeat(len(pieces)), x5, zero.repeat(len(pieces))])
    x4 = x[:, 3]
    f1 = -(
        25.0 * (x1 - 2.0) ** 2
        + (x2 - 2.0) ** 2
        + (x3 - 1.0) ** 2
        + (x4 - 4.0) ** 2
        + (x5 - 1.0) ** 2
    )
    return np.column_stack([f1, (x**2).sum(axis=1)])


PROBLEMS: dict[str, tuple[Callable[[], Problem], Callable[[], Array]]] = {
    "zdt1": (ZDT1, _zdt1_front),
    "zdt2": (ZDT2, _zdt2_front),
    "zdt3": (ZDT3, _zdt3_front),
    "tnk": (TNK, _tnk_front),
    "srn": (SRN, _srn_front),
    "osy": (OSY, _osy_front),
    "shifted-zdt1": (ShiftedZdt1, _zdt1_front),
}
