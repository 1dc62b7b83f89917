"""Robust forces at points of a path as functions of u'' and u'^2, with their slopes.

In every case the least squeeze is convex in the required force and moment, and these are affine in
(u'', u'^2). So is the largest over the worst cases, whose slopes are those of the case that rules.
"""

from __future__ import annotations

import numpy as np

from codegen.build import compile_function
from codegen.cache import Cache
from hybrid_opt.per_workcell import kept_per_workcell
from hybrid_opt.robust.cases import worst_cases
from hybrid_opt.robust.force import check_pads, check_set
from hybrid_opt.robust.ruling import ruling_cases
from symbolic.array import Array
from symbolic.physics.case_squeeze import case_slopes_function
from symbolic.workcell.records import Workcell


class RobustPath:
    """The compiled function behind robust forces along paths of one workcell."""

    def __init__(self, workcell: Workcell, cache: Cache | None = None) -> None:
        """Load or build the compiled function.

        Raises:
            SettingsError: the pads do not face one another, or the workcell's set leaves no
                friction or patch.
            DualArmError: the function cannot be built.
        """
        check_pads(workcell)
        check_set(workcell, workcell.uncertainty)
        self._cases = worst_cases(workcell, workcell.uncertainty)
        self._set = workcell.uncertainty
        self._function = compile_function(case_slopes_function(workcell), cache, lanes=0)

    def at(
        self, path: tuple[Array, Array, Array], a: Array, w: Array, leader: int = 0
    ) -> tuple[Array, Array]:
        """Least normal forces that hold in every case of the workcell's set.

        Args:
            path: box poses and their derivatives by u at n points, (n, 6) each.
            a, w: (n,) u'' and u'^2.
            leader: index of the arm that keeps its place.

        Returns:
            (n, 2) forces of both robots [N], and (n, 2, 2) their derivatives by u'' and by u'^2.
        """
        n, k = len(a), len(self._cases)
        rows = [np.tile(values, (k, 1)) for values in path]
        rows += [np.tile(a, k), np.tile(w, k), np.repeat(self._cases, n, axis=0)]
        out = self._function.batch(*rows)
        force = out["normal_force"].reshape(k, n, 2)
        slope = out["slope"].reshape(k, n, 2, 2)
        every, ruling = np.arange(n), ruling_cases(force, self._set, leader)
        slopes = ruling.slopes(slope[ruling.commanded, every], slope[ruling.felt, every])
        return ruling.force, slopes


robust_path = kept_per_workcell(RobustPath)
"""The one of a workcell, the same for the same record."""
