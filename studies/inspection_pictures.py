"""Pictures of `studies.inspect`: the cell, the arms' reach, collisions, the carry to play."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hybrid_opt.carry import Carry
from hybrid_opt.cell import Cell
from hybrid_opt.display.view import CarryView, Look
from hybrid_opt.evaluate.explanation import Explanation
from studies.report.data import shown
from studies.report.pictures_cell import environment, reachable_regions
from studies.report.pictures_meeting import meeting
from studies.report.reach import reach_map
from studies.report.style import in_style, save, settled
from symbolic.errors import SettingsError


def draw(
    cell: Cell,
    carries: Mapping[str, Carry],
    explained: Mapping[str, Explanation],
    output: Path,
) -> tuple[str, ...]:
    """The paper's Figures 4 and 5 as files, and each carry's first collision; their names.

    Args:
        cell: the cell.
        carries: by their names, 'initial' among them.
        explained: what is in the way of those that fail.
        output: folder.

    Raises:
        SettingsError: the folder cannot be made.
    """
    _made(output)
    geometry, initial = cell.geometry, shown("", carries["initial"])
    reach = reach_map(geometry, np.random.default_rng(0))
    with in_style():
        figures = {
            "reachable_regions": settled(reachable_regions(geometry, reach, initial)),
            "cell": settled(environment(geometry, initial)),
        }
        for name, why in explained.items():
            if why.pair is not None:
                at = carries[name].pose[why.sample], carries[name].q[why.sample]
                figures[f"collision_{name}"] = settled(meeting(geometry, why.pair, *at, str(why)))
    return tuple(
        str(path) for name, figure in figures.items() for path in save(figure, output, name)
    )


def show(carry: Carry, why: Explanation | None, path: Path) -> str:
    """Write the page that plays a carry; it begins where the carry fails, the bodies that meet
    there in red. Its name.

    Raises:
        SettingsError: its folder cannot be made.
        DisplayError: it cannot be written.
    """
    _made(path.parent)
    look = None if why is None else Look(why.sample, str(why), why.pair or ())
    CarryView(carry, look=look).save(path)
    return str(path)


def _made(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"--output {folder}: cannot be made ({error.strerror})") from error
