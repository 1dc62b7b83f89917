"""Chords between neighbours of a front: feasible points that win area, or none."""

from __future__ import annotations

import numpy as np

from hybrid_opt.indicators.metrics import hypervolume
from hybrid_opt.polishing.archive import GrowingFront
from hybrid_opt.polishing.chords import Chord, between, chord_of, widest
from hybrid_opt.polishing.filling import gaps
from hybrid_opt.polishing.settings import FillSettings
from tests.hybrid_opt.polishing.test_filling import front
from tests.hybrid_opt.polishing.test_front import evaluator, polished

FILL = FillSettings()


def archive_of_polished() -> GrowingFront:
    """Every fourth member of a polished front."""
    x, objectives = polished().x[::4], polished().objectives[::4]
    archive = GrowingFront(x, objectives, list(range(len(x))))
    archive.polished = [True] * len(x)
    return archive


def test_the_widest_chords_come_first_and_each_once() -> None:
    archive, tried, widths = front((0.0, 9.0), (1.0, 4.0), (2.0, 3.0), (9.0, 0.0)), set[Chord](), []
    while (gap := widest(archive, tried)) is not None:
        tried.add(chord_of(archive, gap))
        widths.append(gap.width)
    assert len(widths) == 3
    assert widths == sorted(widths, reverse=True)


def test_points_that_no_solve_made_have_no_chords() -> None:
    archive = front((0.0, 9.0), (1.0, 4.0), (2.0, 3.0))
    archive.polished[0] = False
    gap = widest(archive, set())
    assert gap is not None
    assert (gap.first, gap.second) == (1, 2)


def test_a_point_on_a_chord_is_feasible_and_wins_area() -> None:
    archive, found = archive_of_polished(), 0
    before = hypervolume(np.array(archive.objectives))
    for gap in gaps(archive):
        point = between(evaluator(), archive, gap, FILL)
        if point is None:
            continue
        x, objectives = point
        judged = evaluator().evaluate(x)
        assert judged.feasible[0]
        np.testing.assert_array_equal(judged.objectives[0], objectives)
        assert hypervolume(np.array([*archive.objectives, objectives])) > before
        way = archive.x[gap.second] - archive.x[gap.first]
        share = (x - archive.x[gap.first]) @ way / (way @ way)
        assert 0.0 < share < 1.0
        np.testing.assert_allclose(x, archive.x[gap.first] + share * way, atol=1e-12)
        found += 1
    assert found > 0


def test_a_chord_through_what_is_infeasible_leads_nowhere() -> None:
    archive = archive_of_polished()
    archive.x[0], archive.x[1] = evaluator().lower, evaluator().upper
    gap = next(gap for gap in gaps(archive) if {gap.first, gap.second} == {0, 1})
    assert between(evaluator(), archive, gap, FILL) is None
