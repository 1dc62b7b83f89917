"""Empirical attainment surfaces: objectives that a share of the replicas reached or bettered.

Source: Fonseca, Guerreiro, Lopez-Ibanez and Paquete 2011, through moocore's `eaf`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import moocore
import numpy as np
from numpy.typing import ArrayLike

from symbolic.array import Array
from symbolic.errors import SettingsError


@dataclass(frozen=True)
class AttainmentSurface:
    """The goals that at least `percentile` percent of the fronts attain.

    Attributes:
        percentile: in (0, 100].
        points: (k, n_obj) the corners of the surface, by increasing first objective; empty
            where fewer fronts than that hold any point.
    """

    percentile: float
    points: Array


def attainment_surfaces(
    fronts: Sequence[ArrayLike], percentiles: Sequence[float] = (25.0, 50.0, 75.0)
) -> tuple[AttainmentSurface, ...]:
    """Attainment surfaces of replicas' fronts.

    A surface belongs to the least number of fronts that makes up its percentile. An empty
    front counts as a replica that attains nothing.

    Args:
        fronts: one (k_i, n_obj) front per replica, n_obj 2 or 3.
        percentiles: in (0, 100].

    Raises:
        SettingsError: no fronts, or a percentile out of range.
    """
    if len(fronts) == 0 or not all(0.0 < percentile <= 100.0 for percentile in percentiles):
        raise SettingsError(
            f"attainment of {len(fronts)} fronts at {list(percentiles)} percent; needed are at "
            "least one front and percentiles above 0 and up to 100"
        )
    sets = [np.asarray(front, dtype=np.float64) for front in fronts]
    filled = [points for points in sets if len(points) > 0]
    width = filled[0].shape[1] if filled else 2
    surfaces = []
    for percentile in percentiles:
        # Rounded first, so that 30 % of 10 fronts is 3 in spite of binary fractions.
        needed = max(1, int(np.ceil(np.round(percentile / 100.0 * len(sets), 9))))
        points = np.empty((0, width))
        if needed <= len(filled):
            labels = np.repeat(np.arange(len(filled)), [len(points) for points in filled])
            levels = moocore.eaf(
                np.concatenate(filled), labels, percentiles=[100.0 * needed / len(filled)]
            )
            points = levels[:, :-1]
            points = points[np.lexsort(points.T[::-1])]
        points.setflags(write=False)
        surfaces.append(AttainmentSurface(float(percentile), points))
    return tuple(surfaces)
