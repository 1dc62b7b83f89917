"""MOPSO's parts against hand-made cases, and the whole against its reference figures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pymoo.problems.multi.osy import OSY
from pymoo.problems.multi.zdt import ZDT1

from hybrid_opt.metaheuristics import make, search
from hybrid_opt.metaheuristics.mopso import (
    HypercubeArchive,
    hypercubes,
    reflect,
    replaces_best,
    thin,
    turbulence,
)
from studies.research.analytic import compare
from symbolic.array import Array
from symbolic.errors import SettingsError


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def dominates(a: Array, b: Array) -> bool:
    return bool((a <= b).all() and (a < b).any())


def test_reflection_stops_at_the_bound_and_turns_back() -> None:
    position, velocity = reflect(
        np.array([[1.5, 0.5, -0.25]]), np.array([[0.7, 0.2, -0.5]]), np.zeros(3), np.ones(3)
    )
    np.testing.assert_array_equal(position, [[1.0, 0.5, 0.0]])
    np.testing.assert_array_equal(velocity, [[-0.7, 0.2, 0.5]])


def test_turbulence_strikes_one_coordinate_within_its_reach() -> None:
    lower, upper = np.array([0.0, -2.0, 0.0]), np.array([1.0, 2.0, 10.0])
    position = np.tile([0.5, 0.0, 5.0], (20_000, 1))
    moved = turbulence(position, lower, upper, 0.3, rng()) - position
    struck = moved != 0.0
    assert struck.sum(axis=1).max() == 1
    assert struck.any(axis=1).mean() == pytest.approx(0.3, abs=0.015)
    assert struck.sum(axis=0) / struck.sum() == pytest.approx(1.0 / 3.0, abs=0.03)
    reach = np.abs(moved).max(axis=0)
    assert (reach <= 0.15 * (upper - lower)).all()
    assert (reach > 0.149 * (upper - lower)).all()


@pytest.mark.parametrize(
    ("point", "violation", "best", "best_violation", "share"),
    [
        ([1.0, 1.0], 0.0, [2.0, 2.0], 0.0, 1.0),
        ([1.0, 2.0], 0.0, [2.0, 2.0], 0.0, 1.0),
        ([2.0, 2.0], 0.0, [1.0, 1.0], 0.0, 0.0),
        ([1.0, 2.0], 0.0, [2.0, 1.0], 0.0, 0.5),
        ([1.0, 1.0], 0.0, [1.0, 1.0], 0.0, 0.5),
        ([9.0, 9.0], 0.0, [1.0, 1.0], 0.1, 1.0),
        ([1.0, 1.0], 0.1, [9.0, 9.0], 0.0, 0.0),
        ([9.0, 9.0], 0.1, [1.0, 1.0], 0.2, 1.0),
        ([1.0, 1.0], np.inf, [9.0, 9.0], 0.2, 0.0),
    ],
)
def test_personal_best(
    point: list[float], violation: float, best: list[float], best_violation: float, share: float
) -> None:
    n = 4000
    replaced = replaces_best(
        np.tile(point, (n, 1)),
        np.full(n, violation),
        np.tile(best, (n, 1)),
        np.full(n, best_violation),
        rng(),
    )
    if share in (0.0, 1.0):
        assert replaced.mean() == share
    else:
        assert replaced.mean() == pytest.approx(share, abs=0.03)


def test_hypercubes_of_a_hand_made_case() -> None:
    objectives = np.array([[0.0, 10.0], [0.9, 9.2], [5.0, 5.0], [9.5, 0.4], [10.0, 0.0]])
    cubes = hypercubes(objectives, 10)
    # Cells (0, 9), (0, 9), (5, 5), (9, 0), (9, 0): the greatest values belong to the last cell.
    assert cubes[0] == cubes[1]
    assert cubes[3] == cubes[4]
    assert len(set(cubes)) == 3


@given(
    cubes=st.lists(st.integers(0, 5), min_size=1, max_size=40),
    capacity=st.integers(1, 40),
    seed=st.integers(0, 1000),
    data=st.data(),
)
def test_thinning_levels_the_fullest_cubes(
    cubes: list[int], capacity: int, seed: int, data: st.DataObject
) -> None:
    numbers = np.unique(np.array(cubes), return_inverse=True)[1].astype(np.intp)
    newcomer = np.array(
        data.draw(st.lists(st.booleans(), min_size=len(cubes), max_size=len(cubes)))
    )
    kept = thin(numbers, newcomer, capacity, rng(seed))
    assert len(kept) == min(capacity, len(cubes)) == len(set(kept.tolist()))
    # Oracle: take one from a fullest cube until the capacity is met.
    sizes = np.bincount(numbers)
    while sizes.sum() > capacity:
        sizes[np.argmax(sizes)] -= 1
    left = np.bincount(numbers[kept], minlength=len(sizes))
    np.testing.assert_array_equal(np.sort(left), np.sort(sizes))
    # An old member only goes where no newcomer of its cube stays.
    gone = np.setdiff1d(np.arange(len(cubes)), kept)
    for cube in set(numbers[gone[~newcomer[gone]]].tolist()):
        assert not newcomer[kept[numbers[kept] == cube]].any()


def test_leaders_follow_the_roulette_over_cubes() -> None:
    archive = HypercubeArchive(100, 2, n_var=1, n_obj=2)
    # Cubes of 3, 1 and 1 members on a mutually non-dominated line.
    objectives = np.array([[0.0, 4.0], [0.1, 3.9], [0.2, 3.8], [2.5, 2.5], [4.0, 0.0]])
    archive.update(np.zeros((5, 1)), objectives, np.zeros(5), rng())
    shares = np.bincount(archive.leaders(60_000, rng(1)), minlength=5) / 60_000
    # Cube fitness 10/n: 10/3, 10, 10 of 70/3; members share their cube's chance.
    expected = np.array([1 / 21, 1 / 21, 1 / 21, 3 / 7, 3 / 7])
    np.testing.assert_allclose(shares, expected, atol=0.01)


@given(
    objectives=arrays(np.float64, (30, 2), elements=st.integers(0, 12).map(float)),
    violation=arrays(np.float64, 30, elements=st.sampled_from([0.0, 0.5, 1.0, np.inf])),
    batch=st.integers(1, 30),
)
def test_archive_is_the_non_dominated_set_of_least_violation(
    objectives: Array, violation: Array, batch: int
) -> None:
    archive = HypercubeArchive(1000, 30, n_var=1, n_obj=2)
    labels = np.arange(30.0)[:, None]
    for start in range(0, 30, batch):
        part = slice(start, start + batch)
        archive.update(labels[part], objectives[part], violation[part], rng())
    best = violation.min()
    pool = objectives[(violation == best) & np.isfinite(violation)]
    expected = {tuple(p) for p in pool if not any(dominates(q, p) for q in pool)}
    assert {tuple(p) for p in archive.objectives} == expected
    assert len(archive) == len(expected)
    np.testing.assert_array_equal(
        objectives[archive.decisions[:, 0].astype(int)], archive.objectives
    )


def test_swarm_flies_between_its_place_and_the_leader() -> None:
    """With the social pull alone each coordinate ends between the old place and the leader."""
    problem = ZDT1(n_var=5)
    algorithm = make(
        "mopso",
        {
            "swarm": 30,
            "archive": 1,
            "inertia": 0.0,
            "cognitive": 0.0,
            "mutation_share": 0.0,
        },
    )
    algorithm.setup(problem, termination=("n_eval", 60), seed=1)
    first = algorithm.ask()
    algorithm.evaluator.eval(problem, first, algorithm=algorithm)
    algorithm.tell(infills=first)
    assert len(algorithm.opt) == 1
    leader, place = algorithm.opt[0].X, first.get("X")
    flown = algorithm.ask().get("X")
    low, high = np.minimum(place, leader), np.maximum(place, leader)
    assert ((flown >= low) & (flown <= high)).all()
    fraction = (flown - place) / np.where(leader == place, 1.0, leader - place)
    assert fraction.mean() == pytest.approx(0.5, abs=0.08)


def test_turbulence_fades_over_the_horizon() -> None:
    """A swarm that only turbulence moves comes to rest when the horizon's share is over."""
    jostled = {"inertia": 0.0, "cognitive": 0.0, "social": 0.0, "swarm": 50, "horizon": 2000}
    decisions = search(ZDT1(), make("mopso", jostled), 2000, 1).evaluated.decisions
    swarms = decisions.reshape(40, 50, -1)
    moved = (np.diff(swarms, axis=0) != 0.0).any(axis=2).mean(axis=1)
    # Generation k (from 0) has elapsed k / 40 of the run; half of it is turbulent.
    expected = np.maximum(1.0 - np.arange(39) / 20.0, 0.0) ** 1.5
    np.testing.assert_allclose(moved, expected, atol=0.2)
    assert (moved[20:] == 0.0).all()


