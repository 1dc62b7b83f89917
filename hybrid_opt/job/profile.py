"""The smooth way from 0 to 1 that every phase beside the carry takes, and how long it may take.

h(t/T) with h = 35 s^4 - 84 s^5 + 70 s^6 - 20 s^7, the polynomial of least degree whose first three
derivatives vanish at both ends: a phase begins and ends at rest in position, in acceleration and in
jerk, so that torques and forces have no corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from symbolic.array import Array

PEAK_RATE = 35.0 / 16.0
"""Largest h' over s in [0, 1]."""

_H = np.polynomial.Polynomial([0.0, 0.0, 0.0, 0.0, 35.0, -84.0, 70.0, -20.0])


@dataclass(frozen=True)
class Rise:
    """The profile and its derivatives by time at n samples, evenly spaced over a duration.

    Attributes:
        time: (n,) from 0 [s].
        value, rate, second, third: (n,) h and its derivatives by time.
    """

    time: Array
    value: Array
    rate: Array
    second: Array
    third: Array


def rise(duration: float, samples: int) -> Rise:
    """The way from 0 to 1 within a duration [s]."""
    share = np.linspace(0.0, 1.0, samples)
    # Rounding must not leave [0, 1]; the last values of a polynomial of degree 7 would.
    value = np.clip(_H(share), 0.0, 1.0)
    derivatives = [_H.deriv(k)(share) / duration**k for k in (1, 2, 3)]
    for derivative in derivatives:
        derivative[[0, -1]] = 0.0
    return Rise(duration * share, value, *derivatives)


def at_even_steps(duration: float, step: float) -> float:
    """The duration rounded up to whole steps [s]."""
    return float(np.ceil(duration / step - 1e-9) * step)
