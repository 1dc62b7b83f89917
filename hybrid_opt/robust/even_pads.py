"""How hard to press so that pads hold that press evenly, for every case of a set.

The other forces of this package belong to pads that may choose their pressure
(`symbolic.contact.grasp`). Real pads do not: these forces are what is commanded at least
(`hybrid_opt.robust.squeeze`), by the soft-finger model (`symbolic.contact.soft_finger`).
"""

from __future__ import annotations

import numpy as np

from codegen.build import compile_function
from codegen.cache import Cache
from hybrid_opt.per_workcell import kept_per_workcell
from hybrid_opt.robust.cases import nominal_case, worst_cases
from hybrid_opt.robust.force import HeldMotion, check_set
from symbolic.array import Array
from symbolic.contact.worst_cases import case_soft_function
from symbolic.errors import SettingsError
from symbolic.records import Uncertainty, Workcell

DIRECTIONS = 8
"""Ways in which either pad is displaced; the corners lie just outside the disc of what may be."""

RULING = 2
"""Cases of the load, at every sample, that are looked at with displaced pads."""


class EvenPads:
    """The compiled function behind these forces.

    Attributes:
        workcell: the cell.
    """

    def __init__(self, workcell: Workcell, cache: Cache | None = None) -> None:
        """Load or build the compiled function.

        Raises:
            SettingsError: the pads are not two with opposite normals.
            DualArmError: the function cannot be built.
        """
        if not workcell.has_opposite_pads:
            raise SettingsError(
                "what pads that press evenly need is known for two pads with opposite normals only"
            )
        self.workcell = workcell
        self._function = compile_function(case_soft_function(workcell), cache, lanes=0)

    def least(self, motion: HeldMotion, cases: Array) -> Array:
        """(k, n, 2) least normal forces [N] at n samples for cases (k, 15), or for cases of each
        sample (k, n, 15)."""
        n = len(motion.pose)
        each = np.broadcast_to(cases if cases.ndim == 3 else cases[:, None], (len(cases), n, 15))
        rows = (np.tile(x, (len(cases), 1)) for x in (motion.pose, motion.rate, motion.second_rate))
        found = self._function.batch(*rows, each.reshape(-1, 15), threads=0)["normal_force"]
        return np.asarray(found.reshape(len(cases), n, 2))

    def nominal(self, motion: HeldMotion) -> Array:
        """(n, 2) least normal forces of the cell as it is described [N]."""
        return np.asarray(self.least(motion, nominal_case(self.workcell)[None])[0])

    def hold(self, motion: HeldMotion, uncertainty: Uncertainty, leader: int = 0) -> Array:
        """(n,) least normal force to command of the arm that does not lead, for every case [N].

        Loads are looked at in all corners of the set. Displaced pads, of which none is exactly the
        worst, are looked at with the loads that ask for most.

        Raises:
            SettingsError: the set leaves no friction or patch.
        """
        check_set(self.workcell, uncertainty)
        follower = 1 - leader
        corners = worst_cases(self.workcell, uncertainty)
        needed = self.least(motion, corners)[:, :, follower]
        if not uncertainty.pad_position:
            return np.asarray(needed.max(axis=0))
        angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        reach = uncertainty.pad_position / np.cos(np.pi / DIRECTIONS)
        way = reach * np.column_stack([np.cos(angle), np.sin(angle)])
        first, second = np.meshgrid(np.arange(DIRECTIONS), np.arange(DIRECTIONS), indexing="ij")
        displaced = np.column_stack([way[first.ravel()], way[second.ravel()]])
        worst = needed.max(axis=0)
        for rank in range(min(RULING, len(corners))):
            ruling = np.argsort(-needed, axis=0, kind="stable")[rank]
            cases = np.tile(corners[ruling], (len(displaced), 1, 1))
            cases[:, :, 11:15] = displaced[:, None]
            worst = np.maximum(worst, self.least(motion, cases)[:, :, follower].max(axis=0))
        return np.asarray(worst)


even_pads = kept_per_workcell(EvenPads)
"""The model of a workcell, the same one for the same record."""
