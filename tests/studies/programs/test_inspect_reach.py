"""Where both arms can hold the box, as `inspect --reach` prints and draws it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from studies import inspect
from symbolic.records.poses import Orientation, box_placement
from tests.hybrid_opt.extras.proposing.test_hold_map import box_text
from tests.refusals import ended_by


def test_reach_is_told_and_drawn_without_poses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = tmp_path / "box.toml"
    cell.write_text(box_text(), encoding="utf-8")
    grid = ["--step", "0.1", "--heights", "0.3,2.5", "--yaws", "1"]
    assert inspect.main(["--reach", str(cell), *grid, "--json", "--output", str(tmp_path)]) == 0
    found = json.loads(capsys.readouterr().out)
    low, high = found["heights"]
    assert low["places"] > 0
    assert (high["places"], high["best"]) == (0, None)
    assert low["best"] == found["start"]
    T_world_box = box_placement(Orientation(), np.array(found["start"]))
    pads = [(T_world_box @ [*xyz, 1.0])[0] for xyz in found["contacts"]]
    assert pads[0] < pads[1], "each arm holds the face on its own side"
    (picture,) = found["files"]
    assert np.asarray(Image.open(picture).convert("L")).std() > 10.0


def test_options_of_one_kind_of_inspection_go_together(tmp_path: Path) -> None:
    cell = tmp_path / "box.toml"
    cell.write_text(box_text(), encoding="utf-8")
    with ended_by("settings", "--polish", "--reach"):
        inspect.main([str(cell), "--reach", "--polish"])
    for wrong in ("high", "0.3,,1", "99"):
        with ended_by("settings", "heights"):
            inspect.main([str(cell), "--reach", "--heights", wrong])
    with ended_by("settings", "--yaws", "--reach"):
        inspect.main([str(cell), "--yaws", "2"])
