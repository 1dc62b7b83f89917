"""Decided start branches in the text of a workcell file."""

from __future__ import annotations

import tomllib

import pytest

from symbolic.read.cell import with_branches


@pytest.mark.parametrize(
    ("robots", "expected"),
    [
        ("[{start_branch = 'search'}, {start_branch=\"search\"}]", [3, 5]),
        ('[{start_branch = 7}, {"start_branch" = "search"}]', [7, 5]),
        ('[{start_branch = "search"}, {}]', [3, None]),
        ("[{}, {}]", [None, None]),
    ],
)
def test_each_robot_gets_its_own(robots: str, expected: list[int | None]) -> None:
    text = f"robots = {robots}\n".encode()
    changed = with_branches(text, tomllib.loads(text.decode()), (3, 5))
    found = tomllib.loads(changed.decode())["robots"]
    assert [robot.get("start_branch") for robot in found] == expected


def test_undecided_ones_stay() -> None:
    text = b'robots = [{start_branch = "search"}, {start_branch = "search"}]'
    assert with_branches(text, tomllib.loads(text.decode()), (-2, -2)) == text
