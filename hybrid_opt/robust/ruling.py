"""The worst cases that decide both robots' forces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array
from symbolic.records import Uncertainty


@dataclass(frozen=True)
class RulingCases:
    """The worst cases that decide the forces; n samples.

    Attributes:
        leader: index of the arm that keeps its place.
        force: (n, 2) what is commanded of the force-controlled arm, and the largest that the other
            feels [N].
        commanded: (n,) the case that decides the first.
        felt: (n,) the case in which the leading arm feels most beyond it.
        share: (n,) of the difference of both forces there that it feels.
    """

    leader: int
    force: Array
    commanded: NDArray[np.intp]
    felt: NDArray[np.intp]
    share: Array

    def at(self, rows: NDArray[np.intp]) -> RulingCases:
        """At some of the samples."""
        cases = self.commanded[rows], self.felt[rows]
        return RulingCases(self.leader, self.force[rows], *cases, self.share[rows])

    def slopes(self, commanded: Array, felt: Array) -> Array:
        """(n, 2, m) derivatives of `force` from those of both robots' forces (n, 2, m) in the cases
        `commanded` and `felt`."""
        follower = 1 - self.leader
        found = np.empty_like(commanded)
        found[:, follower] = commanded[:, follower]
        step = felt[:, self.leader] - felt[:, follower]
        found[:, self.leader] = commanded[:, follower] + self.share[:, None] * step
        return found


def felt_share(difference: Array, uncertainty: Uncertainty) -> Array:
    """Largest share that the leading arm feels of differences between leading and commanded force
    under the largest mass: all of one that loads it, the least mass's share of one that relieves
    it."""
    lightest = (1.0 - uncertainty.mass) / (1.0 + uncertainty.mass)
    return np.where(difference > 0.0, 1.0, lightest)


def ruling_cases(
    worst: Array,
    uncertainty: Uncertainty,
    leader: int,
    difference: Array | None = None,
    leading_share: float = 1.0,
) -> RulingCases:
    """The cases that decide among the least normal forces (k, n, 2) [N] of the worst ones.

    The difference of both forces is the motion's, whatever the squeeze, and proportional to the
    mass.

    Args:
        difference: (k, n) leading less commanded force [N], where `worst` does not tell all.
        leading_share: what the leading arm presses more for each newton more that is commanded.
    """
    follower, every = 1 - leader, np.arange(worst.shape[1])
    if difference is None:
        difference = worst[:, :, leader] - leading_share * worst[:, :, follower]
    share = felt_share(difference, uncertainty)
    commanded = worst[:, :, follower].argmax(axis=0)
    felt = (share * difference).argmax(axis=0)
    force = np.empty(worst.shape[1:])
    force[:, follower] = worst[commanded, every, follower]
    force[:, leader] = leading_share * force[:, follower] + (share * difference)[felt, every]
    return RulingCases(leader, force, commanded, felt, share[felt, every])
