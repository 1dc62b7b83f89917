"""The external archive of MOPSO on an adaptive hypercube grid.

Source: C. A. Coello Coello, G. T. Pulido and M. S. Lechuga, "Handling multiple objectives with
particle swarm optimization", IEEE Trans. Evolutionary Computation 8(3), 2004, 256-279.
"""

from __future__ import annotations

import moocore
import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array

Indices = NDArray[np.intp]


def hypercubes(objectives: Array, divisions: int) -> Indices:
    """Number the occupied hypercubes of the grid that the points themselves span.

    Args:
        objectives: (n, n_obj), finite.
        divisions: cells per objective between the least and the greatest value.

    Returns:
        (n,), for each point its cube, cubes numbered from 0 in no particular order.
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
    """Choose the members that stay when the archive is over capacity.

    Taking a member from a fullest cube again and again levels all cubes to a common height.
    The outcome comes from one sort: stack the members of each cube, old ones below newcomers
    (the papers refuse a newcomer to a fullest cube) and otherwise at random, then keep the
    lowest of all stacks, at equal height old members first and otherwise at random.

    Args:
        cubes: (n,) cube number of each member.
        newcomer: (n,) whether the member was not in the archive before.
        capacity: members that may stay.
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
    """Non-dominated points found so far, at most `capacity`, feasible before infeasible.

    While no feasible point is known it holds those of least violation, as guides only.

    Attributes:
        decisions: (n, n_var).
        objectives: (n, n_obj).
        violation: (n,), 0 where feasible, otherwise the common least violation.
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
            decisions: (n, n_var).
            objectives: (n, n_obj); must be finite where `violation` is.
            violation: (n,), infinite for points to be refused outright.
            rng: source of randomness for thinning.

        Returns:
            Which of [old members, new points], in this order, are members now.
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
        """Draw (count,) indices of members as leaders, sparse cubes preferred.

        The archive must not be empty.
        """
        drawn = np.searchsorted(self._leader_chances, rng.random(count), side="right")
        return np.minimum(drawn, len(self) - 1)
