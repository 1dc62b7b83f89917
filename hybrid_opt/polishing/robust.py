"""Robust forces in the polish: at the samples of a carry, and along a driven path.

The smooth model has planned forces with two derivatives. For robust forces it takes values and
slopes at the candidate of each iteration, exact for the governing cases, and the curvature of
planned forces. So the model of every iteration agrees with the true forces to first order, and at a
stationary point of the iteration the true first-order conditions hold. At every point of a driven
path the most demanding cases have a row each: if two cases govern alternately, one row alone would
admit a step that the other forbids.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from codegen.interpreted import interpret
from hybrid_opt.carry import BoxMotion
from hybrid_opt.compiled_cell import contact_function
from hybrid_opt.robust.cases import GoverningCases, governing_cases
from hybrid_opt.robust.force import robust_model
from hybrid_opt.robust.path_force import PathPoints, robust_path
from symbolic.array import Array
from symbolic.contact.worst_cases import case_gradient_function
from symbolic.records.cell import Workcell
from symbolic.smooth.driven import planned_branches
from symbolic.smooth.samples import motion_function

LEADER = 0
"""Index of the arm that keeps its position, as in the objectives."""

GOVERNING_CASES = 3
"""Number of cases per robot and point of a driven path that have rows."""

ROBUST_ROWS = 2 * GOVERNING_CASES


class RobustSamples:
    """Computes robust forces at the samples of a workcell's carries."""

    def __init__(self, workcell: Workcell) -> None:
        """Load or build the compiled functions.

        Args:
            workcell: the cell.

        Raises:
            SettingsError: no force of the pads holds the box in some case of the uncertainty, or
                the uncertainty leaves no friction or patch.
            DualArmError: a function cannot be built.
        """
        self._workcell, self._model = workcell, robust_model(workcell)
        self._cases = self._model.worst_cases(workcell.uncertainty, LEADER)
        self._gradient = contact_function(workcell, "case gradient", case_gradient_function)
        self._motion = interpret(motion_function(workcell.task))

    def forces(self, found: Mapping[str, Array]) -> Array:
        """Compute the normal forces (n, 2) [N] with which both robots hold the box in every case of
        the uncertainty, at n samples.

        Args:
            found: the evaluator's outputs for one candidate, of which the box pose and its first
                and second time derivative ('pose', 'rate' and 'second_rate', (n, 6)) are used.
        """
        motion = BoxMotion(*[found[name] for name in ("pose", "rate", "second_rate")])
        return self._governing(motion).force

    def first(self, x: Array) -> tuple[Array, Array]:
        """Compute the normal forces with which both robots hold the box in every case of the
        uncertainty, and their first derivatives by the decision vector.

        Args:
            x: (n_var,) decision vector.

        Returns:
            Forces (n, 2) [N] at n samples, and their derivatives (n, 2, n_var) by x.
        """
        out = self._motion.batch(np.ascontiguousarray(x)[None])
        rows = out["motion"][0]
        by_x = out["slope"][0].reshape(*rows.shape, len(x))
        parts = [np.ascontiguousarray(rows[:, at : at + 6]) for at in (0, 6, 12)]
        governing = self._governing(BoxMotion(*parts))
        slopes = governing.slopes(
            *[
                self._gradient.batch(*parts, self._cases[case])["slope"]
                for case in (governing.commanded, governing.leading)
            ]
        )
        return governing.force, np.einsum("nrm,nmx->nrx", slopes, by_x)

    def _governing(self, motion: BoxMotion) -> GoverningCases:
        worst = self._model.least_squeeze(motion, self._cases)
        share = float(self._model.leading_share[LEADER])
        return governing_cases(worst, self._workcell.uncertainty, LEADER, leading_share=share)


class RobustForces:
    """Computes robust forces of both robots at points of timed paths of one workcell."""

    def __init__(self, workcell: Workcell, pose: int) -> None:
        """Prepare the forces.

        Args:
            workcell: the workcell.
            pose: number of entries of a box pose with redundant joints.
        """
        self._forces, self._pose = robust_path(workcell), pose
        self._branches = planned_branches(workcell)

    def at(self, path: Sequence[Array], a: Array, w: Array) -> tuple[Array, Array]:
        """Compute the normal forces that hold the box in the `GOVERNING_CASES` cases of the
        uncertainty with the largest commanded forces at each point, and their derivatives.

        Args:
            path: box pose followed by redundant joints, and its first and second derivative by the
                path parameter u, (points, pose) each.
            a: (points,) path acceleration u'' [1/s^2].
            w: (points,) squared path speed u'^2 [1/s^2].

        Returns:
            Forces (points, ROBUST_ROWS) [N], all cases of the first robot and then those of the
            second; and their derivatives (points, ROBUST_ROWS, 3 pose + 2) by the entries of
            `path`, u'' and u'^2.
        """
        pose, first, second = (np.ascontiguousarray(part[:, :6]) for part in path)
        force, slope = self._forces.most_demanding(
            PathPoints(pose, first, second, a, w), GOVERNING_CASES
        )
        n = len(a)
        found = np.zeros((n, ROBUST_ROWS, 3 * self._pose + 2))
        by = slope.reshape(n, ROBUST_ROWS, -1)
        for k in range(3):
            found[:, :, k * self._pose : k * self._pose + 6] = by[:, :, 6 * k : 6 * k + 6]
        found[:, :, -2:] = by[:, :, -2:]
        return force.reshape(n, ROBUST_ROWS), found

    def planned_weights(self, weight: Array, value: Array) -> Array:
        """Replace the multipliers of robust normal forces by multipliers of planned normal forces.

        A Hessian of the Lagrangian with the new multipliers approximates the curvature of robust
        forces, which is not computed, by that of planned forces.

        Args:
            weight: (points, quantities + ROBUST_ROWS) multipliers of the quantities, then of the
                robust forces.
            value: (points, quantities + ROBUST_ROWS) values of the quantities, then the robust
                forces.

        Returns:
            (points, quantities) multipliers of the quantities.
        """
        size = weight.shape[1] - ROBUST_ROWS
        found = weight[:, :size].copy()
        shares = weight[:, size:].reshape(-1, 2, GOVERNING_CASES).sum(axis=2)
        for arm, branches in enumerate(self._branches):
            governing = branches[np.argmax(value[:, :size] @ branches.T, axis=1)]
            found += shares[:, arm, None] * governing
        return found
