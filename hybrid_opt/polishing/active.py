"""Which constraints at places of the path enter a solve, and which a solution violates.

Places are the task's samples and some between them (`hybrid_opt.polishing.carry`). The payload
passes obstacles by single directions (`hybrid_opt.polishing.passages`); the arms' bounds enter
where they are small, at the lowest points along the path; joint limits and singularities at the
tightest place. The smooth bound may be lower than the true distance by a centimetre, so a row asks
for the wanted distance less what FCL, or the sharp bound, measures beyond the smooth one at the
current point; where the solution moves on and that was too much, the next round asks again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.carry import PER_SAMPLE, Carry
from hybrid_opt.polishing.passages import (
    FARTHEST,
    Row,
    dipped,
    lowest,
    passage_rows,
    separation_row,
)
from hybrid_opt.polishing.records import PolishSettings
from symbolic.array import Array
from symbolic.smooth.problem import PressureRow
from symbolic.smooth.rows import RowFunctions, RowKind

BESIDE = (0, 1, -6, 6)
"""Places around the lowest violated clearance that get a row; a dip counts at two neighbours."""

NEAR = 0.02
"""Bounds lower than this are compared with FCL's distance [m]."""

WINDOW = 16
"""Places on either side of a passing row among which the kink's height is measured."""

DISTANCES = ("clearance", "separation", "passing")
"""Kinds of rows whose values are distances [m]."""

LIMIT_ACTIVITY = 0.05
"""Joints nearer than this to a limit get a row [rad]."""

PRESSURE_SHARE = 0.7
"""Shifts of the centre of pressure beyond this share of the patch's radius get rows."""

BESIDE_PRESSED = (-4, -1, 0, 1, 4)
"""Samples around the farthest shift that get a row."""

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
        self._separable = set(rows.separable())
        self._wanted = evaluator.workcell.collision.tolerance + settings.clearance

    def near(self, carry: Carry) -> list[Row]:
        """Rows of everything near activity."""
        rows: list[Row] = []
        least = carry.clearance.min(axis=0)
        for pair in np.flatnonzero(least < max(self._settings.activity, FARTHEST)).tolist():
            if pair in self._separable:
                rows += passage_rows(pair, self._gaps(carry, pair))
            elif least[pair] < self._settings.activity:
                places = lowest(carry.clearance[:, pair], self._settings.activity, None)
                rows += [(RowKind("clearance", pair), place) for place in places]
        return self._movable(rows + self._joint_rows(carry, LIMIT_ACTIVITY, SINGULARITY_SHARE))

    def pressed(self, carry: Carry, share: float = PRESSURE_SHARE) -> set[PressureRow]:
        """Robots and samples where the centre of pressure is near the rim of the patch: the
        farthest of every stretch beyond a share of the radius, and those beside it."""
        last = len(carry.shift) - 1
        return {
            (robot, min(max(0, sample + beside), last))
            for robot in (0, 1)
            for sample in lowest(-carry.shift[:, robot], -share, None)
            for beside in BESIDE_PRESSED
        }

    def violated(self, carry: Carry, known: Carry) -> list[Row]:
        """Rows of everything that a candidate violates; directions are those of a known one."""
        rows = self._joint_rows(carry, 0.0, None)
        # An arm loses the path at the edge of its reach, where it is stretched: singular.
        rows += [
            (RowKind("singularity", -1, arm), carry.reached + later)
            for arm in carry.stranded
            for later in LOST_PLACES
        ]
        # Half of the wanted distance is left to what the solver and FCL round off.
        limit = self._wanted / 2.0
        close = dipped(carry.clearance) < limit
        if close.any():
            truth = self._measured(carry, close)
            for pair in np.flatnonzero(close.any(axis=0)).tolist():
                places = lowest(truth[:, pair], limit, None)
                if pair in self._separable:
                    rows += self._passages(known, pair, places)
                    continue
                beside = {k + shift for k in places for shift in BESIDE}
                rows += [(RowKind("clearance", pair), k) for k in beside if k < carry.reached]
        return self._movable(rows)

    def _passages(self, known: Carry, pair: int, places: list[int]) -> list[Row]:
        """The rows near some places by which a known candidate keeps the payload from a pair."""
        gaps = self._gaps(known, pair)
        kinks = [row for row in passage_rows(pair, gaps) if row[0].kind == "passing"]
        rows: list[Row] = []
        for place in places:
            near = [row for row in kinks if abs(row[1] - place) <= WINDOW]
            beside = (k for k in (place - WINDOW // 2, place, place + WINDOW // 2))
            rows += near or [
                separation_row(pair, gaps, k) for k in beside if 0 <= k < known.reached
            ]
        return rows

    def _gaps(self, carry: Carry, pair: int) -> Array:
        """(reached, n) gaps of a separable pair along every direction [m]."""
        return np.asarray(self._rows.separations(pair)(carry.pose[: carry.reached].T).full()).T

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
        chosen = [row for row in rows if row[0].kind in DISTANCES and row[1] < carry.reached]
        around = [_around(row) for row in chosen]
        low = np.zeros(carry.clearance.shape, dtype=bool)
        for (kind, _), window in zip(chosen, around, strict=True):
            low[window, kind.index] = carry.clearance[window, kind.index] < NEAR
        measured = self._measured(carry, low)
        truth = np.array(
            [
                measured[window, kind.index].min()
                for (kind, _), window in zip(chosen, around, strict=True)
            ]
        )
        smooth = self._smooth(carry, chosen)
        wanted = np.full(len(chosen), self._wanted)
        if lenient:
            wanted = np.where(truth > 0.0, np.minimum(wanted, truth), wanted)
        return required | dict(zip(chosen, (wanted - (truth - smooth)).tolist(), strict=True))

    def halfway(self, carry: Carry, row: Row, required: float) -> float:
        """Half way from a row's required value to what the candidate has there."""
        return (required + float(self._smooth(carry, [row])[0])) / 2.0

    def _smooth(self, carry: Carry, rows: Sequence[Row]) -> Array:
        """The rows' values as the smooth problem sees them."""
        values = np.empty(len(rows))
        groups: dict[RowKind, list[int]] = {}
        for k, (kind, _) in enumerate(rows):
            groups.setdefault(kind, []).append(k)
        for kind, members in groups.items():
            at = [rows[k][1] for k in members]
            inputs = [array[at].T for array in (carry.pose, carry.rate, *carry.q)]
            values[members] = self._rows.value(kind)(*inputs).full().ravel()
        return values

    def _measured(self, carry: Carry, wanted: NDArray[np.bool_]) -> Array:
        """The bounds, those of wanted pairs raised to FCL's distance where nothing touches, and
        lowered to what is to be expected beside each place."""
        bounds = carry.clearance.copy()
        k = carry.reached
        q_1, q_2 = carry.q
        self._evaluator.checker.measure(carry.pose[:k], q_1[:k], q_2[:k], bounds, wanted)
        return bounds - (carry.clearance - dipped(carry.clearance))

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
                    places = lowest(margins, limit, None)
                    rows += [(RowKind(side, joint, arm), place) for place in places]
            measure = carry.manipulability[:, arm]
            least = 1.0 if share is None else max(1.0, share * float(np.median(measure)))
            places = lowest(measure, least, None if share is None else SINGULARITY_STRIDE)
            rows += [(RowKind("singularity", -1, arm), place) for place in places]
        return rows


def _around(row: Row) -> slice:
    """The places where what a row keeps is measured."""
    kind, place = row
    width = WINDOW if kind.kind == "passing" else 0
    return slice(max(0, place - width), place + width + 1)
