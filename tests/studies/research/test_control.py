"""Polished studies beside longer searches."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.campaign.results import read_campaign
from hybrid_opt.errors import ResultsError
from hybrid_opt.evaluate.objectives import front_of
from hybrid_opt.indicators import metrics
from hybrid_opt.progress import Progress
from studies.research import longer_searches
from studies.research.best_front import ReferenceFront
from studies.research.control import main
from studies.study.summary import read_summary
from tests.refusals import ended_by, refused


@pytest.fixture(scope="module")
def polished(polished_study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy: longer searches are stored in it."""
    return Path(shutil.copytree(polished_study, tmp_path_factory.mktemp("control") / "results"))


def test_longer_searches_repeat_the_studys_own_settings(polished: Path) -> None:
    (found,) = longer_searches.controls(polished, [160], 1, Progress(shown=False))
    longer = read_campaign(polished / "control" / "160")
    own = read_campaign(polished)
    stored, wanted = longer.settings, own.settings
    assert stored == replace(wanted, evaluations=160)
    # The same seed: the longer search begins as the shorter one, up to its cut last generation.
    first, second = longer.replicas[0].evaluations.x, own.replicas[0].evaluations.x
    assert (first[:120] == second).all()
    rows = read_summary(polished).algorithms["nsga2"].replicas
    alone = [metrics.hypervolume(r.front, metrics.REFERENCE_POINT) for r in longer.replicas]
    after = [row.polished.hypervolume for row in rows if row.polished is not None]
    wins = sum(mine > theirs for mine, theirs in zip(after, alone, strict=True))
    assert (found.polished_wins, found.replicas, found.evaluations) == (wins, 2, 160)
    # A second call reads what the first one computed.
    assert longer_searches.controls(polished, [160], 1, Progress(shown=False)) == [found]
    assert "NSGA-II, 160 evaluations" in longer_searches.as_text([found])


def test_distance_to_a_reference_front(polished: Path) -> None:
    own = read_campaign(polished)
    fronts = [front.objectives for front in own.fronts if front.polished]
    assert len(fronts) == 2
    union = front_of(np.concatenate(fronts))
    reference = ReferenceFront(own.workcell.digest, union, np.empty((len(union), 0)))
    (found,) = longer_searches.approaches(polished, reference)
    gaps = [metrics.hypervolume(union) - metrics.hypervolume(r.front) for r in own.replicas]
    assert found.search_gap == pytest.approx(np.median(gaps))
    assert 0.0 <= found.polished_gap < found.search_gap
    assert found.polished_igd < found.search_igd
    assert found.closed == pytest.approx(100.0 * (1.0 - found.polished_gap / found.search_gap))
    assert "NSGA-II" in longer_searches.approaches_text([found])
    searched = front_of(np.concatenate([r.front for r in own.replicas[:1]]))
    own_front = ReferenceFront(own.workcell.digest, searched, np.empty((len(searched), 0)))
    assert longer_searches.approaches(polished, own_front)  # the gap to it may be none
    with refused(ResultsError, "another-workcell"):
        longer_searches.approaches(
            polished, ReferenceFront("0" * 64, union, np.empty((len(union), 0)))
        )


def test_a_study_without_a_polish_is_told(study: Path) -> None:
    with ended_by("not-polished", "--polish"):
        assert main([str(study)]) == 2
