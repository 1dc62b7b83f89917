"""The drivable experiment and the one beside it: what each knows of the other."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.campaign.results import read_campaign
from hybrid_opt.campaign.settings import POLISH, polished_folder
from hybrid_opt.polishing.records import PolishedFront
from hybrid_opt.store.files import write_json
from hybrid_opt.store.json_records import to_json
from hybrid_opt.timing import closest_to_reference_timing, time_path
from hybrid_opt.timing.document import read_timing
from studies.study.drivable import known_paths, least_force


def test_ends_and_middle_of_polished_fronts_and_the_balanced_path_are_known(
    study: Path, tmp_path: Path
) -> None:
    root = tmp_path / "results"
    shutil.copytree(study, root)
    campaign = read_campaign(root)
    n = campaign.workcell.task.n_path
    (balanced,) = least_force(campaign).values()
    np.testing.assert_array_equal(known_paths(root), balanced[None])
    replica = max(campaign.replicas, key=lambda one: len(one.front))
    front = PolishedFront(
        np.array(replica.front_x),
        np.array(replica.front),
        np.full(len(replica.front), -1),
        np.ones(len(replica.front), dtype=bool),
        (),
        1.0,
        1.0,
        "quadratic",
    )
    path = polished_folder(root, replica.algorithm, replica.replica) / POLISH
    path.parent.mkdir(parents=True)
    write_json(path, to_json(front))
    wanted = replica.front_x[[0, len(replica.front) // 2, -1], :n]
    both = np.unique(np.vstack([balanced, wanted]), axis=0)
    np.testing.assert_array_equal(known_paths(root), both)


def test_paths_are_timed_in_the_cell_that_robots_drive(study: Path) -> None:
    """Its pads press otherwise than the experiment's; the search's own timing stays its own."""
    document = read_timing(study / "timing" / "hand-made.json")
    own, driven = (read_campaign(root).cell for root in (study, study / "drivable"))
    assert own.workcell.task.allocation != driven.workcell.task.allocation
    found, curve = document.timings, document.force_curve
    assert found["search"].duration == pytest.approx(own.carry(own.initial).duration, rel=1e-12)
    assert curve is not None
    k = len(curve.force) // 2
    limits = driven.timing_model.drive_limits(float(curve.force[k]))
    timing = time_path(driven.timing_model, own.initial, limits)
    assert curve.duration[k] == pytest.approx(timing.duration, rel=1e-9)
    closest = closest_to_reference_timing(driven.timing_model, own.initial)
    assert found["closest to reference"].duration == pytest.approx(closest.duration, rel=1e-9)
