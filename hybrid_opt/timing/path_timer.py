"""Fastest timings of many paths of one workcell, from waypoints, fast enough for a search.

A carry is not built: `hybrid_opt.timing.limits.drive_path` recomputes one for a timing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.timing.limits import arm_path_error, limited_force
from hybrid_opt.timing.model import TimingModel, require_intervals, sample_limits_set
from hybrid_opt.timing.passes import ForwardBackwardPasses
from hybrid_opt.timing.records import PathTiming, TimingLimits, TimingStatus, failed_timing
from hybrid_opt.timing.solve import time_path
from symbolic.array import Array
from symbolic.errors import SettingsError
from symbolic.records import Workcell

if TYPE_CHECKING:
    import casadi as ca

    from symbolic.cell_model import CellModel

PATH_INTERVALS = 100
"""Pieces of constant path acceleration."""


class PathTimer:
    """Times paths of one workcell. For limits that the compiled passes do not support it calls
    `time_path`, which is slow.

    Attributes:
        workcell: the cell.
        intervals: pieces of constant path acceleration.
        passes: the compiled passes.
    """

    def __init__(
        self,
        cell: Workcell | CompiledCell,
        intervals: int = PATH_INTERVALS,
        threads: int = 1,
        lanes: int = 0,
    ) -> None:
        """Load or build the compiled functions.

        Args:
            cell: compiled, if others share its functions.
            threads: threads that share a batch.
            lanes: paths of a batch that run side by side; 0 for the machine's width. One lane
                builds faster.

        Raises:
            SettingsError: the number of intervals is out of range.
            DualArmError: the model or its code cannot be built.
        """
        require_intervals(intervals)
        compiled = CompiledCell.of(cell)
        self.workcell, self.intervals, self._threads = compiled.workcell, intervals, threads

        def make(model: CellModel) -> dict[str, ca.Function]:
            # Not imported at the top: a warm start needs no CasADi.
            from symbolic.limit_coefficients import path_function

            return {"path": path_function(model, 2 * intervals + 1)}

        paths = compiled.functions("path", make, str(intervals), lanes=lanes, bodies=False)
        self._path, self._limits = paths["path"], sample_limits_set(compiled, lanes)
        self.passes = ForwardBackwardPasses(compiled, intervals, threads)
        # Made here: the cell's files may be gone when the first path is timed.
        has_all = self.passes.supports(TimingLimits(force=1.0, robust=True))
        self._model = None if has_all else TimingModel(compiled, intervals)

    def path_limits(self, x: Array) -> dict[str, Array]:
        """Compute the outputs of `symbolic.limit_coefficients.path_function` and the coefficients
        `limits` for waypoints (n, n_var), at both ends and in the middle of every interval."""
        # One path is not worth a second thread.
        threads = self._threads if len(x) > 1 else 1
        paths = self._path.batch(np.ascontiguousarray(x, dtype=float), threads=threads)
        shapes = zip(self._limits.input_names, self._limits.input_shapes, strict=True)
        samples = [paths[name].reshape(-1, *shape) for name, shape in shapes]
        rows = self._limits.batch(*samples, threads=threads)["limits"]
        return paths | {"limits": rows.reshape(len(x), 2 * self.intervals + 1, rows.shape[-1])}

    def time(self, x: Array, limits: TimingLimits) -> PathTiming:
        """Compute the fastest timing from rest to rest of one path.

        Args:
            x: (n_var,) free waypoints.
            limits: in addition to the workcell's.

        Raises:
            SettingsError: x has the wrong shape or is not finite.
        """
        (timing,) = self.time_all(np.asarray(x, dtype=float)[None], [limits])
        return timing

    def time_all(self, x: Array, limits: list[TimingLimits]) -> list[PathTiming]:
        """Compute the fastest timing of every path (n, n_var) within its own limits.

        Raises:
            SettingsError: x has the wrong shape or is not finite.
        """
        x = np.ascontiguousarray(x, dtype=float)
        (n_var,) = self._path.input_shapes[0]
        if x.shape != (len(limits), n_var) or not np.isfinite(x).all():
            raise SettingsError(
                f"waypoints of shape {x.shape}; needs {len(limits)} rows of {n_var} finite numbers",
                code="shape",
            )
        return self.time_from_coefficients(x, self.path_limits(x), limits)

    def path_errors(self, paths: dict[str, Array]) -> list[PathTiming | None]:
        """Return an error for each path of `path_limits` without feasible timing, else None."""
        names = ("lost", "limit_margin", "manipulability")
        sides = [np.stack([paths[f"{name}_{arm}"] for arm in (1, 2)], axis=2) for name in names]
        found = [
            arm_path_error(self.workcell, pose[:, :6], *each)
            for pose, *each in zip(paths["pose"], *sides, strict=True)
        ]
        return [
            None if error is None else failed_timing(error.status, error.place, self.intervals)
            for error in found
        ]

    def time_from_coefficients(
        self,
        x: Array,
        paths: dict[str, Array],
        limits: list[TimingLimits],
        path_errors: Sequence[PathTiming | None] | None = None,
    ) -> list[PathTiming]:
        """Time paths as `time_all` does, from known answers of `path_limits` and `path_errors`."""
        found = list(self.path_errors(paths) if path_errors is None else path_errors)
        rows = [row for row, error in enumerate(found) if error is None]
        fast = [row for row in rows if self.passes.supports(limits[row])]
        if fast:
            chosen = paths if len(fast) == len(x) else {k: v[fast] for k, v in paths.items()}
            timings = self.passes.time(chosen, [limits[row] for row in fast])
            for row, timing in zip(fast, timings, strict=True):
                found[row] = timing
        if self._model is not None:
            for row in set(rows).difference(fast):
                found[row] = _as_path_timing(self._model, x[row], limits[row])
        return [timing for timing in found if timing is not None]


def _as_path_timing(model: TimingModel, x: Array, limits: TimingLimits) -> PathTiming:
    """Return the answer of `time_path` for a path (n_path,) as a `PathTiming`."""
    timing = time_path(model, x, limits)
    force, robust, carry = np.full(2, np.nan), None, timing.carry
    if timing.status is TimingStatus.INFEASIBLE_AT_REST:
        carry = model.still(model.path_motion(x))
    if carry is not None:
        force = carry.peak_normal_force
        if limits.robust:
            robust = limited_force(carry, model.workcell, limits).max(axis=0)
    return PathTiming(
        status=timing.status,
        place=timing.place,
        duration=timing.duration,
        peak_force=force,
        use={name: used.ratio for name, used in timing.use.items()},
        grid_speed=timing.grid_speed,
        sweeps=timing.iterations,
        slowed=timing.slowed,
        robust_force=robust,
    )
