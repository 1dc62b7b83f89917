"""The timing model of one workcell: the limits of its carries, and compiled functions of the
geometry and the loads of a path."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from codegen.function import NumericFunction
from hybrid_opt.carry import ArmMotion, Carry, joints_of
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.robust.force import robust_model
from hybrid_opt.robust.path_force import PathPoints, RobustPath, robust_path
from hybrid_opt.timing.passes import ForwardBackwardPasses
from hybrid_opt.timing.records import FRICTION_RATIO, TimingLimits
from symbolic.array import Array
from symbolic.cell_model import CellModel
from symbolic.contact.registry import command_model, contact_model
from symbolic.errors import SettingsError
from symbolic.functions import timing_functions
from symbolic.limits import LIMITS, Limit
from symbolic.records import Workcell

INTERVALS = 200
"""Pieces of constant path acceleration."""

REFINEMENT = 10
"""Samples per piece at which a timing is recomputed."""

_SPLINE_EVERY = 2
"""Every so many samples of a path are knots of the interpolating splines."""

EXACT_FORCE_ABOVE = 0.98
"""Robust forces above this share of the force limit are computed exactly."""

PEAK_SEARCH_STRIDE = 20
"""Stride of the samples in the search for the largest robust force."""

ROBUST_BATCH = 2000
"""Number of samples whose uncertain cases are held in memory together."""

LEAST_NORMAL_FORCE = 1e-9
"""A contact with a smaller normal force counts as carrying nothing [N]."""

if TYPE_CHECKING:
    import casadi as ca


@dataclass(frozen=True)
class PathMotion:
    """Geometry of one path at n samples of the path parameter u.

    Fields are described in `symbolic.path_motion` and `symbolic.robot.arm` under the same names.
    `_first` and `_second` mark derivatives by u; joints of both arms stand side by side.

    Attributes:
        x: (n_var,) decision vector.
        parameter: (n,) u in [0, 1].
        pose: (n, 6) box poses [m, rad].
        q: (n, all joints) joint positions [rad].
        lost: (n, 2) 0 while each arm has reached all samples up to here, else 1.
        limit_margin: (n, 2) least distance of each arm's joints from their limits [rad].
        manipulability: (n, 2) absolute determinant of each arm's Jacobian [m^3].
    """

    x: Array
    parameter: Array
    pose: Array
    pose_first: Array
    pose_second: Array
    angular_first: Array
    angular_second: Array
    normal: Array
    force_by_acceleration: Array
    force_by_speed: Array
    q: Array
    q_first: Array
    q_second: Array
    torque_by_acceleration: Array
    torque_by_speed: Array
    torque_at_rest: Array
    wrench_torque: Array
    ik_residual: Array
    lost: Array
    limit_margin: Array
    manipulability: Array

    def at(self, samples: NDArray[np.intp]) -> PathMotion:
        """Select the samples with the given indices, in this order."""
        sampled = {f.name: getattr(self, f.name)[samples] for f in fields(self) if f.name != "x"}
        return PathMotion(self.x, **sampled)

    def interpolate(self, u: Array) -> PathMotion:
        """Interpolate the geometry at path parameters u (m,) in [0, 1] by cubic splines."""
        spline, parts = self._spline
        values = np.split(spline(u), parts, axis=1)
        shaped = {
            name: value.reshape(len(u), *getattr(self, name).shape[1:])
            for name, value in zip(SAMPLED_FIELDS, values, strict=True)
        }
        return PathMotion(self.x, u, **shaped)

    def third_derivatives(self, u: Array) -> tuple[Array, Array]:
        """Return the third derivatives of the joint positions (m, all joints) and of the box
        position (m, 3) by the path parameter u.

        Args:
            u: (m,) path parameters in [0, 1].
        """
        joints = self.q_second.shape[1]
        both = self._third(u)
        return both[:, :joints], both[:, joints : joints + 3]

    @cached_property
    def _spline(self) -> tuple[CubicSpline, Array]:
        """Cubic spline in the path parameter u through all arrays of the motion, flattened and
        joined column by column; and the columns at which they are to be split again.
        """
        u = self.parameter[::_SPLINE_EVERY]
        columns = [
            getattr(self, name)[::_SPLINE_EVERY].reshape(len(u), -1) for name in SAMPLED_FIELDS
        ]
        parts = np.cumsum([column.shape[1] for column in columns])[:-1]
        return CubicSpline(u, np.concatenate(columns, axis=1)), parts

    @cached_property
    def _third(self) -> CubicSpline:
        both = np.concatenate([self.q_second, self.pose_second], axis=1)
        return CubicSpline(self.parameter, both).derivative()


SAMPLED_FIELDS = tuple(f.name for f in fields(PathMotion) if f.name not in ("x", "parameter"))

_BOX, _ARMS = (
    SAMPLED_FIELDS[: SAMPLED_FIELDS.index("q")],
    SAMPLED_FIELDS[SAMPLED_FIELDS.index("q") :],
)


# --- the limits of a carry ---


class CarryLimits:
    """The limits of a workcell's carries, recomputed from physical quantities alone.

    Attributes:
        workcell: the workcell.
        bounds: largest allowed values, by name of a limit in `symbolic.limits.LIMITS` that the
            workcell states: (all joints,) for joints, (2,) for robots, a number for the payload.
        has_pressure_limit: whether the contact model limits the shift of the pressure.
    """

    def __init__(self, workcell: Workcell) -> None:
        self.workcell = workcell
        self.has_pressure_limit = contact_model(workcell).has_pressure_limit
        self.bounds = {limit.name: _bound_of(limit, workcell) for limit in LIMITS if limit.bound}
        self._friction = np.array([contact.friction for contact in workcell.contacts])

    def applies(self, limit: Limit, limits: TimingLimits) -> bool:
        """Return True if an entry `limit` of the table `symbolic.limits.LIMITS` applies to timings
        with the options in `limits`.
        """
        if limit.option == "pressure":
            return limits.pressure and self.has_pressure_limit
        return not limit.option or bool(getattr(limits, limit.option))

    def ratios(self, carry: Carry, limits: TimingLimits) -> dict[str, Array]:
        """Compute every limited quantity, divided by its limit, at n samples of a carry.

        Args:
            carry: the carry.
            limits: limits in addition to the workcell's.

        Returns:
            Ratios by name. `FRICTION_RATIO` is the tangential force over the largest one that
            friction bears; the others are the limits of `symbolic.limits.LIMITS` that apply. The
            shape is (n, joints of both arms) for a limit on joints, (n, 2) for a limit on robots,
            and (n, 1) or (n,) for a limit on the payload.
        """
        bound = np.maximum(carry.normal_force * self._friction, LEAST_NORMAL_FORCE)
        ratios = {FRICTION_RATIO: carry.tangential_force / bound}
        for limit in LIMITS:
            if not self.applies(limit, limits):
                continue
            if limit.block == "force":
                assert limits.force is not None
                ratios[limit.name] = self._near_limit(carry, limits) / limits.force
            elif not limit.carry:
                # The reference speeds: of the two limits on the payload's speed.
                task = self.workcell.task
                ratios[limit.name] = np.maximum(
                    row_lengths(carry.rate[:, :3]) / task.reference_speed,
                    row_lengths(carry.angular_velocity) / task.reference_angular_speed,
                )
            elif limit.scope == "joint":
                ratios[limit.name] = np.abs(carry.stack_arms(limit.carry)) / self.bounds[limit.name]
            elif limit.scope == "payload":
                vector = getattr(carry, limit.carry)[:, :3]
                ratios[limit.name] = row_lengths(vector) / self.bounds[limit.name]
            else:
                ratios[limit.name] = getattr(carry, limit.carry) / self.bounds[limit.name]
        return ratios

    def limited_force(self, carry: Carry, limits: TimingLimits) -> Array:
        """Return the normal forces (n, 2) [N] of a carry that the force limit bounds.

        They are the planned forces. If `limits` bound robust forces, they are the larger one of
        planned and robust force at each sample and robot.
        """
        if not limits.robust:
            return carry.normal_force
        workcell = self.workcell
        commanded, leading = robust_model(workcell).hold(carry, workcell.uncertainty)
        return np.maximum(carry.normal_force, np.stack([leading, commanded], axis=1))

    def _near_limit(self, carry: Carry, limits: TimingLimits) -> Array:
        """Compute `limited_force` (n, 2) [N] at less cost. Robust forces are computed only near the
        force limit and near the largest force; elsewhere the result is the planned force, a lower
        bound.
        """
        if not limits.robust or limits.force is None:
            return self.limited_force(carry, limits)
        if not command_model(self.workcell).has_scalar_squeeze:
            return self.limited_force(carry, limits)
        n = len(carry)
        points = PathPoints(carry.pose, carry.rate, carry.second_rate, np.zeros(n), np.ones(n))
        found, path = carry.normal_force.copy(), robust_path(self.workcell)
        if _robust_forces_above(EXACT_FORCE_ABOVE * limits.force, points, path, found):
            return found
        # Nearly the largest one is among a few; only what exceeds that can be larger.
        _robust_forces_above(0.0, points, path, found, every=PEAK_SEARCH_STRIDE)
        _robust_forces_above(float(found.max()), points, path, found)
        return found


def _bound_of(limit: Limit, workcell: Workcell) -> Array:
    if limit.scope == "joint":
        return workcell.stack_joint_limits(limit.bound)
    if limit.scope == "payload":
        return np.asarray(getattr(workcell.payload, limit.bound), dtype=float)
    return np.array([getattr(contact, limit.bound) for contact in workcell.contacts])


def _robust_forces_above(
    level: float, points: PathPoints, path: RobustPath, found: Array, every: int = 1
) -> bool:
    """Compute the robust forces that exceed a level, and enter them into an array of forces.

    Args:
        level: the level [N].
        points: n points of paths.
        path: computes robust forces at the points.
        found: (n, 2) normal forces of both robots [N]; entries are raised in place to robust forces
            above the level.
        every: only points whose index is a multiple of this number are evaluated.

    Returns:
        True if any robust force exceeds the level.
    """
    known, rows = False, np.arange(0, len(points), every)
    for part in np.array_split(rows, -(-len(rows) // ROBUST_BATCH)):
        least = np.full(len(part), level)
        above, ruling = path.governing_above(points.at(part), least)
        found[part[above]] = np.maximum(found[part[above]], ruling.force)
        known = known or len(above) > 0
    return known


def row_lengths(vectors: Array) -> Array:
    """Return the lengths (n, 1) of vectors (n, k)."""
    length: Array = np.linalg.norm(vectors, axis=1, keepdims=True)
    return length


# --- the compiled functions ---


class TimingModel:
    """Limits and compiled functions from which timings of one workcell's trajectories are computed.

    Attributes:
        workcell: the workcell.
        compiled: the workcell with its compiled functions.
        intervals: number of intervals of constant path acceleration.
        is_robust: whether force limits apply to every case of the workcell's uncertainty.
        passes: the compiled timing at these intervals.
        carry_limits: the limits of the workcell's carries.
        joint_names: names of the joints of each arm.
    """

    def __init__(
        self,
        cell: Workcell | CompiledCell,
        intervals: int = INTERVALS,
        robust: bool = False,
    ) -> None:
        """Load or build the compiled functions.

        Args:
            cell: the workcell; give a compiled one to share its functions.
            intervals: number of intervals of constant path acceleration.
            robust: True if force limits apply to robust forces, which hold in every case of the
                workcell's uncertainty; False for planned forces.

        Raises:
            SettingsError: the number of intervals is out of range.
            DualArmError: the model or its code cannot be built.
        """
        require_intervals(intervals)
        self.compiled = compiled = CompiledCell.of(cell)
        self.workcell = compiled.workcell
        self.intervals, self.is_robust = intervals, robust
        self.passes = ForwardBackwardPasses(compiled, intervals)
        self.joint_names = self.passes.joint_names
        self.carry_limits = CarryLimits(self.workcell)
        self._sample_limits = sample_limits_set(compiled, lanes=0)
        samples = REFINEMENT * intervals + 1
        self._latest: PathMotion | None = None

        def make(model: CellModel) -> dict[str, ca.Function]:
            return timing_functions(model, samples)

        self._functions = compiled.functions("timing", make, str(samples), bodies=False, taped=True)

    def path_motion(self, x: Array) -> PathMotion:
        """Compute the geometry of a path at `REFINEMENT` samples per interval, uniform in u. The
        last result is cached.

        Args:
            x: (n_var,) decision vector, or only its free waypoints (n_path,).

        Raises:
            SettingsError: x has the wrong shape or is not finite.
        """
        task = self.workcell.task
        if np.shape(x) == (task.n_path,) and task.n_path < task.n_var:
            x = np.append(x, task.force_limit[1])
        x = self.checked(x)
        if self._latest is None or not np.array_equal(self._latest.x, x):
            out = self._functions["path_motion"](x)
            n = len(out["pose"])
            values = {name: out[name] for name in _BOX}
            for name in _ARMS:
                both = [out[f"{name}_{arm}"].reshape(n, -1) for arm in (1, 2)]
                values[name] = np.concatenate(both, axis=1)
            values["wrench_torque"] = values["wrench_torque"].reshape(n, -1, 6)
            u = np.linspace(0.0, 1.0, n)
            self._latest = PathMotion(x=x.copy(), parameter=u, **values)
        return self._latest

    def path_coefficients(self, motion: PathMotion) -> dict[str, Array]:
        """Return the arrays of one path that `ForwardBackwardPasses.time` takes as `paths`.

        Returns:
            `limits`, the coefficients of the limits; `pose`, `pose_first` and `pose_second`, box
            poses with redundant joints and their first and second derivative by u. Each array has
            shape (1, 2 intervals + 1, columns), for both ends and the middle of every interval.
        """
        task, some = self.workcell.task, slice(None, None, REFINEMENT // 2)
        box = (motion.pose, motion.pose_first, motion.pose_second)
        joints = (motion.q, motion.q_first, motion.q_second)
        extended = [np.zeros((len(pose[some]), task.extended_size)) for pose in box]
        for values, pose, moved in zip(extended, box, joints, strict=True):
            values[:, :6] = pose[some]
            for arm, own in enumerate(joints_of(self.workcell, moved[some])):
                for joint, entry in task.redundant_entries[arm]:
                    values[:, entry] = own[:, joint]
        q = map(np.ascontiguousarray, joints_of(self.workcell, motion.q[some]))
        rows = self._sample_limits.batch(*extended, *q)["limits"]
        names = ("pose", "pose_first", "pose_second")
        poses = {name: values[None] for name, values in zip(names, extended, strict=True)}
        return {"limits": rows[None]} | poses

    def load(self, pose: Array, rate: Array, second_rate: Array) -> dict[str, Array]:
        """Compute the outputs `symbolic.contact.load.LOAD_OUTPUTS` (forces and wrenches by name)
        for a motion of the box.

        Args:
            pose, rate, second_rate: (n, 6) box poses [m, rad], and their first and second
                derivatives by time.
        """
        return self._functions["load"].batch(pose, rate, second_rate)

    def path_force(self, motion: PathMotion, a: Array, w: Array) -> tuple[Array, Array]:
        """Compute the planned normal forces (n, 2) [N] at n samples of a path, and their slopes (n,
        2, 2) by (u'', u'^2).

        Args:
            motion: geometry of the path.
            a, w: (n,) values of u'' [1/s^2] and u'^2 [1/s^2].
        """
        path = (motion.pose, motion.pose_first, motion.pose_second)
        found = self._functions["path_force"].batch(*path, a, w)
        return found["normal_force"], found["slope"]

    def uncertain_load(
        self, carry: Carry, friction: Array, centre_of_mass: Array
    ) -> dict[str, Array]:
        """Compute the forces of a carry in a cell with other friction and another centre of mass.

        Args:
            carry: the carry.
            friction: (2,) friction coefficients.
            centre_of_mass: (3,) centre of mass in the box frame [m].

        Returns:
            Forces and wrenches by the names in `symbolic.contact.load.LOAD_OUTPUTS`.
        """
        return self._functions["uncertain_load"].batch(
            carry.pose, carry.rate, carry.second_rate, friction, centre_of_mass
        )

    def arm_motion(self, arm: int, q: Array, pose: Array, first: Array) -> dict[str, Array]:
        """Compute the motion of one arm while the box moves straight: the outputs
        `symbolic.path_motion.ARM_OUTPUTS` (derivatives of the joint positions by the path
        parameter, and parts of the joint torques), by name.

        Args:
            arm: index of the arm, 0 or 1.
            q: (n, joints) joint positions that hold the box at the poses [rad]; redundant joints
                rest.
            pose: (n, 6) box poses [m, rad].
            first: (n, 6) derivative of the poses by the path parameter; the second derivative is
                zero.
        """
        still = np.zeros((len(q), self.workcell.task.extended_size))
        motion = [still.copy() for _ in (pose, first)]
        for extended, values in zip(motion, (pose, first), strict=True):
            extended[:, :6] = values  # the redundant joints are in q already
        return self._functions[f"arm_{arm + 1}"].batch(np.ascontiguousarray(q), *motion, still)

    def wrench_torque(self, q: Array, pose: Array) -> Array:
        """Compute matrices (n, all joints, 6) that map each arm's contact wrench to its joint
        torques.

        Args:
            q: (n, all joints) joint positions [rad].
            pose: (n, 6) box poses [m, rad].
        """
        arms, still = joints_of(self.workcell, q), np.zeros_like(pose)
        found = [self.arm_motion(arm, own, pose, still) for arm, own in enumerate(arms)]
        matrices = [each["wrench_torque"].reshape(len(q), -1, 6) for each in found]
        return np.concatenate(matrices, axis=1)

    def drive(self, motion: PathMotion, speed: Array, acceleration: Array) -> dict[str, Array]:
        """Compute the outputs `symbolic.contact.load.LOAD_OUTPUTS` (forces and wrenches by name) of
        the path `motion` that is driven with path speed u' (n,) [1/s] and path acceleration u''
        (n,) [1/s^2].
        """
        rate = motion.pose_first * speed[:, None]
        second = motion.pose_second * speed[:, None] ** 2 + (
            motion.pose_first * acceleration[:, None]
        )
        return self.load(motion.pose, rate, second)

    def contact_torque(self, wrench_torque: Array, load: Mapping[str, Array]) -> Array:
        """Compute the joint torques (n, all joints) [N m] that exert the contact wrenches in
        `load`, a result of the method `load`, with the matrices `wrench_torque` (n, all joints, 6).
        """
        wrenches = (load["wrench_1"], load["wrench_2"])
        return contact_torque(len(self.joint_names[0]), wrench_torque, wrenches)

    def carry(self, motion: PathMotion, time: Array, speed: Array, acceleration: Array) -> Carry:
        """Return the carry that drives a path with a given timing.

        Args:
            motion: geometry of the path at n samples.
            time: (n,) times of the samples [s].
            speed, acceleration: (n,) path speeds u' [1/s] and path accelerations u'' [1/s^2].
        """
        load = self.drive(motion, speed, acceleration)
        v, w, a = speed[:, None], speed[:, None] ** 2, acceleration[:, None]
        own = motion.torque_by_acceleration * a + motion.torque_by_speed * w
        joints = (
            motion.q,
            motion.q_first * v,
            motion.q_second * w + motion.q_first * a,
            self.contact_torque(motion.wrench_torque, load),
            own + motion.torque_at_rest,
        )
        loads = {f.name: load[f.name] for f in fields(Carry) if f.name in load}
        loads["contact_force"] = loads["contact_force"].reshape(-1, 2, 3)
        split = [joints_of(self.workcell, values) for values in joints]
        return Carry(
            workcell=self.workcell,
            x=motion.x,
            timing="limits",
            parameter=motion.parameter,
            time=time,
            pose=motion.pose,
            rate=motion.pose_first * v,
            second_rate=motion.pose_second * w + motion.pose_first * a,
            **loads,
            arms=(
                ArmMotion(*[first for first, _ in split]),
                ArmMotion(*[second for _, second in split]),
            ),
            judgement=None,
        )

    def still(self, motion: PathMotion) -> Carry:
        """Return a carry whose samples are those of `motion`, each with the arms and the box at
        rest.
        """
        zero = np.zeros(len(motion.parameter))
        return self.carry(motion, zero, zero, zero)

    def drive_limits(self, force: float) -> TimingLimits:
        """Return the limits of drivable carries with a force limit `force` [N].

        The force limit applies to robust forces if the model is robust, else to planned forces.
        """
        return TimingLimits(force=force, robust=self.is_robust)

    def checked(self, x: Array) -> Array:
        """Check the shape of a decision vector (n_var,) and return it as an array.

        Raises:
            SettingsError: x does not fit the workcell.
        """
        x = np.ascontiguousarray(x, dtype=float)
        n_var = self.workcell.task.n_var
        if x.shape != (n_var,) or not np.isfinite(x).all():
            raise SettingsError(
                f"decision vector of shape {x.shape}; needs {n_var} finite numbers", code="shape"
            )
        return x


@dataclass(frozen=True)
class SpeedProfile:
    """Path speeds at the samples of a `PathMotion`, with constant u'' on every interval.

    There are `REFINEMENT` + 1 samples per interval: both of its ends are samples, so an inner grid
    point occurs twice.

    Attributes:
        index: (n,) index of each sample in the `PathMotion`.
        time: (n,) [s].
        share: (n,) position of each sample within its interval, in [0, 1].
        a, w: (n,) path acceleration u'' [1/s^2] and squared path speed u'^2 [1/s^2].
    """

    index: NDArray[np.intp]
    time: Array
    share: Array
    a: Array
    w: Array

    @classmethod
    def from_grid_speed(cls, grid_speed: Array) -> SpeedProfile:
        """Return the profile with the path speeds u' `grid_speed` (intervals + 1,) [1/s] at the
        grid points, and constant u'' between them.
        """
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
        """Return the carry that drives a path with these speeds.

        Args:
            model: timing model of the workcell.
            motion: geometry of the path.
            a, w: numbers [1/s^2] that are added to the path acceleration u'' and to the squared
                path speed u'^2 at every sample, for finite differences.
        """
        speed = np.sqrt(np.maximum(self.w + w, 0.0))
        return model.carry(motion.at(self.index), self.time, speed, self.a + a)


def sample_limits_set(compiled: CompiledCell, lanes: int) -> NumericFunction:
    """Load or build the compiled function of the coefficients of all timing limits at one sample,
    `symbolic.limit_coefficients.sample_limits_function`.

    Args:
        compiled: the cell with its compiled functions.
        lanes: number of samples that one vector instruction evaluates side by side; 0 for the
            machine's width.
    """

    def make(model: CellModel) -> dict[str, ca.Function]:
        # Not imported at the top: a warm start needs no CasADi.
        from symbolic.limit_coefficients import sample_limits_function

        return {"sample_limits": sample_limits_function(model)}

    return compiled.functions("sample limits", make, lanes=lanes, bodies=False)["sample_limits"]


def require_intervals(intervals: int) -> None:
    """Check that a number of intervals is allowed.

    Raises:
        SettingsError: the number is out of range.
    """
    if not 10 <= intervals <= 2000:
        raise SettingsError(f"{intervals} intervals; allowed are 10 to 2000", code="intervals")


def contact_torque(first: int, wrench_torque: Array, wrenches: Iterable[Array]) -> Array:
    """Compute the joint torques (n, all joints) [N m] with which the robots exert wrenches on the
    box.

    Args:
        first: number of joints of the first arm.
        wrench_torque: (n, all joints, 6) matrices from wrenches to torques, both arms stacked.
        wrenches: (n, 6) wrench of each robot [N, N m].
    """
    parts = (wrench_torque[:, :first], wrench_torque[:, first:])
    each = zip(parts, wrenches, strict=True)
    return np.concatenate([np.einsum("njk,nk->nj", part, w) for part, w in each], axis=1)
