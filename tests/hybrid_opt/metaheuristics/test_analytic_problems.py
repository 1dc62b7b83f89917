"""Test problems: their reference fronts against known ranges and an independent solver."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from hybrid_opt.indicators import metrics
from hybrid_opt.metaheuristics import analytic_problems

# Ideal, nadir and largest hypervolume of the normalised front, for reference point (1.1, 1.1).
KNOWN = {
    "zdt1": ((0.0, 0.0), (1.0, 1.0), 0.8766),
    "zdt2": ((0.0, 0.0), (1.0, 1.0), 0.5433),
    "zdt3": ((0.0, -0.7734), (0.8518, 1.0), 0.7275),
    "tnk": ((0.0417, 0.0417), (1.0385, 1.0385), 0.5189),
    "srn": ((10.1, -217.74), (222.97, 2.61), 0.7507),
    "osy": ((-274.0, 4.0), (-42.0, 76.0), 0.9689),
    "shifted-zdt1": ((0.0, 0.0), (1.0, 1.0), 0.8766),
}


@pytest.mark.parametrize("name", analytic_problems.names())
def test_front_has_its_known_range_and_volume(name: str) -> None:
    target = analytic_problems.make(name)
    ideal, nadir, volume = KNOWN[name]
    np.testing.assert_allclose(target.ideal, ideal, rtol=2e-4, atol=5e-5)
    np.testing.assert_allclose(target.nadir, nadir, rtol=2e-4, atol=5e-5)
    # A finite sample of the front stays below the limit, by less than its resolution.
    reached = metrics.hypervolume(target.normalise(target.front))
    assert volume - 1e-3 < reached <= volume + 5e-5
    assert metrics.non_dominated(target.front).all()


@pytest.mark.parametrize("name", ["tnk", "srn", "osy"])
def test_front_is_what_a_gradient_solver_finds(name: str) -> None:
    """Least f1 under a bound on f2, by SLSQP from many starts."""
    target = analytic_problems.make(name)
    problem = target.problem
    rng = np.random.default_rng(5)
    extent = target.nadir - target.ideal

    def values(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        f, g = problem.evaluate(x, return_values_of=["F", "G"])
        return (f - target.ideal) / extent, g

    for limit in (0.1, 0.3, 0.55):
        best = np.inf
        for start in rng.uniform(problem.xl, problem.xu, size=(20, problem.n_var)):
            outcome = minimize(
                lambda x: values(x)[0][0],
                start,
                method="SLSQP",
                bounds=list(zip(problem.xl, problem.xu, strict=True)),
                constraints={
                    "type": "ineq",
                    "fun": lambda x, limit=limit: np.append(-values(x)[1], limit - values(x)[0][1]),
                },
            )
            f, g = values(outcome.x)
            if (g <= 1e-7).all() and f[1] <= limit + 1e-7:
                best = min(best, float(f[0]))
        normalised = target.normalise(target.front)
        expected = normalised[normalised[:, 1] <= limit][:, 0].min()
        assert best == pytest.approx(expected, abs=3e-3)


def test_shifted_zdt_has_its_optimum_inside() -> None:
    problem = analytic_problems.make("shifted-zdt1").problem
    optimum = np.concatenate([[0.25], np.linspace(0.2, 0.5, 29)])
    np.testing.assert_allclose(problem.evaluate(optimum), [0.25, 0.5])
    away = optimum.copy()
    away[7] += 0.1
    assert problem.evaluate(away)[1] > 0.5
    away[7] -= 0.2
    assert problem.evaluate(away)[1] > 0.5
