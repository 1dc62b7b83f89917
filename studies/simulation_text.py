"""Predicted beside simulated: what the simulated cell says of a study's carries, as a table."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hybrid_opt.campaign.simulated import StoredSimulation
from studies.text_table import number, text_table

HEADINGS = (
    "carry",
    "duration [s]",
    "holds from",
    "slips first",
    "pressed with",
    "peak predicted [N]",
    "peak simulated [N]",
    "largest error [%]",
    "slip [mm]",
    "arrives",
)

MEANING = (
    "Holds from: multiple of the planned forces, between a run that slips and one that holds. The "
    "other columns: a run pressed as said, forces of both robots, their error over the reference."
)


def simulation_rows(found: Sequence[StoredSimulation]) -> list[tuple[str, ...]]:
    """One row per carry, cells in the order of `HEADINGS`."""
    return [
        (
            one.label,
            number(one.duration, 2),
            f"{one.slips:.3f} to {one.holds:.3f}" if math.isfinite(one.holds) else one.problem,
            f"pad {one.pad} at {one.begins:.2f} s" if one.pad else "-",
            "robust forces" if one.robust else f"{number(one.factor, 1)} times the plan",
            *(" / ".join(number(force, 2) for force in forces) for forces in one.peaks),
            number(100.0 * one.largest_error, 1),
            number(1e3 * one.slip, 3),
            "yes" if one.arrives else "NO",
        )
        for one in found
    ]


def simulation_text(found: Sequence[StoredSimulation]) -> str:
    """The table for a terminal."""
    rows = [HEADINGS, *simulation_rows(found)]
    return f"In the simulated cell\n{text_table(rows, left=(0, 2, 3, 4))}\n{MEANING}"
