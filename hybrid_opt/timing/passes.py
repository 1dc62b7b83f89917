"""Fastest timings of paths by a compiled backward and forward pass; docs/explanation/timing.md
explains it.

At a point of the path every limit bounds a function of u'' and u'^2 (`symbolic.limits`). Robust
forces are convex in (u'', u'^2) (`hybrid_opt.robust.path_force`), but take an interior-point method
per case. So they enter as supporting lines: the passes time the paths, where the forces come near
the limit their tangents are added, and the passes run again (Kelley's cutting planes).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from codegen.build import load_or_compile
from codegen.cache import source_digest
from codegen.function import NumericFunction, Signature
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.robust.path_force import BY_TIMING, PathPoints, RobustPath, robust_path
from hybrid_opt.timing.records import (
    PER_JOINT,
    PER_ROBOT,
    PathTiming,
    Place,
    TimingLimits,
    TimingStatus,
)
from symbolic.array import Array
from symbolic.contact.registry import command_model, contact_model
from symbolic.limits import LIMIT_NAMES, limit_layout, passes_enumeration
from symbolic.read.arms import arm_model
from symbolic.records import Robot, Workcell

CUTS_PER_SAMPLE = 24
"""Supporting lines per sample at most. New lines replace the oldest."""

MAX_CUT_ITERATIONS = 20
"""How often the passes run again with more supporting lines."""

CUT_TOLERANCE = 1e-4
"""Accepted excess of a force over its limit, as a share of the limit."""

CUT_ABOVE = 0.98
"""A force above this share of its limit gets a tangent before it exceeds the limit."""

REST_UTILISATION = 1.0 - 1e-6
"""Largest share of the limit at rest, as in the passes."""


AtRest = tuple[Array, int]
"""Excess of robust forces at rest: the largest force (2,) of each robot [N], and the sample of the
larger one."""


class ForwardBackwardPasses:
    """The compiled backward and forward pass of one workcell, which computes the fastest timings of
    batches of paths.

    Attributes:
        workcell: the workcell.
        intervals: number of intervals of constant path acceleration.
        joint_names: names of the joints of each arm.
    """

    def __init__(self, compiled: CompiledCell, intervals: int, threads: int = 1) -> None:
        """Load or build the compiled backward and forward pass over a path.

        Args:
            compiled: the workcell with its compiled functions.
            intervals: number of intervals of constant path acceleration.
            threads: number of threads that share a batch of paths.

        Raises:
            DualArmError: the code cannot be built.
        """
        self._compiled, self._threads = compiled, threads
        self.workcell, self.intervals = compiled.workcell, intervals
        first, second = compiled.workcell.robots
        self.joint_names = (joint_names(first), joint_names(second))
        self._passes = forward_backward_passes(compiled, intervals)
        self._has_scalar_squeeze = command_model(self.workcell).has_scalar_squeeze

    def supports(self, limits: TimingLimits) -> bool:
        """Return True if the backward and forward pass can respect these limits.

        They cannot respect limits on robust forces unless the normal force of one pad determines
        that of the other pad (`ContactModel.has_scalar_squeeze`).
        """
        return self._has_scalar_squeeze or not limits.robust

    def time(
        self, paths: Mapping[str, Array], limits: TimingLimits, force: Array | None = None
    ) -> list[PathTiming]:
        """Compute the fastest timing of each of n paths.

        Args:
            paths: arrays by name. `limits` (n, 2 intervals + 1, columns of
                `symbolic.limits.limit_layout`) are the coefficients of the limits at both ends and
                in the middle of every interval. Robust limits also need `pose`, `pose_first` and
                `pose_second` (n, 2 intervals + 1, 6 or more) there.
            limits: limits of all paths, for which `supports` returns True.
            force: (n,) force limit of each path [N]; None for the force limit in `limits`.

        Returns:
            One record per path; without a timing it has infinite duration and states what failed.
        """
        most = np.inf if limits.force is None else limits.force
        options = np.empty((len(paths["limits"]), 4))
        options[:, 0] = most if force is None else force
        options[:, 1:] = limits.torque, limits.pressure, limits.reference_speed
        if limits.robust:
            return self._time_robust(paths, options)
        out = self._passes.batch(paths["limits"], options, threads=self._threads)
        return [self._timing(out, k) for k in range(len(options))]

    def _time_robust(self, paths: Mapping[str, Array], options: Array) -> list[PathTiming]:
        drive = RobustCuttingPlanes(self._cut_passes, robust_path(self.workcell), paths, options)
        out, still = drive.time(self._threads)
        found = [self._timing(out, k) for k in range(len(options))]
        for k, rest in enumerate(still):
            limit, peak = float(options[k, 0]), drive.peak[k]
            if rest is not None:
                peak, sample = rest
                arm, u = int(peak.argmax()), sample / (2 * self.intervals)
                where = "normal force", arm, round(u * self.intervals), u
                place = limit_place(self.workcell, self.joint_names, *where)
                failed = failed_timing(TimingStatus.INFEASIBLE_AT_REST, place, self.intervals)
                found[k] = replace(failed, peak_force=peak)
            if rest is not None or found[k].ok:
                use = found[k].use | {"normal force": float(peak.max()) / limit}
                found[k] = replace(found[k], robust_force=peak, use=use)
        return found

    @cached_property
    def _cut_passes(self) -> NumericFunction:
        return forward_backward_passes(self._compiled, self.intervals, CUTS_PER_SAMPLE)

    def _timing(self, out: dict[str, Array], k: int) -> PathTiming:
        status = PASS_STATUSES[int(out["status"][k])]
        use = out["use"][k]
        if status is TimingStatus.SOLVER_FAILED:
            interval = int(out["interval"][k])
            place = Place("path timing", "", "", interval, interval / self.intervals)
        else:
            kind = int(np.argmax(use[:, 0]))
            column, parameter = int(use[kind, 2]), float(use[kind, 1])
            where = LIMIT_NAMES[kind], column, round(parameter * self.intervals), parameter
            place = limit_place(self.workcell, self.joint_names, *where)
        return PathTiming(
            status=status,
            place=place,
            duration=float(out["duration"][k]),
            peak_force=out["peak"][k],
            use=dict(zip(LIMIT_NAMES, use[:, 0].tolist(), strict=True)),
            grid_speed=np.sqrt(out["squared"][k]),
            sweeps=int(out["sweeps"][k]),
            slowed=float(out["slowed"][k]),
        )


class RobustCuttingPlanes:
    """Computes the fastest timings of n paths within robust force limits.

    Robust forces are convex in (u'', u'^2). They are bounded by their tangents (supporting lines)
    at former timings, and the paths timed again (Kelley's cutting planes).

    Attributes:
        peak: (n, 2) largest robust forces of each path's last timing [N].
    """

    def __init__(
        self,
        passes: NumericFunction,
        forces: RobustPath,
        paths: Mapping[str, Array],
        options: Array,
    ) -> None:
        """Start without supporting lines (tangents that bound the robust forces).

        Args:
            passes: `forward_backward_passes` with `CUTS_PER_SAMPLE`.
            forces: robust forces of the workcell's paths.
            paths: arrays by name, as for `ForwardBackwardPasses.time`.
            options: (n, 4) options of the passes; the first column holds finite force limits [N].
        """
        n, samples = paths["pose"].shape[:2]
        self._passes, self._forces, self._options = passes, forces, options
        self._rows, self._limit = paths["limits"], options[:, 0]
        names = ("pose", "pose_first", "pose_second")
        self._parts = [np.ascontiguousarray(paths[name][:, :, :6]) for name in names]
        # The lines of every sample, and how many it was given.
        self._cuts = np.zeros((n, samples, CUTS_PER_SAMPLE, 3))
        self._cuts[..., 2] = np.inf
        self._count, self.peak = np.zeros((n, samples), dtype=np.intp), np.zeros((n, 2))
        # Both ends and the middle of every interval, each with its interval's u''.
        self._intervals = samples // 2
        first = 2 * np.arange(self._intervals)[:, None]
        self._sample = (first + np.array([0, 1, 2])).reshape(-1)
        self._share = np.tile([0.0, 0.5, 1.0], self._intervals)

    def time(self, threads: int) -> tuple[dict[str, Array], list[AtRest | None]]:
        """Compute the fastest timings of all paths.

        Args:
            threads: number of threads that share the paths.

        Returns:
            - Outputs of the compiled backward and forward pass, by name.
            - For each path whose robust forces at rest exceed its force limit: the largest of these
              forces and their sample. None for other paths.
        """
        still = self._at_rest()
        out = self._passes.batch(self._rows, self._options, self._cuts, threads=threads)
        left = np.array([k for k, rest in enumerate(still) if rest is None], dtype=np.intp)
        for _ in range(MAX_CUT_ITERATIONS):
            left = left[np.isfinite(out["duration"][left])]
            left = left[self._cut(left, out["squared"][left])]
            if not len(left):
                break
            driven = (self._rows[left], self._options[left], self._cuts[left])
            for name, values in self._passes.batch(*driven, threads=threads).items():
                out[name][left] = values
        return out, still

    def _at_rest(self) -> list[AtRest | None]:
        """Find the paths whose robust forces at rest exceed the force limit.

        The other paths get supporting lines: the tangents of their robust forces at u' = 0.

        Returns:
            For each path that exceeds the limit the largest robust forces at rest and their sample;
            None for other paths.
        """
        n, samples = self._count.shape
        found: list[AtRest | None] = [None] * n
        path, sample = np.divmod(np.arange(n * samples), samples)
        points = self._points(path, sample, *np.zeros((2, n * samples)))
        rows, ruling = self._forces.governing_above(points, CUT_ABOVE * self._limit[path])
        force, slope = ruling.force, self._forces.slopes(points.at(rows), ruling)
        for k in np.unique(path[rows]):
            own = path[rows] == k
            at = int(force[own].max(axis=1).argmax())
            if force[own].max() > REST_UTILISATION * self._limit[k]:
                found[k] = force[own].max(axis=0), int(sample[rows][own][at])
        place = (path[rows], sample[rows])
        self._add(place, np.zeros((len(rows), 2)), force, slope[:, :, BY_TIMING])
        return found

    def _cut(self, chosen: NDArray[np.intp], squared: Array) -> NDArray[np.bool_]:
        """Bound robust forces by further supporting lines (tangents) where timings exceed the force
        limits of their paths.

        Args:
            chosen: (m,) indices of the paths that were timed.
            squared: (m, intervals + 1) squared path speeds u'^2 of these timings at the grid points
                [1/s^2].

        Returns:
            (m,) True for paths whose robust forces exceed their limit.
        """
        m, per = len(chosen), len(self._sample)
        if not m:
            return np.zeros(0, dtype=bool)
        begin = np.repeat(squared[:, :-1], 3, axis=1)
        rise = np.repeat(np.diff(squared, axis=1), 3, axis=1)
        w = (begin + self._share * rise).reshape(-1)
        a = (rise * self._intervals / 2.0).reshape(-1)
        path, sample = np.repeat(chosen, per), np.tile(self._sample, m)
        points, limit = self._points(path, sample, a, w), self._limit[path]
        rows, ruling = self._forces.governing_above(points, CUT_ABOVE * limit)
        force = ruling.force
        exceeded = np.zeros(len(self._limit), dtype=bool)
        exceeded[path[rows][force.max(axis=1) > (1.0 + CUT_TOLERANCE) * limit[rows]]] = True
        self.peak[chosen] = 0.0
        np.maximum.at(self.peak, path[rows], force)
        for k in chosen[self.peak[chosen].max(axis=1) == 0.0]:
            own = np.flatnonzero(path == k)
            self.peak[k] = self._forces.at(points.at(own))[0].max(axis=0)
        keep = np.flatnonzero(exceeded[path[rows]])
        z = np.stack([a[rows], w[rows]], axis=1)[keep]
        place = (path[rows][keep], sample[rows][keep])
        slope = self._forces.slopes(points.at(rows[keep]), ruling.at(keep))
        self._add(place, z, force[keep], slope[:, :, BY_TIMING])
        return exceeded[chosen]

    def _add(
        self,
        place: tuple[NDArray[np.intp], NDArray[np.intp]],
        z: Array,
        force: Array,
        slope: Array,
    ) -> None:
        """Store a supporting line at each of m points: the tangent of the larger one of both
        robots' forces, as a function of (u'', u'^2).

        Args:
            place: index of the path and of the sample of each point, (m,) each.
            z: (m, 2) values of (u'', u'^2) at the points [1/s^2].
            force: (m, 2) robust forces [N].
            slope: (m, 2, 2) derivatives of the forces by (u'', u'^2).
        """
        larger, every = force.argmax(axis=1), np.arange(len(force))
        limit = self._limit[place[0]]
        gradient = slope[every, larger] / limit[:, None]
        bound = 1.0 - force[every, larger] / limit + (gradient * z).sum(axis=1)
        lines = np.column_stack([gradient, bound])
        # Ends of neighbouring intervals share a sample: one after the other.
        for path, sample, line in zip(*place, lines, strict=True):
            self._cuts[path, sample, self._count[path, sample] % CUTS_PER_SAMPLE] = line
            self._count[path, sample] += 1

    def _points(
        self, path: NDArray[np.intp], sample: NDArray[np.intp], a: Array, w: Array
    ) -> PathPoints:
        pose, first, second = (part[path, sample] for part in self._parts)
        return PathPoints(pose, first, second, a, w)


PASS_STATUSES = (
    TimingStatus.OK,
    TimingStatus.INFEASIBLE_AT_REST,
    TimingStatus.SOLVER_FAILED,
    TimingStatus.NOT_CONVERGED,
    TimingStatus.SOLVER_FAILED,
)
"""Timing status by the number that the compiled passes return."""


def forward_backward_passes(
    compiled: CompiledCell, intervals: int, cuts: int = 0
) -> NumericFunction:
    """Load or build the compiled function that times one path by a backward and a forward pass.

    Inputs of this function:

    - `samples` (2 intervals + 1, columns of `symbolic.limits.limit_layout`): coefficients of the
      limits at both ends and in the middle of every interval;
    - `options` (4,): the largest normal force [N], infinite for none; then 0 or 1 each for limits
      on torques, pressure shifts and the reference speeds;
    - with supporting lines also `cuts` (2 intervals + 1, cuts, 3): at every sample lines alpha u''
      + beta u'^2 <= bound with positive bounds, infinite after the last line.

    Outputs, of which `peak` and `use` describe rest if there is no timing:

    - `status`: an index into `PASS_STATUSES`;
    - `interval`: index of the interval of a failure;
    - `duration` [s], infinite if there is no timing;
    - `peak` (2,): largest normal forces [N];
    - `use` (len(LIMIT_NAMES), 3): largest ratio of value to limit for each limit, with the path
      parameter and the index of joint or contact there;
    - `squared` (intervals + 1,): u'^2 at the grid points [1/s^2];
    - `sweeps`: iterations of both passes;
    - `slowed`: uniform factor on the path speed, below one if only this made the limits hold.

    Args:
        compiled: the workcell with its compiled functions.
        intervals: number of intervals of constant path acceleration.
        cuts: number of supporting lines per sample.
    """
    details = (str(intervals), str(cuts), source_digest(__name__, "symbolic.limits"), _passes_c())
    key = compiled.key("path timing", *details, bodies=False)
    made = load_or_compile(
        key, lambda: _source(compiled.symbols.workcell, intervals, cuts), compiled.cache
    )
    return compiled.bound(made)


def _passes_c() -> str:
    return files("hybrid_opt.timing").joinpath("c/passes.c").read_text()


def _source(workcell: Workcell, intervals: int, cuts: int) -> tuple[Signature, str]:
    # Not imported at the top: a warm start needs no CasADi.
    from codegen.source import handwritten_source
    from symbolic.expression import sx_parameters
    from symbolic.limit_coefficients import force_functions, ratio_functions

    layout = limit_layout(workcell)
    helpers = (*force_functions(workcell), *ratio_functions(workcell))
    rooms = [(f.sz_arg(), f.sz_res(), f.sz_iw(), f.sz_w()) for f in helpers]
    # `ask` of the passes hands all of them five arguments.
    most = (max(5, *sizes) for sizes in zip(*rooms, strict=True))
    constants = {
        **dict(zip(("ROOM_ARG", "ROOM_RES", "ROOM_IW", "ROOM_W"), most, strict=True)),
        "ROOM_SOLVED": max(1, helpers[0].numel_out(1)),
        "INTERVALS": intervals,
        "JOINTS": layout.joints,
        "SIZE": layout.size,
        "RATIOS": layout.joints + 2,
        "CUTS": cuts,
        "HELD": 3 if cuts else 2,
        **{f"AT_{name.upper()}": place for name, place in layout.offsets.items()},
    }
    held = sx_parameters(workcell.payload)
    # Both ends of an interval take the time of one; programs of forces are no straight code.
    pairs = (helpers[0], helpers[2]) if contact_model(workcell).has_closed_form else ()
    constants["IN_PAIRS"] = int(bool(pairs))
    text = "".join(
        [
            *[f"#define {name} {value}\n" for name, value in constants.items()],
            passes_enumeration(),
            _passes_c(),
        ]
    )
    signature = Signature(
        "path_timing",
        ("samples", "options", *(("cuts",) if cuts else ()), *held),
        ("status", "interval", "duration", "peak", "use", "squared", "sweeps", "slowed"),
        (
            *((2 * intervals + 1, layout.size), (4,)),
            *(((2 * intervals + 1, cuts, 3),) if cuts else ()),
            *((int(symbols.numel()),) for symbols in held.values()),
        ),
        ((), (), (), (2,), (len(LIMIT_NAMES), 3), (intervals + 1,), (), ()),
    )
    return signature, handwritten_source(
        signature, text, helpers, {f"{f.name()}_in_pairs": f for f in pairs}
    )


def joint_names(robot: Robot) -> tuple[str, ...]:
    """Return the names of a robot's joints in the order of q."""
    return tuple(arm_model(robot).names)[1:]


# --- places of limits, and paths without a timing ---


LEAST_MOTION = 1e-9
"""Box and joints count as standing still if they move less along the whole path [m, rad]."""

ARM_CHECKS = (
    (TimingStatus.OFF_PATH, "reach", "loses the path"),
    (TimingStatus.JOINT_LIMITS, "joint position", "leaves its joint range"),
    (TimingStatus.NEAR_SINGULAR, "manipulability", "comes too near a singular posture"),
)
"""Errors of an arm along a path, in the order in which they are reported: timing status, name of
the condition in a `Place`, and a phrase that says what the robot fails to do."""


def limit_place(
    workcell: Workcell,
    joint_names: tuple[tuple[str, ...], ...],
    constraint: str,
    column: int,
    sample: int,
    parameter: float,
) -> Place:
    """Describe the limit, joint and point of a path at which a limit is used most.

    Args:
        workcell: the workcell.
        joint_names: names of the joints of each arm.
        constraint: name of the limit.
        column: index of the joint (both arms in order) or of the robot; 0 for a limit of the
            payload.
        sample: index of the sample.
        parameter: path parameter u in [0, 1].
    """
    robot, joint = "", ""
    if constraint in PER_JOINT:
        arm = int(column >= len(joint_names[0]))
        joint = joint_names[arm][column - arm * len(joint_names[0])]
        robot = workcell.robots[arm].name
    elif constraint in PER_ROBOT:
        robot = workcell.robots[column].name
    return Place(constraint, robot, joint, sample, parameter)


def failed_timing(status: TimingStatus, place: Place, intervals: int) -> PathTiming:
    """Return the record of a path that cannot be timed, with infinite duration and zero speeds.

    Args:
        status: why there is no timing.
        place: the violated limit or condition, and where.
        intervals: number of intervals of constant path acceleration.
    """
    speed = np.zeros(intervals + 1)
    return PathTiming(status, place, float("inf"), np.full(2, np.nan), {}, speed)


def path_failure(
    workcell: Workcell, pose: Array, lost: Array, limit_margin: Array, manipulability: Array
) -> tuple[TimingStatus, Place, str] | None:
    """Find out why a path has no timing at any speed: all its poses are the same, or an arm does
    not reach a pose, leaves its joint range or is near a singularity.

    Args:
        workcell: the workcell.
        pose: (n, 6) box poses at uniform samples of the path parameter.
        lost: (n, 2) 0 at samples up to which the arm has reached every pose, else 1.
        limit_margin: (n, 2) least distance of a joint to its limits [rad], negative beyond them.
        manipulability: (n, 2) absolute determinant of the Jacobian [m^3].

    Returns:
        Status, place and reason of the error; None without an error.
    """
    if float(np.abs(pose - pose[0]).max()) < LEAST_MOTION:
        reason = "all poses of the path are the same: there is nothing to time"
        return TimingStatus.NO_MOTION, Place("path length", "", "", 0, 0.0), reason
    least = [robot.min_manipulability for robot in workcell.robots]
    found = (lost > 0.5, limit_margin < 0.0, manipulability < least)
    for failed, (status, constraint, text) in zip(found, ARM_CHECKS, strict=True):
        if failed.any():
            sample = int(np.argmax(failed.any(axis=1)))
            robot = workcell.robots[int(np.argmax(failed[sample]))].name
            place = Place(constraint, robot, "", sample, sample / (len(pose) - 1))
            reason = f"robot {robot!r} {text} at u = {place.parameter:.4f}"
            return status, place, reason
    return None
