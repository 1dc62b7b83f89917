"""Limits of a carry: errors of its path, limits along the path as functions of the timing, and the
utilisation of each limit, recomputed from physical quantities alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.carry import Carry
from hybrid_opt.robust.force import robust_model
from hybrid_opt.robust.path_force import BY_TIMING, PathPoints, robust_path
from hybrid_opt.timing.model import REFINEMENT, PathMotion, TimingModel
from hybrid_opt.timing.records import (
    FRICTION_RATIO,
    PER_JOINT,
    Place,
    Timing,
    TimingLimits,
    TimingStatus,
    Utilisation,
    limit_place,
)
from symbolic.array import Array
from symbolic.contact.registry import command_model, contact_model
from symbolic.errors import SettingsError
from symbolic.functions import TIMING_TOLERANCE
from symbolic.limits import LIMITS, Limit, limits_of_block
from symbolic.records import Workcell

FRICTION_ROUNDING = 1e-6
"""The least-effort forces are on the friction cones; an excess up to this is rounding."""

RECOMPUTED_TOLERANCE = TIMING_TOLERANCE
"""Largest accepted excess of a recomputed limit, as a share of it."""

LEAST_SPEED_FACTOR = 0.98
"""A timing that has to be slowed further to satisfy its limits has not converged."""

LINEARISED_ABOVE = 0.6
"""Torques and shifts below this share of their limit enter no program."""

EXACT_FORCE_ABOVE = 0.98
"""Robust forces above this share of a limit are computed exactly."""

FACTOR_TOLERANCE = 1e-4
"""Share of a limit that a factor on the speeds may leave unused."""

PEAK_SEARCH_STRIDE = 20
"""Stride of the samples in the search for the largest robust force."""

ROBUST_BATCH = 2000
"""Samples of a carry whose cases are in memory together."""

LEAST_NORMAL_FORCE = 1e-9
"""A contact with less normal force carries nothing [N]."""

LEAST_MOTION = 1e-9
"""A path along which box and joints move less does not move [m, rad]."""

ARM_CHECKS = (
    (TimingStatus.OFF_PATH, "reach", "loses the path"),
    (TimingStatus.JOINT_LIMITS, "joint position", "leaves its joint range"),
    (TimingStatus.NEAR_SINGULAR, "manipulability", "comes too near a singular posture"),
)
"""Errors of an arm along a path, in the order of reporting: the timing's status, its name in a
`Place`, and the robot's failure, for people."""


def arm_path_error(
    workcell: Workcell, pose: Array, lost: Array, limit_margin: Array, manipulability: Array
) -> Timing | None:
    """Return the error of a path without feasible timing, with arm and place, else None.

    Args:
        pose: (n, 6) box poses at uniform samples.
        lost, limit_margin, manipulability: (n, 2) by sample and arm, as of
            `symbolic.robot.arm.TRACK_OUTPUTS`.
    """
    if float(np.abs(pose - pose[0]).max()) < LEAST_MOTION:
        reason = "all poses of the path are the same: there is nothing to time"
        return Timing(TimingStatus.NO_MOTION, reason, Place("path length", "", "", 0, 0.0), None)
    least = [robot.min_manipulability for robot in workcell.robots]
    found = (lost > 0.5, limit_margin < 0.0, manipulability < least)
    for failed, (status, constraint, text) in zip(found, ARM_CHECKS, strict=True):
        if failed.any():
            sample = int(np.argmax(failed.any(axis=1)))
            robot = workcell.robots[int(np.argmax(failed[sample]))].name
            place = Place(constraint, robot, "", sample, sample / (len(pose) - 1))
            reason = f"robot {robot!r} {text} at u = {place.parameter:.4f}"
            return Timing(status, reason, place, None)
    return None


def path_error(model: TimingModel, motion: PathMotion) -> Timing | None:
    """Return the error of a path without feasible timing, else None."""
    arms = motion.lost, motion.limit_margin, motion.manipulability
    return arm_path_error(model.workcell, motion.pose, *arms)


