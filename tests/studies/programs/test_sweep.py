"""The sweep's options, its table and its figure."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from hybrid_opt.extras.sweeping import Combination, Sweep, read_sweep
from hybrid_opt.store.files import to_json, write_json
from studies.programs import sweeping
from studies.programs.sweeping import _figure, _table
from studies.sweep import main
from symbolic.errors import WorkcellError


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("payload.mass=6:14:2", (6.0, 8.0, 10.0, 12.0, 14.0)),
        ("contacts.friction=0.4:1:0.1", (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)),
        ("task.ramp_time=0.5", (0.5,)),
        ("payload.mass=6,11,7", (6.0, 11.0, 7.0)),
    ],
)
def test_values_of_a_key(text: str, values: tuple[float, ...]) -> None:
    options = main.parser().parse_args(["cell.toml", "--over", text])
    assert options.over == [(text.partition("=")[0], values)]


@pytest.mark.parametrize("text", ["payload.mass", "=1:2:1", "m=1:2", "m=2:1:1", "m=1:2:0", "m=x"])
def test_wrong_values_are_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main.parser().parse_args(["cell.toml", "--over", text])
    assert "--over" in capsys.readouterr().err


def test_a_key_that_leads_nowhere_is_told_before_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(*given: object, **settings: object) -> None:
        pytest.fail("searched before the key was looked at")

    monkeypatch.setattr(sweeping, "search", work)
    begin = ["studies/workcells/rack.toml", "--output", str(tmp_path), "--jobs", "1", "--over"]
    with pytest.raises(WorkcellError, match=r"^studies/workcells/rack\.toml: [^/]*payload\.weight"):
        sweeping.sweep_numbers(main.parser().parse_args([*begin, "payload.weight=3"]))


def test_a_sweep_is_stored_listed_and_drawn(tmp_path: Path) -> None:
    rows = (
        Combination((8.0, 0.5), np.nan, np.nan, np.zeros(0), "unheld"),
        Combination((8.0, 1.0), 2.5, 90.0, np.ones(3)),
    )
    done = Sweep("digest", {"mass": (8.0,), "friction": (0.5, 1.0)}, np.zeros(3), rows)
    write_json(tmp_path / "sweep.json", to_json(done))
    assert repr(read_sweep(tmp_path / "sweep.json")) == repr(done)
    assert re.search(r"mass 8, friction 0\.5: .*unheld", repr(done))
    assert _table(done).rows[1] == ("8", "1", "2.500", "90.0", "")
    left, right = _figure(done).axes
    assert np.ravel(left.lines[0].get_ydata())[1] == 2.5
    assert np.ravel(right.lines[0].get_ydata())[1] == 90.0
