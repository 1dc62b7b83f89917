"""Candidates of the time law 'optimal': how their paths are driven, and what no timing can drive.

A candidate is a path and a force limit. Its timing is the fastest from rest to rest within that
force and all limits of robots, payload and contacts (`hybrid_opt.timing.path_timer`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from codegen.function import NumericFunction
from hybrid_opt.carry import DRIVE_CONSTRAINTS, FORCE_LIMIT, JOINT_TORQUE, NO_TIMING
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.timing.path_timer import PathTimer, PathTiming
from hybrid_opt.timing.records import TimingLimits, TimingStatus
from symbolic.array import Array

_AT_REST = {"normal force": FORCE_LIMIT, "joint torque": JOINT_TORQUE}


@dataclass(frozen=True)
class Drive:
    """How n candidates are driven, at m samples uniform in u.

    Attributes:
        time, speed, acceleration: (n, m) [s], u' [1/s], u'' [1/s^2]. A path without a timing
            stands still, its samples one second apart in all.
        peak_force: (n, 2) largest normal forces [N].
        robust_force: (n, 2) the same in every case of the workcell's uncertainty, None where the
            limit is one of the planned forces.
        violation: (n, len(DRIVE_CONSTRAINTS)).
        position: (n,) path parameter of the violation, NaN without one.
    """

    time: Array
    speed: Array
    acceleration: Array
    peak_force: Array
    robust_force: Array | None
    violation: Array
    position: Array


class Driver:
    """Drives candidates of one workcell.

    Attributes:
        timer: what times their paths.
        robust: whether their force limits hold in every case of the workcell's uncertainty.
    """

    def __init__(self, timer: PathTimer, threads: int = 1, robust: bool = False) -> None:
        """Drive with a timer.

        Args:
            timer: of a workcell whose time law is 'optimal'.
            threads: threads that share a batch of candidates.
            robust: whether force limits hold in every case of the workcell's uncertainty.
        """
        self._task = timer.workcell.task
        self._threads = threads
        self.timer, self.robust = timer, robust

    def limits(self, force: float) -> TimingLimits:
        """Those of a candidate whose force limit this is [N]."""
        return TimingLimits(force=max(force, 1e-9), robust=self.robust)

    def outputs(self, candidate: NumericFunction, x: Array) -> dict[str, Array]:
        """Every per-sample output of decision vectors (n, n_var), driven.

        Args:
            candidate: compiled `symbolic.functions.candidate_function`.
            x: decision vectors.

        Returns:
            Its outputs, and `peak_force`, `drive_violation`, `drive_position` as in `Drive`; with
            robust limits `robust_force` as well.
        """
        found = self.drive(x)
        motion = (found.time, found.speed, found.acceleration)
        outputs = candidate.batch(x, *motion, threads=self._threads)
        # Where the path itself fails no timing tells the forces: those of its samples at rest.
        sampled = outputs["normal_force"].max(axis=1)
        forces = {"peak_force": found.peak_force}
        if found.robust_force is not None:
            forces["robust_force"] = found.robust_force
        told = {name: np.where(np.isfinite(f), f, sampled) for name, f in forces.items()}
        return (
            outputs | told | {"drive_violation": found.violation, "drive_position": found.position}
        )

    def timings(self, x: Array) -> list[PathTiming]:
        """The timing of every decision vector (n, n_var)."""
        limits = [self.limits(float(force)) for force in x[:, -1]]
        return self.timer.time_all(x[:, : self._task.n_path], limits)

    def drive(self, x: Array) -> Drive:
        """How decision vectors (n, n_var) are driven."""
        timings = self.timings(x)
        u = np.linspace(0.0, 1.0, self._task.samples)
        driven = [_at(timing, u) for timing in timings]
        violation = np.zeros((len(x), len(DRIVE_CONSTRAINTS)))
        position = np.full(len(x), np.nan)
        for row, timing in enumerate(timings):
            if np.isfinite(timing.duration):
                continue
            name, excess = NO_TIMING, 1.0
            if timing.status is TimingStatus.INFEASIBLE_AT_REST:
                name = _AT_REST.get(timing.place.constraint, NO_TIMING)
                excess = max(timing.use[timing.place.constraint] - 1.0, 1e-9)
            violation[row, DRIVE_CONSTRAINTS.index(name)] = excess
            position[row] = timing.place.parameter
        force = np.array([timing.peak_force for timing in timings]).reshape(-1, 2)
        robust = None
        if self.robust:
            unknown = np.full(2, np.nan)
            known = [t.robust_force for t in timings]
            robust = np.array([unknown if f is None else f for f in known]).reshape(-1, 2)
        # An axis of three that no candidates leave empty, too.
        parts = np.array(driven).reshape(len(x), 3, len(u))
        time, speed, acceleration = np.swapaxes(parts, 0, 1)
        return Drive(time, speed, acceleration, force, robust, violation, position)


def driver_of(compiled: CompiledCell, threads: int, robust: bool) -> Driver:
    """What drives candidates of a cell under the time law 'optimal', see `Driver`."""
    return Driver(PathTimer(compiled, threads=threads), threads, robust)


def _at(timing: PathTiming, u: Array) -> tuple[Array, Array, Array]:
    """Time, u' and u'' at path parameters u; u'' is that of the interval that begins there."""
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
