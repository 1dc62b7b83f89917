"""Tables and figures as text for a terminal."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence


def number(value: float | None, digits: int, scale: float = 1.0) -> str:
    """A figure in print; '-' where there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value * scale:.{digits}f}"


def text_table(rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> str:
    """Rows in columns with a line below the first one, the head.

    Args:
        rows: cells; the rows are equally long.
        left: columns that are flush left; the others are flush right.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(
            cell.ljust(width) if k in left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
    return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])
