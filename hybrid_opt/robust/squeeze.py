"""How hard to press, over time: normal forces to command, at least what holds the box, smooth.

With N_1 - N_2 fixed by the motion, the force of one arm decides both: the leading arm keeps its
place and feels what follows, the other is force-controlled (`hybrid_opt.robust`). Force
beyond the plan presses both pads against one another and moves nothing.

The plan may assume pads that choose their pressure. What is commanded always holds pads that press
evenly as well (`hybrid_opt.robust.force.soft_model`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter1d

from hybrid_opt.carry import Carry
from hybrid_opt.robust.force import HeldMotion, robust_model, soft_model
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty, Workcell

FACTOR = 1.3
"""Commanded over least force where nothing says how uncertain the cell is."""

RESERVE = 0.10
"""Share by which robust forces are exceeded: they hold a box whose wrenches follow the plan.
Simulated arms hold their pads' orientation instead, and needed up to 10 % more (docs/witness.md).
"""

LARGEST_FACTOR = 10.0
SMOOTHING = 0.1
"""Half the width of the time window over which commanded forces are smoothed [s]."""

STEP = 1e-3
"""Time step of the smoothing [s]."""


@dataclass(frozen=True)
class SqueezeSettings:
    """How hard to press.

    Attributes:
        factor: commanded squeeze over the least that holds; None for the robust force of the
            workcell's uncertainty, and `FACTOR` where it has none.
        leader: index of the arm that keeps its place.
        smoothing: half the width of the time window of the smoothing [s].
    """

    factor: float | None = None
    leader: int = 0
    smoothing: float = SMOOTHING

    def __post_init__(self) -> None:
        if self.factor is not None and not 1.0 <= self.factor <= LARGEST_FACTOR:
            raise SettingsError(
                f"squeeze {self.factor:g}: allowed is 1 to {LARGEST_FACTOR:g} times the least "
                "squeeze that holds"
            )
        if self.leader not in (0, 1):
            raise SettingsError(f"leader {self.leader}: give 0 or 1, the index of an arm")
        if not 2.0 * STEP <= self.smoothing <= 10.0:
            raise SettingsError(
                f"smoothing over {self.smoothing:g} s: allowed is {2.0 * STEP:g} to 10 s"
            )


@dataclass(frozen=True)
class Squeeze:
    """How the commanded forces came about.

    Attributes:
        leader: index of the arm that keeps its place; the other is force-controlled.
        factor: commanded squeeze over the least that holds, None where the forces are robust ones.
        uncertainty: the set that the forces hold for, None where a factor was taken.
        smoothing: half the width of the time window of the smoothing [s].
        even_pads: whether the forces hold pads that press evenly; known for two pads with opposite
            normals.
    """

    leader: int
    factor: float | None
    uncertainty: Uncertainty | None
    smoothing: float
    even_pads: bool = True

    def __str__(self) -> str:
        pads = "pads that press evenly" if self.even_pads else "pads that choose their pressure"
        if self.factor is None:
            return f"holds {pads} in every case of the cell's [uncertainty]"
        return f"{self.factor:g} times the least that holds {pads}"


def chosen_squeeze(workcell: Workcell, settings: SqueezeSettings) -> Squeeze:
    """The settings applied to a workcell."""
    factor, uncertainty = settings.factor, None
    if factor is None and not workcell.uncertainty.is_empty:
        uncertainty = workcell.uncertainty
    elif factor is None:
        factor = FACTOR
    even = workcell.has_opposite_pads
    return Squeeze(settings.leader, factor, uncertainty, settings.smoothing, even)


def extra_force(
    workcell: Workcell, squeeze: Squeeze, time: Array, motion: HeldMotion, least: Array
) -> Array:
    """(n,) what both robots press with beyond the planned normal forces [N].

    Smooth where the planned forces are; with it neither robot ever presses less than the plan, or
    than what holds pads that press evenly, or than the robust force and its reserve, ask for.

    Args:
        time: (n,) of the samples, not decreasing [s].
        motion: of the box at the samples.
        least: (n, 2) planned normal forces [N].

    Raises:
        SettingsError: the uncertainty leaves no friction or patch.
    """
    follower = 1 - squeeze.leader
    planned = least[:, follower]
    if squeeze.uncertainty is not None:
        needed, known = planned, (motion, squeeze.uncertainty, squeeze.leader)
        if squeeze.even_pads:
            needed = np.maximum(needed, soft_model(workcell).hold(*known)[0])
        if workcell.task.allocation != "soft-finger":
            needed = np.maximum(needed, (1.0 + RESERVE) * robust_model(workcell).hold(*known)[0])
    else:
        assert squeeze.factor is not None, "a squeeze has a factor or a set"
        if squeeze.even_pads:
            least = np.maximum(least, soft_model(workcell).nominal(motion))
        needed = least[:, follower] + (squeeze.factor - 1.0) * least.mean(axis=1)
    return smooth_above(time, needed, squeeze.smoothing) - planned


def commanded_forces(
    workcell: Workcell, carry: Carry, settings: SqueezeSettings
) -> tuple[Array, Squeeze]:
    """(n, 2) normal forces to command of both robots along a carry [N], and how they came about.

    Args:
        workcell: states what is uncertain.

    Raises:
        SettingsError: the cell's uncertainty leaves no friction or patch.
    """
    squeeze = chosen_squeeze(workcell, settings)
    extra = extra_force(workcell, squeeze, carry.time, carry, carry.normal_force)
    return carry.normal_force + extra[:, None], squeeze


def smooth_above(time: Array, values: Array, width: float) -> Array:
    """A smooth curve that is nowhere below the given one, level at both ends.

    The largest value within a window, averaged over the same window by a smooth kernel: where the
    kernel reaches, every windowed maximum covers the point in its middle.

    Args:
        time: (n,) not decreasing [s].
        values: (n,) linear between the times.
        width: half the width of the window [s].
    """
    count = max(2, int(np.ceil((time[-1] - time[0]) / STEP)) + 1)
    grid = np.linspace(time[0], time[-1], count)
    step = grid[1] - grid[0]
    reach = int(np.ceil(width / step))
    # Between grid points nothing may be missed: each takes the largest of the steps beside it.
    cell = np.clip(np.searchsorted(grid, time, side="right") - 1, 0, count - 2)
    highest = np.interp(grid, time, values)
    np.maximum.at(highest, cell, values)
    np.maximum.at(highest, cell + 1, values)
    highest = maximum_filter1d(highest, 2 * reach + 1, mode="reflect")
    kernel = (1.0 - np.linspace(-1.0, 1.0, 2 * reach + 1) ** 2) ** 3
    padded = np.pad(highest, reach, mode="symmetric")
    smooth = np.convolve(padded, kernel / kernel.sum(), mode="valid")
    return np.asarray(np.interp(time, grid, smooth))
