"""Cost of a cell's limits on jerk for the selected carries of a drivable experiment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybrid_opt.campaign.layout import POLISHED_SUFFIX
from hybrid_opt.timing.document import StoredJerk, read_timing
from hybrid_opt.timing.records import TimingStatus
from studies.terminal_summary import title
from studies.text_table import number, text_table
from studies.timing_stage import TIMING

NOTE = (
    "Joints and payload within their largest jerk, at rest without acceleration at both ends. "
    "Medians over the carries."
)


@dataclass(frozen=True)
class JerkCosts:
    """Cost of limits on jerk for several carries.

    Attributes:
        label: whose they are.
        carries: how many.
        without, within: median durations without and within the limits [s].
        cost, most: median and largest share of the duration that the limits add.
    """

    label: str
    carries: int
    without: float
    within: float
    cost: float
    most: float

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of a row of the table with `HEAD`."""
        return (
            self.label,
            str(self.carries),
            number(self.without, 3),
            number(self.within, 3),
            number(self.cost, 1, 100.0),
            number(self.most, 1, 100.0),
        )


HEAD = ("limits on jerk", "carries", "without [s]", "within [s]", "cost %", "at most %")


def jerk_costs(root: Path) -> tuple[JerkCosts, ...]:
    """The costs by algorithm, the hand-made carry's first; none where no jerk is limited.

    Args:
        root: results folder of the drivable experiment.

    Raises:
        ResultsError: a timing is damaged.
    """
    found: dict[str, list[StoredJerk]] = {}
    for path in sorted((root / TIMING).rglob("*.json")):
        jerk = read_timing(path).jerk
        if jerk is not None and jerk.status == TimingStatus.OK:
            found.setdefault(_label(path.relative_to(root / TIMING)), []).append(jerk)
    return tuple(_costs(label, timings) for label, timings in found.items())


def jerk_text(costs: Sequence[JerkCosts]) -> str:
    """The costs for a terminal, '' without any."""
    if not costs:
        return ""
    return f"{text_table([HEAD, *(each.cells for each in costs)])}\n{NOTE}"


def _label(path: Path) -> str:
    if len(path.parts) == 1:
        return path.stem
    folder = path.parts[0]
    name = title(folder.removesuffix(POLISHED_SUFFIX))
    return f"{name}, polished" if folder.endswith(POLISHED_SUFFIX) else name


def _costs(label: str, found: Sequence[StoredJerk]) -> JerkCosts:
    within, without = (
        np.array([getattr(jerk, name) for jerk in found]) for name in ("duration", "without")
    )
    cost = within / without - 1.0
    return JerkCosts(
        label,
        len(found),
        float(np.median(without)),
        float(np.median(within)),
        float(np.median(cost)),
        float(cost.max()),
    )
