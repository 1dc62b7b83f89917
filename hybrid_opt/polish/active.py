"""Which constraints at places of the path enter a solve, and which a solution violates.

Places are the task's samples and some between them (`hybrid_opt.polish.carry`). Obstacles enter
where their clearance bound is small, at the lowest points along the path; joint limits and
singularities at the tightest place. The smooth bound may be lower than the true distance by a
centimetre, so a row asks for the wanted distance less what FCL, or the sharp bound, measures
beyond the smooth one at the current point; where the solution moves on and that was too much, the
next round asks again from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.evaluation import CandidateEvaluator
from hybrid_opt.polish.carry import PER_SAMPLE, Carry
from hybrid_opt.polish.records import PolishSettings
from symbolic.smooth_rows import RowFunctions, RowKind
from symbolic.workcell import Array

Row = tuple[RowKind, int]
"""What is kept, and at which place."""

BESIDE = (0, 1, -6, 6)
"""Places around the lowest violated clearance that get a row; a dip counts at two neighbours."""

NEAR = 0.02
"""Bounds lower than this are compared with FCL's distance [m]."""

PAYLOAD_ACTIVITY = ((0.03, 8), (0.08, 16))
"""The payload's clearances need no joints: they are cheap, decide where the path may go, and get
rows below each distance [m] at every so many places."""

LIMIT_ACTIVITY = 0.05
"""Joints nearer than this to a limit get a row [rad]."""

SINGULARITY_SHARE = 0.5
SINGULARITY_STRIDE = 32
"""Where |det J| is below this share of its median along the path, every so many places get a row:
it bounds the reach, beyond which nothing else is defined."""

LOST_PLACES = (0, 16, 32)
"""Places after the loss of an arm that get a row."""


