"""Verdicts on candidates, and what can make one infeasible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from hybrid_opt.carry import DRIVE_CONSTRAINTS, Judgement
from symbolic.array import Array
from symbolic.functions import CONSTRAINTS

COLLISION = "collision"
BETWEEN_SAMPLES = "between_samples"
NOT_FINITE = "not_finite"

REASONS = (*CONSTRAINTS, COLLISION, BETWEEN_SAMPLES, NOT_FINITE, *DRIVE_CONSTRAINTS)
"""What can make a candidate infeasible; `Evaluations.reason` indexes it.

between_samples: not proven free of collisions between the samples; only fronts are certified.
not_finite: an objective is NaN or infinite (a solver or model failure, never a front member).
The rest only under the time law 'optimal', see `hybrid_opt.carry.DRIVE_CONSTRAINTS`.
"""

FEASIBLE = -1
"""`Evaluations.reason` of a feasible candidate."""


@dataclass(frozen=True, repr=False)
class Evaluations:
    """Verdicts on n candidates; every array has a leading axis over them.

    Attributes:
        x: (n, n_var) decision vectors.
        objectives: (n, m) values without penalty; only meaningful where feasible.
        penalised: (n, m) objectives with the paper's penalty, always finite; what a search sees.
        feasible: (n,).
        reason: (n,) index into `REASONS` of the constraint violated first along the path, or
            `FEASIBLE`.
        position: (n,) path parameter in [0, 1] of the first violation; NaN where feasible.
        violation: (n, len(REASONS)) violation of each constraint, 0 where satisfied; the unit
            is the constraint's (`symbolic.functions.CONSTRAINTS`), time share for
            collision, 1 for those that follow it.
        violation_time: (n, len(REASONS)) time in violation over the duration.
    """

    x: Array
    objectives: Array
    penalised: Array
    feasible: NDArray[np.bool_]
    reason: NDArray[np.int8]
    position: Array
    violation: Array
    violation_time: Array

    def __len__(self) -> int:
        return len(self.x)

    def judgement(self, row: int, objective_names: Sequence[str]) -> Judgement:
        """The verdict on one candidate in words."""
        feasible = bool(self.feasible[row])
        return Judgement(
            feasible=feasible,
            reason="" if feasible else REASONS[int(self.reason[row])],
            position=None if feasible else float(self.position[row]),
            objectives=dict(zip(objective_names, self.objectives[row].tolist(), strict=True)),
        )

    @property
    def infeasible_by_reason(self) -> dict[str, int]:
        """Infeasible candidates by the constraint violated first, the most frequent first."""
        counts = {name: int(np.sum(self.reason == i)) for i, name in enumerate(REASONS)}
        found = sorted(counts.items(), key=lambda item: -item[1])
        return {name: count for name, count in found if count}

    def __repr__(self) -> str:
        share = 100.0 * float(self.feasible.mean()) if len(self) else 0.0
        counts = [f"{c} {n.replace('_', ' ')}" for n, c in self.infeasible_by_reason.items()]
        return f"{len(self)} candidates, {share:.1f} % feasible" + "".join(
            f"; {count}" for count in counts
        )

    def __getitem__(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> Evaluations:
        return Evaluations(**{f.name: getattr(self, f.name)[rows] for f in fields(self)})


def concatenated(parts: list[Evaluations]) -> Evaluations:
    """Several evaluations, at least one, in order as one."""
    return Evaluations(
        **{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Evaluations)}
    )
