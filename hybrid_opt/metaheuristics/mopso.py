"""Multi-objective particle swarm optimisation after Coello Coello and Lechuga.

Sources: C. A. Coello Coello and M. S. Lechuga, "MOPSO: a proposal for multiple objective particle
swarm optimization", Proc. CEC 2002, 1051-1056 (flight, archive, leaders); C. A. Coello Coello,
G. T. Pulido and M. S. Lechuga, IEEE Trans. Evolutionary Computation 8(3), 2004, 256-279
(constraints, fading turbulence).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import moocore
import numpy as np
from numpy.typing import NDArray
from pymoo.core.algorithm import Algorithm
from pymoo.core.population import Population
from pymoo.core.problem import Problem

from hybrid_opt.metaheuristics.algorithms import Guarded, Points, Share, WarmSampling
from symbolic.array import Array, Range, require_allowed
from symbolic.errors import SettingsError

Indices = NDArray[np.intp]

Pull = Annotated[float, Range(0.0, 4.0)]


@dataclass(frozen=True)
class MopsoSettings:
    """Settings of MOPSO; the defaults except the swarm are those of the 2002 and 2004 papers.

    Constriction coefficients (inertia 0.7298, cognitive and social 1.496) are far worse at 1000
    evaluations (shifted ZDT1: IGD 0.91).

    Attributes:
        swarm: number of particles.
        archive: capacity of the external archive.
        divisions: number of intervals per objective in the grid of hypercubes.
        inertia: factor on a particle's old velocity.
        cognitive: factor on the velocity term that points to the particle's best position so far.
        social: factor on the velocity term that points to a leader, a member of the archive.
        mutation_share: share of the run over which the turbulence (random displacement) fades to
            zero.
        horizon: number of evaluations of the whole run; None to take it from the termination.
    """

    swarm: Points = 40
    archive: Points = 100
    divisions: Annotated[int, Range(1, 1000)] = 30
    inertia: Share = 0.4
    cognitive: Pull = 1.0
    social: Pull = 1.0
    mutation_share: Share = 0.5
    horizon: Annotated[int, Range(1, 10**9)] | None = None

    def __post_init__(self) -> None:
        require_allowed(self, "mopso: ")


def hypercubes(objectives: Array, divisions: int) -> Indices:
    """Assign each point to a hypercube of a grid in objective space that spans all points.

    Args:
        objectives: (n, n_obj) points, finite.
        divisions: number of intervals per objective between the least and the greatest value.

    Returns:
        (n,) number of each point's hypercube. Only occupied hypercubes have numbers, from 0, in no
        particular order.
    """
    lowest = objectives.min(axis=0)
    extent = np.ptp(objectives, axis=0)
    scaled = (objectives - lowest) / np.where(extent > 0.0, extent, 1.0)
    cells = np.minimum((scaled * divisions).astype(np.intp), divisions - 1)
    key = np.ravel_multi_index(tuple(cells.T), (divisions,) * cells.shape[1])
    return np.asarray(np.unique(key, return_inverse=True)[1], dtype=np.intp)


def thin(
    cubes: Indices, newcomer: NDArray[np.bool_], capacity: int, rng: np.random.Generator
) -> Indices:
    """Choose the members that stay if the archive is over capacity.

    Members are removed one by one, always from a hypercube that has the most. Within a hypercube
    newcomers are removed before old members; otherwise chance decides.

    Args:
        cubes: (n,) hypercube number of each member.
        newcomer: (n,) True for members that were not in the archive before.
        capacity: number of members that may stay.
        rng: source of randomness.

    Returns:
        (min(n, capacity),) increasing indices of the members that stay.
    """
    count = len(cubes)
    shuffled = rng.permutation(count)
    grouped = shuffled[np.lexsort((newcomer[shuffled], cubes[shuffled]))]
    sizes = np.bincount(cubes)
    sizes = sizes[sizes > 0]
    height = np.arange(count) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    order = np.lexsort((rng.random(count), newcomer[grouped], height))
    kept = grouped[order[:capacity]]
    return np.sort(kept)


class HypercubeArchive:
    """Archive of at most `capacity` non-dominated feasible points.

    As long as no feasible point is known, it holds the points of least violation as guides. The
    first feasible point replaces them.

    Attributes:
        decisions: (n, n_var) decision vectors.
        objectives: (n, n_obj) objectives.
        violation: (n,) total constraint violation: 0 if feasible, otherwise the least known one.
    """

    def __init__(self, capacity: int, divisions: int, n_var: int, n_obj: int) -> None:
        self.capacity = capacity
        self.divisions = divisions
        self.decisions = np.empty((0, n_var))
        self.objectives = np.empty((0, n_obj))
        self.violation = np.empty(0)
        self._leader_chances = np.empty(0)

    def __len__(self) -> int:
        return len(self.violation)

    def update(
        self, decisions: Array, objectives: Array, violation: Array, rng: np.random.Generator
    ) -> Indices:
        """Merge evaluated points into the archive.

        Args:
            decisions: (m, n_var) decision vectors.
            objectives: (m, n_obj) objectives; finite for every point with finite violation.
            violation: (m,) total constraint violations; points with infinite violation are refused.
            rng: source of randomness for thinning.

        Returns:
            Indices of the members after the merge, counted in the list of the n old members
            followed by the m new points.
        """
        all_decisions = np.concatenate([self.decisions, decisions])
        all_objectives = np.concatenate([self.objectives, objectives])
        all_violation = np.concatenate([self.violation, violation])

        least = all_violation.min(initial=np.inf)
        members = np.flatnonzero((all_violation == least) & np.isfinite(all_violation))
        if len(members) > 0:
            members = members[moocore.is_nondominated(all_objectives[members])]
            cubes = hypercubes(all_objectives[members], self.divisions)
            if len(members) > self.capacity:
                stay = thin(cubes, members >= len(self), self.capacity, rng)
                members, cubes = members[stay], cubes[stay]
            # Roulette over cubes with fitness proportional to 1/n, then uniform inside: a
            # member's chance is proportional to 1/n^2.
            chances = 1.0 / np.bincount(cubes)[cubes] ** 2.0
            self._leader_chances = np.cumsum(chances / chances.sum())

        self.decisions = all_decisions[members]
        self.objectives = all_objectives[members]
        self.violation = all_violation[members]
        return members

    def leaders(self, count: int, rng: np.random.Generator) -> Indices:
        """Draw members at random as leaders. Members of sparse hypercubes are preferred.

        The archive must not be empty.

        Args:
            count: number of draws.
            rng: source of randomness.

        Returns:
            (count,) indices of the members.
        """
        drawn = np.searchsorted(self._leader_chances, rng.random(count), side="right")
        return np.minimum(drawn, len(self) - 1)


Mask = NDArray[np.bool_]


def reflect(position: Array, velocity: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Put particles outside the bounds on the bounds, and reverse the velocity components that
    crossed.

    Args:
        position, velocity: (n, n_var) of n particles.
        lower, upper: (n_var,) bounds.

    Returns:
        Positions and velocities (n, n_var).
    """
    inside = np.clip(position, lower, upper)
    return inside, np.where(inside == position, velocity, -velocity)


