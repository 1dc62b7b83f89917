"""Re-evaluation of a stored trajectory from its file alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybrid_opt.cell import Cell
from hybrid_opt.store.trajectory_figures import same_figure, trajectory_figures
from hybrid_opt.store.trajectory_file import StoredTrajectory

START_TOLERANCE = 1e-6
"""Largest difference of the start postures [rad]."""


@dataclass(frozen=True)
class FigureComparison:
    """A stored figure beside the recomputed one, which is None where nothing computes it."""

    name: str
    stored: float
    recomputed: float | None

    @property
    def same(self) -> bool:
        """Whether both agree to the tolerances of a re-evaluation."""
        return self.recomputed is not None and same_figure(self.stored, self.recomputed)


@dataclass(frozen=True)
class Replay:
    """A re-evaluated trajectory.

    Attributes:
        cell: as unpacked from the file.
        figures: every stored figure, compared.
        start_difference: largest difference of the start postures [rad].
    """

    cell: Cell
    figures: tuple[FigureComparison, ...]
    start_difference: float

    @property
    def reproduced(self) -> bool:
        """Whether every stored figure and the start postures came out again."""
        return self.start_difference <= START_TOLERANCE and all(
            figure.same for figure in self.figures
        )


def replay(stored: StoredTrajectory, folder: Path) -> Replay:
    """Unpack a stored trajectory's workcell into a folder and evaluate the trajectory again.

    Raises:
        DualArmError: the stored workcell is not valid, or its model cannot be built.
    """
    cell = stored.open_cell(folder)
    carry = cell.carry(stored.x)
    recomputed = trajectory_figures(carry)
    differences = [
        float(np.abs(arm.q[0] - start).max())
        for arm, start in zip(carry.arms, stored.start, strict=True)
    ]
    return Replay(
        cell,
        tuple(
            FigureComparison(name, value, recomputed.get(name))
            for name, value in stored.figures.items()
        ),
        max(differences),
    )
