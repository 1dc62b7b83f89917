"""Whether the pads get to the box of a proposed carry, and away from it again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from codegen.function import NumericFunction
from codegen.interpreted import InterpretedFunction
from codegen.source import dense
from hybrid_opt.compiled_cell import CompiledCell
from hybrid_opt.job.collisions import JobCollisions
from hybrid_opt.job.ends import what_blocks
from hybrid_opt.proposing.trial import Trial
from symbolic.cell_model import CellModel

if TYPE_CHECKING:
    import casadi as ca


class _InterpretedCell(CompiledCell):
    """A cell of which nothing is compiled."""

    def functions(
        self,
        name: str,
        make: Callable[[CellModel], Mapping[str, ca.Function]],
        *details: str,
        lanes: int = 1,
        levels: Mapping[str, int] | None = None,
    ) -> dict[str, NumericFunction]:
        return {
            name: InterpretedFunction(dense(function))
            for name, function in make(self.model).items()
        }


def grasp_blocked(trial: Trial) -> str:
    """What is in the way of the pads' approach before a trial's carry or of their retreat after
    it, lift and set-down included; '' where nothing is, or where there are no jobs of such pads."""
    cell = trial.workcell
    if not cell.has_facing_pads:
        return ""
    found = trial.evaluator.outputs(trial.initial[None])
    q = np.hstack([found["q_1"][0], found["q_2"][0]])[[0, -1]]
    collisions = JobCollisions(_InterpretedCell(cell, model=trial.model))
    posture = trial.evaluator.functions["posture"]
    return what_blocks(cell, collisions, posture, found["pose"][0][[0, -1]], q)
