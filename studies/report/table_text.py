"""A table of texts, and how it reads as CSV, Markdown, LaTeX and HTML."""

from __future__ import annotations

import csv
import html
import io
import math
import re
from dataclasses import dataclass
from functools import partial

LONG = 30
"""Characters of a cell from which on it takes several lines."""

NOTHING = "–"
"""Text of a missing figure."""


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
    note: str

    @property
    def words(self) -> tuple[bool, ...]:
        """Of every column, whether it holds words, which begin at the left; others hold figures."""
        columns = zip(*self.rows, strict=True) if self.rows else [()] * len(self.header)
        return tuple(k == 0 or not any(map(_is_figure, column)) for k, column in enumerate(columns))

    def csv(self) -> str:
        """Comma-separated values, without title and note."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.header)
        writer.writerows(self.rows)
        return text.getvalue()

    def markdown(self) -> str:
        """A Markdown table with title and note."""
        rule = tuple("---" if word else "---:" for word in self.words)
        lines = [self.header, rule, *self.rows]
        body = "\n".join("| " + " | ".join(_markdown(cell) for cell in row) + " |" for row in lines)
        return f"**{_markdown(self.title)}**\n\n{body}\n\n{_markdown(self.note)}\n"

    def latex(self) -> str:
        """A LaTeX table with booktabs rules."""
        columns = "".join("l" if word else "r" for word in self.words)
        rows = [" & ".join(_latex(cell) for cell in row) + r" \\" for row in self.rows]
        head = " & ".join(_latex(cell) for cell in self.header) + r" \\"
        return "\n".join(
            [
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
        )

    def html(self) -> str:
        """An HTML table; every text is escaped."""
        head = "".join(map(partial(_html_cell, "th"), self.header, self.words))
        body = "".join(
            f"<tr>{''.join(map(partial(_html_cell, 'td'), row, self.words))}</tr>"
            for row in self.rows
        )
        return (
            f"<h3>{html.escape(self.title)}</h3><div class='scroll'><table><thead><tr>{head}</tr>"
            f"</thead><tbody>{body}</tbody></table></div><p class='note'>{html.escape(self.note)}"
            "</p>"
        )


def number(value: float | None, digits: int = 2) -> str:
    """A figure in print."""
    if value is None or not math.isfinite(value):
        return NOTHING
    return f"{value:z.{digits}f}"


def _is_figure(cell: str) -> bool:
    """Whether a cell is a figure, with what belongs to it."""
    return len(cell) <= LONG and re.match(r"[-+\N{MINUS SIGN}]?\.?\d", cell) is not None


def _html_cell(kind: str, cell: str, word: bool) -> str:
    classes = " ".join(["word"] * word + ["long"] * (len(cell) > LONG))
    named = f" class='{classes}'" if classes else ""
    return f"<{kind}{named}>{html.escape(cell)}</{kind}>"


def _markdown(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;").replace("\n", " ")


_LATEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "–": "--",
}


def _latex(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in text)
