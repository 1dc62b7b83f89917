"""Timings of a path whose accelerations do not jump, as robots drive them: limits on jerk, rest
without acceleration.

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

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from hybrid_opt.errors import JobError
from hybrid_opt.timing.model import PathMotion, TimingModel
from hybrid_opt.timing.programs import (
    LINEARISED_ABOVE,
    SOLVER_MARGIN,
    JerkProgram,
    PathLimits,
    squared_speed_limit,
)
from hybrid_opt.timing.records import (
    FRICTION_RATIO,
    JerkLimits,
    JerkTiming,
    Place,
    Timing,
    TimingLimits,
    TimingStatus,
)
from hybrid_opt.timing.smoothing import SMOOTHING_WIDTH, smoothed
from hybrid_opt.timing.solve import (
    LEAST_SPEED_FACTOR,
    RECOMPUTED_TOLERANCE,
    check_limits,
    largest_speed_factor,
    most_used,
    time_path,
)
from symbolic.array import Array
from symbolic.contact.registry import command_model
from symbolic.records import Workcell

if TYPE_CHECKING:
    pass

SPLINE_SUPPORT = 4
"""Number of basis functions of a cubic spline that are nonzero at a point. They are neighbours."""

SPLINE_PIECES = 60
"""Pieces of the spline of squared speeds."""

POINTS_PER_PIECE = 4
"""Points per piece at which limits apply."""

CHECKS_PER_POINT = 10
"""Points per imposed one at which the answer is checked."""

MAX_JERK_ITERATIONS = 40
DURATION_TOLERANCE = 1e-4
"""Relative change of the duration at which iterations end."""

MAX_TIGHTENINGS = 4
"""How often a timing is recomputed with tighter limits if it exceeds limits between the points."""

START_UTILISATION = 0.5
"""Largest utilisation of a limit by the slow first timing."""

RESTS = 1e-3
"""A joint begins or ends at rest if its acceleration there is below this share of its limit."""

LEAST_COEFFICIENT_SHARE = 0.05
"""Smallest value of a coefficient after a step, as a share of its value before the step."""


def driven_timing(model: TimingModel, x: Array) -> Timing:
    """Compute the timing with which robots drive a carry: the fastest one within the workcell's
    limits and `driven_limits`, with continuous acceleration.

    If the path has no timing, the result states why.

    Args:
        model: timing model of the workcell.
        x: (n_var,) decision vector of the carry.

    Raises:
        JobError: there is no such timing: the smoothed one exceeds a limit even at half its speed,
            or the limits on jerk cannot be satisfied.
    """
    limits = driven_limits(model, x)
    timing = time_path(model, x, limits)
    return (
        without_jumps(model, timing, applicable_jerk_limits(model.workcell, limits))
        if timing.ok
        else timing
    )


def driven_limits(model: TimingModel, x: Array) -> TimingLimits:
    """Return the limits, in addition to the workcell's, of the timing that `driven_timing`
    computes.

    With the drivable time law this is the force limit, the last entry of `x`; otherwise these are
    the reference speeds.

    Args:
        model: timing model of the workcell.
        x: (n_var,) decision vector of the carry.
    """
    if model.workcell.task.law.is_drivable:
        return model.drive_limits(float(x[-1]))
    return TimingLimits(reference_speed=True)


def without_jumps(
    model: TimingModel, timing: Timing, jerk: JerkLimits | None, width: float = SMOOTHING_WIDTH
) -> Timing:
    """Compute a timing of the same path with continuous acceleration, within the limits of the
    given timing.

    With limits on jerk it is a new, fast timing. Without, the given timing is smoothed over a
    window of time and slowed down. If all joint accelerations of the given timing are zero at both
    ends, it is returned unchanged.

    Args:
        model: timing model of the workcell.
        timing: drivable timing with path speeds on the grid.
        jerk: limits on jerk; None to smooth the given timing.
        width: half the width of the smoothing window [s]; zero returns the given timing.

    Raises:
        JobError: the smoothed timing exceeds a limit even at half its speed, or the limits on jerk
            cannot be satisfied.
    """
    if width == 0.0 or has_rest_at_ends(timing):
        return timing
    if jerk is None:
        return smoothed(model, timing, width)
    found = time_with_jerk(model, timing.driven.x, timing.limits, jerk, timing).timing
    if found.carry is None:
        raise JobError(f"no timing within the limits on jerk: {found.reason}")
    return found


def has_rest_at_ends(timing: Timing) -> bool:
    """Return True if all joint accelerations of a timing are zero at beginning and end, up to the
    share `RESTS` of their limits.
    """
    return acceleration_at_ends(timing) <= RESTS


def acceleration_at_ends(timing: Timing) -> float:
    """Compute the largest ratio of a joint acceleration to its limit at the beginning and end of a
    timing.
    """
    carry = timing.driven
    limit = carry.workcell.stack_joint_limits("acceleration_max")
    return float((np.abs(carry.stack_arms("q_second")[[0, -1]]) / limit).max())


def time_with_jerk(
    model: TimingModel,
    x: Array,
    limits: TimingLimits,
    jerk: JerkLimits,
    fastest: Timing | None = None,
) -> JerkTiming:
    """Compute a fast timing from rest to rest within all limits, with continuous accelerations.

    If the path has no timing without jerk limits either, the result states why.

    Args:
        model: timing model of the workcell.
        x: (n_var,) decision vector.
        limits: limits in addition to the workcell's.
        jerk: jerk limits of joints and payload.
        fastest: the timing without jerk limits; computed if None.

    Raises:
        SettingsError: x does not fit the workcell; or `limits` bound robust forces, and the contact
            model has no derivatives of these (`applicable_jerk_limits`).
    """
    motion = model.path_motion(x)
    fastest = fastest or time_path(model, x, limits, motion)
    if not fastest.ok:
        return JerkTiming(fastest, jerk, (np.nan, np.nan), fastest.duration)
    problem = _JerkProblem(model, motion, limits, jerk)
    return replace(problem.solve(), without=fastest.duration)


def applicable_jerk_limits(workcell: Workcell, limits: TimingLimits) -> JerkLimits | None:
    """Return the jerk limits with which a path can be timed within given further limits.

    Args:
        workcell: the cell, which states the jerk limits.
        limits: the further limits.

    Returns:
        The workcell's jerk limits; None if it states none, or if `limits` bound robust forces and
        the contact model has no derivatives of these.
    """
    slopes = not limits.robust or command_model(workcell).has_scalar_squeeze
    return JerkLimits.from_workcell(workcell) if slopes else None


class _JerkProblem:
    """Timing of one path within one set of limits. Its variables are the k spline coefficients c of
    the squared speed v along the path, as in `WarpedPath`.
    """

    def __init__(
        self, model: TimingModel, motion: PathMotion, limits: TimingLimits, jerk: JerkLimits
    ) -> None:
        self._model, self._limits, self._jerk = model, limits, jerk
        self._coarse = WarpedPath.from_motion(motion, SPLINE_PIECES * POINTS_PER_PIECE)
        self._at = PathLimits(model, self._coarse.motion, limits)
        self._fine = WarpedPath.from_motion(
            motion, SPLINE_PIECES * POINTS_PER_PIECE * CHECKS_PER_POINT
        )

    def solve(self) -> JerkTiming:
        """Solve quadratic programs, whose limits apply at coarse points of the path, until the
        duration settles. Then check the result at finer points.

        Where a finer point exceeds a limit, the limits of the neighbouring coarse points are
        tightened and the programs solved again, at most `MAX_TIGHTENINGS` times.
        """
        c = np.ones(self._coarse.value.shape[1])
        c, rounds = self._iterate(self._start_factor(c) * c)
        for _ in range(MAX_TIGHTENINGS):
            excess = self._excess(c)
            if excess.max() <= 1.0 + RECOMPUTED_TOLERANCE:
                break
            keep = self._coarse.keep / np.where(excess > 1.0, excess, 1.0)
            self._coarse = replace(self._coarse, keep=keep)
            c, more = self._iterate(largest_speed_factor(self._use_by_factor(c)) ** 2 * c)
            rounds += more
        return replace(self._checked_timing(c), rounds=rounds)

    def _iterate(self, c: Array) -> tuple[Array, int]:
        """Solve convex programs from feasible spline coefficients c (k,) of the squared speed until
        the duration settles. Return the last coefficients (k,) and the number of programs solved.
        """
        duration = self._coarse.duration(c)
        for rounds in range(1, MAX_JERK_ITERATIONS + 1):
            found = self._step(c)
            if found is None:
                return c, rounds
            c, before = found, duration
            duration = self._coarse.duration(c)
            if abs(duration / before - 1.0) < DURATION_TOLERANCE:
                break
        return c, rounds

    def _step(self, c: Array) -> Array | None:
        """Solve one convex program, linearised at spline coefficients c (k,) of the squared speed.

        Returns:
            Coefficients (k,) with a shorter duration that satisfy all limits at the coarse points;
            None if the program has no solution.
        """
        at, rows = self._coarse, JerkProgram(len(c))
        self._motion_rows(rows)
        self._force_rows(c, rows)
        self._jerk_rows(c, rows)
        rows.add_upper_bounds(
            -np.ones((len(c), 1)), -LEAST_COEFFICIENT_SHARE * c, np.arange(len(c))
        )
        gradient, H = at.objective(c)
        answer = rows.minimise(H, gradient - H @ c, c)
        if answer is None:
            return None
        # The quadratic model promises too much far away: c and the answer are both allowed, and so
        # is everything between them.
        share = 1.0
        while at.duration(c + share * (answer - c)) > at.duration(c) and share > 1e-3:
            share *= 0.5
        return np.asarray(c + share * (answer - c))

    def _motion_rows(self, rows: JerkProgram) -> None:
        """Add limits on speeds and accelerations of joints and box to the program `rows`."""
        at, first_basis = self._coarse, self._coarse.first_basis
        squared_by, acceleration_by = at.local(at.squared_by), at.local(at.acceleration_by)
        most = squared_speed_limit(self._model, at.motion, self._limits)
        rows.add_upper_bounds(squared_by / np.minimum(most, 1e6)[:, None], at.keep, first_basis)
        alpha, beta = self._at.joint_accelerations()
        by = alpha[:, :, None] * acceleration_by[:, None, :]
        by = by + beta[:, :, None] * squared_by[:, None, :]
        rows.add_two_sided_bounds(by, 0.0, at.keep, first_basis)
        for first, second, limit in self._at.accelerations():
            A = first[:, :, None] * acceleration_by[:, None]
            A = A + second[:, :, None] * squared_by[:, None]
            none = np.zeros_like(squared_by)
            rows.add_norm_bounds(A / limit, np.zeros((len(at.s), 3)), none, at.keep, first_basis)

    def _force_rows(self, c: Array, rows: JerkProgram) -> None:
        """Add limits on normal forces, joint torques and shifts of the pressure, linearised at the
        coefficients c (k,), to the program `rows`.
        """
        at = self._coarse
        a, w = at.acceleration_by @ c, np.maximum(at.squared_by @ c, 0.0)
        along = np.stack([at.acceleration_by, at.squared_by], axis=1)[:, None]
        for force, slope in self._at.forces(a, w):
            _add_linearised(at, c, force, (slope[..., None] * along).sum(axis=2), rows)
        value = self._at.ratios(a, w)
        near = (np.abs(value) > LINEARISED_ABOVE).any(axis=0)
        if not near.any():
            return
        slope = self._at.ratio_slopes(value, a, w)[:, near]
        by = (slope[..., None] * along).sum(axis=2)
        for sign in (1.0, -1.0):
            _add_linearised(at, c, sign * value[:, near], sign * by, rows)

    def _jerk_rows(self, c: Array, rows: JerkProgram) -> None:
        """Add limits on the jerks of joints and payload to the convex program `rows`.

        With the squared speed v, jerk / sqrt(v) is linear in the spline coefficients. Its bound,
        limit / sqrt(v), is replaced by the tangent at the coefficients c (k,).
        """
        at, jerk, v = self._coarse, self._jerk, self._coarse.value @ c
        # Multiplied by sqrt(v) of the last round, so that rows are of order one.
        root = np.sqrt(v)
        level = at.keep * (1.5 / root) * root
        head = (at.keep * (0.5 * v**-1.5) * root)[:, None] * at.local(at.value)
        limited = np.isfinite(jerk.joints)
        by = at.joint_jerk_by[:, limited] / jerk.joints[limited, None] * root[:, None, None]
        rows.add_two_sided_bounds(by, head[:, None], level, at.first_basis)
        if np.isfinite(jerk.payload):
            box = at.box_jerk_by / jerk.payload * root[:, None, None]
            rows.add_norm_bounds(box, np.zeros((len(v), 3)), head, level, at.first_basis)

    def _excess(self, c: Array) -> Array:
        """Compute for each of n coarse points the largest ratio (n,) of value to limit at the finer
        points around it, over all limits.

        Args:
            c: (k,) spline coefficients of the squared speed.
        """
        carry = self._model.carry(self._fine.motion, *self._fine.profile(c))
        ratios = self._model.carry_limits.ratios(carry, self._limits)
        del ratios[FRICTION_RATIO]
        joint, box = self._jerks(self._fine, c)
        use = np.max([*[ratio.max(axis=1) for ratio in ratios.values()], joint, box], axis=0)
        between = use[1:].reshape(-1, CHECKS_PER_POINT).max(axis=1)
        return np.asarray(np.maximum(np.append(use[0], between), np.append(between, use[-1])))

    def _start_factor(self, c: Array) -> float:
        """Return a factor on spline coefficients c (k,) of the squared speed that makes the motion
        slow enough for a first iterate.

        With r the largest ratio of a quantity to its limit at rest, all ratios of the slowed motion
        are at most r + `START_UTILISATION` (1 - r).
        """
        factor = 1.0
        rest = max(self._check(self._coarse, 0.0 * c)[1:])
        allowed = rest + START_UTILISATION * (1.0 - rest)
        while max(self._check(self._coarse, factor * c)[1:]) > allowed:
            factor *= 0.5
        return factor

    def _jerks(self, at: WarpedPath, c: Array) -> tuple[Array, Array]:
        """Compute jerks over their limits at n points, for spline coefficients c (k,) of the
        squared speed.

        Returns:
            The largest joint jerk and the payload jerk at each point, (n,) each.
        """
        joint, box = at.jerk(c)
        stack_joint_limits = (np.abs(joint) / self._jerk.joints).max(axis=1)
        return stack_joint_limits, np.linalg.norm(box, axis=1) / self._jerk.payload

    def _check(self, at: WarpedPath, c: Array) -> tuple[Timing, float, float, float]:
        carry = self._model.carry(at.motion, *at.profile(c))
        timing = check_limits(self._model, carry, self._limits)
        joint, box = (float(jerk.max()) for jerk in self._jerks(at, c))
        return timing, most_used(timing.use).ratio, joint, box

    def _use_by_factor(self, c: Array) -> Callable[[float], float]:
        """Return a function that maps a factor on all speeds to the largest ratio of a quantity to
        its limit at the finer points.

        Args:
            c: (k,) spline coefficients of the squared speed at factor 1.
        """
        jerk = max(float(jerk.max()) for jerk in self._jerks(self._fine, c))

        def use(f: float) -> float:
            carry = self._model.carry(self._fine.motion, *self._fine.profile(f**2 * c))
            timing = check_limits(self._model, carry, self._limits)
            return max(most_used(timing.use).ratio, f**3 * jerk)

        return use

    def _checked_timing(self, c: Array) -> JerkTiming:
        """Check the timing with spline coefficients c (k,) on the finer grid, and slow it down
        uniformly if it exceeds a limit there.
        """
        factor = largest_speed_factor(self._use_by_factor(c))
        timing, *uses = self._check(self._fine, factor**2 * c)
        status = TimingStatus.OK if factor >= LEAST_SPEED_FACTOR else TimingStatus.NOT_CONVERGED
        place = timing.place
        if max(uses[1:]) > uses[0]:
            joint = uses[1] >= uses[2]
            place = Place("joint jerk" if joint else "payload jerk", "", "", 0, 0.0)
        timing = replace(timing, status=status, place=place, slowed=factor)
        return JerkTiming(timing, self._jerk, (uses[1], uses[2]), np.nan)


@dataclass(frozen=True)
class WarpedPath:
    """A path at n samples of its warped parameter s, u = s^3 (10 - 15 s + 6 s^2), with linear maps
    from spline coefficients to the motion there.

    The k coefficients c are those of v = s'^2, a cubic spline in s.

    Attributes:
        s: (n,) warped parameter in [0, 1].
        value: (n, k) matrix from coefficients to v [1/s^2].
        squared_by, acceleration_by: (n, k) matrices from coefficients to u'^2 and to u'' [1/s^2].
        motion: geometry of the path at the samples, differentiated by u.
        columns: (n, SPLINE_SUPPORT) indices of the coefficients that influence each sample.
        joint_jerk_by, box_jerk_by: (n, joints, SPLINE_SUPPORT) and (n, 3, SPLINE_SUPPORT), matrices
            from these coefficients to jerk / sqrt(v).
        keep: (n,) share of every limit that a program may use.
    """

    s: Array
    value: Array
    squared_by: Array
    acceleration_by: Array
    motion: PathMotion
    columns: NDArray[np.intp]
    joint_jerk_by: Array
    box_jerk_by: Array
    keep: Array

    @classmethod
    def from_motion(cls, motion: PathMotion, intervals: int) -> WarpedPath:
        """Sample the path of `motion` at the ends of `intervals` equal intervals of its warped
        parameter s, both ends of the path included.
        """
        s, inner = np.linspace(0.0, 1.0, intervals + 1), np.linspace(0.0, 1.0, SPLINE_PIECES + 1)
        knots = np.concatenate([np.zeros(3), inner, np.ones(3)])
        splines = BSpline(knots, np.eye(len(knots) - 4), 3)
        value, first, second = splines(s), splines.derivative(1)(s), splines.derivative(2)(s)
        warp = (
            30.0 * (s * (1.0 - s)) ** 2,
            60.0 * s * (1.0 - s) * (1.0 - 2.0 * s),
            60.0 * (1.0 - 6.0 * s + 6.0 * s**2),
        )
        one, two, three = (part[:, None] for part in warp)
        u = np.clip(s**3 * (10.0 - 15.0 * s + 6.0 * s**2), 0.0, 1.0)
        third, motion = motion.third_derivatives(u), motion.interpolate(u)
        begins = np.minimum(np.argmax(value != 0.0, axis=1), value.shape[1] - SPLINE_SUPPORT)
        columns = begins[:, None] + np.arange(SPLINE_SUPPORT)
        local = [np.take_along_axis(b, columns, axis=1)[:, None] for b in (value, first, second)]

        def jerk(by_u: Array, by_uu: Array, by_uuu: Array) -> Array:
            on_value = by_uuu * one**3 + 3.0 * by_uu * one * two + by_u * three
            on_first = 1.5 * (by_uu * one**2 + by_u * two)
            on_second = 0.5 * by_u * one
            parts = zip((on_value, on_first, on_second), local, strict=True)
            return np.asarray(sum(a[:, :, None] * b for a, b in parts))

        box = (motion.pose_first[:, :3], motion.pose_second[:, :3])
        return cls(
            s,
            value,
            one**2 * value,
            two * value + one * first / 2.0,
            motion,
            columns,
            jerk(motion.q_first, motion.q_second, third[0]),
            jerk(*box, third[1]),
            np.full(len(s), 1.0 - SOLVER_MARGIN),
        )

    @property
    def first_basis(self) -> NDArray[np.intp]:
        """Index of the first coefficient that influences each sample, (n,)."""
        return self.columns[:, 0]

    def local(self, values: Array) -> Array:
        """Select, for each of n samples, the entries that belong to the `SPLINE_SUPPORT`
        coefficients that influence it.

        Args:
            values: (n, ..., k) one entry per sample and coefficient.

        Returns:
            (n, ..., SPLINE_SUPPORT) the selected entries.
        """
        shape = (len(self.columns), *[1] * (values.ndim - 2), SPLINE_SUPPORT)
        return np.take_along_axis(values, self.columns.reshape(shape), axis=-1)

    def duration(self, c: Array) -> float:
        """Compute the duration [s] by Simpson's rule; the number of samples has to be odd.

        Args:
            c: (k,) spline coefficients of the squared speed.
        """
        return float(self._weights() @ (1.0 / np.sqrt(np.maximum(self.value @ c, 1e-300))))

    def _weights(self) -> Array:
        weights = np.where(np.arange(len(self.s)) % 2 == 1, 4.0, 2.0)
        weights[[0, -1]] = 1.0
        return weights / (3.0 * (len(self.s) - 1))

    def profile(self, c: Array) -> tuple[Array, Array, Array]:
        """Compute the motion along the path with spline coefficients c (k,) of the squared speed.

        Returns:
            Times [s] of the samples, path speeds u' [1/s] and path accelerations u'' [1/s^2], (n,)
            each. For rest (all coefficients zero) the path parameter s takes the place of the
            times.
        """
        v, time = self.value @ c, self.s
        if v.any():
            slowness = 1.0 / np.sqrt(v)
            steps = np.diff(self.s) * (slowness[1:] + slowness[:-1]) / 2.0
            time = np.concatenate([[0.0], np.cumsum(steps)])
        return time, np.sqrt(np.maximum(self.squared_by @ c, 0.0)), self.acceleration_by @ c

    def jerk(self, c: Array) -> tuple[Array, Array]:
        """Compute the jerks of the joints (n, joints) [rad/s^3] and of the box frame's origin (n,
        3) [m/s^3], world frame.

        Args:
            c: (k,) spline coefficients of the squared speed.
        """
        root = np.sqrt(np.maximum(self.value @ c, 0.0))[:, None]
        own = c[self.columns][:, None]
        return root * (self.joint_jerk_by * own).sum(-1), root * (self.box_jerk_by * own).sum(-1)

    def objective(self, c: Array) -> tuple[Array, Array]:
        """Return gradient (k,) and Hessian (k, k) of the duration by the coefficients, at the
        values c (k,).
        """
        v, weights = self.value @ c, self._weights()
        gradient = -0.5 * self.value.T @ (weights * v**-1.5)
        return gradient, 0.75 * (self.value.T * (weights * v**-2.5)) @ self.value


def _add_linearised(at: WarpedPath, c: Array, value: Array, by: Array, rows: JerkProgram) -> None:
    """Add the rows value + by (c_new - c) <= bound for limited values, linearised at spline
    coefficients c. The bound is 1, less where limits are tightened.

    A value that exceeds its bound at c gets the value itself as bound, so that c stays feasible.

    Args:
        at: samples of the path.
        c: (k,) spline coefficients of the squared speed.
        value: (n, m) ratios of the values at c to their limits.
        by: (n, m, k) derivatives of the ratios by the coefficients.
        rows: convex program that gets the rows.
    """
    bound = np.maximum(at.keep[:, None], value) - value + by @ c
    A = at.local(by)
    first = np.repeat(at.first_basis, by.shape[1])
    rows.add_upper_bounds(A.reshape(-1, A.shape[2]), bound.reshape(-1), first)
