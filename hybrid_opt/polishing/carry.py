"""A candidate as the polish sees it: on the task's samples, and on places between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from symbolic.array import Array
from symbolic.physics.path import path_basis
from symbolic.robot.arm import REACH_TOLERANCE
from symbolic.workcell.decision import waypoints_of

PER_SAMPLE = 4
"""Places per interval between samples. What dips between two places is covered by the distance
kept from obstacles, and in the end certified."""


@dataclass(frozen=True)
class Carry:
    """A candidate on m places: the samples, and `PER_SAMPLE` - 1 places between any two.

    Attributes:
        pose, rate: (m, 6) box poses, and their change from place to place [m, rad].
        q: both arms' joint positions, (m, 6) each [rad]; beyond `reached` without meaning.
        reached: places before the first that an arm does not reach.
        stranded: the arms that do not reach all places.
        clearance: (reached, n_pairs) lower bounds of every active pair's distance [m].
        manipulability: (reached, 2) |det J| over its least value, between samples interpolated.
        split: (n, 2) on samples: normal component, tangential magnitude of the required force [N].
        peak: (2,) peak normal forces over their references.
        shift: (n, 2) on samples: shifts of the centres of pressure over their patches' radii.
    """

    pose: Array
    rate: Array
    q: tuple[Array, Array]
    reached: int
    stranded: tuple[int, ...]
    clearance: Array
    manipulability: Array
    split: Array
    peak: Array
    shift: Array

    @property
    def is_followed(self) -> bool:
        """Whether both arms reach all places."""
        return self.reached == len(self.pose)


class CarryReader:
    """Evaluates candidates of one cell on places.

    Attributes:
        basis, rate_basis: (m, n_waypoints) of all places: poses = basis @ waypoints, and their
            change from place to place.
    """

    def __init__(self, evaluator: CandidateEvaluator) -> None:
        self._evaluator = evaluator
        task = evaluator.workcell.task
        self._radii = [contact.patch_radius for contact in evaluator.workcell.contacts]
        self._samples = np.linspace(0.0, 1.0, task.samples)
        self._places = np.linspace(0.0, 1.0, (task.samples - 1) * PER_SAMPLE + 1)
        along = path_basis(len(task.waypoints), self._places)
        self.basis, self.rate_basis = along.position, along.first / (len(self._places) - 1)

    def read(self, x: Array) -> Carry:
        """Evaluate a decision vector (n_var,)."""
        evaluator = self._evaluator
        found = {name: value[0] for name, value in evaluator.outputs(x[None]).items()}
        waypoints = waypoints_of(evaluator.workcell.task, x)
        pose = np.ascontiguousarray(self.basis @ waypoints)
        guesses = [self._between(found[f"q_{arm}"]) for arm in (1, 2)]
        posture = evaluator.functions["posture"].batch(pose, *guesses)
        followed = np.column_stack(
            [
                (posture[f"residual_{arm}"].reshape(-1) <= REACH_TOLERANCE)
                & (self._between(found[f"lost_{arm}"].reshape(-1, 1))[:, 0] == 0.0)
                for arm in (1, 2)
            ]
        )
        lost = np.flatnonzero(~followed.all(axis=1))
        reached = int(lost[0]) if len(lost) else len(followed)
        q = (posture["q_1"], posture["q_2"])
        limits = [robot.min_manipulability for robot in evaluator.workcell.robots]
        measure = np.column_stack(
            [found[f"manipulability_{arm}"].reshape(-1) / limits[arm - 1] for arm in (1, 2)]
        )
        force = found["normal_force"]
        return Carry(
            pose=pose,
            rate=self.rate_basis @ waypoints,
            q=q,
            reached=reached,
            stranded=tuple(np.flatnonzero(~followed.all(axis=0)).tolist()),
            clearance=evaluator.checker.bounds(pose[:reached], q[0][:reached], q[1][:reached]),
            manipulability=self._between(measure)[:reached],
            split=np.column_stack(
                [force[:, 0] - force[:, 1], found["tangential_force"].sum(axis=1)]
            ),
            peak=force.max(axis=0) / evaluator.workcell.task.reference_force,
            shift=found["pressure_shift"] / self._radii,
        )

    def _between(self, values: Array) -> Array:
        """Values (n, k) on samples, interpolated to all places (m, k)."""
        return np.column_stack(
            [np.interp(self._places, self._samples, column) for column in values.T]
        )
