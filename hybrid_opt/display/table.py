"""Tables of texts in every form, and the format of quantities in all of them."""

from __future__ import annotations

import html
import math
import re
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from hybrid_opt.store.files import csv_text

LONGEST_CELL = 30
"""Characters of a cell from which on it takes several lines."""

NOTHING = "–"
"""Text of a missing figure."""

TERMINAL_WIDTH = 100
"""Characters of a line of text in a terminal."""


def number(value: float | None, digits: int = 2, scale: float = 1.0) -> str:
    """Format a figure; `NOTHING` for None."""
    if value is None or not math.isfinite(value):
        return NOTHING
    return f"{value * scale:z.{digits}f}"


UNPUBLISHED = "unknown"
"""Cell of an unpublished figure."""


def torque_use(use: float | None) -> str:
    """Format a use of joint torques [%]; `UNPUBLISHED` for zero, the use of unknown limits."""
    return UNPUBLISHED if use == 0.0 else number(use, 1, 100.0)


def counted(count: int, noun: str) -> str:
    """Format a number of things; the plural of the noun ends in s."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


@dataclass(frozen=True)
class Quantity:
    """Format of a quantity in tables, figures and pages.

    Attributes:
        name, unit: of its column; a pure number has the unit ''.
        digits: behind the point.
        scale: from its value in SI units to that in print.
    """

    name: str
    unit: str = ""
    digits: int = 2
    scale: float = 1.0

    def heading(self, whose: str = "") -> str:
        """Format the heading of a column: the name, its owner, and the unit."""
        named = f"{self.name}, {whose}" if whose else self.name
        return f"{named} [{self.unit}]" if self.unit else named

    def __call__(self, value: float | None) -> str:
        """Format a value."""
        return number(value, self.digits, self.scale)

    def mean(self, mean: float | None, std: float | None) -> str:
        """Format mean and standard deviation."""
        return f"{self(mean)} ± {self(std)}"

    def spread(self, middle: float, low: float, high: float) -> str:
        """Format a value in the middle and the range around it, the value alone if they are
        equal."""
        if low == high or not math.isfinite(middle):
            return self(middle)
        return f"{self(middle)} [{self(low)}, {self(high)}]"


@dataclass(frozen=True)
class Table:
    """A table of texts.

    Attributes:
        name: of its files, without suffix.
        title: above it.
        header, rows: cells; the first column names the row.
        note: below it.
    """

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    @property
    def words(self) -> tuple[bool, ...]:
        """Per column, True if it holds words, which are flush left; others hold figures."""
        columns = zip(*self.rows, strict=True) if self.rows else [()] * len(self.header)
        return tuple(k == 0 or not any(map(_is_figure, column)) for k, column in enumerate(columns))

    def text(self) -> str:
        """Format for a terminal."""
        left = [k for k, word in enumerate(self.words) if word]
        parts = [self.title, text_table([self.header, *self.rows], left)]
        return "\n".join(parts + ([textwrap.fill(self.note, TERMINAL_WIDTH)] if self.note else []))

    def csv(self) -> str:
        """Format as comma-separated values, without title and note."""
        return csv_text(self.header, self.rows)

    def markdown(self) -> str:
        """Format as a Markdown table with title and note."""
        rule = tuple("---" if word else "---:" for word in self.words)
        lines = [self.header, rule, *self.rows]
        body = "\n".join("| " + " | ".join(map(_markdown, row)) + " |" for row in lines)
        return f"**{_markdown(self.title)}**\n\n{body}\n\n{_markdown(self.note)}\n"

    def latex(self) -> str:
        """Format as a LaTeX table with booktabs rules."""
        columns = "".join("l" if word else "r" for word in self.words)
        head, *rows = (" & ".join(map(_latex, row)) + r" \\" for row in (self.header, *self.rows))
        lines = [
            "% needs \\usepackage{booktabs}",
            r"\begin{table}",
            rf"\caption{{{_latex(self.title)} {_latex(self.note)}}}",
            rf"\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            head,
            r"\midrule",
            *rows,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
        return "\n".join(lines)

    def html(self) -> str:
        """Format as an HTML table; every text is escaped."""
        head, *body = (
            "".join(map(_html_cell, [kind] * len(row), row, self.words))
            for kind, row in (("th", self.header), *(("td", row) for row in self.rows))
        )
        return (
            f"<h3>{html.escape(self.title)}</h3><div class='scroll'><table><thead><tr>{head}</tr>"
            f"</thead><tbody>{''.join(f'<tr>{row}</tr>' for row in body)}</tbody></table></div>"
            f"<p class='note'>{html.escape(self.note)}</p>"
        )


def text_table(rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> str:
    """Format rows in columns with a line below the first one, the head.

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


def lines(figures: Mapping[str, str]) -> list[str]:
    """Format one line per figure, values aligned."""
    width = max((len(name) for name in figures), default=0)
    return [f"  {name:<{width}}  {value}" for name, value in figures.items()]


def figures_html(figures: Mapping[str, str]) -> str:
    """Format an HTML table of two columns."""
    rows = "".join(
        f'<tr><th style="text-align:left">{html.escape(name)}</th>'
        f'<td style="text-align:left">{html.escape(value)}</td></tr>'
        for name, value in figures.items()
    )
    return f"<table>{rows}</table>"


def _is_figure(cell: str) -> bool:
    """Return True if a cell is a figure, with its unit or spread."""
    return len(cell) <= LONGEST_CELL and re.match(r"[-+\N{MINUS SIGN}]?\.?\d", cell) is not None


def _html_cell(kind: str, cell: str, word: bool) -> str:
    classes = " ".join(["word"] * word + ["long"] * (len(cell) > LONGEST_CELL))
    named = f" class='{classes}'" if classes else ""
    return f"<{kind}{named}>{html.escape(cell)}</{kind}>"


def _markdown(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;").replace("\n", " ")


_LATEX = {letter: f"\\{letter}" for letter in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "–": "--",
}


def _latex(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in text)
