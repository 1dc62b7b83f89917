"""Which constraints at places of the path enter a solve, and which a solution violates.

A place is a sample of the task. Obstacles enter where their clearance bound is small, at the
lowest points along the path and a few samples beside them; joint limits and singularities at the
tightest sample. The compiled bound may be lower than the true distance by a few millimetres, so
a row asks for the wanted distance less what FCL measures beyond the bound at the current point;
where the solution moves on and that was too much, the next round asks again from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.evaluation import CandidateEvaluator
from hybrid_opt.polish.records import PolishSettings
from symbolic.evaluator import CONSTRAINTS
from symbolic.smooth_rows import RowFunctions, RowKind
from symbolic.workcell import Array

Row = tuple[RowKind, int]
"""What is kept, and at which sample."""

BESIDE = (0, -3, 3)
"""Samples around the lowest violated clearance that get a row."""

NEAR = 0.02
"""Bounds lower than this are compared with FCL's distance [m]."""

PAYLOAD_ACTIVITY = ((0.03, 2), (0.08, 4))
"""The payload's clearances need no joints: they are cheap, decide where the path may go, and get
rows below each distance [m] at every so many samples."""

LIMIT_ACTIVITY = 0.05
"""Joints nearer than this to a limit get a row [rad]."""

SINGULARITY_SHARE = 0.5
SINGULARITY_STRIDE = 8
"""Where |det J| is below this share of its median along the path, every so many samples get a row:
it bounds the reach, beyond which nothing else is defined."""

LOST_SAMPLES = (0, 4, 8)
"""Samples after the loss of an arm that get a row."""


