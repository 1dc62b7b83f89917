"""Tables and figures as text for a terminal."""

from __future__ import annotations

import math

from hybrid_opt.display.table import text_table as text_table


def counted(count: int, noun: str) -> str:
    """A number of things, whose plural ends in s."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def number(value: float | None, digits: int, scale: float = 1.0) -> str:
    """A figure in print; '-' where there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value * scale:z.{digits}f}"