class ActiveSet:
    """Chooses rows for candidates of one evaluator."""

    def __init__(
        self, evaluator: CandidateEvaluator, rows: RowFunctions, settings: PolishSettings
    ) -> None:
        self._evaluator, self._rows, self._settings = evaluator, rows, settings
        geometry = evaluator.checker.geometry
        self._payload_pairs = {
            k
            for k, pair in enumerate(geometry.active)
            if {geometry.bodies[pair.first].group, geometry.bodies[pair.second].group}
            == {"payload", "environment"}
        }
        self._wanted = evaluator.workcell.collision.tolerance + settings.clearance

    def near(self, carry: Carry) -> list[Row]:
        """Rows of everything near activity."""
        rows = []
        widest = max(self._settings.activity, *(distance for distance, _ in PAYLOAD_ACTIVITY))
        for pair in np.flatnonzero((carry.clearance < widest).any(axis=0)).tolist():
            column = carry.clearance[:, pair]
            places = set(_lowest(column, self._settings.activity, None))
            if pair in self._payload_pairs:
                for distance, stride in PAYLOAD_ACTIVITY:
                    places.update(_lowest(column, distance, stride))
            rows += [(RowKind("clearance", pair), place) for place in places]
        return self._movable(rows + self._joint_rows(carry, LIMIT_ACTIVITY, SINGULARITY_SHARE))

    def violated(self, carry: Carry) -> list[Row]:
        """Rows of everything that the candidate violates."""
        rows = self._joint_rows(carry, 0.0, None)
        # An arm loses the path at the edge of its reach, where it is stretched: singular.
        rows += [
            (RowKind("singularity", -1, arm), carry.reached + later)
            for arm in carry.stranded
            for later in LOST_PLACES
        ]
        # Half of the wanted distance is left to what the solver and FCL round off.
        limit = self._wanted / 2.0
        close = _dipped(carry.clearance) < limit
        if close.any():
            truth = self._measured(carry, close)
            for pair in np.flatnonzero(close.any(axis=0)).tolist():
                lowest = _lowest(truth[:, pair], limit, None)
                places = {k + shift for k in lowest for shift in BESIDE}
                rows += [(RowKind("clearance", pair), k) for k in places if k < carry.reached]
        return self._movable(rows)

    def _movable(self, rows: list[Row]) -> list[Row]:
        """Without the first and last pose, which are fixed."""
        last = (self._evaluator.workcell.task.samples - 1) * PER_SAMPLE
        return [row for row in rows if 0 < row[1] < last]

    def required(self, carry: Carry, rows: Sequence[Row], lenient: bool) -> dict[Row, float]:
        """The value that each row at a reached place has to keep, see the module.

        Args:
            lenient: ask for no more than the candidate keeps already, where it is free.
        """
        required = dict.fromkeys(rows, self._settings.margin)
        chosen = [row for row in rows if row[0].kind == "clearance" and row[1] < carry.reached]
        places = np.array([place for _, place in chosen], dtype=int)
        pairs = np.array([kind.index for kind, _ in chosen], dtype=int)
        low = np.zeros(carry.clearance.shape, dtype=bool)
        low[places, pairs] = carry.clearance[places, pairs] < NEAR
        truth = self._measured(carry, low)[places, pairs]
        smooth = np.array([self._smooth(carry, row) for row in chosen])
        wanted = np.full(len(chosen), self._wanted)
        if lenient:
            wanted = np.where(truth > 0.0, np.minimum(wanted, truth), wanted)
        return required | dict(zip(chosen, (wanted - (truth - smooth)).tolist(), strict=True))

    def halfway(self, carry: Carry, row: Row, required: float) -> float:
        """Half way from a row's required value to what the candidate has there."""
        return (required + self._smooth(carry, row)) / 2.0

    def _smooth(self, carry: Carry, row: Row) -> float:
        """The row's value as the smooth problem sees it."""
        kind, place = row
        value = self._rows.value(kind)
        return float(value(carry.pose[place], carry.q[0][place], carry.q[1][place]))

    def _measured(self, carry: Carry, wanted: NDArray[np.bool_]) -> Array:
        """The bounds, those of wanted pairs raised to FCL's distance where nothing touches, and
        lowered to what is to be expected beside each place."""
        bounds = carry.clearance.copy()
        k = carry.reached
        q_1, q_2 = carry.q
        self._evaluator.checker.measure(carry.pose[:k], q_1[:k], q_2[:k], bounds, wanted)
        return _dipped(bounds)

    def _joint_rows(self, carry: Carry, limit: float, share: float | None) -> list[Row]:
        rows: list[Row] = []
        for arm, robot in enumerate(self._evaluator.workcell.robots):
            q = carry.q[arm][: carry.reached]
            for joint in range(6):
                sides: tuple[tuple[Literal["lower", "upper"], Array], ...] = (
                    ("lower", q[:, joint] - robot.position_lower[joint]),
                    ("upper", robot.position_upper[joint] - q[:, joint]),
                )
                for side, margins in sides:
                    places = _lowest(margins, limit, None)
                    rows += [(RowKind(side, joint, arm), place) for place in places]
            measure = carry.manipulability[:, arm]
            least = 1.0 if share is None else max(1.0, share * float(np.median(measure)))
            places = _lowest(measure, least, None if share is None else SINGULARITY_STRIDE)
            rows += [(RowKind("singularity", -1, arm), place) for place in places]
        return rows


def _dipped(clearance: Array) -> Array:
    """Clearances (n, k) with the dips between places: where an edge is passed, the clearance falls
    steadily up to a kink and rises steadily from there, so the lines from both sides meet at the
    least value in between, which then counts at both places."""
    low = clearance.copy()
    if len(clearance) < 4:
        return low
    before, left, right, after = (clearance[i : len(clearance) - 3 + i] for i in range(4))
    falling, rising = before - left, after - right
    both = (falling > 0.0) & (rising > 0.0)
    slopes = np.where(both, falling + rising, 1.0)
    share = np.where(both, (left - right + rising) / slopes, 0.0)
    kink = np.where((share > 0.0) & (share < 1.0), left - falling * share, np.inf)
    low[1:-2] = np.minimum(low[1:-2], kink)
    low[2:-1] = np.minimum(low[2:-1], kink)
    return low


def _lowest(values: Array, limit: float, stride: int | None) -> list[int]:
    """Of every stretch of places below the limit the lowest, and those by the stride from it."""
    below = values < limit
    starts = np.flatnonzero(below & ~np.concatenate([[False], below[:-1]]))
    ends = np.flatnonzero(below & ~np.concatenate([below[1:], [False]]))
    places: list[int] = []
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        lowest = start + int(np.argmin(values[start : end + 1]))
        if stride is None:
            places.append(lowest)
        else:
            places += range(lowest - (lowest - start) // stride * stride, end + 1, stride)
    return places
