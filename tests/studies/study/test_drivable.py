"""What the drivable experiment knows of the one beside it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from hybrid_opt.campaign.layout import POLISH, polished_folder
from hybrid_opt.campaign.polish_document import polish_document
from hybrid_opt.campaign.results import read_campaign
from hybrid_opt.polishing.records import PolishedFront
from hybrid_opt.store.files import write_json
from hybrid_opt.store.json_records import to_json
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
    write_json(path, to_json(polish_document(front)))
    wanted = replica.front_x[[0, len(replica.front) // 2, -1], :n]
    both = np.unique(np.vstack([balanced, wanted]), axis=0)
    np.testing.assert_array_equal(known_paths(root), both)
