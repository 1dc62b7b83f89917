"""Pairs left out by the workcell file and by an SRDF."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from symbolic.geometry.pairs import build_geometry
from symbolic.records import CollisionSettings, IgnoredPair
from tests.symbolic.geometry.collision_cells import rack


def test_a_pattern_stands_for_every_pair_it_matches() -> None:
    cell = rack()
    names = {body.name for body in build_geometry(cell).bodies}
    left = {name for name in names if name.startswith("left/link_")}
    pattern = IgnoredPair("left/link_*", "payload", "held")
    geometry = build_geometry(replace(cell, collision=CollisionSettings(ignored=(pattern,))))
    assert len(left) == 6
    reasons = {
        frozenset((geometry.bodies[p.first].name, geometry.bodies[p.second].name)): p.reason
        for p in geometry.excluded
    }
    assert all(reasons[frozenset((name, "payload"))].endswith("held") for name in left)
    assert "ignored" not in reasons.get(frozenset(("right/link_1", "payload")), "")


def test_disabled_pairs_of_an_srdf_are_left_out_for_its_robot(tmp_path: Path) -> None:
    cell = rack()
    free = build_geometry(cell)
    pair = ("left/link_1", "left/link_4")
    assert pair in free.pair_names
    srdf = tmp_path / "arm.srdf"
    srdf.write_text(
        '<robot><disable_collisions link1="link_4" link2="link_1" reason="Never"/>'
        '<disable_collisions link1="link_1" link2="no_shape" reason="Never"/></robot>',
        encoding="utf-8",
    )
    robots = (replace(cell.robots[0], srdf=srdf), cell.robots[1])
    geometry = build_geometry(replace(cell, robots=robots))
    assert set(free.pair_names) - set(geometry.pair_names) == {pair}
    assert "disabled in arm.srdf: Never" in [pair.reason for pair in geometry.excluded]
