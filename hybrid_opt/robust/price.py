"""The price of robustness: the forces of a carry against the size of the uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from hybrid_opt.carry import Carry
from symbolic.array import Array, Figure, Pair, Row, Shape
from symbolic.records import Uncertainty

if TYPE_CHECKING:
    pass

from hybrid_opt.robust.force import RobustModel, SampledCheck, allowed_factor, subsample

MOST, POINTS = 2.0, 9
"""Largest multiple of the uncertainty in a price of robustness, and number of multiples."""


CASES = 100_000
"""Number of random cases in which every priced carry is checked."""


@dataclass(frozen=True)
class RobustPrice:
    """Normal forces that hold the box in every case, for one carry and several sizes of the
    uncertainty.

    Attributes:
        uncertainty: the workcell's uncertainty.
        factors: (k,) factors on the uncertainty for which a holding force was found.
        peak: (k, 2) largest normal force of each robot along the carry for each factor [N].
        commanded: (2,) largest normal force of each robot for the factor 1 [N].
        limit: (2,) reference force of each robot [N].
        largest_factor: largest factor for which the forces stay within the reference forces.
        check: check of the commanded forces in random cases of the uncertainty.
    """

    uncertainty: Uncertainty
    factors: Row
    peak: Annotated[Array, Shape((None, 2))]
    commanded: Pair
    limit: Pair
    largest_factor: Figure
    check: SampledCheck


def robust_price(
    model: RobustModel,
    carry: Carry,
    rng: np.random.Generator,
    leader: int = 0,
    cases: int = CASES,
    threads: int = 1,
    points: int = POINTS,
) -> RobustPrice:
    """Compute how the largest normal forces of a carry that hold the box in every case of the
    uncertainty grow with the size of the uncertainty.

    Args:
        model: computes robust normal forces, which hold the box in every case of the uncertainty.
        carry: the carry.
        rng: random generator for the cases of the check.
        leader: index of the position-controlled arm.
        cases: number of random cases in which the commanded force is checked.
        threads: number of threads, 0 for one per core.
        points: number of factors, evenly spaced from 0 to `MOST`, by which the uncertainty is
            multiplied. Factors that leave no friction are left out.

    Returns:
        Largest normal forces for each factor, the largest factor within the reference forces, and
        the check of the forces for factor 1.

    Raises:
        SettingsError: the uncertainty leaves no friction or contact patch.
    """
    workcell = model.workcell
    uncertainty = workcell.uncertainty
    (_, motion), limit = subsample(carry), workcell.task.reference_force
    force = model.robust_force(motion, uncertainty, leader)
    factors = np.linspace(0.0, MOST, points)
    factors = factors[factors < allowed_factor(workcell, uncertainty)]
    peak = np.array([model.peak(motion, uncertainty.scaled(f), leader) for f in factors])
    held = np.isfinite(peak).all(axis=1)
    return RobustPrice(
        uncertainty=uncertainty,
        factors=factors[held],
        peak=peak[held],
        commanded=force.peak,
        limit=limit,
        largest_factor=model.largest_factor(motion, limit, leader),
        check=model.check(motion, force, cases, rng, threads),
    )
