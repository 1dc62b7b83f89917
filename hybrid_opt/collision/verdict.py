"""What collision checking says of one candidate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from symbolic.array import Array


@dataclass(frozen=True)
class Touch:
    """Two bodies in collision.

    Attributes:
        sample: index of the sample; for a collision between samples, of the one before.
        time: [s] since the start of the candidate.
        first, second: names of the bodies.
    """

    sample: int
    time: float
    first: str
    second: str


@dataclass(frozen=True)
class Verdict:
    """The collisions of one candidate.

    Attributes:
        colliding: (n,) samples in collision.
        collision_time: time that the colliding samples stand for [s]; each stands for half of
            its two neighbouring steps.
        first_touch: the earliest collision, or None.
        min_clearance: lower bound of the least distance over all pairs and samples [m]; at most
            the collision tolerance where something collides or the bounds cannot tell.
        open_samples: samples that the bounds left to FCL.
        fcl_calls: FCL queries made.
    """

    colliding: NDArray[np.bool_]
    collision_time: float
    first_touch: Touch | None
    min_clearance: float
    open_samples: int
    fcl_calls: int

    @property
    def is_free(self) -> bool:
        """Whether no sample collides."""
        return self.first_touch is None


def sample_durations(time: Array) -> Array:
    """Time (..., n) [s] that each sample stands for: half of both neighbouring steps."""
    halves = np.diff(time) / 2.0
    durations = np.zeros(time.shape)
    durations[..., :-1] += halves
    durations[..., 1:] += halves
    return durations
