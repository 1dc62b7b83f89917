"""Patterns of body names."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from symbolic.records.problems import matching

NAMES = ("payload", "left/link_1", "left/link_2", "right/link_1", "odd*name", "odd[1]")


def test_patterns() -> None:
    assert matching("left/*", NAMES) == ("left/link_1", "left/link_2")
    assert matching("*/link_?", NAMES) == NAMES[1:4]
    assert matching("odd*name", NAMES) == ("odd*name",)
    assert matching("odd[1]*", NAMES) == ("odd[1]",)
    assert matching("link", NAMES) == ()


@given(st.lists(st.text("ab*?", min_size=1), min_size=1), st.data())
def test_every_name_is_matched_by_itself(names: list[str], data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(names))
    assert matching(name, names) == (name,)