@dataclass(frozen=True)
class Carry:
    """A candidate as the constraints see it, n samples.

    Attributes:
        pose: (n, 6); q: two (n, 6).
        reached: samples before the first that an arm does not reach.
        stranded: the arms that do not reach all samples.
        clearance: (reached, n_pairs) lower bounds of every active pair's distance [m].
        singularity: (reached, 2) |det J| over its least value, minus 1.
        split: (n, 2) normal component and tangential magnitude of the required force [N].
        peak: (2,) peak normal forces over their references.
    """

    pose: Array
    q: tuple[Array, Array]
    reached: int
    stranded: tuple[int, ...]
    clearance: Array
    singularity: Array
    split: Array
    peak: Array

    @property
    def is_followed(self) -> bool:
        """Whether both arms reach all samples."""
        return self.reached == len(self.pose)


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

    def carry(self, x: Array) -> Carry:
        """Evaluate a decision vector (n_var,)."""
        evaluator = self._evaluator
        found = {name: value[0] for name, value in evaluator.outputs(x[None]).items()}
        lost = np.column_stack([found["lost_1"], found["lost_2"]]).reshape(-1, 2) > 0.0
        reached = int(np.argmax(lost.any(axis=1))) if lost.any() else len(lost)
        configuration = (found["pose"], found["q_1"], found["q_2"])
        columns = [CONSTRAINTS.index(f"singularity_{arm}") for arm in (1, 2)]
        force = found["normal_force"]
        return Carry(
            pose=found["pose"],
            q=(found["q_1"], found["q_2"]),
            reached=reached,
            stranded=tuple(np.flatnonzero(lost.any(axis=0)).tolist()),
            clearance=evaluator.checker.bounds(*(array[:reached] for array in configuration)),
            singularity=-found["constraint"][:reached, columns],
            split=np.column_stack(
                [force[:, 0] - force[:, 1], found["tangential_force"].sum(axis=1)]
            ),
            peak=force.max(axis=0) / evaluator.workcell.task.reference_force,
        )

    def near(self, carry: Carry) -> list[Row]:
        """Rows of everything near activity."""
        rows = []
        widest = max(self._settings.activity, *(distance for distance, _ in PAYLOAD_ACTIVITY))
        for pair in np.flatnonzero((carry.clearance < widest).any(axis=0)).tolist():
            column = carry.clearance[:, pair]
            samples = set(_lowest(column, self._settings.activity, None))
            if pair in self._payload_pairs:
                for distance, stride in PAYLOAD_ACTIVITY:
                    samples.update(_lowest(column, distance, stride))
            rows += [(RowKind("clearance", pair), sample) for sample in samples]
        return self._movable(rows + self._joint_rows(carry, LIMIT_ACTIVITY, SINGULARITY_SHARE))

    def violated(self, carry: Carry) -> list[Row]:
        """Rows of everything that the candidate violates."""
        rows = self._joint_rows(carry, 0.0, None)
        # An arm loses the path at the edge of its reach, where it is stretched: singular.
        rows += [
            (RowKind("singularity", -1, arm), carry.reached + later)
            for arm in carry.stranded
            for later in LOST_SAMPLES
        ]
        # Half of the wanted distance is left to what the solver and FCL round off.
        limit = self._wanted / 2.0
        close = carry.clearance < limit
        if close.any():
            truth = self._measured(carry, close)
            for pair in np.flatnonzero(close.any(axis=0)).tolist():
                lowest = _lowest(truth[:, pair], limit, None)
                samples = {k + shift for k in lowest for shift in BESIDE}
                rows += [(RowKind("clearance", pair), k) for k in samples if k < carry.reached]
        return self._movable(rows)

    def _movable(self, rows: list[Row]) -> list[Row]:
        """Without the first and last pose, which are fixed."""
        last = self._evaluator.workcell.task.samples - 1
        return [row for row in rows if 0 < row[1] < last]

    def required(self, carry: Carry, rows: Sequence[Row], lenient: bool) -> dict[Row, float]:
        """The value that each row at a reached sample has to keep, see the module.

        Args:
            lenient: ask for no more than the candidate keeps already, where it is free.
        """
        required = dict.fromkeys(rows, self._settings.margin)
        chosen = [row for row in rows if row[0].kind == "clearance" and row[1] < carry.reached]
        samples = np.array([sample for _, sample in chosen], dtype=int)
        pairs = np.array([kind.index for kind, _ in chosen], dtype=int)
        low = np.zeros(carry.clearance.shape, dtype=bool)
        low[samples, pairs] = carry.clearance[samples, pairs] < NEAR
        truth = self._measured(carry, low)[samples, pairs]
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
        kind, sample = row
        value = self._rows.value(kind)
        return float(value(carry.pose[sample], carry.q[0][sample], carry.q[1][sample]))

    def _measured(self, carry: Carry, wanted: NDArray[np.bool_]) -> Array:
        """The bounds, those of wanted pairs raised to FCL's distance where nothing touches."""
        bounds = carry.clearance.copy()
        k = carry.reached
        q_1, q_2 = carry.q
        self._evaluator.checker.measure(carry.pose[:k], q_1[:k], q_2[:k], bounds, wanted)
        return bounds

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
                    samples = _lowest(margins, limit, None)
                    rows += [(RowKind(side, joint, arm), sample) for sample in samples]
            measure = carry.singularity[:, arm] + 1.0
            least = 1.0 if share is None else max(1.0, share * float(np.median(measure)))
            samples = _lowest(measure, least, None if share is None else SINGULARITY_STRIDE)
            rows += [(RowKind("singularity", -1, arm), sample) for sample in samples]
        return rows


def _lowest(values: Array, limit: float, stride: int | None) -> list[int]:
    """Of every stretch of samples below the limit the lowest, and those by the stride from it."""
    below = values < limit
    starts = np.flatnonzero(below & ~np.concatenate([[False], below[:-1]]))
    ends = np.flatnonzero(below & ~np.concatenate([below[1:], [False]]))
    samples: list[int] = []
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        lowest = start + int(np.argmin(values[start : end + 1]))
        if stride is None:
            samples.append(lowest)
        else:
            samples += range(lowest - (lowest - start) // stride * stride, end + 1, stride)
    return samples
