"""A timing without jumps of the acceleration, from one that has them.

Time-optimal timings switch accelerations in no time, and begin and end with one. No controller
follows that. Here the path parameter as a function of time, u(t), is averaged over a short window
with a smooth kernel: box and arms stay on the very same path, begin and end at rest also in their
accelerations, and the jerk is bounded by the jumps over the width. What then exceeds a limit, since
speeds are passed a little earlier or later, is mended by slowing down uniformly.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.optimize import brentq

from hybrid_opt.carry import Carry
from hybrid_opt.errors import JobError
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import Timing
from hybrid_opt.timing.use import limit_use, worst
from symbolic.array import Array

WIDTH = 0.05
"""Half the width of the window [s]."""

WIDEST = 1.0
"""Largest width that may be asked for [s]."""

STEP = 5e-4
"""Of the averaging [s]."""

EVERY = 4
"""Steps of the averaging between two samples of the carry."""

RESTS = 1e-3
"""Share of an acceleration limit below which a joint counts as at rest."""

_SLOWER = (0.95, 0.5)
"""Factors tried as the lower end of the search for one, the mildest first."""

_RESOLUTION = 1e-4
"""Of the factor by which a timing is slowed."""


def rests_at_ends(timing: Timing) -> bool:
    """Whether all joints begin and end without acceleration."""
    return acceleration_at_ends(timing) <= RESTS


def acceleration_at_ends(timing: Timing) -> float:
    """Largest acceleration of a joint at either end, over its limit."""
    carry = timing.carry
    assert carry is not None, "a timing that is to be driven has a carry"
    limit = np.concatenate([robot.acceleration_max for robot in carry.workcell.robots])
    return float((np.abs(carry.side_by_side("q_second")[[0, -1]]) / limit).max())


def smoothed(model: TimingModel, timing: Timing, width: float = WIDTH) -> Timing:
    """The timing averaged over a window, within the limits that it was found for.

    Args:
        model: of the timing's workcell.
        timing: one that robots can drive, with its speeds on the grid.
        width: half the width of the window [s].

    Raises:
        JobError: the limits do not hold even at half the speed.
    """
    carry, speed = timing.carry, timing.grid_speed
    assert carry is not None, "a timing that is to be driven has a carry"
    assert speed is not None, "a timing that was found has its speeds"
    u, rate, second = _averaged(speed, width)
    motion = model.path_motion(carry.x).between(u)
    limits = timing.limits

    def driven(factor: float) -> Carry:
        time = np.asarray(EVERY * STEP / factor * np.arange(len(u)))
        return model.carry(motion, time, factor * rate, factor**2 * second)

    @cache
    def excess(factor: float) -> float:
        use = limit_use(driven(factor), model.workcell, limits, model.joint_names)
        return worst(use).ratio - 1.0

    factor = 1.0
    if excess(factor) > 0.0:
        slow = next((slower for slower in _SLOWER if excess(slower) <= 0.0), None)
        if slow is None:
            raise JobError(
                "the carry's timing cannot be smoothed within its limits; choose a slower timing"
            )
        # A root within _RESOLUTION that lies on the slow side.
        factor = brentq(excess, slow, 1.0, xtol=_RESOLUTION / 2.0) - _RESOLUTION
    found = driven(factor)
    use = limit_use(found, model.workcell, limits, model.joint_names)
    place = worst(use).place
    reason = f"{found.duration:.3f} s without jumps of the acceleration; most used: {place}"
    slowed = timing.slowed * factor
    return replace(
        timing, reason=reason, place=place, carry=found, use=use, grid_speed=None, slowed=slowed
    )


def _averaged(grid_speed: Array, width: float) -> tuple[Array, Array, Array]:
    """u, u' and u'' of the averaged timing at every `EVERY`th step."""
    intervals = len(grid_speed) - 1
    grid = np.linspace(0.0, 1.0, intervals + 1)
    steps = 2.0 * np.diff(grid) / (grid_speed[:-1] + grid_speed[1:])
    begins = np.concatenate([[0.0], np.cumsum(steps)])
    reach = int(np.ceil(width / STEP))
    count = int(np.ceil(begins[-1] / STEP)) + 1
    # At rest before and after, for as long as the window reaches beyond what is kept.
    time = STEP * np.arange(-2 * reach, count + 2 * reach)
    interval = np.clip(np.searchsorted(begins, time, side="right") - 1, 0, intervals - 1)
    into = np.clip(time, 0.0, begins[-1]) - begins[interval]
    change = np.diff(grid_speed) / steps
    speed = np.where(
        (time > 0.0) & (time < begins[-1]), grid_speed[interval] + change[interval] * into, 0.0
    )
    place = grid[interval] + (grid_speed[interval] + change[interval] * into / 2.0) * into
    s = np.linspace(-1.0, 1.0, 2 * reach + 1)
    kernel = (1.0 - s**2) ** 3
    slope = -6.0 * s * (1.0 - s**2) ** 2 / (reach * STEP)
    total = kernel.sum()
    u = np.convolve(np.clip(place, 0.0, 1.0), kernel / total, mode="valid")
    rate = np.convolve(speed, kernel / total, mode="valid")
    second = np.convolve(speed, slope / total, mode="valid")
    keep = np.arange(0, len(u) + EVERY - 1, EVERY).clip(max=len(u) - 1)
    return np.clip(u[keep], 0.0, 1.0), np.maximum(rate[keep], 0.0), second[keep]
