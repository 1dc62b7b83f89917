"""An evaluator whose redundant joints stand still: what locking them would allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.evaluate.evaluations import Evaluations
from symbolic.array import Array
from symbolic.errors import SettingsError


class LockedEvaluator:
    """Evaluates box paths alone, every redundant joint at one position throughout.

    A redundant joint with a constant path gives what the arm with that joint locked gives, so that
    one compiled cell serves all positions. Decision vectors are the free waypoints of the box.
    """

    def __init__(self, evaluator: CandidateEvaluator, positions: Array) -> None:
        """Lock the joints.

        Args:
            evaluator: of a cell in which redundant joints are free at all waypoints.
            positions: (m,) where they stand [rad or m].

        Raises:
            SettingsError: a redundant joint is fixed somewhere, or positions are not one per joint.
        """
        task = evaluator.workcell.task
        n = len(task.waypoints)
        if evaluator.n_var != task.n_box + n * len(task.redundant):
            raise SettingsError("joints are locked in cells where they are free at every waypoint")
        if np.shape(positions) != (len(task.redundant),):
            raise SettingsError(f"{np.size(positions)} positions; needed are {len(task.redundant)}")
        self._evaluator = evaluator
        self._locked = np.repeat(np.asarray(positions, dtype=float), n)
        self.objective_names = evaluator.objective_names
        self.n_var = task.n_box
        self.lower, self.upper = evaluator.lower[: self.n_var], evaluator.upper[: self.n_var]

    def evaluate(self, x: Array) -> Evaluations:
        """Verdicts on box paths (n, n_var)."""
        return replace(self._evaluator.evaluate(self._whole(x)), x=x)

    def certified(self, evaluations: Evaluations) -> Evaluations:
        """See `CandidateEvaluator.certified`."""
        whole = replace(evaluations, x=self._whole(evaluations.x))
        return replace(self._evaluator.certified(whole), x=evaluations.x)

    def _whole(self, x: Array) -> Array:
        return np.hstack([x, np.tile(self._locked, (len(x), 1))])
