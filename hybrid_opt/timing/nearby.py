"""What limits cost a fastest timing: how its duration moves as they, or what they limit, move.

A timing is squared path speeds s at grid points. To first order the fastest one near it is a linear
program: least slope of the duration times ds, within what is left of every limit that s nearly
uses. Where a number of the cell makes a ratio of a limited quantity over its limit greater by dr at
the same speeds, that much less is left, and the program says what it costs: dr times the limit's
multiplier, and where limits rule together, as both arms' of a symmetric cell, what the directional
derivative is (the envelope theorem). Neither the timing nor what it uses is found again.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array

from hybrid_opt.timing.given import DrivenSpeeds
from hybrid_opt.timing.limits import limit_ratios
from hybrid_opt.timing.model import REFINEMENT, TimingModel
from hybrid_opt.timing.records import Timing
from symbolic.array import Array
from symbolic.errors import SettingsError

USED = 0.97
"""Share of a limit from which on a change of the timing could exceed it."""

REACH = 0.02
"""Share of every squared speed that a timing nearby may have more or less."""

FASTEST = 5e-3
"""Share of the duration that a fastest timing may have left to gain."""

CHANGE, NOTHING = 1e-4, 1e-10
"""Share of a limit by which changes are extrapolated, and from which on they count as any."""

STEP = 1e-6
"""Share of the largest value by which ratios are differenced."""


class NearTimings:
    """Timings near the fastest one of a path, as a linear program.

    Attributes:
        speeds: of the fastest one.
    """

    def __init__(self, model: TimingModel, timing: Timing) -> None:
        """Linearise the limits that a timing of `time_path` nearly uses.

        Raises:
            SettingsError: there is no timing, or it is not the fastest.
        """
        if timing.carry is None or timing.grid_speed is None:
            raise SettingsError(f"there is no timing: {timing.reason}")
        self.speeds = at = DrivenSpeeds.of(timing.grid_speed)
        motion, intervals = model.path_motion(timing.carry.x), model.intervals

        def ratios(**more: float) -> dict[str, Array]:
            carry = at.carry(model, motion, **more)
            return limit_ratios(carry, model.workcell, timing.limits)

        here = ratios()
        del here["friction"]  # tight by construction
        self._used = {name: np.nonzero(ratio >= USED) for name, ratio in here.items()}
        used = self._at_used(here)
        step_a, step_w = (STEP * float(np.abs(part).max()) for part in (at.a, at.w))
        by_a = (self._at_used(ratios(a=step_a)) - used) / step_a
        by_w = (self._at_used(ratios(w=step_w)) - used) / step_w
        sample = np.concatenate([rows for rows, _ in self._used.values()])
        # Within an interval w = s_0 + share (s_1 - s_0) and a = (s_1 - s_0) / (2 width).
        turn, share, interval = by_a * intervals / 2.0, at.share[sample], sample // (REFINEMENT + 1)
        values = np.concatenate([(1.0 - share) * by_w - turn, share * by_w + turn])
        places = np.tile(np.arange(len(sample)), 2), np.concatenate([interval, interval + 1])
        matrix = csr_array((values, places), shape=(len(sample), intervals + 1))[:, 1:-1]
        speed = timing.grid_speed
        pace = 2.0 / intervals / (speed[:-1] + speed[1:]) ** 2
        slope = -(pace[:-1] + pace[1:]) / (2.0 * speed[1:-1])  # both ends stand still
        scale = speed[1:-1] ** 2  # shares of these are around one
        self._slope, self._matrix = slope * scale, matrix * scale[None, :]
        self._left = np.maximum(1.0 - used, 0.0)
        self._least = self._program(self._left)
        if not self._least > -FASTEST * timing.duration:
            raise SettingsError("the timing is not the fastest within its limits; time it again")

    def changes(self, low: dict[str, Array], high: dict[str, Array]) -> tuple[float, float]:
        """What the duration changes by towards the higher, and towards the lower of two cells as
        far to either side, whose ratios at `speeds` are known [s]; NaN where no timing is near."""
        more = (self._at_used(high) - self._at_used(low)) / 2.0
        largest = float(np.abs(more).max(initial=0.0))
        if largest < NOTHING:
            return 0.0, 0.0
        # Large enough for the program's tolerance.
        times = CHANGE / largest
        rise, fall = (
            (self._program(self._left - sign * times * more) - self._least) / times
            for sign in (1.0, -1.0)
        )
        return rise, fall

    def _at_used(self, ratios: dict[str, Array]) -> Array:
        return np.concatenate([ratios[name][places] for name, places in self._used.items()])

    def _program(self, left: Array) -> float:
        """The least change of the duration [s] with what is `left` (m,) of the limits."""
        found = linprog(
            self._slope,
            A_ub=self._matrix,
            b_ub=left,
            bounds=(-REACH, REACH),
            method="highs",
            options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
        )
        return float(found.fun) if found.status == 0 else float("nan")
