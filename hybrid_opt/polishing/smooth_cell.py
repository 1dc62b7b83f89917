"""What all smooth programs of a cell share."""

from __future__ import annotations

import numpy as np

from codegen.cache import Cache
from hybrid_opt.polishing.compiled_rows import row_binder
from hybrid_opt.polishing.decision import UnitBox
from hybrid_opt.polishing.functions import PolishFunctions
from hybrid_opt.polishing.grid import Grid
from hybrid_opt.polishing.robust_samples import RobustSamples
from symbolic.array import Array
from symbolic.records import POSE_SIZE, Workcell
from symbolic.records.task import extended_waypoints
from symbolic.smooth.samples import branch_coefficients, sample_blocks


class SmoothCell:
    """What all smooth programs of a cell share.

    Attributes:
        workcell, task, functions, grid: the cell's.
        unit: the scaled decision vector.
        free: rows and columns of the variables among the extended waypoints.
        blocks: how samples are divided among functions.
        coefficients: (2, 6, 2) those of `branch_coefficients`, and of `layout.HELD`, by which both
            forces are what they are.
        robust: robust forces where they are minimised, None for the planned ones.
        rounding: of the time law's kinks, see `SolveSettings.rounding`.
        still: (n_waypoints, 6 + m) extended waypoints without the variables.
        bind: puts rows together in C, whose library a cache keeps.
    """

    def __init__(
        self,
        workcell: Workcell,
        functions: PolishFunctions,
        grid: Grid,
        robust: RobustSamples | None = None,
        rounding: float = 0.0,
        cache: Cache | None = None,
    ) -> None:
        self.rounding, self.robust = rounding, robust
        self.workcell, self.task = workcell, workcell.task
        self.functions, self.grid = functions, grid
        self.unit = UnitBox.of(workcell.task)
        self.blocks = sample_blocks(workcell.task)
        own = np.eye(2)[:, None]
        self.coefficients = np.concatenate([branch_coefficients(workcell), own], axis=1)
        self.free = workcell.task.free_entries
        self.bind = row_binder(cache)
        self._n_path = workcell.task.n_path
        fixed = [waypoint.lower for waypoint in self.task.waypoints]
        self.still = np.column_stack([fixed, *[joint.lower for joint in self.task.redundant]])

    def waypoints(self, x: Array) -> Array:
        """As `extended_waypoints`, which looks up what is known here and unwraps what need not
        be."""
        points = self.still.copy()
        points[self.free] = x[: self._n_path]
        turns = points[1:, 3:POSE_SIZE] - points[:-1, 3:POSE_SIZE]
        return extended_waypoints(self.task, x) if np.abs(turns).max() > np.pi else points