def turbulence(
    position: Array, lower: Array, upper: Array, strength: float, rng: np.random.Generator
) -> Array:
    """Displace one random coordinate of some particles.

    Args:
        position: (n, n_var) positions.
        lower, upper: (n_var,) bounds.
        strength: number in [0, 1]: the probability that a particle is displaced, and the width of
            the range of displacements as a share of the bounds' range.
        rng: source of randomness.

    Returns:
        (n, n_var) positions within the bounds.
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
    """Return a mask (n,) of the particles whose new point becomes their personal best.

    A point with less violation becomes the best. At equal violation a dominating point does and a
    dominated one does not; between incomparable points chance decides.

    Args:
        objectives, violation: (n, n_obj) and (n,) of the new points.
        best_objectives, best_violation: (n, n_obj) and (n,) of the personal bests so far.
        rng: source of randomness.
    """
    coin = rng.random(len(violation)) < 0.5
    no_worse = (objectives <= best_objectives).all(axis=1)
    no_better = (objectives >= best_objectives).all(axis=1)
    by_dominance = np.where(no_worse == no_better, coin, no_worse)
    return np.where(violation == best_violation, by_dominance, violation < best_violation)


class Mopso(Guarded, Algorithm):  # type: ignore[misc]
    """MOPSO on pymoo's ask-and-tell interface; `opt` is the feasible part of the archive.

    The turbulence fades over the run, so the number of evaluations has to be known: use an `n_eval`
    termination, or set `settings.horizon`.
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