class PathLimits:
    """Limits of a path at samples, as functions of (u'', u'^2) over the limits.

    Speeds are in `squared_speed_limit`. Robust forces of pads without one squeeze
    (`ContactModel.has_scalar_squeeze`) are among the ratios.

    Attributes:
        motion: geometry of the path at the samples.
    """

    def __init__(self, model: TimingModel, motion: PathMotion, limits: TimingLimits) -> None:
        self.motion, self._model, self._limits = motion, model, limits
        workcell = model.workcell
        self._squeezed = limits.robust and command_model(workcell).has_scalar_squeeze
        self._grasped = limits.robust and not self._squeezed

    def joint_accelerations(self) -> tuple[Array, Array]:
        """Return the joint accelerations (n, all joints) by u'' and by u'^2, over their limits,
        which apply to both signs."""
        (limit,) = limits_of_block("acceleration")
        first, second = self._derivatives(limit)
        bound = bound_of(limit, self._model.workcell)
        return first / bound, second / bound

    def accelerations(self) -> list[tuple[Array, Array, float]]:
        """Return the payload's accelerations (n, 3) by u'' and by u'^2, and the limits on their
        lengths."""
        return [
            (first[:, :3], second[:, :3], float(bound_of(limit, self._model.workcell)))
            for limit in limits_of_block("cone")
            for first, second in [self._derivatives(limit)]
        ]

    def _derivatives(self, limit: Limit) -> tuple[Array, Array]:
        m, name = self.motion, limit.path
        return getattr(m, f"{name}_first"), getattr(m, f"{name}_second")

    def forces(self, a: Array, w: Array) -> list[tuple[Array, Array]]:
        """Compute normal forces (n, 2) that are convex in (u'', u'^2), and their slopes (n, 2, 2),
        at u'' = a and u'^2 = w (n,), over the limit: planned ones, and robust ones if these are
        limited."""
        model, limit = self._model, self._limits.force
        if limit is None:
            return []
        found = [model.path_force(self.motion, a, w)]
        if self._squeezed:
            force, slope = robust_path(model.workcell).at(self._points(a, w))
            found.append((force, slope[:, :, BY_TIMING]))
        return [(force / limit, slope / limit) for force, slope in found]

    def ratios(self, a: Array, w: Array) -> Array:
        """Compute limits that are not convex, signed (n, k)."""
        m, workcell, limits = self.motion, self._model.workcell, self._limits
        pressure = has_pressure_limit(workcell, limits)
        force = limits.force if self._grasped else None
        columns = [np.zeros((len(a), 0))]
        if not (limits.torque or pressure or force):
            return columns[0]
        load = self._model.drive(m, np.sqrt(w), a)
        if limits.torque:
            own = m.torque_by_acceleration * a[:, None] + m.torque_by_speed * w[:, None]
            torque = self._model.contact_torque(m.wrench_torque, load) + own + m.torque_at_rest
            columns.append(torque / workcell.stack_joint_limits("torque_max"))
        if pressure:
            radius = np.array([contact.patch_radius for contact in workcell.contacts])
            columns.append(load["pressure_shift"] / radius)
        if force:
            moved = self._points(a, w).motion
            commanded, leading = robust_model(workcell).hold(moved, workcell.uncertainty)
            columns.append(np.stack([leading, commanded], axis=1) / force)
        return np.concatenate(columns, axis=1)

    def ratio_slopes(self, ratios: Array, a: Array, w: Array) -> Array:
        """Compute the slopes (n, k, 2) of `ratios` at a and w by (u'', u'^2), by forward
        differences."""
        step_a = 1e-5 * max(float(np.abs(a).max()), 1e-6)
        step_w = 1e-5 * max(float(w.max()), 1e-6)
        by_a = (self.ratios(a + step_a, w) - ratios) / step_a
        return np.stack([by_a, (self.ratios(a, w + step_w) - ratios) / step_w], axis=-1)

    def _points(self, a: Array, w: Array) -> PathPoints:
        m = self.motion
        return PathPoints(m.pose[:, :6], m.pose_first[:, :6], m.pose_second[:, :6], a, w)


