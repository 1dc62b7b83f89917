"""Figures as a terminal's lines and columns, and as an HTML table."""

from __future__ import annotations

import html
from collections.abc import Collection, Mapping, Sequence


def lines(figures: Mapping[str, str]) -> list[str]:
    """One line per figure, values aligned."""
    width = max((len(name) for name in figures), default=0)
    return [f"  {name:<{width}}  {value}" for name, value in figures.items()]


def table(figures: Mapping[str, str]) -> str:
    """An HTML table of two columns."""
    rows = "".join(
        f'<tr><th style="text-align:left">{html.escape(name)}</th>'
        f'<td style="text-align:left">{html.escape(value)}</td></tr>'
        for name, value in figures.items()
    )
    return f"<table>{rows}</table>"


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
