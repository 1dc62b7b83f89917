"""Motion bounds against densely sampled motion, point by point."""

from __future__ import annotations

import numpy as np
import pytest

from symbolic.array import Array
from symbolic.geometry.pairs import coal_distance
from symbolic.geometry.pieces import Piece, farthest_from_axis, skeleton
from symbolic.geometry.screen import reach_about_joints
from tests.symbolic.geometry.collision_cells import (
    functions_of,
    placed_pieces,
    random_configurations,
    whole_geometry_of,
)

STEPS = 16


def points_of(pieces: list[tuple[Piece, ...]]) -> list[Array]:
    return [np.vstack([skeleton(piece)[0] for piece in body]) for body in pieces]


@pytest.mark.parametrize("size", [0.02, 0.2, 0.6])
def test_no_point_moves_farther_than_the_bound(size: float) -> None:
    """Distances at both ends, chord and bend bound every point's way between."""
    geometry = whole_geometry_of("rack")
    motion = functions_of(geometry)["motion"]
    rng = np.random.default_rng(21)
    starts = np.hstack(random_configurations(geometry, 12, rng))
    ends = starts + rng.uniform(-size, size, starts.shape)
    parts = (slice(0, 6), slice(6, 12), slice(12, 18))
    for a, b in zip(starts, ends, strict=True):
        chord, bend = (
            np.ravel(np.array(v)) for v in motion(*[a[p] for p in parts], *[b[p] for p in parts])
        )
        seen = []
        for s in np.linspace(0.0, 1.0, STEPS + 1):
            c = (1 - s) * a + s * b
            seen.append(points_of(placed_pieces(geometry, *[c[p] for p in parts])))
        for k, pair in enumerate(geometry.active):
            first, second = geometry.bodies[pair.first], geometry.bodies[pair.second]
            if first.group == second.group:
                continue
            for j, s in enumerate(np.linspace(0.0, 1.0, STEPS + 1)):
                for end, share in ((0, s), (STEPS, 1 - s)):
                    way = sum(
                        np.linalg.norm(seen[j][i] - seen[end][i], axis=1).max()
                        for i in (pair.first, pair.second)
                    )
                    allowed = share * chord[k] + s * (1 - s) / 2.0 * bend[k]
                    assert way <= allowed + 1e-9, geometry.pair_names[k]


def test_links_of_one_arm_approach_no_faster_than_the_bound() -> None:
    geometry = whole_geometry_of("rack")
    motion = functions_of(geometry)["motion"]
    rng = np.random.default_rng(22)
    starts = np.hstack(random_configurations(geometry, 15, rng))
    ends = starts + rng.uniform(-0.2, 0.2, starts.shape)
    parts = (slice(0, 6), slice(6, 12), slice(12, 18))
    own = [
        k
        for k, pair in enumerate(geometry.active)
        if geometry.bodies[pair.first].group == geometry.bodies[pair.second].group
    ]
    assert own
    for a, b in zip(starts, ends, strict=True):
        chord, bend = (
            np.ravel(np.array(v)) for v in motion(*[a[p] for p in parts], *[b[p] for p in parts])
        )
        before = placed_pieces(geometry, *[a[p] for p in parts])
        after = placed_pieces(geometry, *[b[p] for p in parts])
        for k in own:
            pair = geometry.active[k]
            d_a = max(0.0, coal_distance(before[pair.first], before[pair.second]))
            d_b = max(0.0, coal_distance(after[pair.first], after[pair.second]))
            assert bend[k] == 0.0
            assert abs(d_a - d_b) <= chord[k] + 1e-5


def test_reach_of_a_link_about_its_own_joint_is_exact_to_its_shape() -> None:
    geometry = whole_geometry_of("rack")
    arm = geometry.arms[0]
    for body in geometry.bodies:
        if body.group != "robot 1" or body.frame.joint < 0:
            continue
        reach = reach_about_joints(body, arm)
        k = body.frame.joint
        own = max(farthest_from_axis(p, np.zeros(3), arm.axes[k]) for p in body.pieces)
        assert reach[k] == pytest.approx(own)
        assert np.all(reach[k + 1 :] == 0.0)
        assert np.all(reach[:k] > 0.0)


def test_standing_still_is_no_motion() -> None:
    geometry = whole_geometry_of("rack")
    at = [array[0] for array in random_configurations(geometry, 1, np.random.default_rng(23))]
    chord, bend = functions_of(geometry)["motion"](*at, *at)
    assert np.all(np.array(chord) == 0.0)
    assert np.all(np.array(bend) == 0.0)
