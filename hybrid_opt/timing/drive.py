"""Candidates of drivable cells: the timing of their paths, and the violations of paths
without one.

A candidate is a path and a force limit. Its timing is the fastest from rest to rest within this
limit and all limits of robots, payload and contacts (`hybrid_opt.timing.path_timer`).
"""

from __future__ import annotations

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
from hybrid_opt.timing.path_timer import PathTimer
from hybrid_opt.timing.records import PathTiming, TimingLimits, TimingStatus
from symbolic.array import Array

_AT_REST = {"normal force": FORCE_LIMIT, "joint torque": JOINT_TORQUE}


class CandidateDriver:
    """Times candidates of one drivable workcell.

    Attributes:
        timer: times their paths.
        robust: whether force limits apply to every case of the workcell's uncertainty.
    """

    def __init__(self, timer: PathTimer, threads: int = 1, robust: bool = False) -> None:
        """Drive with a timer; so many threads share a batch of candidates."""
        self._task = timer.workcell.task
        self._threads = threads
        self.timer, self.robust = timer, robust
        self._last: tuple[bytes, PathTiming, dict[str, Array]] | None = None

    def limits(self, force: float) -> TimingLimits:
        """Return the limits of a candidate with a force limit [N]."""
        return TimingLimits(force=max(force, 1e-9), robust=self.robust)

    def outputs(self, candidate: NumericFunction, x: Array) -> dict[str, Array]:
        """Compute every per-sample output of decision vectors (n, n_var) under their timings.

        Args:
            candidate: compiled `symbolic.functions.candidate_function`.
            x: decision vectors. A path without a timing stands still for one second.

        Returns:
            Its outputs; peak_force (n, 2), the largest normal forces [N]; drive_violation (n,
            len(DRIVE_CONSTRAINTS)), and drive_position (n,), its path parameter, NaN without one.
            With robust limits robust_force (n, 2) as well, the largest in every case of the
            workcell's uncertainty.
        """
        timings = self.timings(x)
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

    def timings(self, x: Array) -> list[PathTiming]:
        """Compute the timing of every decision vector (n, n_var)."""
        if len(x) == 1:
            return [self.time_candidate(x[0])[0]]
        limits = [self.limits(float(force)) for force in x[:, -1]]
        return self.timer.time_all(x[:, : self._task.n_path], limits)

    def time_candidate(self, x: Array) -> tuple[PathTiming, dict[str, Array]]:
        """Compute the timing of one decision vector (n_var,), and `path_limits` of its path. The
        last result is cached: a polish needs it several times in a row."""
        key = x.tobytes()
        if self._last is None or self._last[0] != key:
            path = np.ascontiguousarray(x[None, : self._task.n_path], dtype=float)
            known = self.timer.path_limits(path)
            (timing,) = self.timer.time_from_coefficients(path, known, [self.limits(float(x[-1]))])
            self._last = key, timing, known
        return self._last[1:]


def _speed_profile_at(timing: PathTiming, u: Array) -> tuple[Array, Array, Array]:
    """Return time, u' and u'' at path parameters u; u'' is that of the interval that begins
    there."""
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
    """Compute how a search drives a drivable carry x (n_var,) within its own force limit.

    Raises:
        SettingsError: x does not fit the workcell.
    """
    (found,) = _driver_of(model).timings(model.checked(x)[None])
    return found


def search_carry(model: TimingModel, x: Array) -> Carry:
    """Compute the carry x (n_var,) under the task's own time law; see `hybrid_opt.carry`.

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
