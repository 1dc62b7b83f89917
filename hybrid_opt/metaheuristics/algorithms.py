"""Search algorithms on pymoo's interface: NSGA-II, SMS-EMOA and uniform random search.

They guarantee more than pymoo's: an exact number of evaluations and finite fronts. MOPSO is in
`hybrid_opt.metaheuristics.mopso`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import moocore
import numpy as np
from pymoo.algorithms.moo.nsga2 import NSGA2
from pymoo.algorithms.moo.sms import SMSEMOA
from pymoo.core.algorithm import Algorithm
from pymoo.core.duplicate import DefaultDuplicateElimination
from pymoo.core.mating import Mating
from pymoo.core.population import Population
from pymoo.core.problem import Problem
from pymoo.operators.crossover.sbx import SBX
from pymoo.operators.mutation.pm import PM
from pymoo.operators.sampling.rnd import FloatRandomSampling
from pymoo.operators.selection.tournament import TournamentSelection
from pymoo.termination.max_eval import MaximumFunctionCallTermination

from symbolic.array import Array, Range, require_allowed
from symbolic.errors import SettingsError

Share = Annotated[float, Range(0.0, 1.0)]
Points = Annotated[int, Range(1, 100_000)]
Index = Annotated[float, Range(1.0, 1000.0)]

WORST_OBJECTIVE = 1e30
"""Value in place of an objective that is not finite. Every real point dominates it, and unlike
infinity it keeps differences and normalisations finite."""


def violation_of(objectives: Array, constraints: Array) -> Array:
    """Compute the total constraint violation of evaluated points.

    Args:
        objectives: (n, n_obj) objectives.
        constraints: (n, n_con) constraint values, satisfied where <= 0; n_con may be 0.

    Returns:
        (n,) sum of the positive constraint values, 0 if feasible. It is infinite if any objective
        is NaN or reaches `WORST_OBJECTIVE` in magnitude, or if any constraint is not finite.
    """
    total = np.maximum(constraints, 0.0).sum(axis=1)
    sound = (np.abs(objectives) < WORST_OBJECTIVE).all(axis=1) & np.isfinite(constraints).all(
        axis=1
    )
    return np.where(sound, total, np.inf)


def feasible_front(points: Population) -> Population:
    """Return the feasible members of a population that no other feasible member dominates, without
    duplicates."""
    if len(points) == 0:
        return points
    feasible = points[points.get("CV")[:, 0] == 0.0]
    if len(feasible) == 0:
        return Population.empty()
    return feasible[moocore.is_nondominated(feasible.get("F"))]


class Guarded(Algorithm):  # type: ignore[misc]
    """Mixin that gives a pymoo algorithm an exact number of evaluations and finite fronts.

    List it before the algorithm among the base classes.

    - The last generation is cut so that exactly the evaluations of an `n_eval` termination are
      spent, for every population size.
    - A point with a NaN or infinite objective or constraint counts as infinitely infeasible, also
      on a problem without constraints. It loses every comparison and enters no front.
    """

    def _setup(self, problem: Problem, **kwargs: Any) -> None:
        if problem.n_eq_constr > 0:
            raise SettingsError(
                f"the problem has {problem.n_eq_constr} equality constraints; "
                "state them as inequalities with a tolerance",
                code="equalities",
            )
        super()._setup(problem, **kwargs)

    @property
    def budget(self) -> int | None:
        """Number of evaluations that the termination allows in total; None if it sets no such
        limit."""
        if isinstance(self.termination, MaximumFunctionCallTermination):
            return int(self.termination.n_max_evals)
        return None

    def infill(self) -> Population:
        """Return the next candidates to evaluate, at most as many as evaluations are left."""
        candidates = super().infill()
        if self.budget is None:
            return candidates
        return candidates[: max(self.budget - self.evaluator.n_eval, 0)]

    def advance(self, infills: Population | None = None, **kwargs: Any) -> Any:
        """Take evaluated candidates into the population.

        Candidates with an objective or constraint that is not finite are marked as infeasible
        before.

        Args:
            infills: evaluated candidates of the last `infill`.
            kwargs: passed on to pymoo.
        """
        if infills is not None and len(infills) > 0:
            objectives, constraints = infills.get("F", "G")
            violation = violation_of(objectives, constraints)
            for index in np.flatnonzero(np.isinf(violation)):
                infills[index].F = np.full_like(objectives[index], WORST_OBJECTIVE)
                infills[index].G = np.full_like(constraints[index], WORST_OBJECTIVE)
            # Not `infills.set`, which first lets pymoo compute the value in Python.
            for individual, total in zip(infills, violation[:, None], strict=True):
                individual.CV = total
        return super().advance(infills=infills, **kwargs)

    def _set_optimum(self) -> None:
        self.opt = feasible_front(self.pop)


class WarmSampling(FloatRandomSampling):  # type: ignore[misc]
    """Sampler of an initial population: given points, then uniform samples within the bounds."""

    def __init__(self, initial: Array | None = None) -> None:
        super().__init__()
        self.initial = initial

    def _do(
        self, problem: Problem, n_samples: int, *args: Any, random_state: Any = None, **kwargs: Any
    ) -> Array:
        samples: Array = super()._do(problem, n_samples, random_state=random_state)
        if self.initial is None:
            return samples
        initial = np.atleast_2d(np.asarray(self.initial, dtype=np.float64))
        if initial.shape[1] != problem.n_var or len(initial) > n_samples:
            raise SettingsError(
                f"initial points have shape {initial.shape}; allowed are at most {n_samples} "
                f"(the population) of {problem.n_var} values",
                code="shape",
            )
        # Written so that a NaN coordinate is refused too.
        if not ((initial >= problem.xl) & (initial <= problem.xu)).all():
            raise SettingsError(
                "an initial point lies outside the bounds; move it inside",
                code="outside-the-bounds",
            )
        samples[: len(initial)] = initial
        return samples


class ExhaustiveMating(Mating):  # type: ignore[misc]
    """Mating that always returns the full number of offspring: uniform samples replace missing
    unique ones.

    pymoo stops a run early if crossover and mutation yield only duplicates, as in a collapsed
    population. The budget would then not be spent.
    """

    def do(self, problem: Problem, pop: Population, n_offsprings: int, **kwargs: Any) -> Population:
        """Return exactly `n_offsprings` offspring.

        Args:
            problem: the problem, whose bounds limit the offspring.
            pop: population of the parents.
            n_offsprings: number of offspring.
            kwargs: passed on to pymoo.
        """
        offspring = super().do(problem, pop, n_offsprings, **kwargs)
        missing = n_offsprings - len(offspring)
        if missing > 0:
            fresh = FloatRandomSampling()(problem, missing, random_state=kwargs["random_state"])
            offspring = Population.merge(offspring, fresh)
        return offspring


# --- the algorithms ---


@dataclass(frozen=True)
class GeneticSettings:
    """Settings of NSGA-II and SMS-EMOA.

    Attributes:
        population: number of points per generation; at 1000 evaluations 40 does better than 100.
        crossover_probability: probability of simulated binary crossover per mating.
        crossover_eta: distribution index of the crossover; larger values keep children nearer to
            parents.
        mutation_probability: probability of polynomial mutation per variable; None for 1 / n_var.
        mutation_eta: distribution index of the mutation.
    """

    population: Annotated[int, Range(4, 100_000)] = 40
    crossover_probability: Share = 0.9
    crossover_eta: Index = 15.0
    mutation_probability: Share | None = None
    mutation_eta: Index = 20.0

    def __post_init__(self) -> None:
        require_allowed(self, "genetic algorithm: ")


@dataclass(frozen=True)
class RandomSettings:
    """Settings of uniform random search.

    Attributes:
        batch: number of points per evaluation call.
    """

    batch: Points = 100

    def __post_init__(self) -> None:
        require_allowed(self, "random: ")


class GuardedNsga2(Guarded, NSGA2):  # type: ignore[misc]
    """NSGA-II (Deb et al. 2002) of pymoo with the guarantees of `Guarded`. If the problem has
    constraints it uses constraint domination."""


class GuardedSmsEmoa(Guarded, SMSEMOA):  # type: ignore[misc]
    """SMS-EMOA (Beume et al. 2007) of pymoo with the guarantees of `Guarded`.

    It makes a whole generation of offspring at a time. If the problem has constraints, it prefers
    feasible points.
    """


def genetic(
    kind: type[Algorithm], compare: Any, settings: GeneticSettings, initial: Array | None
) -> Algorithm:
    """Build a genetic algorithm whose parents are chosen by tournaments.

    Args:
        kind: class of the algorithm.
        compare: pymoo's comparison function, which decides a tournament.
        settings: settings of the algorithm.
        initial: (k, n_var) decision vectors that the first generation starts with, the rest being
            uniformly random; None for all random.
    """
    mating = ExhaustiveMating(
        TournamentSelection(func_comp=compare),
        SBX(eta=settings.crossover_eta, prob=settings.crossover_probability),
        PM(eta=settings.mutation_eta, prob_var=settings.mutation_probability),
        eliminate_duplicates=DefaultDuplicateElimination(),
    )
    return kind(pop_size=settings.population, sampling=WarmSampling(initial), mating=mating)


class RandomSearch(Guarded, Algorithm):  # type: ignore[misc]
    """Uniform random points within the bounds, the baseline of every search."""

    def __init__(
        self, settings: RandomSettings, initial: Array | None = None, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.settings = settings
        self.sampling = WarmSampling(initial)
        self.uniform = WarmSampling()

    def _initialize_infill(self) -> Population:
        return self.sampling(self.problem, self.settings.batch, random_state=self.random_state)

    def _initialize_advance(self, infills: Population, **kwargs: Any) -> None:
        self.members = feasible_front(infills)

    def _infill(self) -> Population:
        return self.uniform(self.problem, self.settings.batch, random_state=self.random_state)

    def _advance(self, infills: Population, **kwargs: Any) -> None:
        self.pop = infills
        self.members = feasible_front(Population.merge(self.members, infills))

    def _set_optimum(self) -> None:
        self.opt = self.members
