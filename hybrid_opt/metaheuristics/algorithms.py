"""Search algorithms on pymoo's interface, with guarantees beyond pymoo's: an exact budget and
finite fronts. NSGA-II, SMS-EMOA and uniform random search; `hybrid_opt.metaheuristics.mopso` has
MOPSO.
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
"""Stands in for an objective that is not finite: every real point dominates it, and unlike
infinity it leaves differences and normalisations finite."""


def violation_of(objectives: Array, constraints: Array) -> Array:
    """Compute the total constraint violation of evaluated points.

    Args:
        objectives: (n, n_obj).
        constraints: (n, n_con), satisfied where <= 0; n_con may be 0.

    Returns:
        (n,), the sum of positive constraint values: 0 is feasible; infinite where an
        objective or a constraint is not a finite number below `WORST_OBJECTIVE`.
    """
    total = np.maximum(constraints, 0.0).sum(axis=1)
    sound = (np.abs(objectives) < WORST_OBJECTIVE).all(axis=1) & np.isfinite(constraints).all(
        axis=1
    )
    return np.where(sound, total, np.inf)


def feasible_front(points: Population) -> Population:
    """Return the feasible, mutually non-dominated members of evaluated points, each value once."""
    if len(points) == 0:
        return points
    feasible = points[points.get("CV")[:, 0] == 0.0]
    if len(feasible) == 0:
        return Population.empty()
    return feasible[moocore.is_nondominated(feasible.get("F"))]


class Guarded(Algorithm):  # type: ignore[misc]
    """Mixin with an exact budget and finite fronts, placed before a pymoo algorithm among the
    bases.

    - The last generation is cut so that exactly the evaluations of an `n_eval` termination
      are spent, for every population size.
    - A point with a NaN or infinite objective or constraint is infeasible, without limit,
      also on a problem without constraints; it loses every comparison and enters no front.
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
        """Evaluations that the termination allows in total, None without such a limit."""
        if isinstance(self.termination, MaximumFunctionCallTermination):
            return int(self.termination.n_max_evals)
        return None

    def infill(self) -> Population:
        """Return the next candidates, at most the remaining budget."""
        candidates = super().infill()
        if self.budget is None:
            return candidates
        return candidates[: max(self.budget - self.evaluator.n_eval, 0)]

    def advance(self, infills: Population | None = None, **kwargs: Any) -> Any:
        """Take evaluated candidates, with non-finite ones made infeasible first."""
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
    """Uniform samples within the bounds, the first of them replaced by given points."""

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
    """Mating that always fills its offspring: uniform samples replace missing unique ones.

    pymoo stops a run early when crossover and mutation yield duplicates only, as happens in a
    collapsed population; the budget would then not be spent.
    """

    def do(self, problem: Problem, pop: Population, n_offsprings: int, **kwargs: Any) -> Population:
        """Return exactly `n_offsprings` offspring of `pop`."""
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
        population: points per generation; at 1000 evaluations 40 does better than 100.
        crossover_probability: of simulated binary crossover per mating.
        crossover_eta: its distribution index, greater keeps children nearer to the parents.
        mutation_probability: of polynomial mutation per variable, None for 1 / n_var.
        mutation_eta: its distribution index.
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
    """Settings of uniform random search. batch: points per evaluation call."""

    batch: Points = 100

    def __post_init__(self) -> None:
        require_allowed(self, "random: ")


class GuardedNsga2(Guarded, NSGA2):  # type: ignore[misc]
    """NSGA-II (Deb et al. 2002) of pymoo with `Guarded`'s promises; constraint domination where the
    problem has constraints."""


class GuardedSmsEmoa(Guarded, SMSEMOA):  # type: ignore[misc]
    """SMS-EMOA (Beume et al. 2007) of pymoo, with a whole generation of offspring at a time;
    feasible before infeasible where the problem has constraints."""


def genetic(
    kind: type[Algorithm], compare: Any, settings: GeneticSettings, initial: Array | None
) -> Algorithm:
    """Build an algorithm that mates the winners of tournaments decided by `compare`."""
    mating = ExhaustiveMating(
        TournamentSelection(func_comp=compare),
        SBX(eta=settings.crossover_eta, prob=settings.crossover_probability),
        PM(eta=settings.mutation_eta, prob_var=settings.mutation_probability),
        eliminate_duplicates=DefaultDuplicateElimination(),
    )
    return kind(pop_size=settings.population, sampling=WarmSampling(initial), mating=mating)


class RandomSearch(Guarded, Algorithm):  # type: ignore[misc]
    """Uniform random points within the bounds: the baseline of every search."""

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
