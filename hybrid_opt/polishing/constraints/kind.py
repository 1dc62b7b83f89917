"""What every kind of constraint answers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from hybrid_opt.evaluate.evaluation import CandidateEvaluator
from hybrid_opt.polishing.layout import ForceRow, PlaceRow, PressureRow
from hybrid_opt.polishing.placed_carry import PlacedCarry
from hybrid_opt.polishing.settings import PolishSettings
from hybrid_opt.polishing.smooth_cell import SmoothCell
from hybrid_opt.polishing.targets import Target
from symbolic.records import Workcell

AnyRow = TypeVar("AnyRow", ForceRow, PressureRow, PlaceRow)


@dataclass(frozen=True)
class Surroundings:
    """What all kinds read.

    Attributes:
        evaluator: the full model.
        cell: of the smooth problem.
        settings: of the polish.
    """

    evaluator: CandidateEvaluator
    cell: SmoothCell
    settings: PolishSettings

    @property
    def workcell(self) -> Workcell:
        """The evaluator's."""
        return self.evaluator.workcell

    def movable(self, place: int) -> bool:
        """Whether a place is not one of both ends, which are fixed."""
        return 0 < place < len(self.cell.grid.parameter) - 1


class Kind(ABC, Generic[AnyRow]):
    """A kind of constraint.

    Attributes:
        lasting: whether its rows are kept where the solve moves on to another candidate. What is
            asked of others is relative to the candidate that is left behind.
    """

    lasting: bool = False

    def __init__(self, around: Surroundings) -> None:
        self.around, self.near_settings = around, around.settings.near

    @abstractmethod
    def near(self, carry: PlacedCarry, target: Target) -> Iterable[AnyRow]:
        """Rows of what is near at a candidate."""

    @abstractmethod
    def violated(self, carry: PlacedCarry, known: PlacedCarry) -> Iterable[AnyRow]:
        """Rows of what a step violates that was made from a known candidate."""

    def required(
        self, carry: PlacedCarry, rows: Sequence[AnyRow], lenient: bool = False
    ) -> list[float]:
        """The value that each row has to keep, as learned from a candidate.

        Args:
            lenient: ask for no more than the candidate keeps already, where it is free.
        """
        return [self.around.settings.margin] * len(rows)

    def demanded(
        self, carry: PlacedCarry, known: PlacedCarry, rows: Sequence[AnyRow], before: list[float]
    ) -> list[float]:
        """The value that rows which a step violates have to keep from now on.

        Args:
            carry: where the step led.
            known: where it came from.
            before: what the rows had to keep, the margin where they were none.
        """
        return self.required(carry, rows)
