"""Options that are no number, or none of the range, are refused before any work."""

from __future__ import annotations

import argparse
from collections.abc import Callable

import pytest

from studies import inspect, reference_front, robust, simulate, thresholds
from studies.options import force, number, seed, whole

ODD = ("", " ", "a", "nan", "1e400", "-1", "9" * 5000, "\ud800", "1_000_000_000_000_000_000_000")


@pytest.mark.parametrize("text", ODD)
@pytest.mark.parametrize("kind", [whole(0, 10**6), number(0.0, 1e6), seed, force])
def test_odd_values_are_refused_in_one_line(kind: Callable[[str], object], text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError) as caught:
        kind(text)
    said = str(caught.value)
    assert said.startswith("found ")
    assert "; allowed is a" in said
    assert said.isprintable()
    assert len(said) < 120


def test_the_ends_belong_to_the_range() -> None:
    assert [whole(2, 5)(text) for text in ("2", "5")] == [2, 5]
    assert [number(-0.5, 1e3)(text) for text in ("-0.5", "1e3")] == [-0.5, 1e3]
    for text in ("1", "6", "3.0"):
        with pytest.raises(argparse.ArgumentTypeError):
            whole(2, 5)(text)


@pytest.mark.parametrize(
    ("main", "arguments"),
    [
        (robust.main, ["t.json", "--cases", "0"]),
        (robust.main, ["t.json", "--points", "-1"]),
        (robust.main, ["t.json", "--seed", "-1"]),
        (simulate.main, ["t.json", "--runs", "-5"]),
        (simulate.main, ["t.json", "--force-limit", "inf"]),
        (simulate.main, ["t.json", "--seed", "9" * 30]),
        (thresholds.main, ["--carries", "0"]),
        (thresholds.main, ["--seed", "-1"]),
        (inspect.main, ["c.toml", "--candidates", "1000000000000000"]),
        (inspect.main, ["c.toml", "--seed", "x"]),
        (reference_front.main, ["c.toml", "--output", "f.csv", "--starts", "0"]),
        (reference_front.main, ["c.toml", "--output", "f.csv", "--jobs", "-1"]),
        (reference_front.main, ["c.toml", "--output", "f.csv", "--attempts", "-1"]),
        (reference_front.main, ["c.toml", "--output", "f.csv", "--seed", "-1"]),
    ],
)
def test_programs_say_what_is_allowed(
    main: Callable[[list[str]], int], arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert arguments[-2] in said
    assert "allowed is a whole number" in said or "allowed is a number" in said
