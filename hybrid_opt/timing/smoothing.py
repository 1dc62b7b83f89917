"""Smoothing of a timing with jumps of the acceleration.

Time-optimal timings switch accelerations instantaneously, and begin and end with an acceleration.
No controller can follow that. Here the path parameter as a function of time, u(t), is averaged over
a short window with a smooth kernel. Box and arms stay on exactly the same path, begin and end at
rest without acceleration, and the jerk is bounded by the jumps over the width. Speeds are reached a
little earlier or later than before; if a limit is then exceeded, the motion is slowed down
uniformly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hybrid_opt.errors import JobError
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import Timing
from hybrid_opt.timing.solve import check_limits, most_used
from symbolic.array import Array

SMOOTHING_WIDTH = 0.05
"""Half the width of the window [s]."""

LARGEST_WIDTH = 1.0
"""Largest allowed width [s]."""

AVERAGING_STEP = 5e-4
"""Time step of the averaging [s]."""

STEPS_PER_SAMPLE = 4
"""Number of averaging steps between two samples of the carry."""

_SLOWER = (0.95, 0.5)
"""Factors that are tried as the lower end of the search for the slowdown, the mildest first."""

_RESOLUTION = 1e-4
"""Resolution of the factor by which a timing is slowed."""

_UNUSED = 1e-4
"""Share of the most used limit that may be left unused."""

_INSIDE = 0.01
"""Guesses of the factor keep this share of the interval away from its ends."""


def smoothed(model: TimingModel, timing: Timing, width: float) -> Timing:
    """Average a timing over a window of time, then slow it down until it satisfies its limits.

    Args:
        model: timing model of the workcell.
        timing: timing with jumps of acceleration.
        width: half the width of the window [s].

    Raises:
        JobError: the smoothed timing exceeds its limits even at half its speed.
    """
    u, rate, second = _averaged(timing.grid_speed, width)
    motion = model.path_motion(timing.driven.x).interpolate(u)
    limits = timing.limits

    def driven(factor: float) -> _Slowdown:
        time = np.asarray(STEPS_PER_SAMPLE * AVERAGING_STEP / factor * np.arange(len(u)))
        carry = model.carry(motion, time, factor * rate, factor**2 * second)
        ratios = model.carry_limits.ratios(carry, limits)
        found = check_limits(model, carry, limits, ratios)
        columns = [ratio.ravel() for name, ratio in ratios.items() if name != "friction"]
        return _Slowdown(factor, found, most_used(found.use).ratio - 1.0, np.concatenate(columns))

    found = _fastest(driven)
    told = f"{found.timing.duration:.3f} s without jumps of the acceleration; most used: "
    return replace(
        timing,
        reason=f"{told}{found.timing.place}",
        place=found.timing.place,
        carry=found.timing.carry,
        use=found.timing.use,
        grid_speed=np.zeros(0),
        slowed=timing.slowed * found.factor,
    )


@dataclass(frozen=True)
class _Slowdown:
    """A smoothed timing, slowed down by a factor.

    Attributes:
        factor: ratio of the slowed to the original speeds, at most 1.
        timing: the slowed timing.
        excess: largest ratio of a value to its limit, minus one.
        columns: ratios of all values to their limits in one flat array, without friction, which
            every timing uses fully.
    """

    factor: float
    timing: Timing
    excess: float
    columns: Array


def _fastest(driven: Callable[[float], _Slowdown]) -> _Slowdown:
    """Find the largest factor up to 1 on the speeds with which a timing satisfies its limits.

    Args:
        driven: function that returns the timing slowed by a factor.

    Raises:
        JobError: the limits are exceeded even with the factor 0.5.
    """
    fast = driven(1.0)
    if fast.excess <= 0.0:
        return fast
    slow = next((found for found in map(driven, _SLOWER) if found.excess <= 0.0), None)
    if slow is None:
        raise JobError(
            "the carry's timing cannot be smoothed within its limits; choose a slower timing"
        )
    turn = 0
    while slow.excess < -_UNUSED and fast.factor - slow.factor > _RESOLUTION:
        turn += 1
        # Every third is halfway, in case the guesses come nearer from one side only.
        middle = (slow.factor + fast.factor) / 2.0
        between = driven(middle if turn % 3 == 0 else _between(slow, fast))
        if between.excess <= 0.0:
            slow = between
        else:
            fast = between
    return slow


def _between(slow: _Slowdown, fast: _Slowdown) -> float:
    """Estimate the factor on the speeds with which the timing just reaches the limit that `fast`
    exceeds most.

    The estimate is linear in the square of the factor, because accelerations, forces and torques
    are nearly affine in it.

    Args:
        slow: timing slowed by a factor that satisfies the limits.
        fast: timing slowed by a larger factor that exceeds a limit.
    """
    low, high, least = slow.columns, fast.columns, 1.0 - _UNUSED / 2.0
    beyond = (high > least) & (high > low)
    share = ((least - low[beyond]) / (high[beyond] - low[beyond])).min(initial=1.0)
    # Not too near either end: what is not affine would hold it there.
    share = float(np.clip(share, _INSIDE, 1.0 - _INSIDE))
    return float(np.sqrt(slow.factor**2 + share * (fast.factor**2 - slow.factor**2)))


def _averaged(grid_speed: Array, width: float) -> tuple[Array, Array, Array]:
    """Average the path parameter u(t) of a timing over a moving window of time, so that its
    acceleration has no jumps.

    Args:
        grid_speed: path speeds u' on a uniform grid of u [1/s].
        width: half the width of the window [s].

    Returns:
        Samples of u, u' [1/s] and u'' [1/s^2], uniform in time, `STEPS_PER_SAMPLE` times
        `AVERAGING_STEP` apart.
    """
    intervals = len(grid_speed) - 1
    grid = np.linspace(0.0, 1.0, intervals + 1)
    steps = 2.0 * np.diff(grid) / (grid_speed[:-1] + grid_speed[1:])
    begins = np.concatenate([[0.0], np.cumsum(steps)])
    reach = int(np.ceil(width / AVERAGING_STEP))
    count = int(np.ceil(begins[-1] / AVERAGING_STEP)) + 1
    # At rest before and after, for as long as the window reaches beyond what is kept.
    time = AVERAGING_STEP * np.arange(-2 * reach, count + 2 * reach)
    interval = np.clip(np.searchsorted(begins, time, side="right") - 1, 0, intervals - 1)
    into = np.clip(time, 0.0, begins[-1]) - begins[interval]
    change = np.diff(grid_speed) / steps
    speed = np.where(
        (time > 0.0) & (time < begins[-1]), grid_speed[interval] + change[interval] * into, 0.0
    )
    place = grid[interval] + (grid_speed[interval] + change[interval] * into / 2.0) * into
    s = np.linspace(-1.0, 1.0, 2 * reach + 1)
    kernel = (1.0 - s**2) ** 3
    slope = -6.0 * s * (1.0 - s**2) ** 2 / (reach * AVERAGING_STEP)
    total = kernel.sum()
    u = np.convolve(np.clip(place, 0.0, 1.0), kernel / total, mode="valid")
    rate = np.convolve(speed, kernel / total, mode="valid")
    second = np.convolve(speed, slope / total, mode="valid")
    keep = np.arange(0, len(u) + STEPS_PER_SAMPLE - 1, STEPS_PER_SAMPLE).clip(max=len(u) - 1)
    return np.clip(u[keep], 0.0, 1.0), np.maximum(rate[keep], 0.0), second[keep]
