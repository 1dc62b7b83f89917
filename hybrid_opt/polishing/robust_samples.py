"""Robust forces at the samples of a carry, with their slopes by the decision vector.

The smooth problem knows planned forces with two derivatives. For robust ones it takes their values
and slopes at the candidate of each round, exact for the case that rules, and bends them as planned
forces bend: every round's model agrees with the truth to first order, so that where rounds come to
rest the true first-order conditions hold.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from codegen.build import compile_function
from codegen.interpreted import InterpretedFunction
from hybrid_opt.robust.cases import worst_cases
from hybrid_opt.robust.force import BoxMotion, check_set, robust_model
from hybrid_opt.robust.ruling import RulingCases, ruling_cases
from symbolic.array import Array
from symbolic.contact.worst_cases import case_gradient_function
from symbolic.records import Workcell
from symbolic.smooth.samples import motion_function

LEADER = 0
"""The arm that keeps its place, as in the objectives."""


class RobustSamples:
    """Robust forces along carries of one workcell."""

    def __init__(self, workcell: Workcell) -> None:
        """Load or build the compiled functions.

        Raises:
            SettingsError: there are no robust forces of its pads, or its uncertainty leaves no
                friction or patch.
            DualArmError: a function cannot be built.
        """
        check_set(workcell, workcell.uncertainty)
        self._workcell, self._model = workcell, robust_model(workcell)
        self._cases = worst_cases(workcell, workcell.uncertainty)
        self._gradient = compile_function(case_gradient_function(workcell))
        self._motion = InterpretedFunction(motion_function(workcell.task))

    def forces(self, found: Mapping[str, Array]) -> Array:
        """(n, 2) normal forces [N] from the evaluator's outputs for one candidate."""
        motion = BoxMotion(*[found[name] for name in ("pose", "rate", "second_rate")])
        return self._ruling(motion).force

    def first(self, x: Array) -> tuple[Array, Array]:
        """Forces (n, 2) [N] of a decision vector (n_var,) and their derivatives (n, 2, n_var)."""
        out = self._motion.batch(np.ascontiguousarray(x)[None])
        rows = out["motion"][0]
        by_x = out["slope"][0].reshape(*rows.shape, len(x))
        parts = [np.ascontiguousarray(rows[:, at : at + 6]) for at in (0, 6, 12)]
        ruling = self._ruling(BoxMotion(*parts))
        slopes = ruling.slopes(
            *[
                self._gradient.batch(*parts, self._cases[case])["slope"]
                for case in (ruling.commanded, ruling.felt)
            ]
        )
        return ruling.force, np.einsum("nrm,nmx->nrx", slopes, by_x)

    def _ruling(self, motion: BoxMotion) -> RulingCases:
        worst = self._model.least_squeeze(motion, self._cases)
        return ruling_cases(worst, self._workcell.uncertainty, LEADER)