def squared_speed_limit(motion: PathMotion, workcell: Workcell, limits: TimingLimits) -> Array:
    """Return the largest u'^2 (n,) by all limits on speeds; infinite where nothing moves."""
    task = workcell.task
    demands = []
    for limit in limits_of_block("speed"):
        if limit.path:
            values = getattr(motion, f"{limit.path}_first")
            values = np.abs(values) if limit.scope == "joint" else _norm(values[:, :3])
            demands.append((values / bound_of(limit, workcell)).max(axis=1))
    if limits.reference_speed:
        linear, angular = _norm(motion.pose_first[:, :3]), _norm(motion.angular_first)
        demands += [
            linear[:, 0] / task.reference_speed,
            angular[:, 0] / task.reference_angular_speed,
        ]
    demand = np.max(demands, axis=0)
    with np.errstate(divide="ignore"):
        squared: Array = 1.0 / demand**2
    return squared


def duration_at_speed_limits(model: TimingModel, motion: PathMotion, limits: TimingLimits) -> float:
    """Return the duration [s] of a path driven at its speed limits alone, without ramps."""
    squared = squared_speed_limit(motion, model.workcell, limits)
    slowness = 1.0 / np.sqrt(np.minimum(squared, 1e8))
    return float(np.trapezoid(slowness, motion.parameter))


def limit_ratios(carry: Carry, workcell: Workcell, limits: TimingLimits) -> dict[str, Array]:
    """Compute every limited quantity over its limit at every sample.

    Returns:
        By name of `symbolic.limits.LIMITS`, and friction: (n, all joints) for joints, (n, 2) for
        robots, (n, 1) for the payload; only the limits that apply.
    """
    friction = np.array([contact.friction for contact in workcell.contacts])
    bound = np.maximum(carry.normal_force * friction, LEAST_NORMAL_FORCE)
    ratios = {FRICTION_RATIO: carry.tangential_force / bound}
    for limit in LIMITS:
        if not applies(limit, workcell, limits):
            continue
        if limit.block == "force":
            assert limits.force is not None
            ratios[limit.name] = _near_limit(carry, workcell, limits) / limits.force
        elif not limit.carry:
            # The reference speeds: of the two limits on the payload's speed.
            task = workcell.task
            ratios[limit.name] = np.maximum(
                _norm(carry.rate[:, :3]) / task.reference_speed,
                _norm(carry.angular_velocity) / task.reference_angular_speed,
            )
        elif limit.scope == "joint":
            ratios[limit.name] = np.abs(carry.stack_arms(limit.carry)) / bound_of(limit, workcell)
        elif limit.scope == "payload":
            vector = getattr(carry, limit.carry)[:, :3]
            ratios[limit.name] = _norm(vector) / bound_of(limit, workcell)
        else:
            ratios[limit.name] = getattr(carry, limit.carry) / bound_of(limit, workcell)
    return ratios


def applies(limit: Limit, workcell: Workcell, limits: TimingLimits) -> bool:
    """Return True if one of `LIMITS` applies."""
    if limit.option == "pressure":
        return has_pressure_limit(workcell, limits)
    return not limit.option or bool(getattr(limits, limit.option))


def bound_of(limit: Limit, workcell: Workcell) -> Array:
    """Return the largest values of a limited quantity: (all joints,), (2,) robots, or of the
    payload."""
    if limit.scope == "joint":
        return workcell.stack_joint_limits(limit.bound)
    if limit.scope == "payload":
        return np.asarray(getattr(workcell.payload, limit.bound), dtype=float)
    return np.array([getattr(contact, limit.bound) for contact in workcell.contacts])


def limited_force(carry: Carry, workcell: Workcell, limits: TimingLimits) -> Array:
    """Return the limited normal forces (n, 2): planned, and robust ones if these are limited."""
    if not limits.robust:
        return carry.normal_force
    commanded, leading = robust_model(workcell).hold(carry, workcell.uncertainty)
    return np.maximum(carry.normal_force, np.stack([leading, commanded], axis=1))


