"""A table of texts, and how it reads as CSV, Markdown, LaTeX and HTML."""

from __future__ import annotations

import csv
import html
import io
import math
from dataclasses import dataclass

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

    def csv(self) -> str:
        """Comma-separated values, without title and note."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.header)
        writer.writerows(self.rows)
        return text.getvalue()

    def markdown(self) -> str:
        """A Markdown table with title and note."""
        lines = [self.header, tuple(["---"] + ["---:"] * (len(self.header) - 1)), *self.rows]
        body = "\n".join("| " + " | ".join(_markdown(cell) for cell in row) + " |" for row in lines)
        return f"**{_markdown(self.title)}**\n\n{body}\n\n{_markdown(self.note)}\n"

    def latex(self) -> str:
        """A LaTeX table with booktabs rules."""
        columns = "l" + "r" * (len(self.header) - 1)
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
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in self.header)
        body = "".join(
            "<tr>" + "".join(_html_cell(cell) for cell in row) + "</tr>" for row in self.rows
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


def _html_cell(cell: str) -> str:
    kind = " class='text'" if len(cell) > 40 else ""
    return f"<td{kind}>{html.escape(cell)}</td>"


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
