"""A candidate as the polish sees it: on the task's samples, and on places between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.functions import RowFunctions
from hybrid_opt.polishing.grid import Grid, dipped
from hybrid_opt.polishing.robust_samples import RobustSamples
from symbolic.array import Array
from symbolic.robot.arm import REACH_TOLERANCE
from symbolic.smooth.reach import Reach
from symbolic.workcell.decision import POSE_SIZE, extended_waypoints, place_redundant

_Found = TypeVar("_Found")

DIPS_BELOW = 0.1
"""Pairs that stay farther apart than this are not looked at between places [m]."""


@dataclass(frozen=True)
class PlacedCarry:
    """A candidate on m places.

    Attributes:
        pose, rate: (m, 6) box poses [m, rad], and their first derivative with respect to the
            path parameter.
        q: both arms' joint positions, (m, n) each [rad]; beyond `reached` without meaning.
        reached: places before the first that an arm does not reach.
        stranded: the arms that do not reach all places.
        clearance: (reached, n_pairs) lower bounds of every active pair's distance [m].
        lowered: the same with the dips that are to be expected beside each place.
        manipulability: (reached, 2) |det J| over its least value.
        split: (n, 2) on samples: normal component, tangential magnitude of the required force [N].
        force: (n, 2) on samples: the normal forces that are minimised, planned or robust ones [N].
        peak: (2,) their peaks over their references.
        shift: (n, 2) on samples: shifts of the centres of pressure over their patches' radii.
    """

    pose: Array
    rate: Array
    q: tuple[Array, Array]
    reached: int
    stranded: tuple[int, ...]
    clearance: Array
    lowered: Array
    manipulability: Array
    split: Array
    force: Array
    peak: Array
    shift: Array
    _distances: Distances = field(repr=False)
    _known: dict[object, Any] = field(default_factory=dict, repr=False)

    @property
    def is_followed(self) -> bool:
        """Whether both arms reach all places."""
        return self.reached == len(self.pose)

    def distance(self, wanted: NDArray[np.bool_]) -> Array:
        """(reached, n_pairs) as `lowered`, those wanted raised by what FCL's distance exceeds the
        bound where nothing touches [m]."""
        return self._distances.at(wanted)

    def once(self, key: object, find: Callable[[], _Found]) -> _Found:
        """What several kinds of constraints want to know of this candidate, found by the first."""
        if key not in self._known:
            self._known[key] = find()
        found: _Found = self._known[key]
        return found


class Distances:
    """Distances of one candidate; each is measured when it is first asked for, and kept."""

    def __init__(
        self,
        bounds: Array,
        lowered: Array,
        measure: Callable[[Array, NDArray[np.bool_]], object],
    ) -> None:
        """bounds, lowered: (n, n_pairs), the latter with the dips beside each place; measure:
        raises bounds. Nothing is copied until something is measured."""
        self._bounds, self._lowered, self._measure = bounds, lowered, measure
        self._raised, self._distances = bounds, lowered
        self._unknown = np.ones(bounds.shape, dtype=np.bool_)

    def at(self, wanted: NDArray[np.bool_]) -> Array:
        """All of them, the wanted measured."""
        fresh = wanted & self._unknown
        if fresh.any():
            if self._raised is self._bounds:
                self._raised, self._distances = self._bounds.copy(), self._lowered.copy()
            self._measure(self._raised, fresh)
            where = fresh.nonzero()
            self._distances[where] += self._raised[where] - self._bounds[where]
            self._unknown[where] = False
        return self._distances


class CarryReader:
    """Evaluates candidates of one cell on the places of a grid."""

    def __init__(
        self,
        evaluator: CandidateEvaluator,
        grid: Grid,
        rows: RowFunctions,
        robust: RobustSamples | None = None,
    ) -> None:
        """robust: what gives the forces that are minimised, None for the planned ones."""
        self._evaluator, self._grid, self._rows, self._robust = evaluator, grid, rows, robust
        self._radii = [contact.patch_radius for contact in evaluator.workcell.contacts]

    def read(self, x: Array) -> PlacedCarry:
        """Evaluate a decision vector (n_var,)."""
        evaluator, grid = self._evaluator, self._grid
        found = {name: value[0] for name, value in evaluator.outputs(x[None]).items()}
        task = evaluator.workcell.task
        waypoints = extended_waypoints(task, x)
        extended = grid.basis @ waypoints
        pose = np.ascontiguousarray(extended[:, :POSE_SIZE])
        guesses = [grid.between(found[f"q_{arm}"]) for arm in (1, 2)]
        place_redundant(task, extended, guesses)
        posture = evaluator.functions["posture"].batch(pose, *guesses)
        followed = np.column_stack(
            [
                (posture[f"residual_{arm}"].reshape(-1) <= REACH_TOLERANCE)
                & (grid.between(found[f"lost_{arm}"].reshape(-1, 1))[:, 0] == 0.0)
                for arm in (1, 2)
            ]
        )
        lost = np.flatnonzero(~followed.all(axis=1))
        reached = int(lost[0]) if len(lost) else len(followed)
        q_1, q_2 = posture["q_1"], posture["q_2"]
        rate = np.ascontiguousarray((grid.rate_basis @ waypoints)[:, :POSE_SIZE])
        squares = [
            1.0 + self._rows.of(Reach(arm), "first").batch(pose, rate, q_1, q_2)["value"]
            for arm in (0, 1)
        ]
        force = found["normal_force"]
        minimised = force if self._robust is None else self._robust.forces(found)
        held = (pose[:reached], q_1[:reached], q_2[:reached])
        bounds = evaluator.checker.bounds(*held)
        near = bounds.min(axis=0, initial=np.inf) < DIPS_BELOW
        lowered = bounds.copy()
        lowered[:, near] = dipped(bounds[:, near])
        return PlacedCarry(
            pose=pose,
            rate=rate,
            q=(q_1, q_2),
            reached=reached,
            stranded=tuple(np.flatnonzero(~followed.all(axis=0)).tolist()),
            clearance=bounds,
            lowered=lowered,
            manipulability=np.sqrt(np.maximum(np.column_stack(squares), 0.0))[:reached],
            split=np.column_stack(
                [force[:, 0] - force[:, 1], found["tangential_force"].sum(axis=1)]
            ),
            force=minimised,
            peak=minimised.max(axis=0) / task.reference_force,
            shift=found["pressure_shift"] / self._radii,
            _distances=Distances(
                bounds,
                lowered,
                lambda raised, wanted: evaluator.checker.measure(*held, raised, wanted),
            ),
        )