def _near_limit(carry: Carry, workcell: Workcell, limits: TimingLimits) -> Array:
    """Compute `limited_force`, exactly only where it matters.

    Robust forces below `EXACT_FORCE_ABOVE` of the limit and below the carry's largest are replaced
    by the planned ones, which takes a fraction of the time.
    """
    if not limits.robust or limits.force is None:
        return limited_force(carry, workcell, limits)
    if not command_model(workcell).has_scalar_squeeze:
        return limited_force(carry, workcell, limits)
    n = len(carry)
    points = PathPoints(carry.pose, carry.rate, carry.second_rate, np.zeros(n), np.ones(n))
    found = carry.normal_force.copy()
    if _robust_forces_above(EXACT_FORCE_ABOVE * limits.force, points, workcell, found):
        return found
    # Nearly the largest one is among a few; only what exceeds that can be larger.
    _robust_forces_above(0.0, points, workcell, found, every=PEAK_SEARCH_STRIDE)
    _robust_forces_above(float(found.max()), points, workcell, found)
    return found


def _robust_forces_above(
    level: float, points: PathPoints, workcell: Workcell, found: Array, every: int = 1
) -> bool:
    """Write the robust forces above a level [N], of every `every`-th point, into forces (n, 2);
    return True if there are any."""
    known, rows = False, np.arange(0, len(points), every)
    for part in np.array_split(rows, -(-len(rows) // ROBUST_BATCH)):
        least = np.full(len(part), level)
        above, ruling = robust_path(workcell).governing_above(points.at(part), least)
        found[part[above]] = np.maximum(found[part[above]], ruling.force)
        known = known or len(above) > 0
    return known


def has_pressure_limit(workcell: Workcell, limits: TimingLimits) -> bool:
    """Return True if the pressure's shift is a limit."""
    return limits.pressure and contact_model(workcell).has_pressure_limit


def check_limits(
    model: TimingModel,
    carry: Carry,
    limits: TimingLimits,
    ratios: Mapping[str, Array] | None = None,
) -> Timing:
    """Return a carry as a timing with status `OK`, with the utilisation of its limits.

    Args:
        ratios: its `limit_ratios`, if known.
    """
    ratios = limit_ratios(carry, model.workcell, limits) if ratios is None else ratios
    use = dict[str, Utilisation]()
    for name, ratio in ratios.items():
        sample, column = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
        where = int(column), int(sample), float(carry.parameter[sample])
        place = limit_place(model.workcell, model.joint_names, name, *where)
        use[name] = Utilisation(float(ratio[sample, column]), place)
    place = most_used(use).place
    reason = f"{carry.duration:.3f} s; most used: {place}"
    return Timing(TimingStatus.OK, reason, place, carry, use, limits=limits)


def joint_use(carry: Carry, workcell: Workcell) -> dict[str, Array]:
    """Return the largest utilisation of every joint's limits over the carry, (all joints,) per
    joint constraint; `contact torque` is the share of the contact wrench alone."""
    ratios = limit_ratios(carry, workcell, TimingLimits())
    use = {name: ratios[name].max(axis=0) for name in PER_JOINT}
    limit = workcell.stack_joint_limits("torque_max")
    return use | {"contact torque": (np.abs(carry.contact_torque) / limit).max(axis=0)}


def largest_speed_factor(use: Callable[[float], float]) -> float:
    """Return the largest factor on the speeds, at most one, without an exceeded limit, by a
    function of the factor to the largest utilisation; one if none exceeds `RECOMPUTED_TOLERANCE`.
    """
    fast = use(1.0)
    if fast <= 1.0 + RECOMPUTED_TOLERANCE:
        return 1.0
    # What limits are about grows about as the square of the speeds does.
    low, high, slow, turn = 0.0, 1.0, 0.0, 0
    while slow < 1.0 - FACTOR_TOLERANCE and high - low > FACTOR_TOLERANCE / 2.0:
        turn += 1
        share = (1.0 - FACTOR_TOLERANCE / 2.0 - slow) / (fast - slow)
        factor = np.sqrt(low**2 + share * (high**2 - low**2))
        # Every third is halfway, in case the guesses come nearer from one side only.
        factor = float((low + high) / 2.0 if turn % 3 == 0 else factor)
        found = use(factor)
        if found > 1.0:
            high, fast = factor, found
        else:
            low, slow = factor, found
    return low


def most_used(use: dict[str, Utilisation]) -> Utilisation:
    """Return the largest utilisation; friction, tight by construction, counts only if violated."""
    candidates = [
        excess
        for name, excess in use.items()
        if name != FRICTION_RATIO or excess.ratio > 1.0 + FRICTION_ROUNDING
    ]
    return max(candidates, key=lambda excess: excess.ratio)


def _norm(vectors: Array) -> Array:
    length: Array = np.linalg.norm(vectors, axis=1, keepdims=True)
    return length


@dataclass(frozen=True)
class SpeedProfile:
    """Path speeds with constant u'' on intervals, at `REFINEMENT` samples per interval, both ends
    of every interval included.

    Attributes:
        index: (n,) of the samples among those of a path's motion.
        time: (n,) [s].
        share: (n,) positions of the samples within their intervals.
        a, w: (n,) u'' and u'^2.
    """

    index: NDArray[np.intp]
    time: Array
    share: Array
    a: Array
    w: Array

    @classmethod
    def from_grid_speed(cls, grid_speed: Array) -> SpeedProfile:
        """Sample path speeds u' at the grid points (intervals + 1,) [1/s]."""
        squared, intervals = grid_speed**2, len(grid_speed) - 1
        share = np.linspace(0.0, 1.0, REFINEMENT + 1)
        w = squared[:-1, None] + np.outer(np.diff(squared), share)
        speed = np.sqrt(np.maximum(w, 0.0))
        # Average speed over a piece of constant acceleration is that of its ends.
        total = speed[:, :1] + speed
        elapsed = 2.0 * share / intervals / np.where(total > 0.0, total, 1.0)
        starts = np.concatenate([[0.0], np.cumsum(elapsed[:, -1])])[:-1]
        index = REFINEMENT * np.arange(intervals)[:, None] + np.arange(REFINEMENT + 1)
        return cls(
            index.reshape(-1),
            (starts[:, None] + elapsed).reshape(-1),
            np.tile(share, intervals),
            np.repeat(np.diff(squared) * intervals / 2.0, REFINEMENT + 1),
            w.reshape(-1),
        )

    def carry(
        self, model: TimingModel, motion: PathMotion, a: float = 0.0, w: float = 0.0
    ) -> Carry:
        """Return the carry of a path at these speeds, with `a` added to u'' and `w` to u'^2
        everywhere."""
        speed = np.sqrt(np.maximum(self.w + w, 0.0))
        return model.carry(motion.at(self.index), self.time, speed, self.a + a)


def drive_path(
    model: TimingModel,
    x: Array,
    grid_speed: Array,
    limits: TimingLimits,
    motion: PathMotion | None = None,
) -> Timing:
    """Check a given timing of a path against every limit.

    Args:
        model: its intervals are those of the timing.
        x: (n_var,) decision vector.
        grid_speed: (intervals + 1,) path speed u' at the grid points [1/s].
        motion: geometry of the path, if known.

    Returns:
        Status `OK`, or `EXCEEDED` with the limit and the place; or the error of the path itself.

    Raises:
        SettingsError: x or the speeds do not fit.
    """
    grid_speed = np.asarray(grid_speed, dtype=float)
    moves = np.all(grid_speed[:-1] + grid_speed[1:] > 0.0) if grid_speed.ndim == 1 else False
    if grid_speed.shape != (model.intervals + 1,) or not moves:
        raise SettingsError(
            f"path speeds of shape {grid_speed.shape}; needs {model.intervals + 1} that never "
            "stand still over an interval",
            code="shape",
        )
    motion = model.path_motion(x) if motion is None else motion
    failure = path_error(model, motion)
    if failure is not None:
        return failure
    timing = check_limits(
        model, SpeedProfile.from_grid_speed(grid_speed).carry(model, motion), limits
    )
    timing, excess = replace(timing, grid_speed=grid_speed), most_used(timing.use)
    if excess.ratio <= 1.0 + RECOMPUTED_TOLERANCE:
        return timing
    reason = f"uses {100.0 * excess.ratio:.1f} % of the limit: {excess.place}"
    return replace(timing, status=TimingStatus.EXCEEDED, reason=reason)
