"""Disabled pairs of SRDF files."""

from __future__ import annotations

from pathlib import Path

import pytest

from symbolic.errors import UrdfError
from symbolic.read.urdf import DisabledPair, read_srdf


def test_pairs_are_read_in_order_and_the_rest_is_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "arm.srdf"
    path.write_text(
        '<robot name="arm"><group name="g"><joint name="j"/></group>'
        '<disable_collisions link1="a" link2="b" reason="Adjacent"/>'
        '<disable_collisions link1="a" link2="c"/></robot>',
        encoding="utf-8",
    )
    assert read_srdf(path) == (DisabledPair("a", "b", "Adjacent"), DisabledPair("a", "c", ""))


def test_a_pair_without_a_link_is_told(tmp_path: Path) -> None:
    path = tmp_path / "arm.srdf"
    path.write_text('<robot><disable_collisions link1="a"/></robot>', encoding="utf-8")
    with pytest.raises(UrdfError, match=r"arm\.srdf: .*disable_collisions\[0\] link2: is missing"):
        read_srdf(path)
