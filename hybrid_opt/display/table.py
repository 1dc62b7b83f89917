"""Figures by name as a terminal's lines and as an HTML table."""

from __future__ import annotations

import html
from collections.abc import Mapping


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
