"""Filling a front: where the next attempt aims, and from which side."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_opt.polishing.archive import GrowingFront
from hybrid_opt.polishing.filling import TAIL, Edge, crept, filling, gaps
from hybrid_opt.polishing.settings import FillSettings
from symbolic.array import Array

SETTINGS = FillSettings(solved=10, stride=10.0, far=0.4)


def front(*objectives: tuple[float, float]) -> GrowingFront:
    """All polished; each decision vector is its index."""
    x = np.arange(float(len(objectives)))[:, None]
    archive = GrowingFront(x, np.array(objectives), list(range(len(objectives))))
    archive.polished = [True] * len(objectives)
    return archive


def test_gaps_are_measured_in_units_of_the_front() -> None:
    found = gaps(front((0.0, 10.0), (1.0, 2.5), (4.0, 0.0)))
    assert [(gap.first, gap.second) for gap in found] == [(0, 1), (1, 2)]
    assert [gap.length for gap in found] == pytest.approx([0.25 + 0.75, 0.75 + 0.25])
    assert [gap.width for gap in found] == pytest.approx([(0.25 * 0.75) ** 0.5] * 2)


def test_lengths_of_every_front_sum_up_to_two() -> None:
    rng = np.random.default_rng(2)
    ends = np.sort(rng.uniform(1.0, 3.0, 9)), -np.sort(-rng.uniform(5.0, 50.0, 9))
    found = gaps(front(*zip(*(end.tolist() for end in ends), strict=True)))
    assert sum(gap.length for gap in found) == pytest.approx(2.0)


def test_flat_tails_count_by_their_length() -> None:
    flat, _ = gaps(front((0.0, 1.0), (1e-9, 0.5), (1.0, 0.0)))
    assert flat.width == pytest.approx(TAIL * 0.5, rel=1e-3)


def test_the_widest_gap_is_next_half_way_along_it() -> None:
    archive = front((0.0, 1.0), (0.1, 0.8), (1.0, 0.0))
    found = filling(archive, set(), SETTINGS)
    assert found is not None
    attempt = found.attempt
    assert attempt.near
    assert found.edge == _edge(archive, 1, 2)
    np.testing.assert_array_equal(attempt.start, [0.1, 0.8])
    # The target's diagonal meets the chord half way: its difference of objectives is the mean.
    anchor = attempt.target.anchor
    assert anchor[0] - anchor[1] == pytest.approx((0.1 - 0.8 + 1.0 - 0.0) / 2.0)


def test_a_stride_is_never_longer_than_asked() -> None:
    archive = front((0.0, 1.0), (1.0, 0.0))
    found = filling(archive, set(), FillSettings(stride=0.3))
    assert found is not None
    anchor = found.attempt.target.anchor
    assert (anchor[0] - anchor[1]) - (0.0 - 1.0) == pytest.approx(0.3)


def test_sides_are_tried_once_each_and_gaps_left_then() -> None:
    archive, tried = front((0.0, 1.0), (0.2, 0.3), (1.0, 0.0)), set[Edge]()
    order = []
    while (found := filling(archive, tried, SETTINGS)) is not None:
        tried.add(found.edge)
        order.append(found.edge)
    near = [_edge(archive, 1, 2), _edge(archive, 2, 1)]
    far = [(first, second, False) for first, second, _ in near]
    narrow = [_edge(archive, 0, 1), _edge(archive, 1, 0)]
    assert order == near + far + narrow


def test_what_is_not_polished_is_no_start() -> None:
    archive = front((0.0, 1.0), (1.0, 0.0))
    archive.polished[0] = False
    found = filling(archive, set(), SETTINGS)
    assert found is not None
    assert found.edge == _edge(archive, 1, 0)


def test_a_point_beside_the_start_has_crept() -> None:
    archive = front((0.0, 1.0), (1.0, 0.0))
    found = filling(archive, set(), FillSettings(stride=0.4))
    assert found is not None
    assert crept(archive, found, np.array([0.05, 0.95]))
    assert not crept(archive, found, np.array([0.1, 0.8]))


def test_enough_points_are_enough() -> None:
    assert filling(front((0.0, 1.0), (1.0, 0.0)), set(), FillSettings(solved=2)) is None
    assert filling(front((0.0, 1.0)), set(), SETTINGS) is None


def _edge(archive: GrowingFront, start: int, across: int) -> Edge:
    vectors: list[Array] = archive.x
    return vectors[start].tobytes(), vectors[across].tobytes(), True
