"""The price of robustness: forces against the size of a set, and the largest that arms allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.robust.force import BoxMotion, RobustModel, SampledCheck, allowed_factor
from symbolic.array import Array
from symbolic.records import Uncertainty

USUAL = Uncertainty(
    friction=0.10,
    mass=0.05,
    centre_of_mass=np.full(3, 0.005),
    pad_position=0.003,
    disturbance=np.full(3, 0.2),
)
"""A set to think of where the workcell states none."""

FACTORS = np.linspace(0.0, 2.0, 9)
"""Multiples of the set whose forces are given."""

CASES = 100_000
"""Random cases that every priced carry is held against."""

SAMPLES = 100
"""Samples of a carry that are judged, beside those of its largest forces."""


@dataclass(frozen=True)
class RobustPrice:
    """The price of robustness of one carry.

    Attributes:
        uncertainty: the set.
        stated: whether the workcell states it.
        factors: (k,) multiples of the set.
        peak: (k, 2) largest normal force of each robot under them [N].
        commanded: (2,) under the set itself [N].
        limit: (2,) reference forces [N].
        largest_factor: the largest multiple that they allow.
        check: random cases of the set itself under its forces.
    """

    uncertainty: Uncertainty
    stated: bool
    factors: Array
    peak: Array
    commanded: Array
    limit: Array
    largest_factor: float
    check: SampledCheck


def robust_price(
    model: RobustModel,
    carry: Carry,
    rng: np.random.Generator,
    leader: int = 0,
    cases: int = CASES,
    threads: int = 1,
) -> RobustPrice:
    """The cost of robustness against the workcell's set for a carry; against `USUAL` without one.

    Args:
        model: of the carry's workcell.
        rng: draws the random cases.
        leader: index of the arm that keeps its place.
        cases: how many.
        threads: that hold them against the forces, 0 for one per core.

    Raises:
        SettingsError: the set leaves no friction or patch, or there is no such arm.
    """
    workcell = model.workcell
    stated = not workcell.uncertainty.is_empty
    uncertainty = workcell.uncertainty if stated else USUAL
    motion, limit = thinned(carry), workcell.task.reference_force
    force = model.robust_force(motion, uncertainty, leader)
    factors = FACTORS[allowed_factor(workcell, uncertainty) > FACTORS]
    return RobustPrice(
        uncertainty=uncertainty,
        stated=stated,
        factors=factors,
        peak=model.price(motion, factors, leader, uncertainty),
        commanded=force.peak,
        limit=limit,
        largest_factor=model.largest_factor(motion, limit, leader, uncertainty),
        check=model.check(motion, force, cases, rng, threads),
    )


def thinned(carry: Carry) -> BoxMotion:
    """`SAMPLES` evenly spread samples of a carry, and those of its largest normal forces."""
    even = np.linspace(0, len(carry) - 1, min(len(carry), SAMPLES)).round().astype(int)
    rows = np.union1d(even, carry.normal_force.argmax(axis=0))
    return BoxMotion(carry.pose[rows], carry.rate[rows], carry.second_rate[rows])
