"""Timings of a path whose accelerations do not jump: limits on jerk, rest without acceleration.

The fastest timing without jerk limits switches accelerations in no time, and starts at rest with
an acceleration. Here the path is warped first, u = rho(s) with rho' and rho'' zero at both ends:
driven at any speed s' > 0 it starts and ends at rest without acceleration. With v = s'^2, and ' for
d/ds on v and rho,

    u'^2  = rho'^2 v
    u''   = rho'' v + rho' v' / 2
    q'''  = sqrt(v) [(q_uuu rho'^3 + 3 q_uu rho' rho'' + q_u rho''') v
                     + (q_uu rho'^2 + q_u rho'') 3/2 v' + q_u rho' v'' / 2],

so that with v a cubic spline all but the jerk, and what is not convex anyway, is linear or convex
in its coefficients. A jerk within J is |[...]| <= J / sqrt(v), whose right side is convex: its
tangent at the last v lies below it, so every program allows less than the limits do, and the last
v is among what it allows (the convex-concave procedure). The answer is judged between the points at
which limits are imposed; where it exceeds one, less of it is allowed there, and what still does
after some times is slowed down.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import BSpline

from hybrid_opt.carry import Carry
from hybrid_opt.robust.cases import is_squeezed
from hybrid_opt.timing.jerk_program import Point
from hybrid_opt.timing.jerk_step import convex_step
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.path_check import path_failure
from hybrid_opt.timing.path_motion import PathMotion
from hybrid_opt.timing.records import (
    JerkLimits,
    JerkTiming,
    Place,
    Timing,
    TimingLimits,
    TimingStatus,
)
from hybrid_opt.timing.solve import LEAST_SPEED, time_path
from hybrid_opt.timing.use import RECOMPUTED_TOLERANCE, limit_ratios, limit_use, worst
from symbolic.array import Array

PIECES = 60
"""Pieces of the spline of squared speeds."""

POINTS = 4
"""Per piece, at which limits are imposed."""

FINER = 10
"""Points per imposed one at which the answer is judged."""

MAX_ROUNDS = 40
SETTLED = 1e-4
"""Relative change of the duration at which rounds end."""

TIGHTENED = 4
"""Times that a timing is found anew with less of the limits where they were exceeded."""

FIRST_USE = 0.5
"""Largest use of a limit by the slow start that the rounds begin with."""


def time_with_jerk(
    model: TimingModel, x: Array, limits: TimingLimits, jerk: JerkLimits
) -> JerkTiming:
    """A fast timing from rest to rest within all limits, whose accelerations do not jump.

    Args:
        x: (n_var,) decision vector.

    Raises:
        SettingsError: x does not fit the workcell, or limited robust forces have no slopes.
    """
    motion = model.path_motion(x)
    fastest = time_path(model, x, limits, motion)
    if path_failure(model, motion) is not None or not fastest.ok:
        return JerkTiming(fastest, jerk, (np.nan, np.nan), fastest.duration)
    problem = _Problem(model, motion, limits, jerk)
    return replace(problem.solve(), without=fastest.duration)


def drive_with_jerk(model: TimingModel, x: Array) -> JerkTiming | None:
    """A drivable carry x (n_var,) within its own force limit and the cell's limits on jerk; None
    where the cell limits no jerk, and where limited robust forces have no slopes."""
    jerk, limits = JerkLimits.of(model.workcell), model.drive_limits(float(x[-1]))
    if jerk is None or (limits.robust and not is_squeezed(model.workcell)):
        return None
    return time_with_jerk(model, x, limits, jerk)


class _Problem:
    """One path with one set of limits."""

    def __init__(
        self, model: TimingModel, motion: PathMotion, limits: TimingLimits, jerk: JerkLimits
    ) -> None:
        self._model, self._limits, self._jerk = model, limits, jerk
        inner = np.linspace(0.0, 1.0, PIECES + 1)
        self._knots = np.concatenate([np.zeros(3), inner, np.ones(3)])
        self._motion = motion
        self._coarse = self._points(np.linspace(0.0, 1.0, PIECES * POINTS + 1))
        self._fine = self._points(np.linspace(0.0, 1.0, PIECES * POINTS * FINER + 1))

    def _points(self, s: Array) -> Point:
        """Basis of the spline and geometry at some places s."""
        n = len(self._knots) - 4
        splines = BSpline(self._knots, np.eye(n), 3)
        basis = [splines(s), splines.derivative(1)(s), splines.derivative(2)(s)]
        warp = (
            30.0 * (s * (1.0 - s)) ** 2,
            60.0 * s * (1.0 - s) * (1.0 - 2.0 * s),
            60.0 * (1.0 - 6.0 * s + 6.0 * s**2),
        )
        u = np.clip(s**3 * (10.0 - 15.0 * s + 6.0 * s**2), 0.0, 1.0)
        return Point.of(s, basis, warp, self._motion.between(u), self._motion.third(u))

    def solve(self) -> JerkTiming:
        """Rounds until nothing changes; then with less of the limits where the answer exceeds them
        between the points, as often as that helps."""
        c = np.ones(len(self._knots) - 4)
        c, rounds = self._settled(self._slow(c) * c)
        for _ in range(TIGHTENED):
            excess = self._excess(c)
            if excess.max() <= 1.0 + RECOMPUTED_TOLERANCE:
                break
            keep = self._coarse.keep / np.where(excess > 1.0, excess, 1.0)
            self._coarse = replace(self._coarse, keep=keep)
            c, more = self._settled(self._factor(c) ** 2 * c)
            rounds += more
        return replace(self._judged(c), rounds=rounds)

    def _settled(self, c: Array) -> tuple[Array, int]:
        """Rounds from coefficients that keep the limits, and how many."""
        duration = self._coarse.duration(c)
        for rounds in range(1, MAX_ROUNDS + 1):
            found = convex_step(self._model, self._coarse, c, self._limits, self._jerk)
            if found is None:
                return c, rounds
            c, before = found, duration
            duration = self._coarse.duration(c)
            if abs(duration / before - 1.0) < SETTLED:
                break
        return c, rounds

    def _excess(self, c: Array) -> Array:
        """(coarse points,) largest use of a limit at the finer points around each."""
        carry = self._carry(self._fine, c)
        ratios = limit_ratios(carry, self._model.workcell, self._limits)
        del ratios["friction"]
        joint, box = self._jerks(self._fine, c)
        use = np.max([*[ratio.max(axis=1) for ratio in ratios.values()], joint, box], axis=0)
        between = use[1:].reshape(-1, FINER).max(axis=1)
        return np.asarray(np.maximum(np.append(use[0], between), np.append(between, use[-1])))

    def _slow(self, c: Array) -> float:
        """Factor on the squared speeds at which everything is used little, as at rest."""
        factor = 1.0
        rest = max(self._uses(0.0 * c))
        allowed = rest + FIRST_USE * (1.0 - rest)
        while max(self._uses(factor * c)) > allowed:
            factor *= 0.5
        return factor

    def _uses(self, c: Array) -> tuple[float, float, float]:
        """Largest use of the timing's limits, joint jerk and payload jerk at the coarse points."""
        return self._judge(self._coarse, c)[1:]

    def _carry(self, at: Point, c: Array) -> Carry:
        return self._model.carry(at.motion, at.time(c), at.speed(c), at.acceleration(c))

    def _jerks(self, at: Point, c: Array) -> tuple[Array, Array]:
        """(n,) largest joint jerk and payload jerk over their limits."""
        joint, box = at.jerk(c)
        of_joints = (np.abs(joint) / self._jerk.joints).max(axis=1)
        return of_joints, np.linalg.norm(box, axis=1) / self._jerk.payload

    def _judge(self, at: Point, c: Array) -> tuple[Timing, float, float, float]:
        carry = self._carry(at, c)
        use = limit_use(carry, self._model.workcell, self._limits, self._model.joint_names)
        joint, box = (float(jerk.max()) for jerk in self._jerks(at, c))
        excess = worst(use)
        reason = f"{carry.duration:.3f} s; most used: {excess.place}"
        timing = Timing(TimingStatus.OK, reason, excess.place, carry, use, limits=self._limits)
        return timing, excess.ratio, joint, box

    def _factor(self, c: Array) -> float:
        """On the speeds, with which the timing exceeds no limit on the finer grid."""
        if max(self._judge(self._fine, c)[1:]) <= 1.0 + RECOMPUTED_TOLERANCE:
            return 1.0
        low, high = 0.0, 1.0
        for _ in range(14):
            factor = 0.5 * (low + high)
            exceeded = max(self._judge(self._fine, factor**2 * c)[1:]) > 1.0
            low, high = (low, factor) if exceeded else (factor, high)
        return low

    def _judged(self, c: Array) -> JerkTiming:
        """The timing on the finer grid, slowed down where it exceeds a limit."""
        factor = self._factor(c)
        timing, *uses = self._judge(self._fine, factor**2 * c)
        status = TimingStatus.OK if factor >= LEAST_SPEED else TimingStatus.NOT_CONVERGED
        place = timing.place
        if max(uses[1:]) > uses[0]:
            joint = uses[1] >= uses[2]
            place = Place("joint jerk" if joint else "payload jerk", "", "", 0, 0.0)
        timing = replace(timing, status=status, place=place, slowed=factor)
        return JerkTiming(timing, self._jerk, (uses[1], uses[2]), np.nan)
