"""What limits a carry: along a path as functions of its timing, and as shares of each limit that a
carry uses, recomputed from its physical quantities alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.robust.force import BoxMotion, robust_model
from hybrid_opt.robust.path_force import BY_TIMING, PathPoints, robust_path
from hybrid_opt.timing.model import PathMotion, TimingModel, contact_torque
from hybrid_opt.timing.records import Excess, Place, TimingLimits
from symbolic.array import Array
from symbolic.functions import TIMING_TOLERANCE
from symbolic.records import Workcell

JOINT_CONSTRAINTS = ("joint velocity", "joint acceleration", "joint torque")
CONTACT_CONSTRAINTS = ("normal force", "friction", "pressure shift")

FRICTION_ROUNDING = 1e-6
"""The least-effort forces lie on the friction cones; this much beyond them is rounding."""

RECOMPUTED_TOLERANCE = TIMING_TOLERANCE
"""Largest excess of a recomputed limit, as a share of it."""

NEAR = 0.6
"""Torques and shifts that stay below this share of their limit enter no program."""

EXACT = 0.98
"""Share of a limit of robust forces above which they are computed exactly."""

SLOWINGS = 14
"""Bisections of a factor on the speeds."""

SPREAD = 20
"""Stride of the samples whose robust force is computed in the search for the largest."""

AT_A_TIME = 2000
"""Samples of a carry whose cases are held in memory together."""

FORCE_FLOOR = 1e-9
"""A contact with less normal force than this carries nothing [N]."""


class PathLimits:
    """The limits of a path at samples of it, over these limits, as functions of (u'', u'^2).

    Speeds are `squared_speed_limit`; robust forces of pads without one squeeze
    (`Workcell.has_one_squeeze`), and planned ones without slopes, are among the ratios.

    Attributes:
        motion: the path's geometry at the samples.
    """

    def __init__(self, model: TimingModel, motion: PathMotion, limits: TimingLimits) -> None:
        self.motion, self._model, self._limits = motion, model, limits
        workcell = model.workcell
        self._squeezed = limits.robust and workcell.has_one_squeeze
        self._grasped = limits.robust and not self._squeezed

    def joint_accelerations(self) -> tuple[Array, Array]:
        """(n, all joints) by u'' and by u'^2, with limits of both signs."""
        limit = self._model.workcell.of_joints("acceleration_max")
        return self.motion.q_first / limit, self.motion.q_second / limit

    def accelerations(self) -> tuple[tuple[Array, Array, float], ...]:
        """The box's two accelerations (n, 3) by u'' and by u'^2, and the limit on their length."""
        m, payload = self.motion, self._model.workcell.payload
        return (
            (m.pose_first[:, :3], m.pose_second[:, :3], payload.acceleration_max),
            (m.angular_first, m.angular_second, payload.angular_acceleration_max),
        )

    def forces(self, a: Array, w: Array) -> list[tuple[Array, Array]]:
        """Normal forces (n, 2) that are convex in (u'', u'^2), and their slopes (n, 2, 2), at
        u'' = a and u'^2 = w (n,): planned ones, and robust ones where these are limited."""
        model, limit = self._model, self._limits.force
        if limit is None:
            return []
        found = []
        if model.workcell.has_force_slopes:
            found.append(model.path_force(self.motion, a, w))
        if self._squeezed:
            force, slope = robust_path(model.workcell).at(self._points(a, w))
            found.append((force, slope[:, :, BY_TIMING]))
        return [(force / limit, slope / limit) for force, slope in found]

    def ratios(self, a: Array, w: Array) -> Array:
        """Limits that are not convex, signed (n, k)."""
        m, workcell, limits = self.motion, self._model.workcell, self._limits
        pressure = limits_pressure(workcell, limits)
        force = None if workcell.has_force_slopes and not self._grasped else limits.force
        columns = [np.zeros((len(a), 0))]
        if not (limits.torque or pressure or force):
            return columns[0]
        load = self._model.drive(m, np.sqrt(w), a)
        if limits.torque:
            own = m.torque_by_acceleration * a[:, None] + m.torque_by_speed * w[:, None]
            torque = contact_torque(workcell, m.wrench_torque, load) + own + m.torque_at_rest
            columns.append(torque / workcell.of_joints("torque_max"))
        if pressure:
            radius = np.array([contact.patch_radius for contact in workcell.contacts])
            columns.append(load["pressure_shift"] / radius)
        if force:
            needed = load["normal_force"]
            if self._grasped:
                moved = BoxMotion(*self._points(a, w).motion)
                commanded, leading = robust_model(workcell).hold(moved, workcell.uncertainty)
                needed = np.stack([leading, commanded], axis=1)
            columns.append(needed / force)
        return np.concatenate(columns, axis=1)

    def ratio_slopes(self, ratios: Array, a: Array, w: Array) -> Array:
        """(n, k, 2) of `ratios` at a and w by (u'', u'^2), by forward differences."""
        step_a = 1e-5 * max(float(np.abs(a).max()), 1e-6)
        step_w = 1e-5 * max(float(w.max()), 1e-6)
        by_a = (self.ratios(a + step_a, w) - ratios) / step_a
        return np.stack([by_a, (self.ratios(a, w + step_w) - ratios) / step_w], axis=-1)

    def _points(self, a: Array, w: Array) -> PathPoints:
        m = self.motion
        return PathPoints(m.pose[:, :6], m.pose_first[:, :6], m.pose_second[:, :6], a, w)


def squared_speed_limit(motion: PathMotion, workcell: Workcell, limits: TimingLimits) -> Array:
    """(n,) largest u'^2 by all limits on speeds; infinite where nothing moves."""
    payload, task = workcell.payload, workcell.task
    velocity = workcell.of_joints("velocity_max")
    linear = np.linalg.norm(motion.pose_first[:, :3], axis=1)
    angular = np.linalg.norm(motion.angular_first, axis=1)
    demands = [
        (np.abs(motion.q_first) / velocity).max(axis=1),
        linear / payload.velocity_max,
        angular / payload.angular_velocity_max,
    ]
    if limits.reference_speed:
        demands += [linear / task.reference_speed, angular / task.reference_angular_speed]
    demand = np.max(demands, axis=0)
    with np.errstate(divide="ignore"):
        limit: Array = 1.0 / demand**2
    return limit


def duration_at_speed_limits(model: TimingModel, motion: PathMotion, limits: TimingLimits) -> float:
    """Duration of a path driven at its speed limits alone, without ramps [s]."""
    squared = squared_speed_limit(motion, model.workcell, limits)
    slowness = 1.0 / np.sqrt(np.minimum(squared, 1e8))
    return float(np.trapezoid(slowness, motion.parameter))


def limit_ratios(carry: Carry, workcell: Workcell, limits: TimingLimits) -> dict[str, Array]:
    """Every limited quantity over its limit at every sample.

    Returns:
        By constraint (n, all joints) for joints, (n, 2) for contacts, (n, 1) for the box; only the
        limits that apply.
    """
    payload, task = workcell.payload, workcell.task

    friction = np.array([contact.friction for contact in workcell.contacts])
    radius = np.array([contact.patch_radius for contact in workcell.contacts])
    linear, angular = _norm(carry.rate[:, :3]), _norm(carry.angular_velocity)
    ratios = {
        "joint velocity": np.abs(carry.side_by_side("q_rate")) / workcell.of_joints("velocity_max"),
        "joint acceleration": np.abs(carry.side_by_side("q_second"))
        / workcell.of_joints("acceleration_max"),
        "payload velocity": linear / payload.velocity_max,
        "payload acceleration": _norm(carry.second_rate[:, :3]) / payload.acceleration_max,
        "payload angular velocity": angular / payload.angular_velocity_max,
        "payload angular acceleration": _norm(carry.angular_acceleration)
        / payload.angular_acceleration_max,
        "friction": carry.tangential_force / np.maximum(carry.normal_force * friction, FORCE_FLOOR),
    }
    if limits.torque:
        ratios["joint torque"] = np.abs(carry.torque) / workcell.of_joints("torque_max")
    if limits_pressure(workcell, limits):
        ratios["pressure shift"] = carry.pressure_shift / radius
    if limits.force is not None:
        ratios["normal force"] = _near_limit(carry, workcell, limits) / limits.force
    if limits.reference_speed:
        ratios["path speed"] = np.maximum(
            linear / task.reference_speed, angular / task.reference_angular_speed
        )
    return ratios


def limited_force(carry: Carry, workcell: Workcell, limits: TimingLimits) -> Array:
    """(n, 2) normal forces that the force limit holds for: planned, and robust ones where asked."""
    if not limits.robust:
        return carry.normal_force
    commanded, leading = robust_model(workcell).hold(carry, workcell.uncertainty)
    return np.maximum(carry.normal_force, np.stack([leading, commanded], axis=1))


def _near_limit(carry: Carry, workcell: Workcell, limits: TimingLimits) -> Array:
    """As `limited_force`; robust ones that are below `EXACT` of the limit, and below the largest of
    the carry, may be told as the planned ones: to see that takes a fraction of the time."""
    if not limits.robust or limits.force is None or not workcell.has_one_squeeze:
        return limited_force(carry, workcell, limits)
    n = len(carry)
    points = PathPoints(carry.pose, carry.rate, carry.second_rate, np.zeros(n), np.ones(n))
    found = carry.normal_force.copy()
    if _tell_above(EXACT * limits.force, points, workcell, found):
        return found
    # Nearly the largest one is among a few; only what exceeds that can be larger.
    _tell_above(0.0, points, workcell, found, every=SPREAD)
    _tell_above(float(found.max()), points, workcell, found)
    return found


def _tell_above(
    level: float, points: PathPoints, workcell: Workcell, found: Array, every: int = 1
) -> bool:
    """Write the robust forces above a level [N], of every so manieth point, into forces (n, 2);
    whether there are any."""
    known, rows = False, np.arange(0, len(points), every)
    for part in np.array_split(rows, -(-len(rows) // AT_A_TIME)):
        least = np.full(len(part), level)
        above, ruling = robust_path(workcell).ruling_beyond(points.at(part), least)
        found[part[above]] = np.maximum(found[part[above]], ruling.force)
        known = known or len(above) > 0
    return known


def limits_pressure(workcell: Workcell, limits: TimingLimits) -> bool:
    """Whether the pressure's shift is a limit.

    The joint allocation keeps it within the patches by pressing harder: there it is no limit, but
    up to the patch's rim wherever the moments need it.
    """
    return limits.pressure and workcell.task.allocation == "paper"


def limit_use(
    carry: Carry,
    workcell: Workcell,
    limits: TimingLimits,
    joint_names: tuple[tuple[str, ...], tuple[str, ...]],
) -> dict[str, Excess]:
    """The largest use of every limit and where, by constraint.

    Args:
        joint_names: names of both arms' joints.
    """
    return use_of(limit_ratios(carry, workcell, limits), carry, joint_names)


def use_of(
    ratios: Mapping[str, Array],
    carry: Carry,
    joint_names: tuple[tuple[str, ...], tuple[str, ...]],
) -> dict[str, Excess]:
    """`limit_use` where a carry's `limit_ratios` are known."""
    workcell, use = carry.workcell, {}
    for name, ratio in ratios.items():
        sample, column = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
        robot, joint = "", ""
        if name in JOINT_CONSTRAINTS:
            arm, index = joint_at(joint_names, int(column))
            robot, joint = workcell.robots[arm].name, joint_names[arm][index]
        elif name in CONTACT_CONSTRAINTS:
            robot = workcell.robots[column].name
        place = Place(name, robot, joint, int(sample), float(carry.parameter[sample]))
        use[name] = Excess(float(ratio[sample, column]), place)
    return use


def joint_use(carry: Carry, workcell: Workcell) -> dict[str, Array]:
    """Worst use of every joint's limits over the carry, (all joints,) per joint constraint.

    Beside the three limits, `contact torque` is the share of the contact wrench alone.
    """
    ratios = limit_ratios(carry, workcell, TimingLimits())
    use = {name: ratios[name].max(axis=0) for name in JOINT_CONSTRAINTS}
    limit = workcell.of_joints("torque_max")
    return use | {"contact torque": (np.abs(carry.contact_torque) / limit).max(axis=0)}


def joint_at(joint_names: tuple[tuple[str, ...], ...], column: int) -> tuple[int, int]:
    """Arm and joint of a column, both arms' joints side by side."""
    first = len(joint_names[0])
    return (0, column) if column < first else (1, column - first)


def largest_speed_factor(exceeds: Callable[[float], bool]) -> float:
    """The largest factor on the speeds, at most one, with which nothing is exceeded."""
    low, high = 0.0, 1.0
    for _ in range(SLOWINGS):
        factor = (low + high) / 2.0
        low, high = (low, factor) if exceeds(factor) else (factor, high)
    return low


def worst(use: dict[str, Excess]) -> Excess:
    """The limit with the largest use; friction, tight by construction, counts only when broken."""
    candidates = [
        excess
        for name, excess in use.items()
        if name != "friction" or excess.ratio > 1.0 + FRICTION_ROUNDING
    ]
    return max(candidates, key=lambda excess: excess.ratio)


def _norm(vectors: Array) -> Array:
    length: Array = np.linalg.norm(vectors, axis=1, keepdims=True)
    return length