def test_the_length_of_the_run_must_be_known() -> None:
    algorithm = make("mopso")
    with pytest.raises(SettingsError, match="'horizon'"):
        algorithm.setup(ZDT1(), termination=("n_gen", 5), seed=1)


def test_archive_and_front_respect_the_capacity() -> None:
    result = search(OSY(), make("mopso", {"archive": 12}), 2000, 2)
    assert 0 < len(result.front) <= 12
    constraints = OSY().evaluate(result.front.decisions, return_values_of=["G"])
    assert (constraints <= 0.0).all()


@pytest.mark.heavy
def test_inside_the_bands_at_1000() -> None:
    problems = ("zdt1", "zdt2", "zdt3", "tnk", "srn", "osy")
    result = compare(problems, [1000], ["mopso", "mopso-turbulent"], seeds=10)
    assert len(result.scores) == 12
    for row in result.scores:
        assert row.hypervolume_verdict in ("inside", "better"), row
        assert row.igd_verdict in ("inside", "better"), row
        assert row.infeasible_in_front == 0


@pytest.mark.slow
@pytest.mark.parametrize(("problem", "evaluations"), [("tnk", 10_000), ("zdt1", 25_000)])
def test_inside_the_bands_of_longer_runs(problem: str, evaluations: int) -> None:
    (row,) = compare([problem], [evaluations], ["mopso"], seeds=4).scores
    assert row.hypervolume_verdict in ("inside", "better")
    assert row.igd_verdict in ("inside", "better")


@pytest.mark.heavy
def test_level_with_nsga2_where_the_optimum_lies_inside() -> None:
    result = compare(["shifted-zdt1"], [1000], ["mopso", "nsga2"], seeds=20)
    volume, distance = result.tests
    assert volume.a12 >= 0.5
    assert distance.a12 <= 0.5
