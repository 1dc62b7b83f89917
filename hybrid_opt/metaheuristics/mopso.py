"""Multi-objective particle swarm optimisation after Coello Coello and Lechuga.

Sources: C. A. Coello Coello and M. S. Lechuga, "MOPSO: a proposal for multiple objective particle
swarm optimization", Proc. CEC 2002, 1051-1056 (flight, archive, leaders); C. A. Coello Coello,
G. T. Pulido and M. S. Lechuga, IEEE Trans. Evolutionary Computation 8(3), 2004, 256-279
(constraints, fading turbulence).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymoo.core.algorithm import Algorithm
from pymoo.core.population import Population
from pymoo.core.problem import Problem

from hybrid_opt.metaheuristics.guarded import Guarded, WarmSampling
from hybrid_opt.metaheuristics.hypercube_archive import HypercubeArchive
from hybrid_opt.metaheuristics.settings import MopsoSettings
from symbolic.array import Array
from symbolic.errors import SettingsError

Mask = NDArray[np.bool_]


def reflect(position: Array, velocity: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Stop particles at the bounds and reverse the velocity components that crossed them."""
    inside = np.clip(position, lower, upper)
    return inside, np.where(inside == position, velocity, -velocity)


def turbulence(
    position: Array, lower: Array, upper: Array, strength: float, rng: np.random.Generator
) -> Array:
    """Displace one random coordinate of some particles.

    Args:
        position: (n, n_var).
        lower, upper: (n_var,) bounds.
        strength: in [0, 1], both the probability that a particle is displaced and the
            fraction of the bounds' extent that the displacement may cover in total.
        rng: source of randomness.

    Returns:
        (n, n_var), within the bounds.
    """
    count, n_var = position.shape
    struck = np.flatnonzero(rng.random(count) < strength)
    axis = rng.integers(n_var, size=len(struck))
    reach = 0.5 * strength * (upper - lower)[axis]
    centre = position[struck, axis]
    low = np.maximum(centre - reach, lower[axis])
    high = np.minimum(centre + reach, upper[axis])
    moved = position.copy()
    moved[struck, axis] = low + (high - low) * rng.random(len(struck))
    return moved


def replaces_best(
    objectives: Array,
    violation: Array,
    best_objectives: Array,
    best_violation: Array,
    rng: np.random.Generator,
) -> Mask:
    """Whether each particle's new point becomes its personal best.

    Less violation wins; among equals a dominating point wins, a dominated one loses, and
    between incomparable ones a fair coin decides.

    Args:
        objectives, best_objectives: (n, n_obj).
        violation, best_violation: (n,).
        rng: source of randomness.
    """
    coin = rng.random(len(violation)) < 0.5
    no_worse = (objectives <= best_objectives).all(axis=1)
    no_better = (objectives >= best_objectives).all(axis=1)
    by_dominance = np.where(no_worse == no_better, coin, no_worse)
    return np.where(violation == best_violation, by_dominance, violation < best_violation)


class Mopso(Guarded, Algorithm):  # type: ignore[misc]
    """MOPSO on pymoo's ask-and-tell interface; `opt` is the archive's feasible part.

    The turbulence fades over the run, so the number of evaluations must be known: terminate by
    `n_eval`, or give `settings.horizon`.
    """

    def __init__(
        self, settings: MopsoSettings, initial: Array | None = None, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.settings = settings
        self.sampling = WarmSampling(initial)

    def _setup(self, problem: Problem, **kwargs: Any) -> None:
        super()._setup(problem, **kwargs)
        horizon = self.settings.horizon if self.settings.horizon is not None else self.budget
        if horizon is None:
            raise SettingsError(
                "mopso: how long the run will be is unknown; terminate by n_eval or set 'horizon'"
            )
        self.horizon = horizon
        self.guides = HypercubeArchive(
            self.settings.archive, self.settings.divisions, problem.n_var, problem.n_obj
        )
        self.members = Population.empty()

    def _initialize_infill(self) -> Population:
        return self.sampling(self.problem, self.settings.swarm, random_state=self.random_state)

    def _initialize_advance(self, infills: Population, **kwargs: Any) -> None:
        position, objectives, violation = infills.get("X", "F", "CV")
        self.position = position
        self.velocity = np.zeros_like(position)
        self.best_position = position.copy()
        self.best_objectives = objectives.copy()
        self.best_violation = violation[:, 0].copy()
        self._remember(infills, position, objectives, violation[:, 0])

    def _infill(self) -> Population:
        settings, rng = self.settings, self.random_state
        lower, upper = self.problem.xl, self.problem.xu
        shape = self.position.shape
        leader = self.best_position
        if len(self.guides) > 0:
            leader = self.guides.decisions[self.guides.leaders(shape[0], rng)]
        velocity = (
            settings.inertia * self.velocity
            + settings.cognitive * rng.random(shape) * (self.best_position - self.position)
            + settings.social * rng.random(shape) * (leader - self.position)
        )  # Eq. 1
        position, self.velocity = reflect(self.position + velocity, velocity, lower, upper)  # Eq. 2
        strength = self._turbulence_strength()
        if strength > 0.0:
            position = turbulence(position, lower, upper, strength, rng)
        self.position = position
        return Population.new(X=position)

    def _advance(self, infills: Population, **kwargs: Any) -> None:
        position, objectives, violation = infills.get("X", "F", "CV")
        violation = violation[:, 0]
        # The last generation of a budget may hold only the first particles.
        flown = np.arange(len(infills))
        better = replaces_best(
            objectives,
            violation,
            self.best_objectives[flown],
            self.best_violation[flown],
            self.random_state,
        )
        self.best_position[flown[better]] = position[better]
        self.best_objectives[flown[better]] = objectives[better]
        self.best_violation[flown[better]] = violation[better]
        self.pop = infills
        self._remember(infills, position, objectives, violation)

    def _set_optimum(self) -> None:
        self.opt = self.members if np.all(self.guides.violation == 0.0) else Population.empty()

    def _remember(
        self, points: Population, position: Array, objectives: Array, violation: Array
    ) -> None:
        kept = self.guides.update(position, objectives, violation, self.random_state)
        self.members = Population.merge(self.members, points)[kept]

    def _turbulence_strength(self) -> float:
        if self.settings.mutation_share == 0.0:
            return 0.0
        elapsed = (self.evaluator.n_eval - self.settings.swarm) / self.horizon
        return float(max(1.0 - elapsed / self.settings.mutation_share, 0.0) ** 1.5)
