"""Candidates of drivable workcells: a path and a force limit each. The timing of a candidate is the
fastest from rest to rest within this limit and all limits of robots, payload and contacts; a path
that cannot be timed has a violation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from codegen.function import NumericFunction
from hybrid_opt.carry import (
    DRIVE_CONSTRAINTS,
    FORCE_LIMIT,
    JOINT_TORQUE,
    NO_TIMING,
    Carry,
    carry_from_outputs,
)
from hybrid_opt.timing.model import TimingModel
from hybrid_opt.timing.records import PathTiming, TimingLimits, TimingStatus
from hybrid_opt.timing.solve import PathTimer
from symbolic.array import Array

LEAST_FORCE_LIMIT = 1e-9
"""Least force limit of a candidate [N]: no timing has none."""

_AT_REST = {"normal force": FORCE_LIMIT, "joint torque": JOINT_TORQUE}


@dataclass(frozen=True)
class TimedCandidate:
    """A candidate with its fastest timing.

    Attributes:
        timing: the timing, or the error of the path.
        duration: [s], infinite without a timing that respects every limit.
        squared: (intervals + 1,) squared path speed u'^2 at the grid points [1/s^2].
        joints: (intervals + 1, n) joint positions of each arm at the grid points [rad].
    """

    timing: PathTiming
    duration: float
    squared: Array
    joints: tuple[Array, Array]


class CandidateDriver:
    """Computes the fastest timings of the candidates of one drivable workcell.

    Attributes:
        timer: times the paths of the candidates.
        robust: whether force limits apply to every case of the workcell's uncertainty.
    """

    def __init__(self, timer: PathTimer, threads: int = 1, robust: bool = False) -> None:
        """Prepare the timing of candidates, each within the force limit in its decision vector.

        Args:
            timer: computes the timings.
            threads: number of threads that share a batch of candidates.
            robust: True if force limits apply to robust forces, which hold in every case of the
                workcell's uncertainty; False for planned forces.
        """
        self._task = timer.workcell.task
        self._threads = threads
        self.timer, self.robust = timer, robust
        # Force limits are the candidates' own.
        self._limits = TimingLimits(force=1.0, robust=robust)
        self._last: tuple[bytes, TimedCandidate] | None = None

    def limits(self, force: float) -> TimingLimits:
        """Return the limits within which a candidate is timed.

        Args:
            force: force limit of the candidate [N]; values below `LEAST_FORCE_LIMIT` are raised to
                it.
        """
        return TimingLimits(force=max(force, LEAST_FORCE_LIMIT), robust=self.robust)

    def time_paths(self, paths: Array, force: Array) -> list[PathTiming]:
        """Compute the fastest timings of n paths, each within its own force limit.

        Args:
            paths: (n, n_path) free waypoints.
            force: (n,) force limits [N].
        """
        return self.timer.time_all(paths, self._limits, np.maximum(force, LEAST_FORCE_LIMIT))

    def durations(self, paths: Array, force: float) -> Array:
        """Compute the durations (n,) [s] of the fastest timings of n paths within one force limit;
        infinite for a path without a timing.

        Args:
            paths: (n, n_path) free waypoints.
            force: the force limit [N].
        """
        found = self.time_paths(paths, np.full(len(paths), force))
        return np.array([t.duration if t.status is TimingStatus.OK else np.inf for t in found])

    def outputs(self, candidate: NumericFunction, x: Array) -> dict[str, Array]:
        """Compute the outputs of n candidates under their fastest timings.

        Args:
            candidate: compiled `symbolic.functions.candidate_function`.
            x: (n, n_var) decision vectors. A candidate without a timing is evaluated at rest for
                one second.

        Returns:
            Outputs of `candidate` by name, and three more. `peak_force` (n, 2): largest normal
            forces [N]. `drive_violation` (n, len(DRIVE_CONSTRAINTS)): positive for the constraint
            that rules out a timing, else zero. `drive_position` (n,): path parameter u of the
            violation, NaN without one. With robust limits also `robust_force` (n, 2): largest
            normal forces over all cases of the workcell's uncertainty [N].
        """
        if len(x) == 1:
            timings = [self.time_candidate(x[0]).timing]
        else:
            force = np.maximum(x[:, -1], LEAST_FORCE_LIMIT)
            timings = self.timer.time_all(x[:, : self._task.n_path], self._limits, force)
        u = np.linspace(0.0, 1.0, self._task.samples)
        # An axis of three that no candidates leave empty, too.
        driven = np.array([_speed_profile_at(timing, u) for timing in timings]).reshape(
            len(x), 3, len(u)
        )
        time, speed, acceleration = np.swapaxes(driven, 0, 1)
        outputs = candidate.batch(x, time, speed, acceleration, threads=self._threads)
        forces = {"peak_force": [timing.peak_force for timing in timings]}
        if self.robust:
            unknown = np.full(2, np.nan)
            known = [timing.robust_force for timing in timings]
            forces["robust_force"] = [unknown if force is None else force for force in known]
        # A path without a timing gets the forces of its samples at rest.
        sampled = outputs["normal_force"].max(axis=1)
        for name, values in forces.items():
            force = np.array(values).reshape(-1, 2)
            outputs[name] = np.where(np.isfinite(force), force, sampled)
        violation, position = np.zeros((len(x), len(DRIVE_CONSTRAINTS))), np.full(len(x), np.nan)
        for row, timing in enumerate(timings):
            if np.isfinite(timing.duration):
                continue
            name, excess = NO_TIMING, 1.0
            if timing.status is TimingStatus.INFEASIBLE_AT_REST:
                name = _AT_REST.get(timing.place.constraint, NO_TIMING)
                excess = max(timing.use[timing.place.constraint] - 1.0, 1e-9)
            violation[row, DRIVE_CONSTRAINTS.index(name)] = excess
            position[row] = timing.place.parameter
        return outputs | {"drive_violation": violation, "drive_position": position}

    def time_candidate(self, x: Array) -> TimedCandidate:
        """Compute the fastest timing of a candidate within its own force limit.

        The last result is cached, because a polish asks for it several times in a row.

        Args:
            x: (n_var,) decision vector.
        """
        key = x.tobytes()
        if self._last is None or self._last[0] != key:
            path, force = x[None, : self._task.n_path], np.maximum(x[-1:], LEAST_FORCE_LIMIT)
            known = self.timer.path_limits(path)
            (timing,) = self.timer.time_all(path, self._limits, force, known)
            duration = timing.duration if timing.status is TimingStatus.OK else np.inf
            q_1, q_2 = (np.ascontiguousarray(known[f"q_{arm}"][0][::2]) for arm in (1, 2))
            squared = timing.grid_speed**2
            self._last = key, TimedCandidate(timing, duration, squared, (q_1, q_2))
        return self._last[1]


def _speed_profile_at(timing: PathTiming, u: Array) -> tuple[Array, Array, Array]:
    """Compute the motion along a path at given path parameters.

    At a grid point u'' belongs to the interval that begins there. A path without a timing is at
    rest.

    Args:
        timing: fastest timing of the path.
        u: (n,) path parameters in [0, 1].

    Returns:
        Time [s], path speed u' [1/s] and path acceleration u'' [1/s^2], (n,) each.
    """
    if not np.isfinite(timing.duration):
        return u, np.zeros_like(u), np.zeros_like(u)
    squared = timing.grid_speed**2
    intervals = len(squared) - 1
    interval = np.minimum((u * intervals).astype(int), intervals - 1)
    acceleration = np.diff(squared) * intervals / 2.0
    # Average speed over a piece of constant acceleration is that of its ends.
    steps = 2.0 / intervals / (timing.grid_speed[:-1] + timing.grid_speed[1:])
    begins = np.concatenate([[0.0], np.cumsum(steps)])[:-1]
    into = u - interval / intervals
    speed = np.sqrt(np.maximum(squared[interval] + 2.0 * acceleration[interval] * into, 0.0))
    total = timing.grid_speed[interval] + speed
    time = begins[interval] + 2.0 * into / np.where(total > 0.0, total, 1.0)
    return time, speed, acceleration[interval]


def search_timing(model: TimingModel, x: Array) -> PathTiming:
    """Compute the timing that a search gives a drivable carry within its own force limit.

    Args:
        model: timing model of the workcell.
        x: (n_var,) decision vector.

    Raises:
        SettingsError: x does not fit the workcell.
    """
    return _driver_of(model).time_candidate(model.checked(x)).timing


def search_carry(model: TimingModel, x: Array) -> Carry:
    """Compute the carry that a search evaluates, under the task's own time law.

    Args:
        model: timing model of the workcell.
        x: (n_var,) decision vector.

    Raises:
        SettingsError: x does not fit the workcell.
    """
    x = model.checked(x)
    functions = model.compiled.evaluators
    if not model.workcell.task.law.is_drivable:
        return carry_from_outputs(model.workcell, functions, x, functions["candidate"](x))
    outputs = _driver_of(model).outputs(functions["candidate"], x[None])
    single = {name: values[0] for name, values in outputs.items()}
    return carry_from_outputs(model.workcell, functions, x, single)


@lru_cache(maxsize=2)
def _driver_of(model: TimingModel) -> CandidateDriver:
    return CandidateDriver(PathTimer(model.compiled), robust=model.is_robust)
