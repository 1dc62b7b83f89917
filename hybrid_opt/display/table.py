"""Tables of texts in several formats, and the number format of quantities in all of them."""

from __future__ import annotations

import html
import math
import re
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from hybrid_opt.store.files import csv_text

LONGEST_CELL = 30
"""A cell with more characters takes several lines."""

NOTHING = "–"
"""Text in place of a missing figure."""

TERMINAL_WIDTH = 100
"""Number of characters on a line in a terminal."""


def number(value: float | None, digits: int = 2, scale: float = 1.0) -> str:
    """Format a number with a fixed number of decimals; `NOTHING` if it is None or not finite.

    Args:
        value: the number.
        digits: number of decimals.
        scale: factor by which the number is multiplied first.
    """
    if value is None or not math.isfinite(value):
        return NOTHING
    return f"{value * scale:z.{digits}f}"


UNPUBLISHED = "unknown"
"""Text in place of a figure that the robot's maker does not publish."""


def torque_use(use: float | None) -> str:
    """Format the ratio `use` of joint torque to torque limit in percent; `NOTHING` for None.

    A ratio of zero means that the robot's limits are unknown, and gives `UNPUBLISHED`.
    """
    return UNPUBLISHED if use == 0.0 else number(use, 1, 100.0)


def counted(count: int, noun: str) -> str:
    """Format a count with a noun, such as '1 point' and '3 points'.

    Args:
        count: the count.
        noun: the noun in the singular; its plural adds an s.
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


@dataclass(frozen=True)
class Quantity:
    """Name, unit and number format of a quantity in tables, figures and pages.

    Attributes:
        name: name of the quantity.
        unit: unit in which it is printed, '' for a pure number.
        digits: number of decimals.
        scale: factor from the value in SI units to the printed value.
    """

    name: str
    unit: str = ""
    digits: int = 2
    scale: float = 1.0

    def heading(self, whose: str = "") -> str:
        """Format the heading of a column: the quantity's name and unit.

        Args:
            whose: owner of the quantity, such as a robot, which follows the name; '' for none.
        """
        named = f"{self.name}, {whose}" if whose else self.name
        return f"{named} [{self.unit}]" if self.unit else named

    def __call__(self, value: float | None) -> str:
        """Format a value in SI units as a printed number without its unit; `NOTHING` for None."""
        return number(value, self.digits, self.scale)

    def mean(self, mean: float | None, std: float | None) -> str:
        """Format a mean and a standard deviation as 'mean ± deviation'.

        Args:
            mean: the mean in SI units.
            std: the standard deviation in SI units.
        """
        return f"{self(mean)} ± {self(std)}"

    def spread(self, middle: float, low: float, high: float) -> str:
        """Format a value and its range as 'middle [low, high]'; without the range if it is a single
        value.

        Args:
            middle: the value in SI units.
            low, high: ends of the range in SI units.
        """
        if low == high or not math.isfinite(middle):
            return self(middle)
        return f"{self(middle)} [{self(low)}, {self(high)}]"


@dataclass(frozen=True)
class Table:
    """Table whose cells are texts.

    Attributes:
        name: name of the files to which the table is written, without suffix.
        title: title above the table.
        header: heading of each column.
        rows: cells of each row; the first cell names the row.
        note: note below the table.
    """

    name: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    @property
    def words(self) -> tuple[bool, ...]:
        """For each column, True if it contains words and is flush left, False if it contains
        numbers and is flush right.
        """
        columns = zip(*self.rows, strict=True) if self.rows else [()] * len(self.header)
        return tuple(k == 0 or not any(map(_is_figure, column)) for k, column in enumerate(columns))

    def text(self) -> str:
        """Format the table as text for a terminal."""
        left = [k for k, word in enumerate(self.words) if word]
        parts = [self.title, text_table([self.header, *self.rows], left)]
        return "\n".join(parts + ([textwrap.fill(self.note, TERMINAL_WIDTH)] if self.note else []))

    def csv(self) -> str:
        """Format the table as comma-separated values, without title and note."""
        return csv_text(self.header, self.rows)

    def markdown(self) -> str:
        """Format the table in Markdown, with title and note."""
        rule = tuple("---" if word else "---:" for word in self.words)
        lines = [self.header, rule, *self.rows]
        body = "\n".join("| " + " | ".join(map(_markdown, row)) + " |" for row in lines)
        return f"**{_markdown(self.title)}**\n\n{body}\n\n{_markdown(self.note)}\n"

    def latex(self) -> str:
        """Format the table in LaTeX with booktabs rules."""
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
        """Format the table in HTML; every text is escaped."""
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
    """Format rows of cells as text in aligned columns, with a rule below the first row, the
    heading.

    Args:
        rows: rows of cells, all of equal length, the heading first.
        left: indices of columns that are flush left; the others are flush right.
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
    """Format named texts as one line each, 'name  text', with all texts in one column.

    Args:
        figures: texts by name.
    """
    width = max((len(name) for name in figures), default=0)
    return [f"  {name:<{width}}  {value}" for name, value in figures.items()]


def figures_html(figures: Mapping[str, str]) -> str:
    """Format named texts as an HTML table of two columns, name and text."""
    rows = "".join(
        f'<tr><th style="text-align:left">{html.escape(name)}</th>'
        f'<td style="text-align:left">{html.escape(value)}</td></tr>'
        for name, value in figures.items()
    )
    return f"<table>{rows}</table>"


def _is_figure(cell: str) -> bool:
    """Return True if a cell is short and begins with a number; a unit or a range may follow."""
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
