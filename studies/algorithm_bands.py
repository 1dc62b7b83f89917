"""Figures that a correct implementation of Coello's MOPSO reaches on analytic problems."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from hybrid_opt.indicators.statistics import Summary

Verdict = Literal["inside", "better", "worse"]


@dataclass(frozen=True)
class Band:
    """Average figures of a correct MOPSO, see `BAND_SOURCE`.

    Attributes:
        hypervolume, igd: means over `BAND_SEEDS` seeds.
        igd_std: standard deviation of the IGD over seeds, where known.
    """

    hypervolume: float
    igd: float
    igd_std: float | None = None


BAND_SEEDS = 10
BAND_POPULATION = 100
BAND_SOURCE = (
    "reference runs of an independent implementation of the 2002/2004 algorithm, made when this "
    "program was specified: mean of 10 seeds, swarm and archive 100"
)
BANDS: dict[tuple[str, int], Band] = {
    ("zdt1", 1000): Band(0.00, 1.49),
    ("zdt2", 1000): Band(0.00, 2.34),
    ("zdt3", 1000): Band(0.00, 0.92),
    ("tnk", 1000): Band(0.465, 0.029),
    ("srn", 1000): Band(0.738, 0.0068),
    ("osy", 1000): Band(0.590, 0.241),
    ("zdt1", 10_000): Band(0.278, 0.452),
    ("zdt2", 10_000): Band(0.006, 0.871),
    ("zdt3", 10_000): Band(0.248, 0.335),
    ("tnk", 10_000): Band(0.507, 0.0072),
    ("srn", 10_000): Band(0.741, 0.0060),
    ("osy", 10_000): Band(0.846, 0.156),
    ("zdt1", 25_000): Band(0.628, 0.166, 0.021),
    ("zdt2", 25_000): Band(0.393, 0.091, 0.020),
    ("zdt3", 25_000): Band(0.501, 0.121, 0.026),
    ("tnk", 25_000): Band(0.509, 0.0061),
    ("srn", 25_000): Band(0.739, 0.0067),
    ("osy", 25_000): Band(0.892, 0.133),
}


def judge(
    ours: Summary, reference: float, *, higher_is_better: bool, std: float | None = None
) -> Verdict | None:
    """Whether our mean agrees with a band's.

    The band is the reference mean plus and minus three standard errors of the difference of
    the two means. The reference's spread is taken as ours where it is not known.

    Returns:
        None where fewer than two seeds leave the spread unknown.
    """
    if ours.count < 2:
        return None
    reference_std = ours.std if std is None else std
    error = math.sqrt(ours.std**2 / ours.count + reference_std**2 / BAND_SEEDS)
    gain = ours.mean - reference if higher_is_better else reference - ours.mean
    if abs(gain) <= 3.0 * error:
        return "inside"
    return "better" if gain > 0.0 else "worse"
