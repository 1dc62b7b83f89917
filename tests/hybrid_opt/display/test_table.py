"""Tables: figures aligned, nothing of theirs read as markup."""

from __future__ import annotations

import csv
import io
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.display.table import (
    NOTHING,
    Quantity,
    Table,
    counted,
    number,
    text_table,
    torque_use,
)

TEXTS = st.text(st.characters(blacklist_categories=("Cs", "Cc")), min_size=1, max_size=20)


def test_columns_are_aligned_and_the_head_is_underlined() -> None:
    rows = [["name", "kg", "why"], ["a", "1.5", "x"], ["longer", "10.25", ""]]
    assert text_table(rows, left=(0, 2)).splitlines() == [
        "name       kg  why",
        "------------------",
        "a         1.5  x",
        "longer  10.25",
    ]


def test_figures_that_do_not_exist_are_a_dash() -> None:
    assert [number(v, 2) for v in (1.005, None, math.nan, math.inf)] == ["1.00", *[NOTHING] * 3]
    assert number(0.5, 1, 100.0) == "50.0"


def test_no_share_is_stated_of_torques_that_nobody_published() -> None:
    assert [torque_use(use) for use in (0.0, 0.1234, None)] == ["unknown", "12.3", NOTHING]


def test_one_thing_is_not_plural() -> None:
    assert [counted(n, "replica") for n in (0, 1, 2)] == ["0 replicas", "1 replica", "2 replicas"]


def test_a_quantity_reads_alike_everywhere() -> None:
    shift = Quantity("shift", "mm", 1, 1e3)
    assert (shift.heading(), shift.heading("left")) == ("shift [mm]", "shift, left [mm]")
    assert (shift(0.0123), shift(None), shift.mean(0.01, 0.002)) == ("12.3", NOTHING, "10.0 ± 2.0")
    assert shift.spread(0.01, 0.005, 0.02) == "10.0 [5.0, 20.0]"
    assert (shift.spread(0.01, 0.01, 0.01), shift.spread(math.nan, 0.0, 1.0)) == ("10.0", NOTHING)


def test_words_begin_at_the_left_and_figures_end_at_the_right() -> None:
    rows = (("a", "1.0 ± 2", "none", NOTHING), ("b", "-0.5", "upper, x", "\N{MINUS SIGN}3 of 4"))
    table = Table("t", "title", ("who", "how much", "which", "of"), rows, "note")
    assert table.words == (True, False, True, False)
    assert "| --- | ---: | --- | ---: |" in table.markdown()
    assert r"\begin{tabular}{lrlr}" in table.latex()
    assert "<th class='word'>which</th>" in table.html()
    assert "<td class='word'>upper, x</td>" in table.html()
    assert "<td>-0.5</td>" in table.html()
    assert table.text().splitlines()[0] == "title"
    assert table.text().splitlines()[-2:] == [
        "b        -0.5  upper, x  \N{MINUS SIGN}3 of 4",
        "note",
    ]


@given(st.lists(TEXTS, min_size=2, max_size=4))
def test_csv_reads_back(cells: list[str]) -> None:
    table = Table("t", "title", tuple(cells), (tuple(cells),), "note")
    assert list(csv.reader(io.StringIO(table.csv()))) == [cells, cells]


@given(TEXTS)
def test_html_holds_no_markup_of_its_texts(text: str) -> None:
    hostile = f"<script>{text}</script>\"'&"
    page = Table("t", hostile, (hostile, "b"), ((hostile, "c"),), hostile).html()
    assert "<script" not in page
    assert page.count("</td>") == 2


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a_b & 50 % #1 {x} $y$", r"a\_b \& 50 \% \#1 \{x\} \$y\$"),
        ("C:\\x^2~", r"C:\textbackslash{}x\textasciicircum{}2\textasciitilde{}"),
        ("1 ± 2 –", r"1 $\pm$ 2 --"),
    ],
)
def test_latex_escapes_what_latex_would_read(text: str, expected: str) -> None:
    assert expected in Table("t", text, ("a", "b"), (("c", "d"),), "").latex()


def test_markdown_keeps_one_row_per_line() -> None:
    text = Table("t", "x", ("a|b", "c"), (("1\n2", "<b>"),), "n").markdown()
    assert "| a\\|b | c |" in text
    assert "| 1 2 | &lt;b> |" in text
